"""95 % intervals from a bootstrap over scenes.

Images of one scene are not independent, so whole scenes are drawn with replacement.

Plain percentile intervals from few scenes are too narrow and off centre. Three corrections change the percentiles. The
factor C/(C - 1) corrects the variance of C scenes, and Student's t replaces the normal distribution [1]_. The method
BC_a shifts the percentiles for bias and skewness [2]_. ``benchmarks/accuracy/coverage.py`` measures how often the
intervals contain the true value.

References
----------
.. [1] T. C. Hesterberg, "What teachers should know about the bootstrap", The American Statistician 69(4), 2015,
   section on expanded percentiles. https://doi.org/10.1080/00031305.2015.1089789
.. [2] B. Efron, "Better bootstrap confidence intervals", Journal of the American Statistical Association 82(397), 1987.
   https://doi.org/10.1080/01621459.1987.10478410
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri, stdtrit

from kpbench.types import Float, Int

TAIL = 0.025
"""Nominal probability that the true value lies below a 95 % interval, and that it lies above the interval."""
Interval = tuple[float, float]
"""Lower and upper bound."""
MOST_KINDS = 1000
"""Largest number of kinds. A kind is a group of scenes of equal counts. Random pools of scenes replace more kinds."""


def sum_by_scene(sums: NDArray[Any], scene: Int) -> NDArray[Any]:
    """Add up the counts of the images of each scene.

    Parameters
    ----------
    sums : ndarray of shape (N, M)
        Counts per image.
    scene : ndarray of shape (N,), int64
        Scene ID of each image.

    Returns
    -------
    ndarray of shape (C, M)
        Counts per scene, in the order of the scene IDs. If no two images share a scene, in the order of the images.
    """
    order = np.argsort(scene, kind="stable")
    starts = np.flatnonzero(np.append(True, np.diff(scene[order]) != 0)[: len(order)])
    return sums if len(starts) == len(sums) else np.add.reduceat(sums[order], starts)


def bootstrap_intervals(
    sums: NDArray[Any], statistics: Callable[[Float], Mapping[str, Float]], resamples: int, seed: int
) -> dict[str, Interval | None]:
    """Compute 95 % intervals of statistics of summed counts, by drawing scenes with replacement.

    Scenes of equal counts form one kind. A resample is one draw from a multinomial distribution, which gives the number
    of scenes of each kind. So the cost depends on the number of kinds, not on the number of scenes.

    Parameters
    ----------
    sums : ndarray of shape (C, M)
        Counts or sums per scene.
    statistics : function
        Function that computes named values of shape (...) from sums of shape (..., M). An undefined value is nan.
    resamples : int
        Number of resamples. 0 computes no intervals.
    seed : int
        Seed of the draws.

    Returns
    -------
    dict of str to (low, high) or None
        None if there are fewer than two scenes, ``resamples`` is 0, or the value is undefined in all resamples.

    Examples
    --------
    >>> import numpy as np, kpbench
    >>> sums = np.array([[3, 4], [4, 4], [2, 4], [4, 4]])  # matches and true keypoints of four scenes
    >>> found = kpbench.scoring.bootstrap_intervals(sums, lambda s: {"score": s[..., 0] / s[..., 1]}, 1000, seed=0)
    >>> low, high = found["score"]
    >>> 0.4 < low < 13 / 16 < high <= 1
    True
    """
    if len(sums) < 2 or not resamples:
        return dict.fromkeys(statistics(sums.sum(axis=0)))
    rng = np.random.default_rng(seed)
    kinds, count = pool_kinds(sums, rng)
    drawn = rng.multinomial(count.sum(), count / count.sum(), size=resamples)
    total = count @ kinds
    found, without_one = statistics(total), statistics(total - kinds)
    result: dict[str, Interval | None] = {}
    for name, values in statistics(drawn.astype(float) @ kinds).items():
        values = values[np.isfinite(values)]
        levels = _percentile_levels(values, float(found[name]), without_one[name], count, len(sums))
        low, high = np.quantile(values, levels).tolist() if len(values) else (np.nan, np.nan)
        result[name] = (low, high) if len(values) else None
    return result


def pool_kinds(sums: NDArray[Any], rng: np.random.Generator) -> tuple[NDArray[Any], Int]:
    """Return the kinds of scenes, of shape (K, M), and the number of scenes of each kind, of shape (K,).

    More than ``MOST_KINDS`` kinds are replaced by random pools of about equal size. Sums of pools vary like sums of
    scenes.
    """
    kinds, count = _unique_rows(sums)
    if len(kinds) <= MOST_KINDS:
        return kinds, count
    shuffled = np.repeat(kinds, count, axis=0)[rng.permutation(len(sums))]
    pools = np.add.reduceat(shuffled, np.linspace(0, len(sums), MOST_KINDS, endpoint=False).astype(int))
    return pools, np.ones(MOST_KINDS, np.int64)


def _percentile_levels(values: Float, found: float, without_one: Float, count: Int, scenes: int) -> Float:
    """Return the two quantile levels that bound a 95 % interval.

    Without bias and skewness, the levels approach 0.025 and 0.975 as the number of scenes grows.

    Parameters
    ----------
    values : ndarray of shape (R,), float64
        The statistic of each resample.
    found : float
        The statistic of all scenes.
    without_one : ndarray of shape (K,), float64
        The statistic after one scene of each kind in turn is removed (jackknife).
    count : ndarray of shape (K,), int64
        Number of scenes of each kind.
    scenes : int
        Number of scenes.
    """
    half = -stdtrit(scenes - 1, TAIL) * np.sqrt(scenes / (scenes - 1)) * np.array([-1.0, 1.0])
    defined = np.isfinite(without_one)
    if not len(values) or not defined.any():
        return np.asarray(ndtr(half))
    below = np.mean(values < found) + np.mean(values == found) / 2
    bias = ndtri(np.clip(below, 0.5 / len(values), 1 - 0.5 / len(values)))
    weight = count[defined]
    change = np.average(without_one[defined], weights=weight) - without_one[defined]
    spread = float(weight @ change**2)
    skew = float(weight @ change**3) / (6 * spread**1.5) if spread > 0 else 0.0
    return np.asarray(ndtr(bias + (bias + half) / (1 - skew * (bias + half))))


def _unique_rows(table: NDArray[Any]) -> tuple[NDArray[Any], Int]:
    """Return the distinct rows of a table, in lexicographic order, and the count of each row.

    Rows of whole numbers are packed into one integer each if 62 bits suffice. Sorting integers is many times faster
    than sorting rows. Other rows are sorted, but equal ones stay apart.
    """
    if table.dtype.kind == "f":
        return table[np.lexsort(table.T[::-1])], np.ones(len(table), np.int64)
    least = table.min(axis=0)
    sizes = (table.max(axis=0) - least).astype(object) + 1
    if np.prod(sizes) >= 2**62:
        return np.unique(table, axis=0, return_counts=True)
    shape = tuple(int(size) for size in sizes)
    code, count = np.unique(np.ravel_multi_index(tuple((table - least).T), shape), return_counts=True)
    return np.stack(np.unravel_index(code, shape), axis=1) + least, count
