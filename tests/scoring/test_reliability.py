import numpy as np
import pytest

from kpbench.report.report import to_markdown_report
from kpbench.report.sections import Report
from kpbench.report.summary import summarise_scores
from kpbench.scoring.reliability import compute_reliability
from kpbench.scoring.scores import score
from kpbench.types import KEYPOINT_DTYPE, Detections, Truth


def by_hand(scores, hits):
    """The definition, detection by detection."""
    total = 0.0
    for b in range(10):
        inside = [
            (s, h) for s, h in zip(scores, hits, strict=True) if b / 10 <= s < (b + 1) / 10 or (b == 9 and s == 1)
        ]
        total += abs(sum(s - h for s, h in inside))
    return total / len(scores)


def test_the_error_follows_the_definition():
    rng = np.random.default_rng(0)
    scores = np.append(rng.random(500), np.arange(11) / 10)  # with every edge
    hits = rng.random(len(scores)) < scores**2
    found = compute_reliability(scores, hits)
    assert found["ece"] == pytest.approx(by_hand(scores.tolist(), hits.tolist()))
    assert sum(b["detections"] for b in found["bins"]) == len(scores)
    shuffled = rng.permutation(len(scores))
    assert compute_reliability(scores[shuffled], hits[shuffled])["ece"] == pytest.approx(found["ece"], abs=1e-15)


def test_probabilities_that_hold_have_a_small_error():
    rng = np.random.default_rng(1)
    scores = rng.random(20_000)
    assert compute_reliability(scores, rng.random(20_000) < scores)["ece"] < 0.02


@pytest.mark.parametrize("scores", [[], [-0.1, 0.5], [0.5, 1.1]])
def test_scores_that_are_no_probabilities_have_no_error(scores):
    assert compute_reliability(np.array(scores, float), np.ones(len(scores), bool)) == {"ece": None, "bins": []}


def test_scores_and_reports_hold_it():
    keypoints = np.zeros(4, KEYPOINT_DTYPE)
    for name in ("x", "y", "radius_major", "radius_minor"):
        keypoints[name] = 10
    truth = Truth(np.arange(4), np.arange(5), keypoints, np.array([""] * 4), np.full(4, np.nan), np.arange(4))
    scores = score(truth, [Detections([[10, 10], [50, 50]], [0.95, 0.25])] * 4, resamples=0)
    content = scores.to_dict()["reliability"]
    assert content["ece"] == pytest.approx((0.05 + 0.25) / 2)
    assert [b["precision"] for b in content["bins"]] == [0, 1]
    assert "ECE 0.150" in summarise_scores(scores)
    assert "Calibration of the score" in to_markdown_report(Report((scores,)))
