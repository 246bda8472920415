"""The shape of a printed sheet: ratio of its scales, skew, and bow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kpbench.types import Float

SHAPE_NAMES = ("ratio", "skew", "bow_xx", "bow_xy", "bow_yy")
"""Names of the parameters of :class:`PrintShape`."""


class BentPoints(NamedTuple):
    """Points of a sheet, and how they move."""

    xyz: Float
    """Points in mm of the board frame, of shape (n, 3)."""
    by_shape: Float
    """Derivatives by the five parameters of the shape, of shape (n, 3, 5)."""
    by_point: Float
    """Derivatives by the point on the flat sheet as designed, of shape (n, 3, 2)."""


@dataclass(frozen=True)
class PrintShape:
    """How a printed sheet differs from its design.

    A point (x, y) of the design lies at ``p = S (x, y)`` on the flat sheet, with ``S = [[1 + ratio / 2, skew / 2],
    [skew / 2, 1 - ratio / 2]]``. The sheet is bent with the curvatures ``Q = [[bow_xx, bow_xy], [bow_xy, bow_yy]]``::

        z = pᵀ Q p / 2,   (x, y) = p - Q p (pᵀ Q p) / 6

    The second equation keeps lengths along a cylinder, to the third order.

    Attributes
    ----------
    ratio : float
        Scale in x divided by the scale in y, minus 1.
    skew : float
        Change of the angle between the axes, rad.
    bow_xx, bow_xy, bow_yy : float
        Curvatures, 1/mm.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.calibration import PrintShape
    >>> PrintShape(bow_xx=0.001).bend(np.array([[60.0, 0.0]])).xyz.round(3).tolist()
    [[59.964, 0.0, 1.8]]
    """

    ratio: float = 0.0
    skew: float = 0.0
    bow_xx: float = 0.0
    bow_xy: float = 0.0
    bow_yy: float = 0.0

    @property
    def values(self) -> Float:
        """The five parameters, ndarray of shape (5,)."""
        return np.array([getattr(self, name) for name in SHAPE_NAMES])

    def bend(self, points_mm: Float) -> BentPoints:
        """Return the places of points of the design, shape (n, 2), mm, with their derivatives."""
        n = len(points_mm)
        x, y = points_mm.T
        S = np.array([[1 + self.ratio / 2, self.skew / 2], [self.skew / 2, 1 - self.ratio / 2]])
        Q = np.array([[self.bow_xx, self.bow_xy], [self.bow_xy, self.bow_yy]])
        p = points_mm @ S
        w = p @ Q
        e = (p * w).sum(axis=1)
        xyz = np.column_stack([p - w * e[:, None] / 6, e / 2])
        by_p = np.empty((n, 3, 2))
        by_p[:, :2] = np.eye(2) - (Q * e[:, None, None] + 2 * w[:, :, None] * w[:, None, :]) / 6
        by_p[:, 2] = w
        zero = np.zeros(n)
        p_by_stretch = np.stack([np.stack([x, y], axis=1), np.stack([-y, x], axis=1)], axis=1) / 2
        by_shape = np.empty((n, 3, 5))
        by_shape[:, :, :2] = by_p @ p_by_stretch
        px, py = p.T
        w_by_bow = np.stack([np.stack([px, py, zero], axis=1), np.stack([zero, px, py], axis=1)], axis=1)
        e_by_bow = np.stack([px * px, 2 * px * py, py * py], axis=1)
        by_shape[:, :2, 2:] = -(w_by_bow * e[:, None, None] + w[:, :, None] * e_by_bow[:, None]) / 6
        by_shape[:, 2, 2:] = e_by_bow / 2
        return BentPoints(xyz, by_shape, by_p @ S)
