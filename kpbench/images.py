"""Images from where a user has them: a file, a folder, a video, a camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from kpbench.errors import DataError
from kpbench.files import IMAGE_SUFFIXES, image_files, write_atomic
from kpbench.types import UInt8

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
PICTURES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Source:
    """Named images in order: RGB or grey uint8, or None for a file that cannot be decoded.

    ``length`` is their number, None where nobody knows it; ``fps`` that of a video or camera, else None.
    """

    images: Iterator[tuple[str, UInt8 | None]]
    length: int | None
    fps: float | None = None


def open_images(source: str, but: Path | None = None) -> Source:
    """Images of ``camera:N``, a video file, an image file, or a folder (by name, subfolders too, ``but`` for one).

    Raises
    ------
    DataError
        If there is nothing, or nothing that can be opened.
    """
    path = Path(source)
    if source.startswith("camera:"):
        number = source.removeprefix("camera:")
        if not number.isdecimal():
            raise DataError(f"{source}: expected camera:0, camera:1, …")
        return _video(cv2.VideoCapture(int(number)), source, None)
    if path.is_dir():
        files = image_files(path, but)
        if not files:
            raise DataError(f"{path}: neither a dataset nor a folder with images ({', '.join(IMAGE_SUFFIXES)})")
        return Source(((name, _decode(path / name)) for name in files), len(files))
    if not path.exists():
        raise DataError(f"{path}: no such dataset, image, folder or video")
    if path.suffix.lower() in VIDEOS:
        capture = cv2.VideoCapture(str(path))
        return _video(capture, source, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
    image = _decode(path)
    if image is None:
        raise DataError(f"{path}: cannot be decoded as an image")
    return Source(iter([(path.name, image)]), 1)


def check_apart(source: str | Path, target: Path) -> None:
    """Refuse to write images over those that are read.

    Raises
    ------
    DataError
        If the target is the source, or the folder that it lies in.
    """
    given = Path(source).resolve()
    if target.resolve() in (given, *([given.parent] if given.is_file() else [])):
        raise DataError(f"{target}: holds the images themselves, which would be overwritten; name another place")


def _decode(path: Path) -> UInt8 | None:
    try:
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
    except (OSError, cv2.error):
        return None
    return None if image is None else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _video(capture: cv2.VideoCapture, name: str, length: int | None) -> Source:
    if not capture.isOpened():
        raise DataError(f"{name}: cannot be opened as a video")

    def frames() -> Iterator[tuple[str, UInt8 | None]]:
        number = 0
        while True:
            good, frame = capture.read()
            if not good:
                capture.release()
                return
            yield f"{number:08d}.png", np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)
            number += 1

    return Source(frames(), length if length and length > 0 else None, capture.get(cv2.CAP_PROP_FPS) or 25.0)


@contextmanager
def image_writer(
    target: Path | None, count: int | None, fps: float | None = None
) -> Iterator[Callable[[str, UInt8], None]]:
    """Write RGB images: into a folder as PNG under their names, as a video (.mp4), or the only one as a picture (.png).

    ``count`` is how many there will be, None where nobody knows it.

    Raises
    ------
    DataError
        If the target cannot be written.
    """
    if target is None:
        yield lambda name, image: None
        return
    try:
        file = target.suffix.lower() in (*VIDEOS, *PICTURES) and not target.is_dir()
        if file and target.suffix.lower() in PICTURES and count != 1:
            raise DataError(f"{target}: there is more than one image, expected a folder to draw into")
        (target.parent if file else target).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{target}: cannot be written, {error.strerror}") from None
    if not file or target.suffix.lower() in PICTURES:

        def write_file(name: str, image: UInt8) -> None:
            path = target if file else target / (name if name.endswith(".png") else f"{name}.png")
            path.parent.mkdir(parents=True, exist_ok=True)
            # OpenCV itself writes halves of files, and ends the process on names that are no UTF-8
            suffix = path.suffix.lower()
            write_atomic(path, cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes())

        yield write_file
        return
    with _video_writer(target, fps or 25.0) as write:
        yield write


@contextmanager
def _video_writer(target: Path, fps: float) -> Iterator[Callable[[str, UInt8], None]]:
    """Frames as a video, whole or not at all: OpenCV says nothing of a disk that is full."""
    part = target.with_name(f".{target.stem}.part{target.suffix}")
    video: list[cv2.VideoWriter] = []
    sizes = set[tuple[int, int]]()
    written = 0

    def write_frame(name: str, image: UInt8) -> None:
        nonlocal written
        size = (image.shape[1], image.shape[0])
        sizes.add(size)
        if len(sizes) > 1:  # which OpenCV would leave out
            raise DataError(f"{target}: {name} is of another size than those before, expected a folder to draw into")
        if not video:
            video.append(cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*"mp4v"), fps, size))
            if not video[0].isOpened():
                raise DataError(f"{target}: cannot be written as a video, expected a name ending in .mp4")
        video[0].write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        written += 1

    try:
        yield write_frame
        for writer in video:
            writer.release()
        if video and int(cv2.VideoCapture(str(part)).get(cv2.CAP_PROP_FRAME_COUNT)) != written:
            raise DataError(f"{target}: cannot be written whole, is the disk full?")
        if video:
            part.replace(target)
    finally:
        for writer in video:
            writer.release()
        part.unlink(missing_ok=True)


def resize(grey: UInt8, width: int, height: int) -> UInt8:
    """The image in another size; the outer corners of its corner pixels stay where they are."""
    if grey.shape == (height, width):
        return grey
    how = cv2.INTER_CUBIC if width > grey.shape[1] else cv2.INTER_AREA
    return np.asarray(cv2.resize(grey, (width, height), interpolation=how), np.uint8)
