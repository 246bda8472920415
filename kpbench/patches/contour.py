"""The outline of a design's black cells: exact contours of straight lines and arcs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.geometry.outline import Arc, Contour, Line, Region, cos_sin_deg
from kpbench.types import Float


def trace_contours(radii: Float, angles: Float, black: NDArray[np.bool_]) -> Region:
    """Contours of the black cells: all cell borders, less those that two black cells share."""
    rings, sectors = black.shape
    width = np.diff(np.append(angles, angles[0] + 360.0))
    # A node is (ring border, angle); all nodes at radius 0 are the centre. Borders run so that ink is
    # on the same side of each, hence one that two black cells share appears once in each direction.
    borders: dict[tuple[Any, Any, str], float] = {}

    def add(start: tuple[int, int], end: tuple[int, int], kind: str, sweep: float) -> None:
        a = (start[0], 0) if start[0] == 0 else start
        b = (end[0], 0) if end[0] == 0 else end
        if borders.pop((b, a, kind), None) is None:
            borders[a, b, kind] = sweep

    if sectors == 1:  # whole rings: nothing is straight
        contours: list[Contour] = []
        for i in range(rings):
            inner, outer = black[i - 1, 0] if i else black[i, 0], black[i, 0]
            if i and inner != outer:
                contours.append((Arc(0, 0, radii[i], 0.0, 360.0 if inner else -360.0),))
        if black[-1, 0]:
            contours.append((Arc(0, 0, radii[-1], 0.0, 360.0),))
        return tuple(contours)
    for i in range(rings):
        for j in range(sectors):
            if not black[i, j]:
                continue
            k = (j + 1) % sectors
            add((i + 1, j), (i + 1, k), f"arc{i + 1},{j}", width[j])
            add((i + 1, k), (i, k), f"line{i},{k}", 0.0)
            if i:
                add((i, k), (i, j), f"arc{i},{j}", -width[j])
            add((i, j), (i + 1, j), f"line{i},{j}", 0.0)
    return _chain(borders, radii, angles)


def _chain(borders: dict[tuple[Any, Any, str], float], radii: Float, angles: Float) -> Region:
    """Join directed borders end to start into closed contours."""
    leaving: dict[Any, list[tuple[Any, Any, str]]] = {}
    for key in borders:
        leaving.setdefault(key[0], []).append(key)
    contours = []
    while leaving:
        first = next(iter(leaving))
        chain: list[tuple[Any, Any, str]] = []
        node = first
        while True:
            choices = leaving[node]
            chain.append(choices.pop(_turn(chain[-1], choices, angles) if chain else 0))
            if not choices:
                del leaving[node]
            node = chain[-1][1]
            if node == first:
                break
        contours.append(_merge([_segment(key, borders[key], radii, angles) for key in chain]))
    return tuple(contours)


def _turn(arrived: tuple[Any, Any, str], choices: list[tuple[Any, Any, str]], angles: Float) -> int:
    """Which border to follow where black cells touch at a point: the one that stays on the same cell.

    At the centre, ink lies clockwise of a leaving edge and anticlockwise of an arriving one, so the
    same sector's leaving edge is the nearest one anticlockwise of the arriving edge.
    """
    if arrived[1][0] != 0 or len(choices) == 1:
        return next((n for n, c in enumerate(choices) if c[2][:3] != arrived[2][:3]), 0)
    came = angles[arrived[0][1]]
    return int(np.argmin([(came - angles[c[1][1]] - 1e-9) % 360.0 for c in choices]))


def _segment(key: tuple[Any, Any, str], sweep: float, radii: Float, angles: Float) -> Line | Arc:
    (i, j), (k, m), kind = key
    if kind.startswith("arc"):
        return Arc(0.0, 0.0, float(radii[i]), float(angles[j]), float(sweep))
    (c0, s0), (c1, s1) = cos_sin_deg(float(angles[j])), cos_sin_deg(float(angles[m]))
    near, far = float(radii[i]), float(radii[k])
    return Line(near * c0, near * s0, far * c1, far * s1)


def _merge(contour: list[Line | Arc]) -> Contour:
    """Join arcs that continue each other; a line through the centre keeps the centre as a vertex."""
    for _ in contour:  # start where a new arc starts, so that no arc is split by the contour's start
        if isinstance(contour[0], Arc) and isinstance(contour[-1], Arc) and _continues(contour[-1], contour[0]):
            contour = contour[1:] + contour[:1]
    merged: list[Line | Arc] = []
    for part in contour:
        last = merged[-1] if merged else None
        if isinstance(last, Arc) and isinstance(part, Arc) and _continues(last, part):
            merged[-1] = Arc(0.0, 0.0, last.radius, last.start_deg, last.sweep_deg + part.sweep_deg)
        else:
            merged.append(part)
    return tuple(merged)


def _continues(before: Arc, after: Arc) -> bool:
    return before.radius == after.radius and before.sweep_deg * after.sweep_deg > 0
