"""An image at half its size again and again, and its values at many places."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.types import Float, Float32, Int, UInt8


def pyramid(image: UInt8, smooth_px: float = 0.7) -> list[Float32]:
    """Octaves of a grey image; pixel (x, y) of level l lies at (x, y)·2^l of the image.

    Each level is smoothed by about ``smooth_px`` of its own px.
    """
    levels = [image.astype(np.float32)]
    if smooth_px:
        levels[0] = np.asarray(cv2.GaussianBlur(levels[0], (0, 0), smooth_px))
    while min(levels[-1].shape) >= 16 and len(levels) < 7:
        levels.append(np.asarray(cv2.pyrDown(levels[-1])))
    return levels


class Picture:
    """A grey image and what is needed of it again and again.

    Attributes
    ----------
    raw, smooth : its :func:`pyramid`, as it is and smoothed.
    noise : standard deviation, grey levels, from the median of second differences, which edges hardly move.
    range : grey levels between its dark and its bright parts.
    """

    def __init__(self, grey: UInt8) -> None:
        self.raw, self.smooth = pyramid(grey, 0), pyramid(grey)
        kernel = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
        differences = cv2.filter2D(grey, cv2.CV_16S, kernel)[::2, ::2]  # of whole numbers the median takes less time
        self.noise = 1.4826 / 6 * float(np.median(np.abs(differences)))
        dark, bright = np.percentile(grey[::4, ::4], (2, 98))
        self.range = float(bright - dark)


MOST_ROWS = 2**14
"""Rows that are sampled at once: OpenCV's remap takes fewer than 2**15."""


def sample(levels: Sequence[Float32], level: Int, xy: Float, A: Float, points: Float) -> Float32:
    """Bilinear grey values (N, M) at ``xy + A @ points`` px of the image, each row from a level of its own."""
    values = np.empty((len(xy), len(points)), np.float32)
    fan = points.T.astype(np.float32)
    for n in np.unique(level):
        whole = np.flatnonzero(level == n)
        for rows in np.split(whole, range(MOST_ROWS, len(whole), MOST_ROWS)):
            at, map_ = (xy[rows] * 0.5**n).astype(np.float32), (A[rows] * 0.5**n).astype(np.float32)
            x, y = (map_[:, axis] @ fan + at[:, axis : axis + 1] for axis in (0, 1))
            values[rows] = cv2.remap(levels[n], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values


def outside_image(image: Float32, xy: Float, A: Float, points: Float) -> tuple[Int, NDArray[np.bool_]]:
    """Rows that have samples outside the image, and which ones: (K,) and (K, M)."""
    last = np.array(image.shape[::-1]) - 1.0
    reach = np.linalg.norm(A, axis=2) * np.linalg.norm(points, axis=1).max()
    rows = np.flatnonzero(np.any((xy - reach < 0) | (xy + reach > last), axis=1))
    x, y = (A[rows, axis] @ points.T + xy[rows, axis, None] for axis in (0, 1))
    return rows, (x < 0) | (y < 0) | (x > last[0]) | (y > last[1])


FLOOR = 1.0
"""Grey levels; a standard deviation around a place that is under it counts as nothing."""


def normalise(values: Float32) -> Float32:
    """Zero mean and unit norm a row."""
    centred = values - values.mean(axis=1, keepdims=True)
    size = np.einsum("nm,nm->n", centred, centred) + np.float32(FLOOR**2 * values.shape[1])
    return np.asarray(centred / np.sqrt(size)[:, None])


def coarsest_level(radius_px: Float, least_px: float, levels: Sequence[Float32]) -> Int:
    """The coarsest pyramid level in which a radius still measures ``least_px``."""
    octave = np.floor(np.log2(np.maximum(radius_px, 1e-6) / least_px))
    return np.clip(octave, 0, len(levels) - 1).astype(np.int64)
