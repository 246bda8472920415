"""Backgrounds of images: crops of the user's photographs, or procedural textures with natural statistics."""

from __future__ import annotations

import hashlib
import os
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.files import IMAGE_SUFFIXES, image_files
from kpbench.filters import filter_separably, gaussian_taps
from kpbench.images import decode_photo
from kpbench.portable import cos_sin
from kpbench.types import Float, UInt8

CACHE_BYTES = 128 * 2**20
"""Largest size of the cache of decoded photographs of a :class:`PhotoFolder`, bytes."""
PHOTO_PARTS = ("all", "training", "validation")
"""Parts of a folder of photographs."""
VALIDATION_EVERY = 10
"""One of so many photographs of a folder is for validation, and trains nothing."""
LEAVES = 700
"""Number of shapes in a procedural background. In an image of 640x480 px, the areas of the shapes sum to about the area
of the image."""
LEAF_RADIUS = (0.008, 0.35)
"""Smallest and largest radius of a shape in a procedural background, as fractions of the image's longer side."""
LEAF_BLUR_PX = 0.7
"""Standard deviation of the Gaussian that blurs the shapes of a procedural background, px."""
TEXTURE_UNIT = 32
"""Whole numbers per grey level in the texture of a procedural background. OpenCV interpolates whole numbers exactly."""
TEXTURE_OCTAVES = 7
"""Number of noise layers in a procedural background. Each layer has half the resolution of the previous one."""


def is_in_part(number: int, part: str) -> bool:
    """Return whether the photograph with this number, from 0, belongs to one of ``PHOTO_PARTS``."""
    return part == "all" or (number % VALIDATION_EVERY == 0) == (part == "validation")


@dataclass(frozen=True)
class Background:
    """One background and its origin.

    Attributes
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
        Grey or RGB.
    file : str
        Path of the photograph, relative to its folder; "" for a procedural background.
    broken_files : tuple of str
        Files that were tried before ``file`` and could not be decoded.
    """

    image: UInt8
    file: str = ""
    broken_files: tuple[str, ...] = ()


@dataclass
class PhotoFolder:
    """Photographs in a folder and its subfolders. The photographs may have any size and colour mode, and may be broken.

    A cache of bounded size keeps decoded photographs. The cache affects the speed, but no result.

    Attributes
    ----------
    path : Path
    files : tuple of str
        Paths relative to ``path``, sorted so that the n-th file is the same on every machine.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> from kpbench.render import PhotoFolder
    >>> cv2.imwrite("wall.png", np.full((300, 400), 90, np.uint8))
    True
    >>> photos = PhotoFolder.open(".")
    >>> background = photos.sample(np.random.default_rng(0), 64, 48, channels=1)
    >>> background.file, background.image.shape
    ('wall.png', (48, 64))
    """

    path: Path
    files: tuple[str, ...]
    _cache: OrderedDict[tuple[str, int], UInt8 | None] = field(default_factory=OrderedDict, repr=False)
    _cached_bytes: int = 0

    @classmethod
    def open(cls, path: str | Path, part: str = "all") -> PhotoFolder:
        """List a folder and make sure that at least one photograph in the folder can be decoded.

        Parameters
        ----------
        path : path
        part : str
            "validation" (every tenth photograph), "training" (the others), or "all". If the folder holds only one
            photograph, the photograph belongs to both parts.

        Raises
        ------
        DataError
            If the folder does not exist, holds no image file, or holds no image file that can be decoded.
        """
        folder = Path(path)
        if not folder.is_dir():
            problem = "a file, expected a folder" if folder.exists() else "no such folder"
            raise DataError(f"{folder}: {problem} of background images")
        files = image_files(folder)
        if not files:
            expected = ", ".join(IMAGE_SUFFIXES)
            raise DataError(f"{folder}: no background images in it, expected files ending in {expected}")
        photos = cls(folder, files)
        if all(photos.decode(name, 1) is None for name in files):
            raise DataError(f"{folder}: none of its {len(files)} image files can be decoded, first is {files[0]}")
        if len(files) > 1:
            photos.files = tuple(file for n, file in enumerate(files) if is_in_part(n, part))
        return photos

    @property
    def digest(self) -> str:
        """SHA-256 of the names and sizes of all files; a changed digest shows that the folder has changed."""
        listing = "\n".join(f"{name}\t{(self.path / name).stat().st_size}" for name in self.files)
        return hashlib.sha256(os.fsencode(listing)).hexdigest()

    def decode(self, name: str, channels: int) -> UInt8 | None:
        """Decode one whole photograph.

        Parameters
        ----------
        name : str
            An entry of ``files``.
        channels : {1, 3}
            1 for grey, 3 for RGB.

        Returns
        -------
        ndarray of shape (H, W) or (H, W, 3), uint8, or None
            None if the file is broken.
        """
        key = (name, channels)
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        image = decode_photo(self.path / name, channels)
        self._cache[key] = image
        self._cached_bytes += 0 if image is None else image.nbytes
        while self._cached_bytes > CACHE_BYTES and len(self._cache) > 1:
            _, dropped = self._cache.popitem(last=False)
            self._cached_bytes -= 0 if dropped is None else dropped.nbytes
        return image

    def _files_from(self, first: int) -> Iterator[str]:
        """Yield all files: from position ``first`` to the end, then from the start to position ``first``."""
        yield from self.files[first:]
        yield from self.files[:first]

    def sample(self, rng: np.random.Generator, width_px: int, height_px: int, channels: int) -> Background:
        """Draw a random crop of a random photograph, mirrored with probability 0.5 and resized.

        If a file is broken, the next file of ``files`` is used. A broken file therefore does not change the random
        numbers.

        Parameters
        ----------
        rng : numpy.random.Generator
        width_px, height_px : int
            Size of the background.
        channels : {1, 3}
            1 for grey, 3 for RGB.

        Raises
        ------
        DataError
            If no file can be decoded any more.
        """
        first, zoom, x_fraction, y_fraction, mirror = (
            int(rng.integers(len(self.files))),
            rng.uniform(0.5, 1.0),
            rng.random(),
            rng.random(),
            rng.random() < 0.5,
        )
        broken: list[str] = []
        for name in self._files_from(first):
            photo = self.decode(name, channels)
            if photo is not None:
                image = _crop_and_resize(photo, width_px, height_px, zoom, x_fraction, y_fraction)
                return Background(np.asarray(cv2.flip(image, 1), np.uint8) if mirror else image, name, tuple(broken))
            broken.append(name)
        raise DataError(f"{self.path}: its image files can no longer be decoded")


