"""A pinhole camera with a lens that distorts as OpenCV's models do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kpbench.errors import DataError
from kpbench.geometry.lens import Lens, LensModel
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
    """A pinhole camera with a lens.

    A point (X, Y, Z) of the camera frame has the ray (x, y) = (X / Z, Y / Z). :class:`kpbench.geometry.lens.Lens`
    describes how the lens moves the ray to (x', y'). The intrinsic matrix :attr:`K` then maps (x', y') to px.

    Attributes
    ----------
    width_px, height_px : int
        Size of the image.
    focal_px : float
        Focal length in px along x.
    distortion : tuple of float
        OpenCV's coefficients, see :class:`kpbench.geometry.lens.Lens`. For the model ``brown``, 0, 4, 5, 8 or 12
        numbers; all are zero for a camera without distortion. For the model ``fisheye``, 4 numbers.
    model : {"brown", "fisheye"}
        Model of the lens.
    principal_px : (float, float), optional
        The principal point, px. None: the centre of the image.
    focal_y_px : float, optional
        Focal length in px along y. None: the same as along x.

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
    distortion: tuple[float, ...] = NO_DISTORTION
    model: LensModel = "brown"
    principal_px: tuple[float, float] | None = None
    focal_y_px: float | None = None

    @property
    def K(self) -> Float:
        """Intrinsic matrix from the camera frame to px, ndarray of shape (3, 3)."""
        cx, cy = self.principal_px or ((self.width_px - 1) / 2, (self.height_px - 1) / 2)
        return np.array([[self.focal_px, 0, cx], [0, self.focal_y_px or self.focal_px, cy], [0, 0, 1]])

    @cached_property
    def _middle(self) -> Float:
        """The principal point, px."""
        return self.K[:2, 2]

    @cached_property
    def _focal(self) -> Any:
        """The focal length, or the focal lengths along x and y as ndarray of shape (2,)."""
        return self.focal_px if self.focal_y_px is None else np.array([self.focal_px, self.focal_y_px])

    @cached_property
    def lens(self) -> Lens:
        """The lens."""
        return Lens(self.model, self.distortion)

    @property
    def is_bent(self) -> bool:
        """Whether the lens bends straight lines."""
        return self.model == "fisheye" or any(self.distortion)

    def without_distortion(self) -> Camera:
        """Return the same camera with a lens that keeps straight lines straight."""
        return replace(self, distortion=NO_DISTORTION, model="brown")

    def at_size(self, width_px: int, height_px: int) -> Camera:
        """Return the same camera with images of another size: a whole-number multiple or fraction of its own.

        Raises
        ------
        DataError
            If the size is no whole-number multiple or fraction of the camera's.

        Examples
        --------
        >>> from kpbench.geometry import Camera
        >>> Camera(640, 480, 700.0).at_size(1280, 960).focal_px
        1400.0
        """
        scale, own = width_px / self.width_px, f"{self.width_px}x{self.height_px}"
        is_whole = float(scale).is_integer() or float(self.width_px / width_px).is_integer()
        if not is_whole or height_px != self.height_px * scale:
            raise DataError(
                f"the image has {width_px}x{height_px} px, expected the camera's {own} or a whole-number scale of it"
            )
        if scale == 1:
            return self
        x, y = ((self.K[:2, 2] + 0.5) * scale - 0.5).tolist()
        focal_y = None if self.focal_y_px is None else scale * self.focal_y_px
        return replace(
            self,
            width_px=width_px,
            height_px=height_px,
            focal_px=scale * self.focal_px,
            focal_y_px=focal_y,
            principal_px=(x, y),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the camera for the config of a dataset."""
        return {
            "model": self.model,
            "size_px": [self.width_px, self.height_px],
            "K": self.K.tolist(),
            "distortion": list(self.distortion),
        }

    def scaled(self, scale: float) -> Camera:
        """Return the same camera with an image of the same size that is magnified about the image's centre."""
        middle = np.array([(self.width_px - 1) / 2, (self.height_px - 1) / 2])
        x, y = (middle + scale * (self.K[:2, 2] - middle)).tolist()
        focal_y = None if self.focal_y_px is None else scale * self.focal_y_px
        return replace(self, focal_px=scale * self.focal_px, focal_y_px=focal_y, principal_px=(x, y))

    def project(self, points_camera: ArrayLike) -> Float:
        """Return the image points (N, 2), px, of points (N, 3) in the camera frame. Every z must be positive."""
        points = np.asarray(points_camera, np.float64)
        return self.distort(points[:, :2] / points[:, 2:])

    def distort(self, rays: Float) -> Float:
        """Return the image points (N, 2), px, of rays (x, y), shape (N, 2)."""
        return np.asarray(self._focal * self.lens.distort(rays) + self._middle)

    def undistort(self, points_px: ArrayLike) -> Float:
        """Return the rays (x, y), shape (N, 2), of image points (N, 2), px. The inverse of :meth:`distort`.

        Raises
        ------
        ValueError
            If a point lies outside the valid region of the lens, see :meth:`kpbench.geometry.lens.Lens.undistort`.
        """
        return self.lens.undistort((np.asarray(points_px, np.float64) - self.K[:2, 2]) / self._focal)

    def local_K(self, ray: ArrayLike) -> Float:
        """Return the matrix, shape (3, 3), that equals :meth:`distort` to first order near one ray.

        If the camera has no distortion, the matrix is ``K`` for every ray.
        """
        x, y = np.asarray(ray, np.float64)
        rays = np.array([[x, y]])
        J, point = self.K[[0, 1], [0, 1], None] * self.lens.jacobian(rays)[0], self.distort(rays)[0]
        return np.vstack([np.column_stack([J, point - (J[:, 0] * x + J[:, 1] * y)]), [0.0, 0.0, 1.0]])
