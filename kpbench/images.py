"""Images: read a file, a folder, a video or a camera; write PNG, JPEG and video; convert and resize.

Images are uint8, grey (H, W) or RGB (H, W, 3).
"""

from __future__ import annotations

import errno
import os
import secrets
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from kpbench.decoding import require_opencv_name
from kpbench.errors import DataError, system_reason
from kpbench.files import IMAGE_SUFFIXES, image_files, make_folder, read_bytes
from kpbench.films import DEFAULT_FPS, VIDEO_SUFFIXES, Film, name_frames, open_animation, open_camera, open_video
from kpbench.pixels import Notes, decode_pixels
from kpbench.tiff import has_more_pages, is_tiff
from kpbench.types import UInt8
from kpbench.writing import move_file, require_writable, write_file

DRAWING_SUFFIXES = (".png", ".jpg", ".jpeg")  # suffixes of an image file into which detections are drawn
UNDECODABLE = "cannot be decoded"
"""Message about an image without pixels."""
PNG_HEAD_BYTES = 33
"""Length of the signature and of the first chunk (IHDR) of a PNG file."""
VIDEO_MARK = b"kpbench.video/1 "
OVERLAY = "overlay"
"""Kind of the images into which detections are drawn."""


@dataclass(frozen=True)
class ImageSource:
    """Named images in order.

    Attributes
    ----------
    images : iterator of (str, ndarray or None)
        Name and pixels of each image. The pixels of a file that cannot be decoded are None.
    length : int or None
        Number of images; None if unknown, as for a camera.
    fps : float or None
        Frames per second of a film or camera; None for files.
    film : str
        The film or camera whose frames the images are; "" for files.
    problems : dict of str to str
        Why an image has no pixels, by name, filled while ``images`` is read. A name that is not here could not be
        decoded.
    names : tuple of str or None
        The names of all images; None if they are the numbers of frames, such as ``00000012.png``.
    folder : str
        Folder of the images, as it was given; "" for none.
    """

    images: Iterator[tuple[str, UInt8 | None]]
    length: int | None
    fps: float | None = None
    film: str = ""
    problems: dict[str, str] = field(default_factory=dict)
    names: tuple[str, ...] | None = None
    folder: str = ""

    def locate(self, name: str) -> tuple[str, int, float]:
        """Return the file of an image, the number of its frame (-1 for none), and its time in a film, s (nan for none).

        Examples
        --------
        >>> from kpbench.images import ImageSource
        >>> ImageSource(iter(()), 0, folder="photos").locate("a.png")
        ('photos/a.png', -1, nan)
        >>> ImageSource(iter(()), 100, 25.0, "film.mp4").locate("00000050.png")
        ('film.mp4', 50, 2.0)
        """
        if not self.film:
            return (Path(self.folder) / name).as_posix(), -1, np.nan
        frame = int(Path(name).stem)
        return self.film, frame, frame / self.fps if self.fps and self.length is not None else np.nan

    def describe_failures(self, failures: Sequence[tuple[str, str]]) -> list[str]:
        """Return failures, each a name and a message, in lines; one line for all frames with the same message."""
        if not self.film:
            return [f"{name}: {message}" for name, message in failures]
        frames: dict[str, list[int]] = {}
        for name, message in failures:
            frames.setdefault(message, []).append(int(Path(name).stem))
        lines = []
        for message, numbers in frames.items():
            problem = " cannot be read" if message == UNDECODABLE else f": {message}"
            lines.append(f"{self.film}: {name_frames(numbers, self.length)}{problem}")
        return lines


def open_images(source: str, exclude: Path | None = None) -> ImageSource:
    """Open ``camera:N``, a video file, an image file, or a folder of images.

    The images of a folder and of its subfolders come in the order of their paths. Images below the folder ``exclude``
    are left out.

    Raises
    ------
    DataError
        If the source does not exist, holds no image, or cannot be opened.
    """
    path = Path(source)
    if source.startswith("camera:"):
        number = source.removeprefix("camera:")
        if not number.isdecimal():
            raise DataError(f"{source}: expected camera:0, camera:1, …")
        return _source_of(open_camera(int(number)), source)
    if path.is_dir():
        files = image_files(path, exclude)
        if not files:
            raise DataError(f"{path}: neither a dataset nor a folder with images ({', '.join(IMAGE_SUFFIXES)})")
        problems: dict[str, str] = {}
        return ImageSource(read_files(path, files, problems), len(files), problems=problems, names=files, folder=source)
    if not path.exists():
        raise DataError(f"{path}: no such dataset, image, folder or video")
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return _source_of(open_video(path), source)
    image = _read_image(path, Notes())
    if isinstance(image, Film):
        return _source_of(image, source)
    if isinstance(image, str):
        raise DataError(f"{path}: {image}{' as an image of at most 200 megapixels' if image == UNDECODABLE else ''}")
    return ImageSource(iter([(path.name, image)]), 1, names=(path.name,), folder=str(path.parent))


