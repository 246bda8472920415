"""Photographs as files: their pixels as the sensor saw them, how the camera was held, and their quality."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from kpbench.errors import DataError, system_reason
from kpbench.files import IMAGE_SUFFIXES, image_files, read_bytes
from kpbench.pixels import decode_pixels
from kpbench.types import UInt8
from kpbench.writing import HEAD_BYTES, TAIL_BYTES, kind_of

EXIF_ORIENTATION = 274
STANDARD_LUMINANCE_MEAN = 57.625
"""Mean of the luminance table of the JPEG standard (ITU-T T.81, table K.1), which stands for the quality 50."""


@dataclass(frozen=True)
class Photo:
    """What is known of the file of a photograph.

    Attributes
    ----------
    name : str
        Path relative to the folder of the photographs.
    size_px : (int, int)
        Width and height as the sensor saw them; (0, 0) if the file cannot be read.
    exif_turn : int
        Orientation in the EXIF data, 1 for upright. The pixels are not turned.
    jpeg_quality : int or None
        Quality of the JPEG file, from its tables; None for another form.
    sha256 : str
    is_of_kpbench : bool
        Whether kpbench wrote the file, so that it is taken for simulated.

    Examples
    --------
    >>> from kpbench.calibration import Photo
    >>> Photo("a.jpg", (4000, 3000), exif_turn=6, jpeg_quality=92, sha256="").exif_turn
    6
    """

    name: str
    size_px: tuple[int, int]
    exif_turn: int
    jpeg_quality: int | None
    sha256: str
    is_of_kpbench: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of the photograph in the configuration of a dataset."""
        return {
            "name": self.name,
            "exif_turn": self.exif_turn,
            "jpeg_quality": self.jpeg_quality,
            "sha256": self.sha256,
        }


def list_photos(source: str | Path | Sequence[str | Path], exclude: Path | None = None) -> list[tuple[str, Path]]:
    """Return names and paths of photographs: the images of a folder and its subfolders, or a list of files.

    Raises
    ------
    DataError
        If there is no photograph.
    """
    if isinstance(source, str | Path):
        folder = Path(source)
        if folder.is_dir():
            found = [(name, folder / name) for name in image_files(folder, exclude)]
            if not found:
                raise DataError(f"{folder}: no photographs in it, expected files ending in {', '.join(IMAGE_SUFFIXES)}")
            return found
        source = [folder]
    paths = [Path(path) for path in source]
    for path in paths:
        if not path.is_file():
            raise DataError(f"{path}: no such photograph or folder of photographs")
    return [(path.name, path) for path in paths]


def read_photo(name: str, path: Path) -> tuple[Photo, UInt8 | None]:
    """Read a photograph: what is known of it, and its pixels, grey (H, W) or RGB (H, W, 3); None if it is broken."""
    try:
        data = read_bytes(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read, {system_reason(error) or error}") from None
    try:
        image = decode_pixels(np.frombuffer(data, np.uint8), 3, rotate=False, name=path)
    except DataError:
        image = None
    digest = hashlib.sha256(data).hexdigest()
    if image is None:
        return Photo(name, (0, 0), 1, None, digest), None
    turn, quality = _read_head(data)
    if (image == image[..., :1]).all():
        image = np.ascontiguousarray(image[..., 0])
    is_of_kpbench = kind_of(data[:HEAD_BYTES], data[-TAIL_BYTES:]) is not None
    return Photo(name, (image.shape[1], image.shape[0]), turn, quality, digest, is_of_kpbench), image


def as_grey(image: UInt8) -> UInt8:
    """Return an image of shape (H, W)."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def _read_head(data: bytes) -> tuple[int, int | None]:
    """Return the orientation in the EXIF data, and the quality of a JPEG file."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as image:
            turn = int(image.getexif().get(EXIF_ORIENTATION, 1))
            tables = getattr(image, "quantization", None)
    except Exception:  # Pillow raises errors of many types
        return 1, None
    if not tables:
        return turn, None
    scale = 100 * float(np.mean(list(tables[0]))) / STANDARD_LUMINANCE_MEAN
    return turn, int(np.clip(round((200 - scale) / 2 if scale <= 100 else 5000 / scale), 1, 100))
