"""Random shadow and random rain: the two effects of the paper whose parameters albumentations draws."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from kpbench.degrade.effects import brightness
from kpbench.types import UInt8


def import_albumentations() -> Any:
    """Import albumentations and return the module.

    The import is slow and is therefore made at the first use. ``NO_ALBUMENTATIONS_UPDATE`` stops albumentations from
    looking online for a newer version.
    """
    os.environ["NO_ALBUMENTATIONS_UPDATE"] = "1"
    import albumentations

    return albumentations


@lru_cache(maxsize=8)
def _transform(name: str) -> Any:
    # by default, RandomShadow shades only the lower half, for road scenes; here it shades the whole image
    options = {"shadow_roi": (0, 0, 1, 1)} if name == "RandomShadow" else {}
    return getattr(import_albumentations(), name)(p=1.0, **options)


def _draw_parameters(name: str, image: UInt8, seed: int) -> tuple[Any, dict[str, Any]]:
    """Return a transform of the library, and the parameters that the transform draws for an image from a seed."""
    transform = _transform(name)
    transform.set_random_seed(seed)
    return transform, transform.get_params_dependent_on_data({"shape": image.shape}, {})


def shadow(image: UInt8, seed: int) -> UInt8:
    """Darken one or two polygons to half their brightness, as ``albumentations.RandomShadow`` does.

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
    _, drawn = _draw_parameters("RandomShadow", image, seed)
    result = image.copy()
    for corners, intensity in zip(drawn["vertices_list"], drawn["intensities"], strict=True):
        mask = cv2.fillPoly(np.zeros(image.shape[:2], np.uint8), [corners], 255)
        cv2.copyTo(brightness(result, 1 - float(intensity)), mask, result)
    return result


def rain(image: UInt8, seed: int) -> UInt8:
    """Draw bright streaks over a dimmed image, as ``albumentations.RandomRain`` does for images of three channels.

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
    transform, drawn = _draw_parameters("RandomRain", image, seed)
    start = drawn["rain_drops"]
    lines = np.stack([start, start + np.array([drawn["slant"], drawn["drop_length"]])], axis=1).astype(np.int32)
    layer = np.zeros_like(image)
    cv2.polylines(layer, list(lines), False, transform.drop_color, transform.drop_width, cv2.LINE_4)
    kernel = (transform.blur_value, transform.blur_value)
    lit = cv2.add(image, cv2.blur(layer, kernel))
    return np.asarray(cv2.multiply(lit, transform.brightness_coefficient, dtype=cv2.CV_8U), np.uint8)
