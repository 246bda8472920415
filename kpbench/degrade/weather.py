"""Shadow and rain: :func:`shadow` and :func:`rain` of the paper, and :func:`rainfall` with a strength.

The paper took its two from the library albumentations. The random numbers here have the distributions of
``RandomShadow`` and ``RandomRain`` of that library (version 2.0.8, default arguments). The images therefore have the
same statistics.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from kpbench.degrade.effects import brightness, for_all_channels, to_uint8
from kpbench.filters import box_filter
from kpbench.portable import cos_sin
from kpbench.types import UInt8

SHADOW_CORNERS = 5
"""Number of corners of a shadow. The corners are drawn anywhere in the image; the sides may cross each other."""
SHADOW_LIGHT = 0.5
"""Fraction of the light that a shadow keeps."""
DROPS_PER_ROW = 1 / 3
"""Number of raindrops per row of pixels."""
DROP_LENGTH = 1 / 8
"""Length of the trail of a drop downwards, in image heights."""
DROP_SLANT_PX = 10.0
"""Largest length of the trail of a drop sideways, px. All drops of an image have the same slant."""
DROP_GREY = 200
"""Grey level that a drop adds before the blur."""
DROP_BLUR_PX = 7
"""Side of the box mean that blurs the drops, px."""
RAIN_LIGHT = 0.7
"""Fraction of the light that rain leaves, drops included."""


def shadow(image: UInt8, seed: int) -> UInt8:
    """Darken one or two random polygons to half their brightness.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    seed : int
        Seed of the polygons.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import shadow
    >>> np.unique(shadow(np.full((60, 80), 200, np.uint8), seed=1)).tolist()
    [100, 200]
    """
    rng = np.random.default_rng(seed)
    result = image.copy()
    for _ in range(int(rng.integers(1, 3))):
        corners = rng.integers((0, 0), image.shape[1::-1], (SHADOW_CORNERS, 2)).astype(np.int32)
        mask = cv2.fillPoly(np.zeros(image.shape[:2], np.uint8), [corners], 255)
        cv2.copyTo(brightness(result, SHADOW_LIGHT), mask, result)
    return result


def rain(image: UInt8, seed: int) -> UInt8:
    """Draw bright streaks over the image, and dim the image.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    seed : int
        Seed of the streaks.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import rain
    >>> wet = rain(np.full((60, 80), 100, np.uint8), seed=1)
    >>> int(wet.min()), bool(wet.max() > 100)
    (70, True)
    """
    rng = np.random.default_rng(seed)
    height, width = image.shape[:2]
    length = max(1, int(DROP_LENGTH * height))
    trail = np.array([math.floor(rng.uniform(-DROP_SLANT_PX, DROP_SLANT_PX)), length])
    start = rng.integers((0, 0), (width, height - length), (int(DROPS_PER_ROW * height), 2))
    layer = np.zeros((height, width), np.uint8)
    lines = np.stack([start, start + trail], axis=1).astype(np.int32)
    cv2.polylines(layer, list(lines), False, DROP_GREY, 1, cv2.LINE_4)
    drops = box_filter(layer, DROP_BLUR_PX)
    lit = cv2.add(image, drops if image.ndim == 2 else cv2.merge([drops] * 3))
    return brightness(np.asarray(lit, np.uint8), RAIN_LIGHT)


def rainfall(image: UInt8, seed: int, streaks: int, length_px: float, slant_deg: float) -> UInt8:
    """Draw bright streaks of falling drops over the image.

    The paper's rain is :func:`rain`, whose strength is fixed. Here, ``streaks`` sets the strength.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    seed : int
        Seed of the place, slant, length, width and opacity of each streak.
    streaks : int
        Number of streaks.
    length_px : float
        Mean length of the streaks, px.
    slant_deg : float
        Mean angle of the streaks, from straight down towards +x, degrees.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import rainfall
    >>> wet = rainfall(np.full((60, 80), 90, np.uint8), seed=1, streaks=20, length_px=8, slant_deg=10)
    >>> int(wet.min()), bool(wet.max() > 100)
    (90, True)
    """
    rng = np.random.default_rng(seed)
    rows, columns = image.shape[:2]
    layer = np.zeros((rows, columns), np.uint8)
    start = rng.uniform(-0.05, 1.05, (streaks, 2)) * (columns, rows)
    slant = np.radians(slant_deg + rng.normal(0, 2, streaks))
    step = (length_px * rng.uniform(0.5, 1.5, streaks))[:, None] * np.column_stack(cos_sin(slant)[::-1])
    opacity, is_thick = rng.integers(60, 200, streaks), rng.random(streaks) < 0.25
    ends = np.rint(16 * np.stack([start, start + step], axis=1)).astype(int).tolist()
    for (a, b), level, thick in zip(ends, opacity.tolist(), is_thick.tolist(), strict=True):
        cv2.line(layer, a, b, level, 2 if thick else 1, cv2.LINE_AA, 4)
    share = for_all_channels(box_filter(layer, 3).astype(np.float32) / 255, image)
    return to_uint8(image + (np.float32(225) - image) * share)
