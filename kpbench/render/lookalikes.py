"""Look-alikes: shapes that a detector may take for a patch, such as discs, rings, chequers, text and half-patches.

Look-alikes carry no label: a detector must not report them. OpenCV draws them, without exact edges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from kpbench.patches.design import Patch, unit_polygons
from kpbench.types import Float, UInt8


@dataclass(frozen=True)
class Shape:
    """Place, size and inks of one look-alike.

    Attributes
    ----------
    x, y : float
        Centre, px.
    radius : float
        Semi-axis along the shape's own x axis, px.
    ratio : float
        Semi-axis along the shape's own y axis, as a fraction of ``radius``.
    angle_deg : float
        Angle from the image's x axis to the shape's x axis, towards +y.
    ink, second_ink : float
        Grey levels; one is dark, the other is light.
    """

    x: float
    y: float
    radius: float
    ratio: float
    angle_deg: float
    ink: float
    second_ink: float


def draw_lookalikes(
    image: UInt8,
    rng: np.random.Generator,
    count: int,
    patches: Sequence[Patch],
    radius_px: tuple[float, float] = (4.0, 40.0),
) -> None:
    """Draw look-alikes into an image, in place.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    rng : numpy.random.Generator
    count : int
        Number of look-alikes.
    patches : sequence of Patch
        The designs whose halves are drawn.
    radius_px : (float, float)
        Smallest and largest radius; radii are drawn log-uniformly.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import shipped_patches
    >>> from kpbench.render import draw_lookalikes
    >>> image = np.full((120, 160), 128, np.uint8)
    >>> draw_lookalikes(image, np.random.default_rng(0), 5, shipped_patches())
    >>> bool((image != 128).any())
    True
    """
    height, width = image.shape[:2]
    for _ in range(count):
        dark, light = float(rng.uniform(0, 120)), float(rng.uniform(150, 255))
        ink, second_ink = (dark, light) if rng.random() < 0.5 else (light, dark)
        x, y = rng.uniform(0, 1, 2) * (width, height)
        radius = float(np.exp(rng.uniform(*np.log(radius_px))))
        ratio, angle_deg = float(rng.uniform(0.4, 1)), float(rng.uniform(0, 360))
        shape = Shape(float(x), float(y), radius, ratio, angle_deg, ink, second_ink)
        kind = int(rng.integers(len(SHAPE_DRAWERS) + 1))
        if kind < len(SHAPE_DRAWERS):
            SHAPE_DRAWERS[kind](image, rng, shape)
        else:
            _draw_half_patch(image, rng, shape, patches[int(rng.integers(len(patches)))])


def _colour(image: UInt8, level: float) -> tuple[float, ...]:
    """Return a grey level as OpenCV's colour for a grey or RGB image."""
    return (level,) * (1 if image.ndim == 2 else 3)


def _to_sixteenths(points: Float) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    """Convert px to 1/16 px, the unit of OpenCV's drawing functions."""
    return np.rint(points * 16).astype(np.int32)


def _fill_ellipse(image: UInt8, shape: Shape, scale: float, level: float, end_deg: float = 360) -> None:
    """Fill the ellipse of a shape, scaled about its centre; with ``end_deg`` 180 only one half."""
    centre = (round(shape.x * 16), round(shape.y * 16))
    axes = (round(shape.radius * scale * 16), round(shape.radius * shape.ratio * scale * 16))
    cv2.ellipse(image, centre, axes, shape.angle_deg, 0, end_deg, _colour(image, level), -1, cv2.LINE_AA, 4)


def _draw_disc(image: UInt8, rng: np.random.Generator, shape: Shape) -> None:
    _fill_ellipse(image, shape, 1, shape.ink)


def _draw_rings(image: UInt8, rng: np.random.Generator, shape: Shape) -> None:
    for n, scale in enumerate(np.linspace(1, 0, int(rng.integers(2, 5)), endpoint=False)):
        _fill_ellipse(image, shape, float(scale), (shape.ink, shape.second_ink)[n % 2])


