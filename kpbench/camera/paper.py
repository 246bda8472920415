"""The printed sheet: its bow, and the gain of its ink.

A sheet that is not flat maps a point (x, y) of the flat board, mm, to a point (x, y, z) of the board frame, mm. Ink
that spreads moves every edge of the ink outwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from kpbench.geometry.outline import Region, cos_sin_deg
from kpbench.geometry.spread import spread
from kpbench.portable import cos_sin, cos_sin_of
from kpbench.types import Float

LARGEST_TURN = math.pi / 2
"""Largest angle, in rad, by which half of a sheet may be rolled, see :meth:`Cylinder.of_sagitta`."""


@dataclass(frozen=True)
class Cylinder:
    """A sheet that is rolled onto a cylinder. The map is developable: it keeps all lengths within the sheet.

    The axis of the cylinder is parallel to the direction ``e = (cos axis_deg, sin axis_deg)`` of the board. With
    ``a = x ex + y ey`` along the axis, ``s = y ex - x ey`` across the axis and the radius R, a point is mapped to::

        a' = a,   s' = R sin(s / R),   z = R (1 - cos(s / R))

    The board's centre stays where it is.

    Attributes
    ----------
    radius_mm : float
        Radius R. If R is positive, the edges of the sheet bend away from the viewer. If R is negative, the edges bend
        towards the viewer.
    axis_deg : float
        Direction of the axis from +x towards +y.

    Examples
    --------
    >>> from kpbench.camera.paper import Cylinder
    >>> Cylinder(radius_mm=100.0, axis_deg=90.0).bend([[0.0, 0.0], [10.0, 3.0]]).round(3) + 0.0
    array([[0.   , 0.   , 0.   ],
           [9.983, 3.   , 0.5  ]])
    """

    radius_mm: float
    axis_deg: float = 0.0

    @classmethod
    def of_sagitta(cls, sagitta_mm: float, width_mm: float, axis_deg: float = 0.0) -> Cylinder:
        """Make a cylinder from the sagitta: the depth of a sheet's edges behind its middle.

        Parameters
        ----------
        sagitta_mm : float
            Negative if the edges bend towards the viewer; not 0.
        width_mm : float
            Width of the flat sheet across the axis.
        axis_deg : float

        Raises
        ------
        ValueError
            If the sagitta is 0, or more than a sheet has that is rolled onto half of a cylinder.

        Examples
        --------
        >>> from kpbench.camera.paper import Cylinder
        >>> round(Cylinder.of_sagitta(sagitta_mm=5.0, width_mm=200.0).radius_mm, 2)
        999.17
        """
        ratio = abs(sagitta_mm) / (width_mm / 2)
        if not 0 < ratio <= 1 / LARGEST_TURN:
            most = width_mm / 2 / LARGEST_TURN
            raise ValueError(f"sagitta is {sagitta_mm:g} mm, expected up to {most:g} mm of this width, and not 0")
        low, high = 0.0, LARGEST_TURN
        for _ in range(60):  # (1 - cos h) / h grows with the turn h of half of the sheet
            half = (low + high) / 2
            sine = cos_sin_of(half / 2)[1]
            low, high = (half, high) if 2 * sine * sine < ratio * half else (low, half)
        return cls(math.copysign(width_mm / 2 / high, sagitta_mm), axis_deg)

    def bend(self, points_mm: ArrayLike) -> Float:
        """Return the points (x, y, z), shape (N, 3), of points (x, y) of the flat sheet, shape (N, 2), mm."""
        x, y = np.asarray(points_mm, np.float64).T
        ex, ey = cos_sin_deg(self.axis_deg)
        along, across = x * ex + y * ey, y * ex - x * ey
        half_sine = cos_sin(across * (0.5 / self.radius_mm))[1]
        across = self.radius_mm * cos_sin(across * (1 / self.radius_mm))[1]
        z = 2 * self.radius_mm * half_sine * half_sine
        return np.column_stack([along * ex - across * ey, along * ey + across * ex, z])


@dataclass(frozen=True)
class Saddle:
    """A sheet that is bent to a saddle: ``z = c x' y'``, with axes x' and y' that are turned by ``axis_deg``.

    The surface is the hyperbolic paraboloid. It is not developable: its Gaussian curvature at the centre is ``-c²``.
    Real paper stretches little, so real saddles are shallow. x and y stay the same. Lengths along x' grow by the factor
    ``sqrt(1 + c² y'²)``, lengths along y' by ``sqrt(1 + c² x'²)``.

    Attributes
    ----------
    c_per_mm : float
        Twist c, 1/mm. A corner at (x', y') lies ``c x' y'`` behind the board's plane.
    axis_deg : float
        Direction of the axis x' from +x towards +y.

    Examples
    --------
    >>> from kpbench.camera.paper import Saddle
    >>> Saddle(c_per_mm=0.001).bend([[50.0, 40.0], [50.0, -40.0]])
    array([[ 50.,  40.,   2.],
           [ 50., -40.,  -2.]])
    """

    c_per_mm: float
    axis_deg: float = 0.0

    def bend(self, points_mm: ArrayLike) -> Float:
        """Return the points (x, y, z), shape (N, 3), of points (x, y) of the flat sheet, shape (N, 2), mm."""
        x, y = np.asarray(points_mm, np.float64).T
        ex, ey = cos_sin_deg(self.axis_deg)
        return np.column_stack([x, y, self.c_per_mm * (x * ex + y * ey) * (y * ex - x * ey)])


Bow = Cylinder | Saddle
"""The bow of a sheet of paper."""


@lru_cache(maxsize=256)
def spread_ink(ink: Region, gain: float, within: float = math.inf) -> Region:
    """Return the outline of ink whose edges all move outwards by a distance, as black ink on paper does.

    The result is exact: the Minkowski sum of the ink and a disc of radius ``gain`` (the parallel body; Serra, *Image
    Analysis and Mathematical Morphology*, 1982, chapter V). It consists of straight lines and arcs.

    * Lines and arcs of the ink move by ``gain`` along their outward normals.
    * A convex corner of the ink becomes an arc of radius ``gain`` about the corner.
    * At a reflex corner, the two moved edges meet in a corner.
    * Black sectors whose apexes meet at the centre join. A white sector of the angle α keeps its sides' directions. Its
      apex moves from the centre along its bisector, by ``gain / sin(α / 2)``. Around the centre, all is black up to the
      distance ``gain``.

    Parameters
    ----------
    ink : Region
        Such as :attr:`kpbench.patches.Patch.black_region`.
    gain : float
        In the unit of the region. If negative, the ink recedes: the white paper is spread instead.
    within : float
        Radius of a disc about the origin to which the result is cut, such as the rim of a patch that is cut out.

    Returns
    -------
    Region
        Each part of the outline occurs once, and parts do not overlap.

    Examples
    --------
    >>> from kpbench.camera.paper import spread_ink
    >>> from kpbench.geometry import circle, flatten, rectangle
    >>> spread_ink(circle(0.0, 0.0, 2.0), 0.5)
    ((Arc(x=0.0, y=0.0, radius=2.5, start_deg=0.0, sweep_deg=360.0),),)
    >>> len(spread_ink(rectangle(0, 0, 2, 1), 0.1)[0])
    8
    """
    return spread(ink, gain, within)
