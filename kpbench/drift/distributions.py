"""How far the distribution of a quantity differs between two datasets, and whether chance explains it.

References
----------
.. [1] A. L. Gibbs and F. E. Su, "On choosing and bounding probability metrics", International Statistical Review 70(3),
   2002. https://doi.org/10.1111/j.1751-5823.2002.tb00178.x
.. [2] P. Good, "Permutation, Parametric, and Bootstrap Tests of Hypotheses", 3rd edition, Springer 2005.
   https://doi.org/10.1007/b138696
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kpbench.types import Int

MOST_SCENES = 2000
"""Largest number of scenes of each dataset that a test looks at."""
EXCHANGED_TIMES = 999
"""Number of random exchanges of a test. The smallest p-value is 1/1000."""


class SceneValues(NamedTuple):
    """Values of a quantity in one dataset."""

    values: NDArray[Any]
    """Numbers, or texts of categories, shape (N,)."""
    scene: Int
    """Scene of each value, shape (N,)."""


@dataclass(frozen=True)
class DistributionShift:
    """The difference between the distributions of a quantity in two datasets.

    Attributes
    ----------
    name : str
        Name of the quantity, with its unit.
    count_a, count_b : int
        Number of values in each dataset.
    typical_a, typical_b : float, str or None
        Median of a number. For a category, the share of the category whose share differs most. None without values.
    shift : float or None
        Share of the values that would have to move, 0 to 1, see :func:`kpbench.drift.compute_shift`. None without
        values in one of the datasets.
    p : float or None
        p-value, see :func:`kpbench.drift.exchange_scenes`.
    p_holm : float or None
        The p-value, adjusted for all quantities by Holm's method.

    Examples
    --------
    >>> from kpbench.drift import DistributionShift
    >>> DistributionShift("tilt, degrees", 90, 80, 20.0, 31.5, 0.25, 0.001, 0.012).is_drift(0.05)
    True
    """

    name: str
    count_a: int
    count_b: int
    typical_a: float | str | None
    typical_b: float | str | None
    shift: float | None
    p: float | None = None
    p_holm: float | None = None

    def is_drift(self, max_shift: float) -> bool:
        """Return whether the shift is larger than ``max_shift``, and ``p_holm`` is at most 0.05."""
        return self.shift is not None and self.shift > max_shift and self.p_holm is not None and self.p_holm <= 0.05


def compute_shift(a: ArrayLike, b: ArrayLike) -> float:
    """Compute how far two samples differ, as a share of the values from 0 to 1.

    Of numbers, this is the statistic of Kolmogorov and Smirnov: the largest difference between the shares of values up
    to a limit. Of texts, it is the total variation: half of the sum of the differences between the shares [1]_.

    Parameters
    ----------
    a, b : array_like of shape (N,) and (M,)
        Numbers without nan, or texts. Neither may be empty.

    Returns
    -------
    float

    Examples
    --------
    >>> from kpbench.drift import compute_shift
    >>> compute_shift([1, 2, 3, 4], [3, 4, 5, 6]), compute_shift(["x", "x"], ["x", "y"])
    (0.5, 0.5)
    """
    a, b = np.asarray(a), np.asarray(b)
    distinct, code = np.unique(np.concatenate([a, b]), return_inverse=True)
    count_a, count_b = (np.bincount(part, minlength=len(distinct)) for part in (code[: len(a)], code[len(a) :]))
    return _shift_of_counts(count_a, count_b, distinct.dtype.kind != "U")


def _shift_of_counts(a: NDArray[Any], b: NDArray[Any], is_number: bool) -> float:
    """Compute the shift from the counts of each distinct value. nan if there are none."""
    total_a, total_b = a.sum(), b.sum()
    if not total_a or not total_b:
        return np.nan
    difference = a / total_a - b / total_b
    return float(np.abs(np.cumsum(difference)).max() if is_number else np.abs(difference).sum() / 2)


def exchange_scenes(a: SceneValues, b: SceneValues, seed: int) -> float:
    """Compute the p-value of a shift, by exchanging whole scenes between the two datasets.

    If the datasets have one distribution, each scene could as well have come from the other one [2]_. Values of one
    scene stay together, as they depend on each other. If both datasets have the same scenes, such as two versions of a
    dataset, a scene of one is exchanged with the same scene of the other. The p-value is the share of 999 random
    exchanges whose shift is at least the observed shift; the observed order counts as one of them. At most 2,000 evenly
    spaced scenes of each dataset are looked at.

    Parameters
    ----------
    a, b : pair of ndarrays of shape (N,)
        Values, and the scene of each value.
    seed : int
        Seed of the exchanges.

    Returns
    -------
    float

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.drift import exchange_scenes
    >>> rng = np.random.default_rng(0)
    >>> exchange_scenes((rng.normal(0, 1, 50), np.arange(50)), (rng.normal(3, 1, 60), np.arange(60)), seed=0)
    0.001
    """
    (values_a, scene_a), (values_b, scene_b) = _thin(*a), _thin(*b)
    distinct, code = np.unique(np.concatenate([values_a, values_b]), return_inverse=True)
    is_number = distinct.dtype.kind != "U"
    own_a, unit_a = np.unique(scene_a, return_inverse=True)
    own_b, unit_b = np.unique(scene_b, return_inverse=True)
    unit, is_paired = np.concatenate([unit_a, unit_b + len(own_a)]), np.array_equal(own_a, own_b)
    whole, rng = np.bincount(code, minlength=len(distinct)), np.random.default_rng(seed)

    def shift(is_of_a: NDArray[np.bool_]) -> float:
        first = np.bincount(code[is_of_a[unit]], minlength=len(distinct))
        return _shift_of_counts(first, whole - first, is_number)

    labels = np.arange(len(own_a) + len(own_b)) < len(own_a)
    observed, extreme = shift(labels), 1
    for _ in range(EXCHANGED_TIMES):
        coin = rng.random(len(own_a)) < 0.5
        tried = np.concatenate([coin, ~coin]) if is_paired else rng.permutation(labels)
        extreme += not shift(tried) < observed * (1 - 1e-9)  # an undefined shift counts as extreme
    return extreme / (EXCHANGED_TIMES + 1)


def _thin(values: NDArray[Any], scene: Int) -> SceneValues:
    """Return the values of at most ``MOST_SCENES`` evenly spaced scenes."""
    scenes = np.unique(scene)
    if len(scenes) <= MOST_SCENES:
        return SceneValues(values, scene)
    kept = np.isin(scene, scenes[np.linspace(0, len(scenes) - 1, MOST_SCENES).astype(int)])
    return SceneValues(values[kept], scene[kept])


def compare_distributions(name: str, a: SceneValues | None, b: SceneValues | None, seed: int) -> DistributionShift:
    """Compare a quantity of two datasets. None stands for a dataset that does not tell the quantity."""
    known = [part and SceneValues(*(column[_is_known(part.values)] for column in part)) for part in (a, b)]
    count_a, count_b = (0 if part is None else len(part.values) for part in known)
    typical_a, typical_b = _find_typical(*(None if part is None else part.values for part in known))
    shift = p = None
    if known[0] and known[1] and count_a and count_b:
        shift, p = compute_shift(known[0].values, known[1].values), exchange_scenes(known[0], known[1], seed)
    return DistributionShift(name, count_a, count_b, typical_a, typical_b, shift, p)


def _is_known(values: NDArray[Any]) -> NDArray[np.bool_]:
    return np.ones(len(values), bool) if values.dtype.kind == "U" else np.isfinite(values)


def _find_typical(a: NDArray[Any] | None, b: NDArray[Any] | None) -> list[float | str | None]:
    """Return the medians of numbers, or the shares of the category whose share differs most."""
    given = [part for part in (a, b) if part is not None and len(part)]
    if not given or given[0].dtype.kind != "U":
        return [float(np.median(part)) if part is not None and len(part) else None for part in (a, b)]
    names = np.unique(np.concatenate(given))
    shares = [np.array([np.mean(part == name) for name in names]) for part in given]
    n = int(np.argmax(np.abs(shares[0] - shares[-1])))
    return [
        f"{np.mean(part == names[n]):.1%} {names[n]}" if part is not None and len(part) else None for part in (a, b)
    ]
