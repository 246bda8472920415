"""Boards of tags (ArUco, AprilTag, ChArUco), which can replace boards of patches in the same scenes.

The keypoints are the corners of the tags, or the inner corners of the ChArUco pattern. A tag board is a square of black
and white modules with a white border of at least one module. A tag board has six or eight keypoints;
:func:`kpbench.patches.hexagon_board` has six. The tags are as large as the square and its border permit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.geometry.outline import circle, flatten
from kpbench.patches.board import HEXAGON_DIAMETER
from kpbench.patches.modules import module_region
from kpbench.types import Float

TAG_BOARDS = ("aruco", "apriltag", "charuco")
DICTIONARIES = {
    "aruco": cv2.aruco.DICT_4X4_50,
    "apriltag": cv2.aruco.DICT_APRILTAG_36h11,
    "charuco": cv2.aruco.DICT_4X4_50,
}
TAGS_PER_BOARD = 2  # the two tags lie on a diagonal of the board and have eight corners in all
CHARUCO_SQUARES = (4, 3)  # columns and rows; the pattern has six inner corners
SQUARE_MODULES, MARKER_MODULES = 8, 6  # side of a ChArUco square, and of the marker within the square, in modules


@dataclass(frozen=True)
class TagCorner:
    """A corner of a tag board as a keypoint.

    A circle about the corner takes the role of a patch's disc: the matching threshold is a fraction of the circle's
    radius.

    Attributes
    ----------
    patch_id : int
        Identity that detectors report.
    x_mm, y_mm : float
        Place in the board frame.
    diameter_mm : float
        Diameter of the circle.

    Examples
    --------
    >>> from kpbench.patches import tag_board
    >>> tag_board("aruco", side_mm=150.0).keypoints[4]
    TagCorner(patch_id=4, x_mm=5.0, y_mm=5.0, diameter_mm=24.0)
    """

    patch_id: int
    x_mm: float
    y_mm: float
    diameter_mm: float

    @property
    def H_patch2board(self) -> Float:
        """Homography from the unit disc to mm of the board frame, ndarray of shape (3, 3)."""
        radius = self.diameter_mm / 2
        return np.array([[radius, 0.0, self.x_mm], [0.0, radius, self.y_mm], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class TagBoard:
    """A square of black and white modules.

    Attributes
    ----------
    name : str
        "aruco", "apriltag" or "charuco".
    side_x_mm, side_y_mm : float
        Width and height, which are equal.
    keypoints : tuple of TagCorner
    black : ndarray of shape (n, n), bool
        Whether each module of the board is black, row by row.

    Examples
    --------
    >>> from kpbench.patches import tag_board
    >>> tag_board("apriltag", side_mm=200.0).black.shape
    (19, 19)
    """

    name: str
    side_x_mm: float
    side_y_mm: float
    keypoints: tuple[TagCorner, ...]
    black: NDArray[np.bool_] = field(compare=False, repr=False)

    def outlines(self, radius_px: Float, ink_gain: float = 0.0) -> tuple[list[list[Float]], list[list[Float]]]:
        """Return the outlines as :meth:`kpbench.patches.Board.outlines` does. The only ink is that of black modules."""
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        middle, module_mm = len(self.black) / 2, self.side_x_mm / len(self.black)
        ink = [module_mm * (corners + place - middle) for place in np.argwhere(self.black)[:, ::-1]]
        if ink_gain:
            gain = ink_gain * self.keypoints[0].diameter_mm / 2 / module_mm
            tolerance = 1e-3 * self.keypoints[0].diameter_mm / 2 / float(radius_px.max()) / module_mm
            modules = tuple(map(tuple, self.black.tolist()))
            ink = [module_mm * (polygon - middle) for polygon in flatten(module_region(modules, gain), tolerance)]
        discs = []
        for k, radius in zip(self.keypoints, radius_px, strict=True):
            mm = k.diameter_mm / 2
            discs.append(flatten(circle(k.x_mm, k.y_mm, mm), 1e-3 * mm / float(radius)))
        return [ink], discs

    def to_dict(self) -> dict[str, Any]:
        """Return the entry that describes the board in the configuration of a dataset."""
        return {
            "name": self.name,
            "side_mm": self.side_x_mm,
            "modules": ["".join(" #"[int(black)] for black in row) for row in self.black],
            "keypoints": [[k.patch_id, k.x_mm, k.y_mm, k.diameter_mm] for k in self.keypoints],
        }


def tag_dictionary(board: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of the tags on a board."""
    return cv2.aruco.getPredefinedDictionary(DICTIONARIES[board])


def charuco_pattern() -> cv2.aruco.CharucoBoard:
    """Return the ChArUco pattern as OpenCV's object, with lengths in modules."""
    return cv2.aruco.CharucoBoard(CHARUCO_SQUARES, SQUARE_MODULES, MARKER_MODULES, tag_dictionary("charuco"))


@lru_cache
def tag_board(name: str, side_mm: float) -> TagBoard:
    """Return a board of tags on a square.

    ``aruco`` and ``apriltag`` carry the tags 0 and 1. Corner c of tag t has the ID 4 t + c. The corners of a tag are
    numbered clockwise from the top left. ``charuco`` has the six inner corners of 4 x 3 squares in OpenCV's order.

    Parameters
    ----------
    name : str
        "aruco" (dictionary 4x4_50), "apriltag" (36h11) or "charuco" (4x4_50).
    side_mm : float
        Side of the square.

    Examples
    --------
    >>> from kpbench.patches import tag_board
    >>> [len(tag_board(name, 200.0).keypoints) for name in ("aruco", "apriltag", "charuco")]
    [8, 8, 6]
    """
    black, corners = _charuco() if name == "charuco" else _two_tags(name)
    module_mm = side_mm / len(black)
    corners_mm = (np.array(list(corners.values())) - len(black) / 2) * module_mm
    keypoints = tuple(
        TagCorner(n, float(x), float(y), HEXAGON_DIAMETER * side_mm)
        for n, (x, y) in zip(corners, corners_mm, strict=True)
    )
    return TagBoard(name, side_mm, side_mm, keypoints, black)


Pattern = tuple[NDArray[np.bool_], dict[int, tuple[float, float]]]
"""Whether each module is black; and by ID, the keypoints' positions (x, y) in modules from the board's top left."""


def _two_tags(name: str) -> Pattern:
    tags = tag_dictionary(name)
    width = tags.markerSize + 2
    black = np.zeros((TAGS_PER_BOARD * (width + 1) + 1,) * 2, bool)
    corners = {}
    for tag in range(TAGS_PER_BOARD):
        first = 1 + tag * (width + 1)
        black[first : first + width, first : first + width] = tags.generateImageMarker(tag, width) == 0
        for corner, (x, y) in enumerate([(0, 0), (width, 0), (width, width), (0, width)]):
            corners[4 * tag + corner] = (float(first + x), float(first + y))
    return black, corners


def _charuco() -> Pattern:
    pattern = charuco_pattern()
    columns, rows = (SQUARE_MODULES * squares for squares in CHARUCO_SQUARES)
    black = np.zeros((columns + 2,) * 2, bool)
    top = (len(black) - rows) // 2
    black[top : top + rows, 1 : columns + 1] = pattern.generateImage((columns, rows)) == 0
    inside = np.asarray(pattern.getChessboardCorners())[:, :2] + (1, top)
    return black, {n: (float(x), float(y)) for n, (x, y) in enumerate(inside)}
