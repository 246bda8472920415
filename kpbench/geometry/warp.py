"""Maps of points that bend straight lines: their first order at a point, and polygons that follow them.

A *point map* takes points of shape (N, 2) in one plane and returns their images, shape (N, 2), in another plane. A
homography, the lens, a bent sheet of paper, and any chain of them are point maps.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpbench.portable import matmul
from kpbench.types import Float

PointMap = Callable[[Float], Float]
"""A map from points of shape (N, 2) to points of shape (N, 2)."""
TOLERANCE_PX = 1e-3
"""Largest distance between a bent line and its chords, px."""
SHORTEST_PX = 2.0
"""Edges whose images are shorter are not divided, px. If the image of a straight line has a radius of curvature of
500 px, such an edge deviates from its chord by at most 1/1000 px."""
MOST_CHORDS = 400
"""Largest number of chords of one edge."""
_STENCIL = np.array([[-2.0, 0], [-1, 0], [1, 0], [2, 0], [0, -2], [0, -1], [0, 1], [0, 2]])
"""Points of the differences of :func:`linearise`, in steps."""


def linearise(point_map: PointMap, point: ArrayLike, step: float = 1e-3) -> tuple[Float, Float]:
    """Return the image of a point, and the derivative of the map at the point.

    The derivative is computed from four differences per coordinate (Fornberg, *Mathematics of Computation* 51, 1988,
    table 1). Its error is ``step ** 4 / 30`` times the map's fifth derivative.

    Parameters
    ----------
    point_map : callable
    point : array_like of shape (2,)
    step : float
        Step of the differences, in the unit of the point.

    Returns
    -------
    image : ndarray of shape (2,)
    J : ndarray of shape (2, 2)
        ``J[i, j]`` is the derivative of coordinate i of the image by coordinate j of the point.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.geometry.warp import linearise
    >>> image, J = linearise(lambda points: points**2, [3.0, 1.0])
    >>> image.tolist(), J.round(9).tolist()
    ([9.0, 1.0], [[6.0, 0.0], [0.0, 2.0]])
    """
    centre = np.asarray(point, np.float64)
    images = point_map(np.vstack([centre, centre + step * _STENCIL]))
    along = images[1:].reshape(2, 4, 2)  # coordinate of the point, step of -2 to 2, coordinate of the image
    J = (along[:, 0] - along[:, 3]) * (1 / 12) + (along[:, 2] - along[:, 1]) * (8 / 12)
    return images[0], J.T / step


def bend_homography(H: Float, point: ArrayLike, image: Float, J: Float) -> Float:
    """Return the homography that has a given image and a given derivative at one point.

    Of all such homographies, the result differs from ``H`` by an affine map of the image. It keeps the horizon of H.

    Parameters
    ----------
    H : ndarray of shape (3, 3)
    point : array_like of shape (2,)
    image : ndarray of shape (2,)
        Image of the point under the result.
    J : ndarray of shape (2, 2)
        Derivative of the result at the point.

    Returns
    -------
    ndarray of shape (3, 3)
        Its last entry is 1.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.geometry.warp import bend_homography
    >>> bend_homography(np.eye(3), [0, 0], np.array([5.0, 6.0]), np.array([[2.0, 0.0], [0.0, 3.0]])).tolist()
    [[2.0, 0.0, 5.0], [0.0, 3.0, 6.0], [0.0, 0.0, 1.0]]
    """
    x, y = np.asarray(point, np.float64)
    u, v, w = (H[:, 0] * x + H[:, 1] * y + H[:, 2]).tolist()
    (a, c), (b, d) = ((H[:2, k] * w - np.array([u, v]) * H[2, k]) / (w * w) for k in range(2))  # columns of dH
    inverse = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
    A = matmul(J, inverse)
    shift = image - (A[:, 0] * (u / w) + A[:, 1] * (v / w))
    affine = np.vstack([np.column_stack([A, shift]), [0.0, 0.0, 1.0]])
    bent = matmul(affine, H)
    return np.asarray(bent / bent[2, 2])


def subdivide(
    points: Float,
    next_vertex: NDArray[np.int64],
    point_map: PointMap,
    tolerance: float = TOLERANCE_PX,
    shortest: float = SHORTEST_PX,
) -> tuple[Float, NDArray[np.int64], NDArray[np.int64]]:
    """Add vertices to polygons, so that their images under a map follow the images of their edges.

    The images of three inner points of every edge tell how far the image of the edge bends from its chord. Chords of
    the n-th part of an edge deviate from a parabola by the n²-th part.

    Parameters
    ----------
    points : ndarray of shape (N, 2)
        Vertices of one or more polygons.
    next_vertex : ndarray of shape (N,), int64
        Index of the next vertex of the same polygon.
    point_map : callable
    tolerance : float
        Largest deviation, in the unit of the images.
    shortest : float
        Edges whose images are shorter than this stay undivided.

    Returns
    -------
    points : ndarray of shape (M, 2)
        Vertices of the new polygons. The vertices of an edge stand together, in the order of ``points``.
    next_vertex : ndarray of shape (M,), int64
    edge : ndarray of shape (M,), int64
        Index of the old edge on which the new edge lies.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.geometry.warp import subdivide
    >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    >>> finer, _, edge = subdivide(4 * square, np.array([1, 2, 3, 0]), lambda p: p + 0.01 * p[:, ::-1] ** 2)
    >>> len(finer), np.bincount(edge).tolist()
    (28, [7, 7, 7, 7])
    """
    start, step = point_map(points), points.take(next_vertex, axis=0) - points
    chord = start.take(next_vertex, axis=0) - start
    length = np.sqrt((chord * chord).sum(axis=1))
    count = np.ones(len(points), np.int64)
    if len(long_edges := np.flatnonzero(length > max(shortest, 0.0))):
        inner = [points[long_edges] + share * step[long_edges] for share in (0.25, 0.5, 0.75)]
        offset = point_map(np.concatenate(inner)).reshape(3, -1, 2) - start[long_edges]
        dx, dy = chord[long_edges].T
        aside = np.abs(offset[..., 0] * dy - offset[..., 1] * dx).max(axis=0) / length[long_edges]
        count[long_edges] = np.clip(np.ceil(np.sqrt(aside * (1 / tolerance))), 1, MOST_CHORDS)
    first = np.cumsum(count) - count
    edge = np.repeat(np.arange(len(points)), count)
    nth = np.arange(len(edge)) - first.take(edge)
    finer = points.take(edge, axis=0) + (nth / count.take(edge))[:, None] * step.take(edge, axis=0)
    following = np.arange(1, len(edge) + 1)
    following[first + count - 1] = first.take(next_vertex)
    return finer, following, edge


def join_polygons(polygons: list[Float]) -> tuple[Float, NDArray[np.int64]]:
    """Return the vertices of polygons as one array, and the index of the next vertex of each vertex.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.geometry.warp import join_polygons
    >>> points, next_vertex = join_polygons([np.zeros((3, 2)), np.zeros((4, 2))])
    >>> next_vertex.tolist()
    [1, 2, 0, 4, 5, 6, 3]
    """
    sizes = np.array([len(polygon) for polygon in polygons])
    last = np.cumsum(sizes) - 1
    next_vertex = np.arange(1, last[-1] + 2)
    next_vertex[last] = last - sizes + 1
    return np.concatenate(polygons), next_vertex


def remember_last(point_map: PointMap) -> PointMap:
    """Return a map that keeps its last result: a shutter asks for the same array of points at several times."""
    points, result = np.zeros((0, 2)), np.zeros((0, 2))

    def remember(given: Float) -> Float:
        nonlocal points, result
        if given is not points:
            points, result = given, point_map(given)
        return result

    return remember
