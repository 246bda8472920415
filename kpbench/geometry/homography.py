"""Homographies, the projection of discs to ellipses, and the pixel convention of the whole package.

Conventions
-----------
* Image frame: float64 px, x right, y down. The **centre** of the top-left pixel is (0, 0), as in OpenCV.
  Pixel (column j, row i) covers ``[j - 0.5, j + 0.5] x [i - 0.5, i + 0.5]``.
* Patch frame: the patch is the unit disc, u right, v down. Angles grow from +u towards +v, which is clockwise for a
  person who looks at the patch.
* Board frame: mm, x right, y down, z away from the viewer. The origin is the board's centre.
* Camera frame: x right, y down, z forward.
* ``H_a2b`` maps frame a to frame b.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpbench.portable import arctan2, matmul
from kpbench.types import Float


def project(H_a2b: Float, points_a: ArrayLike) -> Float:
    """Map points through a homography.

    Parameters
    ----------
    H_a2b : ndarray of shape (3, 3)
        Homography from frame a to frame b.
    points_a : array_like of shape (N, 2)
        Points in frame a.

    Returns
    -------
    ndarray of shape (N, 2), float64
        Points in frame b.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.geometry import project
    >>> H_patch2image = np.array([[20.0, 0.0, 100.0], [0.0, 10.0, 50.0], [0.0, 0.0, 1.0]])
    >>> project(H_patch2image, [[0.0, 0.0], [1.0, 0.0]])
    array([[100.,  50.],
           [120.,  50.]])
    """
    points = np.asarray(points_a, np.float64)
    mapped = points[:, :1] * H_a2b[:, 0] + points[:, 1:] * H_a2b[:, 1] + H_a2b[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


@dataclass(frozen=True)
class Ellipse:
    """An ellipse: centre and semi-axes in px; angle of the major axis in [0, 180) degrees, from +x towards +y."""

    x: float
    y: float
    major: float
    minor: float
    angle_deg: float


def project_discs(H_patch2image: Float) -> tuple[Float, Float, Float, Float]:
    """Return the ellipses to which homographies map the unit circle.

    The dual conic of the unit circle is ``C* = diag(1, 1, -1)``. Its image under H is ``H C* Hᵀ`` (Hartley and
    Zisserman, *Multiple View Geometry*, 2nd ed., eq. 2.17). The centre of the ellipse is the image of the disc's centre
    only if H is affine.

    Parameters
    ----------
    H_patch2image : ndarray of shape (N, 3, 3)
        Homographies from the unit disc to px.

    Returns
    -------
    centre : ndarray of shape (N, 2)
        Centres of the ellipses, px.
    major, minor : ndarray of shape (N,)
        Semi-axes, px.
    angle_deg : ndarray of shape (N,)
        Angles of the major axes from +x towards +y, in [0, 180) degrees.

    Notes
    -----
    All values of a disc are nan if the disc touches or crosses the camera's horizon. The image of the disc is then no
    ellipse.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.geometry import project_discs
    >>> H = np.array([[20.0, 0.0, 100.0], [0.0, 10.0, 50.0], [0.0, 0.0, 1.0]])
    >>> centre, major, minor, angle_deg = project_discs(H[None])
    >>> centre.tolist(), major.tolist(), minor.tolist(), angle_deg.tolist()
    ([[100.0, 50.0]], [20.0], [10.0], [0.0])
    """
    centre, xx, yy, xy = _project_axes(H_patch2image)
    return centre, *ellipse_axes(xx, yy, xy)


def project_disc_sizes(H_patch2image: Float) -> tuple[Float, Float, Float]:
    """Return the centres and the semi-axes of the ellipses of :func:`project_discs`, without their angles."""
    centre, xx, yy, xy = _project_axes(H_patch2image)
    return centre, *_semi_axes(xx, yy, xy)


def _project_axes(H_patch2image: Float) -> tuple[Float, Float, Float, Float]:
    """Return the centres of the ellipses, and the entries of the matrices for :func:`ellipse_axes`."""
    dual = _project_dual_conics(H_patch2image)
    x, y = dual[:, 0, 2], dual[:, 1, 2]
    return dual[:, :2, 2], x * x - dual[:, 0, 0], y * y - dual[:, 1, 1], x * y - dual[:, 0, 1]


def _semi_axes(xx: Float, yy: Float, xy: Float) -> tuple[Float, Float]:
    middle, spread = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    return np.sqrt(middle + spread), np.sqrt(np.maximum(middle - spread, 0.0))


def ellipse_axes(xx: Float, yy: Float, xy: Float) -> tuple[Float, Float, Float]:
    """Return semi-axes and angles of the ellipses ``dᵀ M⁻¹ d = 1``, d from the centre, M = [[xx, xy], [xy, yy]].

    Parameters
    ----------
    xx, yy, xy : ndarray of shape (N,)

    Returns
    -------
    major, minor : ndarray of shape (N,)
        Square roots of the eigenvalues of M.
    angle_deg : ndarray of shape (N,)
        Angles of the major axes from +x towards +y, in [0, 180) degrees.
    """
    return *_semi_axes(xx, yy, xy), np.degrees(arctan2(2 * xy, xx - yy) / 2) % 180.0


def project_disc_boxes(H_patch2image: Float) -> tuple[Float, Float]:
    """Return the bounding boxes of the ellipses of :func:`project_discs`.

    Parameters
    ----------
    H_patch2image : ndarray of shape (N, 3, 3)
        Homographies from the unit disc to px.

    Returns
    -------
    centre : ndarray of shape (N, 2)
        Centres of the ellipses, px.
    half_size : ndarray of shape (N, 2)
        Half widths and half heights of the boxes, px.
    """
    dual = _project_dual_conics(H_patch2image)
    centre = dual[:, :2, 2]
    return centre, np.sqrt(centre**2 - dual[:, (0, 1), (0, 1)])


def _project_dual_conics(H_patch2image: Float) -> Float:
    """Return the images of the unit circle's dual conic under homographies, each divided by its last entry."""
    dual = matmul(H_patch2image * (1.0, 1.0, -1.0), H_patch2image.transpose(0, 2, 1))
    last = dual[:, 2:, 2:]
    return np.asarray(np.divide(dual, last, out=np.full(dual.shape, np.nan), where=last < 0))


def project_disc(H_patch2image: Float) -> Ellipse:
    """Return the ellipse to which a homography maps the unit circle. See :func:`project_discs`.

    Raises
    ------
    ValueError
        If the disc touches or crosses the camera's horizon. The image of the disc is then no ellipse.
    """
    centre, major, minor, angle_deg = project_discs(H_patch2image[None])
    if np.isnan(major[0]):
        raise ValueError("the disc reaches the horizon of the camera: its image is not an ellipse")
    return Ellipse(float(centre[0, 0]), float(centre[0, 1]), float(major[0]), float(minor[0]), float(angle_deg[0]))
