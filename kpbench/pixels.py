"""Pixels: decode image files to 8 bits, grey (H, W) or RGB (H, W, 3).

A picture of 16 bits keeps the 8 highest of the bits that it uses. A transparent picture is laid on white.
``docs/reference/detectors.md`` states the rules.
"""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.decoding import decode_image
from kpbench.errors import KpbenchWarning
from kpbench.files import open_file
from kpbench.tiff import is_tiff, read_tag
from kpbench.types import UInt8

DEPTHS = (8, 10, 12, 14, 16)
"""Bits per sample of cameras that store 16-bit pictures."""
_PNG_SIGNATURE, _JPEG_SIGNATURE = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_ORIENTATION, _MAX_SAMPLE_VALUE, _EXTRA_SAMPLES = 274, 281, 338
"""TIFF tags: how the camera was held; the largest value of the samples; what further channels are (1, 2: opacity)."""
BAND_PIXELS = 2**17
"""Number of pixels that are laid on white at once."""
_PNG_GREY_ALPHA, _PNG_RGBA = 4, 6
"""Colour types of PNG (ISO 15948, 11.2.2)."""


SIDEWAYS = (5, 6, 7, 8)
"""Orientations of EXIF in which the width of the stored pixels is the height of the picture."""


TRANSPARENT = "is transparent, and is laid on white"


class Notes:
    """Warns once of each kind of picture that is not read as it is, with the first such file as the example."""

    def __init__(self) -> None:
        self._given = set[str]()

    def warn(self, name: object, kind: str) -> None:
        """Warn of a file, unless an earlier file was of the same kind."""
        if kind not in self._given:
            self._given.add(kind)
            warnings.warn(f"{name}: {kind}", KpbenchWarning, stacklevel=2)


def decode_pixels(
    data: NDArray[np.uint8], channels: int, rotate: bool, name: object = "", notes: Notes | None = None
) -> UInt8 | None:
    """Return the content of an image file as grey (``channels`` 1) or RGB (``channels`` 3) pixels.

    Parameters
    ----------
    data : ndarray of uint8
    channels : int
    rotate : bool
        Whether to rotate the picture as its EXIF data says.
    name : object
        Name of the file, for warnings.
    notes : Notes, optional
        Warns of bits that were dropped and of transparency that was removed. None warns of nothing.

    Returns
    -------
    ndarray or None
        None if the data cannot be decoded.
    """
    is_jpeg = data[:3].tobytes() == _JPEG_SIGNATURE  # OpenCV and Pillow rotate some by a damaged EXIF block in two ways
    flags = cv2.IMREAD_GRAYSCALE if channels == 1 else cv2.IMREAD_COLOR
    flags |= 0 if rotate and not is_jpeg else cv2.IMREAD_IGNORE_ORIENTATION
    try:
        special = None if _is_plain(data) else _decode_deep_or_transparent(data, rotate, name, notes)
        if special is not None:
            return np.asarray(
                cv2.cvtColor(special, cv2.COLOR_BGR2GRAY if channels == 1 else cv2.COLOR_BGR2RGB), np.uint8
            )
        image = decode_image(data, flags)
        if image is not None and rotate and is_jpeg:
            image = _rotate(image, data)
        largest = _largest_value(data)
        if image is not None and 0 < largest < 255:
            image = cv2.LUT(image, np.array([min(255, round(v / largest * 255)) for v in range(256)], np.uint8))
        if image is None or channels == 1:
            return None if image is None else np.asarray(image, np.uint8)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
    except cv2.error:
        return None


