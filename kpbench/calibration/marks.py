"""Reference marks of a board in a photograph: their X-corners, to parts of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.calibration.xcorners import refine_x_corners
from kpbench.errors import DataError
from kpbench.geometry.homography import project
from kpbench.patches.board import Board
from kpbench.patches.reference import ARM_MODULES, CORNER_PLACES, MARK_MODULES, reference_dictionary
from kpbench.types import Float, Int, UInt8

TAG_ERROR = 0.35
"""Largest distance of a tag's corner from the homography of all tags, in sides of the tag in the image."""
REACH_MODULES = 0.9 * ARM_MODULES
"""Radius about an X-corner within which there is nothing else, in modules of its mark."""
NEIGHBOURS = 16
"""Number of corners around a mark that tell where its own corners are, if its tag was not read."""
FARTHEST_SIDES = 3.0
"""Largest distance of a mark, whose tag was not read, from the nearest corner that was found, in sides of the mark."""
DOUBLE_TAGS = 3
"""Number of tags that are seen twice, from which two boards are in view."""
STRETCH_PERCENT = (1, 99)
"""Percentiles of the grey levels that are stretched to black and white before tags are looked for."""
X_SIGNS = np.array([[1, 1], [-1, 1], [1, 1], [-1, 1]])
"""Directions of the axes at each corner of a mark for which the sectors of (+, +) and (-, -) are white."""


