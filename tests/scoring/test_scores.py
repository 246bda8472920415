import itertools
import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import stats

from kpbench.errors import DataError, GateFailed, PredictionsError
from kpbench.scoring import assignment, bootstrap
from kpbench.scoring.assignment import CLUTTER, DUPLICATE, MATCHED, NEAR_MISS, DetectionPoints, TruthPoints, match
from kpbench.scoring.metrics import METRICS
from kpbench.scoring.outcomes import Settings
from kpbench.scoring.scores import check_gates, score
from kpbench.types import KEYPOINT_DTYPE, Detections, Predictions, Truth


def truth_of(images, condition=None, rung=None, scene=None, image_id=None):
    """Truth from a list of images, each a list of (x, y, radius, id)."""
    n = len(images)
    rows = [row for image in images for row in image]
    keypoints = np.zeros(len(rows), KEYPOINT_DTYPE)
    for k, (x, y, radius, patch_id) in enumerate(rows):
        keypoints[k]["x"], keypoints[k]["y"], keypoints[k]["patch_id"] = x, y, patch_id
        keypoints[k]["radius_major"], keypoints[k]["radius_minor"] = radius, radius / 2
    return Truth(
        image_id=np.arange(n) if image_id is None else np.asarray(image_id),
        offsets=np.concatenate([[0], np.cumsum([len(image) for image in images])]).astype(np.int64),
        keypoints=keypoints,
        condition=np.array([""] * n if condition is None else condition),
        rung=np.full(n, np.nan) if rung is None else np.asarray(rung, float),
        scene_id=np.arange(n) if scene is None else np.asarray(scene),
    )


def found(*rows, ids=True):
    """Detections from rows (x, y, score, id)."""
    table = np.array(rows, float).reshape(-1, 4)
    return Detections(table[:, :2], table[:, 2], table[:, 3].astype(int) if ids else None)


def run(truth, detections, **options):
    return score(truth, detections, resamples=0, **options)


# --- cases ------------------------------------------------------------------------------------------------------

# Places on a grid and few scores, so that overlaps, ties and distances equal to the reach come up all the time
PLACE = st.integers(0, 8).map(lambda n: n / 2)
KEYPOINT = st.tuples(PLACE, PLACE, st.sampled_from([0.5, 1.0, 2.0]), st.integers(0, 2))
DETECTION = st.tuples(PLACE, PLACE, st.sampled_from([0.25, 0.5, 0.75]), st.integers(0, 2))
IMAGE = st.tuples(st.lists(KEYPOINT, max_size=4), st.lists(DETECTION, max_size=5))
IMAGES = st.lists(IMAGE, min_size=1, max_size=4)
EPS = st.sampled_from([0.0, 0.5, 1.0, 1.5])


def tables(images):
    return truth_of([t for t, _ in images]), [found(*d) for _, d in images]


def matchings(allowed):
    """Every one-to-one assignment as a list of (keypoint, detection); slow and simple."""
    keypoints = sorted({t for t, _ in allowed})

    def extend(k, used):
        if k == len(keypoints):
            yield []
            return
        yield from extend(k + 1, used)
        for t, d in allowed:
            if t == keypoints[k] and d not in used:
                for rest in extend(k + 1, used | {d}):
                    yield [(t, d), *rest]

    return extend(0, frozenset())


def worth(pairs, keypoints, detections):
    """Most matches, then highest scores, then least distance."""
    distance = sum(np.hypot(keypoints[t][0] - detections[d][0], keypoints[t][1] - detections[d][1]) for t, d in pairs)
    return len(pairs), sorted((detections[d][2] for _, d in pairs), reverse=True), -round(distance, 9)


def match_of(images, eps):
    truth, detections = tables(images)
    p = Predictions.from_detections(detections)
    keypoints = truth.keypoints
    truth_image, image = (np.repeat(np.arange(len(images)), np.diff(offsets)) for offsets in (truth.offsets, p.offsets))
    xy = np.stack([keypoints["x"], keypoints["y"]], axis=1)
    truth_points = TruthPoints(xy, keypoints["radius_major"].astype(float), truth_image)
    return match(truth_points, DetectionPoints(p.xy, p.score, image, p.patch_id), eps)


