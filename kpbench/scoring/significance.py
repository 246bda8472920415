"""Test whether two detectors differ on the same scenes, and adjust the p-values of several tests.

References
----------
.. [1] P. Good, "Permutation, Parametric, and Bootstrap Tests of Hypotheses", 3rd edition, Springer 2005, section 3.7 on
   matched pairs. https://doi.org/10.1007/b138696
.. [2] B. Phipson and G. K. Smyth, "Permutation p-values should never be zero", Statistical Applications in Genetics and
   Molecular Biology 9(1), 2010. https://doi.org/10.2202/1544-6115.1585
.. [3] S. Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6(2),
   1979. https://www.jstor.org/stable/4615733
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpbench.scoring.bootstrap import pool_kinds
from kpbench.types import Float

LEVEL = 0.05
"""Largest p-value at which detectors are said to differ."""
MOST_EXACT = 12
"""Largest number of scenes with a difference for which all exchanges are tried."""
EXCHANGES = 4999
"""Number of random exchanges for more scenes. The smallest p-value is 1/5000."""


def exchange_test(
    sums: NDArray[Any], statistics: Callable[[Float], Mapping[str, Float]], seed: int
) -> dict[str, float | None]:
    """Compute two-sided p-values of paired differences, by exchanging the two detectors within scenes.

    If the detectors are equally good, each scene could as well have come out with the two results exchanged [1]_. The
    p-value is the share of exchanges whose difference is at least as large as the observed difference. The observed
    order counts as one of the random exchanges [2]_.

    Parameters
    ----------
    sums : ndarray of shape (C, 2M)
        Counts per scene: M counts of the first detector, then M counts of the second detector.
    statistics : function
        Function that computes named differences of shape (...) from sums of shape (..., 2M). An undefined value is nan.
    seed : int
        Seed of the exchanges. Without effect for at most 12 scenes in which the detectors differ.

    Returns
    -------
    dict of str to float or None
        None if the observed difference is undefined.

    Examples
    --------
    >>> import numpy as np, kpbench
    >>> sums = np.array([[4, 3], [4, 2], [5, 4], [4, 4]])  # matches of the first and of the second detector
    >>> kpbench.scoring.exchange_test(sums, lambda s: {"matches": s[..., 0] - s[..., 1]}, seed=0)
    {'matches': 0.25}
    """
    half = sums.shape[1] // 2
    total, rng = sums.sum(axis=0), np.random.default_rng(seed)
    change = np.hstack([sums[:, half:], sums[:, :half]]) - sums
    change = change[change.any(axis=1)]
    exact = len(change) <= MOST_EXACT
    if exact:
        exchanged = np.arange(2 ** len(change))[:, None] >> np.arange(len(change)) & 1
    else:
        change, count = pool_kinds(change, rng)
        exchanged = rng.binomial(count, 0.5, size=(EXCHANGES, len(count)))
    tried = statistics((total + exchanged @ change).astype(float))
    result: dict[str, float | None] = {}
    for name, value in statistics(total.astype(float)).items():
        least = abs(float(value)) * (1 - 1e-9) - 1e-12  # rounding must not separate equal differences
        extreme = int(np.sum(~(np.abs(tried[name]) < least)))  # an undefined difference counts as extreme
        p = extreme / len(exchanged) if exact else (extreme + 1) / (EXCHANGES + 1)
        result[name] = None if np.isnan(value) else p
    return result


def adjust_holm(p: ArrayLike) -> Float:
    """Adjust the p-values of several tests by Holm's method [3]_.

    If every test whose adjusted p-value is at most 0.05 is called a difference, the probability of one or more false
    differences is at most 5 %.

    Parameters
    ----------
    p : array_like of shape (N,)
        The p-values.

    Returns
    -------
    ndarray of shape (N,), float64
        The adjusted p-values, in the order of ``p``.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.scoring.adjust_holm([0.01, 0.04, 0.03]).tolist()
    [0.03, 0.06, 0.06]
    """
    values = np.asarray(p, float)
    order = np.argsort(values, kind="stable")
    adjusted = np.empty(len(values))
    adjusted[order] = np.minimum(np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1)), 1)
    return adjusted
