"""Bias, scatter and NEES against slow computations and against draws whose bias and covariance are known."""

import numpy as np
import pytest
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from kpbench.scoring.metrics import METRICS
from kpbench.scoring.scores import score
from kpbench.types import KEYPOINT_DTYPE, Detections, Predictions, Truth

NEW = METRICS[METRICS.index("bias_px") :]


def poses(n, rng, tilt=(10, 60)):
    """Homographies of discs of radius 20 to 40 px before a camera of 800 px focal length, at any place and turn."""
    H = np.zeros((n, 3, 3))
    for k in range(n):
        turn = Rotation.from_euler("zxz", [rng.uniform(0, 360), rng.uniform(*tilt), rng.uniform(0, 360)], degrees=True)
        away = 800 / rng.uniform(20, 40)
        move = np.array([*rng.uniform(-0.35, 0.35, 2), 1]) * away
        H[k] = np.diag([800, 800, 1]) @ np.stack([*turn.as_matrix().T[:2], move], axis=1)
    return H


def truth_of(H, per_image=2, patches=1):
    """Truth of discs at such homographies."""
    keypoints = np.zeros(len(H), KEYPOINT_DTYPE)
    keypoints["H_patch2image"] = H
    keypoints["x"], keypoints["y"] = (H[:, :2, 2] / H[:, 2:, 2]).T
    keypoints["radius_major"] = keypoints["radius_minor"] = 30
    keypoints["patch_id"] = np.arange(len(H)) % patches
    n = len(H) // per_image
    rung = np.full(n, np.nan)
    return Truth(np.arange(n), np.arange(n + 1) * per_image, keypoints, np.array([""] * n), rung, np.arange(n) // 2)


def predictions_of(truth, error, covariance=None):
    xy = np.stack([truth.keypoints["x"], truth.keypoints["y"]], axis=1) + error
    ids = truth.keypoints["patch_id"]
    return Predictions(truth.image_id, truth.offsets, xy, np.ones(len(xy)), ids, covariance=covariance)


def jacobian(H, step=1e-5):
    """Derivative of the image of the patch's centre, by differences."""

    def place(u, v):
        x, y, w = H @ [u, v, 1]
        return np.array([x, y]) / w

    return np.stack([place(step, 0) - place(-step, 0), place(0, step) - place(0, -step)], axis=1) / (2 * step)


def run(truth, predictions, resamples=0):
    return score(truth, predictions, eps=1, resamples=resamples)


@pytest.mark.parametrize("mirrored", [False, True])
def test_bias_is_the_mean_error_in_the_frame_of_the_patch(mirrored):
    rng = np.random.default_rng(0)
    H = poses(40, rng)
    if mirrored:
        H = H @ np.diag([1, -1, 1])
    truth, error = truth_of(H), rng.normal(0, 0.3, (40, 2))
    scores = run(truth, predictions_of(truth, error))
    in_patch = np.array([polar(jacobian(h))[0].T @ e for h, e in zip(H, error, strict=True)])
    mean = in_patch.mean(axis=0)
    found = [scores[name] for name in ("bias_u_px", "bias_v_px", "bias_px")]
    assert found == pytest.approx([*mean, np.hypot(*mean)], abs=1e-7)
    assert scores["scatter_px"] == pytest.approx(np.sqrt(((in_patch - mean) ** 2).sum(axis=1).mean()), abs=1e-7)
    assert scores["error_rms_px"] ** 2 == pytest.approx(scores["bias_px"] ** 2 + scores["scatter_px"] ** 2)


def test_each_design_has_its_own_bias():
    rng = np.random.default_rng(1)
    H = poses(80, rng)
    truth = truth_of(H, patches=2)
    own = np.array([[0.2, 0], [-0.2, 0]])[np.arange(80) % 2]
    error = np.array([polar(jacobian(h))[0] @ b for h, b in zip(H, own, strict=True)])
    scores = run(truth, predictions_of(truth, error))
    assert scores["bias_px"] == pytest.approx(0, abs=1e-6)
    for n, bias in enumerate((0.2, -0.2)):
        metrics = scores.group(None, None, n).metrics
        assert (metrics["bias_u_px"], metrics["scatter_px"]) == pytest.approx((bias, 0), abs=1e-6)


def test_bias_along_the_tilt_is_towards_the_far_side():
    rng = np.random.default_rng(2)
    H = poses(40, rng)
    angle = np.linspace(0, 2 * np.pi, 3601)
    rim = np.stack([np.cos(angle), np.sin(angle), np.ones(3601)])
    far = rim[:2, [np.argmax((h @ rim)[2]) for h in H]].T  # the point of each rim with the largest depth
    away = np.array([jacobian(h) @ u for h, u in zip(H, far, strict=True)])
    away /= np.linalg.norm(away, axis=1)[:, None]
    across = np.stack([-away[:, 1], away[:, 0]], axis=1)
    truth = truth_of(H)
    scores = run(truth, predictions_of(truth, 0.25 * away + rng.normal(0, 1, (40, 1)) * across))
    assert scores["bias_tilt_px"] == pytest.approx(0.25, abs=2e-3)
    flat = poses(4, rng, tilt=(0, 0))
    scores = run(truth_of(flat), predictions_of(truth_of(flat), np.full((4, 2), 0.1)))
    assert scores["bias_tilt_px"] is None
    assert scores["bias_px"] is not None


def draws(n=6000, seed=3, factor=1.0):
    rng = np.random.default_rng(seed)
    truth = truth_of(np.tile(poses(20, rng), (n // 20, 1, 1)))
    root = rng.normal(0, 1, (n, 2, 2)) * rng.uniform(0.02, 0.5, (n, 1, 1)) + 0.02 * np.eye(2)
    error = np.einsum("nij,nj->ni", root, rng.normal(size=(n, 2)))
    return truth, predictions_of(truth, error, factor * root @ root.transpose(0, 2, 1))


def test_right_covariances_have_a_nees_of_2_in_all_quintiles():
    truth, predictions = draws()
    scores = run(truth, predictions, resamples=400)
    matched = scores.outcomes.matched
    error = predictions.xy - np.stack([truth.keypoints["x"], truth.keypoints["y"]], axis=1)
    each = np.einsum("ni,nij,nj->n", error, np.linalg.inv(predictions.covariance), error)
    assert scores["nees"] == pytest.approx(each[matched].mean())
    sigma = np.sqrt(np.trace(predictions.covariance, axis1=1, axis2=2) / 2)
    assert scores["sigma_median_px"] == pytest.approx(np.median(sigma[matched]))
    low, high = scores.overall.intervals["nees"]
    assert 1.8 < low < scores["nees"] < high < 2.2
    assert high - low == pytest.approx(4 * 2 / np.sqrt(len(each)), rel=0.3)
    assert len(scores.nees_by_sigma) == 5
    for part in scores.nees_by_sigma:
        inside = matched & (sigma >= part["sigma_px"][0] - 1e-9) & (sigma <= part["sigma_px"][1] + 1e-9)
        assert part["nees"] == pytest.approx(each[inside].mean())
        assert 1.7 < part["interval"][0] < part["nees"] < part["interval"][1] < 2.3
    assert sum(part["matched"] for part in scores.nees_by_sigma) == matched.sum()
    timid = run(*draws(factor=4.0))
    assert timid["nees"] == pytest.approx(scores["nees"] / 4)


def test_the_order_of_images_and_detections_changes_no_digit():
    truth, predictions = draws(200)
    rng = np.random.default_rng(7)
    images = rng.permutation(100)
    rows = np.concatenate([2 * n + rng.permutation(2) for n in images])
    keypoints = truth.keypoints[rows]
    turned = Truth(images, truth.offsets, keypoints, truth.condition, truth.rung, truth.scene_id[images])
    p = predictions
    moved = Predictions(images, p.offsets, p.xy[rows], p.score[rows], p.patch_id[rows], covariance=p.covariance[rows])
    a, b = run(truth, p, 50).to_dict(), run(turned, moved, 50).to_dict()
    assert a == b
    assert a["metrics"]["intervals"]["nees"] is not None


def test_equal_predictions_are_in_one_bin():
    truth, _ = draws(200)
    same = predictions_of(truth, np.full((200, 2), 0.1), np.tile(np.eye(2), (200, 1, 1)))
    [part] = run(truth, same).nees_by_sigma
    assert (part["sigma_px"], part["matched"], part["interval"]) == ([1.0, 1.0], 200, None)
    assert part["nees"] == pytest.approx(0.02)


def test_what_is_not_known_is_undefined():
    truth, _ = draws(20)
    scores = run(truth, predictions_of(truth, np.zeros((20, 2))), 20)
    assert (scores["nees"], scores["sigma_median_px"], scores.overall.intervals["nees"]) == (None, None, None)
    assert scores.nees_by_sigma == []
    assert (scores["bias_px"], scores["scatter_px"]) == (0, 0)
    singular = run(truth, predictions_of(truth, np.zeros((20, 2)), np.zeros((20, 2, 2))), 20)
    assert (singular["nees"], singular["sigma_median_px"]) == (None, 0.0)
    assert singular.overall.intervals["nees"] is None
    without_homography = truth_of(np.zeros((2, 3, 3)) + np.diag([0, 0, 1]))
    without_homography.keypoints["H_patch2image"] = 0
    found = run(without_homography, predictions_of(without_homography, np.zeros((2, 2))))
    assert [found[name] for name in NEW] == [None] * len(NEW)
    nothing = run(truth, [Detections.none()] * len(truth), 20)
    assert [nothing[name] for name in NEW] == [None] * len(NEW)
