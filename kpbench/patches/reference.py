"""Reference marks: printed tags in white squares whose four corners are X-corners.

A mark is a grid of 16 x 16 modules. Its middle is a white square of 10 x 10 modules that holds an ArUco tag of 6 x 6
modules. A black arm of 3 modules lies on each side of the white square. Two arms meet at each corner of the square, as
two black fields of a chessboard do. An X-corner looks the same after half a turn. The tone curve of a camera, blur and
the gain of ink keep this symmetry, and so they do not move the corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DesignError
from kpbench.geometry.outline import Line, Region, flatten
from kpbench.patches.modules import Modules, module_region
from kpbench.types import Float

TOUCHING_MM = 1e-6
"""A smaller overlap is accepted: after rounding, two touching patches may seem to overlap."""
TAG_MODULES, SQUARE_SIDE, ARM_MODULES = 6, 10, 3
"""Sides of the tag and of the white square, and width of an arm, in modules."""
MARK_MODULES = SQUARE_SIDE + 2 * ARM_MODULES
"""Side of a mark, in modules."""
REFERENCE_DICTIONARIES = {f"DICT_4X4_{count}": count for count in (50, 100, 250, 1000)}
"""Number of tags of each of OpenCV's dictionaries that marks may have."""
REFERENCE_KIND = "aruco-x-corners"
"""Kind of the marks in a sidecar."""
CORNER_PLACES = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (SQUARE_SIDE / MARK_MODULES / 2)
"""The X-corners of a mark, clockwise from the top left, in sides of the mark."""


@dataclass(frozen=True)
class ReferenceMark:
    """A reference mark on a board.

    Attributes
    ----------
    dictionary : str
        OpenCV's name of the tag's dictionary, such as "DICT_4X4_100".
    mark_id : int
        Identity of the tag.
    x_mm, y_mm : float
        Middle of the mark in the board frame.
    width_mm, height_mm : float
        Size of the whole mark.

    Examples
    --------
    >>> from kpbench.patches import ReferenceMark
    >>> ReferenceMark("DICT_4X4_50", 3, x_mm=20.0, y_mm=0.0, width_mm=16.0, height_mm=16.0).corners_mm.tolist()
    [[15.0, -5.0], [25.0, -5.0], [25.0, 5.0], [15.0, 5.0]]
    """

    dictionary: str
    mark_id: int
    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float

    @property
    def corners_mm(self) -> Float:
        """The X-corners, clockwise from the top left, ndarray of shape (4, 2)."""
        return np.asarray(CORNER_PLACES * (self.width_mm, self.height_mm) + (self.x_mm, self.y_mm))

    @property
    def tag_corners_mm(self) -> Float:
        """The corners of the tag, clockwise from the top left, ndarray of shape (4, 2)."""
        middle = np.array([self.x_mm, self.y_mm])
        return np.asarray(middle + (self.corners_mm - middle) * (TAG_MODULES / SQUARE_SIDE))

    @property
    def region(self) -> Region:
        """Outline of the black ink in mm of the board frame."""
        return self._scaled(_modules(self.dictionary, self.mark_id))

    @property
    def white_region(self) -> Region:
        """Outline of all that is not black within the mark and a border of one module: the ink of an inverted print."""
        black = np.pad(np.array(_modules(self.dictionary, self.mark_id)), 1)
        return self._scaled(_as_modules(~black))

    def outlines(self, ink_gain_mm: float) -> list[Float]:
        """Return the outlines of the black ink as polygons in mm of the board frame, after ink gain."""
        modules = _modules(self.dictionary, self.mark_id)
        polygons = flatten(module_region(modules, ink_gain_mm * MARK_MODULES / self.width_mm), 1e-3)
        return [self._place(polygon, MARK_MODULES) for polygon in polygons]

    def _scaled(self, black: Modules) -> Region:
        def place(line: Line) -> Line:
            (x0, y0), (x1, y1) = self._place(np.array([[line.x0, line.y0], [line.x1, line.y1]]), len(black)).tolist()
            return Line(x0, y0, x1, y1)

        region = module_region(black)
        return tuple(tuple(place(part) for part in contour if isinstance(part, Line)) for contour in region)

    def _place(self, points: Float, modules: int) -> Float:
        size = np.array([self.width_mm, self.height_mm]) / MARK_MODULES
        return np.asarray((points - modules / 2) * size + (self.x_mm, self.y_mm))


def check_references(
    board: str, references: Sequence[ReferenceMark], side_mm: Float, centres_mm: Float, extent_mm: Float
) -> None:
    """Refuse reference marks that overlap a patch, another mark or the edge of their board, or are no set.

    ``side_mm`` (2,) is the size of the board. ``centres_mm`` (N, 2) and ``extent_mm`` (N,) are those of the patches.
    """
    if not references:
        return
    place = np.array([(m.x_mm, m.y_mm) for m in references])
    half = np.array([(m.width_mm, m.height_mm) for m in references]) / 2
    ids = [m.mark_id for m in references]
    if len({m.dictionary for m in references}) > 1 or len({*ids}) < len(ids):
        raise DesignError(f"board {board!r}: reference marks need one dictionary and different ids")
    between = np.abs(place[:, None] - place) - half[:, None] - half
    overlap = (between < -TOUCHING_MM).all(axis=2) & ~np.eye(len(ids), dtype=bool)
    apart = np.maximum(np.abs(place[:, None] - centres_mm) - half[:, None], 0)
    to_patch = np.hypot(*apart.transpose(2, 0, 1)) - extent_mm
    bad = (np.abs(place) + half > side_mm / 2 + TOUCHING_MM).any(axis=1) | overlap.any(axis=1)
    bad |= (to_patch < -TOUCHING_MM).any(axis=1)
    if bad.any():
        mark = references[int(np.argmax(bad))]
        raise DesignError(
            f"board {board!r}: reference mark {mark.mark_id} at ({mark.x_mm:g}, {mark.y_mm:g}) mm overlaps "
            "a patch, another mark or the edge of the board"
        )


def reference_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of a name, such as "DICT_4X4_100"."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


@lru_cache(maxsize=512)
def _modules(dictionary: str, mark_id: int) -> Modules:
    black = np.zeros((MARK_MODULES, MARK_MODULES), bool)
    near, far = ARM_MODULES, MARK_MODULES - ARM_MODULES
    black[:near, near:far] = black[far:, near:far] = black[near:far, :near] = black[near:far, far:] = True
    first = (MARK_MODULES - TAG_MODULES) // 2
    tag = reference_dictionary(dictionary).generateImageMarker(mark_id, TAG_MODULES) == 0
    black[first : first + TAG_MODULES, first : first + TAG_MODULES] = tag
    return _as_modules(black)


def _as_modules(black: NDArray[np.bool_]) -> Modules:
    return tuple(map(tuple, black.tolist()))


def number_marks(centres_mm: Sequence[tuple[float, float]], side_mm: float) -> tuple[ReferenceMark, ...]:
    """Return marks of one size at given places, numbered from 0, with the smallest dictionary that has enough tags.

    Raises
    ------
    DesignError
        If there are more than 1000 marks.
    """
    fitting = [name for name, count in REFERENCE_DICTIONARIES.items() if count >= len(centres_mm)]
    if not fitting:
        most = max(REFERENCE_DICTIONARIES.values())
        raise DesignError(f"{len(centres_mm)} reference marks, expected at most {most}; use larger patches")
    return tuple(ReferenceMark(fitting[0], n, x, y, side_mm, side_mm) for n, (x, y) in enumerate(centres_mm))