@given(IMAGES, EPS)
@settings(max_examples=80, deadline=None)
def test_the_matching_is_the_best_of_all(images, eps):
    m = match_of(images, eps)
    t0 = d0 = 0
    for keypoints, detections in images:
        reach = {
            (t, d): np.hypot(k[0] - f[0], k[1] - f[1])
            for (t, k), (d, f) in itertools.product(enumerate(keypoints), enumerate(detections))
        }
        allowed = [pair for pair, distance in reach.items() if distance <= eps * keypoints[pair[0]][2]]
        pairs = [(t, m.detection[t0 + t] - d0) for t in range(len(keypoints)) if m.detection[t0 + t] >= 0]
        assert set(pairs) <= set(allowed)
        assert len({d for _, d in pairs}) == len(pairs)
        best = max(worth(option, keypoints, detections) for option in matchings(allowed))
        assert worth(pairs, keypoints, detections) == best
        for t in range(len(keypoints)):
            distance = m.distance[t0 + t]
            assert np.isnan(distance) if t not in dict(pairs) else distance == reach[t, dict(pairs)[t]]
        for d in range(len(detections)):
            mine = [distance for pair, distance in reach.items() if pair[1] == d and pair in allowed]
            near = any(reach[t, d] <= keypoints[t][2] for t in range(len(keypoints)))
            explains = d in dict(pairs).values()
            kind = MATCHED if explains else DUPLICATE if mine else NEAR_MISS if near else CLUTTER
            assert m.kind[d0 + d] == kind
            nearest = m.nearest[d0 + d] - t0
            assert reach[nearest, d] == min(mine) if mine else m.nearest[d0 + d] == -1
        t0, d0 = t0 + len(keypoints), d0 + len(detections)


@given(IMAGES, EPS)
@settings(max_examples=80, deadline=None)
def test_one_matching_serves_all_thresholds(images, eps):
    truth, detections = tables(images)
    truths = len(truth.keypoints)
    assume(truths)
    whole = run(truth, detections, eps=eps)
    area = recall = 0.0
    for n, level in enumerate(whole.curve["score"]):
        part = run(truth, [d[d.score >= level] for d in detections], eps=eps)
        assert whole.curve["precision"][n] == part["precision"]
        assert whole.curve["recall"][n] == part["recall"]
        assert whole.curve["average_false_alarm"][n] == part["average_false_alarm"]
        area += (part["recall"] - recall) * part["precision"]
        recall = part["recall"]
    assert whole["average_precision"] == pytest.approx(area)


def literal_by_hand(images, eps):
    """The paper's formulas as printed, by the letter: (successes, of which with the right ID)."""
    hits = right = 0
    for keypoints, detections in images:
        for x, y, _, patch_id in detections:
            reached = [
                (np.hypot(x - k[0], y - k[1]), k[0], k[1], k[3])
                for k in keypoints
                if np.hypot(x - k[0], y - k[1]) <= eps * k[2]
            ]
            hits += bool(reached)
            # two keypoints at one place are no patches; whichever is right
            right += any(k[3] == patch_id for k in reached if k[:3] == min(reached)[:3])
    return hits, right


@given(IMAGES, EPS)
@settings(max_examples=80, deadline=None)
def test_the_literal_reading_counts_every_detection_in_reach(images, eps):
    for keypoints, _ in images:
        assume(len({k[:2] for k in keypoints}) == len(keypoints))
    truth, detections = tables(images)
    hits, right = literal_by_hand(images, eps)
    total, truths = sum(len(d) for d in detections), len(truth.keypoints)
    scores = run(truth, detections, eps=eps)
    assert scores.overall.counts["matched_literal"] == hits
    assert scores.overall.counts["id_correct_literal"] == right
    assert scores["average_false_alarm_literal"] == (total - hits) / len(images)
    assert scores["detection_score_literal"] == (hits / truths if truths else None)
    printed = run(truth, detections, eps=eps, matching="literal")
    for name in ("detection_score", "id_matching_score", "average_false_alarm"):
        assert printed[name] == scores[f"{name}_literal"]


# --- properties -------------------------------------------------------------------------------------------------


@given(IMAGES, EPS, st.randoms(use_true_random=False))
@settings(max_examples=40, deadline=None)
def test_no_order_changes_anything(images, eps, random):
    images = [(t, d) for t, d in images if len({k[:2] for k in t}) == len(t)]
    assume(images)
    order = random.sample(range(len(images)), len(images))
    shuffled = [tuple(random.sample(part, len(part)) for part in images[n]) for n in order]
    truth, detections = tables(images)
    p = Predictions.from_detections(detections)
    truth2, detections2 = tables(shuffled)
    truth2 = Truth(
        np.array(order), *(getattr(truth2, n) for n in ("offsets", "keypoints", "condition", "rung")), np.array(order)
    )
    a = score(truth, p, eps=eps, resamples=20).to_dict()
    b = score(truth2, Predictions.from_detections(detections2, order), eps=eps, resamples=20).to_dict()
    assert a == b
    # and the predictions may come in an order of their own
    back = random.sample(range(len(images)), len(images))
    c = Predictions.from_detections([detections[n] for n in back], back)
    assert score(truth, c, eps=eps, resamples=20).to_dict() == a


def test_the_order_of_many_images_changes_no_digit():
    rng = np.random.default_rng(5)
    images = [([(10, 10, rng.uniform(5, 50), 0)], [(10 + rng.normal(), 10, rng.random(), 0)]) for _ in range(500)]
    a, b = (run(*tables(order), eps=1) for order in (images, images[::-1]))
    assert [a[name] for name in METRICS] == [b[name] for name in METRICS]


