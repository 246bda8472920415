"""What may be taken for a patch and is none: discs, rings, half-discs, half-patches, chequers, polygons, text, bars.

They carry no label; a detector has to leave them alone. Drawn by OpenCV, without regard for exact edges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from kpbench.patches.design import Patch, unit_polygons
from kpbench.types import Float, UInt8


@dataclass(frozen=True)
class Look:
    """Place, size and inks of one look-alike: px, degrees, grey levels; ``ratio`` is short by long axis."""

    x: float
    y: float
    radius: float
    ratio: float
    angle_deg: float
    ink: float
    other: float


def draw_lookalikes(
    image: UInt8,
    rng: np.random.Generator,
    count: int,
    patches: Sequence[Patch],
    radius_px: tuple[float, float] = (4.0, 40.0),
) -> None:
    """Draw ``count`` look-alikes into an image, in place.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    rng
    count : how many.
    patches : the designs of which halves are drawn.
    radius_px : range of their radii, drawn log-uniformly.
    """
    height, width = image.shape[:2]
    for _ in range(count):
        dark, light = float(rng.uniform(0, 120)), float(rng.uniform(150, 255))
        ink, other = (dark, light) if rng.random() < 0.5 else (light, dark)
        x, y = rng.uniform(0, 1, 2) * (width, height)
        radius = float(np.exp(rng.uniform(*np.log(radius_px))))
        look = Look(float(x), float(y), radius, float(rng.uniform(0.4, 1)), float(rng.uniform(0, 360)), ink, other)
        kind = int(rng.integers(len(KINDS) + 1))
        if kind < len(KINDS):
            KINDS[kind](image, rng, look)
        else:
            _half_patch(image, rng, look, patches[int(rng.integers(len(patches)))])


def _grey(image: UInt8, level: float) -> tuple[float, ...]:
    return (level,) * (1 if image.ndim == 2 else 3)


def _fixed(points: Float) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    """Px to OpenCV's 1/16 px."""
    return np.rint(points * 16).astype(np.int32)


def _ellipse(image: UInt8, look: Look, part: float, level: float, end_deg: float = 360) -> None:
    centre = (round(look.x * 16), round(look.y * 16))
    axes = (round(look.radius * part * 16), round(look.radius * look.ratio * part * 16))
    cv2.ellipse(image, centre, axes, look.angle_deg, 0, end_deg, _grey(image, level), -1, cv2.LINE_AA, 4)


def _disc(image: UInt8, rng: np.random.Generator, look: Look) -> None:
    _ellipse(image, look, 1, look.ink)


def _rings(image: UInt8, rng: np.random.Generator, look: Look) -> None:
    for n, part in enumerate(np.linspace(1, 0, int(rng.integers(2, 5)), endpoint=False)):
        _ellipse(image, look, float(part), (look.ink, look.other)[n % 2])


def _one_edge(image: UInt8, rng: np.random.Generator, look: Look) -> None:
    """A disc, half black, half white."""
    _ellipse(image, look, 1, look.other)
    _ellipse(image, look, 1, look.ink, 180)


def _polygon(image: UInt8, rng: np.random.Generator, look: Look) -> None:
    """Triangle or quadrangle."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 5))))
    corners = np.column_stack([look.x + look.radius * np.cos(angles), look.y + look.radius * np.sin(angles)])
    cv2.fillPoly(image, [_fixed(corners)], _grey(image, look.ink), cv2.LINE_AA, 4)


def _text(image: UInt8, rng: np.random.Generator, look: Look) -> None:
    text = "".join(chr(c) for c in rng.integers(48, 91, int(rng.integers(1, 5))))
    place = (round(look.x - look.radius), round(look.y + look.radius / 2))
    font, thick = int(rng.integers(8)), int(rng.integers(1, 4))
    cv2.putText(image, text, place, font, look.radius / 20, _grey(image, look.ink), thick, cv2.LINE_AA)


def _bar(image: UInt8, rng: np.random.Generator, look: Look) -> None:
    """A bar or a line, six radii long."""
    along = 3 * look.radius * np.array([np.cos(np.radians(look.angle_deg)), np.sin(np.radians(look.angle_deg))])
    start, end = ((round(look.x + k * along[0]), round(look.y + k * along[1])) for k in (-1, 1))
    cv2.line(image, start, end, _grey(image, look.ink), int(rng.integers(1, 8)), cv2.LINE_AA)


def _chequers(image: UInt8, rng: np.random.Generator, look: Look) -> None:
    """A chequer board: its corners look like patches, but have neighbours."""
    rows, columns = (int(v) for v in rng.integers(3, 8, 2))
    side = min(look.radius, 18.0)
    A = _turn(look.angle_deg) @ np.diag([side, side * max(look.ratio, 0.5)])
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) - (columns / 2, rows / 2)
    for i in range(rows):
        for j in range(columns):
            square = (corners + np.array([j, i])) @ A.T + (look.x, look.y)
            cv2.fillConvexPoly(image, _fixed(square), _grey(image, (look.ink, look.other)[(i + j) % 2]), cv2.LINE_8, 4)


def _half_patch(image: UInt8, rng: np.random.Generator, look: Look, patch: Patch) -> None:
    """One side of a patch, cut off beside its centre: the keypoint itself is not there."""
    black, disc = unit_polygons(patch, 2.0**-8)
    cut = float(rng.uniform(0.15, 0.4))
    spin, A = _turn(float(rng.uniform(0, 360))), _turn(look.angle_deg) @ np.diag([1, look.ratio]) * look.radius
    for polygons, level in ((disc, max(look.ink, look.other)), (black, min(look.ink, look.other))):
        # clamping to the kept side lays what is cut off onto the line of the cut, where it has no area
        kept = [np.maximum(polygon @ spin.T, (cut, -np.inf)) @ A.T + (look.x, look.y) for polygon in polygons]
        cv2.fillPoly(image, [_fixed(points) for points in kept], _grey(image, level), cv2.LINE_8, 4)


def _turn(angle_deg: float) -> Float:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, -s], [s, c]])


KINDS: tuple[Callable[[UInt8, np.random.Generator, Look], None], ...] = (
    _disc,
    _rings,
    _one_edge,
    _polygon,
    _text,
    _bar,
    _chequers,
)