def refuse_same_folder(source: str | Path, target: Path) -> None:
    """Raise an error if the target is the source, or the folder of the source file.

    Raises
    ------
    DataError
        If the images would be overwritten.
    """
    given = Path(source).resolve()
    if target.resolve() in (given, *([given.parent] if given.is_file() else [])):
        raise DataError(f"{target}: holds the images themselves, which would be overwritten; name another place")


def read_files(folder: Path, names: Sequence[str], problems: dict[str, str]) -> Iterator[tuple[str, UInt8 | None]]:
    """Yield name and pixels of each file of a folder; see :class:`ImageSource`, whose ``problems`` are filled."""
    notes = Notes()
    for name in names:
        found = _read_image(folder / name, notes)
        if isinstance(found, Film):
            notes.warn(folder / name, "is a film, of which only the first frame is read; name the file to read it all")
            yield name, next(found.frames)
        elif isinstance(found, str):
            problems[name] = found
            yield name, None
        else:
            yield name, found


def _read_image(path: Path, notes: Notes | None) -> UInt8 | Film | str:
    """Return the pixels of an image file, or the film that it is, or why it cannot be read."""
    try:
        data = np.frombuffer(read_bytes(path), np.uint8)
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):  # no later file could be read either
            raise DataError(f"{path}: cannot be read, {system_reason(error)}") from None
        return f"cannot be read, {system_reason(error) or error}"
    film = open_animation(path, data, notes)
    if film is not None:
        return film
    try:
        image = decode_pixels(data, 3, rotate=True, name=path, notes=notes)
    except DataError as error:  # of the memory
        return str(error)
    if image is not None and notes is not None and is_tiff(data[:4].tobytes()) and has_more_pages(data.tobytes()):
        notes.warn(path, "has several pages, of which only the first is read")
    return UNDECODABLE if image is None else image


def _source_of(film: Film, name: str) -> ImageSource:
    return ImageSource(((f"{n:08d}.png", frame) for n, frame in enumerate(film.frames)), film.length, film.fps, name)


@contextmanager
def image_writer(
    target: Path | None, count: int | None, fps: float | None = None, names: Iterable[str] | None = None
) -> Iterator[Callable[[str, UInt8 | None], None]]:
    """Yield a function that writes RGB images under their names.

    The target decides the form: a folder of PNG files, one video (.mp4), or one image (.png, .jpg). With no target,
    nothing is written. An image may be None: a video gets a black frame, so that later frames keep their places.

    Parameters
    ----------
    target : Path or None
    count : int or None
        Number of images; None if unknown.
    fps : float or None
        Frames per second of a video.
    names : iterable of str or None
        The names of all images, see :class:`ImageSource`.

    Raises
    ------
    DataError
        If the target cannot be written, or is one image file while ``count`` is not 1. Files that must not be replaced
        are refused before the first image.
    """
    if target is None:
        yield lambda name, image: None
        return
    suffix = target.suffix.lower()
    to_file = suffix in (*VIDEO_SUFFIXES, *DRAWING_SUFFIXES) and not target.is_dir()
    if to_file and suffix in DRAWING_SUFFIXES and count != 1:
        raise DataError(f"{target}: there is more than one image, expected a folder to draw into")
    make_folder(target.parent if to_file else target)
    if to_file and suffix in VIDEO_SUFFIXES:
        with _video_writer(target, fps or DEFAULT_FPS) as write_frame:
            yield write_frame
        return

    if to_file:
        require_writable(target, OVERLAY)
    else:
        require_drawable(target, names, OVERLAY)

    def write_drawing(name: str, image: UInt8 | None) -> None:
        if image is None:
            return
        path = target if to_file else target / drawing_name(name)
        make_folder(path.parent)
        # cv2.imwrite leaves half a file on a full disk, and ends the process if a name is not UTF-8
        write_file(path, _encode(image, path.suffix.lower(), [], OVERLAY))

    yield write_drawing


def drawing_name(name: str) -> str:
    """Return the name of the PNG file that is made from an image. Different images have different names.

    Examples
    --------
    >>> from kpbench.images import drawing_name
    >>> [drawing_name(name) for name in ("a.png", "a.jpg", "a.jpg.png")]
    ['a.png', 'a.jpg.png', 'a.jpg.png.png']
    """
    is_png_alone = name.endswith(".png") and Path(name[:-4]).suffix.lower() not in IMAGE_SUFFIXES
    return name if is_png_alone else f"{name}.png"


def require_drawable(folder: Path, names: Iterable[str] | None, kind: str) -> None:
    """Refuse, before any work is done, a folder in which the PNG files of images would replace other files.

    Parameters
    ----------
    folder : Path
    names : iterable of str or None
        The names of all images, see :class:`ImageSource`. With None, all PNG files that are named like frames count.
    kind : str
        The kind of the PNG files, see :mod:`kpbench.writing`.

    Raises
    ------
    DataError
        The message names a file that must not be replaced.
    """
    targets = folder.glob(f"{'[0-9]' * 8}.png") if names is None else (folder / drawing_name(name) for name in names)
    for target in targets:
        if os.path.lexists(target):
            require_writable(target, kind)