@given(IMAGES, EPS, st.sampled_from([(64.0, 1.0), (-512.0, 1.0), (0.0, 4.0), (16.0, 0.5)]))
@settings(max_examples=60, deadline=None)
def test_translation_and_scale_change_nothing_but_pixels(images, eps, change):
    shift, scale = change
    moved = [
        (
            [((x + shift) * scale, (y + shift) * scale, r * scale, i) for x, y, r, i in t],
            [((x + shift) * scale, (y + shift) * scale, s, i) for x, y, s, i in d],
        )
        for t, d in images
    ]
    a, b = (run(*tables(case), eps=eps) for case in (images, moved))
    assert a.overall.counts == b.overall.counts
    for name in METRICS:
        if name.endswith("_px") and a[name] is not None:
            assert b[name] == pytest.approx(a[name] * scale)
        else:
            assert a[name] == pytest.approx(b[name])


@given(IMAGES, EPS)
@settings(max_examples=60, deadline=None)
def test_x_and_y_count_alike(images, eps):
    turned = [([(y, x, r, i) for x, y, r, i in t], [(y, x, s, i) for x, y, s, i in d]) for t, d in images]
    a, b = (run(*tables(case), eps=eps) for case in (images, turned))
    for name in ("detection_score", "average_false_alarm", "detection_score_literal", "error_rms_px"):
        assert a[name] == pytest.approx(b[name])


@given(IMAGES, EPS)
@settings(max_examples=60, deadline=None)
def test_a_far_detection_raises_only_false_alarms(images, eps):
    truth, detections = tables(images)
    a = run(truth, detections, eps=eps)
    far = Detections(
        *(
            np.concatenate(pair)
            for pair in ((detections[0].xy, [[1e5, -1e5]]), (detections[0].score, [9.0]), (detections[0].patch_id, [1]))
        )
    )
    b = run(truth, [far, *detections[1:]], eps=eps)
    assert b["average_false_alarm"] == pytest.approx(a["average_false_alarm"] + 1 / len(images))
    changed = {"detections", "clutter"}
    assert {k: v for k, v in a.overall.counts.items() if k not in changed} == {
        k: v for k, v in b.overall.counts.items() if k not in changed
    }
    for name in ("detection_score", "detection_score_literal", "id_matching_score", "recall", "error_p95_px"):
        assert a[name] == b[name]


@given(IMAGES)
@settings(max_examples=12, deadline=None)
def test_the_curve_over_eps_is_scoring_at_each(images):
    truth, detections = tables(images)
    curve = run(truth, detections).eps_curve
    for n, eps in enumerate(curve["eps"]):
        alone = run(truth, detections, eps=eps)
        assert curve["detection_score"][n] == alone["detection_score"]
        assert curve["average_false_alarm"][n] == alone["average_false_alarm"]


@given(IMAGES)
@settings(max_examples=30, deadline=None)
def test_a_wider_reach_never_matches_less(images):
    truth, detections = tables(images)
    scores = [run(truth, detections, eps=eps) for eps in (0.0, 0.3, 0.5, 1.0, 1.5, 4.0)]
    for name in ("matched", "matched_literal"):
        counts = [s.overall.counts[name] for s in scores]
        assert counts == sorted(counts)
    alarms = [s["average_false_alarm"] for s in scores]
    assert alarms == sorted(alarms, reverse=True)


@given(IMAGES)
def test_perfect_predictions_are_perfect(images):
    truth, _ = tables(images)
    keypoints = [t for t, _ in images]
    assume(sum(map(len, keypoints)))
    for t in keypoints:
        assume(len({k[:2] for k in t}) == len(t))
    scores = run(truth, [found(*((x, y, 1.0, i) for x, y, _, i in t)) for t in keypoints])
    for name in ("detection_score", "id_matching_score", "precision", "recall", "f1", "average_precision"):
        assert scores[name] == 1
    assert scores["average_false_alarm"] == scores["error_rms_px"] == scores["error_p95_radii"] == 0


# --- bugs that users of other evaluators met --------------------------------------------------------------------


def test_images_without_truth_count_their_false_alarms():
    scores = run(truth_of([[], [(10, 10, 10, 1)]]), [found((3, 3, 1, 0), (9, 3, 1, 0)), found((10, 10, 1, 1))])
    assert scores["average_false_alarm"] == 1
    assert scores["detection_score"] == 1
    assert run(truth_of([[]]), [found((3, 3, 1, 0))])["average_false_alarm"] == 1


def test_identity_zero_is_an_identity():
    scores = run(truth_of([[(10, 10, 10, 0)]]), [found((10, 10, 1, 0))])
    assert scores["id_matching_score"] == 1
    assert scores.confusion == {"ids": [0], "matrix": [[1, 0]]}
    wrong = run(truth_of([[(10, 10, 10, 0)]]), [found((10, 10, 1, 1))])
    assert wrong["id_matching_score"] == 0
    assert wrong.overall.counts["wrong_id"] == 1
    assert wrong.confusion == {"ids": [0], "matrix": [[0, 1]]}