def describe_backgrounds(photos: PhotoFolder | None) -> dict[str, Any]:
    """Return the entry that describes the backgrounds in a dataset's config. The entry holds no path."""
    if photos is None:
        return {"kind": "procedural"}
    return {"kind": "photographs", "files": len(photos.files), "listing_sha256": photos.digest}


def _crop_and_resize(
    photo: UInt8, width_px: int, height_px: int, zoom: float, x_fraction: float, y_fraction: float
) -> UInt8:
    """Cut a window out of a photograph and resize the window.

    ``zoom`` is the size of the window relative to the largest window that fits. The two fractions place the
    window: 0 at the left or upper border, 1 at the right or lower border.
    """
    rows, columns = photo.shape[:2]
    scale = zoom * min(columns / width_px, rows / height_px)
    w, h = max(1, round(width_px * scale)), max(1, round(height_px * scale))
    x, y = int(x_fraction * (columns - w + 1)), int(y_fraction * (rows - h + 1))
    interpolation = cv2.INTER_AREA if scale > 1 else cv2.INTER_LINEAR_EXACT
    window = photo[y : y + h, x : x + w]
    return np.asarray(cv2.resize(window, (width_px, height_px), interpolation=interpolation), np.uint8)


def procedural_background(rng: np.random.Generator, width_px: int, height_px: int, channels: int = 1) -> UInt8:
    """Draw a background that needs no photographs: dead leaves under 1/f texture.

    Opaque shapes of random size, position and grey hide each other. The probability density of the radius r is
    proportional to r⁻³. The edges are therefore scale-invariant, as in natural images [1]_. Octaves of smooth noise add
    a surface texture with a 1/f spectrum.

    Parameters
    ----------
    rng : numpy.random.Generator
    width_px, height_px : int
    channels : {1, 3}
        1 for grey, 3 for RGB.

    Returns
    -------
    ndarray of shape (height_px, width_px) or (height_px, width_px, 3), uint8

    References
    ----------
    .. [1] Lee, Mumford and Huang, *Occlusion models for natural images: a statistical study of a
       scale-invariant dead leaves model*, IJCV 41, 2001.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.render import procedural_background
    >>> procedural_background(np.random.default_rng(0), 64, 48).shape
    (48, 64)
    """
    canvas = np.full((height_px, width_px, channels), round(rng.uniform(40, 215)), np.uint8)
    smallest, largest = LEAF_RADIUS
    # inverse transform sampling: the inverse of the cumulative distribution of the radius, from smallest to largest
    radius_px = smallest * max(width_px, height_px) / np.sqrt(1 - rng.random(LEAVES) * (1 - (smallest / largest) ** 2))
    centre_px = rng.uniform(0, 1, (LEAVES, 2)) * (width_px, height_px)
    ratio, angle_deg = rng.uniform(0.3, 1.0, LEAVES), rng.uniform(0, 360, LEAVES)
    grey = np.clip(rng.normal(127, 62, (LEAVES, 1)) + rng.normal(0, 18, (LEAVES, channels)), 0, 255).round()
    is_rectangle = rng.random(LEAVES) < 0.4
    ellipses = _place_polygon(_circle_corners(48), centre_px, radius_px, ratio, angle_deg)
    rectangles = _place_polygon(np.sqrt(2) * _circle_corners(4, 45), centre_px, radius_px, ratio, angle_deg)
    for n, colour in enumerate(grey.tolist()):
        cv2.fillConvexPoly(canvas, (rectangles if is_rectangle[n] else ellipses)[n], colour, cv2.LINE_8, 4)
    texture = _octave_noise(rng, width_px, height_px).astype(np.float32) / TEXTURE_UNIT
    smooth = filter_separably(canvas, gaussian_taps(LEAF_BLUR_PX))
    if channels == 3:
        texture = cv2.merge([texture] * 3)
    return np.asarray(cv2.add(smooth, texture, dtype=cv2.CV_8U), np.uint8)


