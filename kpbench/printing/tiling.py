"""Tiles: pieces of a board, cut along straight seams that pass between patches and marks. Each tile fits a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from kpbench.errors import DesignError
from kpbench.patches.board import Board

SEAM_CLEARANCE = 1.0  # mm: least distance between a seam and a patch, enough for a careful cut with a knife


@dataclass(frozen=True)
class Tile:
    """A tile: its row and column, counted from 0, and its window from (x0, y0) to (x1, y1) in mm of the board frame."""

    row: int
    column: int
    x0: float
    x1: float
    y0: float
    y1: float

    @property
    def corners(self) -> list[tuple[float, float]]:
        """Corners of the window in mm of the board frame: top left, top right, bottom left, bottom right."""
        return [(x, y) for y in (self.y0, self.y1) for x in (self.x0, self.x1)]

    def contains(self, x_mm: float, y_mm: float) -> bool:
        """Return whether a point lies in the window. A point on a seam lies in the tile to the right or below."""
        return self.x0 <= x_mm < self.x1 and self.y0 <= y_mm < self.y1


def cut_into_tiles(board: Board, width_mm: float, height_mm: float) -> list[Tile]:
    """Cut a board into as few tiles as possible, of at most the given size. Return the tiles row by row.

    Raises
    ------
    DesignError
        If no straight seam passes between the patches.
    """
    cuts = []
    across = [(k.x_mm, k.extent_mm) for k in board.keypoints] + [(m.x_mm, m.width_mm / 2) for m in board.references]
    down = [(k.y_mm, k.extent_mm) for k in board.keypoints] + [(m.y_mm, m.height_mm / 2) for m in board.references]
    for side, longest, places in ((board.side_x_mm, width_mm, across), (board.side_y_mm, height_mm, down)):
        spans = [(middle - extent, middle + extent) for middle, extent in places]
        found = _seams(spans, side, longest)
        if found is None:
            raise DesignError(
                f"board {board.name!r} cannot be tiled: no straight seam passes between its patches within the "
                f"{longest:g} mm that a page holds; use a larger page or smaller patches"
            )
        cuts.append(found)
    xs, ys = cuts
    return [
        Tile(row, column, xs[column], xs[column + 1], ys[row], ys[row + 1])
        for row in range(len(ys) - 1)
        for column in range(len(xs) - 1)
    ]


def _seams(spans: Sequence[tuple[float, float]], side: float, longest: float) -> list[float] | None:
    """Return the ends of the board and the seams along one axis, in ascending order.

    The seams divide the axis into as few pieces as possible, each at most ``longest`` mm long. ``spans`` holds the
    least and greatest coordinate of every patch along the axis. A seam lies in the middle of its gap between patches,
    unless a piece would become too long. Return None if no seam passes between the patches.
    """
    blocked = sorted(((low - SEAM_CLEARANCE, high + SEAM_CLEARANCE) for low, high in spans), key=lambda b: -b[1])
    cuts = [-side / 2]
    while side / 2 - cuts[-1] > longest + 1e-6:
        seam = cuts[-1] + longest
        for low, high in blocked:  # sorted by descending ends: one pass finds the seam
            if low < seam < high:
                seam = low
        if seam <= cuts[-1]:
            return None
        cuts.append(seam)
    cuts.append(side / 2)
    # so far every seam is as far from the start as possible; move the seams back to the middle of their gaps
    for n in range(1, len(cuts) - 1):
        before = max((high for _, high in blocked if high <= cuts[n]), default=-side / 2)
        after = min((low for low, _ in blocked if low >= cuts[n]), default=side / 2)
        cuts[n] = min(cuts[n], max((before + after) / 2, cuts[n + 1] - longest))
    return cuts
