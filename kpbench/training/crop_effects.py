"""Degradations of training crops, drawn at random."""

from __future__ import annotations

import cv2
import numpy as np

from kpbench.degrade.blurs import box_taps, line_kernel
from kpbench.degrade.effects import jpeg
from kpbench.filters import BORDER_MODE
from kpbench.types import Float32, UInt8


def degrade_crop(
    image: UInt8, rng: np.random.Generator, severity: float, radius: float
) -> tuple[UInt8, float, float, float]:
    """Degrade a crop at random: change the light, add rain, blur and noise, and compress the crop as JPEG.

    ``severity`` : from 0 to 1. ``radius`` : short semi-axis of the smallest patch, px; limits the width of the blur.

    Returns
    -------
    image : ndarray of shape (H, W), uint8
    gain : float
        Estimated contrast after the degradations / contrast before the degradations, at the point of the crop where
        this ratio is smallest. A rise of contrast is not counted. Blur is not counted.
    kernel : float
        Width of the blur, px; 0: no blur.
    sigma : float
        Estimated standard deviation of the noise, grey levels.
    """
    gain, kernel, sigma = 1.0, 0.0, 0.6  # a good sensor and rounding give about 0.6 grey levels of noise
    work = image.astype(np.float32)
    if rng.random() < 0.3 * severity:
        work, factor = _draw_shadow(work, rng)
        gain *= factor
    if rng.random() < 0.08 * severity:
        work = 0.7 * _draw_rain(work, rng)
        gain *= 0.7
        sigma += 4.0
    if rng.random() < 0.6 * severity + 0.2:
        work, kernel = _blur(work, rng, severity, radius)
    draw = rng.random()
    if draw < 0.35 * severity:  # the strongest dimming of kpbench.degrade has the factor 0.6^4
        factor = 0.6 ** rng.uniform(0.0, 4.3)
        work *= np.float32(factor)
        gain *= factor
        if rng.random() < 0.3:  # low light has photon noise; sensor noise is added below
            photons = rng.uniform(1.0, 8.0)
            level = np.maximum(work, 0.0) * np.float32(photons)
            work += rng.standard_normal(work.shape, dtype=np.float32) * np.sqrt(level) / np.float32(photons)
            sigma += float(np.sqrt(work.mean().clip(0) / photons))
    elif draw < 0.5 * severity:
        factor = rng.uniform(0.4, 1.5)
        offset = rng.uniform(-40, 40)
        work = work * np.float32(factor) + np.float32(offset)
        gain *= min(factor, 1.0)
    draw = rng.random()
    if draw < 0.75:
        strong = draw < 0.35 * severity
        added = rng.uniform(5, 70) * severity if strong else np.exp(rng.uniform(np.log(0.5), np.log(6.0)))
        work += rng.standard_normal(work.shape, dtype=np.float32) * np.float32(added)
        sigma += added
    result = np.clip(np.rint(work), 0, 255).astype(np.uint8)
    if rng.random() < 0.25 * severity:
        quality = int(rng.uniform(25, 95))
        result = jpeg(result, quality)
        sigma += (100 - quality) / 15
    return result, gain, kernel, sigma


def _draw_shadow(work: Float32, rng: np.random.Generator) -> tuple[Float32, float]:
    """Draw a shadow with one straight border, a glare, or jagged shadows; return the image and its least gain."""
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
        return np.asarray(work + glare, np.float32), 0.5
    angle = rng.uniform(0, 2 * np.pi)
    x = (np.arange(width, dtype=np.float32) - np.float32(rng.uniform(0, width))) * np.float32(np.cos(angle))
    y = (np.arange(height, dtype=np.float32) - np.float32(rng.uniform(0, height))) * np.float32(np.sin(angle))
    ramp = np.clip((y[:, None] + x) / np.float32(np.exp(rng.uniform(0, np.log(width)))) + 0.5, 0, 1)
    factor = rng.uniform(0.2, 0.9)
    return np.asarray(work * (1 - np.float32(1 - factor) * ramp), np.float32), factor


def _draw_jagged_shadows(work: Float32, rng: np.random.Generator) -> tuple[Float32, float]:
    """Draw one or two pentagonal shadows, whose sides may cross; return the image and its least gain."""
    height, width = work.shape
    light, darkest = np.ones_like(work), 1.0
    for _ in range(rng.integers(1, 3)):
        corners = np.rint(rng.uniform(-1.0, 2.0, (5, 2)) * (width, height)).astype(np.int32)
        factor = float(rng.uniform(0.3, 0.8))
        light *= np.where(cv2.fillPoly(np.zeros(work.shape, np.uint8), [corners], 1) > 0, np.float32(factor), 1)
        darkest *= factor
    return work * light, darkest


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


def _blur(work: Float32, rng: np.random.Generator, severity: float, radius: float) -> tuple[Float32, float]:
    """Blur with a box, a Gaussian, a line or a disc; return the image and the width of the blur, px.

    The limit of the width grows with ``radius`` and ``severity``. Patches with the short semi-axis ``radius`` stay
    visible.
    """
    widest = 1.5 + severity * (min(1.4 * radius, 19.0) - 1.5)
    width = float(rng.uniform(1.0, max(widest, 1.5)))
    kind = rng.integers(4)
    if kind == 1:  # a Gaussian with the standard deviation of a box of this width
        return np.asarray(cv2.GaussianBlur(work, (0, 0), width / np.sqrt(12)), np.float32), width
    if kind == 2:
        kernel = line_kernel(round(1.5 * width), float(rng.integers(0, 180)))
    elif kind == 3:  # defocus
        side = np.arange(-int(width / 2 + 1), int(width / 2 + 1) + 1)
        disc = np.clip(width / 2 + 0.5 - np.hypot(side, side[:, None]), 0, 1)
        kernel = disc / disc.sum()
    else:
        kernel = np.outer(taps := box_taps(width), taps)
    return np.asarray(cv2.filter2D(work, -1, kernel, borderType=BORDER_MODE), np.float32), width
