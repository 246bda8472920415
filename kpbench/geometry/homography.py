"""Points, homographies, ellipses, camera and pose, and *the* pixel convention.

Conventions
-----------
* Image frame: x right, y down, float64 px, the **centre** of the top-left pixel is (0, 0) (OpenCV).
  Pixel (column j, row i) covers ``[j - 0.5, j + 0.5] x [i - 0.5, i + 0.5]``.
* Patch frame: the patch is the unit disc; u right, v down. Angles grow from +u towards +v,
  which is clockwise for somebody who looks at the patch.
* Board frame: mm, x right, y down, z away from the viewer; the origin is the board's centre.
* Camera frame: x right, y down, z forward. ``H_a2b`` maps frame a to frame b.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from kpbench.types import Float, UInt8


def project(H_a2b: Float, points_a: ArrayLike) -> Float:
    """Map points through a homography.

    Parameters
    ----------
    H_a2b : ndarray of shape (3, 3)
    points_a : array_like of shape (N, 2)

    Returns
    -------
    ndarray of shape (N, 2)
    """
    points = np.asarray(points_a, np.float64)
    mapped = points @ H_a2b[:, :2].T + H_a2b[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def jacobian(H_a2b: Float, point_a: ArrayLike) -> Float:
    """Derivative of :func:`project` at one point, ndarray of shape (2, 2)."""
    x, y = np.asarray(point_a, np.float64)
    mapped = H_a2b @ np.array([x, y, 1.0])
    return np.asarray((H_a2b[:2, :2] - np.outer(mapped[:2] / mapped[2], H_a2b[2, :2])) / mapped[2])


@dataclass(frozen=True)
class Ellipse:
    """An ellipse in px: centre, semi-axes, and the angle of the major axis in [0, 180) degrees."""

    x: float
    y: float
    major: float
    minor: float
    angle_deg: float


def projected_discs(H_patch2image: Float) -> tuple[Float, Float, Float, Float]:
    """Images of the unit circle under many homographies.

    The dual conic of the unit circle is diag(1, 1, -1); under H it becomes H C* Hᵀ (Hartley and
    Zisserman, *Multiple View Geometry*, 2nd ed., eq. 2.17). Its centre is *not* the image of the
    disc's centre unless H is affine.

    Parameters
    ----------
    H_patch2image : ndarray of shape (N, 3, 3)

    Returns
    -------
    centre : ndarray of shape (N, 2), px
    major, minor : ndarray of shape (N,), semi-axes, px
    angle_deg : ndarray of shape (N,), of the major axis, in [0, 180)
        All are nan where the disc touches or crosses the camera's horizon: its image is no ellipse.
    """
    dual = (H_patch2image * (1.0, 1.0, -1.0)) @ H_patch2image.transpose(0, 2, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        dual = np.where(dual[:, 2:, 2:] < 0, dual / dual[:, 2:, 2:], np.nan)
    x, y = dual[:, 0, 2], dual[:, 1, 2]
    xx, yy, xy = x * x - dual[:, 0, 0], y * y - dual[:, 1, 1], x * y - dual[:, 0, 1]
    middle, spread = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    major, minor = np.sqrt(middle + spread), np.sqrt(np.maximum(middle - spread, 0.0))
    angle_deg = np.degrees(np.arctan2(2 * xy, xx - yy) / 2) % 180.0
    return dual[:, :2, 2], major, minor, angle_deg


def projected_disc(H_patch2image: Float) -> Ellipse:
    """Image of the unit circle under one homography, see :func:`projected_discs`.

    Raises
    ------
    ValueError
        If the disc touches or crosses the camera's horizon, so that its image is no ellipse.
    """
    centre, major, minor, angle_deg = projected_discs(H_patch2image[None])
    if np.isnan(major[0]):
        raise ValueError("the disc reaches the horizon of the camera: its image is not an ellipse")
    return Ellipse(float(centre[0, 0]), float(centre[0, 1]), float(major[0]), float(minor[0]), float(angle_deg[0]))


def rotation_xyz(x_deg: float, y_deg: float, z_deg: float) -> Float:
    """Rotation by z first, then y, then x about the fixed axes: ``Rx @ Ry @ Rz``, shape (3, 3)."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(a := np.radians([x_deg, y_deg, z_deg])), np.sin(a)
    Rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    Ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    Rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(Rx @ Ry @ Rz)


