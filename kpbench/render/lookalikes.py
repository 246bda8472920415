"""Look-alikes: shapes that a detector may mistake for a patch, such as discs, rings, chequers, text and half-patches.

Look-alikes have no keypoint: a detector must not report a look-alike. OpenCV draws look-alikes, without exact edges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from kpbench.patches.design import Patch, unit_polygons
from kpbench.portable import cos_sin, cos_sin_of, exp, log, matmul
from kpbench.types import Float, UInt8


@dataclass(frozen=True)
class Lookalike:
    """Place, size and inks of one look-alike.

    Attributes
    ----------
    x, y : float
        Centre, px.
    radius : float
        Semi-axis along the look-alike's own x axis, px.
    ratio : float
        Semi-axis along the look-alike's own y axis, as a fraction of ``radius``.
    angle_deg : float
        Angle from the image's x axis to the look-alike's x axis, towards +y.
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
        The designs of the half-patches.
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
        radius = float(exp(rng.uniform(*log(radius_px))))
        ratio, angle_deg = float(rng.uniform(0.4, 1)), float(rng.uniform(0, 360))
        lookalike = Lookalike(float(x), float(y), radius, ratio, angle_deg, ink, second_ink)
        kind = int(rng.integers(len(DRAWERS) + 1))
        if kind < len(DRAWERS):
            DRAWERS[kind](image, rng, lookalike)
        else:
            _draw_half_patch(image, rng, lookalike, patches[int(rng.integers(len(patches)))])


def _colour(image: UInt8, level: float) -> tuple[float, ...]:
    """Return a grey level in the form in which OpenCV takes a colour for this image, which is grey or RGB."""
    return (level,) * (1 if image.ndim == 2 else 3)


def _to_sixteenths(points: Float) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    """Convert px to 1/16 px, the unit of OpenCV's drawing functions."""
    return np.rint(points * 16).astype(np.int32)


def _fill_ellipse(image: UInt8, lookalike: Lookalike, scale: float, level: float, end_deg: float = 360) -> None:
    """Fill the ellipse of a look-alike, scaled about its centre. If ``end_deg`` is 180, fill only one half."""
    centre = (round(lookalike.x * 16), round(lookalike.y * 16))
    axes = (round(lookalike.radius * scale * 16), round(lookalike.radius * lookalike.ratio * scale * 16))
    cv2.ellipse(image, centre, axes, lookalike.angle_deg, 0, end_deg, _colour(image, level), -1, cv2.LINE_AA, 4)


def _draw_disc(image: UInt8, rng: np.random.Generator, lookalike: Lookalike) -> None:
    _fill_ellipse(image, lookalike, 1, lookalike.ink)


def _draw_rings(image: UInt8, rng: np.random.Generator, lookalike: Lookalike) -> None:
    for n, scale in enumerate(np.linspace(1, 0, int(rng.integers(2, 5)), endpoint=False)):
        _fill_ellipse(image, lookalike, float(scale), (lookalike.ink, lookalike.second_ink)[n % 2])


def _draw_half_disc(image: UInt8, rng: np.random.Generator, lookalike: Lookalike) -> None:
    """Draw a disc with a dark half and a light half."""
    _fill_ellipse(image, lookalike, 1, lookalike.second_ink)
    _fill_ellipse(image, lookalike, 1, lookalike.ink, 180)


def _draw_polygon(image: UInt8, rng: np.random.Generator, lookalike: Lookalike) -> None:
    """Draw a triangle or a quadrangle."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 5))))
    corners = (lookalike.x, lookalike.y) + lookalike.radius * np.column_stack(cos_sin(angles))
    cv2.fillPoly(image, [_to_sixteenths(corners)], _colour(image, lookalike.ink), cv2.LINE_AA, 4)


def _draw_text(image: UInt8, rng: np.random.Generator, lookalike: Lookalike) -> None:
    text = "".join(chr(c) for c in rng.integers(48, 91, int(rng.integers(1, 5))))
    place = (round(lookalike.x - lookalike.radius), round(lookalike.y + lookalike.radius / 2))
    font, thickness = int(rng.integers(8)), int(rng.integers(1, 4))
    cv2.putText(image, text, place, font, lookalike.radius / 20, _colour(image, lookalike.ink), thickness, cv2.LINE_AA)


def _draw_bar(image: UInt8, rng: np.random.Generator, lookalike: Lookalike) -> None:
    """Draw a bar or a line, six radii long."""
    half = 3 * lookalike.radius * np.array(cos_sin_of(np.radians(lookalike.angle_deg)))
    start, end = ((round(lookalike.x + sign * half[0]), round(lookalike.y + sign * half[1])) for sign in (-1, 1))
    cv2.line(image, start, end, _colour(image, lookalike.ink), int(rng.integers(1, 8)), cv2.LINE_AA)


def _draw_chequers(image: UInt8, rng: np.random.Generator, lookalike: Lookalike) -> None:
    """Draw a chequer board. Each inner corner looks like the patch ``checker``, but is next to other squares."""
    rows, columns = (int(v) for v in rng.integers(3, 8, 2))
    side = min(lookalike.radius, 18.0)
    A = _rotation(lookalike.angle_deg) * (side, side * max(lookalike.ratio, 0.5))
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) - (columns / 2, rows / 2)
    for i in range(rows):
        for j in range(columns):
            square = _to_sixteenths(matmul(corners + np.array([j, i]), A.T) + np.array([lookalike.x, lookalike.y]))
            level = (lookalike.ink, lookalike.second_ink)[(i + j) % 2]
            cv2.fillConvexPoly(image, square, _colour(image, level), cv2.LINE_8, 4)


def _draw_half_patch(image: UInt8, rng: np.random.Generator, lookalike: Lookalike, patch: Patch) -> None:
    """Draw the smaller part of a patch that was cut in two. The other part held the keypoint, and is not drawn."""
    black, disc = unit_polygons(patch, 2.0**-8)
    cut = float(rng.uniform(0.15, 0.4))  # distance from the centre to the cut, in radii
    spin = _rotation(float(rng.uniform(0, 360)))
    A = _rotation(lookalike.angle_deg) * (lookalike.radius, lookalike.radius * lookalike.ratio)
    light, dark = max(lookalike.ink, lookalike.second_ink), min(lookalike.ink, lookalike.second_ink)
    for polygons, level in ((disc, light), (black, dark)):
        # vertices of the other part move onto the cut: this part of the polygon then has no area
        parts = [np.maximum(matmul(polygon, spin.T), (cut, -np.inf)) for polygon in polygons]
        kept = [matmul(part, A.T) + np.array([lookalike.x, lookalike.y]) for part in parts]
        cv2.fillPoly(image, [_to_sixteenths(points) for points in kept], _colour(image, level), cv2.LINE_8, 4)


def _rotation(angle_deg: float) -> Float:
    """Return the matrix (2, 2) of a rotation from +x towards +y."""
    c, s = cos_sin_of(np.radians(angle_deg))
    return np.array([[c, -s], [s, c]])


DRAWERS: tuple[Callable[[UInt8, np.random.Generator, Lookalike], None], ...] = (
    _draw_disc,
    _draw_rings,
    _draw_half_disc,
    _draw_polygon,
    _draw_text,
    _draw_bar,
    _draw_chequers,
)
"""Functions that draw one look-alike each. :func:`draw_lookalikes` also draws half-patches, which need a design."""
