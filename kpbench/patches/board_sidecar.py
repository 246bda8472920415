"""Read boards from their sidecars: the JSON files that are written beside every print."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kpbench.errors import DesignError
from kpbench.files import load_json, read_text
from kpbench.patches.board import Board, BoardKeypoint
from kpbench.patches.design import Patch, shipped_patches
from kpbench.patches.reference import CORNER_PLACES, REFERENCE_DICTIONARIES, REFERENCE_KIND, ReferenceMark
from kpbench.toml import TomlTable, name_source

BOARD_SCHEMA = "kpbench.board/1"
"""Name and version of the format of the sidecars of boards."""
LARGEST_MM = 100_000.0
LARGEST_CORNER_ERROR_MM = 1e-5
"""Largest deviation of the four corners of a mark from a rectangle: files hold lengths rounded to 1 nm."""


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
    content = load_sidecar_json(path)
    with name_source(path, DesignError):
        return _parse(content, (*shipped_patches(), *(patches or ())))


def load_sidecar_json(path: str | Path) -> dict[str, Any]:
    """Return the content of a sidecar as plain data.

    Raises
    ------
    DesignError
        If the file cannot be read, or is no JSON object.
    """
    text = read_text(path, DesignError)
    try:
        content = load_json(text)
    except ValueError as problem:
        raise DesignError(f"{path}: no sidecar of a board ({problem})") from None
    if not isinstance(content, dict):
        raise DesignError(f"{path}: no sidecar of a board, expected a JSON object")
    return content


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
    references = tuple(map(_parse_mark, _tables(table, "references"))) if "references" in table else ()
    is_field = "field" in table and table.flag("field")
    return Board(table.name(), side_x_mm, side_y_mm, tuple(keypoints), references, is_field)


def _parse_mark(entry: TomlTable) -> ReferenceMark:
    entry.choice("kind", (REFERENCE_KIND,))
    dictionary = entry.choice("dictionary", tuple(REFERENCE_DICTIONARIES))
    mark_id = entry.whole_number("id", 0, REFERENCE_DICTIONARIES[dictionary] - 1)
    try:
        corners = np.array(entry.values.get("corners_mm"), np.float64)
        (x, y), size = corners.mean(axis=0).tolist(), np.ptp(corners, axis=0) / np.ptp(CORNER_PLACES, axis=0)
        mark = ReferenceMark(dictionary, mark_id, x, y, float(size[0]), float(size[1]))
        fits = size.min() > 0 and np.abs(mark.corners_mm - corners).max() < LARGEST_CORNER_ERROR_MM
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise entry.problem("corners_mm", "four points [x, y] of a rectangle, clockwise from the top left")
    return mark


def _tables(table: TomlTable, key: str) -> list[TomlTable]:
    """Return the tables of a list, which may have any keys."""
    entries = table.entries(key, "a list of objects")
    keys = {name for entry in entries if isinstance(entry, dict) for name in entry}
    return table.tables(key, keys)
