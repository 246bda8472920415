"""Films: videos, cameras and animated images as frames in order, with the frames that cannot be read.

A frame that cannot be read is None, in its true place. ``docs/reference/detectors.md`` states the rules.
"""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.containers import require_sound_container
from kpbench.decoding import MOST_PIXELS_PER_BYTE, is_whole_png, require_opencv_name
from kpbench.errors import DataError, KpbenchWarning
from kpbench.pixels import TRANSPARENT, Notes, lay_on_white, png_chunk
from kpbench.types import UInt8

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
COUNTING_SUFFIXES = (".mp4", ".avi", ".mov", ".m4v")
"""Videos that state the number of their frames. Others state a duration, which may be that of their sound."""
DEFAULT_FPS = 25.0  # frames per second, of a film or camera that states no frame rate
LEAST_FRAME_BYTES = 8
"""Bytes in the file per frame; a file that states more frames states a wrong number."""
MOST_BAD_FRAMES = 300
"""Reading ends after so many frames in a row that cannot be read."""
FRAMES_IN_DECODER = 32
"""A decoder of several threads may report a bad frame so many frames early."""
MOST_FRAME_PIXELS = 2**24
"""Largest number of pixels of a frame of a GIF, an APNG or a WebP."""


@dataclass(frozen=True)
class Film:
    """The frames of a film.

    Attributes
    ----------
    frames : iterator of ndarray or None
        RGB pixels; None for each frame that cannot be read.
    length : int or None
        Number of frames; None if unknown.
    fps : float
        Frames per second.
    """

    frames: Iterator[UInt8 | None]
    length: int | None
    fps: float


def open_video(path: Path) -> Film:
    """Open a video file.

    Raises
    ------
    DataError
        If the file cannot be opened as a video.
    """
    require_opencv_name(path)
    require_sound_container(path)
    capture = _open(cv2.VideoCapture(str(path)), str(path))
    stated = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    length = stated if 0 < stated <= path.stat().st_size // LEAST_FRAME_BYTES else None
    if length is None and stated > 0:
        warnings.warn(f"{path}: states {stated} frames, more than it can hold", KpbenchWarning, stacklevel=3)
    fps = _fps(capture)
    frames = _video_frames(capture, length, fps, path.suffix.lower() in COUNTING_SUFFIXES)
    return Film(_require_any(frames, path), length, fps)


def open_camera(number: int) -> Film:
    """Open a camera. Its frames end at the first frame that cannot be read.

    Raises
    ------
    DataError
        If there is no such camera.
    """
    capture = _open(cv2.VideoCapture(number), f"camera:{number}")

    def frames() -> Iterator[UInt8 | None]:
        while (found := capture.read())[0]:
            yield _rgb(found[1])
        capture.release()

    return Film(frames(), None, _fps(capture))


def _open(capture: cv2.VideoCapture, name: str) -> cv2.VideoCapture:
    if not capture.isOpened():
        raise DataError(f"{name}: cannot be opened as a video")
    return capture


def _fps(capture: cv2.VideoCapture) -> float:
    stated = capture.get(cv2.CAP_PROP_FPS)
    return stated if 0 < stated < np.inf else DEFAULT_FPS


def _rgb(frame: NDArray[Any]) -> UInt8:
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)


def _require_any(frames: Iterator[UInt8 | None], path: Path) -> Iterator[UInt8 | None]:
    """Pass the frames on; raise an error if there are none."""
    is_empty = True
    for frame in frames:
        is_empty = False
        yield frame
    if is_empty:
        raise DataError(f"{path}: holds no frame that can be read")


def _video_frames(
    capture: cv2.VideoCapture, length: int | None, fps: float, is_counted: bool
) -> Iterator[UInt8 | None]:
    """Yield every frame in its place.

    A failed reading does not tell how many frames it skipped. The time stamp of the next good frame does.
    """
    number, failures, start_ms = 0, 0, 0.0
    while length is None or number < length or not failures:
        try:
            good, frame = capture.read()
        except cv2.error:  # of a frame that declares too many bytes
            good = False
        if not good:
            failures += 1
            missing = 0 if length is None else min(MOST_BAD_FRAMES, length - number)
            if failures > missing + FRAMES_IN_DECODER:
                break
            continue
        stamp_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
        if not number and not failures:
            start_ms = stamp_ms
        if failures:
            is_stamped = 0 < stamp_ms < np.inf and np.isfinite(start_ms)
            place = round((stamp_ms - start_ms) * fps / 1000) if is_stamped else number + failures
            last = number + failures + MOST_BAD_FRAMES if length is None else length - 1
            skipped = max(0, min(place, last) - number)
            yield from [None] * skipped
            number, failures = number + skipped, 0
        yield _rgb(frame)
        number += 1
    capture.release()
    missing = 0 if length is None else length - number
    if is_counted or missing > fps:
        yield from [None] * missing


