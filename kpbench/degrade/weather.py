"""Random shadow and random rain, the two effects of the paper that albumentations draws."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from kpbench.degrade.effects import brightness
from kpbench.types import UInt8


def albumentations() -> Any:
    """The library, imported late: it is slow to import, and would look on the network for news of itself."""
    os.environ["NO_ALBUMENTATIONS_UPDATE"] = "1"
    import albumentations as library

    return library


@lru_cache(maxsize=8)
def _transform(name: str) -> Any:
    # RandomShadow's own region of interest is the lower half of a road scene; here it is the image
    options = {"shadow_roi": (0, 0, 1, 1)} if name == "RandomShadow" else {}
    return getattr(albumentations(), name)(p=1.0, **options)


def _drawn(name: str, image: UInt8, seed: int) -> tuple[Any, dict[str, Any]]:
    """A transform of the library, and what it draws for an image from a seed."""
    transform = _transform(name)
    transform.set_random_seed(seed)
    return transform, transform.get_params_dependent_on_data({"shape": image.shape}, {})


def shadow(image: UInt8, seed: int) -> UInt8:
    """One or two dark polygons at half the brightness, as ``albumentations.RandomShadow`` draws them."""
    _, drawn = _drawn("RandomShadow", image, seed)
    result = image.copy()
    for corners, intensity in zip(drawn["vertices_list"], drawn["intensities"], strict=True):
        mask = cv2.fillPoly(np.zeros(image.shape[:2], np.uint8), [corners], 255)
        cv2.copyTo(brightness(result, 1 - float(intensity)), mask, result)
    return result


def rain(image: UInt8, seed: int) -> UInt8:
    """Bright streaks over a dimmed image, as ``albumentations.RandomRain`` draws them; it asks for three channels."""
    transform, drawn = _drawn("RandomRain", image, seed)
    start = drawn["rain_drops"]
    lines = np.stack([start, start + np.array([drawn["slant"], drawn["drop_length"]])], axis=1).astype(np.int32)
    layer = np.zeros_like(image)
    cv2.polylines(layer, list(lines), False, transform.drop_color, transform.drop_width, cv2.LINE_4)
    reach = (transform.blur_value, transform.blur_value)
    lit = cv2.add(image, cv2.blur(layer, reach))
    return np.asarray(cv2.multiply(lit, transform.brightness_coefficient, dtype=cv2.CV_8U), np.uint8)
