"""Elementary functions and matrix products that give the same bits on every processor.

NumPy, the C library and BLAS choose their code by the processor, and the last bit of their results differs. IEEE 754
fixes every bit of ``+ - * /``, of the square root and of rounding. The functions here use nothing else. They return
float64 and differ from the exact value by a few units in the last place.

:mod:`kpbench.geometry`, :mod:`kpbench.render` and :mod:`kpbench.degrade` compute the truth and the pixels of datasets
with these functions. The same configuration therefore gives the same files on different processors.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kpbench.types import Float

_SIN = [(-1) ** (n // 2) / math.factorial(n) for n in range(3, 19, 2)]
"""Taylor coefficients of (sin(x) - x) / x for x², x⁴, … At most pi/4, the first left-out term is below 1e-18."""
_COS = [(-1) ** (n // 2) / math.factorial(n) for n in range(2, 20, 2)]
"""Taylor coefficients of cos(x) - 1 for x², x⁴, …"""
_EXP = [1 / math.factorial(n) for n in range(1, 15)]
"""Taylor coefficients of (exp(x) - 1) for x, x², … At most ln(2)/2, the first left-out term is below 1e-19."""
_ARCTAN = [(-1) ** n / (2 * n + 1) for n in range(1, 19)]
"""Taylor coefficients of arctan(x) / x - 1 for x², x⁴, … At most tan(pi/16), the first left-out term is below 1e-27."""
_ARTANH = [1 / (2 * n + 1) for n in range(1, 12)]
"""Taylor coefficients of artanh(x) / x - 1 for x², x⁴, … At most 0.1716, the first left-out term is below 1e-18."""
# a constant as a sum: the first parts have so few bits that their products with small whole numbers are exact
_HALF_PI = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)
_LN2 = (0.6931471806019545, -4.2009150726810846e-11)
_SQRT_HALF = math.sqrt(0.5)


def _polynomial(coefficients: list[float], x: Any) -> Any:
    """Return ``c₀ x + c₁ x² + …`` by Horner's rule."""
    total = coefficients[-1] * x
    for coefficient in coefficients[-2::-1]:
        total = (total + coefficient) * x
    return total


def cos_sin(angle_rad: ArrayLike) -> tuple[Float, Float]:
    """Return the cosine and the sine of angles.

    Parameters
    ----------
    angle_rad : array_like
        Angles of at most 1e5 rad.

    Returns
    -------
    cosine, sine : ndarray of the same shape

    Examples
    --------
    >>> from kpbench.portable import cos_sin
    >>> [round(float(v), 3) for v in cos_sin(0.5)]
    [0.878, 0.479]
    """
    x = np.asarray(angle_rad, np.float64)
    quarter = np.rint(x * (2 / math.pi))
    rest = ((x - quarter * _HALF_PI[0]) - quarter * _HALF_PI[1]) - quarter * _HALF_PI[2]
    square = rest * rest
    sine, cosine = rest + rest * _polynomial(_SIN, square), 1 + _polynomial(_COS, square)
    nth = quarter.astype(np.int64) & 3
    swapped = (nth & 1) == 1
    c, s = np.where(swapped, sine, cosine), np.where(swapped, cosine, sine)
    return np.where((nth == 1) | (nth == 2), -c, c), np.where(nth >= 2, -s, s)


def cos_sin_of(angle_rad: float) -> tuple[float, float]:
    """Return the cosine and the sine of one angle: the bits of :func:`cos_sin`, in a tenth of the time.

    Examples
    --------
    >>> from kpbench.portable import cos_sin_of
    >>> cos_sin_of(0.0)
    (1.0, 0.0)
    """
    x = float(angle_rad)
    quarter = round(x * (2 / math.pi))
    rest = ((x - quarter * _HALF_PI[0]) - quarter * _HALF_PI[1]) - quarter * _HALF_PI[2]
    square = rest * rest
    s, c = rest + rest * _polynomial(_SIN, square), 1 + _polynomial(_COS, square)
    cosine, sine = ((c, s), (-s, c), (-c, -s), (s, -c))[quarter & 3]
    return cosine, sine


def exp(x: ArrayLike) -> Float:
    """Return e to the power of x, for x from -700 to 700.

    Examples
    --------
    >>> from kpbench.portable import exp
    >>> round(float(exp(1.0)), 6)
    2.718282
    """
    values = np.asarray(x, np.float64)
    power = np.rint(values * (1 / math.log(2)))
    rest = (values - power * _LN2[0]) - power * _LN2[1]
    return np.asarray(np.ldexp(1 + _polynomial(_EXP, rest), power.astype(np.int64)))


def log(x: ArrayLike) -> Float:
    """Return the natural logarithm of positive numbers.

    Examples
    --------
    >>> from kpbench.portable import log
    >>> round(float(log(10.0)), 6)
    2.302585
    """
    mantissa, power = np.frexp(np.asarray(x, np.float64))
    is_small = mantissa < _SQRT_HALF
    mantissa, power = np.where(is_small, 2 * mantissa, mantissa), power - is_small
    ratio = (mantissa - 1) / (mantissa + 1)
    return np.asarray(power * _LN2[0] + (power * _LN2[1] + 2 * (ratio + ratio * _polynomial(_ARTANH, ratio * ratio))))


def arctan2(y: ArrayLike, x: ArrayLike) -> Float:
    """Return the angle of the point (x, y) in radians, from -pi to pi; 0 for the origin.

    Examples
    --------
    >>> from kpbench.portable import arctan2
    >>> round(float(arctan2(1.0, -1.0)), 6)
    2.356194
    """
    y, x = np.asarray(y, np.float64), np.asarray(x, np.float64)
    run, rise = np.abs(x), np.abs(y)
    is_steep = rise > run
    run, rise = np.where(is_steep, rise, run), np.where(is_steep, run, rise)
    ratio = np.divide(rise, run, out=np.zeros(np.broadcast(rise, run).shape), where=run > 0)
    for _ in range(2):  # halves the angle, from at most pi/4 to at most pi/16, where the series is short
        ratio = ratio / (1 + np.sqrt(1 + ratio * ratio))
    angle = 4 * (ratio + ratio * _polynomial(_ARCTAN, ratio * ratio))
    angle = np.where(is_steep, math.pi / 2 - angle, angle)
    angle = np.where(x < 0, math.pi - angle, angle)
    return np.asarray(np.where(y < 0, -angle, angle))


def matmul(A: Float, B: Float) -> Float:
    """Return the matrix product ``A @ B`` of two matrices or stacks of matrices.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.portable import matmul
    >>> matmul(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[1.0], [10.0]])).tolist()
    [[21.0], [43.0]]
    """
    total = A[..., :, :1] * B[..., :1, :]
    for k in range(1, A.shape[-1]):
        total = total + A[..., :, k : k + 1] * B[..., k : k + 1, :]
    return np.asarray(total)


@lru_cache(maxsize=1)
def normal_quantiles() -> Float:
    """Return 2¹⁶ equally likely values of the standard normal distribution, in ascending order, from -4.3 to 4.3.

    Examples
    --------
    >>> from kpbench.portable import normal_quantiles
    >>> values = normal_quantiles()
    >>> len(values), round(float(values.std()), 6)
    (65536, 1.0)
    """
    from scipy.special import ndtri

    values = ndtri((np.arange(2**16) + 0.5) / 2**16)
    return np.asarray(np.round(values / values.std(), 6))  # rounded to remove what depends on the processor
