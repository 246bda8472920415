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
from kpbench.geometry.homography import project
from kpbench.geometry.outline import cos_sin_deg
from kpbench.patches.design import Patch, load_patches, shipped_patches, unit_polygons
from kpbench.toml import TomlTable, name_source, read_toml
from kpbench.types import Float

TOML_SCHEMA = "kpbench.board-design/1"
HEXAGON_DIAMETER = 0.16  # of the board's side, from the paper's 16-px patch on a board of 0.5 % of the image
HEXAGON_CIRCUMRADIUS = 0.36
GRID_PITCH = 2.0  # disc diameters
DEFAULT_DIAMETER_MM = 30.0
BOARD_KEYS = ("schema", "name", "designs", "size_mm", "diameter_mm", "grid", "keypoint")
GRID_KEYS = ("rows", "columns", "pitch_mm", "patches")
KEYPOINT_KEYS = ("patch", "x_mm", "y_mm", "rotate_deg", "diameter_mm")
SIZE_MM = (0.1, 5000.0)  # least and most that a board's file may ask for, of diameters and pitches
PLACE_MM = (-25_000.0, 25_000.0)  # likewise, of coordinates


class BoardPoint(Protocol):
    """A point on a board and the disc that is its measure, which a patch fills."""

    @property
    def patch_id(self) -> int:
        """The identity that detectors report."""
        ...

    @property
    def H_patch2board(self) -> Float:
        """Unit disc to mm of the board frame, ndarray of shape (3, 3)."""
        ...


class BoardLike(Protocol):
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
    def keypoints(self) -> Sequence[BoardPoint]:
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
    content = read_toml(path, DesignError)
    with name_source(path, DesignError):
        return parse_board(content, path, patches, diameter_mm)


def parse_board(
    content: Mapping[str, Any], path: Path, patches: Sequence[Patch] | None, diameter_mm: float | None
) -> Board:
    """Build a board from the content of its TOML file, see :func:`load_board`."""
    table = TomlTable(content, BOARD_KEYS, DesignError)
    table.require_schema(TOML_SCHEMA, optional=True)
    if "designs" in table:
        files = table.entries("designs", "a list of file names")
        if not all(isinstance(file, str) for file in files):
            raise table.problem("designs", "a list of file names")
        if patches is not None:
            raise DesignError("designs is set in the file, and others were given; drop one of them")
        patches = load_patches([path.parent / file for file in files])
    elif patches is None:
        patches = shipped_patches()
    name = table.text("name", path.stem)
    if ("grid" in table) == ("keypoint" in table):
        raise DesignError("expected either one [grid] or [[keypoint]] entries")
    if "diameter_mm" in table and diameter_mm is not None:
        raise DesignError(f"diameter_mm is set in the file, and {diameter_mm:g} was asked for; drop one of them")
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
    return Board(name, *size, keypoints)


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
