"""Find where the detection score crosses a limit as the severity of a condition grows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.scoring.bootstrap import Interval, bootstrap_intervals, sum_by_scene
from kpbench.scoring.metrics import SUMS
from kpbench.scoring.scores import Scores
from kpbench.types import Float, Int

DETECTION_SCORE_LIMIT = 0.9
"""Default limit. A breakpoint is where the detection score crosses the limit."""


@dataclass(frozen=True)
class Breakpoint:
    """The rung at which the detection score of a condition crosses a limit.

    Attributes
    ----------
    condition : str
    limit : float
    crossing : {"falls", "rises", "over", "under"}
        "falls": the score falls under the limit as the rung grows. "rises": the score rises to the limit or over it.
        "over": the score is at or over the limit at all rungs. "under": the score is under the limit at all rungs.
    rung : float or None
        Rung of the first crossing of this kind, interpolated linearly; None for "over" and "under".
    interval : (low, high) or None
        95 % interval of the rung from resampled scenes. A resample without such a crossing counts as a crossing at the
        first rung if the score there is already past the limit, else at the last rung. None for "over" and "under", for
        fewer than two scenes, and if `resamples` is 0.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.scoring.Breakpoint("blur", 0.9, "falls", 7.5, (7.1, 8.2)).crossing
    'falls'
    """

    condition: str
    limit: float
    crossing: str
    rung: float | None
    interval: Interval | None

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of ``breakpoints`` in the scores file."""
        return asdict(self)


def find_breakpoints(scores: Scores, limit: float = DETECTION_SCORE_LIMIT) -> tuple[Breakpoint, ...]:
    """Find the first falling and the first rising crossing of each condition.

    The detection score comes from one-to-one matching, even if `matching` in the settings is "literal".

    Parameters
    ----------
    scores : Scores
    limit : float
        The detection score that separates "over" from "under".

    Returns
    -------
    tuple of Breakpoint
        For each condition, at most one breakpoint "falls" and at most one "rises". A condition without crossings has
        one breakpoint "over" or "under", if the detection score is defined at all rungs.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.scoring.find_breakpoints(scores)  # this dataset has no conditions
    ()
    """
    return tuple(b for name, rungs in scores.conditions.items() for b in _find_in_condition(scores, name, rungs, limit))


def _find_in_condition(scores: Scores, name: str, rungs: list[float], limit: float) -> Iterator[Breakpoint]:
    scenes = _sums_by_rung(scores, name, rungs)
    levels = np.array(rungs, np.float64)
    detection_score = _detection_scores(scenes.sum(axis=0), len(rungs))
    under = detection_score < limit
    if np.isfinite(detection_score).all() and (under.all() or not under.any()):
        yield Breakpoint(name, limit, "under" if under[0] else "over", None, None)
    for crossing, rising in (("falls", False), ("rises", True)):
        rung = float(_first_crossing(levels, detection_score, limit, rising))
        if np.isnan(rung):
            continue

        def crossing_rung(sums: NDArray[Any], rising: bool = rising) -> dict[str, Float]:
            values = _detection_scores(sums, len(levels))
            end = np.where((values[..., 0] < limit) != rising, levels[0], levels[-1])
            found = _first_crossing(levels, values, limit, rising)
            return {"rung": np.where(np.isnan(found), end, found)}

        settings = scores.settings
        interval = bootstrap_intervals(scenes, crossing_rung, settings.resamples, settings.seed)["rung"]
        yield Breakpoint(name, limit, crossing, rung, interval)


def _sums_by_rung(scores: Scores, condition: str, rungs: list[float]) -> Int:
    """Return the counts of each scene of a condition, of shape (C, 2R).

    Each rung has two columns, in order: the number of true keypoints and the number of matches.
    """
    truth, sums = scores.outcomes.truth, scores.outcomes.image_sums
    images = np.flatnonzero(truth.condition == condition)
    position = np.searchsorted(rungs, truth.rung[images])
    table = np.zeros((len(images), 2 * len(rungs)), np.int64)
    table[np.arange(len(images)), 2 * position] = sums[images, SUMS.index("truths")]
    table[np.arange(len(images)), 2 * position + 1] = sums[images, SUMS.index("matched")]
    return sum_by_scene(table, truth.scene_id[images])


def _detection_scores(sums: NDArray[Any], rungs: int) -> Float:
    """Compute (..., R) detection scores from (..., 2R) sums; nan where a rung has no keypoints."""
    pairs = sums.reshape(*sums.shape[:-1], rungs, 2).astype(np.float64)
    truths = np.where(pairs[..., 0] > 0, pairs[..., 0], np.nan)
    return np.asarray(pairs[..., 1] / truths)


def _first_crossing(levels: Float, value: Float, limit: float, rising: bool) -> Float:
    """Return the level at which values of shape (..., R) first fall under a limit; nan without a crossing.

    If ``rising``, return the level at which the values first rise to the limit or over it. The values are interpolated
    linearly between the ``levels`` (R,).
    """
    if len(levels) < 2:
        return np.full(value.shape[:-1], np.nan)
    before, after = value[..., :-1], value[..., 1:]
    crosses = (before < limit) & (after >= limit) if rising else (before >= limit) & (after < limit)
    k = np.argmax(crosses, axis=-1)[..., None]
    a, b = np.take_along_axis(before, k, axis=-1)[..., 0], np.take_along_axis(after, k, axis=-1)[..., 0]
    k = k[..., 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        crossing = levels[k] + (levels[k + 1] - levels[k]) * (limit - a) / (b - a)
    return np.asarray(np.where(crosses.any(axis=-1), crossing, np.nan))
