"""Track a board through the frames of a source."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpbench.boards.drawing import draw_board
from kpbench.boards.images import PoseRecord
from kpbench.dataset.drawing import draw_detections
from kpbench.dataset.folder import Dataset
from kpbench.errors import DataError
from kpbench.images import UNDECODABLE, ImageSource, image_writer
from kpbench.tracking.tracker import TrackedPose, Tracker
from kpbench.types import Detections, UInt8
from kpbench.workers import Progress

STATE_COLOURS = {"seen": (0, 158, 115), "tracked": (86, 180, 233), "predicted": (213, 94, 0)}
"""RGB colours of the outline of a board that was seen, tracked or predicted."""


@dataclass(frozen=True)
class TrackRun:
    """A board through the frames of a source.

    Attributes
    ----------
    records : list of PoseRecord
        One per frame.
    failures : list of (str, str)
        Name and message of each frame that could not be read.
    ms : list of float
        Time that the tracker took per frame, milliseconds.
    """

    records: list[PoseRecord]
    failures: list[tuple[str, str]]
    ms: list[float]


@dataclass(frozen=True)
class _Frame:
    name: str
    image: UInt8 | None
    image_id: int
    file: str
    index: int | None
    time_s: float | None
    starts_film: bool


def track_images(
    source: Dataset | ImageSource,
    tracker: Tracker,
    overlay: Path | None = None,
    progress: Progress = lambda images: None,
) -> TrackRun:
    """Track a board through a film, a camera, a folder of images, or a dataset of films.

    Parameters
    ----------
    source : Dataset or ImageSource
        See :func:`kpbench.detectors.open_source`. A dataset must hold films, as ``suite video-v1`` makes them. Ctrl-C
        ends a camera, and keeps the poses so far.
    tracker : Tracker
    overlay : Path, optional
        Folder or film to draw the board into.
    progress : callable
        Called with the number of frames finished since the last call.

    Returns
    -------
    TrackRun

    Raises
    ------
    DataError
        If the dataset holds no films, or a frame has another size than the camera.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.geometry import Camera
    >>> from kpbench.images import ImageSource
    >>> from kpbench.tracking import track_images
    >>> board = kpbench.hexagon_board(kpbench.shipped_patches()[1], 100.0)
    >>> frames = ImageSource(iter([("0.png", np.full((48, 64), 128, np.uint8)), ("1.png", None)]), 2)
    >>> run = track_images(frames, kpbench.Tracker(board, Camera(64, 48, 60.0)))
    >>> [record.reason for record in run.records]
    ['the board was not found', 'the frame cannot be read']
    """
    problems = dict[str, str]()
    length: int | None
    if isinstance(source, Dataset):
        length, fps, names, frames = len(source), None, None, _dataset_frames(source)
    else:
        length, fps, names, frames = source.length, source.fps, source.names, _source_frames(source)
        problems, tracker.fps = source.problems, source.fps or tracker.fps
    run, ends_by = TrackRun([], [], []), () if length is not None else (KeyboardInterrupt,)
    with image_writer(overlay, length, fps, names) as draw, contextlib.suppress(*ends_by):
        for frame in frames:
            if frame.starts_film:
                tracker.reset()
            start = time.perf_counter()
            try:
                found = tracker(frame.image, frame.time_s)
            except DataError as error:
                raise DataError(f"{frame.file or 'image_id'} {frame.name}: {error}") from None
            run.ms.append(1000 * (time.perf_counter() - start))
            if frame.image is None:
                run.failures.append((frame.name, problems.get(frame.name, UNDECODABLE)))
            of_frame = frame.image_id, frame.file, frame.index, frame.time_s, tracker.board.name
            run.records.append(PoseRecord(*of_frame, found.pose, found.reason, found.state, found.filtered))
            if overlay is not None:
                draw(frame.name, None if frame.image is None else draw_pose(frame.image, found, tracker))
            progress(1)
    return run


def _source_frames(source: ImageSource) -> Iterator[_Frame]:
    for n, (name, image) in enumerate(source.images):
        file, index, time_s = source.locate(name)
        at = index if index >= 0 else None, None if np.isnan(time_s) else time_s
        yield _Frame(name, image, n, file, *at, starts_film=n == 0)


def _dataset_frames(dataset: Dataset) -> Iterator[_Frame]:
    for n, image_id in enumerate(dataset.truth.image_id.tolist()):
        records = [effect for effect in dataset.effects(n) if effect["effect"] == "film"]
        if not records:
            raise DataError(f"{dataset.path}: image_id {image_id} is no frame of a film, expected those of `video-v1`")
        index, time_s = records[0]["frame_index"], records[0]["time_s"]
        yield _Frame(f"{image_id:08d}.png", dataset.image(n), image_id, "", index, time_s, starts_film=index == 0)


def draw_pose(image: UInt8, found: TrackedPose, tracker: Tracker) -> UInt8:
    """Draw the outline, the points and the axes of a board on a copy of an image.

    The outline is green if the detector saw the board, blue if it was tracked, and orange if its pose is a guess. The
    axes are red (x), green (y) and blue (towards the viewer).

    Returns
    -------
    ndarray of shape (H, W, 3), uint8
        RGB.
    """
    detections = Detections.none() if found.match is None else found.match.detections
    pose = found.pose or found.filtered

    def draw_below(canvas: UInt8) -> None:
        if pose is not None:
            draw_board(canvas, tracker.board, pose, tracker.camera, STATE_COLOURS[found.state])

    return draw_detections(image, detections, labels=False, draw_below=draw_below)
