"""Directories of TIFF files (TIFF 6.0): what the pages are, and whether their tables name all pixels."""

from __future__ import annotations

import io
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np

SIGNATURES = (b"II*\0", b"MM\0*")
_SUBFILE_TYPE, _WIDTH, _HEIGHT, _SAMPLES, _ROWS_PER_STRIP, _PLANES = 254, 256, 257, 277, 278, 284
_STRIPS, _TILE_WIDTH, _TILE_HEIGHT, _TILES = (273, 279), 322, 323, (324, 325)
_COPY_OR_MASK = 5
"""Bits of the tag NewSubfileType: a small copy of another page, or its mask."""


def is_tiff(content: bytes) -> bool:
    """Return whether a file begins as a TIFF does."""
    return content[:4] in SIGNATURES


def read_tag(content: bytes, tag: int) -> tuple[int, ...]:
    """Return the numbers of a tag of the first page of a TIFF; () if there are none."""
    try:
        return _numbers(next(_pages(content)), tag)
    except Exception:  # no TIFF, or any damage: Pillow raises errors of many types
        return ()


def has_more_pages(content: bytes) -> bool:
    """Return whether a TIFF has a second page that is neither a small copy of the first nor a mask."""
    try:
        return any(not _numbers(page, _SUBFILE_TYPE, 0)[0] & _COPY_OR_MASK for page in islice(_pages(content), 1, 2))
    except Exception:  # of damage
        return False


def names_all_pixels(content: bytes) -> bool:
    """Return whether the table of the first page has as many strips or tiles as the page needs.

    libtiff makes up the places that are missing from the table. Other readers do not.
    """
    try:
        page = next(_pages(content))
        width, height, planes = (_numbers(page, tag, 1)[0] for tag in (_WIDTH, _HEIGHT, _PLANES))
        samples = _numbers(page, _SAMPLES, 1)[0] if planes == 2 else 1
        if any(tag in page for tag in (_TILE_WIDTH, _TILE_HEIGHT, *_TILES)):
            if any(tag in page for tag in _STRIPS) or _TILE_WIDTH not in page or _TILE_HEIGHT not in page:
                return False
            tile_width, tile_height = _numbers(page, _TILE_WIDTH)[0], _numbers(page, _TILE_HEIGHT)[0]
            needed, tables = -(-width // tile_width) * -(-height // tile_height), _TILES
        else:
            needed, tables = -(-height // min(height, *_numbers(page, _ROWS_PER_STRIP, height))), _STRIPS
        places, sizes = (len(_numbers(page, tag)) for tag in tables)
        return places >= needed * samples and (sizes >= needed * samples or (not sizes and places == 1))
    except Exception:  # of damage; libtiff decides
        return True


def _numbers(page: Any, tag: int, *default: int) -> tuple[int, ...]:
    return tuple(int(value) for value in np.ravel(page.get(tag, default)))


def _pages(content: bytes) -> Iterator[Any]:
    """Yield the directory of each page."""
    from PIL import TiffImagePlugin

    at = TiffImagePlugin.ImageFileDirectory_v2(content[:8]).next
    while at:
        file, directory = io.BytesIO(content), TiffImagePlugin.ImageFileDirectory_v2(content[:8])
        file.seek(at)
        directory.load(file)
        at = directory.next
        yield directory
