"""Boards with reference marks: the truth board, and a ring of marks around any board."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from kpbench.patches.board import Board, BoardKeypoint
from kpbench.patches.design import Patch
from kpbench.patches.reference import number_marks

TRUTH_DIAMETER_MM = 24.0
"""Diameter of the discs with which the truth board fits A4."""
MARK_SIDE = 17.6 / TRUTH_DIAMETER_MM
"""Side of a mark, in disc diameters."""
BORDER = 2.0 / TRUTH_DIAMETER_MM
"""White border around the outermost marks, in disc diameters."""
ZONE_X, ZONE_Y = 83.2 / TRUTH_DIAMETER_MM, 63.35 / TRUTH_DIAMETER_MM
"""Distances between the columns and between the rows of marks that divide the patches, in disc diameters."""
TRUTH_COLUMNS, TRUTH_ROWS = 2, 4
"""Patches of a truth board."""
STEPS_X, STEPS_Y = 4, 3
"""Marks per zone along a row and along a column."""
RING_GAP = 0.25
"""Distance between a board and the ring of marks around it, in disc diameters."""
RING_PITCH = 1.18
"""Least distance between neighbours of a ring, in sides of a mark."""


def truth_board(patches: Sequence[Patch], diameter_mm: float = TRUTH_DIAMETER_MM) -> Board:
    """Return the truth board: eight patches in zones that reference marks surround.

    Marks lie on three columns and five rows. No mark is nearer to a disc than 0.45 diameters. The pose of the board,
    and so the place of every patch, is known from the marks alone.

    Parameters
    ----------
    patches : sequence of Patch
        Designs in the order of their places, row by row. They are repeated.
    diameter_mm : float
        Diameter of the discs. All lengths grow with it.

    Examples
    --------
    >>> import kpbench
    >>> board = kpbench.truth_board(kpbench.shipped_patches())
    >>> len(board.keypoints), len(board.references), round(board.side_x_mm), round(board.side_y_mm)
    (8, 69, 188, 275)
    """
    d = diameter_mm
    keypoints = tuple(
        BoardKeypoint(
            patches[(TRUTH_COLUMNS * row + column) % len(patches)],
            (column - (TRUTH_COLUMNS - 1) / 2) * ZONE_X * d,
            (row - (TRUTH_ROWS - 1) / 2) * ZONE_Y * d,
            0.0,
            d / max(1.0, patches[(TRUTH_COLUMNS * row + column) % len(patches)].extent),
        )
        for row in range(TRUTH_ROWS)
        for column in range(TRUTH_COLUMNS)
    )
    columns, rows = TRUTH_COLUMNS * STEPS_X, TRUTH_ROWS * STEPS_Y
    centres = [
        ((i - columns / 2) * ZONE_X / STEPS_X * d, (j - rows / 2) * ZONE_Y / STEPS_Y * d)
        for j in range(rows + 1)
        for i in range(columns + 1)
        if i % STEPS_X == 0 or j % STEPS_Y == 0
    ]
    width, height = (
        (count * zone + MARK_SIDE + 2 * BORDER) * d for count, zone in ((TRUTH_COLUMNS, ZONE_X), (TRUTH_ROWS, ZONE_Y))
    )
    return Board("truth", width, height, keypoints, number_marks(centres, MARK_SIDE * d))


def with_reference(board: Board) -> Board:
    """Return a larger board: a board inside a ring of reference marks.

    Parameters
    ----------
    board : Board
        Without reference marks. A board that has some is returned unchanged.

    Examples
    --------
    >>> import kpbench
    >>> board = kpbench.with_reference(kpbench.hexagon_board(kpbench.shipped_patches()[1], side_mm=120.0))
    >>> board.name, len(board.references)
    ('hexagon-trefoil-reference', 32)
    """
    if board.references:
        return board
    d = max(keypoint.diameter_mm for keypoint in board.keypoints)
    side = MARK_SIDE * d
    width, height = (length + 2 * RING_GAP * d + side for length in (board.side_x_mm, board.side_y_mm))
    columns, rows = (max(1, math.floor(length / (RING_PITCH * side))) for length in (width, height))
    centres = [
        ((i / columns - 0.5) * width, (j / rows - 0.5) * height)
        for j in range(rows + 1)
        for i in range(columns + 1)
        if i in (0, columns) or j in (0, rows)
    ]
    frame = side + 2 * BORDER * d
    return replace(
        board,
        name=f"{board.name}-reference",
        side_x_mm=width + frame,
        side_y_mm=height + frame,
        references=number_marks(centres, side),
    )
