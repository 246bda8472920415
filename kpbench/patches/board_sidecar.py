"""Read boards from their sidecars: the JSON files that are written beside every print."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kpbench.errors import DesignError
from kpbench.files import load_json, read_text
from kpbench.patches.board import Board, BoardKeypoint
from kpbench.patches.design import Patch, shipped_patches
from kpbench.toml import TomlTable, name_source

BOARD_SCHEMA = "kpbench.board/1"
"""Name and version of the format of the sidecars of boards."""
LARGEST_MM = 100_000.0


def read_board_sidecar(path: str | Path, patches: Sequence[Patch] | None = None) -> Board:
    """Read a board from its sidecar. Lengths are those of the sidecar, also after a print check.

    Parameters
    ----------
    path : str or Path
    patches : sequence of Patch, optional
        Designs of your own that the board may use, beside the shipped ones.

    Raises
    ------
    DesignError
        If the file cannot be read, is no sidecar of a board, or names a design that is not known.
    """
    text = read_text(path, DesignError)
    try:
        content = load_json(text)
    except ValueError as problem:
        raise DesignError(f"{path}: no sidecar of a board ({problem})") from None
    if not isinstance(content, dict):
        raise DesignError(f"{path}: no sidecar of a board, expected a JSON object")
    with name_source(path, DesignError):
        return _parse(content, (*shipped_patches(), *(patches or ())))


def _parse(content: dict[str, Any], patches: Sequence[Patch]) -> Board:
    table = TomlTable(content, content.keys(), DesignError)
    table.require_schema(BOARD_SCHEMA)
    known = {(patch.patch_id, patch.digest): patch for patch in patches}
    designs = dict[int, Patch]()
    for entry in _tables(table, "patches"):
        key = entry.whole_number("id", 0), entry.text("digest")
        if key not in known:
            name = entry.values.get("name")
            raise DesignError(f"{entry.place} is the design {name!r} with ID {key[0]}, which is not among `patches`")
        designs[key[0]] = known[key]
    keypoints = list[BoardKeypoint]()
    for entry in _tables(table, "keypoints"):
        patch_id = entry.whole_number("patch_id", 0)
        if patch_id not in designs:
            raise entry.problem("patch_id", f"one of the IDs in patches: {', '.join(map(str, designs))}")
        x_mm, y_mm = (entry.number(key, -LARGEST_MM, LARGEST_MM) for key in ("x_mm", "y_mm"))
        rotate_deg, diameter_mm = (
            entry.number("rotate_deg", -360.0, 360.0),
            entry.number("diameter_mm", 0.1, LARGEST_MM),
        )
        keypoints.append(BoardKeypoint(designs[patch_id], x_mm, y_mm, rotate_deg, diameter_mm))
    side_x_mm, side_y_mm = table.numbers("side_mm", 0.1, LARGEST_MM, 2)
    return Board(table.name(), side_x_mm, side_y_mm, tuple(keypoints))


def _tables(table: TomlTable, key: str) -> list[TomlTable]:
    """Return the tables of a list, which may have any keys."""
    entries = table.entries(key, "a list of objects")
    keys = {name for entry in entries if isinstance(entry, dict) for name in entry}
    return table.tables(key, keys)
