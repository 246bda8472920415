"""Images of board points under a camera, a pose and the shape of the print, with all derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from kpbench.calibration.shape import BentPoints
from kpbench.geometry.camera import Camera
from kpbench.geometry.lens import Lens
from kpbench.types import Float


class Projected(NamedTuple):
    """Images of n points, px, and their derivatives."""

    xy: Float
    """Of shape (n, 2)."""
    by_camera: Float
    """By fx, fy, cx, cy and the coefficients of the lens, of shape (n, 2, 4 + k)."""
    by_shape: Float
    """By the shape of the print, of shape (n, 2, 5)."""
    by_pose: Float
    """By a left-multiplied rotation vector, rad, and by the translation, mm, of shape (n, 2, 6)."""
    by_point: Float
    """By the point on the board as designed, of shape (n, 2, 2)."""


def project_points(camera: Camera, rotation: Float, translation_mm: Float, bent: BentPoints) -> Projected:
    """Project points of a bent sheet.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.calibration import PrintShape
    >>> from kpbench.calibration.projection import project_points
    >>> from kpbench.geometry import Camera
    >>> bent = PrintShape().bend(np.array([[10.0, 0.0]]))
    >>> project_points(Camera(640, 480, 500.0), np.eye(3), np.array([0.0, 0.0, 500.0]), bent).xy
    array([[329.5, 239.5]])
    """
    turned = bent.xyz @ rotation.T
    X, Y, Z = (turned + translation_mm).T
    Z = np.where(Z > 1e-6, Z, 1e-6)
    rays = np.stack([X / Z, Y / Z], axis=1)
    n = len(rays)
    focal = np.array([camera.K[0, 0], camera.K[1, 1]])
    seen = camera.lens.distort(rays)
    ray_by_point = np.zeros((n, 2, 3))
    ray_by_point[:, 0, 0] = ray_by_point[:, 1, 1] = 1 / Z
    ray_by_point[:, :, 2] = -rays / Z[:, None]
    by_point = focal[:, None] * (camera.lens.jacobian(rays) @ ray_by_point)  # by the point in the camera frame
    cross = np.zeros((n, 3, 3))  # derivative of w x turned by w
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = turned[:, 2], -turned[:, 1], turned[:, 0]
    cross -= cross.transpose(0, 2, 1)
    by_camera = np.zeros((n, 2, 4 + len(camera.distortion)))
    by_camera[:, 0, 0], by_camera[:, 1, 1] = seen.T
    by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
    by_camera[:, :, 4:] = focal[:, None] * lens_derivatives(camera.lens, rays)
    on_sheet = by_point @ rotation
    return Projected(
        seen * focal + camera.K[:2, 2],
        by_camera,
        on_sheet @ bent.by_shape,
        np.concatenate([by_point @ cross, by_point], axis=2),
        on_sheet @ bent.by_point,
    )


def lens_derivatives(lens: Lens, rays: Float) -> Float:
    """Return the derivatives of the rays that the sensor sees by the coefficients, ndarray of shape (n, 2, k)."""
    x, y = rays.T
    r2 = x * x + y * y
    if lens.model == "fisheye":
        r = np.sqrt(r2)
        angle = np.arctan(r)
        factor = np.where(r > 0, 1 / np.where(r > 0, r, 1.0), 0.0)
        powers = np.stack([angle ** (2 * k + 3) for k in range(4)], axis=1)
        return np.asarray(rays[:, :, None] * (factor[:, None] * powers)[:, None])
    k = len(lens.coefficients)
    c = np.zeros(12)
    c[:k] = lens.coefficients
    below = 1 + r2 * (c[5] + r2 * (c[6] + r2 * c[7]))
    radial = (1 + r2 * (c[0] + r2 * (c[1] + r2 * c[4]))) / below
    powers = np.stack([r2, r2**2, r2**3], axis=1)
    above, under = powers / below[:, None], -powers * (radial / below)[:, None]
    columns = np.zeros((len(rays), 2, 12))
    columns[:, :, [0, 1, 4]] = rays[:, :, None] * above[:, None]
    columns[:, :, [5, 6, 7]] = rays[:, :, None] * under[:, None]
    columns[:, 0, 2], columns[:, 1, 2] = 2 * x * y, r2 + 2 * y * y
    columns[:, 0, 3], columns[:, 1, 3] = r2 + 2 * x * x, 2 * x * y
    columns[:, 0, 8], columns[:, 0, 9] = r2, r2**2
    columns[:, 1, 10], columns[:, 1, 11] = r2, r2**2
    return np.asarray(columns[:, :, :k])


def camera_values(camera: Camera) -> Float:
    """Return fx, fy, cx, cy and the coefficients of the lens, ndarray of shape (4 + k,)."""
    K = camera.K
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *camera.distortion])


def with_values(camera: Camera, values: Float) -> Camera:
    """Return a camera with other values of :func:`camera_values`."""
    fx, fy, cx, cy, *coefficients = values.tolist()
    return replace(camera, focal_px=fx, focal_y_px=fy, principal_px=(cx, cy), distortion=tuple(coefficients))


def turn(vector: Float) -> Float:
    """Return the rotation of a rotation vector in rad, ndarray of shape (3, 3) (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K))