def lay_on_white(image: UInt8, is_multiplied: bool = False) -> UInt8:
    """Return an image with a fourth channel of opacity (H, W, 4) as its three colours over white.

    ``is_multiplied`` : whether the colours are multiplied by the opacity already, as libtiff gives them.
    """
    result = np.empty((*image.shape[:2], 3), np.uint8)
    step = max(1, BAND_PIXELS // max(1, image.shape[1]))
    for row in range(0, len(image), step):  # in bands of rows, as a pixel takes 50 bytes here
        band = image[row : row + step]
        opacity = band[..., 3:].astype(np.uint32)
        ink = 255 * band[..., :3].astype(np.uint32) if is_multiplied else band[..., :3] * opacity
        result[row : row + step] = np.minimum((ink + 255 * (255 - opacity) + 127) // 255, 255)
    return result


def bits_used(largest: int, declared: int | None = None) -> int:
    """Return how many bits the samples of a 16-bit picture use.

    Parameters
    ----------
    largest : int
        Largest sample of the picture.
    declared : int, optional
        Bits that the file says its samples use. A file whose samples need more bits has scaled them to 16 bits.

    Examples
    --------
    >>> from kpbench.pixels import bits_used
    >>> bits_used(1000), bits_used(1000, declared=12), bits_used(65000, declared=12)
    (10, 12, 16)
    """
    if declared is not None:
        return declared if largest < 2**declared else 16
    return next(bits for bits in DEPTHS if largest < 2**bits)


def _is_plain(data: NDArray[np.uint8]) -> bool:
    """Return whether a file surely has 8 bits per sample and no transparency, so that one decoding is enough."""
    head = data[:64].tobytes()
    if head.startswith(_PNG_SIGNATURE) and len(head) >= 26:
        return head[24] <= 8 and head[25] not in (_PNG_GREY_ALPHA, _PNG_RGBA) and not png_chunk(data, b"tRNS")
    # 32-bit BMP files hold 0 in the fourth byte, which is no transparency
    return head.startswith((_JPEG_SIGNATURE, b"BM"))


def _decode_deep_or_transparent(
    data: NDArray[np.uint8], rotate: bool, name: object, notes: Notes | None
) -> NDArray[np.uint8] | None:
    """Return the BGR pixels of a picture that uses 9 to 15 bits or is transparent; None for any other picture."""
    image: Any = decode_image(data, cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        return None
    bits = 8 if image.dtype == np.uint8 else 16
    has_opacity = image.ndim == 3 and image.shape[2] == 4 and not _has_other_channel(data)
    is_transparent = has_opacity and bool((image[..., 3] < 2**bits - 1).any())
    if bits == 16:
        samples = image[..., :3] if image.ndim == 3 and image.shape[2] == 4 else image
        declared = _declared_bits(data)
        used = bits_used(int(samples.max(initial=0)), declared)
        if used == 16 and not is_transparent:
            return None
        if used < 16 and declared is None and notes is not None:
            notes.warn(name, f"is of 16 bits, of which its largest pixel needs {used}; these are scaled to 8")
        opacity = [image[..., 3] >> 8] if is_transparent else []
        image = np.dstack([samples >> (used - 8), *opacity]).astype(np.uint8)
    elif not is_transparent:
        return None
    if image.ndim == 2 or image.shape[2] == 1:
        image = np.dstack([image] * 3)
    if is_transparent:
        if notes is not None:
            notes.warn(name, TRANSPARENT)
        image = lay_on_white(image, is_multiplied=bits == 8 and is_tiff(data[:4].tobytes()))
    return _rotate(image[..., :3], data) if rotate else np.ascontiguousarray(image[..., :3])


def _declared_bits(data: NDArray[np.uint8]) -> int | None:
    """Return the bits per sample that a PNG (chunk sBIT) or a TIFF (tag MaxSampleValue) says it uses, else None."""
    if data[:8].tobytes() == _PNG_SIGNATURE:
        declared = max(png_chunk(data, b"sBIT"), default=0)
        return declared if 8 <= declared < 16 else None
    largest = max(read_tag(data.tobytes(), _MAX_SAMPLE_VALUE), default=0)
    return max(8, largest.bit_length()) if 0 < largest < 2**16 - 1 else None


def _largest_value(data: NDArray[np.uint8]) -> int:
    """Return the value of white that a PGM or a PPM declares, which OpenCV ignores; 255 for any other file."""
    head = re.sub(rb"#[^\n]*\n", b" ", data[:512].tobytes()) if data[:1].tobytes() == b"P" else b""
    found = re.match(rb"P[2356]\s+\d+\s+\d+\s+(\d{1,5})\s", head)
    return int(found[1]) if found else 255


def _has_other_channel(data: NDArray[np.uint8]) -> bool:
    """Return whether the fourth channel is no opacity: ink of a CMYK TIFF, infrared, and so on."""
    content = data.tobytes()
    return is_tiff(content) and not {1, 2} & set(read_tag(content, _EXTRA_SAMPLES))


def png_chunk(data: NDArray[np.uint8], name: bytes) -> bytes:
    """Return the content of a chunk that stands before the pixels of a PNG file; b"" if there is none."""
    at = len(_PNG_SIGNATURE)
    while at + 8 <= len(data):
        length, kind = int.from_bytes(data[at : at + 4].tobytes(), "big"), data[at + 4 : at + 8].tobytes()
        if kind == name:
            return data[at + 8 : at + 8 + length].tobytes()
        if kind in (b"IDAT", b"IEND"):
            break
        at += 12 + length
    return b""


def _rotate(image: NDArray[Any], data: NDArray[np.uint8]) -> NDArray[Any]:
    """Rotate and flip an image as its EXIF data says."""
    orientation = _size_and_orientation(io.BytesIO(data.tobytes()))[1]
    if orientation in SIDEWAYS:
        image = image.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def read_size(path: Path) -> tuple[int, int] | None:
    """Return width and height of an image as it is shown, rotated by its EXIF data; None if it is no image."""
    (width, height), orientation = _size_and_orientation(path)
    if not width:
        return None
    return (height, width) if orientation in SIDEWAYS else (width, height)


def _size_and_orientation(file: Path | io.BytesIO) -> tuple[tuple[int, int], int]:
    """Return the size of the stored pixels, (0, 0) if there are none, and the orientation in the EXIF data, else 1."""
    from PIL import Image

    size = (0, 0)
    try:
        opened = open_file(file) if isinstance(file, Path) else file
        with opened, Image.open(opened) as image:
            size = image.size
            return size, int(image.getexif().get(_ORIENTATION, 1))
    except Exception:  # Pillow raises errors of many types
        return size, 1
