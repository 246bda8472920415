"""Hand image files and video files to OpenCV, within limits. No other module does.

OpenCV refuses an image that declares more than 200 megapixels: ``kpbench/__init__.py`` sets the limit, which OpenCV
reads when it is loaded.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.files import note_read

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_bytes(path: Path) -> NDArray[np.uint8] | None:
    """Return the content of a file; None if the file cannot be read. The name may hold bytes that are no UTF-8."""
    try:
        note_read(path)
        return np.fromfile(path, np.uint8)
    except (OSError, ValueError):  # a ValueError: no file has such a name
        return None


def decode_image(data: NDArray[np.uint8] | None, flags: int) -> NDArray[Any] | None:
    """Return the image that ``cv2.imdecode`` makes of a file's content; None if the content cannot be decoded."""
    if data is None or not len(data) or not _has_whole_chunks(data):
        return None
    try:
        return cv2.imdecode(data, flags)
    except cv2.error:
        return None


def _has_whole_chunks(data: NDArray[np.uint8]) -> bool:
    """Return whether all chunks of a PNG file end within the file. OpenCV reserves memory for what a chunk declares."""
    if data[:8].tobytes() != PNG_SIGNATURE:
        return True
    at = len(PNG_SIGNATURE)
    while at + 8 <= len(data):
        length, kind = int.from_bytes(data[at : at + 4].tobytes(), "big"), data[at + 4 : at + 8].tobytes()
        at += 12 + length
        if kind == b"IEND":
            break
    return at <= len(data)


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
