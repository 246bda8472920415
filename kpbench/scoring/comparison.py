"""Two detectors on the same images: paired differences with intervals, and who wins where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError, GateFailed
from kpbench.scoring.bootstrap import Interval, by_scene, intervals
from kpbench.scoring.metrics import LABELS, PAPER_METRICS, SUMS, ratios
from kpbench.scoring.scores import Scores
from kpbench.types import Float

METRICS = (*PAPER_METRICS, "precision", "f1")
LOWER_IS_BETTER = ("average_false_alarm",)


@dataclass(frozen=True)
class Difference:
    """First minus second of one metric, over all images or those of one condition and rung.

    Attributes
    ----------
    condition, rung
        None for all images.
    metric : str
    first, second : float or None
        None where undefined; then so is the difference.
    interval : (low, high) or None
        95 % of the difference, from scenes resampled for both alike; None with fewer than two scenes.
    """

    condition: str | None
    rung: float | None
    metric: str
    first: float | None
    second: float | None
    interval: Interval | None

    @property
    def value(self) -> float | None:
        """First minus second."""
        return None if self.first is None or self.second is None else self.first - self.second

    @property
    def verdict(self) -> str:
        """Whether the first is "better" or "worse", or "even": the interval holds 0, or there is none."""
        if self.value is None or self.interval is None or self.interval[0] <= 0 <= self.interval[1]:
            return "even"
        return "better" if (self.value > 0) != (self.metric in LOWER_IS_BETTER) else "worse"

    def to_dict(self) -> dict[str, Any]:
        """An entry of ``differences`` in the comparison file."""
        return {**vars(self), "difference": self.value, "verdict": self.verdict}


@dataclass(frozen=True)
class Comparison:
    """The first detector against one other; ``differences`` begin with those over all images."""

    first: str
    second: str
    differences: tuple[Difference, ...]

    def verdicts(self, metric: str) -> dict[str, int]:
        """How often the first is better, even and worse over the rungs, or over all images if there are none."""
        of_metric = [d for d in self.differences if d.metric == metric]
        said = [d.verdict for d in of_metric[1:] or of_metric]
        return {verdict: said.count(verdict) for verdict in ("better", "even", "worse")}

    def to_dict(self) -> dict[str, Any]:
        """An entry of ``comparisons`` in the comparison file."""
        return {"first": self.first, "second": self.second, "differences": [d.to_dict() for d in self.differences]}


def compare(first: Scores, second: Scores) -> Comparison:
    """Paired differences of the paper's metrics, precision and F1.

    Both are resampled together, scene by scene, so what makes a scene hard for both does not widen the interval. The
    settings are those of ``first``.

    Raises
    ------
    DataError
        If the two were not scored on the same truth with the same settings.
    """
    a, b = first.tally, second.tally
    same = a.truth is b.truth or (
        a.truth.fingerprint == b.truth.fingerprint
        and np.array_equal(a.truth.image_id, b.truth.image_id)
        and np.array_equal(a.truth.keypoints, b.truth.keypoints)
    )
    if not same or a.settings != b.settings:
        raise DataError(f"{first.name} and {second.name} were not scored on the same images with the same settings")
    return Comparison(first.name, second.name, tuple(_differences(first, second)))


def _differences(first: Scores, second: Scores) -> Iterator[Difference]:
    truth, settings = first.tally.truth, first.settings
    both = np.hstack([first.tally.image_sums, second.tally.image_sums])
    width = len(SUMS)
    undefined = {n for run in (first, second) for n, value in run.overall.metrics.items() if value is None}

    def parts(sums: NDArray[Any]) -> tuple[dict[str, Float], dict[str, Float]]:
        return ratios(sums[..., :width], settings.matching), ratios(sums[..., width:], settings.matching)

    def difference(sums: NDArray[Any]) -> dict[str, Float]:
        one, other = parts(sums)
        return {name: one[name] - other[name] for name in METRICS}

    keys = [(None, None), *((name, rung) for name, rungs in first.conditions.items() for rung in rungs)]
    for condition, rung in keys:
        rows = np.ones(len(truth), bool) if condition is None else (truth.condition == condition) & (truth.rung == rung)
        units = by_scene(both[rows], truth.scene_id[rows])
        spread = intervals(units, difference, settings.resamples, settings.seed)
        one, other = parts(units.sum(axis=0))
        for name in METRICS:
            a, b = (None if name in undefined or np.isnan(v[name]) else float(v[name]) for v in (one, other))
            yield Difference(condition, rung, name, a, b, None if a is None or b is None else spread[name])


def check_regression(comparisons: Sequence[Comparison]) -> None:
    """Refuse a first detector that is worse than another over all images, in any of the paper's three metrics.

    Raises
    ------
    GateFailed
        Naming every such metric, with the interval of its difference; or that there are too few scenes to tell.
    """
    failed = []
    for c in comparisons:
        for d in c.differences:
            if d.condition is not None or d.metric not in PAPER_METRICS:
                continue
            if d.value and d.interval is None:
                failed.append(
                    f"{LABELS[d.metric]} of {c.first} differs from that of {c.second} by {d.value:+.4f}, "
                    "and one scene cannot tell whether by chance"
                )
            if d.verdict == "worse" and d.interval:
                span = f"[{d.interval[0]:+.4f}, {d.interval[1]:+.4f}]"
                failed.append(
                    f"{LABELS[d.metric]} of {c.first} is worse than that of {c.second} by {d.value:+.4f} {span}"
                )
    if failed:
        raise GateFailed("; ".join(failed))
