"""Backgrounds: crops of the user's photographs, or a procedural texture with natural statistics."""

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
from kpbench.images import decode_photo
from kpbench.types import Float, UInt8

CACHE_BYTES = 128 * 2**20


@dataclass(frozen=True)
class Background:
    """One background and where it came from.

    Attributes
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8, RGB.
    file : str
        Path of the photograph below the folder, "" for a procedural one.
    broken : tuple of str
        Files that were to be used and could not be decoded.
    """

    image: UInt8
    file: str = ""
    broken: tuple[str, ...] = ()


@dataclass
class PhotoFolder:
    """Photographs below a folder, of any size, mode and nesting, some of them broken.

    ``files`` is the sorted list of paths below ``path``, so that the n-th file is the same on every
    machine. Decoded photographs are kept in a cache of bounded size; it changes no result.
    """

    path: Path
    files: tuple[str, ...]
    _cache: OrderedDict[tuple[str, int], UInt8 | None] = field(default_factory=OrderedDict, repr=False)
    _cached_bytes: int = 0

    @classmethod
    def open(cls, path: str | Path) -> PhotoFolder:
        """List a folder and make sure that at least one photograph in it can be decoded.

        Raises
        ------
        DataError
            If the folder does not exist, holds no image file, or holds none that can be decoded.
        """
        folder = Path(path)
        if not folder.is_dir():
            what = "a file, expected a folder" if folder.exists() else "no such folder"
            raise DataError(f"{folder}: {what} of background images")
        files = image_files(folder)
        if not files:
            expected = ", ".join(IMAGE_SUFFIXES)
            raise DataError(f"{folder}: no background images in it, expected files ending in {expected}")
        photos = cls(folder, files)
        if all(photos.decode(name, 1) is None for name in files):
            raise DataError(f"{folder}: none of its {len(files)} image files can be decoded, first is {files[0]}")
        return photos

    @property
    def digest(self) -> str:
        """SHA-256 over names and sizes of all files: tells whether the folder has changed."""
        listing = "\n".join(f"{name}\t{(self.path / name).stat().st_size}" for name in self.files)
        return hashlib.sha256(os.fsencode(listing)).hexdigest()

    def decode(self, name: str, channels: int) -> UInt8 | None:
        """One whole photograph, (H, W) or (H, W, 3) in RGB; None if it is broken."""
        key = (name, channels)
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        image = decode_photo((self.path / name), channels)
        self._cache[key] = image
        self._cached_bytes += 0 if image is None else image.nbytes
        while self._cached_bytes > CACHE_BYTES and len(self._cache) > 1:
            _, dropped = self._cache.popitem(last=False)
            self._cached_bytes -= 0 if dropped is None else dropped.nbytes
        return image

    def _from(self, first: int) -> Iterator[str]:
        yield from self.files[first:]
        yield from self.files[:first]

    def sample(self, rng: np.random.Generator, width_px: int, height_px: int, channels: int) -> Background:
        """A random crop of a random photograph, mirrored half of the time, resized to the size asked for.

        A broken file is passed over for the next one in the list, so the random numbers drawn do not
        depend on it.
        """
        first, zoom, fx, fy, mirror = (
            int(rng.integers(len(self.files))),
            rng.uniform(0.5, 1.0),
            rng.random(),
            rng.random(),
            rng.random() < 0.5,
        )
        broken: list[str] = []
        for name in self._from(first):
            photo = self.decode(name, channels)
            if photo is not None:
                image = _crop(photo, width_px, height_px, zoom, fx, fy)
                return Background(np.ascontiguousarray(image[:, ::-1]) if mirror else image, name, tuple(broken))
            broken.append(name)
        raise DataError(f"{self.path}: its image files can no longer be decoded")


def _crop(photo: UInt8, width_px: int, height_px: int, zoom: float, fx: float, fy: float) -> UInt8:
    rows, columns = photo.shape[:2]
    scale = zoom * min(columns / width_px, rows / height_px)
    w, h = max(1, round(width_px * scale)), max(1, round(height_px * scale))
    x, y = int(fx * (columns - w + 1)), int(fy * (rows - h + 1))
    how = cv2.INTER_AREA if scale > 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(photo[y : y + h, x : x + w], (width_px, height_px), interpolation=how), np.uint8)


def procedural(rng: np.random.Generator, width_px: int, height_px: int, channels: int = 1) -> UInt8:
    """A background without photographs: dead leaves under 1/f texture.

    Opaque shapes of random size, position and grey that hide each other, with radii of density r⁻³,
    have the scale-invariant edges of natural images (Lee, Mumford and Huang, *Occlusion models for
    natural images*, IJCV 2001); octaves of smooth noise add surface texture with a 1/f spectrum.

    Returns
    -------
    ndarray of shape (height_px, width_px) or (height_px, width_px, 3), uint8
    """
    long_side = max(width_px, height_px)
    canvas = np.full((height_px, width_px, channels), round(rng.uniform(40, 215)), np.uint8)
    count, smallest, largest = 700, 0.008, 0.35  # radii in long sides; so many cover the frame about twice
    radius = smallest * long_side / np.sqrt(1 - rng.random(count) * (1 - (smallest / largest) ** 2))
    centre = rng.uniform(0, 1, (count, 2)) * (width_px, height_px)
    ratio, angle = rng.uniform(0.3, 1.0, count), rng.uniform(0, 360, count)
    grey = np.clip(rng.normal(127, 62, (count, 1)) + rng.normal(0, 18, (count, channels)), 0, 255).round()
    square = rng.random(count) < 0.4
    round_ = _leaves(_circle(48), centre, radius, ratio, angle)
    edged = _leaves(np.sqrt(2) * _circle(4, 45), centre, radius, ratio, angle)
    for is_square, ellipse, corners, colour in zip(square.tolist(), round_, edged, grey.tolist(), strict=True):
        cv2.fillConvexPoly(canvas, corners if is_square else ellipse, colour, cv2.LINE_8, 4)
    strength = rng.uniform(2, 14)
    sizes = [(max(2, width_px >> octave), max(2, height_px >> octave)) for octave in range(1, 8)]
    octaves = [rng.standard_normal(size[::-1], dtype=np.float32) for size in sizes]
    texture: Any = np.zeros((2, 2), np.float32)
    for octave in range(7, 0, -1):  # from coarse to fine, each on top of the ones before
        texture = cv2.resize(texture, sizes[octave - 1])
        texture += np.float32(strength * 2 ** (octave / 2 - 2)) * octaves[octave - 1]
    texture = cv2.resize(texture, (width_px, height_px))
    smooth = cv2.GaussianBlur(canvas, (0, 0), 0.7)
    if channels == 3:
        texture = cv2.merge([texture] * 3)
    return np.asarray(cv2.add(smooth, texture, dtype=cv2.CV_8U), np.uint8)


def _circle(count: int, start_deg: float = 0.0) -> Float:
    """Corners on the unit circle, shape (count, 2)."""
    angles = np.radians(start_deg) + np.arange(count) * (2 * np.pi / count)
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _leaves(corners: Float, centre: Float, radius: Float, ratio: Float, angle_deg: Float) -> NDArray[np.int32]:
    """One polygon stretched, turned and placed many times, in 1/16 px as OpenCV draws: (count, corners, 2)."""
    c, s = np.cos(np.radians(angle_deg))[:, None], np.sin(np.radians(angle_deg))[:, None]
    u, v = corners[:, 0] * radius[:, None], corners[:, 1] * (radius * ratio)[:, None]
    points = np.stack([c * u - s * v, s * u + c * v], axis=-1) + centre[:, None]
    return np.rint(points * 16).astype(np.int32)
