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

import numpy as np
from numpy.typing import ArrayLike

from kpbench.types import Float


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


@dataclass(frozen=True)
class Ellipse:
    """An ellipse in px: centre, semi-axes, and the angle of the major axis in [0, 180) degrees."""

    x: float
    y: float
    major: float
    minor: float
    angle_deg: float


def project_discs(H_patch2image: Float) -> tuple[Float, Float, Float, Float]:
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


def project_disc(H_patch2image: Float) -> Ellipse:
    """Image of the unit circle under one homography, see :func:`project_discs`.

    Raises
    ------
    ValueError
        If the disc touches or crosses the camera's horizon, so that its image is no ellipse.
    """
    centre, major, minor, angle_deg = project_discs(H_patch2image[None])
    if np.isnan(major[0]):
        raise ValueError("the disc reaches the horizon of the camera: its image is not an ellipse")
    return Ellipse(float(centre[0, 0]), float(centre[0, 1]), float(major[0]), float(minor[0]), float(angle_deg[0]))
