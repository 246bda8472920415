import numpy as np
import pytest

from kpbench.scoring.scores import score
from kpbench.types import KEYPOINT_DTYPE, Detections, Truth


def truth_of(tilts, visible=1.0, contrast=100.0, scenes=10):
    """One keypoint of each tilt per image, 100 px apart."""
    keypoints = np.zeros(len(tilts) * scenes, KEYPOINT_DTYPE)
    keypoints["x"], keypoints["y"] = np.tile(np.arange(len(tilts)) * 100.0, scenes), 50
    keypoints["radius_major"] = 20
    keypoints["radius_minor"] = 20 * np.cos(np.radians(np.tile(tilts, scenes)))
    keypoints["visible"], keypoints["contrast"] = visible, contrast
    n = np.arange(scenes)
    return Truth(
        image_id=n,
        offsets=np.arange(scenes + 1) * len(tilts),
        keypoints=keypoints,
        condition=np.array([""] * scenes),
        rung=np.full(scenes, np.nan),
        scene_id=n,
    )


def test_a_slice_counts_the_keypoints_in_its_bin():
    truth = truth_of([5, 40, 70])
    found = [[[0, 50], [100.5, 50]]] * 5 + [[[0, 50]]] * 5  # of 70 degrees none, of 40 degrees every other one
    slices = score(truth, [Detections(xy, np.ones(len(xy))) for xy in found], resamples=400).slices
    assert [(s["range"], s["truths"], s["matched"]) for s in slices] == [
        ([0, 15], 10, 10),
        ([30, 45], 10, 5),
        ([60, 75], 10, 0),
    ]
    assert [s["detection_score"] for s in slices] == [1, 0.5, 0]
    assert [s["error_median_px"] for s in slices] == [0, pytest.approx(0.5), None]
    low, high = slices[1]["interval"]
    assert 0.1 <= low < 0.5 < high <= 0.9


def test_a_quantity_without_a_spread_is_left_out_and_a_whole_patch_has_a_bin_of_its_own():
    visible = np.tile([1.0, 0.999, 0.55], 10)
    slices = score(truth_of([0, 0, 0], visible), [Detections.none()] * 10, resamples=0).slices
    assert [(s["quantity"], s["range"]) for s in slices] == [
        ("visible", [0.5, 0.6]), ("visible", [0.9, 1]), ("visible", [1, 1]),
    ]  # fmt: skip
    unknown = truth_of([0, 0, 0], contrast=np.nan)
    assert score(unknown, [Detections.none()] * 10, resamples=0).slices == []
