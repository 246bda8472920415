"""The state of the page on which images are looked at, without the page: a thread that reads, detects and draws.

One source is looked at at a time. Its images come from files in the folder of the application, from a film that the
command line named, or from a camera; never from a path that a browser sends.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from kpbench.boards.images import PoseRecord, locate_boards
from kpbench.boards.pose import rotation_vector
from kpbench.boards.pose_files import write_poses
from kpbench.dataset.drawing import draw_detections
from kpbench.detectors.interface import LoadedDetector, load_detector
from kpbench.errors import DataError, KpbenchError, one_line
from kpbench.files import read_bytes
from kpbench.geometry.camera import Camera
from kpbench.images import UNDECODABLE, ImageSource, encode_jpeg, open_images
from kpbench.patches.board import Board
from kpbench.patches.design import Patch
from kpbench.predictions.files import write_predictions
from kpbench.tracking.films import draw_pose
from kpbench.tracking.tracker import TrackedPose, Tracker
from kpbench.types import Detections, Predictions, UInt8

MOST_KEPT = 3000
"""Number of the newest images whose detections and poses are kept, for the plot and the files."""
MOST_PICTURES = 50
"""Largest number of photographs whose pictures are kept."""
LARGEST_SHOWN_PX = 1920
"""Longest side of a shown picture, px. Larger images are shown smaller."""
SHOWN_QUALITY = 85
"""Quality of a shown picture (JPEG)."""
RATE_IMAGES = 30
"""Number of images over which the frame rate is measured."""


@dataclass(frozen=True)
class Look:
    """What is looked for.

    Attributes
    ----------
    detector : str
        Name of a shipped detector.
    patches : tuple of Patch
        Designs that ``template`` looks for; empty for the shipped ones.
    board : Board or None
    camera : Camera or None
        A calibration.
    view_deg : float or None
        Without a calibration: field of view along the longer side of an image. None: no camera.
    """

    detector: str = "superpoint-small"
    patches: tuple[Patch, ...] = ()
    board: Board | None = None
    camera: Camera | None = None
    view_deg: float | None = None

    def camera_for(self, image: UInt8) -> Camera | None:
        """Return the camera of an image.

        Raises
        ------
        DataError
            If the calibration is for images of another size.

        Examples
        --------
        >>> import numpy as np
        >>> from kpbench.ui.watcher import Look
        >>> round(Look(view_deg=90.0).camera_for(np.zeros((480, 640), np.uint8)).focal_px)
        320
        """
        height, width = image.shape[:2]
        if self.camera is not None:
            return self.camera.at_size(width, height)
        if self.view_deg is None:
            return None
        return Camera(width, height, max(width, height) / 2 / float(np.tan(np.radians(self.view_deg) / 2)))


@dataclass(frozen=True)
class SeenImage:
    """One image, and what was found in it.

    Attributes
    ----------
    number : int
        Counts the images that were looked at.
    detections : Detections
    record : PoseRecord
        Its file, frame and time; its pose, or why there is none.
    size_px : (int, int)
    ms : float
        Time of the detection.
    picture : bytes
        JPEG with what was found drawn on it; empty for an earlier frame of a film.
    """

    number: int
    detections: Detections
    record: PoseRecord
    size_px: tuple[int, int]
    ms: float
    picture: bytes


@dataclass
class Watcher:
    """Looks at one source after the other, in a thread.

    Attributes
    ----------
    kept : deque of SeenImage
        The newest sights.
    problems : list of str
        One line for each thing that went wrong with the present source.
    is_film : bool
        Whether the present source is a film or a camera.
    is_frozen : bool
    is_running : bool

    Examples
    --------
    >>> import cv2
    >>> import numpy as np
    >>> from kpbench.ui.watcher import Look, Watcher
    >>> _ = cv2.imwrite("grey.png", np.full((48, 64), 128, np.uint8))
    >>> watcher = Watcher()
    >>> watcher.open([("mine.png", "grey.png"), ("gone.png", "gone.png")], Look())
    >>> watcher.wait()
    >>> [sight.record.file for sight in watcher.kept], watcher.problems
    (['mine.png'], ['gone.png: no such dataset, image, folder or video'])
    """

    kept: deque[SeenImage] = field(default_factory=lambda: deque(maxlen=MOST_KEPT))
    problems: list[str] = field(default_factory=list)
    is_film: bool = False
    is_frozen: bool = False
    is_running: bool = False
    detector: LoadedDetector | None = None
    _look: Look = field(default_factory=Look)
    _count: int = 0
    _times_s: deque[float] = field(default_factory=lambda: deque(maxlen=RATE_IMAGES))
    _stop: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def open(self, sources: Sequence[tuple[str, str]], look: Look) -> None:
        """Look at sources, instead of those before.

        Parameters
        ----------
        sources : sequence of (str, str)
            Shown name, and a path or ``camera:N``, of each film, camera or photograph.
        look : Look
        """
        self.close()
        self.kept.clear()
        self._times_s.clear()
        self.problems, self.is_film, self.is_frozen, self.is_running, self._look = [], False, False, True, look
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(list(sources), look, self._stop), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the present source."""
        self._stop.set()
        self.wait(5.0)
        self.is_running = False

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait until the present source has ended."""
        if self._thread is not None:
            self._thread.join(timeout_s)

    @property
    def newest(self) -> SeenImage | None:
        """The newest sight."""
        return self.kept[-1] if self.kept else None

    @property
    def frames_per_s(self) -> float:
        """Images per second, over the newest images."""
        times_s = list(self._times_s)
        return (len(times_s) - 1) / (times_s[-1] - times_s[0]) if len(times_s) > 1 else 0.0

    def sight(self, number: int) -> SeenImage | None:
        """Return a sight with its picture: that of a number, or the newest one if it is gone."""
        found = next((sight for sight in list(self.kept) if sight.number == number and sight.picture), None)
        return found or self.newest

    def predictions_file(self) -> bytes:
        """Return the predictions of the kept images as a file, as ``kpbench detect`` writes it.

        Raises
        ------
        KpbenchError
            If nothing was looked at.
        """
        kept = list(self.kept)
        if not kept or self.detector is None:
            raise DataError("no image has been looked at")
        records = [sight.record for sight in kept]
        predictions = Predictions.from_detections(
            [sight.detections for sight in kept],
            [sight.number for sight in kept],
            {"name": self.detector.name, "version": self.detector.version},
            file=[record.file for record in records],
            size=[sight.size_px for sight in kept],
            frame_index=[-1 if record.frame_index is None else record.frame_index for record in records],
            time_s=[np.nan if record.time_s is None else record.time_s for record in records],
            ms=[sight.ms for sight in kept],
        )
        return _written("predictions.json", lambda path: write_predictions(path, predictions))

    def poses_file(self) -> bytes:
        """Return the poses of the kept images as a CSV file, as ``kpbench track`` writes it."""
        return _written("poses.csv", lambda path: write_poses(path, [sight.record for sight in list(self.kept)]))

    def _run(self, sources: list[tuple[str, str]], look: Look, stop: threading.Event) -> None:
        """Look at all sources, in the thread."""
        try:
            self.detector = load_detector(look.detector, None, look.patches or None)
            self.detector(np.full((64, 64), 128, np.uint8))  # loads its weights, which is no time of the first image
            for shown, source in sources:
                try:
                    self._look_at(open_images(source), shown, look, stop)
                except KpbenchError as error:
                    line = str(error).replace(source, shown)
                    self.problems.append(line if shown in line else f"{shown}: {line}")
                except Exception as error:  # a damaged file can make OpenCV raise anything
                    self.problems.append(one_line(f"{shown}: {type(error).__name__}: {error}"))
                if stop.is_set():
                    return
        except KpbenchError as error:
            self.problems.append(str(error))
        finally:
            if not stop.is_set():
                self.is_running = False

    def _look_at(self, source: ImageSource, shown: str, look: Look, stop: threading.Event) -> None:
        """Look at the images of one source. A film keeps its pace; a camera has its own."""
        is_film, tracker, start_s, unreadable = bool(source.film), None, time.monotonic(), 0
        self.is_film = self.is_film or is_film
        for name, image in source.images:
            _, index, time_s = source.locate(name)
            frame = index if index >= 0 else None, None if np.isnan(time_s) else time_s  # a camera tells no times
            start_s += self._thaw(stop) if is_film else 0.0
            early_s = start_s + (frame[1] or 0.0) - time.monotonic()
            start_s -= min(early_s, 0.0)  # what is late stays late, and does not hurry
            if stop.is_set() or (early_s > 0 and stop.wait(early_s)):
                return
            if image is None:
                unreadable += 1
                continue
            camera = look.camera_for(image)
            if tracker is None and look.board is not None and camera is not None:
                assert self.detector is not None
                tracker = Tracker(look.board, camera, self.detector, fps=source.fps or 30.0)
            if is_film and tracker is not None:
                sight = _track(image, (self._count, shown, *frame), tracker)
            else:
                assert self.detector is not None
                sight = _detect(image, (self._count, shown, *frame), self.detector, look, tracker)
            if stop.is_set():  # another source was opened meanwhile
                return
            self._keep(sight)
        if unreadable:
            problem = f"{unreadable} frames cannot be read" if is_film else source.problems.get(name, UNDECODABLE)
            self.problems.append(f"{shown}: {problem}")

    def _thaw(self, stop: threading.Event) -> float:
        """Wait while the picture is frozen. Return for how long, s."""
        start_s = time.monotonic()
        while self.is_frozen and not stop.wait(0.05):
            pass
        return time.monotonic() - start_s

    def _keep(self, sight: SeenImage) -> None:
        """Keep a sight, and drop the picture that is too old."""
        behind = 1 if self.is_film else MOST_PICTURES
        if len(self.kept) >= behind:
            self.kept[-behind] = replace(self.kept[-behind], picture=b"")
        self.kept.append(sight)
        self._count += 1
        self._times_s.append(time.monotonic())


Place = tuple[int, str, int | None, float | None]
"""Number, file, frame and time of an image."""


def _track(image: UInt8, place: Place, tracker: Tracker) -> SeenImage:
    """Follow the board in a frame."""
    start_s = time.perf_counter()
    found = tracker(image, place[3])
    ms = 1000 * (time.perf_counter() - start_s)
    detections = found.match.detections if found.match else Detections.none()
    record = PoseRecord(*place, tracker.board.name, found.pose, found.reason, found.state, found.filtered)
    drawn = draw_detections(image, detections)
    drawn = draw_pose(drawn, found, tracker) if found.state else drawn
    return SeenImage(place[0], detections, record, (image.shape[1], image.shape[0]), ms, _shown(drawn))


def _detect(image: UInt8, place: Place, detector: LoadedDetector, look: Look, tracker: Tracker | None) -> SeenImage:
    """Look for patches in an image, and for the board among them. ``tracker`` only draws the pose."""
    size_px, start_s = (image.shape[1], image.shape[0]), time.perf_counter()
    detections = detector(image)
    record = PoseRecord(*place, "", None, "no board is chosen")
    if look.board is not None:
        of_image = Predictions.from_detections([detections], [place[0]], size=[size_px])
        [record, *_] = locate_boards(of_image, [look.board], look.camera_for(image))[1]
        record = replace(record, file=place[1], frame_index=place[2], time_s=place[3])
    ms = 1000 * (time.perf_counter() - start_s)
    drawn = draw_detections(image, detections)
    if record.pose is not None and tracker is not None:
        drawn = draw_pose(drawn, TrackedPose("seen", record.pose), tracker)
    return SeenImage(place[0], detections, record, size_px, ms, _shown(drawn))


def _shown(drawn: UInt8) -> bytes:
    """Return a picture as JPEG, at most ``LARGEST_SHOWN_PX`` long."""
    scale = LARGEST_SHOWN_PX / max(drawn.shape)
    if scale < 1:
        drawn = np.asarray(cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return encode_jpeg(drawn, SHOWN_QUALITY)


def _written(name: str, write: Callable[[Path], None]) -> bytes:
    """Return what a function writes to a file of a name."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return read_bytes(path, is_noted=False)


