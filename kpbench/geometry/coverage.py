"""Exact area coverage of polygons on a pixel grid.

Every pixel gets the area of the polygon inside it, without sampling. Each edge is cut where it
crosses a pixel border; a piece adds its signed area to its own pixel and its height to all pixels
on its right, which one running sum along the rows spreads. The cost grows with the outline's
length, not with the area.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.types import Float

Box = tuple[int, int, int, int]
"""Columns and rows of a pixel rectangle: (x, y, width, height); may reach outside the image."""


def bounding_box(polygons: Sequence[Float]) -> Box:
    """The smallest box that :func:`rasterise` accepts for these polygons (a one-pixel margin)."""
    x, y = np.concatenate(list(polygons)).T
    left, top = math.floor(x.min() + 0.5) - 1, math.floor(y.min() + 0.5) - 1
    return left, top, math.floor(x.max() + 0.5) + 2 - left, math.floor(y.max() + 0.5) + 2 - top


def rasterise(regions: Sequence[Sequence[Float]], boxes: Sequence[Box]) -> list[Float]:
    """Rasterise several regions, each into a box of its own.

    Parameters
    ----------
    regions : sequence of sequences of ndarray of shape (N, 2)
        Polygons in px (pixel centres at integers). Within one region, holes run the other way round
        than outer borders; which way round the outer borders run does not matter.
    boxes : sequence of Box
        One a region, at least :func:`bounding_box` of it.

    Returns
    -------
    list of ndarray of shape (height, width), float64
        Covered fraction of each pixel, in [0, 1].
    """
    polygons = [polygon for region in regions for polygon in region]
    owner = np.repeat(np.arange(len(regions)), [sum(map(len, region)) for region in regions])
    if not len(owner):
        return [np.zeros((h, w)) for _, _, w, h in boxes]
    ends = [np.concatenate([polygon[1:], polygon[:1]]) for polygon in polygons]  # a fifth of np.roll's time
    return rasterise_edges(np.concatenate(polygons).T, np.concatenate(ends).T, owner, boxes)


def rasterise_edges(start: Float, end: Float, owner: NDArray[np.int64], boxes: Sequence[Box]) -> list[Float]:
    """:func:`rasterise` of regions given by their edges.

    Parameters
    ----------
    start, end : ndarray of shape (2, N), rows x and y, px
    owner : ndarray of shape (N,)
        The place in ``boxes`` of the region that an edge belongs to; the edges of each close up.
    boxes : sequence of Box
    """
    x, y, width, height = np.array(boxes, np.int64).reshape(-1, 4).T
    base = np.concatenate([[0], np.cumsum(width * height)])
    corner = np.stack([x - 0.5, y - 0.5])[:, owner]
    signed = _accumulate(start - corner, end - corner, base[owner], width[owner], int(base[-1]))
    # a region's running sum ends at zero, so one sum serves them all; abs, because outlines may run either way round
    covered = np.cumsum(signed)
    np.minimum(np.abs(covered, out=covered), 1.0, out=covered)
    return [covered[base[n] : base[n + 1]].reshape(h, w) for n, (_, _, w, h) in enumerate(boxes)]


def _accumulate(start: Float, end: Float, offset: NDArray[np.int64], stride: NDArray[np.int64], total: int) -> Float:
    """Signed area of every pixel, and height for those on its right, from edges in box pixels.

    Pixel i spans [i, i + 1). The running sum of the result along the rows is the coverage.
    """
    step = end - start
    # parts shorter than a pixel, which cross one border of a kind at most
    parts = np.maximum(np.abs(step[0]), np.abs(step[1])).astype(np.int64) + 1
    which = np.repeat(np.arange(len(parts)), parts)
    if len(which) > len(parts):
        nth = np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)
        step = step[:, which] / parts[which]
        start, offset, stride = start[:, which] + nth * step, offset[which], stride[which]
        end = start + step
    first, last = np.floor(start), np.floor(end)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = np.where(first != last, (np.maximum(first, last) - start) / step, 0.0)
    early, late = np.minimum(cut[0], cut[1]), np.maximum(cut[0], cut[1])
    # up to three pieces: to the first border, between the two, and on to the end, which every part has
    one, two = np.flatnonzero(early), np.flatnonzero(late > early)
    edge = np.concatenate([one, two, np.arange(len(late))])
    begin = np.concatenate([np.zeros(len(one)), early[two], late])
    share = np.concatenate([early[one], late[two], np.ones(len(late))]) - begin
    across = step[:, edge]
    middle = start[:, edge] + (begin + 0.5 * share) * across
    pixel = np.floor(middle)
    height = share * across[1]
    right = height * (middle[0] - pixel[0])
    index = (offset[edge] + pixel[1] * stride[edge] + pixel[0]).astype(np.int64)
    weights: Float = np.concatenate([height - right, right])
    return np.asarray(np.bincount(np.concatenate([index, index + 1]), weights, total + 1)[:total], np.float64)


def clip_to_image(box: Box, image: NDArray[Any]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of the image and of the box for the part of a box that lies in the image."""
    x, y, w, h = box
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + w, image.shape[1]), min(y + h, image.shape[0])
    x1, y1 = max(x0, x1), max(y0, y1)
    return (slice(y0, y1), slice(x0, x1)), (slice(y0 - y, y1 - y), slice(x0 - x, x1 - x))
