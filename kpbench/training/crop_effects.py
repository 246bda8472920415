"""Degradations of training crops, drawn at random. Most crops are seen by a camera with a tone curve of its own."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from kpbench.camera.chain import SCENE_TONE
from kpbench.camera.tone import ToneCurve, random_tone_curve
from kpbench.degrade.blurs import box_taps, line_kernel
from kpbench.degrade.effects import jpeg
from kpbench.filters import BORDER_MODE
from kpbench.types import Float32, UInt8

CAMERA_SHARE = 0.6
"""Probability that a crop is seen by a camera: light is blurred before a tone curve, noise grows with the light, and
the image is denoised and sharpened. The other crops are those of a linear camera."""
DRAWN_CURVES = 96
"""Number of random tone curves; a crop has one of them or one of the named curves."""
CURVE_STEPS = 1023
"""Steps of the table of a tone curve, uniform in the square root of the light."""


class DegradedCrop(NamedTuple):
    """A degraded crop, and what is known about it.

    Attributes
    ----------
    image : ndarray of shape (H, W), uint8
    clean : ndarray of shape (H, W), float32
        The crop without noise, sharpening, denoising and JPEG, grey levels.
    sigma : float
        Standard deviation of the noise, grey levels; the errors of JPEG count as noise.
    """

    image: UInt8
    clean: Float32
    sigma: float


def degrade_crop(image: UInt8, rng: np.random.Generator, severity: float, radius: float) -> DegradedCrop:
    """Degrade a crop at random: change the light, add rain, blur and noise, and process and compress the crop.

    ``severity`` : from 0 to 1. ``radius`` : short semi-axis of the smallest patch, px; limits the width of the blur.
    """
    curve = _draw_curve(rng)
    work = image.astype(np.float32) if curve is None else np.float32(255) * SCENE_TONE.decode(image)
    if rng.random() < 0.3 * severity:
        work = _draw_shadow(work, rng)
    if rng.random() < 0.08 * severity:
        work = 0.7 * _draw_rain(work, rng)
    if rng.random() < 0.6 * severity + 0.2:
        work = _blur(work, rng, severity, radius)
    draw = rng.random()
    photons = np.inf  # per grey level of light
    if draw < 0.35 * severity:  # the strongest dimming of kpbench.degrade has the factor 0.6^4
        work *= np.float32(0.6 ** rng.uniform(0.0, 4.3))
        if rng.random() < 0.3:  # low light has photon noise; sensor noise is added below
            photons = rng.uniform(1.0, 8.0)
    elif draw < 0.5 * severity:
        work = work * np.float32(rng.uniform(0.4, 1.5)) + np.float32(rng.uniform(-40, 40) if curve is None else 0)
    if curve is not None:
        photons = min(photons, np.exp(rng.uniform(np.log(1.0), np.log(60.0))))
    noisy = work
    if np.isfinite(photons):
        level = np.sqrt(np.maximum(work, 0.0) / np.float32(photons))
        noisy = noisy + rng.standard_normal(work.shape, dtype=np.float32) * level
    draw = rng.random()
    if draw < 0.75:
        strong = draw < 0.35 * severity
        added = rng.uniform(5, 70) * severity if strong else np.exp(rng.uniform(np.log(0.5), np.log(6.0)))
        share = 1.0 if curve is None else 0.3  # tone curves are steep in the dark
        noisy = noisy + rng.standard_normal(work.shape, dtype=np.float32) * np.float32(added * share)
    if curve is not None:
        work, noisy = _encode(work, curve), _encode(noisy, curve)
    sigma = 0.6 + float((noisy - work).std())  # a good sensor and rounding give about 0.6 grey levels of noise
    if curve is not None:
        noisy = _process(noisy, rng)
    result = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    if rng.random() < 0.25 * severity:
        quality = int(rng.uniform(25, 95))
        result = jpeg(result, quality)
        sigma += (100 - quality) / 15
    return DegradedCrop(result, work, sigma)


def _draw_curve(rng: np.random.Generator) -> Float32 | None:
    """Draw the table of a tone curve, or None for a linear camera."""
    if rng.random() >= CAMERA_SHARE:
        return None
    curves = _curves()
    return curves[int(rng.integers(len(curves)))]


@lru_cache(maxsize=1)
def _curves() -> list[Float32]:
    """Return the tables of all tone curves: grey level of the light (n / CURVE_STEPS)²."""
    rng = np.random.default_rng(2410)
    named = [
        ToneCurve("srgb"),
        ToneCurve("gamma", (1.8,)),
        ToneCurve("gamma", (2.4,)),
        ToneCurve("logarithmic", (50.0,)),
    ]
    named += [ToneCurve("s-curve", (strength,)) for strength in (2.0, 3.5, 5.0)]
    light = (np.arange(CURVE_STEPS + 1) / CURVE_STEPS) ** 2
    curves = [*named * 4, *(random_tone_curve(rng) for _ in range(DRAWN_CURVES))]
    return [np.asarray(255 * curve.value(light), np.float32) for curve in curves]


def _encode(light: Float32, curve: Float32) -> Float32:
    """Return the grey levels of light, in units of 1/255, by a table of :func:`_curves`."""
    root = np.sqrt(np.clip(light, 0, 255) * np.float32(1 / 255)) * np.float32(CURVE_STEPS)
    return np.asarray(curve[(root + np.float32(0.5)).astype(np.uint16)], np.float32)


def _process(levels: Float32, rng: np.random.Generator) -> Float32:
    """Denoise and sharpen, as a camera does."""
    if rng.random() < 0.35:  # guided filter (He, Sun and Tang, 2010), guided by the image itself
        side, strength = (5, 5), np.float32(rng.uniform(2.0, 10.0) ** 2)
        mean = cv2.blur(levels, side, borderType=BORDER_MODE)
        variance = np.maximum(cv2.blur(levels * levels, side, borderType=BORDER_MODE) - mean * mean, 0)
        share = variance / (variance + strength)
        offset = cv2.blur(mean * (1 - share), side, borderType=BORDER_MODE)
        levels = np.asarray(cv2.blur(share, side, borderType=BORDER_MODE) * levels + offset, np.float32)
    if rng.random() < 0.5:
        blurred = cv2.GaussianBlur(levels, (0, 0), rng.uniform(0.7, 2.0), borderType=BORDER_MODE)
        levels = levels + np.float32(rng.uniform(0.2, 1.8)) * (levels - blurred)
    return levels


def _draw_shadow(work: Float32, rng: np.random.Generator) -> Float32:
    """Draw a shadow with one straight border, a glare, or jagged shadows."""
    height, width = work.shape
    kind = rng.random()
    if kind < 0.3:
        return _draw_jagged_shadows(work, rng)
    if kind < 0.4:
        x = (np.arange(width, dtype=np.float32) - np.float32(rng.uniform(0, width))) / np.float32(rng.uniform(8, width))
        y = (np.arange(height, dtype=np.float32) - np.float32(rng.uniform(0, height))) / np.float32(
            rng.uniform(8, height)
        )
        glare = np.float32(rng.uniform(40, 200)) * np.exp(-(x**2 + y[:, None] ** 2))
        return np.asarray(work + glare, np.float32)
    angle = rng.uniform(0, 2 * np.pi)
    x = (np.arange(width, dtype=np.float32) - np.float32(rng.uniform(0, width))) * np.float32(np.cos(angle))
    y = (np.arange(height, dtype=np.float32) - np.float32(rng.uniform(0, height))) * np.float32(np.sin(angle))
    ramp = np.clip((y[:, None] + x) / np.float32(np.exp(rng.uniform(0, np.log(width)))) + 0.5, 0, 1)
    return np.asarray(work * (1 - np.float32(rng.uniform(0.1, 0.8)) * ramp), np.float32)


def _draw_jagged_shadows(work: Float32, rng: np.random.Generator) -> Float32:
    """Draw one or two pentagonal shadows, whose sides may cross."""
    height, width = work.shape
    light = np.ones_like(work)
    for _ in range(rng.integers(1, 3)):
        corners = np.rint(rng.uniform(-1.0, 2.0, (5, 2)) * (width, height)).astype(np.int32)
        factor = float(rng.uniform(0.3, 0.8))
        light *= np.where(cv2.fillPoly(np.zeros(work.shape, np.uint8), [corners], 1) > 0, np.float32(factor), 1)
    return np.asarray(work * light, np.float32)


def _draw_rain(work: Float32, rng: np.random.Generator) -> Float32:
    """Draw short, bright, parallel streaks, and blur the whole crop with a small box."""
    height, width = work.shape
    count = rng.integers(10, 60)
    start = rng.uniform(-10, 1, (count, 2)) + rng.uniform(0, 1, (count, 2)) * (width + 10, height + 10)
    step = np.array([rng.uniform(-8, 8), rng.uniform(8, 20)])
    lines = np.rint(np.stack([start, start + step], axis=1)).astype(np.int32)
    streaked = cv2.polylines(work, list(lines), False, rng.uniform(160, 230))
    reach = int(rng.choice([1, 3, 5, 7]))
    return np.asarray(cv2.blur(streaked, (reach, reach), borderType=BORDER_MODE), np.float32)


def _blur(work: Float32, rng: np.random.Generator, severity: float, radius: float) -> Float32:
    """Blur with a box, a Gaussian, a line or a disc.

    The limit of the width grows with ``radius`` and ``severity``. Patches with the short semi-axis ``radius`` stay
    visible.
    """
    widest = 1.5 + severity * (min(1.4 * radius, 19.0) - 1.5)
    width = float(rng.uniform(1.0, max(widest, 1.5)))
    kind = rng.integers(4)
    if kind == 1:  # a Gaussian with the standard deviation of a box of this width
        return np.asarray(cv2.GaussianBlur(work, (0, 0), width / np.sqrt(12)), np.float32)
    if kind == 2:
        kernel = line_kernel(round(1.5 * width), float(rng.integers(0, 180)))
    elif kind == 3:  # defocus
        side = np.arange(-int(width / 2 + 1), int(width / 2 + 1) + 1)
        disc = np.clip(width / 2 + 0.5 - np.hypot(side, side[:, None]), 0, 1)
        kernel = disc / disc.sum()
    else:
        kernel = np.outer(taps := box_taps(width), taps)
    return np.asarray(cv2.filter2D(work, -1, kernel, borderType=BORDER_MODE), np.float32)
