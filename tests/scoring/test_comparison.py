import json

import numpy as np
import pytest

from kpbench.errors import DataError, GateFailed
from kpbench.report.report import to_html, to_markdown_report
from kpbench.report.sections import Report
from kpbench.scoring.comparison import COMPARED_METRICS, check_regression, compare
from kpbench.scoring.scores import score
from kpbench.types import KEYPOINT_DTYPE, Detections, Predictions, Truth

SCENES, RUNGS = 40, (3, 15)


def truth_of():
    """One keypoint an image, each scene under two rungs."""
    n = SCENES * len(RUNGS)
    keypoints = np.zeros(n, KEYPOINT_DTYPE)
    keypoints["x"] = keypoints["y"] = keypoints["radius_major"] = keypoints["radius_minor"] = 10
    return Truth(
        image_id=np.arange(n),
        offsets=np.arange(n + 1),
        keypoints=keypoints,
        condition=np.array(["blur"] * n),
        rung=np.repeat(RUNGS, SCENES).astype(float),
        scene_id=np.tile(np.arange(SCENES), len(RUNGS)),
    )


TRUTH = truth_of()


def run(hits, alarms=None, ids=0, name="a"):
    """Scores of a detector that finds the keypoint of each image or not, and adds false alarms."""
    alarms = np.zeros(len(hits), int) if alarms is None else alarms
    found = [
        Detections([[10, 10]] * hit + [[50, 50]] * more, [1.0] * (hit + more), [ids] * hit + [0] * more)
        for hit, more in zip(np.asarray(hits, int).tolist(), np.asarray(alarms, int).tolist(), strict=True)
    ]
    return score(TRUTH, Predictions.from_detections(found, TRUTH.image_id, {"name": name}), resamples=400)


def verdict(comparison, metric, condition=None, rung=None):
    return next(d for d in comparison.differences if (d.metric, d.condition, d.rung) == (metric, condition, rung))


def test_a_detector_against_itself_is_even_everywhere():
    hits = np.random.default_rng(0).random(len(TRUTH)) < 0.6
    c = compare(run(hits), run(hits))
    assert {d.value for d in c.differences} == {0.0}
    assert {d.verdict for d in c.differences} == {"even"}
    assert [(d.condition, d.rung) for d in c.differences[:: len(COMPARED_METRICS)]] == [
        (None, None),
        ("blur", 3),
        ("blur", 15),
    ]
    check_regression([c])


def test_differences_are_paired():
    rng = np.random.default_rng(1)
    hard = np.tile(rng.random(SCENES) < 0.5, 2)  # half of the scenes nobody solves: far more spread than difference
    first, second = ~hard, ~hard.copy()
    lost = np.flatnonzero(second)[:12]
    second[lost] = False
    d = verdict(compare(run(first), run(second)), "detection_score")
    assert d.value == pytest.approx(12 / 80)
    assert d.verdict == "better"
    a, b = (run(h).overall.intervals["detection_score"] for h in (first, second))
    assert d.interval[1] - d.interval[0] < 0.6 * (a[1] - a[0])
    assert a[0] < b[1]  # the intervals of the two overlap, that of the difference leaves out 0
    mirrored = verdict(compare(run(second), run(first)), "detection_score")
    assert (mirrored.value, mirrored.verdict) == (-d.value, "worse")
    assert mirrored.interval == pytest.approx((-d.interval[1], -d.interval[0]))


def test_fewer_false_alarms_are_better():
    hits = np.ones(len(TRUTH), bool)
    few, many = np.arange(80) % 4 == 0, np.arange(80) % 4
    c = compare(run(hits, few), run(hits, many))
    assert verdict(c, "average_false_alarm").verdict == "better"
    assert verdict(c, "precision").verdict == "better"
    assert verdict(c, "detection_score").verdict == "even"
    assert c.verdicts("average_false_alarm") == {"better": 2, "even": 0, "worse": 0}
    check_regression([c])
    with pytest.raises(GateFailed, match=r"^false alarms per image of b is worse than that of a by \+1\.2500 \[\+"):
        check_regression([compare(run(hits, many, name="b"), run(hits, few))])


def test_one_rung_can_be_lost_while_the_whole_is_even():
    first, second = np.ones(80, bool), np.ones(80, bool)
    first[:20], second[60:] = False, False
    c = compare(run(first), run(second))
    assert c.verdicts("detection_score") == {"better": 1, "even": 0, "worse": 1}
    assert verdict(c, "detection_score", "blur", 3).value == -0.5
    assert verdict(c, "detection_score").verdict == "even"


def test_what_is_undefined_for_one_is_undefined_for_the_difference():
    hits = np.ones(80, bool)
    blind = score(TRUTH, [Detections([[10, 10]], [1.0])] * 80, resamples=400)
    c = compare(run(hits), blind)
    d = verdict(c, "id_matching_score")
    assert (d.second, d.value, d.interval, d.verdict) == (None, None, None, "even")
    assert json.loads(json.dumps(c.to_dict()))["differences"][1]["difference"] is None


def test_other_images_or_settings_do_not_compare():
    hits = np.ones(80, bool)
    keypoints = TRUTH.keypoints.copy()
    keypoints["x"] += 1
    other = score(Truth(**{**vars(TRUTH), "keypoints": keypoints}), [Detections.none()] * 80)
    coarse = score(TRUTH, [Detections.none()] * 80, eps=0.5)
    for wrong in (other, coarse):
        with pytest.raises(DataError, match="not scored on the same images with the same settings"):
            compare(run(hits), wrong)


def test_a_report_shows_the_comparison():
    a, b = run(np.ones(80, bool), name="a"), run(np.zeros(80, bool), name="b")
    report = Report((a, b), comparisons=(compare(a, b),))
    assert "**a minus b**" in to_markdown_report(report)
    assert "a against the others" in to_html(report)


def test_one_scene_cannot_tell_and_does_not_pass():
    seen, blind = ([Detections([[10, 10]], [1.0], [0])], [Detections.none()])
    one = Truth(
        np.arange(1), np.arange(2), TRUTH.keypoints[:1], TRUTH.condition[:1], TRUTH.rung[:1], TRUTH.scene_id[:1]
    )
    c = compare(score(one, blind, resamples=100), score(one, seen, resamples=100))
    with pytest.raises(GateFailed, match=r"detection score of .* by -1\.0000, and without an interval"):
        check_regression([c])