def open_animation(path: Path, data: NDArray[np.uint8], notes: Notes | None = None) -> Film | None:
    """Open a GIF, an APNG or a WebP with more than one frame; None if the file is none.

    Each frame is drawn over the earlier ones. After a frame that cannot be read, no later frame can be read.
    ``notes`` : warns of transparency that was removed; None warns of nothing.
    """
    head = data[:21].tobytes()
    is_gif = head[:6] in (b"GIF87a", b"GIF89a")
    is_webp = head[:4] == b"RIFF" and head[8:16] == b"WEBPVP8X" and len(head) == 21 and bool(head[20] & 2)
    is_apng = bool(png_chunk(data, b"acTL"))
    if not (is_gif or is_webp or is_apng) or (is_apng and not is_whole_png(data.tobytes(), first_frame_alone=True)):
        return None
    try:
        image, length = _open_frames(data.tobytes(), is_webp)
    except Exception:  # damaged in a way that Pillow has an error of its own for; OpenCV may read the first frame
        return None
    if length < 2:
        return None
    width, height = _largest_gif_extent(data.tobytes(), image.size) if is_gif else image.size
    pixels = width * height
    if pixels > MOST_FRAME_PIXELS or length * pixels > MOST_PIXELS_PER_BYTE * len(data):
        raise DataError(
            f"{path}: declares {length} frames of {width} x {height} in {len(data)} bytes, "
            f"expected at most {MOST_FRAME_PIXELS} pixels, and {MOST_PIXELS_PER_BYTE} pixels of all frames per byte"
        )
    if is_gif and not data[-64:].tobytes().rstrip(b"\0").endswith(b";"):
        warnings.warn(f"{path}: is cut off after frame {length - 1}", KpbenchWarning, stacklevel=2)

    def frames() -> Iterator[UInt8 | None]:
        for n in range(length):
            try:
                image.seek(n)
                pixels = np.asarray(image.convert("RGBA"), np.uint8)
            except Exception:
                yield from [None] * (length - n)
                return
            is_transparent = bool(pixels[..., 3].min() < 255)
            if is_transparent and notes is not None:
                notes.warn(path, TRANSPARENT)
            yield lay_on_white(pixels) if is_transparent else np.ascontiguousarray(pixels[..., :3])

    duration_ms = image.info.get("duration") or 1000 / DEFAULT_FPS
    return Film(frames(), length, 1000 / duration_ms)


def _open_frames(content: bytes, is_webp: bool) -> tuple[Any, int]:
    """Return an animation as Pillow opens it, and the number of its frames. A frame that is cut off counts as one."""
    from PIL import Image

    content, lost = _keep_whole_frames(content) if is_webp else (content, 0)
    image = Image.open(io.BytesIO(content))
    if is_webp:
        image.load()  # which reads the duration
    try:
        return image, getattr(image, "n_frames", 1) + lost
    except Exception:  # a GIF that ends within the head of a frame
        return Image.open(io.BytesIO(content)), image.tell() + 2


def _largest_gif_extent(content: bytes, size: tuple[int, int]) -> tuple[int, int]:
    """Return the width and height that hold all frames of a GIF. A frame may reach out of the picture's stated size."""
    (width, height), at = size, 13 + _color_table_bytes(content[10])
    while at + 10 <= len(content) and content[at] in b"\x21\x2c":
        if content[at] == 0x2C:
            x, y, w, h = struct.unpack_from("<4H", content, at + 1)
            width, height = max(width, x + w), max(height, y + h)
            at += 11 + _color_table_bytes(content[at + 9])
        else:
            at += 2
        while at < len(content) and content[at]:
            at += 1 + content[at]
        at += 1
    return width, height


def _color_table_bytes(flags: int) -> int:
    """Return the size of the table of colours that follows a head of a GIF with these flags."""
    return 3 << (flags & 7) + 1 if flags & 0x80 else 0


def _keep_whole_frames(content: bytes) -> tuple[bytes, int]:
    """Return a WebP without the chunk in which it is cut off, and the number (0 or 1) of frames that this takes."""
    at = 12
    while at + 8 <= len(content):
        stop = at + 8 + int.from_bytes(content[at + 4 : at + 8], "little")
        if stop > len(content):
            break
        at = stop + stop % 2
    if at >= len(content):
        return content, 0
    return content[:4] + (at - 8).to_bytes(4, "little") + content[8:at], 1


def name_frames(numbers: Iterable[int], length: int | None = None) -> str:
    """Return frames in words, in order, and the number of all frames if it is known.

    Examples
    --------
    >>> from kpbench.films import name_frames
    >>> name_frames([7, 12, 13, 14], 30)
    'frames 7 and 12 to 14 of 30'
    """
    runs: list[Sequence[int]] = [
        [n for _, n in run] for _, run in groupby(enumerate(sorted(numbers)), lambda pair: pair[1] - pair[0])
    ]
    words = [f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs]
    *some, last = words if len(words) <= 8 else [*words[:7], f"{sum(map(len, runs[7:]))} more"]
    plural = "" if len(runs) == 1 and len(runs[0]) == 1 else "s"
    return f"frame{plural} {', '.join(some)}{' and ' if some else ''}{last}" + (f" of {length}" if length else "")
