"""Models of lens distortion: from ideal rays to the rays that the sensor sees, and back.

A point (X, Y, Z) of the camera frame has the ideal ray (x, y) = (X / Z, Y / Z). The lens moves the ray to (x', y'). The
camera's intrinsic matrix maps (x', y') to px. The two models are those of OpenCV's modules ``calib3d`` and ``fisheye``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kpbench.portable import arctan2, cos_sin
from kpbench.types import Float

LensModel = Literal["brown", "fisheye"]
"""Name of a model of lens distortion."""
BROWN_LENGTHS = (0, 4, 5, 8, 12)
"""How many coefficients the model of Brown may have."""
FISHEYE_LENGTHS = (4,)
"""How many coefficients the fisheye model may have."""
NEWTON_STEPS = 60
"""Largest number of Newton steps of :meth:`Lens.undistort`. Usually, six steps suffice."""
RAY_ERROR = 1e-12
"""Largest distance between a ray and the distorted image of its undistorted ray, times the ray's length if over 1."""


@dataclass(frozen=True)
class Lens:
    """A lens, described by a model and its coefficients.

    ``brown`` is the model of Brown ("Decentering distortion of lenses", *Photogrammetric Engineering* 32, 1966) in
    OpenCV's form, with ``r² = x² + y²``::

        c  = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
        x' = x c + 2 p1 x y + p2 (r² + 2 x²) + s1 r² + s2 r⁴
        y' = y c + 2 p2 x y + p1 (r² + 2 y²) + s3 r² + s4 r⁴

    ``fisheye`` is the model of Kannala and Brandt ("A generic camera model", *IEEE TPAMI* 28, 2006, eq. 6) in OpenCV's
    form. It is equidistant if all coefficients are 0. With ``θ = arctan r``::

        θ' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)
        x' = x θ' / r
        y' = y θ' / r

    Attributes
    ----------
    model : {"brown", "fisheye"}
    coefficients : tuple of float
        For ``brown`` 0, 4, 5, 8 or 12 numbers in OpenCV's order (k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4).
        Missing coefficients are 0. For ``fisheye`` (k1, k2, k3, k4).

    Raises
    ------
    ValueError
        If the model has another number of coefficients.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.geometry.lens import Lens
    >>> lens = Lens("brown", (-0.2, 0.0, 0.0, 0.0))
    >>> lens.distort(np.array([[0.5, 0.0]]))
    array([[0.475, 0.   ]])
    >>> lens.undistort(np.array([[0.475, 0.0]])).round(12)
    array([[0.5, 0. ]])
    """

    model: LensModel
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        lengths = FISHEYE_LENGTHS if self.model == "fisheye" else BROWN_LENGTHS
        if len(self.coefficients) not in lengths:
            expected = " or ".join(map(str, lengths))
            raise ValueError(f"lens {self.model!r} has {len(self.coefficients)} coefficients, expected {expected}")

    @cached_property
    def _all(self) -> tuple[float, ...]:
        """All coefficients of the model."""
        return (*self.coefficients, *(0.0,) * (12 - len(self.coefficients)))

    def distort(self, rays: ArrayLike) -> Float:
        """Return the rays (x', y') that the sensor sees, shape (N, 2), of ideal rays (x, y), shape (N, 2)."""
        x, y = np.asarray(rays, np.float64).T
        if self.model == "fisheye":
            factor = self._fisheye(x, y)[0]
            return np.array([x * factor, y * factor]).T
        _, _, p1, p2, _, _, _, _, s1, s2, s3, s4 = self._all
        r2 = x * x + y * y
        radial = self._radial(r2)
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        if any((s1, s2, s3, s4)):
            xd, yd = xd + r2 * (s1 + r2 * s2), yd + r2 * (s3 + r2 * s4)
        return np.array([xd, yd]).T

    def jacobian(self, rays: ArrayLike) -> Float:
        """Return the derivatives of (x', y') by (x, y) at rays of shape (N, 2); ndarray of shape (N, 2, 2)."""
        x, y = np.asarray(rays, np.float64).T
        if self.model == "fisheye":
            factor, along, cosine, sine = self._fisheye(x, y)
            xx, xy, yy = along * cosine * cosine, along * cosine * sine, along * sine * sine
            return np.stack([np.stack([factor + xx, xy], axis=-1), np.stack([xy, factor + yy], axis=-1)], axis=-2)
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self._all
        r2 = x * x + y * y
        radial = self._radial(r2)
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / dx is x * slope, d radial / dy is y * slope
        if any((k4, k5, k6)):
            below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
            slope = (slope - radial * (2 * (k4 + r2 * (2 * k5 + r2 * 3 * k6)))) / below
        across = x * y * slope + 2 * p1 * x + 2 * p2 * y
        xx, yy = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x, radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
        xy = yx = across
        if any((s1, s2, s3, s4)):
            prism_x, prism_y = 2 * s1 + 4 * s2 * r2, 2 * s3 + 4 * s4 * r2
            xx, xy, yx, yy = xx + x * prism_x, xy + y * prism_x, yx + x * prism_y, yy + y * prism_y
        return np.stack([np.stack([xx, xy], axis=-1), np.stack([yx, yy], axis=-1)], axis=-2)

    def undistort(self, rays: ArrayLike) -> Float:
        """Return the ideal rays (x, y), shape (N, 2), of rays (x', y') that the sensor sees, shape (N, 2).

        The method is Newton's, from the centre of the image outwards. :meth:`distort` maps the result back to the given
        rays, to ``RAY_ERROR``.

        Raises
        ------
        ValueError
            If a ray lies outside the valid region: no ideal ray up to :attr:`largest_radius` has this image, or the
            lens folds the image over at this ray.
        """
        seen = np.asarray(rays, np.float64).reshape(-1, 2)
        if self.model == "brown" and not any(self.coefficients):
            return seen.copy()
        found = self._from_angle(seen) if self.model == "fisheye" else self._newton(seen)
        error = np.abs(self.distort(found) - seen).max(axis=1) / np.maximum(1.0, np.abs(seen).max(axis=1))
        (a, b), (c, d) = self.jacobian(found).transpose(1, 2, 0)
        wrong = np.flatnonzero(~((error <= RAY_ERROR) & (a * d - b * c > 0)))
        if len(wrong):
            x, y = seen[wrong[0]].tolist()
            limit = f"{self.largest_radius:.3g}"
            raise ValueError(f"ray ({x:.6g}, {y:.6g}) is no image of an ideal ray up to the lens's radius {limit}")
        return found

    @cached_property
    def largest_radius(self) -> float:
        """Radius r of the valid region, without decentering and thin prism; inf if the region has no end.

        Up to this radius, rays farther from the axis have images farther from the axis.
        """
        if self.model == "fisheye":
            return float(np.tan(self._largest_angle)) if self._largest_angle < np.pi / 2 else np.inf
        k1, k2, _, _, k3, k4, k5, k6 = self._all[:8]
        # in s = r²: d(r a(s) / b(s)) / dr = ((a + 2 s a') b - 2 s a b') / b²
        above, below = np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])
        power = 2.0 * np.arange(4)
        slope = np.convolve(above * (1 + power), below) - np.convolve(above, below * power)
        return float(np.sqrt(min(_least_root(slope), _least_root(below))))

    @cached_property
    def _largest_angle(self) -> float:
        """Angle from the axis, in rad, up to which θ' of a fisheye lens grows, at most a right angle."""
        k1, k2, k3, k4 = self.coefficients
        return min(np.pi / 2, float(np.sqrt(_least_root([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))))

    def _radial(self, r2: Float) -> Float:
        k1, k2, _, _, k3, k4, k5, k6 = self._all[:8]
        above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return above / (1 + r2 * (k4 + r2 * (k5 + r2 * k6))) if any((k4, k5, k6)) else above

    def _fisheye(self, x: Float, y: Float) -> tuple[Float, Float, Float, Float]:
        """Return θ' / r, its derivative by r times r, and the direction (cosine, sine) of the ray."""
        r = np.sqrt(x * x + y * y)
        safe = np.where(r > 0, r, 1.0)
        bent, slope = self._bend(arctan2(r, np.ones_like(r)))
        factor = np.where(r > 0, bent / safe, 1.0)
        return factor, slope / (1 + r * r) - factor, x / safe, y / safe

    def _bend(self, angle: Float) -> tuple[Float, Float]:
        """Return θ' and its derivative by θ."""
        k1, k2, k3, k4 = self.coefficients
        a2 = angle * angle
        bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        return bent, 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))

    def _from_angle(self, seen: Float) -> Float:
        """Return the ideal rays behind a fisheye lens, which keeps directions from the axis."""
        bent = np.sqrt((seen * seen).sum(axis=1))
        angle = np.minimum(bent, self._largest_angle)
        for _ in range(NEWTON_STEPS):
            image, slope = self._bend(angle)
            step = (image - bent) / np.where(slope > 0, slope, 1.0)
            angle = np.where(np.abs(step) > 1e-16, np.clip(angle - step, 0.0, self._largest_angle), angle)
        cosine, sine = cos_sin(angle)
        scale = np.divide(sine, cosine * bent, out=np.ones_like(bent), where=(bent > 0) & (cosine > 0))
        return np.asarray(seen * scale[:, None])

    def _newton(self, seen: Float) -> Float:
        """Return the ideal rays behind Brown's lens; rays without a solution come out wrong."""
        limit = self.largest_radius
        found = _within(seen, limit)
        for _ in range(NEWTON_STEPS):
            error = self.distort(found) - seen
            (a, b), (c, d) = self.jacobian(found).transpose(1, 2, 0)
            determinant = a * d - b * c
            safe = np.where(np.abs(determinant) > 1e-9, determinant, 1.0)
            step = np.column_stack([d * error[:, 0] - b * error[:, 1], a * error[:, 1] - c * error[:, 0]])
            step /= safe[:, None]
            moves = np.abs(step).max(axis=1) > 1e-16 * (1 + np.abs(found).max(axis=1))
            if not moves.any():
                break
            found = np.where(moves[:, None], _within(found - step, limit), found)  # a ray depends on no other ray
        return found


def _within(rays: Float, limit: float) -> Float:
    """Return rays, those beyond a radius shortened to almost this radius."""
    r = np.sqrt((rays * rays).sum(axis=1))
    return np.asarray(rays * np.minimum(1.0, 0.999999 * limit / np.maximum(r, 1e-300))[:, None])


def _least_root(coefficients: ArrayLike) -> float:
    """Return the least positive real root of ``c₀ + c₁ s + c₂ s² + …``, to 9 digits; inf if there is none.

    LAPACK computes the roots, and their last digits depend on the processor.
    """
    falling = np.trim_zeros(np.asarray(coefficients, np.float64)[::-1], "f")
    roots = np.roots(falling)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(f"{real.min(initial=np.inf):.9g}")
