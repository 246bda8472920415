"""Compare two detectors on the same images: paired differences with intervals, and which detector is better."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError, GateFailed
from kpbench.scoring.bootstrap import Interval, bootstrap_intervals, sum_by_scene
from kpbench.scoring.metrics import LABELS, PAPER_METRICS, SUMS, compute_ratios
from kpbench.scoring.scores import Scores
from kpbench.scoring.significance import LEVEL, adjust_holm, exchange_test
from kpbench.types import Float

COMPARED_METRICS = (*PAPER_METRICS, "precision", "f1")
"""Names of the metrics that are compared."""
LOWER_IS_BETTER = ("average_false_alarm",)
"""Names of the metrics for which a lower value is better."""


@dataclass(frozen=True)
class Difference:
    """The difference of a metric between two detectors, over all images or over one condition and rung.

    Attributes
    ----------
    condition : str or None
        None for all images.
    rung : float or None
        None for all images.
    metric : str
        One of :data:`COMPARED_METRICS`.
    first, second : float or None
        The metric of each detector; None if the metric is undefined.
    interval : (low, high) or None
        95 % interval of ``first`` minus ``second``. Each resample draws the same scenes for both detectors. None for
        fewer than two scenes, if `resamples` is 0, or if a metric is undefined.
    p : float or None
        Two-sided p-value of :func:`kpbench.scoring.exchange_test`. None where ``interval`` is None.
    p_holm : float or None
        The p-value adjusted for all rungs of the metric by :func:`kpbench.scoring.adjust_holm`. None over all images.

    Examples
    --------
    >>> import kpbench
    >>> difference = kpbench.scoring.Difference("blur", 7, "detection_score", 0.75, 0.5, (0.1, 0.4))
    >>> difference.value, difference.verdict
    (0.25, 'better')
    >>> difference.is_no_worse(0.01)
    True
    """

    condition: str | None
    rung: float | None
    metric: str
    first: float | None
    second: float | None
    interval: Interval | None
    p: float | None = None
    p_holm: float | None = None

    @property
    def value(self) -> float | None:
        """``first`` minus ``second``; None if ``first`` or ``second`` is None."""
        return None if self.first is None or self.second is None else self.first - self.second

    @property
    def verdict(self) -> str:
        """Verdict on the first detector: "better", "worse" or "even".

        "even" if the interval contains 0 or is None, or if ``p_holm`` is over 0.05.
        """
        if self.value is None or self.interval is None or self.interval[0] <= 0 <= self.interval[1]:
            return "even"
        if self.p_holm is not None and self.p_holm > LEVEL:
            return "even"
        return "better" if (self.value > 0) != (self.metric in LOWER_IS_BETTER) else "worse"

    def is_no_worse(self, margin: float) -> bool:
        """Return whether the interval excludes that the first detector is worse by more than ``margin``.

        The error probability is 2.5 %, because one end of the 95 % interval decides.
        """
        if self.interval is None:
            return False
        low, high = self.interval
        return high <= margin if self.metric in LOWER_IS_BETTER else low >= -margin

    def is_equivalent(self, margin: float) -> bool:
        """Return whether the interval lies between ``-margin`` and ``margin``."""
        return self.interval is not None and -margin <= self.interval[0] and self.interval[1] <= margin

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of ``differences`` in the comparison file."""
        return {**vars(self), "difference": self.value, "verdict": self.verdict}


