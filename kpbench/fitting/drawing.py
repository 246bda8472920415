"""Draw designs for the fit: exact coverage by black ink, blur and tone curve, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np

from kpbench.geometry.coverage import Box, rasterise_with_derivatives
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, Int

MODEL_REACH = 1.3
"""The model draws the outermost ring up to this many times its outer radius. The blurred outer edge of the model then
lies outside the patch."""
SIDE_PARTS = 4
"""Number of straight parts of the side of a cell, which a lens bends."""


def move_cells(
    xy: Float, A: Float, bend: Float, gain: float, lens: Float, patch: Patch
) -> tuple[Float, Float, Float, Float]:
    """Return the edges of the black cells of a design in the image.

    Parameters
    ----------
    xy, A : ndarray of shape (2,) and (2, 2)
        Pose, px.
    bend : ndarray of shape (2,)
        First two entries of the last row of the homography.
    gain : float
        Ink gain, disc radii.
    lens : ndarray of shape (2,)
        A point at the distance r px from the centre moves by this times r².
    patch : Patch

    Returns
    -------
    start, end : ndarray of shape (N, 2)
        px. Outer polygons run from x to y, unless ``A`` mirrors.
    move : ndarray of shape (N, 2)
        Derivative of the edges' places with respect to the ink gain, px per disc radius.
    sign : ndarray of shape (N,)
        -1 if ``A`` mirrors, else 1.
    """
    radius = max(float(np.abs(A).max()), 1.0)
    corners, outward, following = black_cells(patch, 2.0 ** np.floor(np.log2(0.02 / radius)))
    inked = corners + gain * outward
    nearness = 1 / (1 + inked @ bend)[:, None]
    seen, move = inked @ A.T * nearness, outward @ A.T * nearness
    start = xy + seen + (seen * seen).sum(axis=1)[:, None] * lens
    (a, b), (c, d) = A.tolist()
    sign = np.full(len(start), 1.0 if a * d > b * c else -1.0)
    return start, start[following], (move + move[following]) / 2, sign


def draw_black_cells(edges: Sequence[tuple[Float, Float, Float, Float]], boxes: Sequence[Box]) -> list[Float32]:
    """Return the coverage by black ink, and its derivatives with respect to x, y and ink gain.

    Parameters
    ----------
    edges : sequence of tuple
        From :func:`move_cells`.
    boxes : sequence of (int, int, int, int)
        See :func:`kpbench.geometry.coverage.rasterise`.

    Returns
    -------
    list of ndarray of shape (4, height, width), float32
    """
    if not edges:
        return []
    start, end, move, sign = (np.concatenate(column).T for column in zip(*edges, strict=True))
    step = end - start
    gradients = sign * np.stack([step[1], -step[0], move[0] * step[1] - move[1] * step[0]])
    owner = np.repeat(np.arange(len(edges)), [len(part[0]) for part in edges])
    return [drawn.astype(np.float32) for drawn in rasterise_with_derivatives(start, end, owner, boxes, gradients)]


@lru_cache(maxsize=256)
def black_cells(patch: Patch, tolerance: float) -> tuple[Float, Float, Int]:
    """Return the black cells of a design as polygons in the patch frame, and how ink gain moves their vertices.

    The cells may stay separate: their coverages are added, so touching cells leave no seam. ``tolerance`` is the
    largest distance between an arc and its polygon, in disc radii. Edges between black and white move outwards by the
    ink gain, and the corners move with their edges.
    """
    radii, angles, black = patch.cells
    radii = np.append(radii[:-1], radii[-1] * MODEL_REACH)
    width = np.diff(np.append(angles, angles[0] + 360.0))
    inside, outside = np.vstack([black[:1], black[:-1]]), np.vstack([black[1:], black[-1:]])
    polygons = []
    for i, j in zip(*np.nonzero(black), strict=True):
        count = int(np.ceil(np.radians(width[j]) / np.sqrt(8 * tolerance / radii[i + 1]))) + 1
        angle = np.radians(angles[j] + width[j] * np.linspace(0, 1, count + 1))
        arc = np.column_stack([np.cos(angle), np.sin(angle)])
        first = (not black[i, j - 1]) * np.array([arc[0, 1], -arc[0, 0]])
        last = (not black[i, (j + 1) % len(angles)]) * np.array([-arc[-1, 1], arc[-1, 0]])
        ends = np.zeros_like(arc)
        ends[0], ends[-1] = first, last
        along = np.linspace(radii[i], radii[i + 1], SIDE_PARTS + 1)[1:-1, None]
        if radii[i]:
            inner, moved = radii[i] * arc[::-1], ends[::-1] - (not inside[i, j]) * arc[::-1]
        else:
            inner, moved = np.zeros((1, 2)), ((first + last) / max(1 + float(first @ last), 0.05))[None]
        sides = [radii[i + 1] * arc, along[::-1] * arc[-1], inner, along * arc[0]]
        of_sides = (np.tile(normal, (len(along), 1)) for normal in (last, first))
        moves = [ends + (not outside[i, j]) * arc, next(of_sides), moved, next(of_sides)]
        polygons.append((np.concatenate(sides), np.concatenate(moves)))
    corners, outward = ([polygon[n] for polygon in polygons] for n in (0, 1))
    first = np.cumsum([0, *map(len, corners)])
    following = [np.roll(np.arange(len(c)), -1) + n for c, n in zip(corners, first, strict=False)]
    return np.concatenate(corners), np.concatenate(outward), np.concatenate(following)


def blur_derivatives(ink: Float32) -> tuple[Float32, Float32, Float32]:
    """Return the derivatives of blurred ink with respect to the blur's variance and the two of its unevenness.

    A Gaussian blur solves the heat equation, so they are half of the second derivatives of the ink.
    """
    xx, yy = (cv2.Sobel(ink, cv2.CV_32F, *order, ksize=1, scale=0.5) for order in ((2, 0), (0, 2)))
    xy: Float32 = np.asarray(cv2.Sobel(ink, cv2.CV_32F, 1, 1, ksize=3, scale=0.25))
    return xx + yy, xx - yy, xy


def tone_curve(ink: Float32, a: float, b: float) -> Float32:
    """Return how black pixels look behind a tone curve.

    Light is blurred before a camera's tone curve. So a pixel that black ink covers by half is darker or brighter than
    the mean of the inks. Between the inks, the curve is ``ink + a ink (1 - ink) + b ink (1 - ink) (1 - 2 ink)``: any
    smooth curve that keeps both inks, to third order. Ink that spreads has nearly the same effect as ``a``.
    """
    return ink + ink * (1 - ink) * (np.float32(a + b) - np.float32(2 * b) * ink)


def tone_slopes(ink: Float32, a: float, b: float) -> tuple[Float32, Float32, Float32]:
    """Return the derivatives of :func:`tone_curve` with respect to ``ink``, ``a`` and ``b``."""
    even, bent = ink * (1 - ink), 1 - 2 * ink
    return 1 + np.float32(a) * bent + np.float32(b) * (1 - 6 * even), even, even * bent
