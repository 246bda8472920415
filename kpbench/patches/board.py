"""Boards: patches at known places in mm, built in (hexagon, grid) or from TOML.

Board frame: mm, x right, y down, z away from the viewer, the origin is the board's centre
(:mod:`kpbench.geometry.homography`). ``Board.points_mm`` goes into ``cv2.solvePnP`` as it is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from kpbench.errors import DesignError
from kpbench.files import read_toml
from kpbench.geometry.homography import project
from kpbench.geometry.outline import cos_sin_deg
from kpbench.patches.design import Patch, load_patches, shipped_patches, unit_polygons
from kpbench.types import Float

TOML_SCHEMA = "kpbench.board-design/1"
HEXAGON_DIAMETER = 0.16  # of the board's side, from the paper's 16-px patch on a board of 0.5 % of the image
HEXAGON_CIRCUMRADIUS = 0.36
GRID_PITCH = 2.0  # disc diameters


class CameraKeypoint(Protocol):
    """A point on a board and the disc that is its measure, which a patch fills."""

    @property
    def patch_id(self) -> int:
        """The identity that detectors report."""
        ...

    @property
    def H_patch2board(self) -> Float:
        """Unit disc to mm of the board frame, ndarray of shape (3, 3)."""
        ...


class CameraBoard(Protocol):
    """What :mod:`kpbench.render` needs of a board: a :class:`Board`, or a :class:`kpbench.patches.TagBoard`."""

    @property
    def side_x_mm(self) -> float:
        """Width."""
        ...

    @property
    def side_y_mm(self) -> float:
        """Height."""
        ...

    @property
    def keypoints(self) -> Sequence[CameraKeypoint]:
        """In the order of their truth."""
        ...

    def outlines(self, radius_px: Float) -> tuple[list[list[Float]], list[list[Float]]]:
        """See :meth:`Board.outlines`."""
        ...


@dataclass(frozen=True)
class BoardKeypoint:
    """One patch on a board: centre in mm of the board frame, turn from +x towards +y, disc diameter in mm."""

    patch: Patch
    x_mm: float
    y_mm: float
    rotate_deg: float
    diameter_mm: float

    @property
    def patch_id(self) -> int:
        """The identity that detectors report."""
        return self.patch.patch_id

    @property
    def extent_mm(self) -> float:
        """Radius of all that belongs to the patch, rim and quiet zone included."""
        return self.patch.extent * self.diameter_mm / 2

    @property
    def H_patch2board(self) -> Float:
        """Unit disc to mm of the board frame, ndarray of shape (3, 3)."""
        c, s = (self.diameter_mm / 2 * v for v in cos_sin_deg(self.rotate_deg))
        return np.array([[c, -s, self.x_mm], [s, c, self.y_mm], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Board:
    """A rectangle with patches on it.

    Raises
    ------
    DesignError
        If it has no keypoint, a patch reaches over its edge, two patches overlap, or two different
        designs share an id.
    """

    name: str
    side_x_mm: float
    side_y_mm: float
    keypoints: tuple[BoardKeypoint, ...]

    def __post_init__(self) -> None:
        if not self.keypoints:
            raise DesignError(f"board {self.name!r} has no keypoints, expected at least one")
        slack = 1e-6  # mm: patches that touch are fine whatever the rounding
        x, y, extent = np.array([(k.x_mm, k.y_mm, k.extent_mm) for k in self.keypoints]).T
        for n in range(len(x) - 1):
            gap = np.hypot(x[n + 1 :] - x[n], y[n + 1 :] - y[n]) - extent[n + 1 :] - extent[n]
            if gap.min() < -slack:
                m = n + 1 + int(gap.argmin())
                raise DesignError(
                    f"board {self.name!r}: keypoints {n} and {m} overlap by {-gap.min():.3g} mm, rims and quiet zones "
                    "included"
                )
        over = np.maximum(abs(x) - self.side_x_mm / 2, abs(y) - self.side_y_mm / 2) + extent
        if over.max() > slack:
            n = int(over.argmax())
            raise DesignError(
                f"board {self.name!r}: keypoint {n} at ({x[n]:g}, {y[n]:g}) mm reaches {over[n]:.3g} mm over "
                f"the edge of the {self.side_x_mm:g} x {self.side_y_mm:g} mm board"
            )
        seen: dict[int, Patch] = {}
        for k in self.keypoints:
            if seen.setdefault(k.patch.patch_id, k.patch).digest != k.patch.digest:
                raise DesignError(f"board {self.name!r}: two designs share the id {k.patch.patch_id}")

    @property
    def patches(self) -> tuple[Patch, ...]:
        """The designs on the board, each once, in order of their ids."""
        return tuple(p for _, p in sorted({k.patch.patch_id: k.patch for k in self.keypoints}.items()))

    @property
    def points_mm(self) -> Float:
        """Keypoints in the board frame, ndarray of shape (N, 3) with z = 0."""
        return np.array([[k.x_mm, k.y_mm, 0.0] for k in self.keypoints])

    def outlines(self, radius_px: Float) -> tuple[list[list[Float]], list[list[Float]]]:
        """Outlines as polygons of shape (N, 2) in mm: those of each part of the black ink, and of each keypoint's disc.

        Parts do not overlap. Curves are true to a thousandth of a pixel where the radius of keypoint n is
        ``radius_px[n]``.
        """
        parts, discs = [], []
        for k, radius in zip(self.keypoints, radius_px, strict=True):
            # the tolerance is rounded to a power of two so that polygons are reused
            black, disc = unit_polygons(k.patch, 2.0 ** np.floor(np.log2(1e-3 / radius)))
            parts.append([project(k.H_patch2board, polygon) for polygon in black])
            discs.append([project(k.H_patch2board, polygon) for polygon in disc])
        return parts, discs

    @property
    def digest(self) -> str:
        """SHA-256 of what is printed and where, to 1 nm; the name does not count."""
        lengths: list[tuple[float, ...]] = [(self.side_x_mm, self.side_y_mm)]
        lengths += [(k.x_mm, k.y_mm, k.rotate_deg, k.diameter_mm) for k in self.keypoints]
        patches = [(k.patch.patch_id, k.patch.digest) for k in self.keypoints]
        content = ([[round(v, 6) + 0.0 for v in row] for row in lengths], patches)
        return hashlib.sha256(repr(content).encode()).hexdigest()


def hexagon_board(patch: Patch, side_mm: float) -> Board:
    """The paper's board: six identical patches on a regular hexagon, the first on the right, then clockwise.

    On a square of side S the discs have a diameter of 0.16 S and their centres a circumradius of 0.36 S.

    Raises
    ------
    DesignError
        If the patch's rim and quiet zone are so wide that patches overlap.
    """
    turns = [cos_sin_deg(60.0 * n) for n in range(6)]
    radius, diameter = HEXAGON_CIRCUMRADIUS * side_mm, HEXAGON_DIAMETER * side_mm
    keypoints = tuple(BoardKeypoint(patch, radius * c, radius * s, 0.0, diameter) for c, s in turns)
    return Board(f"hexagon-{patch.name}", side_mm, side_mm, keypoints)


def grid_board(
    patches: Sequence[Patch], rows: int, columns: int, diameter_mm: float, pitch_mm: float, name: str = "grid"
) -> Board:
    """Patches in rows and columns, row by row from the top left.

    The patch in row r and column c is design ``(r + c) % len(patches)``, so that neighbours differ.
    The board is ``columns * pitch_mm`` wide and ``rows * pitch_mm`` high.

    Raises
    ------
    DesignError
        If the patches overlap.
    """
    keypoints = tuple(
        BoardKeypoint(
            patches[(row + column) % len(patches)],
            (column - (columns - 1) / 2) * pitch_mm,
            (row - (rows - 1) / 2) * pitch_mm,
            0.0,
            diameter_mm,
        )
        for row in range(rows)
        for column in range(columns)
    )
    return Board(name, columns * pitch_mm, rows * pitch_mm, keypoints)


def find_patch(patches: Sequence[Patch], key: object) -> Patch:
    """The design with this name or id.

    Raises
    ------
    DesignError
        If there is none, or if a name is carried by two.
    """
    found = [p for p in patches if key in (p.name, p.patch_id, str(p.patch_id)) and not isinstance(key, bool)]
    if len(found) != 1:
        known = ", ".join(f"{p.name} ({p.patch_id})" for p in patches)
        raise DesignError(f"patch {key!r} is {'carried by two designs' if found else 'not known'}; known are: {known}")
    return found[0]


def load_board(path: str | Path, patches: Sequence[Patch] | None = None, diameter_mm: float | None = None) -> Board:
    """Read a board from TOML: either a ``[grid]`` or a list of ``[[keypoint]]``.

    Parameters
    ----------
    path : path
    patches : sequence of Patch, optional
        Designs that the file may name. If left out: those of its own ``designs = [...]`` (paths
        relative to the file), else the shipped ones.
    diameter_mm : float, optional
        Disc diameter where the file sets none; 30 if left out.

    Raises
    ------
    DesignError
        One line that names the file, the key and what was expected.
    """
    path = Path(path)
    table = read_toml(path, DesignError)
    if "designs" in table:
        files = table["designs"]
        if not isinstance(files, list) or not files or not all(isinstance(f, str) for f in files):
            raise DesignError(f"{path}: designs is {files!r}, expected a list of file names")
        if patches is not None:
            raise DesignError(f"{path}: designs is set in the file, and others were given; drop one of them")
        patches = load_patches([path.parent / f for f in files])
    try:
        return parse_board(table, shipped_patches() if patches is None else patches, path.stem, diameter_mm)
    except DesignError as error:
        raise DesignError(f"{path}: {error}") from None


def parse_board(table: Mapping[str, Any], patches: Sequence[Patch], name: str, diameter_mm: float | None) -> Board:
    """Build a board from its TOML table, see :func:`load_board`."""
    keys(table, "the board", ("schema", "name", "designs", "size_mm", "diameter_mm", "grid", "keypoint"))
    if table.get("schema", TOML_SCHEMA) != TOML_SCHEMA:
        raise DesignError(f"schema is {table['schema']!r}, expected {TOML_SCHEMA!r}")
    name = table.get("name", name)
    if not isinstance(name, str) or not name:
        raise DesignError(f"name is {name!r}, expected a non-empty text")
    if ("grid" in table) == ("keypoint" in table):
        raise DesignError("expected either one [grid] or [[keypoint]] entries")
    if "diameter_mm" in table:
        if diameter_mm is not None:
            raise DesignError(f"diameter_mm is set in the file, and {diameter_mm:g} was asked for; drop one of them")
        diameter_mm = number(table, "diameter_mm", 0.1, 5000.0)
    diameter = 30.0 if diameter_mm is None else diameter_mm
    if "grid" in table:
        board = _parse_grid(table["grid"], patches, diameter, name)
        keypoints, size = board.keypoints, [board.side_x_mm, board.side_y_mm]
    else:
        entries = table["keypoint"]
        if not isinstance(entries, list):
            raise DesignError(f"keypoint is {entries!r}, expected [[keypoint]] entries")
        keypoints = tuple(_parse_keypoint(e, f"keypoint[{n}]", patches, diameter) for n, e in enumerate(entries))
        size = [2 * max((abs(k.x_mm) + k.extent_mm for k in keypoints), default=0.0)]
        size += [2 * max((abs(k.y_mm) + k.extent_mm for k in keypoints), default=0.0)]
    if "size_mm" in table:
        given = table["size_mm"]
        if not isinstance(given, list) or len(given) != 2:
            raise DesignError(f"size_mm is {given!r}, expected [width, height]")
        size = [number({f"size_mm[{n}]": v}, f"size_mm[{n}]", 1.0, 50_000.0) for n, v in enumerate(given)]
    return Board(name, size[0], size[1], keypoints)


def _parse_grid(entry: object, patches: Sequence[Patch], diameter_mm: float, name: str) -> Board:
    grid = keys(entry, "grid", ("rows", "columns", "pitch_mm", "patches"))
    rows, columns = (number(grid, key, 1, 100, "grid.") for key in ("rows", "columns"))
    if rows % 1 or columns % 1:
        raise DesignError(f"grid has {rows:g} rows and {columns:g} columns, expected whole numbers")
    pitch = number(grid, "pitch_mm", 0.1, 5000.0, "grid.") if "pitch_mm" in grid else GRID_PITCH * diameter_mm
    listed = grid.get("patches", [p.patch_id for p in patches])
    if not isinstance(listed, list) or not listed:
        raise DesignError(f"grid.patches is {listed!r}, expected a list of names or ids")
    return grid_board([find_patch(patches, key) for key in listed], int(rows), int(columns), diameter_mm, pitch, name)


def _parse_keypoint(entry: object, place: str, patches: Sequence[Patch], diameter_mm: float) -> BoardKeypoint:
    table = keys(entry, place, ("patch", "x_mm", "y_mm", "rotate_deg", "diameter_mm"))
    try:
        patch = find_patch(patches, table.get("patch"))
    except DesignError as error:
        raise DesignError(f"{place}: {error}") from None
    place += "."
    return BoardKeypoint(
        patch,
        number(table, "x_mm", -25_000.0, 25_000.0, place),
        number(table, "y_mm", -25_000.0, 25_000.0, place),
        number(table, "rotate_deg", -360.0, 360.0, place) if "rotate_deg" in table else 0.0,
        number(table, "diameter_mm", 0.1, 5000.0, place) if "diameter_mm" in table else diameter_mm,
    )


def keys(value: object, place: str, known: Sequence[str]) -> Mapping[str, Any]:
    """The value as a table that has known keys only, or a :class:`DesignError`."""
    if not isinstance(value, Mapping):
        raise DesignError(f"{place} is {value!r}, expected a table with: {', '.join(known)}")
    for name in value:
        if name not in known:
            raise DesignError(f"unknown key {name!r} in {place}; known are: {', '.join(known)}")
    return value


def number(table: Mapping[str, Any], key: str, low: float, high: float, place: str = "") -> float:
    """The number under a key, or a :class:`DesignError`."""
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise DesignError(f"{place}{key} is {value!r}, expected a number from {low:g} to {high:g}")
    return float(value)
