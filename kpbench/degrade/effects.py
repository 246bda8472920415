"""The ladder of degradations: one pure function an effect, uint8 in, uint8 out.

Images are (H, W) or (H, W, 3), grey or RGB. No effect moves the image: every kernel's centroid is its
centre. Borders are mirrored, so that no edge appears there. Levels are grey levels (0-255) and px.

An effect is recorded as a dict, its name under "effect" and the arguments of its function beside it:
:data:`LADDER` draws one for a level, :func:`apply` carries it out.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np

from kpbench.geometry.coverage import Box, bounding_box, clip_to_image, rasterise
from kpbench.geometry.outline import arc_vertices
from kpbench.images import encode_jpeg
from kpbench.types import Float, UInt8

Effect = dict[str, Any]

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


@lru_cache(maxsize=1)
def _normal_quantiles() -> Float:
    """2¹⁶ equally likely values of unit variance: a uniform 16-bit number picks a normal one, up to 4.3 sigma."""
    from scipy.special import ndtri

    values = ndtri((np.arange(2**16) + 0.5) / 2**16)
    return np.asarray(values / values.std())


def noise(image: UInt8, rng: np.random.Generator, sigma: float) -> UInt8:
    """Gaussian noise of standard deviation ``sigma`` grey levels, then rounded and clipped.

    The paper's "kernel size from 15 to 60 pixels" is read as this standard deviation.
    """
    # pixels are whole numbers, so the noise may be rounded before it is added
    levels = np.rint(sigma * _normal_quantiles()).astype(np.int16)
    field = levels[np.frombuffer(rng.bytes(2 * image.size), "<u2")].reshape(image.shape)
    return np.asarray(cv2.add(image, field, dtype=cv2.CV_8U), np.uint8)


def dimming(image: UInt8, k: float, law: Literal["tenth", "literal"] = "tenth") -> UInt8:
    """Multiply by ``0.6 ** (k / 10)``; ``law="literal"`` takes the printed ``0.6 ** k``.

    The printed formula turns an 8-bit image black at k = 10, where the paper still detects all.
    """
    return brightness(image, 0.6 ** (k / 10 if law == "tenth" else k))


def brightness(image: UInt8, factor: float) -> UInt8:
    """Multiply all intensities, then round and clip."""
    table = _uint8(np.arange(256) * factor)
    return np.asarray(cv2.LUT(image, table), np.uint8)


@lru_cache(maxsize=2048)  # more than paper_mix has of them; those of ladder_mix never come back
def line_kernel(length_px: float, angle_deg: float) -> Float:
    """Exact area coverage of a line one pixel wide and ``length_px`` long through the kernel's centre."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    half, side = length_px / 2, 0.5
    corners = np.array([[half, side], [-half, side], [-half, -side], [half, -side]])
    reach = int(np.ceil(half + 1)) + 1
    box = (-reach, -reach, 2 * reach + 1, 2 * reach + 1)
    kernel = rasterise([[corners @ np.array([[c, s], [-s, c]])]], [box])[0]
    kernel = kernel + kernel[::-1, ::-1]  # point-symmetric to the last bit
    kernel[kernel < 1e-9] = 0.0  # what a running sum leaves behind; OpenCV passes over zeros
    border = int((kernel.any(axis=0) | kernel.any(axis=1)).argmax())
    return np.asarray(kernel[border : len(kernel) - border, border : len(kernel) - border] / kernel.sum())


def motion_blur(image: UInt8, length_px: float, angle_deg: float) -> UInt8:
    """Mean along a line through each pixel; the angle grows from +x towards +y."""
    kernel = line_kernel(length_px, angle_deg)
    spread = cv2.filter2D(image.astype(np.float32), -1, kernel, borderType=BORDER)  # half the time of 8 bits
    return np.asarray(cv2.add(spread, np.zeros(1), dtype=cv2.CV_8U), np.uint8)


