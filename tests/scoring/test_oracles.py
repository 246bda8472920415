"""The evaluator against independent ones: brute force, pycocotools, mir_eval, each where definitions coincide."""

import contextlib
import io
import itertools

import numpy as np
import pytest

from kpbench.scoring.assignment import DetectionPoints, TruthPoints, match
from kpbench.scoring.scores import score
from kpbench.types import KEYPOINT_DTYPE, Predictions, Truth

CASES = 1000
RADII, LEVELS = np.array([0.0, 0.5, 1.0, 2.0]), np.array([0.0, 0.25, 0.5, 1e300])


def adversarial(rng):
    """One image: few places on a grid, so that overlaps, equal distances, ties and distances equal to ε abound."""
    kind = rng.integers(0, 6)
    t, d = rng.integers(0, 4), rng.integers(0, 5)
    truth, found = rng.integers(0, 7, (t, 2)) / 2, rng.integers(0, 7, (d, 2)) / 2
    if kind == 1 and t:
        found = truth[rng.integers(0, t, d)]  # all on top of true keypoints
    elif kind == 2 and t:
        found = truth[rng.integers(0, t, d)] + np.array([1.0, 0.0])  # all at the same distance
    elif kind == 3:
        found = found * 1e307  # huge
    elif kind == 4:
        truth, found = np.zeros((t, 2)), np.zeros((d, 2))  # everything at one place
    elif kind == 5 and t:
        found = np.nextafter(truth[rng.integers(0, t, d)] + 2.0, rng.choice([-1e9, 1e9], (d, 2)))  # a bit beside ε
    return truth, rng.choice(RADII[1:], t), found, rng.choice(LEVELS, d)


def best_by_brute_force(truth, reach, found, score):
    """Worth of the best of all one-to-one assignments: most matches, then highest scores, then least distance."""
    with np.errstate(over="ignore"):
        distance = np.hypot(*(truth[:, None] - found[None]).transpose(2, 0, 1)) if len(truth) else np.zeros((0, 0))
    best = (0, [], 0.0)
    slots = [*range(len(found)), *[-1] * len(truth)]
    for chosen in set(itertools.permutations(slots, len(truth))):
        pairs = [(t, d) for t, d in enumerate(chosen) if d >= 0]
        if all(distance[pair] <= reach[pair[0]] for pair in pairs):
            total = round(sum(float(distance[pair]) for pair in pairs), 9)
            best = max(best, (len(pairs), sorted((float(score[d]) for _, d in pairs), reverse=True), -total))
    return best


def test_a_thousand_cases_against_brute_force():
    rng = np.random.default_rng(2026)
    cases = [adversarial(rng) for _ in range(CASES)]
    columns = list(zip(*cases, strict=True))
    truth_image = np.repeat(np.arange(CASES), [len(c) for c in columns[0]])
    image = np.repeat(np.arange(CASES), [len(c) for c in columns[2]])
    truth, radius, found, score = (np.concatenate(column) for column in columns)
    m = match(TruthPoints(truth, radius, truth_image), DetectionPoints(found, score, image), 1.0)
    assert np.count_nonzero(m.detection >= 0) > 400
    for k, (xy, reach, detections, levels) in enumerate(cases):
        rows = np.flatnonzero(truth_image == k)
        won = rows[m.detection[rows] >= 0]
        chosen = m.detection[won]
        assert len(set(chosen)) == len(chosen)
        assert (image[chosen] == k).all()
        scores = sorted(score[chosen].tolist(), reverse=True)
        worth = (len(won), scores, -round(float(m.distance[won].sum()), 9))
        assert worth == best_by_brute_force(xy, reach, detections, levels), k


