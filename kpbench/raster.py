"""Exact area coverage of polygons on a pixel grid.

Every pixel gets the area of the polygon inside it, without sampling. Each edge is cut where it
crosses a pixel border; a piece adds its signed area to its own pixel and its height to all pixels
on its right, which one running sum along the rows spreads. The cost grows with the outline's
length, not with the area.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kpbench.keypoints import Float

__all__ = ["Box", "box_around", "coverage"]

Box = tuple[int, int, int, int]
"""Columns and rows of a pixel rectangle: (x, y, width, height); may reach outside the image."""


def box_around(polygons: Sequence[Float]) -> Box:
    """The smallest box that :func:`coverage` accepts for these polygons (a one-pixel margin)."""
    points = np.concatenate(list(polygons))
    low = np.floor(points.min(axis=0) + 0.5).astype(int) - 1
    high = np.floor(points.max(axis=0) + 0.5).astype(int) + 2
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def coverage(regions: Sequence[Sequence[Float]], boxes: Sequence[Box]) -> list[Float]:
    """Rasterise several regions, each into a box of its own.

    Parameters
    ----------
    regions : sequence of sequences of ndarray of shape (N, 2)
        Polygons in px (pixel centres at integers). Within one region, holes run the other way round
        than outer borders; which way round the outer borders run does not matter.
    boxes : sequence of Box
        One a region, at least :func:`box_around` of it.

    Returns
    -------
    list of ndarray of shape (height, width), float64
        Covered fraction of each pixel, in [0, 1].
    """
    sizes = np.array([w * h for _, _, w, h in boxes], np.int64)
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    start, end, offset, stride = [], [], [], []
    for polygons, (x, y, width, _), base in zip(regions, boxes, offsets[:-1], strict=True):
        corner = np.array([x - 0.5, y - 0.5])
        for polygon in polygons:
            shifted = polygon - corner
            start.append(shifted)
            end.append(np.roll(shifted, -1, axis=0))
            offset.append(np.full(len(polygon), base, np.int64))
            stride.append(np.full(len(polygon), width, np.int64))
    if not start:
        return [np.zeros((h, w)) for _, _, w, h in boxes]
    flat = _accumulate(
        np.concatenate(start), np.concatenate(end), np.concatenate(offset), np.concatenate(stride), int(offsets[-1])
    )
    covered = []
    for (_, _, width, height), low, high in zip(boxes, offsets[:-1], offsets[1:], strict=True):
        area = flat[low:high]
        covered.append(np.clip(area if area.sum() >= 0 else -area, 0.0, 1.0).reshape(height, width))
    return covered


def _accumulate(start: Float, end: Float, offset: NDArray[np.int64], stride: NDArray[np.int64], total: int) -> Float:
    """Signed coverage of all pixels, flat, from edges given in box pixels (pixel i spans [i, i + 1))."""
    step = end - start
    edge = [np.arange(len(start))]
    cut = [np.zeros(len(start))]
    for axis in (0, 1):
        first, last = np.floor(start[:, axis]), np.floor(end[:, axis])
        count = np.abs(last - first).astype(np.int64)
        which = np.repeat(edge[0], count)
        nth = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        rising = step[which, axis] > 0
        border = np.where(rising, first[which] + 1 + nth, first[which] - nth)
        edge.append(which)
        cut.append((border - start[which, axis]) / step[which, axis])
    edges, t = np.concatenate(edge), np.concatenate(cut)
    order = np.lexsort((t, edges))
    edges, t = edges[order], t[order]
    t_end = np.append(t[1:], 1.0)
    t_end[np.append(edges[1:] != edges[:-1], True)] = 1.0
    a = start[edges] + t[:, None] * step[edges]
    height = (t_end - t) * step[edges, 1]
    middle = a + 0.5 * (t_end - t)[:, None] * step[edges]
    pixel = np.floor(middle).astype(np.int64)
    right = height * (middle[:, 0] - pixel[:, 0])
    index = offset[edges] + pixel[:, 1] * stride[edges] + pixel[:, 0]
    signed = np.bincount(index, height - right, total) + np.bincount(index + 1, right, total + 1)[:total]
    return np.cumsum(signed)
