"""Outlines of grids of black and white modules."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from kpbench.geometry.outline import Line, Region
from kpbench.geometry.spread import spread

Modules = tuple[tuple[bool, ...], ...]
"""Whether each module of a grid is black, row by row."""


@lru_cache(maxsize=512)
def module_region(black: Modules, gain: float = 0.0) -> Region:
    """Return the outline of black modules whose edges all move outwards by ``gain``. Lengths are in modules.

    The origin is the top-left corner of the grid.

    Examples
    --------
    >>> from kpbench.patches.modules import module_region
    >>> len(module_region(((True, False), (False, True))))
    1
    """
    edges: dict[tuple[int, int], list[tuple[int, int]]] = {}  # end points of the edges, by their start points

    def add(start: tuple[int, int], end: tuple[int, int]) -> None:
        if start in edges.get(end, []):  # two black neighbours share this edge
            edges[end].remove(start)
        else:
            edges.setdefault(start, []).append(end)

    for y, x in np.argwhere(np.array(black)).tolist():
        corners = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)]
        for n in range(4):
            add(corners[n], corners[(n + 1) % 4])
    contours = []
    while start := next((point for point, ends in edges.items() if ends), None):
        points = [start]
        while (end := edges[points[-1]].pop()) != start:
            points.append(end)
        ends = [*points[1:], start]
        contours.append(tuple(Line(*map(float, (*a, *b))) for a, b in zip(points, ends, strict=True)))
    return spread(tuple(contours), gain)
