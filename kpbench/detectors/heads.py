"""Decoding of the two heads of a SuperPoint network, with NumPy and OpenCV.

The network divides the image into cells of 8x8 px. :func:`decode` turns the logits of the detector head into one
probability map at full resolution. A keypoint is the centre of mass of the probability in a window around a local
maximum. The window may cross the borders of cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.detectors.suppression import suppress
from kpbench.types import Detections, Float, Float32

CELL_PX = 8
"""Side of a cell, px."""
MOST_PEAKS = 10_000
"""Largest number of maxima of an image that are looked at, the best first. A trained network has a few hundred."""
EMPTY_CELL_LOG_ODDS = float(np.log(2e-4))
"""A cell is empty if log(p / q) is at most this for every pixel, where p is the probability of the pixel and q the
probability of "no keypoint". Most cells are empty."""


@dataclass(frozen=True)
class Decoding:
    """Settings of :func:`decode`.

    Attributes
    ----------
    threshold : float
        Least score of a keypoint: the probability that a keypoint lies in the window around the maximum, in [0, 1].
        A threshold below 0.01 still misses some keypoints, as the pixels of empty cells count as 0.
    separation_px : int
        If two maxima are nearer than this, px, only the better is kept. With the default, the centres of two discs side
        by side are both kept if the short axes of the discs are at least 10 px long.
    window_px : int
        Reach of the window around a maximum, px: the window is ``2 · window_px + 1`` px wide. The score is the sum of
        the probability in the window. The place is the centre of mass of this probability.

    Examples
    --------
    >>> from kpbench.detectors import Decoding
    >>> Decoding(threshold=0.3).window_px
    3
    """

    threshold: float = 0.5
    separation_px: int = 6
    window_px: int = 3


def decode(detector_logits: Float32, id_logits: Float32, decoding: Decoding | None = None) -> Detections:
    """Return the keypoints of one image from the logits of the network's two heads.

    Parameters
    ----------
    detector_logits : ndarray of shape (65, h, w), float32
        One channel per pixel of a cell, row by row, and a last channel for "no keypoint".
    id_logits : ndarray of shape (ids + 1, h, w), float32
        One channel per design, and a last channel for "no patch".
    decoding : Decoding, optional
        None: the defaults.

    Returns
    -------
    Detections
        ``xy`` in px of the (8h, 8w) image, best first. ``patch_id`` is the index of the ID head's likeliest design.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.detectors import decode
    >>> detector_logits, id_logits = np.zeros((65, 4, 4), np.float32), np.zeros((5, 4, 4), np.float32)
    >>> detector_logits[64] = 10                      # "no keypoint" in all cells ...
    >>> detector_logits[8 * 5 + 3, 2, 1] = 30         # ... but at row 5, column 3 of the cell in row 2, column 1
    >>> decode(detector_logits, id_logits).xy
    array([[11., 21.]])
    """
    xy, score = locate(detector_logits, decoding or Decoding())
    return Detections(xy, score, np.argmax(identify(id_logits, xy)[:, :-1], axis=1))


def locate(detector_logits: Float32, decoding: Decoding) -> tuple[Float, Float]:
    """Return places (n, 2) px and scores (n,) of keypoints from detector logits (65, h, w), best first."""
    probability = keypoint_probability(detector_logits)
    # a light smoothing removes small bumps, so that each blob has one maximum
    ranked = cv2.GaussianBlur(probability, (5, 5), 1.0, borderType=cv2.BORDER_CONSTANT)
    side = 2 * decoding.separation_px - 1
    highest = cv2.dilate(ranked, np.ones((side, side), np.uint8))
    width, offset = 2 * decoding.window_px + 1, np.arange(-decoding.window_px, decoding.window_px + 1)
    # a window whose sum reaches the threshold has a pixel of at least threshold / width²; 0.5 allows for the smoothing
    found = np.flatnonzero(ranked > 0.5 * decoding.threshold / width**2)  # many times faster than nonzero in 2-D
    found = found[ranked.ravel()[found] >= highest.ravel()[found]]
    rows, columns = np.divmod(found, probability.shape[1])
    windows = _windows(probability, rows[:, None] + offset, columns[:, None] + offset)
    total = windows.sum(axis=(1, 2))
    likely = np.flatnonzero(total >= decoding.threshold)
    likely = likely[np.argsort(-total[likely], kind="stable")[:MOST_PEAKS]] if len(likely) > MOST_PEAKS else likely
    rows, columns, windows, total = rows[likely], columns[likely], windows[likely], total[likely]
    x = columns + windows.sum(axis=1) @ offset / total
    y = rows + windows.sum(axis=2) @ offset / total
    xy = np.column_stack([x, y])
    score = np.minimum(total, 1.0).astype(np.float64)
    kept = suppress(xy, score, decoding.separation_px)
    return xy[kept], score[kept]


def _windows(image: Float32, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Float32:
    """Return windows (n, k, k) of an image at rows (n, k) and columns (n, k); 0 outside the image."""
    height, width = image.shape
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None]
    part = image[np.clip(rows, 0, height - 1)[:, :, None], np.clip(columns, 0, width - 1)[:, None]]
    return np.asarray(part * inside, np.float32)


def identify(id_logits: Float32, xy: Float) -> Float:
    """Return log probabilities (n, ids + 1) of each design and of "no patch" at places (n, 2) px."""
    logits = _interpolate_cells(id_logits, xy)
    logits = logits - logits.max(axis=1, keepdims=True)
    return np.asarray(logits - np.log(np.exp(logits).sum(axis=1, keepdims=True)))


def keypoint_probability(detector_logits: Float32) -> Float32:
    """Return the probability (8h, 8w) of a keypoint at each pixel, from detector logits (65, h, w).

    The probabilities of a cell are the softmax of its logits. All probabilities of an empty cell are set to 0.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.detectors import keypoint_probability
    >>> keypoint_probability(np.zeros((65, 3, 4), np.float32)).shape
    (24, 32)
    """
    _, h, w = detector_logits.shape
    rows, columns = np.nonzero(detector_logits[:-1].max(axis=0) - detector_logits[-1] > EMPTY_CELL_LOG_ODDS)
    logits = detector_logits[:, rows, columns]
    share = np.exp(logits - logits.max(axis=0))
    share = share[:-1] / share.sum(axis=0)
    probability = np.zeros((h, CELL_PX, w, CELL_PX), np.float32)
    probability[rows, :, columns] = share.T.reshape(-1, CELL_PX, CELL_PX)
    return probability.reshape(CELL_PX * h, CELL_PX * w)


def _interpolate_cells(cells: Float32, xy: Float) -> Float:
    """Interpolate a map of cells (C, h, w) bilinearly at places (n, 2) px. Return the values (n, C).

    Cell i is centred at 3.5 + 8i px.
    """
    _, h, w = cells.shape
    u = np.clip((xy - (CELL_PX - 1) / 2) / CELL_PX, 0, (w - 1, h - 1))
    low = np.minimum(u.astype(int), np.maximum((w - 2, h - 2), 0))
    (fx, fy), (j, i) = (u - low).T, low.T
    j1, i1 = np.minimum(j + 1, w - 1), np.minimum(i + 1, h - 1)
    top = cells[:, i, j] * (1 - fx) + cells[:, i, j1] * fx
    bottom = cells[:, i1, j] * (1 - fx) + cells[:, i1, j1] * fx
    return np.asarray((top * (1 - fy) + bottom * fy).T)