@pytest.mark.parametrize("ids", [True, False])
def test_no_detections_is_a_result(ids):
    scores = run(truth_of([[(10, 10, 10, 0)], []]), [Detections.none(ids)] * 2)
    assert (
        scores["detection_score"] == scores["average_false_alarm"] == scores["f1"] == scores["average_precision"] == 0
    )
    for name in ("id_matching_score", "precision", "error_median_px"):
        assert scores[name] is None
    assert scores.overall.counts["missed"] == 1


def test_no_truth_at_all_leaves_ratios_undefined():
    scores = score(truth_of([[], []]), [found((1, 1, 1, 0)), found()])
    assert scores["average_false_alarm"] == 0.5
    assert scores["precision"] == 0
    for name in ("detection_score", "recall", "id_matching_score", "average_precision"):
        assert scores[name] is None
    assert scores.overall.intervals["detection_score"] is None
    assert json.dumps(scores.to_dict(), allow_nan=False)


def test_equal_scores_do_not_let_the_order_choose():
    truth = truth_of([[(10, 10, 50, 1)]])
    rows = [(12, 10, 0.5, 0), (11, 10, 0.5, 1), (10, 13, 0.5, 2)]
    for order in itertools.permutations(rows):
        scores = run(truth, [found(*order)])
        assert scores["error_median_px"] == 1
        assert scores["id_matching_score"] == 1


def test_equal_scores_and_distances_are_decided_by_place():
    rows = [(11, 10, 0.5, 1), (10, 11, 0.5, 0), (9, 10, 0.5, 2), (10, 9, 0.5, 3)]
    for order in itertools.permutations(rows):
        assert run(truth_of([[(10, 10, 50, 2)]]), [found(*order)])["id_matching_score"] == 1  # lowest x
    for order in itertools.permutations([(10, 11, 0.5, 1), (10, 9, 0.5, 2)]):
        assert run(truth_of([[(10, 10, 50, 2)]]), [found(*order)])["id_matching_score"] == 1  # lowest y
    # two keypoints, two detections, both assignments worth the same
    keypoints, pair = [(0, 0, 50, 0), (4, 0, 50, 1)], [(2, 1, 0.5, 0), (2, -1, 0.5, 1)]
    results = {
        run(truth_of([list(k)]), [found(*d)])["id_matching_score"]
        for k, d in itertools.product(itertools.permutations(keypoints), itertools.permutations(pair))
    }
    assert len(results) == 1


def test_where_keypoints_share_detections_the_surest_ones_are_matched():
    keypoints = [(0, 0, 40, 0), (6, 0, 40, 1)]
    rows = [(1, 0, 0.2, 0), (3, 0, 0.9, 0), (2, 0, 0.8, 0), (5, 0, 0.1, 1)]  # near but unsure, far but sure
    for order in itertools.permutations(rows):
        scores = run(truth_of([keypoints]), [found(*order)])
        assert scores["error_rms_px"] == pytest.approx(np.sqrt((2**2 + 3**2) / 2))
        assert scores.overall.counts["duplicate"] == 2


def test_a_detection_belongs_to_the_nearest_keypoint_not_the_first():
    # one detection between two keypoints, both in reach
    scores = run(truth_of([[(0, 0, 100, 0), (8, 0, 100, 1)]]), [found((5, 0, 1, 1))])
    assert scores["error_median_px"] == 3
    assert scores["id_matching_score"] == 1
    assert scores["id_matching_score_literal"] == 1


def test_greedy_would_lose_a_match():
    # the surest detection lies nearer to the keypoint that the other detection needs
    truth = truth_of([[(0, 0, 60, 0), (6, 0, 60, 1)]])
    scores = run(truth, [found((4, 0, 0.9, 0), (11, 0, 0.5, 1))])
    assert scores["detection_score"] == 1
    assert scores["id_matching_score"] == 1


def test_a_distance_equal_to_the_reach_is_a_match():
    truth = truth_of([[(10, 10, 10, 0)]])
    assert run(truth, [found((11, 10, 1, 0))])["detection_score"] == 1
    assert run(truth, [found((np.nextafter(11, 12), 10, 1, 0))])["detection_score"] == 0
    assert run(truth, [found((10, 20, 1, 0))]).overall.counts["near_miss"] == 1
    assert run(truth, [found((10, np.nextafter(20, 21), 1, 0))]).overall.counts["clutter"] == 1


