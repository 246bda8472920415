"""A board cut into page-sized tiles, along straight seams that pass between patches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from kpbench.errors import DesignError
from kpbench.patches.board import Board

SEAM_CLEARANCE = 1.0  # mm between a seam and any patch: what a careful cut with a knife needs


@dataclass(frozen=True)
class Tile:
    """One tile: its place in the tiling from 0, and its window in mm of the board frame."""

    row: int
    column: int
    x0: float
    x1: float
    y0: float
    y1: float

    @property
    def corners(self) -> list[tuple[float, float]]:
        """The window's corners in mm of the board frame: top left, top right, bottom left, bottom right."""
        return [(x, y) for y in (self.y0, self.y1) for x in (self.x0, self.x1)]

    def holds(self, x_mm: float, y_mm: float) -> bool:
        """Whether a point of the board lies in the window; a seam belongs to the tile after it."""
        return self.x0 <= x_mm < self.x1 and self.y0 <= y_mm < self.y1


def cut_into_tiles(board: Board, room_x_mm: float, room_y_mm: float) -> list[Tile]:
    """As few tiles of at most the given size as hold the board, row by row; one if it fits.

    Raises
    ------
    DesignError
        If no straight seam passes between the patches.
    """
    cuts = []
    for side, room, spans in (
        (board.side_x_mm, room_x_mm, [(k.x_mm - k.extent_mm, k.x_mm + k.extent_mm) for k in board.keypoints]),
        (board.side_y_mm, room_y_mm, [(k.y_mm - k.extent_mm, k.y_mm + k.extent_mm) for k in board.keypoints]),
    ):
        found = _seams(spans, side, room)
        if found is None:
            raise DesignError(
                f"board {board.name!r} cannot be tiled: no straight seam passes between its patches within the "
                f"{room:g} mm that a page holds; use a larger page or smaller patches"
            )
        cuts.append(found)
    xs, ys = cuts
    return [
        Tile(row, column, xs[column], xs[column + 1], ys[row], ys[row + 1])
        for row in range(len(ys) - 1)
        for column in range(len(xs) - 1)
    ]


def _seams(spans: Sequence[tuple[float, float]], side: float, room: float) -> list[float] | None:
    """Ends and seams along one axis: as few pieces of at most ``room`` as can be, cut amid the gaps."""
    blocked = sorted(((low - SEAM_CLEARANCE, high + SEAM_CLEARANCE) for low, high in spans), key=lambda b: -b[1])
    cuts = [-side / 2]
    while side / 2 - cuts[-1] > room + 1e-6:
        seam = cuts[-1] + room
        for low, high in blocked:  # from the far end inwards, so that one pass is enough
            if low < seam < high:
                seam = low
        if seam <= cuts[-1]:
            return None
        cuts.append(seam)
    cuts.append(side / 2)
    for n in range(1, len(cuts) - 1):  # every seam is as far along as it can be; most may step back
        before = max((high for _, high in blocked if high <= cuts[n]), default=-side / 2)
        after = min((low for low, _ in blocked if low >= cuts[n]), default=side / 2)
        cuts[n] = min(cuts[n], max((before + after) / 2, cuts[n + 1] - room))
    return cuts