@dataclass(frozen=True)
class Comparison:
    """The differences between the metrics of two detectors.

    Attributes
    ----------
    first, second : str
        Names of the detectors.
    differences : tuple of Difference
        The differences over all images, then the differences of each condition and rung.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.compare(scores, scores).verdicts("detection_score")
    {'better': 0, 'even': 1, 'worse': 0}
    """

    first: str
    second: str
    differences: tuple[Difference, ...]

    def verdicts(self, metric: str) -> dict[str, int]:
        """Count the rungs by verdict on the first detector. Without rungs, count the verdict over all images."""
        overall, *of_rungs = (d.verdict for d in self.differences if d.metric == metric)
        found = of_rungs or [overall]
        return {verdict: found.count(verdict) for verdict in ("better", "even", "worse")}

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of ``comparisons`` in the comparison file."""
        return {"first": self.first, "second": self.second, "differences": [d.to_dict() for d in self.differences]}


def compare(first: Scores, second: Scores) -> Comparison:
    """Compute paired differences of the paper's metrics, precision and F1.

    Each resample draws the same scenes for both detectors. So a scene that is hard for both detectors does not widen
    the interval of the difference.

    Parameters
    ----------
    first, second : Scores
        Scores on the same truth with the same settings.

    Returns
    -------
    Comparison

    Raises
    ------
    DataError
        If the truth or the settings of the two scores differ.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.compare(scores, scores).differences[0].value
    0.0
    """
    require_same_truth(first, second)
    return Comparison(first.name, second.name, _adjust(list(_compute_differences(first, second))))


def require_same_truth(first: Scores, second: Scores) -> None:
    """Raise a :class:`kpbench.DataError` if the truth or the settings of two scores differ."""
    a, b = first.outcomes, second.outcomes
    same = a.truth is b.truth or (
        a.truth.fingerprint == b.truth.fingerprint
        and np.array_equal(a.truth.image_id, b.truth.image_id)
        and np.array_equal(a.truth.keypoints, b.truth.keypoints)
    )
    if not same or a.settings != b.settings:
        raise DataError(f"{first.name} and {second.name} were not scored on the same images with the same settings")


def _adjust(differences: Sequence[Difference]) -> tuple[Difference, ...]:
    """Set ``p_holm`` of the rungs of each metric."""
    result = list(differences)
    for metric in COMPARED_METRICS:
        p = {n: d.p for n, d in enumerate(result) if d.metric == metric and d.condition is not None and d.p is not None}
        for n, adjusted in zip(p, adjust_holm(list(p.values())).tolist(), strict=True):
            result[n] = replace(result[n], p_holm=adjusted)
    return tuple(result)


def _compute_differences(first: Scores, second: Scores) -> Iterator[Difference]:
    truth, settings = first.outcomes.truth, first.settings
    both = np.hstack([first.outcomes.image_sums, second.outcomes.image_sums])
    undefined = {n for run in (first, second) for n, value in run.overall.metrics.items() if value is None}

    def ratios_of_both(sums: NDArray[Any]) -> tuple[dict[str, Float], dict[str, Float]]:
        parts = sums[..., : len(SUMS)], sums[..., len(SUMS) :]
        return compute_ratios(parts[0], settings.matching), compute_ratios(parts[1], settings.matching)

    def difference(sums: NDArray[Any]) -> dict[str, Float]:
        one, other = ratios_of_both(sums)
        return {name: one[name] - other[name] for name in COMPARED_METRICS}

    keys = [(None, None), *((name, rung) for name, rungs in first.conditions.items() for rung in rungs)]
    for condition, rung in keys:
        rows = np.ones(len(truth), bool) if condition is None else (truth.condition == condition) & (truth.rung == rung)
        scenes = sum_by_scene(both[rows], truth.scene_id[rows])
        intervals = bootstrap_intervals(scenes, difference, settings.resamples, settings.seed)
        p = exchange_test(scenes, difference, settings.seed) if settings.resamples else dict.fromkeys(COMPARED_METRICS)
        one, other = ratios_of_both(scenes.sum(axis=0))
        for name in COMPARED_METRICS:
            a, b = (None if name in undefined or np.isnan(v[name]) else float(v[name]) for v in (one, other))
            interval = None if a is None or b is None else intervals[name]
            yield Difference(condition, rung, name, a, b, interval, None if interval is None else p[name])


def check_regression(comparisons: Sequence[Comparison]) -> None:
    """Raise an error if the first detector is worse than another detector in a metric of the paper, over all images.

    Raises
    ------
    GateFailed
        If a metric is worse, or if a metric differs and the difference has no interval. A single scene gives no
        interval. The message names every such metric.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.scoring.check_regression([kpbench.compare(scores, scores)])
    """
    failed = []
    for c in comparisons:
        for d in c.differences:
            if d.condition is not None or d.metric not in PAPER_METRICS:
                continue
            if d.value and d.interval is None:
                failed.append(
                    f"{LABELS[d.metric]} of {c.first} differs from that of {c.second} by {d.value:+.4f}, "
                    "and without an interval the difference may be chance"
                )
            if d.verdict == "worse" and d.interval:
                failed.append(
                    f"{LABELS[d.metric]} of {c.first} is worse than that of {c.second} by {d.value:+.4f} "
                    f"[{d.interval[0]:+.4f}, {d.interval[1]:+.4f}]"
                )
    if failed:
        raise GateFailed("; ".join(failed))


def require_margins(margins: Mapping[str, float]) -> None:
    """Raise an error if a margin of :func:`check_no_worse` is of a metric that is not compared, or not positive."""
    for metric, margin in margins.items():
        if metric not in COMPARED_METRICS:
            raise DataError(f"{metric} is not compared, only {', '.join(COMPARED_METRICS)}")
        if not margin > 0:
            raise DataError(f"the margin of {metric} is {margin:g}, expected a positive number")


def check_no_worse(comparisons: Sequence[Comparison], margins: Mapping[str, float]) -> None:
    """Raise an error unless the first detector is no worse than the others by more than a margin, over all images.

    Parameters
    ----------
    comparisons : sequence of Comparison
    margins : mapping of str to float
        The margin of each metric to check, in the unit of the metric.

    Raises
    ------
    GateFailed
        If an interval does not exclude a larger loss, or if there is no interval.
    DataError
        If a metric is not compared, or a margin is not positive.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.scoring.check_no_worse([kpbench.compare(scores, scores)], {"detection_score": 0.01})
    """
    require_margins(margins)
    failed = []
    for metric, margin in margins.items():
        for c in comparisons:
            d = next(d for d in c.differences if d.condition is None and d.metric == metric)
            if not d.is_no_worse(margin):
                shown = "no interval" if d.interval is None else f"[{d.interval[0]:+.4f}, {d.interval[1]:+.4f}]"
                failed.append(
                    f"{LABELS[metric]} of {c.first} may be worse than that of {c.second} by more than {margin:g}: "
                    f"{shown}"
                )
    if failed:
        raise GateFailed("; ".join(failed))
