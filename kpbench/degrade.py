"""The ladder of degradations: one pure function an effect, uint8 in, uint8 out.

Images are (H, W) or (H, W, 3), grey or RGB. No effect moves the image: every kernel's centroid is its
centre. Borders are mirrored, so that no edge appears there. Levels are grey levels (0-255) and px.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np

from kpbench.keypoints import Float, UInt8
from kpbench.raster import coverage

__all__ = ["LADDER", "blur", "brightness", "dimming", "motion_blur", "noise", "paper_mix", "rain", "shadow"]

BORDER = cv2.BORDER_REFLECT_101


def _uint8(image: Any) -> UInt8:
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


def box_taps(kernel_px: float) -> Float:
    """Weights of a box mean of any width, even or fractional, centred on the middle tap."""
    reach = int(np.ceil((kernel_px - 1) / 2))
    taps = np.ones(2 * reach + 1)
    taps[[0, -1]] -= (2 * reach + 1 - kernel_px) / 2 if reach else 0.0
    return np.asarray(taps / taps.sum())


def blur(image: UInt8, kernel_px: float) -> UInt8:
    """Box mean over ``kernel_px`` x ``kernel_px``: each pixel spreads to that size (paper §3.3)."""
    if kernel_px % 2 == 1:
        return np.asarray(cv2.blur(image, (int(kernel_px), int(kernel_px)), borderType=BORDER), np.uint8)
    taps = box_taps(kernel_px)
    return np.asarray(cv2.sepFilter2D(image, -1, taps, taps, borderType=BORDER), np.uint8)


def noise(image: UInt8, rng: np.random.Generator, sigma: float) -> UInt8:
    """Gaussian noise of standard deviation ``sigma`` grey levels, then rounded and clipped.

    The paper's "kernel size from 15 to 60 pixels" is read as this standard deviation.
    """
    field = rng.standard_normal(image.shape, dtype=np.float32)
    field *= np.float32(sigma)
    field += image
    return _uint8(field)


def dimming(image: UInt8, k: float, law: Literal["tenth", "literal"] = "tenth") -> UInt8:
    """Multiply by ``0.6 ** (k / 10)``; ``law="literal"`` takes the printed ``0.6 ** k``.

    The printed formula turns an 8-bit image black at k = 10, where the paper still detects all.
    """
    return brightness(image, 0.6 ** (k / 10 if law == "tenth" else k))


def brightness(image: UInt8, factor: float) -> UInt8:
    """Multiply all intensities, then round and clip."""
    table = _uint8(np.arange(256) * factor)
    return np.asarray(cv2.LUT(image, table), np.uint8)


@lru_cache(maxsize=512)
def line_kernel(length_px: float, angle_deg: float) -> Float:
    """Exact area coverage of a line one pixel wide and ``length_px`` long through the kernel's centre."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    half, side = length_px / 2, 0.5
    corners = np.array([[half, side], [-half, side], [-half, -side], [half, -side]])
    reach = int(np.ceil(half + 1)) + 1
    box = (-reach, -reach, 2 * reach + 1, 2 * reach + 1)
    kernel = coverage([[corners @ np.array([[c, s], [-s, c]])]], [box])[0]
    kernel = kernel + kernel[::-1, ::-1]  # point-symmetric to the last bit
    return np.asarray(kernel / kernel.sum())


def motion_blur(image: UInt8, length_px: float, angle_deg: float) -> UInt8:
    """Mean along a line through each pixel; the angle grows from +x towards +y."""
    return np.asarray(cv2.filter2D(image, -1, line_kernel(length_px, angle_deg), borderType=BORDER), np.uint8)


@lru_cache(maxsize=8)
def _albumentations(name: str) -> Any:
    os.environ["NO_ALBUMENTATIONS_UPDATE"] = "1"  # it looks on the network at import otherwise
    import albumentations

    # RandomShadow's own region of interest is the lower half of a road scene; here it is the image
    options = {"shadow_roi": (0, 0, 1, 1)} if name == "RandomShadow" else {}
    return getattr(albumentations, name)(p=1.0, **options)


def shadow(image: UInt8, seed: int) -> UInt8:
    """One or two dark polygons at half the brightness (``albumentations.RandomShadow``)."""
    transform = _albumentations("RandomShadow")
    transform.set_random_seed(seed)
    return np.asarray(transform(image=image)["image"], np.uint8)


def rain(image: UInt8, seed: int) -> UInt8:
    """Bright streaks over a dimmed image (``albumentations.RandomRain``; grey goes through three channels)."""
    transform = _albumentations("RandomRain")
    transform.set_random_seed(seed)
    if image.ndim == 3:
        return np.asarray(transform(image=image)["image"], np.uint8)
    return np.ascontiguousarray(transform(image=cv2.merge([image] * 3))["image"][..., 0])


LADDER: dict[str, tuple[Callable[[UInt8, np.random.Generator, float], UInt8], tuple[float, ...]]] = {
    "blur": (lambda image, rng, level: blur(image, level), (3, 7, 11, 15)),
    "dimming": (lambda image, rng, level: dimming(image, level), (10, 20, 30, 40)),
    "noise": (lambda image, rng, level: noise(image, rng, level), (15, 30, 45, 60)),
}
"""Effect → (function of image, rng and level; the rungs of the paper's tables)."""


def paper_mix(image: UInt8, rng: np.random.Generator) -> tuple[UInt8, list[dict[str, Any]]]:
    """The paper's deteriorations (§2.2): one to three of six, drawn without repetition.

    The paper gives no strengths; these follow the defaults of the library that it used, and the order
    is that of light and camera: shadow, rain, motion blur, blur, brightness, noise.

    Returns
    -------
    image : ndarray of the same shape, uint8
    effects : list of dict
        What was applied, in order, with the parameters that were drawn.
    """
    drawn: dict[str, dict[str, Any]] = {
        "shadow": {"seed": int(rng.integers(2**31))},
        "rain": {"seed": int(rng.integers(2**31))},
        "motion_blur": {"length_px": round(rng.uniform(3, 9), 2), "angle_deg": round(rng.uniform(0, 180), 1)},
        "blur": {"kernel_px": int(rng.choice([3, 5, 7]))},
        "brightness": {"factor": round(rng.uniform(0.5, 1.3), 3)},
        "noise": {"sigma": round(rng.uniform(5, 30), 2)},
    }
    chosen = rng.permutation(len(drawn))[: rng.integers(1, 4)]
    effects = [{"effect": name, **drawn[name]} for n, name in enumerate(drawn) if n in chosen]
    return apply(image, rng, effects), effects


FUNCTIONS: dict[str, Callable[..., UInt8]] = {
    "shadow": shadow,
    "rain": rain,
    "motion_blur": motion_blur,
    "blur": blur,
    "brightness": brightness,
    "dimming": dimming,
    "noise": noise,
}


def apply(image: UInt8, rng: np.random.Generator, effects: list[dict[str, Any]]) -> UInt8:
    """Apply recorded effects in order; noise takes its field from ``rng``."""
    for entry in effects:
        parameters = {key: value for key, value in entry.items() if key != "effect"}
        if entry["effect"] == "noise":
            parameters["rng"] = rng
        image = FUNCTIONS[entry["effect"]](image, **parameters)
    return image
