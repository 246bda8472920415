"""Filters of 8-bit images that give the same pixels on every processor.

OpenCV sums in the order that suits the processor, and a sum of fractions depends on its order. The weights here are
therefore whole numbers, and every partial sum is a whole number that float32 or float64 holds exactly. Beyond its
border, the image continues as its mirror image about the outermost pixel.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from scipy import fft

from kpbench.portable import exp
from kpbench.types import Float, Float32, UInt8

BORDER_MODE = cv2.BORDER_REFLECT_101
MOST_DIRECT_WEIGHTS = 129
"""Largest number of weights that ``cv2.filter2D`` sums directly. With more weights, it uses an inexact transform."""
DIRECT_UNIT, SEPARABLE_UNIT, FOURIER_UNIT = 2**16, 2**12, 2**24
"""The sum of the whole weights of a filter. 255 times the unit fits into the 24 bits of a float32; a separable filter
has two units, and rounds to 1/16 grey level between them. The error of a transform in float64 is far below one half for
sums up to 255 times the last unit, and rounding removes the error."""


def to_whole_weights(kernel: Float, unit: int) -> Float:
    """Scale weights to the sum ``unit`` and round them. The middle weight takes up the rest, so that the sum is exact.

    A kernel that is symmetric about its middle stays symmetric.
    """
    weights = np.rint(kernel * (unit / kernel.sum()))
    weights[tuple(n // 2 for n in weights.shape)] += unit - weights.sum()
    return np.asarray(weights)


def filter_image(image: UInt8, kernel: Float) -> UInt8:
    """Correlate an image with a kernel.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    kernel : ndarray of shape (h, w), h and w odd
        Weights; scaled to the sum 1.

    Returns
    -------
    ndarray of the same shape, uint8
        Rounded half to even.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.filters import filter_image
    >>> filter_image(np.array([[0, 0, 90, 0, 0]], np.uint8), np.ones((1, 3)))
    array([[ 0, 30, 30, 30,  0]], dtype=uint8)
    """
    if kernel.size > MOST_DIRECT_WEIGHTS:
        return _filter_by_fourier_transform(image, to_whole_weights(kernel, FOURIER_UNIT))
    weights = to_whole_weights(kernel, DIRECT_UNIT).astype(np.float32)
    sums = cv2.filter2D(image.astype(np.float32), -1, weights, borderType=BORDER_MODE)
    return _divide(sums, DIRECT_UNIT)


def filter_separably(image: UInt8, taps: Float) -> UInt8:
    """Correlate an image with ``np.outer(taps, taps)``, as :func:`filter_image` does, but faster.

    Between rows and columns, values are rounded to 1/16 grey level.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.filters import filter_separably
    >>> filter_separably(np.array([[0, 0, 90, 0, 0]], np.uint8), np.ones(3))
    array([[ 0, 30, 30, 30,  0]], dtype=uint8)
    """
    if len(taps) > MOST_DIRECT_WEIGHTS:
        return filter_image(image, np.outer(taps, taps))
    return _divide(_separable_sums(image, taps), 16 * SEPARABLE_UNIT)


def filter_separably_exactly(image: UInt8, taps: Float) -> Float32:
    """Return the weighted means of :func:`filter_separably` before they are rounded to levels.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    taps : ndarray of shape (n,), n odd and at most 129
        Weights; scaled to the sum 1.

    Returns
    -------
    ndarray of the same shape, float32
        Multiples of 2⁻¹⁶ grey level.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.filters import filter_separably_exactly
    >>> filter_separably_exactly(np.array([[0, 0, 90, 1, 0]], np.uint8), np.array([1, 2, 1])).tolist()
    [[0.0, 22.5, 45.25, 23.0, 0.5]]
    """
    if len(taps) > MOST_DIRECT_WEIGHTS:
        raise ValueError(f"{len(taps)} weights, expected at most {MOST_DIRECT_WEIGHTS}")
    return np.asarray(_separable_sums(image, taps) * np.float32(1 / (16 * SEPARABLE_UNIT)))


def _separable_sums(image: UInt8, taps: Float) -> Any:
    """Return whole multiples of ``1 / (16 * SEPARABLE_UNIT)`` grey level, float32."""
    weights = to_whole_weights(taps, SEPARABLE_UNIT).astype(np.float32)
    rows: Any = cv2.filter2D(image.astype(np.float32), -1, weights[None], borderType=BORDER_MODE)
    rows *= np.float32(16 / SEPARABLE_UNIT)
    return cv2.filter2D(np.rint(rows, out=rows), -1, weights[:, None], borderType=BORDER_MODE)


def gaussian_taps(sigma_px: float) -> Float:
    """Return the weights of a Gaussian, out to four standard deviations, centred on the middle tap."""
    reach = int(np.ceil(4 * sigma_px))
    taps = exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    return np.asarray(taps / taps.sum())


def box_filter(image: UInt8, side_px: int) -> UInt8:
    """Return the mean over a square of an odd side about each pixel.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.filters import box_filter
    >>> box_filter(np.array([[0, 0, 90, 0, 0]], np.uint8), 3)
    array([[ 0, 30, 30, 30,  0]], dtype=uint8)
    """
    sums = cv2.boxFilter(image, cv2.CV_32F, (side_px, side_px), normalize=False, borderType=BORDER_MODE)
    return _divide(sums, side_px**2)


def _divide(sums: Any, unit: int) -> UInt8:
    """Divide by a whole number and round half to even. The fused steps of some processors change nothing here."""
    return np.asarray(cv2.convertScaleAbs(sums, alpha=1 / unit), np.uint8)


def _filter_by_fourier_transform(image: UInt8, weights: Float) -> UInt8:
    """Correlate by the convolution theorem in float64. Rounding to whole sums makes the result exact."""
    reach_y, reach_x = (n // 2 for n in weights.shape)
    padded = cv2.copyMakeBorder(image, reach_y, reach_y, reach_x, reach_x, BORDER_MODE)
    shape = [fft.next_fast_len(n, real=True) for n in padded.shape[:2]]
    spectrum = fft.rfft2(weights[::-1, ::-1], shape)
    channels = padded.reshape(*padded.shape[:2], -1).transpose(2, 0, 1).astype(np.float64)
    sums = [np.rint(fft.irfft2(fft.rfft2(channel, shape) * spectrum, shape)) for channel in channels]
    height, width = image.shape[:2]
    result = np.stack(
        [total[2 * reach_y : 2 * reach_y + height, 2 * reach_x : 2 * reach_x + width] for total in sums], axis=-1
    )
    return np.rint(result / FOURIER_UNIT).astype(np.uint8).reshape(image.shape)
