"""Compare two datasets as a whole, and stop where they drift apart."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kpbench.dataset.folder import Dataset
from kpbench.dataset.labelled import open_labelled
from kpbench.drift.distributions import DistributionShift, compare_distributions
from kpbench.drift.images import PixelChanges, TruthChanges, compare_pixels, compare_truth, pair_images
from kpbench.drift.quantities import collect_quantities, count_measured
from kpbench.errors import DataError, GateFailed
from kpbench.predictions.coco import CocoDataset
from kpbench.scoring.significance import adjust_holm

DIFF_SCHEMA = "kpbench.diff/1"
"""Name and version of the format of the file of differences."""
ABSENT = "absent"
"""Stands for a field that one of the configs does not have."""


@dataclass(frozen=True)
class DatasetDifference:
    """The result of :func:`kpbench.diff`.

    Attributes
    ----------
    about : tuple of two dicts
        ``path``, ``fingerprint``, and the numbers of ``images`` and ``keypoints`` of each dataset.
    config : dict of str to tuple
        The two values of each field of the config that differs, by the path of the field such as ``limits.radius_px``;
        "absent" for a field that one config does not have.
    truth : TruthChanges
        The differences between the keypoints of the common images.
    pixels : PixelChanges
        The differences between the pixels of the common images.
    distributions : tuple of DistributionShift
        The differences between the distributions over all images.
    max_shift : float
        The largest shift of a distribution that is no drift.

    Examples
    --------
    >>> import kpbench
    >>> dataset = kpbench.open_dataset("kpbench-data")
    >>> difference = kpbench.diff(dataset, dataset)
    >>> difference.config, difference.drifted
    ({}, ())
    """

    about: tuple[dict[str, Any], dict[str, Any]]
    config: dict[str, tuple[Any, Any]]
    truth: TruthChanges
    pixels: PixelChanges
    distributions: tuple[DistributionShift, ...]
    max_shift: float

    @property
    def drifted(self) -> tuple[DistributionShift, ...]:
        """The distributions that differ by more than ``max_shift``, and by more than chance explains."""
        return tuple(d for d in self.distributions if d.is_drift(self.max_shift))

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the file of differences."""
        return {
            "schema": DIFF_SCHEMA,
            "a": self.about[0],
            "b": self.about[1],
            "config": [{"field": field, "a": old, "b": new} for field, (old, new) in self.config.items()],
            "truth": self.truth.to_dict(),
            "pixels": vars(self.pixels),
            "distributions": [{**vars(d), "drift": d.is_drift(self.max_shift)} for d in self.distributions],
            "max_shift": self.max_shift,
            "drift": bool(self.drifted),
        }


def diff(
    a: str | Path | Dataset | CocoDataset,
    b: str | Path | Dataset | CocoDataset,
    *,
    max_shift: float = 0.05,
    seed: int = 0,
    progress: Callable[[int], None] = lambda count: None,
) -> DatasetDifference:
    """Compare two datasets, or two versions of one.

    Parameters
    ----------
    a, b : str, Path, Dataset or CocoDataset
        Datasets, or what :func:`kpbench.dataset.open_labelled` opens.
    max_shift : float
        Largest shift of a distribution that is no drift, as a share of its values, see
        :func:`kpbench.drift.compute_shift`.
    seed : int
        Seed of the tests of the distributions.
    progress : function
        Called with a number of images that are done, :func:`kpbench.drift.datasets.count_images_read` in all.

    Returns
    -------
    DatasetDifference

    Raises
    ------
    DataError
        If a dataset cannot be read, or ``max_shift`` is not between 0 and 1.

    Examples
    --------
    >>> import kpbench
    >>> difference = kpbench.diff("kpbench-data", "kpbench-data")
    >>> difference.pixels.changed, [d.shift for d in difference.distributions[:2]]
    (0, [0.0, 0.0])
    """
    if not 0 <= max_shift < 1:
        raise DataError(f"`max_shift` is {max_shift:g}, expected a number from 0 to below 1")
    first, second = (open_labelled(d) if isinstance(d, str | Path) else d for d in (a, b))
    collected = [collect_quantities(dataset, progress) for dataset in (first, second)]
    shifts = [compare_distributions(name, collected[0][name], collected[1][name], seed) for name in collected[0]]
    return DatasetDifference(
        (_describe(first), _describe(second)),
        compare_configs(first.config, second.config),
        compare_truth(first.truth, second.truth),
        compare_pixels(first, second, progress),
        _adjust(shifts),
        max_shift,
    )


def count_images_read(a: Dataset | CocoDataset, b: Dataset | CocoDataset) -> int:
    """Return the number of images that :func:`diff` reports as progress."""
    return count_measured(a) + count_measured(b) + len(pair_images(a.truth, b.truth)[1])


def _describe(dataset: Dataset | CocoDataset) -> dict[str, Any]:
    return {
        "path": str(dataset.path),
        "fingerprint": dataset.fingerprint,
        "images": len(dataset),
        "keypoints": len(dataset.truth.keypoints),
    }


def compare_configs(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the two values of each field that differs, by the path of the field."""
    flat_a, flat_b = _flatten(a), _flatten(b)
    fields = [*flat_a, *(field for field in flat_b if field not in flat_a)]
    pairs = {field: (flat_a.get(field, ABSENT), flat_b.get(field, ABSENT)) for field in fields}
    return {field: pair for field, pair in pairs.items() if pair[0] != pair[1]}


def _flatten(config: Mapping[str, Any], parents: str = "") -> dict[str, Any]:
    """Return the values of nested objects by their paths. A list is one value."""
    flat: dict[str, Any] = {}
    for name, value in config.items():
        is_nested = isinstance(value, Mapping) and value
        flat.update(_flatten(value, f"{parents}{name}.") if is_nested else {f"{parents}{name}": value})
    return flat


def _adjust(shifts: list[DistributionShift]) -> tuple[DistributionShift, ...]:
    """Set ``p_holm``."""
    tested = [n for n, d in enumerate(shifts) if d.p is not None]
    adjusted = adjust_holm(np.array([shifts[n].p for n in tested], float))
    for n, p in zip(tested, adjusted.tolist(), strict=True):
        shifts[n] = replace(shifts[n], p_holm=p)
    return tuple(shifts)


def check_drift(difference: DatasetDifference) -> None:
    """Raise an error if a distribution drifted.

    Raises
    ------
    GateFailed
        The message names every distribution that drifted.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.drift.check_drift(kpbench.diff("kpbench-data", "kpbench-data"))
    """
    if difference.drifted:
        shifts = ", ".join(f"{d.name.split(',')[0]} by {d.shift:.3f}" for d in difference.drifted)
        raise GateFailed(f"distributions drifted by more than {difference.max_shift:g}: {shifts}")
