"""A pinhole camera with OpenCV's lens distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpbench.portable import cos_sin, matmul
from kpbench.types import Float


def rotation_xyz(x_deg: float, y_deg: float, z_deg: float) -> Float:
    """Return the rotation about the fixed axes z, then y, then x: ``Rx @ Ry @ Rz``, shape (3, 3)."""
    (cx, cy, cz), (sx, sy, sz) = cos_sin(np.radians([x_deg, y_deg, z_deg]))
    Rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    Ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    Rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return matmul(matmul(Rx, Ry), Rz)


def plane_to_camera(R_plane2camera: Float, t_camera: ArrayLike) -> Float:
    """Return the matrix ``[r1 r2 t]``, shape (3, 3), that maps (x, y, 1) on a plane to the camera frame."""
    return np.column_stack([R_plane2camera[:, :2], np.asarray(t_camera, np.float64)])


NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Camera:
    """A camera whose principal point is the centre of the image.

    A point (X, Y, Z) of the camera frame has the ray (x, y) = (X / Z, Y / Z). :meth:`distort` first applies the
    model of Brown (1966) in OpenCV's form to the ray, with ``r² = x² + y²``::

        x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)
        y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p2 x y + p1 (r² + 2 y²)

    The intrinsic matrix :attr:`K` then maps (x', y') to px.

    Attributes
    ----------
    width_px, height_px : int
        Size of the image.
    focal_px : float
        Focal length in px.
    distortion : tuple of 5 float
        OpenCV's (k1, k2, p1, p2, k3). All are zero for a camera without distortion.

    Examples
    --------
    >>> from kpbench.geometry import Camera
    >>> camera = Camera(width_px=640, height_px=480, focal_px=700.0)
    >>> camera.project([[0.0, 0.0, 2.0], [0.2, 0.0, 2.0]])
    array([[319.5, 239.5],
           [389.5, 239.5]])
    """

    width_px: int
    height_px: int
    focal_px: float
    distortion: tuple[float, float, float, float, float] = NO_DISTORTION

    @property
    def K(self) -> Float:
        """Intrinsic matrix from the camera frame to px, ndarray of shape (3, 3)."""
        cx, cy = (self.width_px - 1) / 2, (self.height_px - 1) / 2
        return np.array([[self.focal_px, 0, cx], [0, self.focal_px, cy], [0, 0, 1]])

    def project(self, points_camera: ArrayLike) -> Float:
        """Return the image points (N, 2), px, of points (N, 3) in the camera frame. Every z must be positive."""
        points = np.asarray(points_camera, np.float64)
        return self.distort(points[:, :2] / points[:, 2:])

    def distort(self, rays: Float) -> Float:
        """Return the image points (N, 2), px, of rays (x, y), shape (N, 2)."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = np.asarray(rays, np.float64).T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.asarray(self.focal_px * np.column_stack([xd, yd]) + self.K[:2, 2])

    def local_K(self, ray: ArrayLike) -> Float:
        """Return the matrix, shape (3, 3), that equals :meth:`distort` to first order near one ray.

        If the camera has no distortion, the matrix is ``K`` for every ray.
        """
        k1, k2, p1, p2, k3 = self.distortion
        x, y = np.asarray(ray, np.float64)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / dx is x * slope, d radial / dy is y * slope
        J = self.focal_px * np.array([
            [radial + x * x * slope + 2 * p1 * y + 6 * p2 * x, x * y * slope + 2 * p1 * x + 2 * p2 * y],
            [x * y * slope + 2 * p1 * x + 2 * p2 * y, radial + y * y * slope + 6 * p1 * y + 2 * p2 * x],
        ])  # fmt: skip
        point = self.distort(np.array([[x, y]]))[0]
        return np.vstack([np.column_stack([J, point - (J[:, 0] * x + J[:, 1] * y)]), [0.0, 0.0, 1.0]])
