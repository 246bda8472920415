"""Outline of a design's black cells, as exact contours of straight lines and arcs.

A design is a polar chequer of rings and sectors, see :class:`kpbench.patches.Patch`. A *node* is a pair of indices
(radius, angle). All nodes at radius 0 are one node, the centre. The corners of a cell are nodes. A *border* of a cell
is a line or an arc from one corner to the next corner.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kpbench.geometry.outline import Arc, Contour, Line, Region, cos_sin_deg
from kpbench.types import Float

Node = tuple[int, int]
Border = tuple[Node, Node, str]
"""First node, last node, and a name such as ``line0,3`` or ``arc1,2``.

Borders with the same two nodes have different names."""


def trace_contours(radii: Float, angles: Float, black: NDArray[np.bool_]) -> Region:
    """Return the contours of the black cells, without the borders that two black cells share.

    Parameters
    ----------
    radii : ndarray of shape (R + 1,)
        Radii that bound the rings, ascending from 0.
    angles : ndarray of shape (A,)
        Angles that bound the sectors, in degrees, ascending in [0, 360).
    black : ndarray of shape (R, A), bool
        Whether each cell is black.
    """
    rings, sectors = black.shape
    width = np.diff(np.append(angles, angles[0] + 360.0))
    # The borders of every cell run around the cell in the same direction. Two black neighbours therefore add their
    # common border in opposite directions, and the two additions cancel.
    borders: dict[Border, float] = {}  # the value is the sweep of an arc in degrees, 0 for a line

    def add(start: Node, end: Node, kind: str, sweep: float) -> None:
        a = (start[0], 0) if start[0] == 0 else start
        b = (end[0], 0) if end[0] == 0 else end
        if borders.pop((b, a, kind), None) is None:
            borders[a, b, kind] = sweep

    if sectors == 1:  # whole rings have no straight borders
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


def _chain(borders: dict[Border, float], radii: Float, angles: Float) -> Region:
    """Join borders into closed contours: each border starts where the previous border ends."""
    leaving: dict[Node, list[Border]] = {}
    for border in borders:
        leaving.setdefault(border[0], []).append(border)
    contours = []
    while leaving:
        first = next(iter(leaving))
        chain: list[Border] = []
        node = first
        while True:
            choices = leaving[node]
            chain.append(choices.pop(_next_border(chain[-1], choices, angles) if chain else 0))
            if not choices:
                del leaving[node]
            node = chain[-1][1]
            if node == first:
                break
        contours.append(_merge([_segment(border, borders[border], radii, angles) for border in chain]))
    return tuple(contours)


def _next_border(arriving: Border, choices: list[Border], angles: Float) -> int:
    """Return the index of the border that continues the arriving border around the same ink.

    Several borders leave a node if black cells touch at this node only. At a node other than the centre, the contour of
    a cell turns from a line to an arc, or from an arc to a line. At the centre, the ink lies anticlockwise of the
    arriving line and clockwise of a leaving line, as seen on the patch. The line that leaves around the same ink is
    therefore the nearest line anticlockwise of the arriving line.
    """
    if arriving[1][0] != 0 or len(choices) == 1:
        return next((n for n, c in enumerate(choices) if c[2][:3] != arriving[2][:3]), 0)
    arrival_angle = angles[arriving[0][1]]
    return int(np.argmin([(arrival_angle - angles[c[1][1]] - 1e-9) % 360.0 for c in choices]))


def _segment(border: Border, sweep: float, radii: Float, angles: Float) -> Line | Arc:
    (i, j), (k, m), kind = border
    if kind.startswith("arc"):
        return Arc(0.0, 0.0, float(radii[i]), float(angles[j]), float(sweep))
    (c0, s0), (c1, s1) = cos_sin_deg(float(angles[j])), cos_sin_deg(float(angles[m]))
    near, far = float(radii[i]), float(radii[k])
    return Line(near * c0, near * s0, far * c1, far * s1)


def _merge(contour: list[Line | Arc]) -> Contour:
    """Join successive arcs that have the same radius and direction. Lines are not joined."""
    for _ in contour:  # rotate the contour until its first segment does not continue its last segment
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