def _octave_noise(rng: np.random.Generator, width_px: int, height_px: int) -> Any:
    """Return the sum of all octaves of smooth noise, ndarray of shape (height_px, width_px), int16.

    The unit is 1 / ``TEXTURE_UNIT`` grey level.
    """
    strength = rng.uniform(2, 14)
    sizes = [(max(2, width_px >> octave), max(2, height_px >> octave)) for octave in range(1, TEXTURE_OCTAVES + 1)]
    octaves = [rng.standard_normal(size[::-1], dtype=np.float32) for size in sizes]
    texture: Any = np.zeros((2, 2), np.int16)
    for octave in range(TEXTURE_OCTAVES, 0, -1):  # from coarse to fine
        texture = cv2.resize(texture, sizes[octave - 1], interpolation=cv2.INTER_LINEAR_EXACT)
        gain = np.float32(TEXTURE_UNIT * strength * np.sqrt(2.0) ** octave / 4)
        texture += np.rint(gain * octaves[octave - 1]).astype(np.int16)
    return cv2.resize(texture, (width_px, height_px), interpolation=cv2.INTER_LINEAR_EXACT)


def _circle_corners(count: int, start_deg: float = 0.0) -> Float:
    """Return the corners of a regular polygon on the unit circle: ndarray of shape (count, 2)."""
    angles = np.radians(start_deg) + np.arange(count) * (2 * np.pi / count)
    return np.column_stack(cos_sin(angles))


def _place_polygon(
    corners: Float, centre_px: Float, radius_px: Float, ratio: Float, angle_deg: Float
) -> NDArray[np.int32]:
    """Return n copies of one polygon: each copy stretched, turned and moved.

    Parameters
    ----------
    corners : ndarray of shape (k, 2)
    centre_px : ndarray of shape (n, 2)
    radius_px, ratio, angle_deg : ndarray of shape (n,)
        Semi-axis along x before the turn; (semi-axis along y) / (semi-axis along x); angle of the turn.

    Returns
    -------
    ndarray of shape (n, k, 2), int32
        Corners in 1/16 px, the unit of OpenCV's drawing functions.
    """
    c, s = (v[:, None] for v in cos_sin(np.radians(angle_deg)))
    u, v = corners[:, 0] * radius_px[:, None], corners[:, 1] * (radius_px * ratio)[:, None]
    points = np.stack([c * u - s * v, s * u + c * v], axis=-1) + centre_px[:, None]
    return np.rint(points * 16).astype(np.int32)
