"""Outlines of exact straight lines and circular arcs, in any planar frame.

* A *segment* is a :class:`Line` or an :class:`Arc`.
* A *contour* is a closed tuple of segments. Each segment starts where the previous segment ends.
* A *region* is a tuple of contours. Points of the region have winding number 1. The contours of holes therefore run in
  the direction opposite to the outer contours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kpbench.portable import cos_sin, cos_sin_of
from kpbench.types import Float


@dataclass(frozen=True)
class Line:
    """A straight segment from (x0, y0) to (x1, y1).

    Examples
    --------
    >>> from kpbench.geometry import Line, flatten
    >>> triangle = ((Line(0, 0, 4, 0), Line(4, 0, 0, 3), Line(0, 3, 0, 0)),)
    >>> flatten(triangle, tolerance=0.1)[0].tolist()
    [[0, 0], [4, 0], [0, 3]]
    """

    x0: float
    y0: float
    x1: float
    y1: float


@dataclass(frozen=True)
class Arc:
    """A circular arc about (x, y).

    Attributes
    ----------
    x, y : float
        Centre of the circle.
    radius : float
    start_deg : float
        Direction of the first point, from +x towards +y.
    sweep_deg : float
        Angle that the arc covers, from -360 to 360, positive from +x towards +y.

    Examples
    --------
    >>> from kpbench.geometry import Arc
    >>> Arc(x=0.0, y=0.0, radius=2.0, start_deg=0.0, sweep_deg=90.0).point(1.0)
    (0.0, 2.0)
    """

    x: float
    y: float
    radius: float
    start_deg: float
    sweep_deg: float

    def point(self, fraction: float) -> tuple[float, float]:
        """Return the point at a fraction of the sweep, from 0 to 1. Points at multiples of 90 degrees are exact."""
        c, s = cos_sin_deg(self.start_deg + fraction * self.sweep_deg)
        return self.x + self.radius * c, self.y + self.radius * s


Contour = tuple[Line | Arc, ...]
Region = tuple[Contour, ...]


def cos_sin_deg(angle_deg: float) -> tuple[float, float]:
    """Return the cosine and sine of an angle. Both are exact at multiples of 90 degrees."""
    quarter, rest = divmod(angle_deg, 90.0)
    c, s = cos_sin_of(math.radians(rest))
    cosine, sine = ((c, s), (-s, c), (-c, -s), (s, -c))[int(quarter) % 4]
    return cosine, sine


def circle(x: float, y: float, radius: float) -> Region:
    """Return a full disc as a region.

    Parameters
    ----------
    x, y : float
        Centre.
    radius : float

    Examples
    --------
    >>> from kpbench.geometry import circle
    >>> circle(1.0, 2.0, 3.0)
    ((Arc(x=1.0, y=2.0, radius=3.0, start_deg=0.0, sweep_deg=360.0),),)
    """
    return ((Arc(x, y, radius, 0.0, 360.0),),)


def rectangle(x: float, y: float, width: float, height: float) -> Region:
    """Return an axis-parallel rectangle as a region.

    Parameters
    ----------
    x, y : float
        Corner with the least coordinates.
    width, height : float

    Examples
    --------
    >>> from kpbench.geometry import flatten, rectangle
    >>> flatten(rectangle(0, 0, 4, 3), tolerance=0.1)[0].tolist()
    [[0, 0], [4, 0], [4, 3], [0, 3]]
    """
    x1, y1 = x + width, y + height
    return ((Line(x, y, x1, y), Line(x1, y, x1, y1), Line(x1, y1, x, y1), Line(x, y1, x, y)),)


def move(region: Region, x: float, y: float, scale: float = 1.0, rotate_deg: float = 0.0) -> Region:
    """Return a region that is scaled about the origin, then rotated about the origin, then shifted.

    Parameters
    ----------
    region : tuple of contours
    x, y : float
        Shift.
    scale : float
    rotate_deg : float
        Rotation from +x towards +y.

    Examples
    --------
    >>> from kpbench.geometry import circle, move
    >>> move(circle(0.0, 0.0, 1.0), x=10.0, y=20.0, scale=3.0)
    ((Arc(x=10.0, y=20.0, radius=3.0, start_deg=0.0, sweep_deg=360.0),),)
    """
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

    Each arc becomes chords. The chords of a full circle enclose the area of the circle, see :func:`arc_vertices`. An
    open arc has the same chords, but keeps its exact end points. The distance between the chords and the arc is at most
    about 4/3 of ``tolerance``.

    Parameters
    ----------
    region : tuple of contours
    tolerance : float
        In the unit of the region. Arcs and chords differ by at most about 4/3 of this distance.

    Returns
    -------
    list of ndarray of shape (N, 2)
        One polygon per contour. An edge joins the last vertex to the first vertex.

    Examples
    --------
    >>> from kpbench.geometry import circle, flatten
    >>> (polygon,) = flatten(circle(0.0, 0.0, 10.0), tolerance=0.01)
    >>> polygon.shape
    (50, 2)
    """
    return [np.concatenate([_vertices(part, tolerance) for part in contour]) for contour in region]


def arc_vertices(radius: float, angles: ArrayLike, step: float) -> Float:
    """Return the vertices of chords that enclose the same area as an arc.

    The distance of the vertices from the centre is ``radius * sqrt(step / sin(step))``. The triangle of two neighbours
    and the centre then has the area of the sector, ``radius ** 2 * step / 2``.

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
    raised = radius * math.sqrt(step / cos_sin_of(step)[1])
    return np.asarray(raised * np.column_stack(cos_sin(angles)))


def _vertices(part: Line | Arc, tolerance: float) -> Float:
    """Return the vertices of one segment without its last point, which is the first point of the next segment."""
    if isinstance(part, Line):
        return np.array([[part.x0, part.y0]])
    # chords over an angle 2h deviate most from the arc at the vertices, which lie about r h² / 3 outside the arc
    half = np.sqrt(4 * tolerance / part.radius) if tolerance < part.radius else np.pi / 4
    count = max(2, int(np.ceil(abs(np.radians(part.sweep_deg)) / (2 * half))))
    step = np.radians(part.sweep_deg) / count
    angles = np.radians(part.start_deg) + step * np.arange(count)
    points: Float = arc_vertices(part.radius, angles, abs(step)) + np.array([part.x, part.y])
    if abs(part.sweep_deg) < 360:
        points[0] = part.point(0.0)
    return points