def spread(rng, images):
    """Truth more than 2 ε apart, as printed patches are, and detections about it; no distance equal to ε."""
    truth, found = [], []
    for k in range(images):
        cells = rng.permutation(36)[: rng.integers(0, 7)]
        for cell in cells:
            x, y, radius = 40 + 80 * (cell % 6), 40 + 80 * (cell // 6), rng.uniform(8, 35)
            truth.append((k, x, y, radius, rng.integers(0, 4)))
            for _ in range(rng.integers(0, 4)):
                away = radius * 0.1 * rng.choice([0.2, 0.7, 0.99, 1.01, 3.0]) * rng.uniform(0.9, 1)
                angle = rng.uniform(0, 2 * np.pi)
                place = (x + away * np.cos(angle), y + away * np.sin(angle))
                found.append((k, *place, rng.random(), rng.integers(0, 4)))
        found += [(k, *rng.uniform(0, 480, 2), rng.random(), rng.integers(0, 4)) for _ in range(rng.integers(0, 3))]
    return np.array(truth), np.array(found)


def tables(truth, found, images):
    keypoints = np.zeros(len(truth), KEYPOINT_DTYPE)
    keypoints["x"], keypoints["y"], keypoints["patch_id"] = truth[:, 1], truth[:, 2], truth[:, 4]
    keypoints["radius_major"] = keypoints["radius_minor"] = truth[:, 3]
    offsets = np.searchsorted(truth[:, 0], np.arange(images + 1))
    ids = np.arange(images)
    of = Truth(ids, offsets, keypoints, np.array([""] * images), np.full(images, np.nan), ids)
    places = np.searchsorted(found[:, 0], np.arange(images + 1))
    return of, Predictions(ids, places, found[:, 1:3], found[:, 3], found[:, 4].astype(int))


def test_pycocotools_counts_the_same_where_patches_do_not_overlap():
    """OKS at 0.5 with one keypoint is distance <= ε radius when area = radius² and sigma = ε / (2 sqrt(2 ln 2))."""
    coco_module, eval_module = pytest.importorskip("pycocotools.coco"), pytest.importorskip("pycocotools.cocoeval")
    images = 200
    truth, found = spread(np.random.default_rng(7), images)
    scores = score(*tables(truth, found, images), resamples=0)
    radius32 = truth[:, 3].astype(np.float32).astype(float)  # as the table of truth holds it
    coco = coco_module.COCO()
    coco.dataset = {
        "images": [{"id": k} for k in range(images)],
        "categories": [{"id": 1}],
        "annotations": [
            {"id": n + 1, "image_id": int(k), "category_id": 1, "keypoints": [x, y, 2], "num_keypoints": 1,
             "area": r * r, "bbox": [x - r, y - r, 2 * r, 2 * r], "iscrowd": 0}
            for n, ((k, x, y, _, _), r) in enumerate(zip(truth.tolist(), radius32.tolist(), strict=True))
        ],
    }  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()):
        coco.createIndex()
        results = coco.loadRes(
            [
                {"image_id": int(k), "category_id": 1, "keypoints": [x, y, 2], "score": s}
                for k, x, y, s, _ in found.tolist()
            ]
        )
        judge = eval_module.COCOeval(coco, results, "keypoints")
        judge.params.kpt_oks_sigmas = np.array([0.1 / (2 * np.sqrt(2 * np.log(2)))])
        judge.params.iouThrs = np.array([0.5])
        judge.params.areaRng, judge.params.areaRngLbl, judge.params.maxDets = [[0, 1e10]], ["all"], [1000]
        judge.evaluate()
        judge.accumulate()
    parts = [part for part in judge.evalImgs if part is not None]
    matched = sum(int((part["dtMatches"] > 0).sum()) for part in parts)
    detections = sum(part["dtMatches"].size for part in parts)
    n = scores.overall.counts
    assert (matched, detections, sum(len(part["gtIds"]) for part in parts)) == (
        n["matched"],
        n["detections"],
        n["truths"],
    )
    assert n["matched"] > 300
    assert n["duplicate"] > 100
    assert judge.eval["recall"].item() == scores["recall"]
    # COCO samples an interpolated curve at 101 recalls, so its area is a little larger
    assert 0 <= judge.eval["precision"].mean() - scores["average_precision"] < 0.02


def test_mir_eval_matches_as_many_on_a_line_however_crowded():
    """``mir_eval.util.match_events`` is a maximum bipartite matching of times within a window: of places on a line."""
    match_events = pytest.importorskip("mir_eval.util").match_events
    rng = np.random.default_rng(3)
    sizes = rng.integers(0, 9, (2, CASES))
    truth, found = (rng.integers(0, 60, n.sum()) / 4 for n in sizes)
    truth_image, image = (np.repeat(np.arange(CASES), n) for n in sizes)
    on_line = (np.column_stack([np.zeros(len(places)), places]) for places in (truth, found))
    truth_xy, xy = on_line
    truth_points = TruthPoints(truth_xy, np.full(len(truth), 5.0), truth_image)
    m = match(truth_points, DetectionPoints(xy, rng.random(len(found)), image), 0.2)
    ours = np.bincount(truth_image[m.detection >= 0], minlength=CASES)
    theirs = [len(match_events(truth[truth_image == k], found[image == k], 1.0)) for k in range(CASES)]
    assert ours.tolist() == theirs
    assert sum(theirs) > 1000
