"""Where along a severity ladder the detection score crosses a limit, interpolated, with an interval."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.scoring.bootstrap import Interval, by_scene, intervals
from kpbench.scoring.metrics import SUMS
from kpbench.scoring.scores import Scores
from kpbench.types import Float

LIMIT = 0.9
TRUTHS, MATCHED = SUMS.index("truths"), SUMS.index("matched")


@dataclass(frozen=True)
class Breakpoint:
    """The rung at which the detection score of a condition crosses ``limit``.

    Attributes
    ----------
    condition : str
    limit : float
    crossing : {"falls", "rises", "over", "under"}
        Whether the score falls under or rises over the limit as the rung grows; "over" and "under": it is on that
        side at all rungs.
    rung : float or None
        The first such crossing, on straight lines between the rungs; None if there is none.
    interval : (low, high) or None
        95 %, from resampled scenes. A resample that crosses before or after the ladder counts as that end of it.
    """

    condition: str
    limit: float
    crossing: str
    rung: float | None
    interval: Interval | None

    def to_dict(self) -> dict[str, Any]:
        """An entry of ``breakpoints`` in the scores file."""
        return asdict(self)


def breakpoints(scores: Scores, limit: float = LIMIT) -> tuple[Breakpoint, ...]:
    """All crossings of every condition: at most one "falls" and one "rises" each.

    The detection score is that of one-to-one matching, whatever the settings.
    """
    return tuple(b for name, rungs in scores.conditions.items() for b in _of_condition(scores, name, rungs, limit))


def _of_condition(scores: Scores, name: str, rungs: list[float], limit: float) -> Iterator[Breakpoint]:
    rows = scores.tally
    units = _by_rung(rows.image_sums, rows.truth.scene_id, rows.truth.condition == name, rows.truth.rung, rungs)
    levels = np.array(rungs, np.float64)
    score = _detection_scores(units.sum(axis=0), len(rungs))
    under = score < limit
    if np.isfinite(score).all() and (under.all() or not under.any()):
        yield Breakpoint(name, limit, "under" if under[0] else "over", None, None)
    for crossing, rising in (("falls", False), ("rises", True)):
        at = float(_first_crossing(levels, score, limit, rising))
        if np.isnan(at):
            continue

        def resampled(sums: NDArray[Any], rising: bool = rising) -> dict[str, Float]:
            values = _detection_scores(sums, len(levels))
            outside = np.where((values[..., 0] < limit) != rising, levels[0], levels[-1])
            crossed = _first_crossing(levels, values, limit, rising)
            return {"rung": np.where(np.isnan(crossed), outside, crossed)}

        spread = intervals(units, resampled, scores.settings.resamples, scores.settings.seed)["rung"]
        yield Breakpoint(name, limit, crossing, at, spread)


def _by_rung(
    sums: NDArray[np.int64], scene: NDArray[np.int64], of_condition: NDArray[np.bool_], rung: Float, rungs: list[float]
) -> NDArray[np.int64]:
    """(C, 2R) sums of each scene: truths and matches at the first rung, at the second, …"""
    rows = np.flatnonzero(of_condition)
    step = np.searchsorted(rungs, rung[rows])
    wide = np.zeros((len(rows), 2 * len(rungs)), np.int64)
    wide[np.arange(len(rows)), 2 * step] = sums[rows, TRUTHS]
    wide[np.arange(len(rows)), 2 * step + 1] = sums[rows, MATCHED]
    return by_scene(wide, scene[rows])


def _detection_scores(sums: NDArray[Any], rungs: int) -> Float:
    """(…, R) from (…, 2R) sums; nan where a rung has no keypoints."""
    pairs = sums.reshape(*sums.shape[:-1], rungs, 2).astype(np.float64)
    truths = np.where(pairs[..., 0] > 0, pairs[..., 0], np.nan)
    return np.asarray(pairs[..., 1] / truths)


def _first_crossing(levels: Float, value: Float, limit: float, rising: bool) -> Float:
    """Where values of shape (…, R) first fall under (or rise to) a limit between two levels; nan where they do not."""
    if len(levels) < 2:
        return np.full(value.shape[:-1], np.nan)
    before, after = value[..., :-1], value[..., 1:]
    crosses = (before < limit) & (after >= limit) if rising else (before >= limit) & (after < limit)
    k = np.argmax(crosses, axis=-1)[..., None]
    a, b = np.take_along_axis(before, k, axis=-1)[..., 0], np.take_along_axis(after, k, axis=-1)[..., 0]
    k = k[..., 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        at = levels[k] + (levels[k + 1] - levels[k]) * (limit - a) / (b - a)
    return np.asarray(np.where(crosses.any(axis=-1), at, np.nan))