def point_rows(sight: SeenImage, names: Mapping[int, str]) -> list[dict[str, Any]]:
    """Return the detections of an image as rows of a table, the best first. ``names`` are those of the designs."""
    found, rows = sight.detections, list[dict[str, Any]]()
    for n in np.argsort(-found.score, kind="stable").tolist():
        patch_id = None if found.patch_id is None else int(found.patch_id[n])
        x, y = found.xy[n].tolist()
        design = "" if patch_id is None else f"{patch_id} {names.get(patch_id, '')}".strip()
        axes = None if found.A_patch2image is None else np.linalg.svd(found.A_patch2image[n], compute_uv=False).tolist()
        radii = "" if axes is None else " x ".join(f"{axis:.1f}" for axis in axes)
        row = {"design": design, "x": f"{x:.2f}", "y": f"{y:.2f}", "radii": radii, "score": f"{found.score[n]:.3f}"}
        rows.append({"n": n, **row})
    return rows


def pose_numbers(record: PoseRecord) -> tuple[list[float], list[float]] | None:
    """Return the place of a board, mm, and its rotation vector, degrees; None if its pose was not measured."""
    if record.pose is None:
        return None
    turn_deg = np.degrees(rotation_vector(record.pose.rotation))
    return record.pose.translation_mm.tolist(), turn_deg.tolist()


def describe_pose(record: PoseRecord) -> str:
    """Return a pose in words, or why there is none.

    Examples
    --------
    >>> from kpbench.boards import PoseRecord
    >>> from kpbench.ui.watcher import describe_pose
    >>> describe_pose(PoseRecord(0, "a.png", None, None, "grid", None, "the board was not found"))
    'no pose: the board was not found'
    """
    numbers, pose = pose_numbers(record), record.pose
    if numbers is None or pose is None:
        return f"no pose: {record.reason}"
    place, turn = numbers
    unsure = "; ambiguous: another pose fits as well" if pose.ambiguous else ""
    return (
        f"{record.board}, {record.state}: x {place[0]:.1f}, y {place[1]:.1f}, z {place[2]:.1f} mm; turned by "
        f"{turn[0]:.1f}, {turn[1]:.1f}, {turn[2]:.1f}° about x, y, z; {pose.points} points, "
        f"{pose.reprojection_rms_px:.3f} px rms{unsure}"
    )
