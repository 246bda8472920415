"""Detail on patches: what real patches carry and a clean rendering lacks.

A *detail* is drawn in linear light into the pixels of one patch. Its shape lives in the patch frame, so that it follows
the pose. Shapes use nothing but ``+ - * /``, square roots and rounding, so that every processor gives the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kpbench.camera.chain import SCENE_TONE
from kpbench.geometry.coverage import bounding_box, clip_to_image
from kpbench.geometry.homography import project
from kpbench.portable import cos_sin, cos_sin_of
from kpbench.types import Float, Float32, UInt8

REACH = 1.15
"""Details are drawn up to this distance from the centre, disc radii. Ropes and tape end there."""
SOFT = ("crease", "dirt", "glare")
"""Kinds that fade between the rim of the disc and ``REACH``."""
MOST_ON_CENTRE = 0.15
"""Largest radius of what may cover the centre: hub or screw, disc radii."""
SPECULAR_LIGHT = (0.8, 3.0)
"""Range of the light of a highlight, in units of white paper. Light over 1 clips at the sensor."""


@dataclass(frozen=True)
class Grid:
    """The pixels of one patch, and the light on it.

    Attributes
    ----------
    u, v : ndarray of shape (h, w), float32
        Place of each pixel in the patch frame.
    pixel : float
        Side of a pixel at the centre, disc radii.
    white : float
        Light of white paper.
    towards_light : (float, float)
        Direction of the light in the patch frame, of length 1.
    """

    u: Float32
    v: Float32
    pixel: float
    white: float
    towards_light: tuple[float, float]

    def cover(self, depth: Any) -> Any:
        """Return the cover from 0 to 1 of a shape, whose edge lies at depth 0, with an edge of one pixel."""
        return np.clip(depth / self.pixel + 0.5, 0.0, 1.0)


def paint_detail(
    image: UInt8 | Float32,
    H_patch2image: Float,
    rng: np.random.Generator,
    count: int = 3,
    kinds: Sequence[str] | None = None,
    white: float = 0.8,
) -> list[str]:
    """Draw detail onto one patch, in place. The centre of the patch stays the truth.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), float32 or uint8
        Linear light, or grey levels of :data:`kpbench.camera.chain.SCENE_TONE`.
    H_patch2image : ndarray of shape (3, 3)
    rng : numpy.random.Generator
    count : int
        Number of details.
    kinds : sequence of str, optional
        Kinds to draw from, of :data:`DETAILS`. None: all kinds.
    white : float
        Linear light of white paper at the patch.

    Returns
    -------
    list of str
        The kinds that were drawn, in their order. What covers comes before what lies on it.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.render import paint_detail
    >>> image, H_patch2image = np.full((80, 100), 128, np.uint8), np.array([[30.0, 0, 50], [0, 30, 40], [0, 0, 1]])
    >>> paint_detail(image, H_patch2image, np.random.default_rng(3), count=2)
    ['crease', 'screw']
    """
    names = list(kinds or DETAILS)
    drawn = sorted((names[int(rng.integers(len(names)))] for _ in range(count)), key=list(DETAILS).index)
    c, s = cos_sin_of(2 * math.pi * float(rng.random()))
    angles = np.arange(24) * (2 * np.pi / 24)
    rim = project(H_patch2image, REACH * np.column_stack(cos_sin(angles)))
    box = bounding_box([rim])
    in_image, _ = clip_to_image(box, image)
    rows, columns = in_image
    if rows.start == rows.stop or columns.start == columns.stop:
        return drawn
    grid = _grid(H_patch2image, rows, columns, white, (float(c), float(s)))
    if image.dtype == np.uint8:
        light = SCENE_TONE.decode(np.ascontiguousarray(image[in_image], np.uint8))
    else:
        light = np.asarray(image[in_image], np.float32)
    planes = [light] if light.ndim == 2 else [light[..., channel] for channel in range(3)]
    beyond = REACH - np.sqrt(grid.u * grid.u + grid.v * grid.v)
    hard, soft = grid.cover(beyond), np.clip(beyond / (REACH - 1), 0.0, 1.0)
    for name in drawn:
        cover, reflected, factor = DETAILS[name](grid, rng)
        limit = soft if name in SOFT else hard
        cover = cover * limit
        tint = rng.uniform(0.85, 1.15, 3) if len(planes) == 3 else np.ones(1)
        for plane, colour in zip(planes, tint.tolist(), strict=True):
            shaded = plane * (1 + (factor - 1) * limit)
            plane[...] = shaded + cover * (reflected * (grid.white * colour) - shaded)
    image[in_image] = SCENE_TONE.encode(np.asarray(light, np.float32)) if image.dtype == np.uint8 else light
    return drawn


def _grid(H: Float, rows: slice, columns: slice, white: float, towards_light: tuple[float, float]) -> Grid:
    """Return the pixels of rows and columns in the patch frame, by the adjoint of the homography."""
    x = np.arange(columns.start, columns.stop)
    y = np.arange(rows.start, rows.stop)[:, None]
    (m00, m10, m20), (m01, m11, m21), (m02, m12, m22) = H.T.tolist()
    u = (m11 * m22 - m12 * m21) * x + (m02 * m21 - m01 * m22) * y + (m01 * m12 - m02 * m11)
    v = (m12 * m20 - m10 * m22) * x + (m00 * m22 - m02 * m20) * y + (m02 * m10 - m00 * m12)
    w = (m10 * m21 - m11 * m20) * x + (m01 * m20 - m00 * m21) * y + (m00 * m11 - m01 * m10)
    centre = m22 * m22 * m22
    determinant = m00 * (m11 * m22 - m12 * m21) - m01 * (m10 * m22 - m12 * m20) + m02 * (m10 * m21 - m11 * m20)
    u, v = (np.asarray(value / w, np.float32) for value in (u, v))
    return Grid(u, v, math.sqrt(abs(centre / determinant)), white, towards_light)


Shape = tuple[Any, Any, Any]
"""Cover (0 to 1), reflected light in units of white paper, and the factor of the light of what lies below."""


def _bump(square: Any) -> Any:
    """Return (1 - d²)² of squared distances, and 0 from the distance 1 on."""
    rest = np.maximum(1 - square, 0.0)
    return rest * rest


def _turned(grid: Grid, u: float, v: float, rng: np.random.Generator) -> tuple[Float32, Float32]:
    """Return coordinates along and across a random direction, from a point."""
    c, s = cos_sin_of(2 * math.pi * float(rng.random()))
    x, y = grid.u - u, grid.v - v
    return x * c + y * s, y * c - x * s


def _place(rng: np.random.Generator, radius: float) -> tuple[float, float]:
    """Draw a place, uniform in a disc about the centre."""
    (c, s), distance = cos_sin_of(2 * math.pi * float(rng.random())), radius * math.sqrt(float(rng.random()))
    return distance * float(c), distance * float(s)


def _dome(grid: Grid, u: float, v: float, radius: float, rng: np.random.Generator, is_dome: bool) -> Shape:
    """Return a round thing of metal or plastic: a dome, bright towards the light, with a highlight and a shadow."""
    x, y, (lu, lv) = (grid.u - u) / radius, (grid.v - v) / radius, grid.towards_light
    square = x * x + y * y
    tone = float(rng.uniform(0.03, 0.9))
    slope = np.minimum(square, 1.0) if is_dome else 1.0
    shade = 0.65 + 0.45 * (x * lu + y * lv) * slope
    hx, hy = x - 0.45 * lu, y - 0.45 * lv
    highlight = float(rng.uniform(*SPECULAR_LIGHT)) * _bump((hx * hx + hy * hy) / float(rng.uniform(0.05, 0.25)))
    sx, sy, shadow = x + 0.4 * lu, y + 0.4 * lv, float(rng.uniform(0.2, 0.6))
    cover = grid.cover((1 - np.sqrt(square)) * radius)
    return cover, tone * np.clip(shade, 0.05, None) + highlight, 1 - shadow * _bump((sx * sx + sy * sy) / 2.25)


def hub(grid: Grid, rng: np.random.Generator) -> Shape:
    """Draw a hub, rivet or button on the centre, with a ring around its middle."""
    radius = float(rng.uniform(0.05, MOST_ON_CENTRE))
    u, v = _place(rng, 0.02)
    cover, reflected, factor = _dome(grid, u, v, radius, rng, True)
    x, y = grid.u - u, grid.v - v
    ring = np.sqrt(x * x + y * y) / radius - float(rng.uniform(0.45, 0.8))
    return cover, reflected * (1 - 0.6 * _bump(ring * ring / 0.012)), factor


def screw(grid: Grid, rng: np.random.Generator) -> Shape:
    """Draw the head of a screw with a slot or a cross, on the centre or elsewhere."""
    radius = float(rng.uniform(0.03, 0.1))
    u, v = _place(rng, 0.02 if rng.random() < 0.6 else 0.9)
    cover, reflected, factor = _dome(grid, u, v, radius, rng, False)
    along, across = _turned(grid, u, v, rng)
    half, reach = 0.14 * radius, 0.75 * radius
    slot = grid.cover(half - np.abs(across)) * grid.cover(reach - np.abs(along))
    if rng.random() < 0.5:
        slot = np.maximum(slot, grid.cover(half - np.abs(along)) * grid.cover(reach - np.abs(across)))
    return cover, reflected * (1 - 0.85 * slot), factor


def rope(grid: Grid, rng: np.random.Generator) -> Shape:
    """Draw a rope or a cable that crosses the patch, or hangs from its centre."""
    half, bend, hangs = float(rng.uniform(0.012, 0.05)), float(rng.uniform(-0.35, 0.35)), rng.random() < 0.5
    u, v = _place(rng, 0.03 if hangs else 0.5)
    along, across = _turned(grid, u, v, rng)
    slope = 2 * bend * along
    aside = (across - bend * along * along) / np.sqrt(1 + slope * slope)
    if hangs:
        before = np.maximum(-along, 0.0)
        depth = half - np.sqrt(aside * aside + before * before)
    else:
        depth = half - np.abs(aside)
    side = np.clip(aside / half, -1.0, 1.0)
    shade = 0.35 + 0.65 * np.sqrt(1 - side * side)
    if rng.random() < 0.6:  # strands
        turns = along / (half * float(rng.uniform(1.5, 3.0))) + 0.5 * side
        strand = turns - np.floor(turns) - 0.5
        shade = shade * (1 - 1.6 * strand * strand)
    lu, lv = grid.towards_light
    shift, width = 0.6 * half * (1 if lu + lv > 0 else -1), 2.2 * half
    reach = (aside + shift) / width
    if hangs:
        reach = np.sqrt(reach * reach + (np.maximum(-along, 0.0) / width) ** 2)
    return grid.cover(depth), float(rng.uniform(0.03, 0.9)) * shade, 1 - 0.45 * _bump(reach * reach)


def tape(grid: Grid, rng: np.random.Generator) -> Shape:
    """Draw a strip of tape, opaque or clear."""
    half, length = float(rng.uniform(0.04, 0.14)), float(rng.uniform(0.3, 1.2))
    along, across = _turned(grid, *_place(rng, 0.8), rng)
    opacity = float(rng.uniform(0.25, 1.0))
    cover = opacity * grid.cover(half - np.abs(across)) * grid.cover(length - np.abs(along))
    sheen = (across - half * float(rng.uniform(-1, 1))) / half
    return cover, float(rng.uniform(0.05, 0.95)) * (1 + float(rng.uniform(0, 0.6)) * _bump(sheen * sheen)), 1.0


def crease(grid: Grid, rng: np.random.Generator) -> Shape:
    """Draw a crease of the paper: one flank turns to the light, and the other flank away from the light."""
    width, strength = float(rng.uniform(0.02, 0.08)), float(rng.uniform(0.2, 0.7))
    along, across = _turned(grid, *_place(rng, 0.7), rng)
    bend = float(rng.uniform(-0.1, 0.1))
    t = (across - bend * along * along) / width
    # t (1 - t²)² has its extremes at t = 1 / sqrt(5), where it is 0.286
    factor = 1 + strength * t * _bump(t * t) / 0.286
    worn = float(rng.uniform(0.0, 0.5)) * grid.cover(0.12 * width - np.abs(t) * width)
    return worn, 0.7, factor


def dirt(grid: Grid, rng: np.random.Generator) -> Shape:
    """Draw a patch of dirt: dark blotches, dense in its middle."""
    clear: Any = 1.0
    u, v = _place(rng, 0.8)
    spread, opacity = float(rng.uniform(0.1, 0.5)), float(rng.uniform(0.4, 0.95))
    for _ in range(int(rng.integers(5, 16))):
        du, dv = _place(rng, spread)
        along, across = _turned(grid, u + du, v + dv, rng)
        size, stretch = float(rng.uniform(0.02, 0.2)), float(rng.uniform(1.0, 3.0))
        square = (along * along / (stretch * stretch) + across * across) / (size * size)
        clear = clear * (1 - opacity * float(rng.uniform(0.2, 1.0)) * _bump(square))
    return 1 - clear, float(rng.uniform(0.02, 0.15)), 1.0


def glare(grid: Grid, rng: np.random.Generator) -> Shape:
    """Draw the reflection of a lamp on glossy ink: bright core, wide halo."""
    along, across = _turned(grid, *_place(rng, 0.9), rng)
    size, stretch = float(rng.uniform(0.1, 0.5)), float(rng.uniform(1.0, 3.0))
    square = (along * along / (stretch * stretch) + across * across) / (size * size)
    core, halo = _bump(square / 0.16), _bump(square)
    cover = np.minimum(0.95 * core + float(rng.uniform(0.1, 0.5)) * halo, 1.0)
    return cover, float(rng.uniform(*SPECULAR_LIGHT)), 1.0


DETAILS: dict[str, Callable[[Grid, np.random.Generator], Shape]] = {
    "crease": crease,
    "dirt": dirt,
    "tape": tape,
    "rope": rope,
    "hub": hub,
    "screw": screw,
    "glare": glare,
}
"""The function of each kind of detail, in the order in which details lie on each other."""
