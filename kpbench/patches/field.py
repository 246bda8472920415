"""Patch fields: boards on which every window of 3 x 3 patches tells its place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpbench.errors import DesignError
from kpbench.files import shipped_folder
from kpbench.patches.board import Board, BoardKeypoint
from kpbench.patches.design import Patch
from kpbench.types import Int

FIELD_ROWS, FIELD_COLUMNS, FIELD_DIAMETER_MM = 10, 7, 16.0
"""The default field, which fits A4."""
FIELD_PITCH = 1.5
"""Distance of neighbours, in diameters of a patch with its rim and quiet zone."""
LETTERS = 4
SHIPPED_DISTANCES = (5, 4, 3, 2)
"""Distances of the shipped fields."""


def shipped_field(distance: int) -> Int:
    """Return the shipped field whose 3 x 3 windows differ in at least ``distance`` letters, ndarray of shape (R, C).

    Letters are 0 to 3.

    Parameters
    ----------
    distance : int
        2, 3, 4 or 5.

    Raises
    ------
    DesignError
        If there is no such field.

    Examples
    --------
    >>> from kpbench.patches import shipped_field
    >>> shipped_field(4).shape
    (11, 8)
    """
    if distance not in SHIPPED_DISTANCES:
        raise DesignError(f"`distance` is {distance}, expected one of {', '.join(map(str, SHIPPED_DISTANCES))}")
    text = (shipped_folder("patches") / "fields" / f"3x3-distance-{distance}.txt").read_text()
    return np.array([[int(letter) for letter in line] for line in text.split()])


def field_board(
    patches: Sequence[Patch],
    rows: int = FIELD_ROWS,
    columns: int = FIELD_COLUMNS,
    diameter_mm: float = FIELD_DIAMETER_MM,
) -> Board:
    """Return a patch field: a board on which every window of 3 x 3 patches tells its place and its rotation.

    The letters are the top-left part of the shipped field of the greatest distance that is large enough, or of this
    field turned by a quarter.

    Parameters
    ----------
    patches : sequence of Patch
        Four designs, in the order of their letters.
    rows, columns : int
        At least 3 each.
    diameter_mm : float
        Diameter of the discs. Neighbours are 1.5 diameters apart.

    Raises
    ------
    DesignError
        If there are not four designs, or no shipped field is large enough.

    Examples
    --------
    >>> import kpbench
    >>> board = kpbench.field_board(kpbench.shipped_patches())
    >>> len(board.keypoints), board.side_x_mm, board.side_y_mm
    (70, 168.0, 240.0)
    """
    return field_boards(patches, 1, rows, columns, diameter_mm)[0]


def field_boards(
    patches: Sequence[Patch],
    count: int,
    rows: int = FIELD_ROWS,
    columns: int = FIELD_COLUMNS,
    diameter_mm: float = FIELD_DIAMETER_MM,
) -> tuple[Board, ...]:
    """Return patch fields that are told from each other: all windows of 3 x 3 patches of all of them differ.

    The letters are parts of one shipped field that do not overlap: of that of the greatest distance that is large
    enough, or of this field turned by a quarter.

    Parameters
    ----------
    patches : sequence of Patch
        Four designs, in the order of their letters.
    count : int
        Number of fields.
    rows, columns : int
        At least 3 each.
    diameter_mm : float
        Diameter of the discs.

    Returns
    -------
    tuple of Board
        Boards such as ``field-10x7-1``, or ``field-10x7`` if there is only one.

    Raises
    ------
    DesignError
        If there are not four designs, or no shipped field is large enough.

    Examples
    --------
    >>> import kpbench
    >>> [board.name for board in kpbench.field_boards(kpbench.shipped_patches(), count=2, rows=5, columns=5)]
    ['field-5x5-1', 'field-5x5-2']
    """
    if len(patches) != LETTERS:
        raise DesignError(f"a field needs {LETTERS} designs, found {len(patches)}")
    if min(rows, columns) < 3:
        raise DesignError(f"a field of {rows} rows and {columns} columns is too small, expected at least 3 of each")
    parts = _cut_parts(count, rows, columns)
    pitch_mm = FIELD_PITCH * diameter_mm * max(patch.extent for patch in patches)
    names = [f"field-{rows}x{columns}{f'-{n}' if count > 1 else ''}" for n in range(1, count + 1)]
    return tuple(
        _make_board(name, part, patches, pitch_mm, diameter_mm) for name, part in zip(names, parts, strict=True)
    )


def _cut_parts(count: int, rows: int, columns: int) -> list[Int]:
    """Return parts of a shipped field that do not overlap."""
    most = []
    for distance in SHIPPED_DISTANCES:
        letters = shipped_field(distance)
        for field in (letters, np.rot90(letters)):
            down, across = field.shape[0] // rows, field.shape[1] // columns
            if down * across >= count:
                corners = [(rows * (n // across), columns * (n % across)) for n in range(count)]
                return [field[top : top + rows, left : left + columns] for top, left in corners]
            most.append(down * across)
    if count == 1:
        size = " x ".join(map(str, letters.shape))
        raise DesignError(f"a field of {rows} rows and {columns} columns is too large, expected at most {size}")
    raise DesignError(f"there are {max(most)} fields of {rows} rows and {columns} columns, expected at least {count}")


def _make_board(name: str, letters: Int, patches: Sequence[Patch], pitch_mm: float, diameter_mm: float) -> Board:
    rows, columns = letters.shape
    keypoints = tuple(
        BoardKeypoint(
            patches[letter],
            (column - (columns - 1) / 2) * pitch_mm,
            (row - (rows - 1) / 2) * pitch_mm,
            0.0,
            diameter_mm,
        )
        for row, line in enumerate(letters.tolist())
        for column, letter in enumerate(line)
    )
    return Board(name, columns * pitch_mm, rows * pitch_mm, keypoints, is_field=True)
