"""The processor of a camera: from raw digital numbers to the 8-bit image.

Colours are demosaiced and balanced in linear numbers. The tone curve follows. Denoising and sharpening work on levels,
as in phones. All functions give the same bits on every processor: their sums are sums of whole numbers.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np

from kpbench.camera.sensor import UInt16
from kpbench.camera.tone import ToneCurve
from kpbench.filters import BORDER_MODE, filter_separably_exactly, gaussian_taps
from kpbench.types import Float, Float32, UInt8

DEMOSAIC_CODES = {"bilinear": cv2.COLOR_BayerRGGB2RGB, "edge-aware": cv2.COLOR_BayerRGGB2RGB_EA}
"""OpenCV's conversion by the name of the method. Both work in whole numbers."""
DEMOSAIC_MARGIN_PX = 2
"""Pixels by which the mosaic is continued before it is demosaiced; even, to keep the pattern."""
SLOPE_UNIT, OFFSET_UNIT = 2**12, 2**4
"""Steps of the slope and of the offset (grey levels) of the guided filter."""
LARGEST_GUIDED_SIDE = 15
"""Largest side of the guided filter's square, px. Sums of the squares of 15 x 15 levels fit into a float32."""


def demosaic(raw: UInt16, method: Literal["bilinear", "edge-aware"] = "edge-aware") -> UInt16:
    """Interpolate the two missing colours of each pixel of an RGGB mosaic.

    "bilinear" takes the mean of the nearest pixels of each colour. "edge-aware" interpolates green along the direction
    of the smaller difference, and red and blue as "bilinear" does (OpenCV's EA; the idea of Hamilton & Adams, US patent
    5629734, 1997).

    Parameters
    ----------
    raw : ndarray of shape (H, W), uint16
        Beyond the border, the mosaic continues as its mirror image about the outermost pixel.
    method : {"bilinear", "edge-aware"}

    Returns
    -------
    ndarray of shape (H, W, 3), uint16
        RGB.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import demosaic
    >>> demosaic(np.full((4, 6), 700, np.uint16))[0, 0]
    array([700, 700, 700], dtype=uint16)
    """
    margin = DEMOSAIC_MARGIN_PX
    padded = cv2.copyMakeBorder(raw, margin, margin, margin, margin, BORDER_MODE)
    whole = cv2.demosaicing(padded, DEMOSAIC_CODES[method])
    return np.ascontiguousarray(whole[margin:-margin, margin:-margin], np.uint16)


def raw_to_light(raw: UInt16, bits: int = 12, black_dn: int = 0) -> Float32:
    """Return the linear light of raw digital numbers. The largest number is the light 1.0.

    Parameters
    ----------
    raw : ndarray of shape (H, W) or (H, W, 3), uint16
    bits : int
        Resolution of the converter.
    black_dn : int
        Digital number of no light. Smaller numbers count as no light.

    Returns
    -------
    ndarray of the same shape, float32

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import raw_to_light
    >>> raw_to_light(np.array([[20, 60, 255]], np.uint16), bits=8, black_dn=55).tolist()
    [[0.0, 0.02500000037252903, 1.0]]
    """
    light = np.maximum(raw.astype(np.float32) - np.float32(black_dn), 0)
    return np.asarray(light / np.float32(2**bits - 1 - black_dn), np.float32)


def white_balance(light: Float32, gains: tuple[float, float, float]) -> Float32:
    """Multiply red, green and blue by a gain each. Light over 1 clips (von Kries).

    Parameters
    ----------
    light : ndarray of shape (H, W, 3), float32
        Linear light, RGB.
    gains : (float, float, float)

    Returns
    -------
    ndarray of the same shape, float32

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import white_balance
    >>> white_balance(np.float32([[[0.25, 0.5, 0.75]]]), (2, 1, 2)).tolist()
    [[[0.5, 0.5, 1.0]]]
    """
    return np.minimum(light * np.array(gains, np.float32), np.float32(1))


@lru_cache(maxsize=64)
def _level_by_number(curve: ToneCurve, bits: int, black_dn: int, gain: float) -> Any:
    """Return the level of each 16-bit number, ndarray of shape (65536,), uint8."""
    numbers = np.arange(2**bits, dtype=np.uint16)[None]
    levels = curve.encode(raw_to_light(numbers, bits, black_dn) * np.float32(gain))[0]
    return np.pad(levels, (0, 2**16 - len(levels)), mode="edge")