def plane_to_camera(R_plane2camera: Float, t_camera: ArrayLike) -> Float:
    """The 3x3 matrix ``[r1 r2 t]`` that takes (x, y, 1) on a plane to the camera frame."""
    return np.column_stack([R_plane2camera[:, :2], np.asarray(t_camera, np.float64)])


NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Camera:
    """A camera: image size and focal length in px, principal point at the image's centre.

    ``distortion`` holds OpenCV's (k1, k2, p1, p2, k3), radial and tangential (Brown 1966); 0 is a pinhole.
    """

    width_px: int
    height_px: int
    focal_px: float
    distortion: tuple[float, float, float, float, float] = NO_DISTORTION

    @property
    def K(self) -> Float:
        """Intrinsic matrix, camera frame to px, ndarray of shape (3, 3)."""
        cx, cy = (self.width_px - 1) / 2, (self.height_px - 1) / 2
        return np.array([[self.focal_px, 0, cx], [0, self.focal_px, cy], [0, 0, 1]])

    def project(self, points_camera: ArrayLike) -> Float:
        """Points of the camera frame, shape (N, 3), z > 0, to px with distortion, shape (N, 2)."""
        points = np.asarray(points_camera, np.float64)
        return self.distort(points[:, :2] / points[:, 2:])

    def distort(self, rays: Float) -> Float:
        """Points at distance 1 (x / z, y / z), shape (N, 2), to px, shape (N, 2)."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = np.asarray(rays, np.float64).T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.asarray(self.focal_px * np.column_stack([xd, yd]) + self.K[:2, 2])

    def local_K(self, ray: ArrayLike) -> Float:
        """The intrinsic matrix that agrees with :meth:`distort` at one point (x / z, y / z) to first order.

        Without distortion this is ``K`` everywhere.
        """
        k1, k2, p1, p2, k3 = self.distortion
        x, y = np.asarray(ray, np.float64)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # of the radial factor along x is x * slope
        J = self.focal_px * np.array([
            [radial + x * x * slope + 2 * p1 * y + 6 * p2 * x, x * y * slope + 2 * p1 * x + 2 * p2 * y],
            [x * y * slope + 2 * p1 * x + 2 * p2 * y, radial + y * y * slope + 6 * p1 * y + 2 * p2 * x],
        ])  # fmt: skip
        at = self.distort(np.array([[x, y]]))[0]
        return np.vstack([np.column_stack([J, at - J @ (x, y)]), [0.0, 0.0, 1.0]])


def resize(grey: UInt8, width: int, height: int) -> UInt8:
    """The image in another size; the outer corners of its corner pixels stay where they are."""
    if grey.shape == (height, width):
        return grey
    how = cv2.INTER_CUBIC if width > grey.shape[1] else cv2.INTER_AREA
    return np.asarray(cv2.resize(grey, (width, height), interpolation=how), np.uint8)


def suppress(xy: Float, score: Float, distance_px: float | Float) -> NDArray[np.int64]:
    """Non-maximum suppression: indices of the points that have no better kept one within a distance.

    Parameters
    ----------
    xy : ndarray of shape (n, 2), px
    score : ndarray of shape (n,)
    distance_px : float or ndarray of shape (n,)
        Reach of a point, over worse ones.

    Returns
    -------
    ndarray of shape (k,), int64
        Best first; equal scores in order of x, then y.
    """
    order = np.lexsort((xy[:, 1], xy[:, 0], -score))
    reach = np.broadcast_to(np.asarray(distance_px, np.float64), score.shape)[order]
    kept = np.ones(len(order), bool)
    if len(order):
        pairs = cKDTree(xy[order]).query_pairs(reach.max(), output_type="ndarray")
        better, worse = pairs.min(axis=1), pairs.max(axis=1)  # order is from the best on
        near = np.hypot(*(xy[order[better]] - xy[order[worse]]).T) < reach[better]
        by_rank = np.flatnonzero(near)[np.argsort(better[near], kind="stable")]
        for one, other in zip(better[by_rank].tolist(), worse[by_rank].tolist(), strict=True):
            if kept[one]:  # all that is better than this one has been seen
                kept[other] = False
    return order[kept]
