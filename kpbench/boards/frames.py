"""Detections in straight coordinates: without the lens, with the affine frame and the covariance of each point.

A homography H maps the plane of a board to the image, ``H(X) = (a + B X) / w(X)`` with ``w(X) = 1 + cᵀ X``. Its
derivative at X is ``(B - H(X) cᵀ) / w(X)``. A detection gives H(X) as ``xy``, and the derivative as its frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.patches.design import Patch
from kpbench.types import Detections, Float, Int

POINT_SIGMA = 0.03
"""Standard deviation of a point, in disc radii, for finding a board."""
MOST_BENT, MOST_SCALED = 0.15, 0.2
"""Largest errors of the shape and of the logarithm of the scale of a frame, plus three of its standard deviations."""
RIDGE = 1e-12
"""Part of their diagonal that is added to normal equations, so that they can always be solved."""
KNOWN, UNKNOWN_SCALE, UNKNOWN_SHAPE = 0.03, 0.25, 0.1
"""Standard deviations of what a design tells about its frame and of what it does not, in parts of the frame."""


@dataclass(frozen=True)
class Frames:
    """Points and affine frames of n detections in an image without distortion.

    Attributes
    ----------
    xy : ndarray of shape (n, 2)
        Points: rays (x, y) with a camera, px without. nan for a point that the lens cannot show.
    A : ndarray of shape (n, 2, 2)
        Affine frame of each patch, from its unit disc.
    covariance : ndarray of shape (n, 2, 2), or None
        Covariance of the error of each point.
    """

    xy: Float
    A: Float
    covariance: Float | None

    def __getitem__(self, rows: Int) -> Frames:
        return Frames(self.xy[rows], self.A[rows], None if self.covariance is None else self.covariance[rows])


def straighten(detections: Detections, camera: Camera | None) -> Frames:
    """Return the points and frames of detections without the distortion of the lens.

    Raises
    ------
    DataError
        If the detections have no affine frames.
    """
    if detections.A_patch2image is None:
        raise DataError("the detector gives no affine frames (A_patch2image), which a board needs")
    xy, A, covariance = detections.xy, detections.A_patch2image, detections.covariance
    if camera is None:
        return Frames(xy, A, covariance)
    rays = _undistort(camera, xy)
    focal = camera.K[[0, 1], [0, 1]]
    to_ray = np.full((len(rays), 2, 2), np.nan)
    seen = np.isfinite(rays[:, 0])
    to_ray[seen] = np.linalg.inv(focal[:, None] * camera.lens.jacobian(rays[seen]))
    if covariance is not None:
        covariance = to_ray @ covariance @ to_ray.transpose(0, 2, 1)
    return Frames(rays, to_ray @ A, covariance)


def _undistort(camera: Camera, xy: Float) -> Float:
    """Return the rays of points, nan for points outside the valid region of the lens."""
    try:
        return camera.undistort(xy)
    except ValueError:
        if len(xy) == 1:
            return np.full((1, 2), np.nan)
        return np.concatenate([_undistort(camera, point[None]) for point in xy])


@lru_cache(maxsize=256)
def frame_errors(patch: Patch) -> tuple[float, float]:
    """Return the standard deviations of the scale and of the shape of a frame, as parts of the frame.

    Rings tell the scale. Straight lines through the centre do not: only the edge of the disc does, which has little
    contrast. Two lines do not tell the shape either: to scale along both of them changes nothing.
    """
    radii, angles, black = patch.cells
    edges = angles[black[0] != np.roll(black[0], 1)] % 180.0
    if len(radii) > 2:
        return KNOWN, KNOWN
    return UNKNOWN_SCALE, KNOWN if len({round(edge, 3) % 180.0 for edge in edges.tolist()}) > 2 else UNKNOWN_SHAPE


def fit_homography(points: Float, xy: Float, J: Float, scale: Float, shape: Float) -> Float:
    """Fit a homography to points and to its derivatives at these points, by weighted linear least squares.

    Each point gives the equations ``a + B X - x (1 + cᵀ X) = 0`` and ``B - x cᵀ - J (1 + cᵀ X) = 0``.

    Parameters
    ----------
    points : ndarray of shape (n, 2)
        Points X of the plane, in disc radii.
    xy : ndarray of shape (n, 2)
        Their images x.
    J : ndarray of shape (n, 2, 2)
        Derivatives of the image by X.
    scale, shape : ndarray of shape (n,)
        Standard deviations of each J: along itself and across, see :func:`frame_errors`.

    Returns
    -------
    ndarray of shape (3, 3)
        The homography from the plane to the image.
    """
    n, middle, centre = len(points), points.mean(axis=0), xy.mean(axis=0)
    reach = max(float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean())), 1e-9)
    radius = np.sqrt(np.abs(J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]))  # of each patch in the image
    gauge = radius.mean() * reach  # size of the board in the image
    X, x, J = (points - middle) / reach, (xy - centre) / gauge, J * (reach / gauge)
    M, y = np.zeros((n, 6, 8)), np.zeros((n, 6))  # unknown: a (2), B by rows (4), c (2)
    for k in range(2):
        M[:, k, k] = 1.0
        M[:, k, 2 + 2 * k : 4 + 2 * k] = X
        M[:, k, 6:] = -x[:, k, None] * X
        y[:, k] = x[:, k]
        for m in range(2):
            row = 2 + 2 * k + m
            M[:, row, row] = 1.0
            M[:, row, 6:] = -J[:, k, m, None] * X
            M[:, row, 6 + m] -= x[:, k]
            y[:, row] = J[:, k, m]
    along = J.reshape(n, 4, 1) / np.sqrt((J**2).sum(axis=(1, 2)))[:, None, None]
    along = along @ along.transpose(0, 2, 1)
    whiten = np.zeros((n, 6, 6))
    whiten[:, [0, 1], [0, 1]] = reach / POINT_SIGMA
    total = np.sqrt(shape**2 + 2 * scale**2)
    whiten[:, 2:, 2:] = (np.eye(4) - along) / shape[:, None, None] + along / total[:, None, None]
    whiten *= (radius.mean() / radius)[:, None, None]
    rows, right = (whiten @ M).reshape(-1, 8), (whiten @ y[..., None]).ravel()
    normal = rows.T @ rows
    normal.flat[::9] *= 1 + RIDGE
    a0, a1, b00, b01, b10, b11, c0, c1 = np.linalg.solve(normal, rows.T @ right)
    H = np.array([[b00, b01, a0], [b10, b11, a1], [c0, c1, 1.0]])
    to_plane = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, reach]])
    to_image = np.array([[gauge, 0, centre[0]], [0, gauge, centre[1]], [0, 0, 1.0]])
    return np.asarray(to_image @ H @ to_plane)