def test_identity_never_decides_who_is_matched():
    # the surer of two duplicates wins although the other has the right identity
    scores = run(truth_of([[(10, 10, 50, 1)]]), [found((10, 10, 0.5, 1), (12, 10, 0.6, 0))])
    assert scores["id_matching_score"] == 0
    assert scores["error_median_px"] == 2
    assert scores.overall.counts["duplicate"] == 1
    assert scores["average_false_alarm"] == 1


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_a_detector_that_names_every_identity_at_one_place_gets_none(order):
    rows = [(10, 10, 0.5, 0), (10, 10, 0.5, 1), (10, 10, 0.5, 2)]
    scores = run(truth_of([[(10, 10, 50, 1)]]), [found(*(rows[k] for k in order))])
    assert scores["id_matching_score"] == 0
    assert scores.confusion["matrix"] == [[0, 1]]
    assert run(truth_of([[(10, 10, 50, 1)]]), [found(*[rows[1]] * 3)])["id_matching_score"] == 1


def test_inputs_are_left_as_they_were():
    truth, detections = truth_of([[(10, 10, 50, 1)]]), [found((10, 11, 0.5, 1), (12, 10, 0.6, 0))]
    keypoints, p = truth.keypoints.copy(), Predictions.from_detections(detections)
    for array in (truth.keypoints, p.xy, p.score, p.patch_id):
        array.setflags(write=False)
    first = score(truth, p).to_dict()
    assert score(truth, p).to_dict() == first
    assert (truth.keypoints == keypoints).all()


# --- definitions ------------------------------------------------------------------------------------------------


def test_golden():
    truth = truth_of([[(10, 10, 10, 0), (50, 10, 10, 1), (10, 50, 10, 2)], []])
    detections = [
        found(
            (10.3, 10.4, 0.9, 0),  # matched, 0.5 px
            (10.0, 10.6, 0.8, 3),  # duplicate
            (50.0, 9.0, 0.7, 2),  # matched at 1 px, wrong identity
            (13.0, 50.0, 0.6, 2),  # near miss
        ),
        found((300, 300, 0.95, 0)),  # clutter where nothing is
    ]
    scores = run(truth, detections)
    expected = {
        "detection_score": 2 / 3,
        "id_matching_score": 1 / 2,
        "average_false_alarm": 3 / 2,
        "detection_score_literal": 1,
        "id_matching_score_literal": 1 / 3,
        "average_false_alarm_literal": 1,
        "precision": 2 / 5,
        "recall": 2 / 3,
        "f1": 1 / 2,
        "average_precision": (1 / 2 + 2 / 4) / 3,
        "error_median_px": 0.75,
        "error_p95_px": 0.975,
        "error_rms_px": np.sqrt(1.25 / 2),
        "error_median_radii": 0.075,
        "error_p95_radii": 0.0975,
        "error_rms_radii": np.sqrt(1.25 / 2) / 10,
        **dict.fromkeys(METRICS[METRICS.index("bias_px") :]),  # there is neither homography nor covariance
    }
    assert tuple(expected) == METRICS
    for name, value in expected.items():
        assert scores[name] == pytest.approx(value, abs=1e-12), name
    assert scores.overall.counts == {
        "images": 2, "scenes": 2, "truths": 3, "detections": 5, "matched": 2, "id_correct": 1, "wrong_id": 1,
        "missed": 1, "duplicate": 1, "near_miss": 1, "clutter": 1, "matched_literal": 3, "id_correct_literal": 1,
    }  # fmt: skip
    assert scores.confusion == {"ids": [0, 1, 2], "matrix": [[1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]]}


@pytest.mark.parametrize(("kind", "reach"), [("major", 10), ("minor", 5), ("mean", 7.5)])
def test_the_radius_is_the_one_asked_for(kind, reach):
    truth = truth_of([[(0, 0, 10, 0)]])  # minor is half of major
    assert run(truth, [found((reach / 2, 0, 1, 0))], eps=0.5, eps_radius=kind)["detection_score"] == 1
    assert run(truth, [found((reach / 2 + 0.01, 0, 1, 0))], eps=0.5, eps_radius=kind)["detection_score"] == 0
    assert run(truth, [found((1, 0, 1, 0))], eps=0.5, eps_radius=kind)["error_rms_radii"] == pytest.approx(1 / reach)


def test_the_reach_is_that_of_each_keypoint():
    truth = truth_of([[(0, 0, 10, 0), (100, 0, 40, 0)]])
    assert run(truth, [found((2, 0, 1, 0), (102, 0, 1, 0))])["detection_score"] == 0.5


def test_without_identities_the_scores_of_identity_are_undefined():
    scores = run(truth_of([[(0, 0, 10, 0), (50, 0, 10, 1)]]), [found((0, 0, 1, 0), ids=False)])
    assert scores["detection_score"] == 0.5
    assert scores["id_matching_score"] is scores["id_matching_score_literal"] is None
    assert scores.overall.counts["id_correct"] is scores.overall.counts["wrong_id"] is None
    assert scores.confusion == {}


