"""Hand image files and video files to OpenCV, within limits. No other module does.

OpenCV refuses an image that declares more than 200 megapixels: ``kpbench/__init__.py`` sets the limit, which OpenCV
reads when it is loaded.
"""

from __future__ import annotations

import io
import os
import re
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.memory import require_memory
from kpbench.tiff import is_tiff, names_all_pixels

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
MOST_PIXELS = int(os.environ.get("OPENCV_IO_MAX_IMAGE_PIXELS", "200000000"))
"""Largest number of pixels of an image that OpenCV decodes."""
MOST_PIXELS_TWICE = 2**25
"""Largest number of pixels of an image that Pillow looks at before OpenCV. Larger images would take much memory."""
DECODING_BYTES_PER_PIXEL = 16
"""Memory per pixel while an image is decoded, bytes."""
MOST_PIXELS_PER_BYTE = 2_000
"""Largest number of pixels of all frames of an animation, per byte of its file. Films have a few pixels per byte."""


def decode_image(data: NDArray[np.uint8], flags: int) -> NDArray[Any] | None:
    """Return the image that ``cv2.imdecode`` makes of a file's content; None if the content cannot be decoded.

    Raises
    ------
    DataError
        If the memory is too small for the image.
    """
    if not len(data) or not _is_whole(data):
        return None
    try:
        return cv2.imdecode(data, flags)
    except cv2.error:
        return None


def _is_whole(data: NDArray[np.uint8]) -> bool:
    """Return whether all pixels of an image file lie within the file. OpenCV fills up what is missing."""
    content = data.tobytes()
    if content.startswith(PNG_SIGNATURE):
        _require_memory(*struct.unpack(">II", content[16:24].ljust(8, b"\0")))
        return is_whole_png(content)
    if is_tiff(content) and not names_all_pixels(content):
        return False
    return _is_whole_for_pillow(content)


def _require_memory(width: int, height: int) -> None:
    if width * height <= MOST_PIXELS:
        require_memory(width * height * DECODING_BYTES_PER_PIXEL, f"an image of {width} x {height} pixels")


def is_whole_png(content: bytes, first_frame_alone: bool = False) -> bool:
    """Check that all chunks end within the file, the checksums, and the number of bytes of the pixels (ISO 15948).

    With ``first_frame_alone``, the file may end after the pixels of the first frame.
    """
    at, header, unpack, count = len(PNG_SIGNATURE), b"", zlib.decompressobj(), 0
    while at + 8 <= len(content):
        length, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        chunk, checksum = content[at + 8 : at + 8 + length], content[at + 8 + length : at + 12 + length]
        if kind == b"IEND":
            break
        if len(checksum) < 4:  # OpenCV reserves memory for what a chunk declares
            if first_frame_alone:
                break
            return False
        if kind in (b"IHDR", b"PLTE", b"IDAT") and zlib.crc32(kind + chunk) != int.from_bytes(checksum, "big"):
            return False
        if kind == b"IHDR" and header:
            return False
        header = header or chunk
        if kind == b"IDAT":
            try:
                while chunk and not unpack.eof:
                    count += len(unpack.decompress(chunk, 2**22))
                    chunk = unpack.unconsumed_tail
            except zlib.error:
                return False
        at += 12 + length
    return len(header) == 13 and count >= _png_bytes(header)


def _png_bytes(header: bytes) -> int:
    """Return the number of bytes of the pixels of a PNG file, unpacked: each row has a byte for its filter."""
    width, height, bits, colour, _, _, interlaced = struct.unpack(">IIBBBBB", header)
    samples = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colour, 4)
    # (first column, first row, step of columns, step of rows) of each pass of Adam7
    passes = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)]
    total = 0
    for x, y, dx, dy in passes if interlaced else [(0, 0, 1, 1)]:
        columns, rows = -(-(width - x) // dx), -(-(height - y) // dy)
        total += rows * (1 + -(-columns * bits * samples // 8)) if columns > 0 and rows > 0 else 0
    return total


def _is_whole_for_pillow(content: bytes) -> bool:
    """Return False if Pillow finds that pixels are missing. OpenCV does not tell. Pillow knows fewer kinds of files."""
    from PIL import Image, UnidentifiedImageError

    limit = Image.MAX_IMAGE_PIXELS
    try:
        Image.MAX_IMAGE_PIXELS = None  # of large images, OpenCV decides
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(content)) as image:
                _require_memory(image.width, image.height)
                pixels = image.width * image.height
                if image.format in ("GIF", "JPEG", "JPEG2000", "WEBP") and pixels > MOST_PIXELS_PER_BYTE * len(content):
                    return False
                image.draft("RGB", (1, 1))  # a JPEG file is read whole, but made only an eighth as wide
                if pixels <= MOST_PIXELS_TWICE or image.format == "JPEG":
                    image.load()
    except OSError as error:
        if isinstance(error, UnidentifiedImageError) and content.startswith((b"GIF8", b"RIFF")):
            return False  # OpenCV would take memory for the size that the file declares
        return not re.search("truncated|broken data stream", str(error))
    except DataError:
        raise
    except Exception:  # Pillow's plugins raise errors of many classes for what they do not know
        return True
    finally:
        Image.MAX_IMAGE_PIXELS = limit
    return True


def require_opencv_name(path: Path) -> None:
    """Refuse the path of a video whose name OpenCV cannot open. OpenCV would end the process.

    Raises
    ------
    DataError
        If the path is not UTF-8 text.
    """
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        raise DataError(f"{path}: its name is no UTF-8 text, expected another name for a video") from None
