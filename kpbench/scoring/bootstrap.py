"""95 % intervals from a bootstrap over scenes: images of one scene are not independent, so scenes are drawn.

With few scenes percentile intervals are too narrow and off centre. They lack the factor C/(C - 1) of a variance and the
tails of Student's t; both are put into the percentiles (Hesterberg 2015, "What teachers should know about the
bootstrap", section on expanded percentiles). Bias and skewness shift the percentiles (BC_a: Efron 1987, "Better
bootstrap confidence intervals").
``benchmarks/accuracy/coverage.py`` measures how often the intervals hold the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri, stdtrit

from kpbench.types import Float, Int

Interval = tuple[float, float]
MOST_KINDS = 1000  # different scenes that a bootstrap tells apart


def by_scene(sums: NDArray[Any], scene: Int) -> NDArray[Any]:
    """Sums of shape (N, M) of images, added up within scenes: (C, M), in the order of the scenes' numbers."""
    order = np.argsort(scene, kind="stable")
    starts = np.flatnonzero(np.append(True, np.diff(scene[order]) != 0)[: len(order)])
    return sums if len(starts) == len(sums) else np.add.reduceat(sums[order], starts)


def intervals(
    sums: NDArray[Any], statistics: Callable[[Float], Mapping[str, Float]], resamples: int, seed: int
) -> dict[str, Interval | None]:
    """Expanded BC_a intervals of statistics of the summed rows, when rows are drawn with replacement.

    Drawing C scenes with replacement is drawing how often each *kind* of scene (equal sums) comes up, a multinomial;
    so a million scenes cost as much as the few hundred different ones among them.

    Parameters
    ----------
    sums : ndarray of shape (C, M), a row a scene, whole numbers.
    statistics : function
        From (..., M) sums to named values of shape (...), nan where undefined.
    resamples : int
        None at all gives no intervals.
    seed : int

    Returns
    -------
    dict of str to (low, high) or None
        None where there are fewer than two scenes, or where the value is undefined in all resamples.
    """
    if len(sums) < 2 or not resamples:
        return dict.fromkeys(statistics(sums.sum(axis=0)))
    kinds, many = _unique_rows(sums)
    rng = np.random.default_rng(seed)
    if len(kinds) > MOST_KINDS:  # pool scenes at random: the sums of equal-sized pools vary as much
        shuffled = np.repeat(kinds, many, axis=0)[rng.permutation(len(sums))]
        kinds = np.add.reduceat(shuffled, np.linspace(0, len(sums), MOST_KINDS, endpoint=False).astype(int))
        many = np.ones(MOST_KINDS, np.int64)
    drawn = rng.multinomial(many.sum(), many / many.sum(), size=resamples)
    total = many @ kinds
    found, without = statistics(total), statistics(total - kinds)  # without one scene of each kind, for the skewness
    result: dict[str, Interval | None] = {}
    for name, values in statistics(drawn.astype(float) @ kinds).items():
        values = values[np.isfinite(values)]
        levels = _levels(values, float(found[name]), without[name], many, len(sums))
        low, high = np.quantile(values, levels).tolist() if len(values) else (np.nan, np.nan)
        result[name] = (low, high) if len(values) else None
    return result


def _levels(values: Float, found: float, without: Float, many: Int, scenes: int) -> Float:
    """The two percentiles that make a 95 % interval: 0.025 and 0.975 for many scenes, without bias and skewness.

    ``values`` (R,) are those of the resamples, ``found`` is that of all scenes, ``without`` (K,) is that without one
    scene of each kind, and ``many`` (K,) scenes are of the kind.
    """
    half = -stdtrit(scenes - 1, 0.025) * np.sqrt(scenes / (scenes - 1)) * np.array([-1.0, 1.0])
    fine = np.isfinite(without)
    if not len(values) or not fine.any():
        return np.asarray(ndtr(half))
    below = np.mean(values < found) + np.mean(values == found) / 2
    bias = ndtri(np.clip(below, 0.5 / len(values), 1 - 0.5 / len(values)))
    change, weight = np.average(without[fine], weights=many[fine]) - without[fine], many[fine]
    spread = float(weight @ change**2)
    skew = float(weight @ change**3) / (6 * spread**1.5) if spread > 0 else 0.0
    return np.asarray(ndtr(bias + (bias + half) / (1 - skew * (bias + half))))


def _unique_rows(table: NDArray[Any]) -> tuple[NDArray[Any], Int]:
    """The different rows of a table of whole numbers, in a fixed order, and how often each is there."""
    least = table.min(axis=0)
    sizes = (table.max(axis=0) - least).astype(object) + 1
    if np.prod(sizes) >= 2**62:
        return np.unique(table, axis=0, return_counts=True)
    shape = tuple(int(size) for size in sizes)
    code, many = np.unique(np.ravel_multi_index(tuple((table - least).T), shape), return_counts=True)
    return np.stack(np.unravel_index(code, shape), axis=1) + least, many
