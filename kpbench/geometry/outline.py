"""Outlines made of exact straight lines and circular arcs, in any planar frame.

A *contour* is a closed tuple of segments, each of which starts where the one before it ends. A
*region* is a tuple of contours; the area inside has winding number 1, holes run the other way round.
An outline never knows where it will be drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpbench.types import Float


@dataclass(frozen=True)
class Line:
    """A straight segment from (x0, y0) to (x1, y1)."""

    x0: float
    y0: float
    x1: float
    y1: float


@dataclass(frozen=True)
class Arc:
    """A circular arc about (x, y); ``sweep_deg`` is positive from +x towards +y, at most ±360."""

    x: float
    y: float
    radius: float
    start_deg: float
    sweep_deg: float

    def point(self, fraction: float) -> tuple[float, float]:
        """The point at a fraction of the sweep, 0 the start and 1 the end; exact at quarter turns."""
        c, s = cos_sin_deg(self.start_deg + fraction * self.sweep_deg)
        return self.x + self.radius * c, self.y + self.radius * s


Contour = tuple[Line | Arc, ...]
Region = tuple[Contour, ...]


def cos_sin_deg(angle_deg: float) -> tuple[float, float]:
    """Cosine and sine of an angle in degrees, exact at multiples of 90."""
    quarter, rest = divmod(angle_deg, 90.0)
    c, s = np.cos(np.radians(rest)), np.sin(np.radians(rest))
    turned = ((c, s), (-s, c), (-c, -s), (s, -c))[int(quarter) % 4]
    return float(turned[0]), float(turned[1])


def circle(x: float, y: float, radius: float) -> Region:
    """A full disc."""
    return ((Arc(x, y, radius, 0.0, 360.0),),)


def rectangle(x: float, y: float, width: float, height: float) -> Region:
    """An axis-parallel rectangle with its corner of least coordinates at (x, y)."""
    x1, y1 = x + width, y + height
    return ((Line(x, y, x1, y), Line(x1, y, x1, y1), Line(x1, y1, x, y1), Line(x, y1, x, y)),)


def move(region: Region, x: float, y: float, scale: float = 1.0, rotate_deg: float = 0.0) -> Region:
    """Scale about the origin, turn (from +x towards +y), then shift by (x, y)."""
    c, s = cos_sin_deg(rotate_deg)

    def at(px: float, py: float) -> tuple[float, float]:
        return x + scale * (c * px - s * py), y + scale * (s * px + c * py)

    def moved(part: Line | Arc) -> Line | Arc:
        if isinstance(part, Line):
            return Line(*at(part.x0, part.y0), *at(part.x1, part.y1))
        return Arc(*at(part.x, part.y), part.radius * scale, part.start_deg + rotate_deg, part.sweep_deg)

    return tuple(tuple(moved(part) for part in contour) for contour in region)


def flatten(region: Region, tolerance: float) -> list[Float]:
    """Approximate every contour by a closed polygon.

    Arcs become chords whose inner vertices lie so far outside the circle that the polygon's area is
    that of the arc: the remaining edge error is at most ``tolerance`` and has zero mean.

    Parameters
    ----------
    region : Region
    tolerance : float
        Largest distance between the arc and the polygon, in the region's own unit.

    Returns
    -------
    list of ndarray of shape (N, 2)
        One polygon a contour; the last vertex joins the first.
    """
    return [np.concatenate([_vertices(part, tolerance) for part in contour]) for contour in region]


def arc_vertices(radius: float, angles: ArrayLike, step: float) -> Float:
    """Return vertices of chords that enclose the same area as the arc.

    The vertices lie outside the circle by the factor ``sqrt(step / sin(step))``. The triangle between two
    neighbours and the centre then has the area of the sector, ``radius ** 2 * step / 2``.

    Parameters
    ----------
    radius : float
        Radius of the arc about the origin.
    angles : array_like of shape (N,)
        Directions of the vertices from +x towards +y, in radians, ``step`` apart.
    step : float
        Angle between two neighbours in radians, more than 0 and less than pi.

    Returns
    -------
    ndarray of shape (N, 2)
    """
    raised = float(radius * np.sqrt(step / np.sin(step)))
    return np.asarray(raised * np.column_stack([np.cos(angles), np.sin(angles)]))


def _vertices(part: Line | Arc, tolerance: float) -> Float:
    """Vertices of one segment without its end point, which is the next segment's start."""
    if isinstance(part, Line):
        return np.array([[part.x0, part.y0]])
    # sagitta of a chord over the angle 2h is r(1 - cos h) ~ r h²/2; the area balance halves it
    half = np.sqrt(4 * tolerance / part.radius) if tolerance < part.radius else np.pi / 4
    count = max(2, int(np.ceil(abs(np.radians(part.sweep_deg)) / (2 * half))))
    step = np.radians(part.sweep_deg) / count
    angles = np.radians(part.start_deg) + step * np.arange(count)
    points: Float = arc_vertices(part.radius, angles, abs(step)) + np.array([part.x, part.y])
    if abs(part.sweep_deg) < 360:
        points[0] = part.point(0.0)
    return points