@contextmanager
def _video_writer(target: Path, fps: float) -> Iterator[Callable[[str, UInt8 | None], None]]:
    """Yield a function that appends a frame to a video. The video is written whole or not at all.

    OpenCV reports no error when the disk is full. The number of frames is therefore counted at the end.
    """
    require_writable(target, "video")
    require_opencv_name(target)
    part = target.with_name(f".{target.stem}.{secrets.token_hex(4)}.part{target.suffix}")
    video: list[cv2.VideoWriter] = []
    sizes = set[tuple[int, int]]()
    written = black = 0

    def write_frame(name: str, image: UInt8 | None) -> None:
        nonlocal written, black
        if image is None:
            black += 1  # written before the next image, whose size it has
            return
        size = (image.shape[1], image.shape[0])
        sizes.add(size)
        if len(sizes) > 1:  # OpenCV would silently drop the frame
            raise DataError(f"{target}: {name} differs in size from the images before, expected a folder to draw into")
        if not video:
            video.append(cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*"mp4v"), fps, size))
            if not video[0].isOpened():
                raise DataError(f"{target}: cannot be written as a video, expected a name ending in .mp4")
        for frame in [np.zeros_like(image)] * black + [image]:
            video[0].write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        written, black = written + black + 1, 0

    try:
        yield write_frame
        for writer in video:
            writer.release()
        if video and int(cv2.VideoCapture(str(part)).get(cv2.CAP_PROP_FRAME_COUNT)) != written:
            raise DataError(f"{target}: cannot be written whole, is the disk full?")
        if video:
            with part.open("ab") as file:
                file.write(_video_mark(target.suffix.lower()))
            move_file(part, target)
    finally:
        for writer in video:
            writer.release()
        part.unlink(missing_ok=True)


def _video_mark(suffix: str) -> bytes:
    """Return kpbench's mark in an element that players skip: Matroska's Void, AVI's JUNK chunk, or MP4's free box."""
    if suffix in (".mkv", ".webm"):
        return b"\xec" + bytes([0x80 | len(VIDEO_MARK)]) + VIDEO_MARK
    if suffix == ".avi":
        return b"JUNK" + struct.pack("<I", len(VIDEO_MARK)) + VIDEO_MARK
    return struct.pack(">I", 8 + len(VIDEO_MARK)) + b"free" + VIDEO_MARK


def resize(grey: UInt8, width: int, height: int) -> UInt8:
    """Return a grey image in another size. The outer corners of the two images coincide."""
    if grey.shape == (height, width):
        return grey
    how = cv2.INTER_CUBIC if width > grey.shape[1] else cv2.INTER_AREA
    return np.asarray(cv2.resize(grey, (width, height), interpolation=how), np.uint8)


def to_grey(image: UInt8) -> UInt8:
    """Return a grey (H, W) or RGB (H, W, 3) image as grey (H, W).

    Raises
    ------
    DataError
        If the array has another shape or type.
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise DataError(f"image of shape {image.shape} and type {image.dtype}, expected uint8 (H, W) or (H, W, 3)")
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def read_rgb(path: Path) -> UInt8 | None:
    """Return an image as RGB, rotated by its EXIF data, as :func:`open_images` reads it; None if it cannot be read."""
    image = _read_image(path, None)
    if isinstance(image, Film):
        return next(image.frames)
    return None if isinstance(image, str) else image


def decode_photo(path: Path, channels: int) -> UInt8 | None:
    """Return a photograph as grey (``channels`` 1) or RGB (``channels`` 3), not rotated by its EXIF data.

    Return None if the file cannot be decoded, or the image has a side under 8 px.
    """
    try:
        image = decode_pixels(np.frombuffer(read_bytes(path), np.uint8), channels, rotate=False)
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):
            raise DataError(f"{path}: cannot be read, {system_reason(error)}") from None
        return None
    return None if image is None or min(image.shape[:2]) < 8 else image


def encode_png(image: UInt8, kind: str) -> bytes:
    """Return a grey or RGB image as the content of a PNG file, whose mark names a kind of file.

    Each command gives its own kind to its images, because only a file of the same kind is replaced:
    see :mod:`kpbench.writing`.
    """
    return _encode(image, ".png", [], kind)


def encode_jpeg(image: UInt8, quality: int) -> bytes:
    """Return a grey or RGB image as the content of a JPEG file; ``quality`` is from 1 to 100."""
    return _encode(image, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality], "picture")


def _encode(image: UInt8, suffix: str, settings: list[int], kind: str) -> bytes:
    """Return an image file with a mark: PNG has a text chunk, JPEG a comment."""
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    data = cv2.imencode(suffix, pixels, settings)[1].tobytes()
    mark = f"kpbench.{kind}/1".encode()
    if suffix == ".png":
        chunk = b"tEXtSoftware\0" + mark
        chunk = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        return data[:PNG_HEAD_BYTES] + chunk + data[PNG_HEAD_BYTES:]
    return data[:2] + b"\xff\xfe" + struct.pack(">H", len(mark) + 2) + mark + data[2:]