def test_groups_by_condition_rung_and_patch():
    images = [[(10, 10, 10, p)] for p in (0, 1, 0, 1, 0, 1)]
    truth = truth_of(images, ["blur"] * 4 + ["scale"] * 2, [3, 3, 15, 15, 0.5, 0.5], [0, 1, 0, 1, 0, 1])
    seen, far = (10, 10, 1, 0), (90, 90, 1, 0)
    scores = run(truth, [found(seen), found(seen), found(), found(far, far), found(seen, far), found()])
    groups = {(g.condition, g.rung, g.patch_id): g for g in scores.by}
    assert list(groups) == [
        ("blur", 3, None), ("blur", 15, None), ("scale", 0.5, None),
        ("blur", 3, 0), ("blur", 3, 1), ("blur", 15, 0), ("blur", 15, 1), ("scale", 0.5, 0), ("scale", 0.5, 1),
        (None, None, 0), (None, None, 1),
    ]  # fmt: skip
    assert groups["blur", 3, None].metrics["detection_score"] == 1
    assert groups["blur", 3, None].metrics["id_matching_score"] == 0.5
    assert groups["blur", 15, None].metrics["average_false_alarm"] == 1
    assert groups["blur", 15, 0].metrics["average_false_alarm"] == 0
    assert groups["blur", 15, 1].metrics["average_false_alarm"] == 2
    assert groups["blur", 15, 1].metrics["id_matching_score"] is None
    assert groups["scale", 0.5, 0].metrics["precision"] == 0.5
    assert groups[None, None, 0].metrics["detection_score"] == pytest.approx(2 / 3)
    assert groups[None, None, 1].counts["images"] == 3
    assert scores.overall.counts["scenes"] == 2
    assert groups["blur", 3, None].counts["scenes"] == 2
    # Each level is a division: its groups add up to the whole
    for key in ("truths", "detections", "matched", "clutter", "images"):
        assert sum(g.counts[key] for k, g in groups.items() if k[2] is None) == scores.overall.counts[key]
        assert sum(g.counts[key] for k, g in groups.items() if k[0] is None) == scores.overall.counts[key]


def test_false_alarms_belong_to_a_patch_only_where_images_show_one_kind():
    truth = truth_of([[(10, 10, 10, 0), (50, 50, 10, 1)], [(10, 10, 10, 0)], [(10, 10, 10, 2)]])
    seen = (10, 10, 1, 0)
    scores = run(truth, [found(seen), found(seen, (99, 99, 1, 0)), found(seen)])
    zero, one, two = scores.by
    assert (zero.patch_id, one.patch_id, two.patch_id) == (0, 1, 2)
    for mixed in (zero, one):
        for name in ("average_false_alarm", "precision", "f1", "average_precision", "average_false_alarm_literal"):
            assert mixed.metrics[name] is None
        assert mixed.counts["detections"] is mixed.counts["clutter"] is None
    assert zero.metrics["detection_score"] == 1
    assert one.metrics["detection_score"] == 0
    assert two.metrics["average_false_alarm"] == 0
    assert two.metrics["precision"] == 1


@given(IMAGES, EPS)
@settings(max_examples=60, deadline=None)
def test_a_group_is_what_scoring_its_images_alone_gives(images, eps):
    names = ["a", "b", "b", "c"][: len(images)]
    detections = tables(images)[1]
    parted = truth_of([t for t, _ in images], names, [1.0] * len(images))
    for group in score(parted, detections, eps=eps, resamples=30).by:
        if group.patch_id is None:
            some = [n for n, name in enumerate(names) if name == group.condition]
            alone = score(*tables([images[n] for n in some]), eps=eps, resamples=30).overall
            assert group.to_dict() == alone.to_dict()


# --- intervals --------------------------------------------------------------------------------------------------