@lru_cache(maxsize=64)
def disc_kernel(radius_px: float) -> Float:
    """Exact area coverage of a disc about the kernel's centre: an ideal lens out of focus."""
    step = 2 * np.pi / 256
    rim = arc_vertices(radius_px, np.arange(256) * step, step)
    reach = int(np.ceil(radius_px)) + 1
    kernel = rasterise([[rim]], [(-reach, -reach, 2 * reach + 1, 2 * reach + 1)])[0]
    kernel = kernel + kernel[::-1, ::-1]
    return np.asarray(kernel / kernel.sum())


def defocus(image: UInt8, radius_px: float) -> UInt8:
    """Mean over the disc of confusion: each point spreads to a disc of this radius."""
    return np.asarray(cv2.filter2D(image, -1, disc_kernel(radius_px), borderType=BORDER), np.uint8)


def gaussian_taps(sigma_px: float) -> Float:
    """Weights of a Gaussian out to four standard deviations, centred on the middle tap."""
    reach = int(np.ceil(4 * sigma_px))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    return np.asarray(taps / taps.sum())


def gaussian_blur(image: UInt8, sigma_px: float) -> UInt8:
    """Gaussian of standard deviation ``sigma_px``."""
    taps = gaussian_taps(sigma_px)
    return np.asarray(cv2.sepFilter2D(image, -1, taps, taps, borderType=BORDER), np.uint8)


def _grid(image: UInt8, x: float, y: float) -> tuple[Any, Any]:
    """Offsets of all pixels from a point: a row (1, W) and a column (H, 1), float32."""
    rows, columns = image.shape[:2]
    return (np.arange(columns, dtype=np.float32) - np.float32(x))[None], (
        np.arange(rows, dtype=np.float32) - np.float32(y)
    )[:, None]


def _across(field: Any, image: UInt8) -> Any:
    """A field of shape (H, W), ready to be combined with the image, grey or RGB."""
    return field if image.ndim == 2 else field[..., None]


def shadow_edge(image: UInt8, x: float, y: float, angle_deg: float, light: float, penumbra_px: float) -> UInt8:
    """Shade the side towards ``angle_deg`` of a straight edge through (x, y) to a fraction of its light.

    Light falls linearly across the penumbra, as behind a straight edge under a lamp of uniform width.
    """
    dx, dy = _grid(image, x, y)
    c, s = (np.float32(v) for v in (np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))))
    shaded = np.clip((dx * c + dy * s) / np.float32(penumbra_px) + np.float32(0.5), 0, 1)
    return _uint8(image * _across(1 - np.float32(1 - light) * shaded, image))


def rainfall(image: UInt8, seed: int, streaks: int, length_px: float, slant_deg: float) -> UInt8:
    """Bright streaks of falling drops, each at its own place, length and opacity; the scene itself stays.

    :func:`rain` is the fixed mixture of the library that the paper used; this one has a strength.
    """
    rng = np.random.default_rng(seed)
    rows, columns = image.shape[:2]
    layer = np.zeros((rows, columns), np.uint8)
    start = rng.uniform(-0.05, 1.05, (streaks, 2)) * (columns, rows)
    slant = np.radians(slant_deg + rng.normal(0, 2, streaks))
    step = (length_px * rng.uniform(0.5, 1.5, streaks))[:, None] * np.column_stack([np.sin(slant), np.cos(slant)])
    opacity, thick = rng.integers(60, 200, streaks), rng.random(streaks) < 0.25
    ends = np.rint(16 * np.stack([start, start + step], axis=1)).astype(int).tolist()
    for (a, b), level, wide in zip(ends, opacity.tolist(), thick.tolist(), strict=True):
        cv2.line(layer, a, b, level, 2 if wide else 1, cv2.LINE_AA, 4)
    share = _across(cv2.blur(layer, (3, 3)).astype(np.float32) / 255, image)
    return _uint8(image + (np.float32(225) - image) * share)


def jpeg(image: UInt8, quality: int) -> UInt8:
    """Compress and decompress as baseline JPEG of a quality from 1 to 100."""
    packed = np.frombuffer(encode_jpeg(image, int(quality)), np.uint8)
    decoded = np.asarray(cv2.imdecode(packed, cv2.IMREAD_UNCHANGED), np.uint8)
    return decoded if image.ndim == 2 else np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), np.uint8)