@dataclass(frozen=True)
class BoardPoints:
    """Points of a board that are seen in one photograph.

    Attributes
    ----------
    index : ndarray of shape (n,), int64
        Index of each point: mark and corner, ``4 * mark + corner``; or the keypoint of a board without marks.
    xy : ndarray of shape (n, 2)
        Places in the image, px.
    covariance : ndarray of shape (n, 2, 2)
        Covariance of the errors, px².
    problem : str
        Code of what is wrong with the photograph; "" if nothing is.

    Examples
    --------
    >>> from kpbench.calibration import BoardPoints
    >>> len(BoardPoints.none("no-marks"))
    0
    """

    index: Int
    xy: Float
    covariance: Float
    problem: str = ""

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, keep: NDArray[np.bool_] | Int) -> BoardPoints:
        return BoardPoints(self.index[keep], self.xy[keep], self.covariance[keep], self.problem)

    @classmethod
    def none(cls, problem: str) -> BoardPoints:
        """Return no points, with the code of the reason."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), problem)


@dataclass(frozen=True)
class MarkFinder:
    """Finds the reference marks of one board.

    Attributes
    ----------
    board : Board
        With reference marks.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.calibration import MarkFinder
    >>> MarkFinder(kpbench.truth_board(kpbench.shipped_patches())).corners_mm.shape
    (276, 2)
    """

    board: Board

    def __post_init__(self) -> None:
        if not self.board.references:
            raise DataError(f"board {self.board.name!r} has no reference marks, expected some")

    @cached_property
    def corners_mm(self) -> Float:
        """The X-corners of all marks, ndarray of shape (4 n, 2), mm of the board frame."""
        return np.concatenate([mark.corners_mm for mark in self.board.references])

    @cached_property
    def _detector(self) -> cv2.aruco.ArucoDetector:
        parameters = cv2.aruco.DetectorParameters()
        parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = 5, 45
        parameters.adaptiveThreshWinSizeStep = 8
        parameters.minMarkerPerimeterRate = 0.01
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        dictionary = reference_dictionary(self.board.references[0].dictionary)
        return cv2.aruco.ArucoDetector(dictionary, parameters)

    def find(self, image: UInt8) -> BoardPoints:
        """Find the X-corners of the marks in a grey image of shape (H, W).

        Returns
        -------
        BoardPoints
            Its ``problem`` is "" or one of: ``no-marks`` (no tag of the board), ``wrong-board`` (the tags do not lie as
            on the board), ``two-boards`` (tags are there twice).
        """
        place = {mark.mark_id: n for n, mark in enumerate(self.board.references)}
        corners, ids, _ = self._detector.detectMarkers(_stretch(image))
        if ids is None or not any(int(i) in place for i in ids.ravel()):
            return BoardPoints.none("no-marks")
        seen = [
            (place[int(i)], c[0].astype(float)) for c, i in zip(corners, ids.ravel(), strict=True) if int(i) in place
        ]
        number = np.array([n for n, _ in seen])
        found_px = np.stack([c for _, c in seen])
        board_mm = np.stack([self.board.references[n].tag_corners_mm for n in number])
        keep, doubles = _consistent(number, board_mm, found_px)
        if doubles >= DOUBLE_TAGS:
            return BoardPoints.none("two-boards")
        if keep.sum() < min(3, len(self.board.references)) or keep.sum() < 0.5 * len({*number.tolist()}):
            return BoardPoints.none("wrong-board" if len(number) >= 4 else "no-marks")
        number, found_px, board_mm = number[keep], found_px[keep], board_mm[keep]
        points = self._refine(image, number, [_fit(b, f) for b, f in zip(board_mm, found_px, strict=True)])
        before = 0
        while NEIGHBOURS <= len(points) > before:  # each time, the marks around those that were found
            before, points = len(points), self._find_missing(image, points)
        return points

    def _refine(self, image: UInt8, number: Int, H_board2image: list[Float]) -> BoardPoints:
        """Refine the corners of marks, from a homography near each mark."""
        index, start, frames = list[Int](), list[Float](), list[Float]()
        for n, H in zip(number.tolist(), H_board2image, strict=True):
            mark = self.board.references[n]
            index.append(4 * n + np.arange(4))
            start.append(project(H, mark.corners_mm))
            frames.append(
                np.stack([_derivative(H, xy) * sign for xy, sign in zip(mark.corners_mm, X_SIGNS, strict=True)])
            )
        reach_mm = (
            REACH_MODULES / MARK_MODULES * min(self.board.references[0].width_mm, self.board.references[0].height_mm)
        )
        found = refine_x_corners(image, np.concatenate(start), np.concatenate(frames), reach_mm)
        keep = found.is_found
        points = BoardPoints(np.concatenate(index)[keep], found.xy[keep], found.covariance[keep])
        return points[np.argsort(points.index)]

    def _find_missing(self, image: UInt8, points: BoardPoints) -> BoardPoints:
        """Find corners of marks whose tags were not read, and single corners that were not found."""
        known_mm = self.corners_mm[points.index]
        side = self.board.references[0].width_mm
        number, maps = list[int](), list[Float]()
        for n, mark in enumerate(self.board.references):
            if np.isin(4 * n + np.arange(4), points.index).all():
                continue
            distance = np.hypot(*(known_mm - (mark.x_mm, mark.y_mm)).T)
            near = np.argsort(distance)[:NEIGHBOURS]
            if distance[near[0]] <= FARTHEST_SIDES * side and _is_wide(known_mm[near]):
                number.append(n)
                maps.append(_fit(known_mm[near], points.xy[near]))
        if not number:
            return points
        more = self._refine(image, np.array(number), maps)
        more = more[~np.isin(more.index, points.index)]
        index = np.concatenate([points.index, more.index])
        xy, covariance = np.concatenate([points.xy, more.xy]), np.concatenate([points.covariance, more.covariance])
        order = np.argsort(index)
        return BoardPoints(index[order], xy[order], covariance[order])


def _stretch(image: UInt8) -> UInt8:
    """Return the image with its grey levels stretched, so that tags in the dark are found."""
    low, high = np.percentile(image[::4, ::4], STRETCH_PERCENT)
    scale = 255.0 / max(float(high - low), 8.0)
    levels = np.clip((np.arange(256) - low) * scale, 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(image, levels), np.uint8)


def _consistent(number: Int, board_mm: Float, found_px: Float) -> tuple[NDArray[np.bool_], int]:
    """Return which tags lie as on the board, and how many tags were seen at two places.

    Parameters
    ----------
    number : ndarray of shape (n,), int64
    board_mm, found_px : ndarray of shape (n, 4, 2)
    """
    side = np.hypot(*(found_px[:, 0] - found_px[:, 2]).T) / np.sqrt(2)
    threshold = TAG_ERROR * float(np.median(side))
    if len(number) == 1:
        return np.ones(1, bool), 0
    found, _ = cv2.findHomography(board_mm.reshape(-1, 2), found_px.reshape(-1, 2), cv2.RANSAC, threshold)
    if found is None:
        return np.zeros(len(number), bool), 0
    H = np.asarray(found, np.float64)
    with np.errstate(all="ignore"):
        error = np.hypot(*(project(H, board_mm.reshape(-1, 2)) - found_px.reshape(-1, 2)).T).reshape(-1, 4).max(axis=1)
    keep = error < 3 * TAG_ERROR * side  # the lens may bend lines
    doubles = len(number) - len(np.unique(number))
    best = np.zeros(len(number), bool)
    for n in np.unique(number[keep]):
        rows = np.flatnonzero(keep & (number == n))
        best[rows[np.argmin(error[rows])]] = True
    return best, doubles


def _fit(board_mm: Float, image_px: Float) -> Float:
    H, _ = cv2.findHomography(board_mm, image_px, 0)
    return np.asarray(np.eye(3) if H is None else H, np.float64)


def _derivative(H: Float, xy: Float) -> Float:
    """Return the derivative of a homography at a point, ndarray of shape (2, 2)."""
    x, y, w = H @ np.append(xy, 1.0)
    return np.asarray((H[:2, :2] - np.outer([x / w, y / w], H[2, :2])) / w)


def _is_wide(points: Float) -> bool:
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extent[1] > 0.1 * extent[0])


def mark_side_mm(board: Board) -> float:
    """Return the distance between two X-corners of a mark, mm."""
    return float(np.ptp(CORNER_PLACES[:, 0]) * board.references[0].width_mm)
