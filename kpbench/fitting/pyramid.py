"""Image pyramids, and how to sample them at many places at once."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.types import Float, Float32, Int, UInt8

MOST_LEVELS, LEAST_SIDE_PX = 12, 16
"""A level is halved again if its shorter side is at least ``LEAST_SIDE_PX``, until there are ``MOST_LEVELS`` levels."""
REMAP_ROWS = 2**14
"""Largest number of poses that are sampled in one call of OpenCV's remap, which takes fewer than 2**15 rows."""
LEAST_DEVIATION = 1.0
"""Grey levels that are added in quadrature to standard deviations, so that an even surface has correlations near 0."""
SURROUNDINGS_PX, SURROUNDINGS_STEP_PX = 192, 6
"""Noise and grey range are measured in a square of this side around a place, from every sixth pixel, px of a level."""


def build_pyramid(image: UInt8, smooth_px: float = 0.7) -> list[Float32]:
    """Return the pyramid of a grey image, finest level first.

    Parameters
    ----------
    image : ndarray of shape (H, W), uint8
    smooth_px : float
        Standard deviation of the Gaussian that smooths level 0, px. 0 leaves level 0 unchanged. The
        standard deviation in a coarser level is 0.5 to 0.6 px of that level.

    Returns
    -------
    list of ndarray, float32
        Each level has half the size of the level before. Pixel (x, y) of level n lies at (x, y)·2^n of the image.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.fitting import build_pyramid
    >>> [level.shape for level in build_pyramid(np.zeros((48, 64), np.uint8))]
    [(48, 64), (24, 32), (12, 16)]
    """
    levels = [image.astype(np.float32)]
    if smooth_px:
        levels[0] = np.asarray(cv2.GaussianBlur(levels[0], (0, 0), smooth_px))
    while min(levels[-1].shape) >= LEAST_SIDE_PX and len(levels) < MOST_LEVELS:
        levels.append(np.asarray(cv2.pyrDown(levels[-1])))
    return levels


class Pyramids:
    """The two pyramids of a grey image, and measures of the surroundings of places.

    Attributes
    ----------
    raw, smooth : list of ndarray, float32
        :func:`build_pyramid` of the image, without and with smoothing of level 0.
    """

    def __init__(self, grey: UInt8) -> None:
        self.raw, self.smooth = build_pyramid(grey, 0), build_pyramid(grey)
        self._differences: dict[int, Float32] = {}

    def _second_differences(self, level: int) -> Float32:
        if level not in self._differences:
            second = np.array([1, -2, 1], np.float32)
            self._differences[level] = np.asarray(cv2.sepFilter2D(self.raw[level], cv2.CV_32F, second, second))
        return self._differences[level]

    def measure_surroundings(self, xy: Float, level: Int) -> tuple[Float, Float]:
        """Measure noise and grey range in a square of ``SURROUNDINGS_PX`` px of a level around each of N places.

        Parameters
        ----------
        xy : ndarray of shape (N, 2)
            Places, px of the image. A square that would cross the border of the image is moved into the image.
        level : ndarray of shape (N,), int64
            Level of each place, at most the number of levels.

        Returns
        -------
        noise : ndarray of shape (N,)
            Standard deviation of the noise, grey levels, from the median of second differences, which edges hardly
            change.
        grey_range : ndarray of shape (N,)
            Difference between the bright and the dark parts (98th and 2nd percentile), grey levels.
        """
        noise, grey_range = np.empty(len(xy)), np.empty(len(xy))
        for n in np.unique(level).tolist():
            rows, image, differences = np.flatnonzero(level == n), self.raw[n], self._second_differences(n)
            x, y = (_window(xy[rows, axis] * 0.5**n, side) for axis, side in enumerate(image.shape[::-1]))
            at = y[:, :, None], x[:, None]
            noise[rows] = 1.4826 / 6 * np.median(np.abs(differences[at]).reshape(len(rows), -1), axis=1)
            dark, bright = np.percentile(image[at].reshape(len(rows), -1), (2, 98), axis=1)
            grey_range[rows] = bright - dark
        return noise, grey_range


def _window(centre: Float, side: int) -> Int:
    """Return the positions (N, M) along one axis of samples around centres (N,) px, all in [0, side)."""
    offsets = np.arange(-SURROUNDINGS_PX // 2, SURROUNDINGS_PX // 2 + 1, SURROUNDINGS_STEP_PX)
    middle = np.clip(np.rint(centre).astype(np.int64), offsets[-1], max(side - 1 - offsets[-1], offsets[-1]))
    return np.asarray(np.clip(middle[:, None] + offsets, 0, side - 1))


def sample_pyramid(levels: Sequence[Float32], level: Int, xy: Float, A: Float, points: Float) -> Float32:
    """Return bilinear grey values at ``xy + A @ points`` px of the image, for N poses.

    Parameters
    ----------
    levels : list of ndarray
        From :func:`build_pyramid`.
    level : ndarray of shape (N,), int64
        Level that each pose is sampled from.
    xy, A : ndarray of shape (N, 2) and (N, 2, 2)
        Poses, px of the image.
    points : ndarray of shape (M, 2)
        Points in the frame of the poses.

    Returns
    -------
    ndarray of shape (N, M), float32
        A sample outside the image has the value of the nearest point of the image.
    """
    values = np.empty((len(xy), len(points)), np.float32)
    fan = points.T.astype(np.float32)
    for n in np.unique(level):
        of_level = np.flatnonzero(level == n)
        for rows in np.split(of_level, range(REMAP_ROWS, len(of_level), REMAP_ROWS)):
            centre, map_ = (xy[rows] * 0.5**n).astype(np.float32), (A[rows] * 0.5**n).astype(np.float32)
            x, y = (map_[:, axis] @ fan + centre[:, axis : axis + 1] for axis in (0, 1))
            values[rows] = cv2.remap(levels[n], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values


def find_samples_outside(image: Float32, xy: Float, A: Float, points: Float) -> tuple[Int, NDArray[np.bool_]]:
    """Find the poses that may have samples outside the image, and mark the samples outside.

    Parameters
    ----------
    image : ndarray of shape (H, W)
    xy, A, points : ndarray
        As for :func:`sample_pyramid`.

    Returns
    -------
    rows : ndarray of shape (K,), int64
        Indices of the poses. A few of these poses may have all samples inside.
    outside : ndarray of shape (K, M), bool
        Whether each sample of these poses lies outside.
    """
    last = np.array(image.shape[::-1]) - 1.0
    reach = np.linalg.norm(A, axis=2) * np.linalg.norm(points, axis=1).max()
    rows = np.flatnonzero(np.any((xy - reach < 0) | (xy + reach > last), axis=1))
    x, y = (A[rows, axis] @ points.T + xy[rows, axis, None] for axis in (0, 1))
    return rows, (x < 0) | (y < 0) | (x > last[0]) | (y > last[1])


def normalise_rows(values: Float32) -> Float32:
    """Return rows (N, M) of grey values with zero mean and unit norm; the row of an even surface is near 0."""
    centred = values - values.mean(axis=1, keepdims=True)
    size = np.einsum("nm,nm->n", centred, centred) + np.float32(LEAST_DEVIATION**2 * values.shape[1])
    return np.asarray(centred / np.sqrt(size)[:, None])


def choose_level(radius_px: Float, least_px: float, levels: Sequence[Float32]) -> Int:
    """Return the coarsest level in which each radius (N,), given in px of the image, is at least ``least_px`` px."""
    octave = np.floor(np.log2(np.maximum(radius_px, 1e-6) / least_px))
    return np.clip(octave, 0, len(levels) - 1).astype(np.int64)