def develop(
    raw: UInt16,
    curve: ToneCurve,
    bits: int = 12,
    black_dn: int = 0,
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> UInt8:
    """Turn raw digital numbers into levels: black level, white balance and tone curve by one table per colour.

    The result is ``curve.encode(white_balance(raw_to_light(raw, bits, black_dn), gains))``. A grey image has no gains.

    Parameters
    ----------
    raw : ndarray of shape (H, W) or (H, W, 3), uint16
        Grey, or RGB as :func:`demosaic` returns it.
    curve : ToneCurve
    bits, black_dn
        See :func:`raw_to_light`.
    gains : (float, float, float)
        See :func:`white_balance`.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import ToneCurve, develop
    >>> develop(np.array([[0, 1023, 4095]], np.uint16), ToneCurve("gamma", (2.0,)))
    array([[  0, 127, 255]], dtype=uint8)
    """
    if raw.ndim == 2:
        return np.asarray(cv2.LUT(raw, _level_by_number(curve, bits, black_dn, 1.0)), np.uint8)
    tables = [_level_by_number(curve, bits, black_dn, float(gain)) for gain in gains]
    return np.asarray(cv2.LUT(raw, np.stack(tables, axis=-1)[None]), np.uint8)


def _to_levels(values: Any) -> UInt8:
    """Round half to even and clip to the range 0 to 255."""
    np.rint(values, out=values)
    return np.asarray(np.clip(values, 0, 255, out=values).astype(np.uint8))


@lru_cache(maxsize=64)
def _cached_gaussian_taps(sigma_px: float) -> Float:
    return gaussian_taps(sigma_px)


def unsharp_mask(image: UInt8, amount: float, sigma_px: float, threshold: float = 0.0) -> UInt8:
    """Sharpen an image: add a multiple of its difference to its Gaussian blur.

    ``image + amount * (image - blurred)``, where the difference is at least the threshold (Gonzalez & Woods, Digital
    Image Processing, 3rd ed., 3.6.3). Each colour is sharpened on its own.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    amount : float
        Multiple of the difference; 1 doubles the contrast of fine detail.
    sigma_px : float
        Standard deviation of the Gaussian, px, at most 16.
    threshold : float
        Smallest absolute difference that is added, grey levels.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import unsharp_mask
    >>> unsharp_mask(np.array([[50, 50, 50, 200, 200, 200]], np.uint8), amount=1, sigma_px=0.5)
    array([[ 50,  50,  34, 216, 200, 200]], dtype=uint8)
    """
    levels = image.astype(np.float32)
    detail = levels - filter_separably_exactly(image, _cached_gaussian_taps(sigma_px))
    if threshold > 0:
        detail[np.abs(detail) < np.float32(threshold)] = 0
    detail *= np.float32(amount)
    detail += levels
    return _to_levels(detail)


def median_denoise(image: UInt8, side_px: Literal[3, 5] = 3) -> UInt8:
    """Replace each level by the median of a square about its pixel (Tukey, 1977). Each colour has its own median.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
        Beyond the border, the outermost pixel is repeated.
    side_px : {3, 5}
        Side of the square.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import median_denoise
    >>> median_denoise(np.array([[9, 9, 99, 9, 9]], np.uint8))
    array([[9, 9, 9, 9, 9]], dtype=uint8)
    """
    return np.asarray(cv2.medianBlur(image, side_px), np.uint8)


def guided_denoise(image: UInt8, side_px: int = 5, sigma: float = 6.0) -> UInt8:
    """Smooth flat areas and keep edges: the guided filter of an image by itself.

    Over each square, the image is fitted by ``a * level + b`` with ``a = variance / (variance + sigma²)`` and
    ``b = (1 - a) * mean``. The means of a and b over the squares about a pixel give its new level (He, Sun & Tang,
    Guided Image Filtering, PAMI 2013, eqs. 5, 6, 8). Here a is rounded to 1/4096 and b to 1/16 grey level, so that
    sums are exact. Each colour is filtered on its own.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    side_px : int
        Side of the square, odd, at most 15.
    sigma : float
        Standard deviation of detail that is half removed, grey levels.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import guided_denoise
    >>> noisy = np.random.default_rng(0).normal(100, 4, (100, 100)).round().astype(np.uint8)
    >>> guided_denoise(noisy).std().round(1), noisy.std().round(1)
    (np.float64(1.4), np.float64(4.0))
    """
    if not (side_px % 2 and 1 <= side_px <= LARGEST_GUIDED_SIDE):
        raise ValueError(f"side_px is {side_px}, expected an odd number of at most {LARGEST_GUIDED_SIDE}")
    if image.ndim == 3:  # planes fit into the processor's cache
        planes = [guided_denoise(np.asarray(plane, np.uint8), side_px, sigma) for plane in cv2.split(image)]
        return np.asarray(cv2.merge(planes), np.uint8)
    side, n = (side_px, side_px), np.float32(side_px**2)
    settings: dict[str, Any] = {"normalize": False, "borderType": BORDER_MODE}
    mean = cv2.boxFilter(image, cv2.CV_32F, side, **settings) / n
    variance = cv2.sqrBoxFilter(image, cv2.CV_32F, side, **settings) / n - mean * mean
    variance = np.maximum(variance, 0)
    slope = variance / (variance + np.float32(sigma * sigma))
    slope = np.rint(slope * np.float32(SLOPE_UNIT))
    mean *= np.float32(SLOPE_UNIT) - slope
    offset = np.rint(mean * np.float32(OFFSET_UNIT / SLOPE_UNIT))
    slopes: Any = cv2.boxFilter(slope, cv2.CV_32F, side, **settings)
    offsets: Any = cv2.boxFilter(offset, cv2.CV_32F, side, **settings)
    slopes *= np.float32(1 / SLOPE_UNIT)
    slopes *= image
    offsets *= np.float32(1 / OFFSET_UNIT)
    slopes += offsets
    slopes /= n
    return _to_levels(slopes)
