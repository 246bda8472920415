"""Read boards from files, or make them by name. A TOML file describes a grid of designs, or a list of keypoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from kpbench.errors import DesignError
from kpbench.patches.board import HEXAGON_DIAMETER, Board, BoardKeypoint, grid_board, hexagon_board
from kpbench.patches.board_sidecar import read_board_sidecar
from kpbench.patches.design import Patch, load_patches, shipped_patches
from kpbench.patches.field import FIELD_COLUMNS, FIELD_DIAMETER_MM, FIELD_ROWS, field_boards
from kpbench.patches.reference_boards import TRUTH_DIAMETER_MM, truth_board
from kpbench.text import did_you_mean
from kpbench.toml import TomlTable, name_source, read_toml

BOARD_FILE_SCHEMA = "kpbench.board-design/1"
BOARD_NAMES = ("hexagon", "grid", "truth", "field")
"""Boards that need no file."""
GRID_PITCH = 2.0  # default pitch of a grid, in disc diameters
DEFAULT_DIAMETER_MM = 30.0
BOARD_KEYS = ("schema", "name", "designs", "size_mm", "diameter_mm", "field", "grid", "keypoint")
GRID_KEYS = ("rows", "columns", "pitch_mm", "patches")
KEYPOINT_KEYS = ("patch", "x_mm", "y_mm", "rotate_deg", "diameter_mm")
SIZE_MM = (0.1, 5000.0)  # least and greatest diameter or pitch in a file
PLACE_MM = (-25_000.0, 25_000.0)  # least and greatest coordinate in a file


def find_patch(patches: Sequence[Patch], key: object) -> Patch:
    """Return the design that has a given name or id.

    Parameters
    ----------
    patches : sequence of Patch
    key : str or int
        Name or id. The id may be a number or a string.

    Raises
    ------
    DesignError
        If no design, or more than one design, has this name or id.

    Examples
    --------
    >>> from kpbench.patches import find_patch, shipped_patches
    >>> find_patch(shipped_patches(), "wheel").patch_id
    2
    """
    found = [p for p in patches if key in (p.name, p.patch_id, str(p.patch_id)) and not isinstance(key, bool)]
    if len(found) != 1:
        known = ", ".join(f"{p.name} ({p.patch_id})" for p in patches)
        problem = "the name or ID of several designs" if found else "not known"
        close = did_you_mean(str(key), [p.name for p in patches])
        raise DesignError(f"patch {key!r} is {problem}; known are: {known}{close}")
    return found[0]


def load_board(path: str | Path, patches: Sequence[Patch] | None = None, diameter_mm: float | None = None) -> Board:
    """Read a board from a TOML file, or from the JSON sidecar of its print.

    A TOML file has one ``[grid]``, or at least one ``[[keypoint]]``, and not both.

    Parameters
    ----------
    path : str or Path
    patches : sequence of Patch, optional
        Designs that the board may use. Default: the designs in the files that the key ``designs`` lists, with paths
        relative to the folder of the board's file. If the key is missing, the default is the shipped designs. A
        sidecar may always use the shipped designs.
    diameter_mm : float, optional
        Diameter of each disc whose diameter is not set in the file. Default: 30.

    Raises
    ------
    DesignError
        If the file cannot be read, has an unknown key or a wrong value, or describes an impossible board. If the
        sidecar names a design that is not known, or ``diameter_mm`` is given beside it. If ``designs`` or
        ``diameter_mm`` is set both in the file and by a parameter. The message names the file, the key and what was
        expected.

    Examples
    --------
    >>> from pathlib import Path
    >>> import kpbench
    >>> _ = Path("mine.toml").write_text("grid = { rows = 2, columns = 3 }")
    >>> board = kpbench.load_board("mine.toml", diameter_mm=20.0)
    >>> board.side_x_mm, board.side_y_mm
    (120.0, 80.0)
    """
    path = Path(path)
    if path.suffix.lower() == ".json":
        if diameter_mm is not None:
            raise DesignError(f"{path}: the sidecar sets all diameters; drop `diameter_mm`")
        return read_board_sidecar(path, patches)
    content = read_toml(path, DesignError)
    with name_source(path, DesignError):
        return parse_board(content, path, patches, diameter_mm)


def load_boards(
    name: str | Path,
    patches: Sequence[Patch] | None = None,
    diameter_mm: float | None = None,
    *,
    rows: int = FIELD_ROWS,
    columns: int = FIELD_COLUMNS,
    fields: int = 1,
) -> tuple[Board, ...]:
    """Return the boards of a name, or the board of a file.

    Parameters
    ----------
    name : str or Path
        "hexagon" for a hexagon board per design, "grid" for one grid of 4 rows and 3 columns, "truth" for
        :func:`kpbench.truth_board`, "field" for :func:`kpbench.field_boards`, or a file as for
        :func:`kpbench.load_board`.
    patches : sequence of Patch, optional
        Designs on the boards. Default: the shipped designs, or as in the file.
    diameter_mm : float, optional
        Diameter of the discs. Default: 30, or 24 for the truth board, 16 for a field, or as in the file.
    rows, columns : int
        Size of a field. Other boards ignore them.
    fields : int
        Number of fields, see :func:`kpbench.field_boards`. Other boards ignore it.

    Raises
    ------
    DesignError
        If there is no such file, or as raised by :func:`kpbench.load_board`.

    Examples
    --------
    >>> from kpbench.patches import load_boards
    >>> [board.name for board in load_boards("hexagon")]
    ['hexagon-checker', 'hexagon-trefoil', 'hexagon-wheel', 'hexagon-mushroom']
    """
    designs, diameter = patches or shipped_patches(), diameter_mm or DEFAULT_DIAMETER_MM
    if name == "hexagon":
        return tuple(hexagon_board(patch, diameter / HEXAGON_DIAMETER) for patch in designs)
    if name == "truth":
        return (truth_board(designs, diameter_mm or TRUTH_DIAMETER_MM),)
    if name == "field":
        return field_boards(designs, fields, rows, columns, diameter_mm or FIELD_DIAMETER_MM)
    if name == "grid":
        return (grid_board(designs, 4, 3, diameter, GRID_PITCH * diameter),)
    if not Path(name).is_file():
        problem = f"{name}: no such file, expected {', '.join(BOARD_NAMES)} or a board's file"
        raise DesignError(problem + did_you_mean(str(name), BOARD_NAMES))
    return (load_board(name, patches, diameter_mm),)


def parse_board(
    content: Mapping[str, Any], path: Path, patches: Sequence[Patch] | None, diameter_mm: float | None
) -> Board:
    """Return the board that the content of a TOML file describes. See :func:`load_board`."""
    table = TomlTable(content, BOARD_KEYS, DesignError)
    table.require_schema(BOARD_FILE_SCHEMA, optional=True)
    if "designs" in table:
        files = table.entries("designs", "a list of file names")
        if not all(isinstance(file, str) for file in files):
            raise table.problem("designs", "a list of file names")
        if patches is not None:
            raise DesignError("the file sets the key designs, and other designs are given; drop the key or the others")
        patches = load_patches([path.parent / file for file in files])
    elif patches is None:
        patches = shipped_patches()
    name = table.name() if "name" in table else path.stem
    if ("grid" in table) == ("keypoint" in table):
        raise DesignError("expected one [grid], or at least one [[keypoint]], and not both")
    if "diameter_mm" in table and diameter_mm is not None:
        given = f"and `diameter_mm` is {diameter_mm:g}; drop the key or `diameter_mm`"
        raise DesignError(f"the file sets the key diameter_mm, {given}")
    diameter = table.number("diameter_mm", *SIZE_MM, DEFAULT_DIAMETER_MM if diameter_mm is None else diameter_mm)
    if "grid" in table:
        board = _parse_grid(table.table("grid", GRID_KEYS), patches, diameter, name)
        keypoints, size = board.keypoints, (board.side_x_mm, board.side_y_mm)
    else:
        keypoints = tuple(_parse_keypoint(t, patches, diameter) for t in table.tables("keypoint", KEYPOINT_KEYS))
        size = (
            2 * max((abs(k.x_mm) + k.extent_mm for k in keypoints), default=0.0),
            2 * max((abs(k.y_mm) + k.extent_mm for k in keypoints), default=0.0),
        )
    if "size_mm" in table:
        width, height = table.numbers("size_mm", 1.0, 50_000.0, 2)
        size = (width, height)
    return Board(name, *size, keypoints, is_field="field" in table and table.flag("field"))


def _parse_grid(table: TomlTable, patches: Sequence[Patch], diameter_mm: float, name: str) -> Board:
    rows, columns = (table.whole_number(key, 1, 100) for key in ("rows", "columns"))
    pitch_mm = table.number("pitch_mm", *SIZE_MM, GRID_PITCH * diameter_mm)
    if "patches" in table:
        patches = [find_patch(patches, key) for key in table.entries("patches", "a list of names or ids")]
    return grid_board(patches, rows, columns, diameter_mm, pitch_mm, name)


def _parse_keypoint(table: TomlTable, patches: Sequence[Patch], diameter_mm: float) -> BoardKeypoint:
    with name_source(table.place, DesignError):
        patch = find_patch(patches, table.values.get("patch"))
    return BoardKeypoint(
        patch,
        table.number("x_mm", *PLACE_MM),
        table.number("y_mm", *PLACE_MM),
        table.number("rotate_deg", -360.0, 360.0, 0.0),
        table.number("diameter_mm", *SIZE_MM, diameter_mm),
    )
