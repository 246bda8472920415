"""Effects that degrade images, one pure function per effect; the blurs are in :mod:`kpbench.degrade.blurs`.

Every function takes and returns an image of shape (H, W) or (H, W, 3), uint8, grey or RGB. The given image stays
unchanged. No effect moves the image: the centroid of every kernel is its centre. Kernels mirror the image at its
border, so that no edge appears. The unit of intensity is the grey level, 0 to 255.

The record of an effect is a dict: the effect's name under "effect", and the arguments of the effect's function.
:func:`kpbench.degrade.draw_effect` makes the record for a level. :func:`kpbench.degrade.apply_effects` applies records.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np

from kpbench.geometry.coverage import Box, bounding_box, clip_to_image, rasterise
from kpbench.images import encode_jpeg
from kpbench.portable import cos_sin_of, exp, log, matmul, normal_quantiles
from kpbench.types import Float, UInt8

Effect = dict[str, Any]
"""The record of one effect."""

FLARE_GHOSTS = ((-0.4, 0.25, 0.10), (-0.8, 0.45, 0.06), (0.5, 0.15, 0.12))
"""Ghosts of a lens flare, three numbers per ghost.

The numbers are the position on the line from the image's centre (0) to the lamp (1), the radius as a fraction of the
glow's reach, and the intensity as a fraction of the glow's strength.
"""


def to_uint8(image: Any) -> UInt8:
    """Round grey levels and clip them to the range 0 to 255."""
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


def noise(image: UInt8, rng: np.random.Generator, sigma: float) -> UInt8:
    """Add Gaussian noise, then round and clip.

    The paper's "kernel size from 15 to 60 pixels" is read as a standard deviation of 15 to 60 grey levels.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    rng : numpy.random.Generator
    sigma : float
        Standard deviation, grey levels.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import noise
    >>> flat = np.full((200, 200), 128, np.uint8)
    >>> round(noise(flat, np.random.default_rng(0), sigma=15).std())
    15
    """
    # pixels are whole numbers, so noise can be rounded before the addition; a uniform 16-bit number picks a rounded
    # quantile, which is quicker than a normal generator
    levels = np.rint(sigma * normal_quantiles()).astype(np.int16)
    draws = np.frombuffer(rng.bytes(2 * image.size), "<u2").astype(np.uint16, copy=False)
    field = cv2.LUT(draws.reshape(len(image), -1), levels)  # takes a third of the time of NumPy's indexing
    return np.asarray(cv2.add(image, field.reshape(image.shape), dtype=cv2.CV_8U), np.uint8)


def dimming(image: UInt8, k: float, law: Literal["tenth", "literal"] = "tenth") -> UInt8:
    """Multiply all intensities by a power of 0.6, as the paper does.

    The paper prints the factor ``0.6 ** k``. At k = 10, this factor turns an 8-bit image almost black, yet the paper
    still detects all patches. The default factor is therefore ``0.6 ** (k / 10)``.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    k : float
        Exponent, see ``law``.
    law : {"tenth", "literal"}
        "tenth" for ``0.6 ** (k / 10)``, "literal" for the printed ``0.6 ** k``.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import dimming
    >>> white = np.full((1, 1), 255, np.uint8)
    >>> int(dimming(white, 10)[0, 0]), int(dimming(white, 10, law="literal")[0, 0])
    (153, 2)
    """
    return brightness(image, float(exp((k / 10 if law == "tenth" else k) * log(0.6))))


def brightness(image: UInt8, factor: float) -> UInt8:
    """Multiply all intensities by a factor, then round and clip.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    factor : float

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import brightness
    >>> brightness(np.array([[10, 100, 250]], np.uint8), 1.2)
    array([[ 12, 120, 255]], dtype=uint8)
    """
    table = to_uint8(np.arange(256) * factor)
    return np.asarray(cv2.LUT(image, table), np.uint8)


def _offsets_from(image: UInt8, x: float, y: float) -> tuple[Any, Any]:
    """Return the offsets of all pixels from a point: a row of shape (1, W) and a column of shape (H, 1), float32."""
    rows, columns = image.shape[:2]
    dx = np.arange(columns, dtype=np.float32) - np.float32(x)
    dy = np.arange(rows, dtype=np.float32) - np.float32(y)
    return dx[None], dy[:, None]


def for_all_channels(field: Any, image: UInt8) -> Any:
    """Return a field of shape (H, W) in a shape that broadcasts with the image, grey or RGB."""
    return field if image.ndim == 2 else field[..., None]


def shadow_edge(image: UInt8, x: float, y: float, angle_deg: float, light: float, penumbra_px: float) -> UInt8:
    """Shade one side of a straight edge.

    The light falls linearly across the penumbra, as behind a straight edge under a lamp of uniform width.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    x, y : float
        A point on the edge, px.
    angle_deg : float
        Direction from the edge towards the shaded side, from +x towards +y, degrees.
    light : float
        Fraction of the light that the shaded side keeps.
    penumbra_px : float
        Width of the penumbra, px.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import shadow_edge
    >>> shadow_edge(np.full((1, 7), 200, np.uint8), x=3, y=0, angle_deg=0, light=0.5, penumbra_px=2)
    array([[200, 200, 200, 150, 100, 100, 100]], dtype=uint8)
    """
    dx, dy = _offsets_from(image, x, y)
    c, s = (np.float32(v) for v in cos_sin_of(np.radians(angle_deg)))
    shaded = np.clip((dx * c + dy * s) / np.float32(penumbra_px) + np.float32(0.5), 0, 1)
    return to_uint8(image * for_all_channels(1 - np.float32(1 - light) * shaded, image))


def jpeg(image: UInt8, quality: int) -> UInt8:
    """Compress the image as baseline JPEG and decompress it.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    quality : int
        1 (worst) to 100 (best), the scale of libjpeg.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import jpeg
    >>> jpeg(np.full((1, 2), 128, np.uint8), quality=50)
    array([[128, 128]], dtype=uint8)
    """
    coded = np.frombuffer(encode_jpeg(image, int(quality)), np.uint8)
    decoded = np.asarray(cv2.imdecode(coded, cv2.IMREAD_UNCHANGED), np.uint8)
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
    """Simulate the image under less light, brightened to its former brightness.

    The camera is linear (EMVA Standard 1288). At full light, a full well gives grey level 255. The simulated exposure
    has ``2 ** -stops`` of the light. The number of electrons is Poisson-distributed, and reading adds Gaussian noise.
    An analogue gain up to ``most_gain`` makes up for the missing light. The converter rounds. A digital factor makes up
    for the light that is still missing.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    rng : numpy.random.Generator
    stops : float
        Missing light, stops. One stop halves the light.
    full_well_e : float
        Capacity of a pixel, electrons.
    read_noise_e : float
        Standard deviation of the read noise, electrons.
    most_gain : float
        Largest analogue gain.
    bits : int
        Resolution of the converter.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import low_light
    >>> grey = low_light(np.full((100, 100), 128, np.uint8), np.random.default_rng(0), stops=4)
    >>> round(grey.mean()), round(grey.std())
    (128, 7)
    """
    light = float(exp(-stops * log(2.0)))
    electrons = rng.poisson(image * (full_well_e * light / 255)).astype(np.float32)
    electrons += np.float32(read_noise_e) * rng.standard_normal(image.shape, dtype=np.float32)
    gain, steps = min(most_gain, 1 / light), 2**bits - 1
    numbers = np.clip(np.rint(electrons * np.float32(gain * steps / full_well_e)), 0, steps)
    return to_uint8(numbers * np.float32(255 / (steps * gain * light)))


def strip_corners(strips: list[list[float]]) -> list[Float]:
    """Return the corners of each strip of an occlusion, ndarray of shape (4, 2), px."""
    unit_square = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    corners = []
    for x, y, length, width, angle_deg, _ in strips:
        c, s = cos_sin_of(np.radians(angle_deg))
        corners.append(matmul(unit_square * (length, width), np.array([[c, s], [-s, c]])) + np.array([x, y]))
    return corners


def occlusion(image: UInt8, strips: list[list[float]]) -> UInt8:
    """Lay opaque strips over the image.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    strips : list of lists of six floats
        x and y of the centre, length, width (px), angle of the length from +x towards +y (degrees), grey level.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import occlusion
    >>> occlusion(np.full((1, 6), 90, np.uint8), [[2, 0, 2, 5, 0, 20]])
    array([[90, 55, 20, 55, 90, 90]], dtype=uint8)
    """
    return paint_polygons(image, strip_corners(strips), [strip[5] for strip in strips])


def paint_polygons(image: UInt8, polygons: Sequence[Float], levels: Sequence[float]) -> UInt8:
    """Lay opaque polygons of one grey level each over the image, by exact area coverage."""
    result = image.copy()
    for polygon, level in zip(polygons, levels, strict=True):
        box = bounding_box([polygon])
        in_image, in_box = clip_to_image(box, image)
        part = result[in_image]
        if part.size:
            cover = for_all_channels(rasterise([[polygon]], [box])[0][in_box], image)
            result[in_image] = to_uint8(part + (float(level) - part) * cover)
    return result


def polygon_cover(polygons: Sequence[Float], box: Box) -> Float:
    """Return the fraction of each pixel of a box that the polygons hide, ndarray of shape (height, width)."""
    x, y, w, h = box
    uncovered = np.ones((h, w))
    for polygon in polygons:
        polygon_box = bounding_box([polygon])
        relative_box = (polygon_box[0] - x, polygon_box[1] - y, *polygon_box[2:])
        in_box, in_polygon = clip_to_image(relative_box, uncovered)
        if uncovered[in_box].size:
            uncovered[in_box] *= 1 - rasterise([[polygon]], [polygon_box])[0][in_polygon]
    return 1 - uncovered


def flare(image: UInt8, x: float, y: float, strength: float, reach_px: float) -> UInt8:
    """Add the glow of a lamp, and three ghosts (lens reflections) on the line through the lamp and the image's centre.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    x, y : float
        Place of the lamp, px.
    strength : float
        Glow at the lamp, grey levels. At a distance in px, the glow is ``strength * exp(-distance / reach_px)``.
    reach_px : float
        Distance at which the glow has fallen to 1/e, px.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import flare
    >>> bright = flare(np.full((60, 80), 50, np.uint8), x=20, y=20, strength=100, reach_px=10)
    >>> int(bright[20, 20]), int(bright[59, 79])
    (150, 50)
    """
    dx, dy = _offsets_from(image, x, y)
    glow = _exp_falling(np.sqrt(dx * dx + dy * dy) / np.float32(reach_px)) * np.float32(strength)
    middle_x, middle_y = (image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2
    for position, size, intensity in FLARE_GHOSTS:
        dx, dy = _offsets_from(image, middle_x + position * (x - middle_x), middle_y + position * (y - middle_y))
        radius = np.float32(size * reach_px)
        ghost = np.clip((radius - np.sqrt(dx * dx + dy * dy)) / 4 + 0.5, 0, 1)
        glow += np.float32(intensity * strength) * ghost
    return to_uint8(image + for_all_channels(glow, image))


@lru_cache(maxsize=1)
def _exp_table() -> Any:
    """Return exp(-x) for x = 0, 1/256, …, 32, float32."""
    return exp(-np.arange(32 * 256 + 1) / 256).astype(np.float32)


def _exp_falling(x: Any) -> Any:
    """Return exp(-x) of a float32 array of numbers from 0, linear between the table's entries, accurate to 2e-6."""
    steps = np.minimum(x * np.float32(256), np.float32(32 * 256 - 1))
    below = np.floor(steps)
    table, nth = _exp_table(), below.astype(np.int32)
    low = table[nth]
    return low + (table[nth + 1] - low) * (steps - below)
