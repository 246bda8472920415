"""Compute the pose of a known board from a detector's matches, and the errors of this pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.scoring.outcomes import Outcomes
from kpbench.scoring.scores import Scores
from kpbench.types import Float

LEAST_POINTS = 4
"""Smallest number of points that determine the pose of a plane."""


@dataclass(frozen=True)
class PoseErrors:
    """The errors of the board's pose in each of N images; nan where fewer than four keypoints are matched.

    Attributes
    ----------
    translation_percent : ndarray of shape (N,), float64
        Distance between the estimated and the true position of the board's origin, in % of the true distance from
        the camera to the origin.
    rotation_deg : ndarray of shape (N,), float64
        Angle between the estimated and the true orientation, degrees.

    Examples
    --------
    >>> import numpy as np, kpbench
    >>> errors = kpbench.scoring.PoseErrors(np.array([0.1, np.nan]), np.array([0.5, np.nan]))
    >>> int(np.isfinite(errors.rotation_deg).sum())
    1
    """

    translation_percent: Float
    rotation_deg: Float


@dataclass(frozen=True)
class PoseGroup:
    """Percentiles of the pose errors over all images, or over the images of one condition and rung.

    Images without a pose do not influence the percentiles. The percentiles are None if no image has a pose.

    Attributes
    ----------
    condition : str or None
        None for all images.
    rung : float or None
        None for all images.
    images, with_pose : int
        Number of images, and number of images with a pose.
    translation_median_percent, translation_p95_percent : float or None
    rotation_median_deg, rotation_p95_deg : float or None

    Examples
    --------
    >>> import kpbench
    >>> kpbench.scoring.PoseGroup("blur", 15, 20, 19, 0.1, 0.4, 0.3, 1.2).with_pose
    19
    """

    condition: str | None
    rung: float | None
    images: int
    with_pose: int
    translation_median_percent: float | None
    translation_p95_percent: float | None
    rotation_median_deg: float | None
    rotation_p95_deg: float | None


def group_pose_errors(scores: Scores, errors: PoseErrors) -> tuple[PoseGroup, ...]:
    """Compute the median and the 95th percentile of pose errors.

    Parameters
    ----------
    scores : Scores
        The scores that hold the outcomes given to :func:`compute_pose_errors`.
    errors : PoseErrors

    Returns
    -------
    tuple of PoseGroup
        One group for all images, then one group for each condition and rung.

    Examples
    --------
    >>> import numpy as np, kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> images = scores.overall.counts["images"]
    >>> errors = kpbench.scoring.PoseErrors(np.full(images, 0.5), np.full(images, 2.0))
    >>> kpbench.scoring.group_pose_errors(scores, errors)[0].rotation_median_deg
    2.0
    """
    truth = scores.outcomes.truth

    def group(condition: str | None, rung: float | None, images: NDArray[np.bool_]) -> PoseGroup:
        with_pose = images & np.isfinite(errors.rotation_deg)
        both = errors.translation_percent[with_pose], errors.rotation_deg[with_pose]
        percentiles = [v for e in both for v in (np.percentile(e, [50, 95]).tolist() if len(e) else (None, None))]
        return PoseGroup(condition, rung, int(images.sum()), int(with_pose.sum()), *percentiles)

    keys = [(name, rung) for name, rungs in scores.conditions.items() for rung in rungs]
    return (
        group(None, None, np.ones(len(truth), bool)),
        *(group(name, rung, (truth.condition == name) & (truth.rung == rung)) for name, rung in keys),
    )


def compute_pose_errors(outcomes: Outcomes, points_mm: Float, camera: Camera) -> PoseErrors:
    """Compare the board's pose from the matched detections with the pose from the true keypoints, in each image.

    ``solvePnP`` estimates both poses. The match assigns a detection to a keypoint of the board, so wrong identities and
    false alarms have no influence. A distant board has two poses that fit almost equally well. If the estimate is the
    wrong pose, the rotation error is large.

    Parameters
    ----------
    outcomes : Outcomes
    points_mm : ndarray of shape (K, 3), float64
        The board's keypoints in the board's frame, mm, with z = 0. Each image lists its true keypoints in this order.
    camera : Camera

    Returns
    -------
    PoseErrors

    Raises
    ------
    DataError
        If an image does not show exactly K keypoints.

    Examples
    --------
    >>> import numpy as np, kpbench
    >>> from kpbench.geometry import Camera
    >>> points_mm = np.array([[0.0, 0, 0], [90, 0, 0], [90, 60, 0], [0, 60, 0]])
    >>> camera = Camera(640, 480, 500.0)
    >>> xy = camera.project(points_mm + [0, 0, 400])
    >>> keypoints = np.zeros(4, kpbench.KEYPOINT_DTYPE)
    >>> keypoints["x"], keypoints["y"] = xy.T
    >>> keypoints["radius_major"] = 20
    >>> truth = kpbench.Truth(
    ...     np.array([0]), np.array([0, 4]), keypoints, np.array([""]), np.array([np.nan]), np.array([0])
    ... )
    >>> scores = kpbench.score(truth, [kpbench.Detections(xy, np.ones(4))])
    >>> errors = kpbench.scoring.compute_pose_errors(scores.outcomes, points_mm, camera)
    >>> bool(errors.rotation_deg[0] < 0.001)
    True
    """
    truth, k = outcomes.truth, len(points_mm)
    counts = np.diff(truth.offsets)
    if np.any(counts != k):
        n = int(np.argmax(counts != k))
        raise DataError(f"image_id {truth.image_id[n]} has {counts[n]} keypoints, but the board has {k}")
    true_xy = outcomes.truth_points.xy.reshape(-1, k, 2)
    detection = outcomes.matches.detection.reshape(-1, k)
    translation, rotation = np.full(len(truth), np.nan), np.full(len(truth), np.nan)
    for n in np.flatnonzero((detection >= 0).sum(axis=1) >= LEAST_POINTS).tolist():
        matched = detection[n] >= 0
        R_true, t_true = _estimate_pose(points_mm, true_xy[n], camera)
        R, t = _estimate_pose(points_mm[matched], outcomes.detections.xy[detection[n][matched]], camera)
        translation[n] = 100 * np.linalg.norm(t - t_true) / np.linalg.norm(t_true)
        # arctan2 of sine and cosine resolves small angles, which arccos of the trace would round to zero
        turn = R @ R_true.T
        sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        rotation[n] = np.degrees(np.arctan2(sine, np.trace(turn) - 1))
    return PoseErrors(translation, rotation)


def _estimate_pose(points_mm: Float, xy: Float, camera: Camera) -> tuple[Float, Float]:
    """Return the rotation (3, 3) and the translation (3,), mm, from the board's frame to the camera's frame.

    IPPE returns the better of the two candidate poses of a plane. Levenberg-Marquardt refines this pose.
    """
    import cv2

    if camera.model == "fisheye":  # OpenCV's solver knows the model of Brown only
        straight = camera.without_distortion()
        xy, camera = straight.distort(camera.undistort(xy)), straight
    points, pixels = np.ascontiguousarray(points_mm), np.ascontiguousarray(xy)
    distortion = np.array(camera.distortion)
    _, rvec, tvec = cv2.solvePnP(points, pixels, camera.K, distortion, flags=cv2.SOLVEPNP_IPPE)
    rvec, tvec = cv2.solvePnPRefineLM(points, pixels, camera.K, distortion, rvec, tvec)
    return np.asarray(cv2.Rodrigues(rvec)[0], np.float64), np.asarray(tvec, np.float64).ravel()