def random_case(rng, n, per_scene=1):
    images = [[(10, 10, 10, 0), (50, 50, 10, 1)] for _ in range(n)]
    quality = rng.random(n // per_scene).repeat(per_scene)
    detections = [
        found(*[(x, y, 1, 0) for x, y, _, _ in t if rng.random() < q], *[(90, 90, 1, 0)] * rng.poisson(1 - q))
        for t, q in zip(images, quality, strict=True)
    ]
    return truth_of(images, scene=np.arange(n) // per_scene), detections


def test_the_intervals_are_those_of_a_plain_bootstrap_over_scenes():
    rng = np.random.default_rng(1)
    truth, detections = random_case(rng, 120, per_scene=4)
    fast = score(truth, detections, resamples=4000).overall.intervals
    single = [run(truth_of([[(10, 10, 10, 0), (50, 50, 10, 1)]]), [d]).overall.counts for d in detections]
    sums = np.array([[c["matched"], c["truths"], c["detections"]] for c in single]).reshape(30, 4, 3).sum(axis=1)
    draws = sums[rng.integers(0, 30, (4000, 30))].sum(axis=1)
    half = stats.t.ppf(0.975, 29) * np.sqrt(30 / 29) * np.array([-1, 1])  # 2.08, not 1.96: thirty scenes are few
    metrics = {
        "detection_score": lambda s: s[..., 0] / s[..., 1],
        "precision": lambda s: s[..., 0] / s[..., 2],
        "average_false_alarm": lambda s: (s[..., 2] - s[..., 0]) / (s[..., 1] / 2),
    }
    for name, metric in metrics.items():  # BC_a, the skewness from leaving out one scene after the other
        values = metric(draws)
        found_all = metric(sums.sum(axis=0))
        bias = stats.norm.ppf(np.mean(values < found_all) + np.mean(values == found_all) / 2)
        without = np.array([metric(np.delete(sums, n, axis=0).sum(axis=0)) for n in range(30)])
        change = without.mean() - without
        skew = (change**3).sum() / (6 * (change**2).sum() ** 1.5)
        low, high = np.quantile(values, stats.norm.cdf(bias + (bias + half) / (1 - skew * (bias + half))))
        assert fast[name] == pytest.approx((low, high), abs=0.06 * (high - low))


def test_copies_of_an_image_in_its_scene_add_no_certainty():
    truth, detections = random_case(np.random.default_rng(2), 50)
    once = score(truth, detections).overall.intervals
    images = [[(10, 10, 10, 0), (50, 50, 10, 1)]] * 200
    again = score(truth_of(images, scene=np.arange(200) // 4), [d for d in detections for _ in range(4)]).overall
    assert again.counts["scenes"] == 50
    assert again.intervals == once
    apart = score(truth_of(images), [d for d in detections for _ in range(4)]).overall.intervals
    width = {k: np.subtract(*v[::-1]) for k, v in (("once", once["recall"]), ("apart", apart["recall"]))}
    assert width["apart"] < 0.65 * width["once"]


def test_many_different_scenes_are_pooled_without_changing_the_width(monkeypatch):
    truth, detections = random_case(np.random.default_rng(3), 400)
    exact = score(truth, detections, resamples=2000).overall.intervals
    monkeypatch.setattr(bootstrap, "MOST_KINDS", 5)
    assert len(bootstrap._unique_rows(np.array([[0, 1], [2, 3], [0, 1]]))[0]) == 2
    monkeypatch.setattr(bootstrap, "MOST_KINDS", 100)
    monkeypatch.setattr(bootstrap, "_unique_rows", lambda table: (table[np.lexsort(table.T)], np.ones(len(table), int)))
    pooled = score(truth, detections, resamples=2000).overall.intervals
    for name in ("detection_score", "average_false_alarm", "f1"):
        a, b = exact[name], pooled[name]
        assert b[1] - b[0] == pytest.approx(a[1] - a[0], rel=0.25)
        assert sum(b) / 2 == pytest.approx(sum(a) / 2, abs=0.1 * (a[1] - a[0]))


def test_rows_with_counts_too_large_for_one_number_are_told_apart_too():
    table = np.array([[2**31, 2**31, 1], [5, 0, 1], [2**31, 2**31, 1]])
    kinds, many = bootstrap._unique_rows(table)
    assert sorted(zip(kinds.tolist(), many.tolist(), strict=True)) == [([5, 0, 1], 1), ([2**31, 2**31, 1], 2)]


def test_one_scene_has_no_interval():
    scores = score(truth_of([[(10, 10, 10, 0)]] * 3, scene=[7, 7, 7]), [found()] * 3)
    assert set(scores.overall.intervals.values()) == {None}


# --- refusals ---------------------------------------------------------------------------------------------------


def test_predictions_must_be_for_the_images():
    truth = truth_of([[(10, 10, 10, 0)]] * 3, image_id=[5, 3, 9])
    whole = Predictions.from_detections([found()] * 3, [9, 3, 5])
    assert score(truth, whole)["detection_score"] == 0
    with pytest.raises(PredictionsError, match=r"image_id 4 is not in the dataset \(3 images, image_id 3 to 9\)"):
        score(truth, Predictions.from_detections([found()] * 4, [3, 4, 5, 9]))
    part = Predictions.from_detections([found((10, 10, 1, 0))], [9])
    with pytest.raises(PredictionsError, match="no prediction for image_id 3; 2 of 3 images are missing"):
        score(truth, part)
    allowed = score(truth, part, allow_missing=True)
    assert allowed["detection_score"] == pytest.approx(1 / 3)
    assert allowed.overall.counts["images"] == 3
    with pytest.raises(PredictionsError, match="detections of 2 images, expected detections of 3 images"):
        score(truth, [found()] * 2)


def test_another_datasets_fingerprint_is_refused():
    truth = Truth(**{**vars(truth_of([[]])), "fingerprint": "a" * 64})
    assert score(truth, Predictions.from_detections([found()], dataset="a" * 64)).fingerprint == "a" * 64
    for about in ({"dataset": "b" * 64}, {"dataset": "folder", "fingerprint": "b" * 64}):
        with pytest.raises(PredictionsError, match="fingerprint bbbbbbbbbbbb…, but this dataset's is aaaaaaaaaaaa…"):
            score(truth, Predictions.from_detections([found()], **about))


def test_truth_that_cannot_be_scored():
    with pytest.raises(DataError, match=r"image_id 0: a true keypoint at \[1.0, 2.0\] has radius 0.0"):
        score(truth_of([[(1, 2, 0, 0)]]), [found()])
    with pytest.raises(DataError, match="finite"):
        score(truth_of([[(np.nan, 2, 1, 0)]]), [found()])
    with pytest.raises(DataError, match="image_id 4 twice"):
        score(truth_of([[], []], image_id=[4, 4]), Predictions.from_detections([found()], [4]))
    with pytest.raises(DataError, match="no images"):
        score(truth_of([]), Predictions.from_detections([]))


def test_detections_with_nan_are_refused():
    with pytest.raises(PredictionsError, match=r"image_id 1\): keypoints\[1\] is \[nan, 1.0\], expected two finite"):
        score(truth_of([[], []]), [found(), found((1, 1, 1, 0), (np.nan, 1, 1, 0))])


@pytest.mark.parametrize(
    "bad", [{"eps": -1}, {"eps": float("nan")}, {"eps_radius": "x"}, {"matching": "greedy"}, {"resamples": -1}]
)
def test_settings_out_of_range(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        Settings(**bad)


def test_huge_coordinates_are_only_far_away():
    truth = truth_of([[(10, 10, 10, 0)]])
    scores = run(truth, [found((1e308, -1e308, 1, 0), (10, 1e308, 1, 0), (10, 10, 1, 0))])
    assert scores["detection_score"] == 1
    assert scores.overall.counts["clutter"] == 2


def test_blocks_of_pairs_give_what_one_block_gives(monkeypatch):
    rng = np.random.default_rng(0)
    case = [
        (
            [(*rng.uniform(0, 30, 2), 20, 0) for _ in range(5)],
            [(*rng.uniform(0, 30, 2), rng.random(), 0) for _ in range(9)],
        )
        for _ in range(20)
    ]
    whole = match_of(case, 0.5)
    monkeypatch.setattr(assignment, "PAIRS_PER_BLOCK", 7)
    blocks = match_of(case, 0.5)
    for name in vars(whole):
        np.testing.assert_array_equal(getattr(whole, name), getattr(blocks, name))


# --- gates, tables, names ---------------------------------------------------------------------------------------


def test_gates_name_all_that_failed():
    scores = run(truth_of([[(10, 10, 10, 0), (50, 50, 10, 0)]]), [found((10, 10, 1, 0), (90, 90, 1, 0), ids=False)])
    check_gates(scores, {"detection_score": 0.5}, {"average_false_alarm": 1})  # equal is enough
    with pytest.raises(GateFailed) as error:
        check_gates(scores, {"recall": 0.51, "precision": 0.5, "id_matching_score": 0}, {"average_false_alarm": 0.9})
    assert str(error.value) == (
        "recall is 0.5, expected at least 0.51; id_matching_score is undefined, expected at least 0; "
        "average_false_alarm is 1, expected at most 0.9"
    )


def test_the_flat_table_and_the_file_hold_the_same_numbers():
    truth, detections = random_case(np.random.default_rng(4), 20)
    scores = score(truth, detections)
    rows, content = scores.rows(), scores.to_dict()
    assert len(rows) == 1 + len(content["by"]) == 3
    for row, metrics in zip(rows, [content["metrics"], *(g["metrics"] for g in content["by"])], strict=True):
        assert {name: row[name] for name in METRICS} == {name: metrics[name] for name in METRICS}
        assert row["missed"] == metrics["counts"]["missed"]
        low, high = metrics["intervals"]["recall"]
        assert (row["recall_low"], row["recall_high"]) == (low, high)
    assert [row["patch_id"] for row in rows] == [None, 0, 1]


def test_the_evaluator_needs_neither_generator_nor_files():
    code = "import sys, kpbench.scoring.scores; print(*sorted(m for m in sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    heavy = {"h5py", "torch", "onnxruntime", "cv2", "pandas", "pyarrow"}
    assert not heavy & set(loaded)
    assert {name.split(".")[1] for name in loaded if name.startswith("kpbench.")} <= {
        "errors", "types", "validity", "scoring", "geometry",
    }  # fmt: skip


def test_images_without_a_condition_beside_others_are_no_group():
    truth = truth_of([[(10, 10, 10, 0)]] * 4, ["blur", "blur", "", ""], [3, 3, np.nan, np.nan])
    scores = run(truth, [found((10, 10, 1, 0))] * 2 + [found()] * 2)
    assert scores.overall.metrics["detection_score"] == 0.5
    assert [(g.condition, g.rung, g.patch_id) for g in scores.by] == [("blur", 3, None)]