def low_light(
    image: UInt8,
    rng: np.random.Generator,
    stops: float,
    full_well_e: float = 10_000.0,
    read_noise_e: float = 3.0,
    most_gain: float = 16.0,
    bits: int = 10,
) -> UInt8:
    """The same picture taken with ``2 ** -stops`` of the light, brightened to what it was.

    Grey level 255 is a full well at full light. Electrons arrive by Poisson's law, reading adds Gaussian noise,
    the analogue gain makes up for up to ``most_gain``, the converter rounds to ``bits``, and what
    is still missing is multiplied in afterwards (EMVA Standard 1288, the linear camera model).
    """
    light = 2.0**-stops
    electrons = rng.poisson(image * (full_well_e * light / 255)).astype(np.float32)
    electrons += np.float32(read_noise_e) * rng.standard_normal(image.shape, dtype=np.float32)
    gain, steps = min(most_gain, 1 / light), 2**bits - 1
    numbers = np.clip(np.rint(electrons * np.float32(gain * steps / full_well_e)), 0, steps)
    return _uint8(numbers * np.float32(255 / (steps * gain * light)))


def _strips(strips: list[list[float]]) -> list[Float]:
    """Corners of rectangles from (x, y of the middle, length, width, angle)."""
    corners = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    turned = []
    for x, y, length, width, angle_deg, _ in strips:
        c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
        turned.append(corners * (length, width) @ np.array([[c, s], [-s, c]]) + (x, y))
    return turned


def occlusion(image: UInt8, strips: list[list[float]]) -> UInt8:
    """Lay opaque strips over the image: [x, y (of the middle), length, width in px, angle_deg, grey] each."""
    result = image.copy()
    for polygon, strip in zip(_strips(strips), strips, strict=True):
        x, y, w, h = bounding_box([polygon])
        x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + w, image.shape[1]), min(y + h, image.shape[0])
        if x1 <= x0 or y1 <= y0:
            continue
        cover = _across(rasterise([[polygon]], [(x, y, w, h)])[0][y0 - y : y1 - y, x0 - x : x1 - x], image)
        part = result[y0:y1, x0:x1]
        result[y0:y1, x0:x1] = _uint8(part + (strip[5] - part) * cover)
    return result


def flare(image: UInt8, x: float, y: float, strength: float, reach_px: float) -> UInt8:
    """A lamp at (x, y) in the lens: a glow of ``strength`` grey levels that falls off with the distance, and ghosts.

    The glow is ``strength * exp(-distance / reach_px)``; three faint discs lie mirrored across the image's centre.
    """
    dx, dy = _grid(image, x, y)
    glow = np.exp(-np.sqrt(dx * dx + dy * dy) / np.float32(reach_px)) * np.float32(strength)
    middle = (image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2
    for along, size, share in ((-0.4, 0.25, 0.10), (-0.8, 0.45, 0.06), (0.5, 0.15, 0.12)):
        dx, dy = _grid(image, middle[0] + along * (x - middle[0]), middle[1] + along * (y - middle[1]))
        radius = np.float32(size * reach_px)
        glow += np.float32(share * strength) * np.clip((radius - np.sqrt(dx * dx + dy * dy)) / 4 + 0.5, 0, 1)
    return _uint8(image + _across(glow, image))


def occlusion_cover(strips: list[list[float]], box: Box) -> Float:
    """Fraction of each pixel of a box that :func:`occlusion` hides, shape (height, width)."""
    x, y, w, h = box
    seen = np.ones((h, w))
    for polygon in _strips(strips):
        around = bounding_box([polygon])
        shifted = (around[0] - x, around[1] - y, *around[2:])
        there, here = clip_to_image(shifted, seen)
        if seen[there].size:
            seen[there] *= 1 - rasterise([[polygon]], [around])[0][here]
    return 1 - seen
