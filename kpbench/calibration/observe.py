"""Points of a board in photographs: reference marks, or patches that a detector finds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpbench.boards.matching import find_board
from kpbench.calibration.marks import BoardPoints, MarkFinder
from kpbench.calibration.photos import Photo, as_grey, list_photos, read_photo
from kpbench.detectors.interface import load_detector
from kpbench.patches.board import Board
from kpbench.types import Float, UInt8

REJECTIONS = {
    "broken": "the file cannot be decoded",
    "other-size": "the photograph has another size than most",
    "no-marks": "no mark of the board was found",
    "no-board": "the board was not found",
    "wrong-board": "the marks do not lie as on the board",
    "two-boards": "marks of the board are there twice",
    "ambiguous": "other points of the board explain the patches as well",
    "few-points": "too few points of the board were found",
    "no-pose": "no pose fits the points",
    "does-not-fit": "the residuals are much larger than in other photographs",
    "outliers": "too many points do not fit",
    "not-between": "no easy photograph of its series was taken before it, or none after it",
    "no-labels": "no patch lies among the marks that were found, or all are covered",
}
"""Reason codes of rejected photographs, and what they mean."""
LEAST_CORNERS = 12
"""Smallest number of X-corners of a photograph."""
LEAST_PATCHES = 5
"""Smallest number of patches of a photograph, if the board has no marks."""


@dataclass(frozen=True)
class Observed:
    """A photograph with the points of the board in it.

    Attributes
    ----------
    photo : Photo
    points : BoardPoints
    reason : str
        Reason code of a rejected photograph, one of :data:`REJECTIONS`; "" for one that is used.
    """

    photo: Photo
    points: BoardPoints
    reason: str = ""


def board_points_mm(board: Board) -> Float:
    """Return the points that are looked for: the X-corners of the marks, else the patches, ndarray of shape (N, 2)."""
    return MarkFinder(board).corners_mm if board.references else board.points_mm[:, :2]


def name_point(board: Board, index: int) -> str:
    """Return the name of a point of :func:`board_points_mm` for messages."""
    if board.references:
        return f"mark {board.references[index // 4].mark_id}, corner {index % 4}"
    return f"keypoint {index}"


def observe_photos(
    source: str | Path | Sequence[str | Path],
    board: Board,
    *,
    detector: str = "superpoint-small",
    exclude: Path | None = None,
    progress: Callable[[int], None] = lambda photos: None,
) -> list[Observed]:
    """Find the points of a board in photographs.

    Parameters
    ----------
    source : str, Path or a sequence of them
        Folder of photographs, or files.
    board : Board
        With reference marks, these are looked for. Without, its patches are.
    detector : str
        Finds the patches of a board without marks.
    exclude : Path, optional
        Folder whose images are left out.
    progress : callable
        Called with the number of photographs that were read since its last call.

    Raises
    ------
    DataError
        If there are no photographs, or a file cannot be opened.
    """
    find = MarkFinder(board).find if board.references else _patch_finder(board, detector)
    least = LEAST_CORNERS if board.references else LEAST_PATCHES
    found = list[Observed]()
    for name, path in list_photos(source, exclude):
        photo, image = read_photo(name, path)
        points = BoardPoints.none("broken") if image is None else find(as_grey(image))
        reason = points.problem or ("few-points" if len(points) < least else "")
        found.append(Observed(photo, points, reason))
        progress(1)
    sizes = Counter(o.photo.size_px for o in found if not o.reason)
    if not sizes:
        return found
    size, _ = sizes.most_common(1)[0]
    return [o if o.reason or o.photo.size_px == size else Observed(o.photo, o.points, "other-size") for o in found]


def _patch_finder(board: Board, detector: str) -> Callable[[UInt8], BoardPoints]:
    """Return a function that finds the patches of a board in a grey image."""
    detect = load_detector(detector)

    def find(image: UInt8) -> BoardPoints:
        matches = find_board(detect(image), board)
        if not matches:
            return BoardPoints.none("no-board")
        if len(matches) > 1 and len(matches[1].points) > len(matches[0].points) / 2:
            return BoardPoints.none("two-boards")
        match = max(matches, key=lambda m: len(m.points))
        if match.ambiguous:
            return BoardPoints.none("ambiguous")
        covariance = match.detections.covariance
        if covariance is None:
            covariance = np.tile(0.01 * np.eye(2), (len(match.points), 1, 1))
        order = np.argsort(match.points)
        return BoardPoints(match.points[order], match.detections.xy[order], covariance[order])

    return find