def _draw_half_disc(image: UInt8, rng: np.random.Generator, shape: Shape) -> None:
    """Draw a disc, one half dark and one half light."""
    _fill_ellipse(image, shape, 1, shape.second_ink)
    _fill_ellipse(image, shape, 1, shape.ink, 180)


def _draw_polygon(image: UInt8, rng: np.random.Generator, shape: Shape) -> None:
    """Draw a triangle or a quadrangle."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 5))))
    corners = np.column_stack([shape.x + shape.radius * np.cos(angles), shape.y + shape.radius * np.sin(angles)])
    cv2.fillPoly(image, [_to_sixteenths(corners)], _colour(image, shape.ink), cv2.LINE_AA, 4)


def _draw_text(image: UInt8, rng: np.random.Generator, shape: Shape) -> None:
    text = "".join(chr(c) for c in rng.integers(48, 91, int(rng.integers(1, 5))))
    place = (round(shape.x - shape.radius), round(shape.y + shape.radius / 2))
    font, thickness = int(rng.integers(8)), int(rng.integers(1, 4))
    cv2.putText(image, text, place, font, shape.radius / 20, _colour(image, shape.ink), thickness, cv2.LINE_AA)


def _draw_bar(image: UInt8, rng: np.random.Generator, shape: Shape) -> None:
    """Draw a bar or a line, six radii long."""
    angle = np.radians(shape.angle_deg)
    half = 3 * shape.radius * np.array([np.cos(angle), np.sin(angle)])
    start, end = ((round(shape.x + sign * half[0]), round(shape.y + sign * half[1])) for sign in (-1, 1))
    cv2.line(image, start, end, _colour(image, shape.ink), int(rng.integers(1, 8)), cv2.LINE_AA)


def _draw_chequers(image: UInt8, rng: np.random.Generator, shape: Shape) -> None:
    """Draw a chequer board: each corner looks like the patch ``checker``, but has neighbours."""
    rows, columns = (int(v) for v in rng.integers(3, 8, 2))
    side = min(shape.radius, 18.0)
    A = _rotation(shape.angle_deg) @ np.diag([side, side * max(shape.ratio, 0.5)])
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) - (columns / 2, rows / 2)
    for i in range(rows):
        for j in range(columns):
            square = _to_sixteenths((corners + np.array([j, i])) @ A.T + (shape.x, shape.y))
            level = (shape.ink, shape.second_ink)[(i + j) % 2]
            cv2.fillConvexPoly(image, square, _colour(image, level), cv2.LINE_8, 4)


def _draw_half_patch(image: UInt8, rng: np.random.Generator, shape: Shape, patch: Patch) -> None:
    """Draw one side of a patch, cut off beside its centre, so that the keypoint itself is missing."""
    black, disc = unit_polygons(patch, 2.0**-8)
    cut = float(rng.uniform(0.15, 0.4))  # distance from the centre to the cut, in radii
    spin = _rotation(float(rng.uniform(0, 360)))
    A = _rotation(shape.angle_deg) @ np.diag([1, shape.ratio]) * shape.radius
    light, dark = max(shape.ink, shape.second_ink), min(shape.ink, shape.second_ink)
    for polygons, level in ((disc, light), (black, dark)):
        # vertices beyond the cut move onto the cut, where the part that they enclose has no area
        kept = [np.maximum(polygon @ spin.T, (cut, -np.inf)) @ A.T + (shape.x, shape.y) for polygon in polygons]
        cv2.fillPoly(image, [_to_sixteenths(points) for points in kept], _colour(image, level), cv2.LINE_8, 4)


def _rotation(angle_deg: float) -> Float:
    """Rotation matrix from +x towards +y, ndarray of shape (2, 2)."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, -s], [s, c]])


SHAPE_DRAWERS: tuple[Callable[[UInt8, np.random.Generator, Shape], None], ...] = (
    _draw_disc,
    _draw_rings,
    _draw_half_disc,
    _draw_polygon,
    _draw_text,
    _draw_bar,
    _draw_chequers,
)
"""Functions that draw one look-alike each. A half-patch is the kind after the last: it takes the designs too."""
