"""Tone curves: how a camera turns linear light into the 256 levels of a file, and back.

Linear light is a number from 0 (no light) to 1 (the light of level 255). The encoded value is a number from 0 to 1,
255 times of which is rounded to a level. Each curve is strictly monotone and leads from (0, 0) to (1, 1).

All functions give the same bits on every processor, see :mod:`kpbench.portable`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpbench.errors import DataError
from kpbench.portable import cos_sin, exp, log
from kpbench.types import Float, Float32, UInt8

TABLE_STEPS = 2**16 - 1
"""Steps of the table of :meth:`ToneCurve.encode`, over the square root of the light. Equal steps of the light itself
would be too coarse near black: under a gamma of 2.4, level 1 is 1.7e-6 of the light of level 255."""
SRGB_GAMMA, SRGB_OFFSET, SRGB_SLOPE = 2.4, 0.055, 12.92
SRGB_LINEAR_UNTIL, SRGB_ENCODED_UNTIL = 0.0031308, 0.04045
"""The five numbers of sRGB, IEC 61966-2-1:1999, clause 5.2."""
LARGEST_WARP = 0.6
"""Largest sum of the absolute weights of a drawn curve. The slope of the warp lies between 0.4 and 1.6."""
DRAWN_SLOPES, SLOPES_FROM_LIGHT = (0.25, 4.0), 0.05
"""Range of the slopes of a drawn curve, where the light is at least the last number."""

Function = Callable[..., Float]


def _power(x: Float, exponent: float) -> Float:
    """Return ``x ** exponent`` for x of at least 0; below 1e-30, return 0."""
    return np.where(x > 1e-30, exp(exponent * log(np.maximum(x, 1e-30))), 0.0)


def _linear(x: Float) -> Float:
    return x


def _srgb(x: Float) -> Float:
    """IEC 61966-2-1, equations for the nonlinear values."""
    curved = (1 + SRGB_OFFSET) * _power(x, 1 / SRGB_GAMMA) - SRGB_OFFSET
    return np.where(x <= SRGB_LINEAR_UNTIL, SRGB_SLOPE * x, curved)


def _srgb_inverse(y: Float) -> Float:
    curved = _power((y + SRGB_OFFSET) / (1 + SRGB_OFFSET), SRGB_GAMMA)
    return np.where(y <= SRGB_ENCODED_UNTIL, y / SRGB_SLOPE, curved)


def _gamma(x: Float, gamma: float) -> Float:
    return _power(x, 1 / gamma)


def _gamma_inverse(y: Float, gamma: float) -> Float:
    return _power(y, gamma)


def _logarithmic(x: Float, contrast: float) -> Float:
    """Compress as the μ-law of ITU-T G.711 does: log(1 + contrast x) / log(1 + contrast)."""
    return log(1 + contrast * x) / log(1 + contrast)


def _logarithmic_inverse(y: Float, contrast: float) -> Float:
    return (exp(y * log(1 + contrast)) - 1) / contrast


def _sigmoid(t: ArrayLike) -> Float:
    return 1 / (1 + exp(-np.asarray(t, np.float64)))


def _s_curve(x: Float, strength: float) -> Float:
    """Put the sRGB value through a logistic curve about 1/2, scaled to keep 0 and 1 (sigmoidal contrast)."""
    low, high = _sigmoid(-strength / 2), _sigmoid(strength / 2)
    return np.asarray((_sigmoid(strength * (_srgb(x) - 0.5)) - low) / (high - low))


def _s_curve_inverse(y: Float, strength: float) -> Float:
    low, high = _sigmoid(-strength / 2), _sigmoid(strength / 2)
    share = low + y * (high - low)
    return _srgb_inverse(np.clip(0.5 + log(share / (1 - share)) / strength, 0, 1))


def _warp(u: Float, weights: tuple[float, ...]) -> tuple[Float, Float]:
    """Return ``u + Σ wₖ sin(πku) / (πk)`` and the slope ``1 + Σ wₖ cos(πku)``, which is at least ``1 - Σ |wₖ|``."""
    c, s = cos_sin(np.pi * u)
    value, slope, cosine, sine = u, np.ones_like(u), c, s
    for k, weight in enumerate(weights, 1):
        value, slope = value + weight / (np.pi * k) * sine, slope + weight * cosine
        cosine, sine = cosine * c - sine * s, sine * c + cosine * s
    return value, slope


def _warped(x: Float, gamma: float, offset: float, *weights: float) -> Float:
    """Warp a power of the light; ``offset`` makes the slope at black finite, as in ITU-R BT.709."""
    low, high = (_power(np.array(v), 1 / gamma) for v in (offset, 1 + offset))
    return _warp((_power(x + offset, 1 / gamma) - low) / (high - low), weights)[0]


def _warped_inverse(y: Float, gamma: float, offset: float, *weights: float) -> Float:
    low, high = (_power(np.array(v), 1 / gamma) for v in (offset, 1 + offset))
    grid = np.arange(1025) / 1024
    u = _interpolate(y, _warp(grid, weights)[0], grid)
    for _ in range(3):  # Newton's steps, from 1e-4 at most to rounding
        value, slope = _warp(u, weights)
        u = np.clip(u - (value - y) / slope, 0, 1)
    return np.clip(_power(low + u * (high - low), gamma) - offset, 0, 1)


def _interpolate(x: Float, known: Float, values: Float) -> Float:
    """Interpolate linearly as ``np.interp`` does, in steps that no processor fuses."""
    nth = np.clip(np.searchsorted(known, x, side="right") - 1, 0, len(known) - 2)
    fraction = (x - known[nth]) / (known[nth + 1] - known[nth])
    return np.asarray(values[nth] + fraction * (values[nth + 1] - values[nth]))


_KINDS: dict[str, tuple[Function, Function, tuple[tuple[float, float], ...]]] = {
    "linear": (_linear, _linear, ()),
    "srgb": (_srgb, _srgb_inverse, ()),
    "gamma": (_gamma, _gamma_inverse, ((0.25, 4.0),)),
    "logarithmic": (_logarithmic, _logarithmic_inverse, ((0.01, 10_000.0),)),
    "s-curve": (_s_curve, _s_curve_inverse, ((0.01, 20.0),)),
    "warped": (_warped, _warped_inverse, ((0.25, 4.0), (0.0, 1.0), *[(-1.0, 1.0)] * 4)),
}
"""Per name: the curve, its inverse, and the range of each parameter."""


@dataclass(frozen=True)
class ToneCurve:
    """A strictly monotone curve from linear light to encoded values.

    The two fields are the record of the curve: ``ToneCurve(**dataclasses.asdict(curve))`` is the same curve.

    Attributes
    ----------
    name : {"linear", "srgb", "gamma", "logarithmic", "s-curve", "warped", "table"}
        "srgb" is IEC 61966-2-1. "gamma" is ``light ** (1 / gamma)``. "logarithmic" is
        ``log(1 + contrast * light) / log(1 + contrast)``. "s-curve" is sRGB, then a logistic curve of a strength.
        "warped" is what :func:`random_tone_curve` draws. "table" is linear between ``points``.
    parameters : tuple of float
        "gamma": gamma, 0.25 to 4. "logarithmic": contrast, 0.01 to 10000. "s-curve": strength, 0.01 to 20.
        "warped": gamma, offset, four weights. None for the other names.
    points : tuple of (float, float)
        "table": light and encoded value of each point, both strictly increasing from 0 to 1.

    Raises
    ------
    DataError
        If the name is unknown, a parameter is out of its range, or the points are not monotone.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import ToneCurve
    >>> srgb = ToneCurve("srgb")
    >>> srgb.encode(np.array([[0, 0.2140, 1]], np.float32))
    array([[  0, 127, 255]], dtype=uint8)
    >>> srgb.decode(np.array([[188]], np.uint8)).round(3)
    array([[0.503]], dtype=float32)
    >>> int(ToneCurve("table", points=[(0, 0), (0.2, 0.5), (1, 1)]).encode(np.float32([[0.1]]))[0, 0])
    64
    """

    name: str
    parameters: tuple[float, ...] = ()
    points: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", tuple(map(float, self.parameters)))
        object.__setattr__(self, "points", tuple((float(x), float(y)) for x, y in self.points))
        if self.name == "table":
            is_monotone = all(a[0] < b[0] and a[1] < b[1] for a, b in pairwise(self.points))
            if not is_monotone or self.points[:1] != ((0, 0),) or self.points[-1:] != ((1, 1),):
                raise DataError("the points of a tone curve must increase strictly from (0, 0) to (1, 1)")
        elif self.name not in _KINDS:
            raise DataError(f"unknown tone curve {self.name!r}, expected one of {', '.join(_KINDS)}, table")
        elif self.points:
            raise DataError(f"tone curve {self.name!r} has points, expected none")
        ranges = () if self.name == "table" else _KINDS[self.name][2]
        if len(ranges) != len(self.parameters):
            raise DataError(f"tone curve {self.name!r} has {len(self.parameters)} parameters, expected {len(ranges)}")
        for value, (low, high) in zip(self.parameters, ranges, strict=True):
            if not low <= value <= high:
                raise DataError(f"tone curve {self.name!r} has the parameter {value:g}, expected {low:g} to {high:g}")
        if self.name == "warped" and sum(map(abs, self.parameters[2:])) > 0.95:
            raise DataError("the absolute weights of a warped tone curve have a sum over 0.95")

    def value(self, light: ArrayLike) -> Float:
        """Return the encoded values (0 to 1) of linear light (0 to 1), without rounding to levels.

        Examples
        --------
        >>> from kpbench.camera import ToneCurve
        >>> float(ToneCurve("gamma", (2.0,)).value(0.25).round(6))
        0.5
        """
        x = np.asarray(light, np.float64)
        if self.name == "table":
            return _interpolate(x, *np.array(self.points).T)
        return np.asarray(_KINDS[self.name][0](x, *self.parameters))

    def light(self, value: ArrayLike) -> Float:
        """Return the linear light (0 to 1) of encoded values (0 to 1): the inverse of :meth:`value`."""
        y = np.asarray(value, np.float64)
        if self.name == "table":
            return _interpolate(y, *np.array(self.points).T[::-1])
        return np.asarray(_KINDS[self.name][1](y, *self.parameters))

    def encode(self, light: Float32) -> UInt8:
        """Return the levels of linear light, by a table of 65536 entries.

        Parameters
        ----------
        light : ndarray of shape (H, W) or (H, W, 3), float32
            Clipped to the range 0 to 1.

        Returns
        -------
        ndarray of the same shape, uint8
        """
        roots = np.clip(light, 0, 1, dtype=np.float32)
        np.sqrt(roots, out=roots)
        roots *= np.float32(TABLE_STEPS)
        roots += np.float32(0.5)
        return np.asarray(cv2.LUT(roots.astype(np.uint16), _levels_by_root(self)), np.uint8).reshape(light.shape)

    def decode(self, levels: UInt8) -> Float32:
        """Return the linear light of levels. ``encode(decode(levels))`` are the same levels.

        Parameters
        ----------
        levels : ndarray of shape (H, W) or (H, W, 3), uint8

        Returns
        -------
        ndarray of the same shape, float32
        """
        return np.asarray(cv2.LUT(levels, _light_by_level(self)), np.float32).reshape(levels.shape)


@lru_cache(maxsize=64)
def _light_by_level(curve: ToneCurve) -> Any:
    """Return the linear light of each level, ndarray of shape (256,), float32."""
    return curve.light(np.arange(256) / 255).astype(np.float32)


@lru_cache(maxsize=64)
def _levels_by_root(curve: ToneCurve) -> NDArray[Any]:
    """Return the level of each step of the square root of the light, ndarray of shape (65536,), uint8."""
    starts = np.sqrt(curve.light((np.arange(1, 256) - 0.5) / 255))  # where each level begins
    first = np.ceil(starts * TABLE_STEPS).astype(np.int64)
    return np.repeat(np.arange(256, dtype=np.uint8), np.diff(first, prepend=0, append=TABLE_STEPS + 1))


def random_tone_curve(rng: np.random.Generator) -> ToneCurve:
    """Draw a smooth monotone curve: a power of the light with a gamma from 1 to 2.6, warped by four sine waves.

    Where the light is at least 0.05, the slope of the curve lies between 0.25 and 4.

    Parameters
    ----------
    rng : numpy.random.Generator

    Returns
    -------
    ToneCurve
        Its name is "warped".

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.camera import random_tone_curve
    >>> curve = random_tone_curve(np.random.default_rng(0))
    >>> curve.name, len(curve.parameters)
    ('warped', 6)
    """
    grid = np.linspace(SLOPES_FROM_LIGHT, 1, 192)
    while True:
        gamma, offset = rng.uniform(1, 2.6), rng.uniform(0, 0.05)
        weights = rng.uniform(-1, 1, 4) / np.arange(1, 5)
        weights *= rng.uniform(0, LARGEST_WARP) / max(float(np.abs(weights).sum()), 1e-9)
        curve = ToneCurve("warped", tuple(round(float(v), 6) for v in (gamma, offset, *weights)))
        slopes = np.diff(curve.value(grid)) / np.diff(grid)
        if DRAWN_SLOPES[0] <= slopes.min() and slopes.max() <= DRAWN_SLOPES[1]:
            return curve
