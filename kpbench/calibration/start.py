"""Where the solver starts: focal length and poses from homographies."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from kpbench.calibration.bundle import Bundle, PhotoPose, adjust_bundle
from kpbench.calibration.marks import BoardPoints
from kpbench.calibration.shape import PrintShape
from kpbench.geometry.camera import Camera
from kpbench.geometry.lens import LensModel
from kpbench.types import Float

FOCALS = (0.55, 0.8, 1.2, 2.0, 4.0)
"""Focal lengths from which the solution starts, in widths of the image, beside the one of the homographies."""
MOST_PHOTOS, MOST_POINTS = 8, 48
"""Number of photographs, and of points of each, that decide between the starts."""
GOOD_PX = 0.3
"""Root mean square of the residuals, px, below which no further start is tried."""


def start_camera(
    points: Sequence[BoardPoints], board_mm: Float, size_px: tuple[int, int], model: LensModel, coefficients: int
) -> Camera:
    """Return a camera near the solution.

    The focal length is that of the homographies (Z. Zhang, "A flexible new technique for camera calibration", *IEEE
    TPAMI* 22, 2000, eq. 3 and 4, with the principal point in the middle of the image), or one of :data:`FOCALS`,
    whichever leaves the smallest residuals.
    """
    width, height = size_px
    order = sorted(range(len(points)), key=lambda n: -len(points[n]))[: 3 * MOST_PHOTOS]
    chosen = [points[n] for n in order[:: max(1, len(order) // MOST_PHOTOS)]]
    chosen = [p[np.arange(0, len(p), max(1, len(p) // MOST_POINTS))] for p in chosen]
    best: tuple[float, Camera] | None = None
    for focal in (_focal_of_homographies(chosen, board_mm, size_px), *(f * width for f in FOCALS)):
        if focal is None:
            continue
        camera = Camera(width, height, focal, (0.0,) * coefficients, model)
        poses = [start_pose(p, board_mm, camera) for p in chosen]
        usable = [n for n, pose in enumerate(poses) if pose is not None]
        if not usable:
            continue
        starts = [pose for pose in poses if pose is not None]
        bundle = adjust_bundle([chosen[n] for n in usable], board_mm, camera, starts, PrintShape(), rounds=2)
        if not 0.2 < bundle.camera.focal_px / width < 30:
            continue
        cost = float(np.median(bundle.rms_px())) * (len(chosen) / len(usable)) ** 2
        if best is None or cost < 0.98 * best[0]:
            best = cost, bundle.camera
        if cost < GOOD_PX:
            break
    return best[1] if best is not None else Camera(width, height, 1.2 * width, (0.0,) * coefficients, model)


def start_pose(points: BoardPoints, board_mm: Float, camera: Camera) -> PhotoPose | None:
    """Return a pose near the solution of one photograph; None if there is none."""
    try:
        rays = camera.undistort(points.xy)
    except ValueError:
        rays = (points.xy - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    flat = np.column_stack([board_mm[points.index], np.zeros(len(points))])
    if len(points) < 4 or np.linalg.svd(flat[:, :2] - flat[:, :2].mean(axis=0), compute_uv=False)[1] < 1e-3:
        return None
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(flat, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:
        return None
    found = list[tuple[float, PhotoPose]]()
    for rotation, shift in zip(turns, shifts, strict=True):
        R, t = cv2.Rodrigues(rotation)[0], shift.ravel()
        seen = flat @ R.T + t
        if np.isfinite(R).all() and (seen[:, 2] > 0).all():
            error = np.median(np.hypot(*(seen[:, :2] / seen[:, 2:] - rays).T))
            found.append((float(error), PhotoPose(np.asarray(R, np.float64), np.asarray(t, np.float64))))
    return min(found, key=lambda item: item[0])[1] if found else None


def _focal_of_homographies(points: Sequence[BoardPoints], board_mm: Float, size_px: tuple[int, int]) -> float | None:
    """Return the focal length, px, that fits all homographies; None if they do not tell it."""
    middle = (np.array(size_px) - 1) / 2
    scale = float(size_px[0])
    left, right = list[float](), list[float]()
    for p in points:
        if len(p) < 6:
            continue
        found, _ = cv2.findHomography(board_mm[p.index], (p.xy - middle) / scale, 0)
        if found is None:
            continue
        H = np.asarray(found, np.float64)
        H /= np.linalg.norm(H[:, 0])
        left += [float(H[0, 0] * H[0, 1] + H[1, 0] * H[1, 1]), float((H[:2, 0] ** 2).sum() - (H[:2, 1] ** 2).sum())]
        right += [float(-H[2, 0] * H[2, 1]), float(H[2, 1] ** 2 - H[2, 0] ** 2)]
    a, b = np.array(left), np.array(right)
    inverse_square = float(a @ b / max(float(a @ a), 1e-300))
    return scale / float(np.sqrt(inverse_square)) if inverse_square > 1e-4 else None


def solve_photos(
    points: Sequence[BoardPoints],
    board_mm: Float,
    camera: Camera,
    *,
    solve_camera: bool = True,
    solve_shape: bool = True,
) -> Bundle:
    """Solve photographs from a camera near the solution. Every photograph needs a pose.

    Examples
    --------
    See :func:`kpbench.calibrate`.
    """
    poses = [start_pose(p, board_mm, camera) for p in points]
    missing = PhotoPose(np.eye(3), np.array([0.0, 0.0, 1e3]))
    starts = [pose or missing for pose in poses]
    return adjust_bundle(
        points, board_mm, camera, starts, PrintShape(), solve_camera=solve_camera, solve_shape=solve_shape
    )
