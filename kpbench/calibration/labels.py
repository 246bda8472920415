"""True keypoints of a photograph, from its reference marks alone."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.calibration.bundle import Bundle, PhotoPose
from kpbench.calibration.field import LeaveOneOut, ResidualField, fit_field
from kpbench.calibration.projection import project_points
from kpbench.calibration.visibility import compare_scene, look_at_patch
from kpbench.geometry.homography import project
from kpbench.patches.board import Board, BoardKeypoint
from kpbench.portable import cos_sin
from kpbench.render.board_view import RIM_POINTS, ellipse_of_moments
from kpbench.types import LABELLED_KEYPOINT_DTYPE, Float, UInt8

ROLLING_T = 8.0
"""Statistic (Student's t) from which the motion of a rolling shutter is flagged."""


@dataclass(frozen=True)
class PhotoLabels:
    """The true keypoints of a photograph.

    Attributes
    ----------
    keypoints : ndarray of shape (n,), LABELLED_KEYPOINT_DTYPE
    ignored : ndarray of shape (m,), LABELLED_KEYPOINT_DTYPE
        Patches inside of the image that have no label, so that nobody judges a detection there.
    unlabelled : dict of str to int
        Number of keypoints without label, by reason: ``outside`` of the image, outside of the ``hull`` of the marks
        that were found, ``covered``.
    leave_one_out : LeaveOneOut
        The check of every mark.
    rolling_px : float
        Motion of the board from the first to the last row of the image, px, that the residuals tell; 0 if they do not.
    pose : PhotoPose
    rms_px : float
        Root mean square residual of the marks per coordinate, px.
    """

    keypoints: NDArray[Any]
    ignored: NDArray[Any]
    unlabelled: dict[str, int]
    leave_one_out: LeaveOneOut
    rolling_px: float
    pose: PhotoPose
    rms_px: float


def label_photo(
    bundle: Bundle, n: int, board: Board, board_mm: Float, image: UInt8, easy: UInt8 | None = None
) -> PhotoLabels:
    """Return the true keypoints of photograph ``n`` of a bundle.

    Parameters
    ----------
    bundle : Bundle
    n : int
    board : Board
    board_mm : ndarray of shape (N, 2)
        The X-corners of its marks.
    image : ndarray of shape (H, W)
        The grey photograph, which tells what is covered.
    easy : ndarray of shape (H, W), optional
        Photograph ``n``, if `image` is a hard photograph of the same scene.
    """
    field, leave_one_out, rolling_px = _fit(bundle, n, board_mm)
    hull = cv2.convexHull(field.points_mm.astype(np.float32))
    centres = board.points_mm[:, :2]
    pose = bundle.poses[n]
    base = project_points(bundle.camera, pose.rotation, pose.translation_mm, bundle.shape.bend(centres))
    found = field.predict(centres, base.by_pose)
    xy = base.xy + found.mean
    table, unlabelled = np.zeros(len(centres), LABELLED_KEYPOINT_DTYPE), Counter[str]()
    maps = np.stack([_first_order_map(bundle, n, *row) for row in zip(board.keypoints, found.mean, strict=True)])
    is_alike = np.zeros(len(centres), bool) if easy is None else compare_scene(image, easy, maps)
    is_judged = np.zeros(len(centres), bool)
    for k, keypoint in enumerate(board.keypoints):
        x, y = xy[k].tolist()
        if not (-0.5 <= x < image.shape[1] - 0.5 and -0.5 <= y < image.shape[0] - 0.5):
            unlabelled["outside"] += 1
            continue
        sight = look_at_patch(image, maps[k], keypoint.patch)
        truth = (x, y, keypoint.patch_id, *_ellipse(bundle, n, keypoint), maps[k], sight.inside, sight.contrast)
        table[k] = (*truth, np.inf, np.inf, 0.0)  # ignored
        if cv2.pointPolygonTest(hull, (float(centres[k, 0]), float(centres[k, 1])), False) < 0:
            unlabelled["hull"] += 1
        elif not (sight.is_seen if easy is None else is_alike[k] and _is_seen(easy, maps[k], keypoint)):
            unlabelled["covered"] += 1
        else:
            (xx, xy_), (_, yy) = found.covariance[k]
            sigma_x, sigma_y = np.sqrt([xx, yy])
            table[k] = (*truth, sigma_x, sigma_y, xy_ / (sigma_x * sigma_y))
            is_judged[k] = True
    is_there = table["radius_major"] > 0
    parts = table[is_judged], table[is_there & ~is_judged]
    rms_px = float(bundle.rms_px()[n])
    return PhotoLabels(*parts, dict(unlabelled), leave_one_out, rolling_px, pose, rms_px)


def _is_seen(image: UInt8, H_patch2image: Float, keypoint: BoardKeypoint) -> bool:
    return look_at_patch(image, H_patch2image, keypoint.patch).is_seen


def _fit(bundle: Bundle, n: int, board_mm: Float) -> tuple[ResidualField, LeaveOneOut, float]:
    """Fit the field of residuals of a photograph; check each mark; estimate the motion during the exposure."""
    points, inlier, residual, pose = bundle.points[n], bundle.inlier[n], bundle.residual[n], bundle.poses[n]
    rows = np.flatnonzero(inlier)
    at_mm = board_mm[points.index[rows]]
    seen = project_points(bundle.camera, pose.rotation, pose.translation_mm, bundle.shape.bend(at_mm))
    variance = np.trace(points.covariance[rows], axis1=1, axis2=2) / 2
    field = fit_field(at_mm, residual[rows], variance, seen.by_pose)
    leave_one_out = field.leave_one_out(residual[rows], points.index[rows] // 4)
    return field, leave_one_out, _estimate_motion(points.xy[rows], residual[rows], variance, seen.by_pose, bundle)


def _estimate_motion(xy: Float, residual: Float, variance: Float, by_pose: Float, bundle: Bundle) -> float:
    """Return the motion from the first to the last row, px, that explains residuals; 0 if it is not significant."""
    share = (xy[:, 1] - (bundle.camera.height_px - 1) / 2) / bundle.camera.height_px
    motion = share[:, None, None] * np.eye(2)
    weight = 1 / np.sqrt(variance)
    J = (np.concatenate([by_pose, motion], axis=2) * weight[:, None, None]).reshape(2 * len(xy), -1)
    J_scale = np.sqrt((J * J).sum(axis=0))
    solution, rest, rank, _ = np.linalg.lstsq(J / J_scale, (residual * weight[:, None]).ravel(), rcond=None)
    if rank < J.shape[1] or len(J) <= J.shape[1]:
        return 0.0
    inverse = np.linalg.inv((J / J_scale).T @ (J / J_scale))
    spread = np.sqrt(float(rest[0]) / (len(J) - J.shape[1]) * np.diag(inverse))
    t = solution[-2:] / spread[-2:]
    return float(np.hypot(*(solution[-2:] / J_scale[-2:]))) if np.abs(t).max() > ROLLING_T else 0.0


def _first_order_map(bundle: Bundle, n: int, keypoint: BoardKeypoint, offset_px: Float) -> Float:
    """Return the homography that agrees with lens and paper at the centre of a patch to first order."""
    pose = bundle.poses[n]
    bent = bundle.shape.bend(np.array([[keypoint.x_mm, keypoint.y_mm]]))
    on_sheet = np.column_stack([bent.by_point[0] @ keypoint.H_patch2board[:2, :2], bent.xyz[0]])
    M_patch2camera = pose.rotation @ on_sheet
    M_patch2camera[:, 2] += pose.translation_mm
    H = bundle.camera.local_K(M_patch2camera[:2, 2] / M_patch2camera[2, 2]) @ M_patch2camera
    H = H / H[2, 2]
    H[:2] += offset_px[:, None] * H[2]
    return np.asarray(H)


def _ellipse(bundle: Bundle, n: int, keypoint: BoardKeypoint) -> tuple[float, float, float]:
    """Return the semi-axes, px, and the direction of the ellipse with the second moments of the image of a disc."""
    pose = bundle.poses[n]
    rim = np.column_stack(cos_sin(np.arange(RIM_POINTS) * (2 * np.pi / RIM_POINTS)))
    bent = bundle.shape.bend(project(keypoint.H_patch2board, rim))
    ellipse = ellipse_of_moments(project_points(bundle.camera, pose.rotation, pose.translation_mm, bent).xy)
    return ellipse.major, ellipse.minor, ellipse.angle_deg
