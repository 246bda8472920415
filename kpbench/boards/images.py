"""Boards in the detections of many images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from kpbench.boards.field import LEAST_PROBABILITY
from kpbench.boards.matching import BoardMatch, find_board
from kpbench.boards.pose import BoardPose, estimate_pose
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.patches.board import Board
from kpbench.types import Detections, Predictions

NOT_FOUND = "the board was not found"


@dataclass(frozen=True)
class PoseRecord:
    """What is known of one board in one image.

    Attributes
    ----------
    image_id : int
    file : str
        Name of the image's file; "" if unknown.
    frame_index : int or None
    time_s : float or None
    board : str
        Name of the board.
    pose : BoardPose or None
        None if there is no pose.
    reason : str
        Why there is no pose; "" if there is one.
    state : {"seen", "tracked", "predicted", ""}
        ``seen`` for a pose from detections. The others come from a tracker, see :class:`kpbench.tracking.TrackedPose`.
    filtered : BoardPose or None
        The pose that the filter of a tracker makes of this and of earlier images.

    Examples
    --------
    >>> from kpbench.boards import PoseRecord
    >>> PoseRecord(0, "a.png", None, None, "hexagon-trefoil", None, "the board was not found").pose is None
    True
    """

    image_id: int
    file: str
    frame_index: int | None
    time_s: float | None
    board: str
    pose: BoardPose | None
    reason: str
    state: str = "seen"
    filtered: BoardPose | None = None


def find_boards(
    detections: Detections, boards: Sequence[Board], camera: Camera | None = None
) -> tuple[tuple[BoardMatch, ...], ...]:
    """Find several boards in one image.

    If two boards explain one detection, the match with more points counts. With as many points, both matches are
    alternatives of each other, and are therefore ambiguous. Of two fields, the more probable one counts, and its
    ``probability`` takes the other one into account.

    Parameters
    ----------
    detections, camera
        As for :func:`find_board`.
    boards : sequence of Board

    Returns
    -------
    tuple of tuple of BoardMatch
        The matches of each board.

    Raises
    ------
    DataError
        As :func:`find_board`.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.boards import find_boards
    >>> small, large = (kpbench.hexagon_board(kpbench.shipped_patches()[1], side) for side in (100.0, 200.0))
    >>> frames = np.tile(16 * np.eye(2), (6, 1, 1))
    >>> found = kpbench.Detections(2 * small.points_mm[:, :2] + 200, np.ones(6), np.ones(6, int), frames)
    >>> [[match.ambiguous for match in matches] for matches in find_boards(found, [small, large])]
    [[True], [True]]
    """
    found = [(n, match) for n, board in enumerate(boards) for match in find_board(detections, board, camera)]
    found = _choose_fields([item for item in found if item[1].board.is_field]) + [
        item for item in found if not item[1].board.is_field
    ]
    found.sort(key=lambda item: -len(item[1].points))
    kept = list[tuple[int, BoardMatch]]()
    for n, match in found:
        rivals = [k for k, (_, other) in enumerate(kept) if np.isin(match.index, other.index).any()]
        equal = [k for k in rivals if len(kept[k][1].points) == len(match.points)]
        if len(rivals) > len(equal):
            continue
        for k in equal:
            m, other = kept[k]
            kept[k] = (m, replace(other, alternatives=(*other.alternatives, replace(match, alternatives=()))))
            match = replace(match, alternatives=(*match.alternatives, replace(other, alternatives=())))
        kept.append((n, match))
    return tuple(tuple(match for m, match in kept if m == n) for n in range(len(boards)))


def _choose_fields(found: list[tuple[int, BoardMatch]]) -> list[tuple[int, BoardMatch]]:
    """Return the matches of fields, of those that share detections the most probable one, by Bayes' rule over all."""
    kept = list[tuple[int, BoardMatch]]()
    for n, match in sorted(found, key=lambda item: -item[1].evidence):
        rivals = [k for k, (_, other) in enumerate(kept) if np.isin(match.index, other.index).any()]
        if not rivals:
            kept.append((n, match))
        for k in rivals:
            m, other = kept[k]
            lost = np.exp(match.evidence - other.evidence) / match.probability
            probability = 1 / (1 / other.probability + float(lost))
            kept[k] = m, replace(other, probability=probability, is_sure=probability >= LEAST_PROBABILITY)
    return kept


