"""What a detector's errors mean for the pose of a known board: solvePnP on the matched detections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.scoring.outcomes import Tally
from kpbench.scoring.scores import Scores
from kpbench.types import Float

LEAST_POINTS = 4  # that fix the pose of a plane


@dataclass(frozen=True)
class PoseErrors:
    """Errors of the pose in each of N images; nan where fewer than four keypoints were matched.

    Attributes
    ----------
    translation_percent : ndarray of shape (N,), float64
        Distance between the estimated and the true place of the board's origin, in % of its true distance.
    rotation_deg : ndarray of shape (N,), float64
        Angle of the rotation between the estimated and the true orientation.
    """

    translation_percent: Float
    rotation_deg: Float


@dataclass(frozen=True)
class PoseGroup:
    """Errors of the pose over all images (condition and rung None) or those of one rung; None without any pose.

    Attributes
    ----------
    condition : str or None
    rung : float or None
    images, with_pose : int
        Images of the group, and those whose pose is known.
    translation_median_percent, translation_p95_percent : float or None
    rotation_median_deg, rotation_p95_deg : float or None
    """

    condition: str | None
    rung: float | None
    images: int
    with_pose: int
    translation_median_percent: float | None
    translation_p95_percent: float | None
    rotation_median_deg: float | None
    rotation_p95_deg: float | None


def pose_groups(run: Scores, errors: PoseErrors) -> tuple[PoseGroup, ...]:
    """Median and 95th percentile of the errors, over all images and for each condition and rung."""
    truth = run.tally.truth

    def group(condition: str | None, rung: float | None, chosen: NDArray[np.bool_]) -> PoseGroup:
        known = chosen & np.isfinite(errors.rotation_deg)
        both = errors.translation_percent[known], errors.rotation_deg[known]
        spread = [v for e in both for v in (np.percentile(e, [50, 95]).tolist() if len(e) else (None, None))]
        return PoseGroup(condition, rung, int(chosen.sum()), int(known.sum()), *spread)

    rungs = [(name, r) for name, ladder in run.conditions.items() for r in ladder]
    return (
        group(None, None, np.ones(len(truth), bool)),
        *(group(name, r, (truth.condition == name) & (truth.rung == r)) for name, r in rungs),
    )


def pose_errors(rows: Tally, points_mm: Float, camera: Camera) -> PoseErrors:
    """Pose of the board from the matched detections of each image, against that from the true keypoints.

    The match says which keypoint of the board a detection is, so identities and false alarms do not enter; a planar
    board seen from far may flip, which counts as the error that it is.

    Parameters
    ----------
    rows : Tally
    points_mm : ndarray of shape (K, 3)
        The board's keypoints with z = 0, in the order in which they stand in the truth of every image.
    camera : Camera

    Raises
    ------
    DataError
        If an image does not show exactly the K keypoints.
    """
    truth, k = rows.truth, len(points_mm)
    counts = np.diff(truth.offsets)
    if np.any(counts != k):
        n = int(np.argmax(counts != k))
        raise DataError(f"image_id {truth.image_id[n]} has {counts[n]} keypoints, but the board has {k}")
    places = np.stack([truth.keypoints["x"], truth.keypoints["y"]], axis=1).astype(np.float64).reshape(-1, k, 2)
    found = rows.detection.reshape(-1, k)
    translation, rotation = np.full(len(truth), np.nan), np.full(len(truth), np.nan)
    for n in np.flatnonzero((found >= 0).sum(axis=1) >= LEAST_POINTS).tolist():
        seen = found[n] >= 0
        R_true, t_true = _pose(points_mm, places[n], camera)
        R, t = _pose(points_mm[seen], rows.xy[found[n][seen]], camera)
        translation[n] = 100 * np.linalg.norm(t - t_true) / np.linalg.norm(t_true)
        # arctan2 of sine and cosine: arccos of the trace alone cannot tell small angles from none
        turn = R @ R_true.T
        sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        rotation[n] = np.degrees(np.arctan2(sine, np.trace(turn) - 1))
    return PoseErrors(translation, rotation)


def _pose(points_mm: Float, xy: Float, camera: Camera) -> tuple[Float, Float]:
    """Rotation (3, 3) and translation (3,) in mm, board to camera: the plane's better pose, refined."""
    import cv2

    points, pixels = np.ascontiguousarray(points_mm), np.ascontiguousarray(xy)
    distortion = np.array(camera.distortion)
    _, rvec, tvec = cv2.solvePnP(points, pixels, camera.K, distortion, flags=cv2.SOLVEPNP_IPPE)
    rvec, tvec = cv2.solvePnPRefineLM(points, pixels, camera.K, distortion, rvec, tvec)
    return np.asarray(cv2.Rodrigues(rvec)[0], np.float64), np.asarray(tvec, np.float64).ravel()
