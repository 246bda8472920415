"""Boards: patches at known places in mm, in particular hexagons and grids.

Board frame: mm, x right, y down, z away from the viewer. The origin is the board's centre. ``cv2.solvePnP`` takes
``Board.points_mm`` without conversion.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np

from kpbench.errors import DesignError
from kpbench.geometry.homography import project
from kpbench.geometry.outline import cos_sin_deg, flatten
from kpbench.geometry.spread import spread
from kpbench.patches.design import Patch, unit_polygons
from kpbench.patches.lattice import Lattice, find_lattice
from kpbench.patches.reference import TOUCHING_MM, ReferenceMark, check_references
from kpbench.types import Float, Int

# In the paper, a disc is 16 px wide if its board covers 0.5 % of a 1624 x 1240 px image. A square board then has a side
# of 100 px, so the diameter is 0.16 of the side.
HEXAGON_DIAMETER = 0.16  # disc diameter as a fraction of the side
HEXAGON_CIRCUMRADIUS = 0.36  # distance of the discs' centres from the board's centre, as a fraction of the side
SINGLE_DIAMETER = 0.92  # diameter of the one patch of a board, as a fraction of the side


class BoardPoint(Protocol):
    """A keypoint of a board, at the centre of a disc.

    The matching threshold is a fraction of the disc's size in the image. On a board of patches, the disc is the patch
    without rim and quiet zone.

    Examples
    --------
    >>> from kpbench.patches import BoardPoint, tag_board
    >>> point: BoardPoint = tag_board("aruco", side_mm=200.0).keypoints[0]
    >>> point.patch_id
    0
    """

    @property
    def patch_id(self) -> int:
        """Identity that detectors report."""
        ...

    @property
    def H_patch2board(self) -> Float:
        """Homography from the unit disc to mm of the board frame, ndarray of shape (3, 3)."""
        ...


class BoardLike(Protocol):
    """A board that can be rendered, such as :class:`Board` or :class:`kpbench.patches.TagBoard`.

    Examples
    --------
    >>> from kpbench.patches import BoardLike, hexagon_board, shipped_patches, tag_board
    >>> boards: list[BoardLike] = [hexagon_board(shipped_patches()[0], 200.0), tag_board("charuco", 200.0)]
    >>> [len(board.keypoints) for board in boards]
    [6, 6]
    """

    @property
    def side_x_mm(self) -> float:
        """Width of the board."""
        ...

    @property
    def side_y_mm(self) -> float:
        """Height of the board."""
        ...

    @property
    def keypoints(self) -> Sequence[BoardPoint]:
        """Keypoints, in the order of the ground truth."""
        ...

    def outlines(self, radius_px: Float, ink_gain: float = 0.0) -> tuple[list[list[Float]], list[list[Float]]]:
        """See :meth:`Board.outlines`."""
        ...


@dataclass(frozen=True)
class BoardKeypoint:
    """A patch on a board.

    Attributes
    ----------
    patch : Patch
    x_mm, y_mm : float
        Centre in the board frame.
    rotate_deg : float
        Rotation of the patch from +x towards +y.
    diameter_mm : float
        Diameter of the disc, without the rim and the quiet zone around the disc.

    Examples
    --------
    >>> from kpbench.patches import BoardKeypoint, shipped_patches
    >>> keypoint = BoardKeypoint(shipped_patches()[2], x_mm=40.0, y_mm=0.0, rotate_deg=90.0, diameter_mm=30.0)
    >>> keypoint.patch_id, keypoint.extent_mm
    (2, 15.0)
    """

    patch: Patch
    x_mm: float
    y_mm: float
    rotate_deg: float
    diameter_mm: float

    @property
    def patch_id(self) -> int:
        """Identity that detectors report."""
        return self.patch.patch_id

    @property
    def extent_mm(self) -> float:
        """Outer radius of the patch, rim and quiet zone included."""
        return self.patch.extent * self.diameter_mm / 2

    @property
    def H_patch2board(self) -> Float:
        """Homography from the unit disc to mm of the board frame, ndarray of shape (3, 3)."""
        c, s = (self.diameter_mm / 2 * v for v in cos_sin_deg(self.rotate_deg))
        return np.array([[c, -s, self.x_mm], [s, c, self.y_mm], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Board:
    """A rectangle with patches on it.

    Attributes
    ----------
    name : str
    side_x_mm, side_y_mm : float
        Width and height.
    keypoints : tuple of BoardKeypoint
        At least one keypoint.
    references : tuple of ReferenceMark
        Marks that tell the pose of the board without its patches.
    is_field : bool
        Whether the board is found as a field: by any window of 3 x 3 patches, see :func:`kpbench.field_board`.

    Raises
    ------
    DesignError
        If the board has no keypoint, a patch or a mark reaches over the edge of the board, two patches or marks
        overlap, two marks have one id, or two different designs share an id. If a field is no full square lattice, or
        two of its windows look the same in a rotation.

    Examples
    --------
    >>> import kpbench
    >>> board = kpbench.grid_board(kpbench.shipped_patches(), rows=2, columns=3, diameter_mm=20.0, pitch_mm=40.0)
    >>> board.points_mm[:2].tolist()
    [[-40.0, -20.0, 0.0], [0.0, -20.0, 0.0]]
    """

    name: str
    side_x_mm: float
    side_y_mm: float
    keypoints: tuple[BoardKeypoint, ...]
    references: tuple[ReferenceMark, ...] = ()
    is_field: bool = False

    def __post_init__(self) -> None:
        if not self.keypoints:
            raise DesignError(f"board {self.name!r} has no keypoints, expected at least one")
        x, y, extent = np.array([(k.x_mm, k.y_mm, k.extent_mm) for k in self.keypoints]).T
        for n in range(len(x) - 1):
            gap = np.hypot(x[n + 1 :] - x[n], y[n + 1 :] - y[n]) - extent[n + 1 :] - extent[n]
            if gap.min() < -TOUCHING_MM:
                m = n + 1 + int(gap.argmin())
                raise DesignError(
                    f"board {self.name!r}: keypoints {n} and {m} overlap by {-gap.min():.3g} mm, rims and quiet zones "
                    "included"
                )
        over = np.maximum(abs(x) - self.side_x_mm / 2, abs(y) - self.side_y_mm / 2) + extent
        if over.max() > TOUCHING_MM:
            n = int(over.argmax())
            raise DesignError(
                f"board {self.name!r}: keypoint {n} at ({x[n]:g}, {y[n]:g}) mm reaches {over[n]:.3g} mm over "
                f"the edge of the {self.side_x_mm:g} x {self.side_y_mm:g} mm board"
            )
        seen: dict[int, Patch] = {}
        for k in self.keypoints:
            if seen.setdefault(k.patch.patch_id, k.patch).digest != k.patch.digest:
                raise DesignError(f"board {self.name!r}: two designs share the id {k.patch.patch_id}")
        if self.is_field and self.lattice is None:
            raise DesignError(
                f"board {self.name!r} is no field: expected upright patches of one size on a full square lattice, and "
                "windows of 3 x 3 that all differ in all rotations"
            )
        side = np.array([self.side_x_mm, self.side_y_mm])
        check_references(self.name, self.references, side, np.stack([x, y], axis=1), extent)

    @property
    def patches(self) -> tuple[Patch, ...]:
        """Designs on the board, each design once, in the order of their ids."""
        return tuple(p for _, p in sorted({k.patch.patch_id: k.patch for k in self.keypoints}.items()))

    @property
    def points_mm(self) -> Float:
        """Centres of the keypoints in mm of the board frame, ndarray of shape (N, 3) with z = 0."""
        return np.array([[k.x_mm, k.y_mm, 0.0] for k in self.keypoints])

    @cached_property
    def A_patch2board(self) -> Float:
        """Linear map from the disc of each keypoint to mm of the board frame, ndarray of shape (N, 2, 2)."""
        return np.stack([k.H_patch2board[:2, :2] for k in self.keypoints])

    @cached_property
    def lattice(self) -> Lattice | None:
        """Rows and columns of the patches if the board is a field, see :func:`kpbench.field_board`; None otherwise."""
        if not self.is_field:
            return None
        rows = np.array([(k.x_mm, k.y_mm, k.rotate_deg, k.diameter_mm) for k in self.keypoints])
        ids = np.array([k.patch_id for k in self.keypoints])
        return find_lattice(rows[:, :2], ids, rows[:, 2], rows[:, 3])

    @cached_property
    def orientations(self) -> tuple[Int, Float, Float]:
        """Every keypoint in every rotation of its patch that leaves the print unchanged (point, turn, A_board2patch).

        * ``point``, ndarray of shape (m,): index of the keypoint.
        * ``turn``, ndarray of shape (m, 2, 2): the rotation, in the patch frame.
        * ``A_board2patch``, ndarray of shape (m, 2, 2): the linear map from mm of the board frame to the patch frame
          before this rotation.

        A patch that looks the same in every direction has no row.
        """
        rows = [(n, k, turn) for n, k in enumerate(self.keypoints) for turn in range(k.patch.symmetry_order)]
        turns = [cos_sin_deg(360.0 * turn / k.patch.symmetry_order) for _, k, turn in rows]
        return (
            np.array([n for n, _, _ in rows], np.int64),
            np.array([[[c, -s], [s, c]] for c, s in turns]).reshape(-1, 2, 2),
            np.array([np.linalg.inv(k.H_patch2board[:2, :2]) for _, k, _ in rows]).reshape(-1, 2, 2),
        )

    def outlines(self, radius_px: Float, ink_gain: float = 0.0) -> tuple[list[list[Float]], list[list[Float]]]:
        """Return the outlines of all black ink, and of the whole patches, as polygons in mm of the board frame.

        Parameters
        ----------
        radius_px : ndarray of shape (n,)
            Radius of each keypoint's disc in the image, px. The radii set the number of corners: in the image, the
            polygons deviate from the exact curves by at most 1/1000 px.
        ink_gain : float
            Distance by which all edges of the black ink move outwards, in disc radii.

        Returns
        -------
        parts : list of lists of ndarray of shape (N, 2)
            Polygons of each part of the ink. The ink of each patch is one part, and then that of each reference
            mark. Parts do not overlap.
        discs : list of lists of ndarray of shape (N, 2)
            Polygons of each whole patch, rim and quiet zone included.
        """
        parts, discs = [], []
        for k, radius in zip(self.keypoints, radius_px, strict=True):
            # the tolerance is rounded down to a power of two, so that similar radii share an entry of the cache
            tolerance = float(np.ldexp(0.5, np.frexp(1e-3 / radius)[1]))
            black, disc = unit_polygons(k.patch, tolerance)
            if ink_gain:
                black = _spread_polygons(k.patch, tolerance, ink_gain)
            parts.append([project(k.H_patch2board, polygon) for polygon in black])
            discs.append([project(k.H_patch2board, polygon) for polygon in disc])
        radius_mm = max(k.diameter_mm for k in self.keypoints) / 2
        return parts + [mark.outlines(ink_gain * radius_mm) for mark in self.references], discs

    @property
    def digest(self) -> str:
        """SHA-256 of the board's size, of each patch's design, place, rotation and diameter, and of reference marks.

        Lengths are rounded to 1 nm, and rotations to 1e-6 degrees. Names are not hashed.
        """
        lengths: list[tuple[float, ...]] = [(self.side_x_mm, self.side_y_mm)]
        lengths += [(k.x_mm, k.y_mm, k.rotate_deg, k.diameter_mm) for k in self.keypoints]
        patches = [(k.patch.patch_id, k.patch.digest) for k in self.keypoints]
        content: tuple[object, ...] = ([[round(v, 6) + 0.0 for v in row] for row in lengths], patches)
        if self.references:
            corners = [(m.dictionary, m.mark_id, (m.corners_mm.round(6) + 0.0).tolist()) for m in self.references]
            content = (*content, corners)
        return hashlib.sha256(repr(content).encode()).hexdigest()


@lru_cache(maxsize=64)
def _spread_polygons(patch: Patch, tolerance: float, ink_gain: float) -> tuple[Float, ...]:
    """Return the polygons of the black ink after ink gain, in the patch frame. Lengths are in disc radii."""
    return tuple(flatten(spread(patch.black_region, ink_gain), tolerance))


def single_board(patch: Patch, side_mm: float) -> Board:
    """Return a board with one patch, which is almost as large as the board.

    Parameters
    ----------
    patch : Patch
    side_mm : float
        Side of the square. The disc has 0.92 of this side as its diameter, or less if the patch has a rim.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.patches.board import single_board
    >>> single_board(kpbench.shipped_patches()[0], side_mm=100.0).keypoints[0].diameter_mm
    92.0
    """
    diameter_mm = SINGLE_DIAMETER * side_mm / patch.extent
    return Board(f"single-{patch.name}", side_mm, side_mm, (BoardKeypoint(patch, 0.0, 0.0, 0.0, diameter_mm),))


def hexagon_board(patch: Patch, side_mm: float) -> Board:
    """Return the paper's board: six patches of one design on a regular hexagon.

    The board is a square of side S. The discs have a diameter of 0.16 S. The centres of the discs lie 0.36 S from the
    board's centre. The first patch is on the right. The other patches follow clockwise.

    Parameters
    ----------
    patch : Patch
    side_mm : float
        Side S of the square.

    Raises
    ------
    DesignError
        If rim and quiet zone are so wide that patches overlap or reach over the edge of the board.

    Examples
    --------
    >>> import kpbench
    >>> board = kpbench.hexagon_board(kpbench.shipped_patches()[0], side_mm=200.0)
    >>> board.points_mm[0].tolist()
    [72.0, 0.0, 0.0]
    """
    turns = [cos_sin_deg(60.0 * n) for n in range(6)]
    radius, diameter = HEXAGON_CIRCUMRADIUS * side_mm, HEXAGON_DIAMETER * side_mm
    keypoints = tuple(BoardKeypoint(patch, radius * c, radius * s, 0.0, diameter) for c, s in turns)
    return Board(f"hexagon-{patch.name}", side_mm, side_mm, keypoints)


def grid_board(
    patches: Sequence[Patch], rows: int, columns: int, diameter_mm: float, pitch_mm: float, name: str = "grid"
) -> Board:
    """Return a board with patches in rows and columns. The keypoints are listed row by row from the top left.

    The patch in row r and column c is ``patches[(r + c) % len(patches)]``. With two or more designs, neighbours in a
    row or a column therefore have different designs. The board is ``columns * pitch_mm`` wide and ``rows * pitch_mm``
    high.

    Parameters
    ----------
    patches : sequence of Patch
    rows, columns : int
    diameter_mm : float
        Diameter of the discs.
    pitch_mm : float
        Distance between the centres of neighbours in a row or a column.
    name : str

    Raises
    ------
    DesignError
        If patches overlap or reach over the edge of the board, or two different designs share an id.

    Examples
    --------
    >>> import kpbench
    >>> board = kpbench.grid_board(kpbench.shipped_patches(), rows=2, columns=2, diameter_mm=20.0, pitch_mm=40.0)
    >>> [keypoint.patch_id for keypoint in board.keypoints]
    [0, 1, 1, 2]
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