def locate_boards(
    predictions: Predictions, boards: Sequence[Board], camera: Camera | None = None
) -> tuple[Predictions, list[PoseRecord]]:
    """Find boards and their poses in the detections of many images.

    Parameters
    ----------
    predictions : Predictions
        With identities and affine frames.
    boards : sequence of Board
        Their names differ.
    camera : Camera, optional
        Camera of all images. Without a camera, there are no poses.

    Returns
    -------
    Predictions
        With the columns ``board`` and ``points``, and ``probability`` if there is a field. A match whose points are
        ambiguous has no points.
    list of PoseRecord
        For each image and board one record, or one per copy of the board.

    Raises
    ------
    DataError
        If two boards have one name, an image has another size than the camera and no whole-number multiple or fraction
        of it, or the detections have no identities or no affine frames.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.boards import locate_boards
    >>> board = kpbench.grid_board(kpbench.shipped_patches(), rows=2, columns=2, diameter_mm=20.0, pitch_mm=40.0)
    >>> ids = [k.patch_id for k in board.keypoints]
    >>> frames = np.tile(30 * np.eye(2), (4, 1, 1))
    >>> found = kpbench.Detections(3 * board.points_mm[:, :2] + [320, 240], np.ones(4), ids, frames)
    >>> located, poses = locate_boards(kpbench.Predictions.from_detections([found]), [board])
    >>> located.points.tolist(), poses[0].reason
    ([0, 1, 2, 3], 'there is no camera')
    """
    names = [board.name for board in boards]
    if doubles := [name for name in names if names.count(name) > 1]:
        raise DataError(f"two boards have the name {doubles[0]!r}")
    board_of, points = np.full(len(predictions.xy), -1), np.full(len(predictions.xy), -1)
    probability = np.zeros(len(predictions.xy))
    records = list[PoseRecord]()
    for n, (detections, (first, _)) in enumerate(
        zip(predictions.detections(), pairwise(predictions.offsets.tolist()), strict=True)
    ):
        of_image = _camera_of(predictions, n, camera)
        found = find_boards(detections, boards, of_image)
        for k, matches in enumerate(found):
            for match in matches:
                board_of[first + match.index] = k
                points[first + match.index] = -1 if match.ambiguous else match.points
                probability[first + match.index] = match.probability / (1 + len(match.alternatives))
            records += [_record(predictions, n, names[k], match, of_image) for match in matches or (None,)]
    of_fields = probability if any(board.is_field for board in boards) else None
    located = replace(predictions, board=board_of, points=points, boards=tuple(names), probability=of_fields)
    return located, records


def name_image(predictions: Predictions, n: int) -> str:
    """Return the name of an image for a message: its file, or its ID."""
    file = predictions.file[n] if predictions.file is not None else ""
    return file or f"image_id {predictions.image_id[n]}"


def require_camera_size(predictions: Predictions, camera: Camera | None) -> None:
    """Refuse images whose size is no whole-number multiple or fraction of the camera's.

    Raises
    ------
    DataError
        At the first such image.
    """
    for n in range(len(predictions)):
        _camera_of(predictions, n, camera)


def _camera_of(predictions: Predictions, n: int, camera: Camera | None) -> Camera | None:
    """Return the camera for the size of an image."""
    if camera is None or predictions.size is None or not predictions.size[n].all():
        return camera
    try:
        return camera.at_size(*predictions.size[n].tolist())
    except DataError as error:
        raise DataError(f"{name_image(predictions, n)}: {error}") from None


def _record(p: Predictions, n: int, board: str, match: BoardMatch | None, camera: Camera | None) -> PoseRecord:
    pose, reason = None, NOT_FOUND
    if match is not None:
        try:
            pose, reason = (None, "there is no camera") if camera is None else (estimate_pose(match, camera), "")
        except DataError as error:
            reason = str(error).removeprefix(f"board {board!r}: ")
    frame = None if p.frame_index is None or p.frame_index[n] < 0 else int(p.frame_index[n])
    time_s = None if p.time_s is None or np.isnan(p.time_s[n]) else float(p.time_s[n])
    return PoseRecord(int(p.image_id[n]), p.file[n] if p.file is not None else "", frame, time_s, board, pose, reason)
