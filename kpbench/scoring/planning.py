"""Plan how many scenes a measurement needs, from the scores of a pilot.

References
----------
.. [1] B. Efron and C. Stein, "The jackknife estimate of variance", Annals of Statistics 9(3), 1981.
   https://doi.org/10.1214/aos/1176345462
.. [2] S. A. Julious, "Sample sizes for clinical trials with normal data", Statistics in Medicine 23(12), 2004, section
   on non-inferiority. https://doi.org/10.1002/sim.1783
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri, stdtrit

from kpbench.errors import DataError
from kpbench.scoring.bootstrap import TAIL, sum_by_scene
from kpbench.scoring.comparison import require_same_truth
from kpbench.scoring.metrics import LABELS, RATIOS, SUMS, compute_ratios
from kpbench.scoring.scores import Scores
from kpbench.types import Float

POWER = 0.9
"""Probability that a comparison of two equally good detectors shows that the first is no worse by more than a margin.
"""


@dataclass(frozen=True)
class ScenePlan:
    """The number of scenes that one value of a comparison needs.

    Attributes
    ----------
    condition : str or None
        None for all images.
    rung : float or None
        None for all images.
    metric : str
        One of the metrics that are ratios of counts.
    margin : float
        The margin, in the unit of the metric.
    pilot_scenes : int
        Number of scenes in the pilot.
    sigma : float or None
        Standard deviation between scenes, in the unit of the metric. None if undefined.
    scenes : int or None
        Number of scenes needed. None if the pilot shows no spread between scenes.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.scoring.ScenePlan("blur", 7, "f1", 0.01, 20, 0.1, 387).to_dict()["scenes"]
    387
    """

    condition: str | None
    rung: float | None
    metric: str
    margin: float
    pilot_scenes: int
    sigma: float | None
    scenes: int | None

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of ``plans`` in the file of the plan."""
        return dict(vars(self))


def plan_scenes(
    first: Scores, second: Scores | None = None, *, margin: float, metric: str = "detection_score"
) -> list[ScenePlan]:
    """Compute the number of scenes for a margin, over all images and for each condition and rung.

    With one detector, half the width of the 95 % interval of the metric is at most the margin. With two detectors that
    are equally good, the interval of the paired difference shows with probability 0.9 that the first is no worse by
    more than the margin [2]_. The standard deviation between scenes comes from the jackknife [1]_.

    Parameters
    ----------
    first, second : Scores
        Scores of the pilot, with the same truth and settings. None as `second` plans for one detector.
    margin : float
        The margin, in the unit of the metric.
    metric : str
        A metric that is a ratio of counts.

    Returns
    -------
    list of ScenePlan
        The plan over all images, then the plans of the conditions and rungs.

    Raises
    ------
    DataError
        If the margin is not positive, the metric is no ratio of counts, the truths differ, or the pilot has fewer than
        two scenes or shows no spread between its scenes.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> [plan] = kpbench.scoring.plan_scenes(scores, margin=0.05)
    >>> plan.scenes > 2
    True
    """
    if not (margin > 0 and np.isfinite(margin)):
        raise DataError(f"the margin is {margin:g}, expected a positive number")
    if metric not in RATIOS:
        raise DataError(f"there is no plan for {metric}, only for {', '.join(RATIOS)}")
    sums = first.outcomes.image_sums
    if second is not None:
        require_same_truth(first, second)
        sums = np.hstack([sums, second.outcomes.image_sums])

    def statistic(sums: Float) -> Float:
        parts = (sums[..., k : k + len(SUMS)] for k in range(0, sums.shape[-1], len(SUMS)))
        one, *other = (compute_ratios(part, first.settings.matching)[metric] for part in parts)
        return one - other[0] if other else one

    truth, plans = first.outcomes.truth, []
    for condition, rung in [(None, None), *((name, r) for name, rungs in first.conditions.items() for r in rungs)]:
        rows = np.ones(len(truth), bool) if condition is None else (truth.condition == condition) & (truth.rung == rung)
        scenes = sum_by_scene(sums[rows], truth.scene_id[rows])
        without_one = statistic(scenes.sum(axis=0) - scenes)
        spread = without_one[np.isfinite(without_one)]
        sigma = (len(spread) - 1) * float(np.std(spread, ddof=1)) if len(spread) > 1 else None
        needed = None if sigma is None or sigma < 1e-12 else count_scenes(sigma, margin, paired=second is not None)
        plans.append(ScenePlan(condition, rung, metric, margin, len(scenes), sigma, needed))
    if plans[0].scenes is None:
        raise DataError(
            f"{LABELS[metric]} has no spread between the {plans[0].pilot_scenes} scenes of the pilot, "
            "expected a pilot of more or harder scenes"
        )
    return plans


def count_scenes(sigma: float, margin: float, *, paired: bool) -> int:
    """Compute the smallest number of scenes for a margin.

    Parameters
    ----------
    sigma : float
        Standard deviation between scenes of the metric, or of its paired difference.
    margin : float
        The margin, in the unit of ``sigma``.
    paired : bool
        False: half the 95 % interval is at most the margin. True: the interval of the difference of two equally good
        detectors excludes the margin with probability 0.9.

    Examples
    --------
    >>> from kpbench.scoring.planning import count_scenes
    >>> count_scenes(0.1, 0.01, paired=False), count_scenes(0.1, 0.01, paired=True)
    (387, 1053)
    """
    levels = np.array([1 - TAIL, POWER] if paired else [1 - TAIL])
    scenes = max(2, int((ndtri(levels).sum() * sigma / margin) ** 2))  # too few, because Student's t is wider
    while stdtrit(scenes - 1, levels).sum() * sigma > margin * np.sqrt(scenes):
        scenes += 1
    return scenes
