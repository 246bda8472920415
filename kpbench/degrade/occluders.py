"""Hands and cables before the board: opaque limbs, each the hull of two discs.

A limb is a list of seven floats: x and y of both ends, radius at both ends (px), grey level. Places and sizes are told
in widths of the board, which is 12.5 radii of a patch on the boards of the suites.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from kpbench.degrade.effects import Effect, paint_polygons
from kpbench.portable import arctan2, cos_sin
from kpbench.types import Float, UInt8

BOARD_RADII = 12.5
"""Width of a board of :func:`kpbench.patches.hexagon_board`, in radii of its patches."""
FINGER_DEPTHS = (-0.08, 0.0, -0.04, -0.14)
"""How far each finger of a hand reaches, relative to the longest finger, in widths of the board."""
FINGER_LENGTH, FINGER_GAP, FINGER_RADIUS = 0.42, 0.115, 0.05
"""Length and spacing of the fingers and radius of their knuckles, in widths of a board of 187.5 mm: a large hand."""
CABLE_PIECES = 8
"""Straight limbs of a cable."""
CABLE_RADIUS = (0.01, 0.025)
"""Smallest and largest radius of a cable, in widths of the board."""
HIGHLIGHT = 0.5, 22.0
"""Radius of the lit middle of a limb, as a fraction of the limb's radius, and how much brighter it is, grey levels."""
ARC_STEPS = 12
"""Chords of each end of a limb."""


def limbs(image: UInt8, limbs: list[list[float]]) -> UInt8:
    """Lay opaque limbs over the image, in order.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    limbs : list of lists of seven floats
        x and y of one end, x and y of the other end, radius at the one end and at the other (px), grey level.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import limbs
    >>> limbs(np.full((1, 7), 90, np.uint8), [[2, 0, 4, 0, 1.5, 1.5, 20]])[0, [0, 3]].tolist()
    [90, 20]
    """
    return paint_polygons(image, limb_outlines(limbs), [limb[6] for limb in limbs])


def limb_outlines(limbs: list[list[float]]) -> list[Float]:
    """Return the outline of each limb, ndarray of shape (n, 2), px: two arcs and their common tangents."""
    outlines = []
    for x1, y1, x2, y2, r1, r2, _ in limbs:
        dx, dy = x2 - x1, y2 - y1
        length = max(float(np.hypot(dx, dy)), abs(r1 - r2) + 1e-6)
        axis, slope = float(arctan2(dy, dx)), (r1 - r2) / length
        tangent = float(arctan2(np.sqrt(1 - slope * slope), slope))  # from the axis to the points of contact
        near = axis + tangent + (2 * np.pi - 2 * tangent) * np.linspace(0, 1, ARC_STEPS + 1)
        far = axis + tangent * np.linspace(-1, 1, ARC_STEPS + 1)
        (c1, s1), (c2, s2) = cos_sin(near), cos_sin(far)
        first = np.column_stack([x1 + r1 * c1, y1 + r1 * s1])
        outlines.append(np.concatenate([np.column_stack([x2 + r2 * c2, y2 + r2 * s2]), first]))
    return outlines


def _board_circle(discs: Float) -> tuple[Float, float]:
    """Return the middle of the board that carries the discs, (x, y), and its width, px."""
    return np.asarray(discs[:, :2].mean(axis=0)), float(BOARD_RADII * discs[:, 2].mean())


def _limb(start: Float, end: Float, radii: tuple[float, float], grey: float) -> list[list[float]]:
    """Return a limb and its lit middle."""
    thin, brighter = HIGHLIGHT
    place = [*start.tolist(), *end.tolist()]
    both = ([*place, *radii, grey], [*place, thin * radii[0], thin * radii[1], min(grey + brighter, 255.0)])
    return [[round(float(v), 2) for v in limb] for limb in both]


def draw_hand(rng: np.random.Generator, level: float, size_px: tuple[int, int], discs: Float) -> Effect:
    """Draw a hand from a random side, whose longest finger reaches ``level`` percent of the width over the board."""
    middle, width = _board_circle(discs)
    c, s = map(float, cos_sin(rng.uniform(0, 2 * np.pi)))
    inwards, sideways = np.array([c, s]), np.array([-s, c])
    shift, grey = rng.uniform(-0.25, 0.25), float(rng.integers(70, 200))
    bends, lengths = rng.uniform(-0.06, 0.06, 4), rng.uniform(0.95, 1.05, 4)
    parts = []
    knuckle_depth = level / 100 - 0.5 - FINGER_LENGTH
    for n, (depth, bend, stretch) in enumerate(zip(FINGER_DEPTHS, bends, lengths, strict=True)):
        side = shift + (n - 1.5) * FINGER_GAP
        knuckle = middle + width * (knuckle_depth * inwards + side * sideways)
        tip = middle + width * ((level / 100 - 0.5 + depth - FINGER_RADIUS) * inwards + (side + bend) * sideways)
        joint = (knuckle + tip) / 2 + width * 0.02 * stretch * sideways
        r = width * FINGER_RADIUS * np.array([1.05, 0.95, 0.8])
        parts += _limb(knuckle, joint, (r[0], r[1]), grey) + _limb(joint, tip, (r[1], r[2]), grey)
    wrist, palm = (middle + width * ((knuckle_depth - d) * inwards + shift * sideways) for d in (0.9, 0.2))
    parts += _limb(wrist, palm, (0.2 * width, 0.26 * width), grey)
    return {"effect": "limbs", "limbs": parts}


def draw_cable(rng: np.random.Generator, level: float, size_px: tuple[int, int], discs: Float) -> Effect:
    """Draw ``level`` cables, each a bent line across the board near its middle. More cables keep the first ones."""
    middle, width = _board_circle(discs)
    parts = []
    for _ in range(round(level)):
        c, s = map(float, cos_sin(rng.uniform(0, 2 * np.pi)))
        along, across = width * np.array([c, s]), width * np.array([-s, c])
        ends, bend = rng.uniform(-0.45, 0.45, 2), rng.uniform(-0.5, 0.5)
        radius, grey = width * float(rng.uniform(*CABLE_RADIUS)), float(rng.integers(5, 230))
        t = np.linspace(0, 1, CABLE_PIECES + 1)[:, None]
        start, control, end = -along + ends[0] * across, bend * across, along + ends[1] * across
        points = middle + (1 - t) ** 2 * start + 2 * t * (1 - t) * control + t**2 * end
        for a, b in pairwise(points):
            parts += _limb(a, b, (radius, radius), grey)
    return {"effect": "limbs", "limbs": parts}
