"""Score detections against true keypoints: the paper's three metrics and more.

Conventions
-----------
A detection can match a true keypoint if their distance is **at most** the matching threshold: ε times the radius of
*that* keypoint's projected circle (:class:`kpbench.scoring.Settings`). One detection is matched to one keypoint. The
best one-to-one assignment has the most matches, then the highest scores, then the smallest sum of distances. If several
assignments are equally good, the x coordinates decide, then the y coordinates. Identities do not influence the matches.
The order of images, keypoints and detections does not influence the matches.

Each step has a module. ``assignment`` finds the matches, and ``outcomes`` judges each keypoint and detection.
``metrics`` computes metrics, ``bootstrap`` computes intervals, and ``groups`` computes both for each group.
This module puts the scores together. ``docs/reference/metrics.md`` describes each metric with its edge cases.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np

from kpbench.errors import GateFailed, PredictionsError
from kpbench.scoring.assignment import MATCHED, count_matches
from kpbench.scoring.groups import Group, GroupKey, as_written, make_groups
from kpbench.scoring.metrics import SUMS, count_above_thresholds
from kpbench.scoring.outcomes import Outcomes, Settings, match_predictions
from kpbench.scoring.reliability import compute_reliability
from kpbench.scoring.slices import compute_slices
from kpbench.scoring.uncertainty import compute_nees_by_sigma
from kpbench.types import Detections, Predictions, Truth

SCHEMA = "kpbench.scores/1"
"""Name and version of the format of scores files."""
EPS_GRID = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0)
"""The values of ε, in radii, at which a detector is scored for :attr:`Scores.eps_curve`."""
CURVE_POINTS = 201
"""Largest number of points of a precision-recall curve. Longer curves are thinned."""


@dataclass(frozen=True)
class Scores:
    """The result of :func:`kpbench.score`.

    Attributes
    ----------
    overall : Group
        The metrics over all images.
    by : tuple of Group
        The metrics of each condition and rung. If the truth has several patches, also the metrics of each patch, within
        each condition and rung and over all images. If radii fall into several bins, also the metrics of each bin.
    confusion : dict
        The identities of matched detections. ``ids`` holds the true IDs, sorted. ``matrix`` counts matches. Each row
        is a true ID, and each column but the last is a detected ID, both in the order of ``ids``. The last column
        counts detected IDs that no true keypoint has, and contradicted IDs (see :class:`kpbench.scoring.Matches`). The
        dict is empty for a detector without identities.
    curve : dict
        ``score`` holds score thresholds in falling order. ``precision``, ``recall`` and ``average_false_alarm`` are the
        metrics of the detections at or above each threshold. The curve has at most 201 points.
    outcomes : Outcomes
        The outcome of every true keypoint and every detection.
    name : str
        Name and version of the detector, for tables and charts.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> round(scores["detection_score"], 3), scores["average_false_alarm"], scores.name
    (0.957, 0.0, 'oracle')
    """

    overall: Group
    by: tuple[Group, ...]
    confusion: dict[str, Any]
    curve: dict[str, list[float | None]]
    outcomes: Outcomes = field(repr=False)
    name: str = "detector"

    def __getitem__(self, name: str) -> float | None:
        """Return a metric over all images."""
        return self.overall.metrics[name]

    @property
    def settings(self) -> Settings:
        """The settings of the score."""
        return self.outcomes.settings

    @property
    def detector(self) -> dict[str, Any]:
        """The description of the detector in the predictions."""
        return self.outcomes.detector

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the dataset; "" if unknown."""
        return self.outcomes.truth.fingerprint

    def group(self, condition: str | None, rung: float | None, patch_id: int | None = None) -> Group | None:
        """Return the group of a condition, rung and patch, or None if the scores have no such group."""
        return next((g for g in self.by if g.key == GroupKey(condition, rung, patch_id)), None)

    @property
    def conditions(self) -> dict[str, list[float]]:
        """The rungs of each condition that has rungs, sorted. Conditions are in the order of their first images."""
        names = dict.fromkeys(self.outcomes.truth.condition.tolist())
        rungs: dict[str, list[float]] = {name: [] for name in names if name}
        for g in self.by:
            if g.condition is not None and g.rung is not None and g.patch_id is None:
                rungs[g.condition].append(g.rung)
        return {name: sorted(values) for name, values in rungs.items() if values}

    @cached_property
    def eps_curve(self) -> dict[str, list[float | None]]:
        """``detection_score`` and ``average_false_alarm`` of one-to-one matching at several values of ``eps``."""
        outcomes = self.outcomes
        truths, detections, images = len(outcomes.truth_id), len(outcomes.detections.xy), len(outcomes.truth)
        counts = count_matches(outcomes.truth_points, outcomes.detections, EPS_GRID)
        return {
            "eps": list(EPS_GRID),
            "detection_score": [n / truths if truths else None for n in counts],
            "average_false_alarm": [(detections - n) / images for n in counts],
        }

    @cached_property
    def nees_by_sigma(self) -> list[dict[str, Any]]:
        """``nees`` with its interval in each quintile of the predicted standard deviation; empty without covariances.

        ``sigma_px`` is the range of the standard deviations, ``matched`` the number of matched keypoints.
        """
        return compute_nees_by_sigma(self.outcomes)

    @cached_property
    def reliability(self) -> dict[str, Any]:
        """The calibration of the score over all images: :func:`kpbench.scoring.reliability.compute_reliability`."""
        return compute_reliability(self.outcomes.detections.score, self.outcomes.matches.kind == MATCHED)

    @cached_property
    def slices(self) -> list[dict[str, Any]]:
        """The detection score by tilt, contrast and visible share: :func:`kpbench.scoring.slices.compute_slices`."""
        return compute_slices(self.outcomes)

    def rows(self) -> list[dict[str, Any]]:
        """Return a flat table: a row over all images, then a row per group.

        The columns of interval bounds end in ``_low`` and ``_high``.
        """
        return [
            {"condition": g.condition, "rung": g.rung, "patch_id": g.patch_id}
            | dict(zip(("radius_px_low", "radius_px_high"), g.key.radius_px or (None, None), strict=True))
            | g.metrics
            | g.counts
            | {
                f"{name}_{end}": interval and interval[k]
                for name, interval in g.intervals.items()
                for k, end in enumerate(("low", "high"))
            }
            for g in (self.overall, *self.by)
        ]

    def image_rows(self) -> list[dict[str, Any]]:
        """Return a table for pandas: a row per image, with its condition, rung, scene and counts."""
        truth = self.outcomes.truth
        return [
            {"image_id": image_id, "scene_id": scene_id, "condition": condition or None, "rung": as_written(rung)}
            | dict(zip(SUMS[1:], counts[1:], strict=True))
            for image_id, scene_id, condition, rung, counts in zip(
                truth.image_id.tolist(),
                truth.scene_id.tolist(),
                truth.condition.tolist(),
                truth.rung.tolist(),
                self.outcomes.image_sums.tolist(),
                strict=True,
            )
        ]

    @property
    def truth_error(self) -> dict[str, float]:
        """Errors of the truth of labelled photographs: median standard deviation, and keypoints that they limit."""
        table = self.outcomes.truth.keypoints
        sigma = np.sqrt((table["sigma_x"].astype(float) ** 2 + table["sigma_y"].astype(float) ** 2) / 2)
        median = float(np.median(sigma)) if len(sigma) else 0.0
        return {"sigma_median_px": median, "limited": int(self.outcomes.truth_limited.sum())}

    @property
    def ignored(self) -> dict[str, int]:
        """Number of ignored ``patches`` in the images, and of ``detections`` at them, which count neither way."""
        patches = self.outcomes.truth.ignored
        return {"patches": 0 if patches is None else len(patches), "detections": self.outcomes.ignored_detections}

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the scores file (``kpbench.scores/1``), without provenance."""
        return {
            "schema": SCHEMA,
            "dataset": {
                "fingerprint": self.fingerprint or None,
                "images": self.overall.counts["images"],
                **({} if self.outcomes.truth_points.least_reach_px is None else {"truth": self.truth_error}),
                **({"ignored": self.ignored} if self.ignored["patches"] else {}),
            },
            "detector": self.detector,
            "settings": asdict(self.settings),
            "metrics": self.overall.to_dict(),
            "by": [{**g.key._asdict(), "metrics": g.to_dict()} for g in self.by],
            "confusion": self.confusion,
            "curve": self.curve,
            "eps_curve": self.eps_curve,
            "nees_by_sigma": self.nees_by_sigma,
            "reliability": self.reliability,
            "slices": self.slices,
        }


def _count_confusions(outcomes: Outcomes) -> dict[str, Any]:
    """Return :attr:`Scores.confusion`."""
    patch_id, matches, matched = outcomes.detections.patch_id, outcomes.matches, outcomes.matched
    if patch_id is None:
        return {}
    ids, row = np.unique(outcomes.truth_id, return_inverse=True)
    detected = patch_id[matches.detection[matched]]
    column = np.searchsorted(ids, detected)
    known = np.append(ids, -1)[column] == detected
    known &= ~matches.contradicted[matched]
    cell = row[matched] * (len(ids) + 1) + np.where(known, column, len(ids))
    matrix = np.bincount(cell, minlength=len(ids) * (len(ids) + 1)).reshape(len(ids), len(ids) + 1)
    return {"ids": ids.tolist(), "matrix": matrix.tolist()}


def _trace_curve(outcomes: Outcomes) -> dict[str, list[float | None]]:
    """Return :attr:`Scores.curve`."""
    truths = len(outcomes.truth_id)
    rows = outcomes.ranking
    hit = outcomes.matches.kind[rows] == MATCHED
    threshold, matches, detections = count_above_thresholds(outcomes.detections.score[rows], hit)
    points = CURVE_POINTS if len(threshold) else 0
    rows = np.unique(np.linspace(0, len(threshold) - 1, points).astype(int))
    threshold, matches, detections = threshold[rows], matches[rows], detections[rows]
    return {
        "score": threshold.tolist(),
        "precision": (matches / detections).tolist(),
        "recall": (matches / truths).tolist() if truths else [None] * len(rows),
        "average_false_alarm": ((detections - matches) / len(outcomes.truth)).tolist(),
    }


class HasTruth(Protocol):
    """The part of a dataset that :func:`kpbench.score` uses."""

    @property
    def truth(self) -> Truth:
        """The true keypoints of all images."""
        ...


def score(
    truth: Truth | HasTruth,
    detections: Predictions | Iterable[Detections],
    *,
    eps: float = 0.1,
    eps_radius: Literal["major", "minor", "mean"] = "major",
    matching: Literal["one-to-one", "literal"] = "one-to-one",
    allow_missing: bool = False,
    resamples: int = 1000,
    seed: int = 0,
) -> Scores:
    """Score detections against true keypoints.

    Parameters
    ----------
    truth : Truth or Dataset
    detections : Predictions or iterable of Detections
        Predictions, or one :class:`kpbench.Detections` per image of the truth, in the truth's order.
    eps, eps_radius, matching, resamples, seed
        As in :class:`kpbench.scoring.Settings`.
    allow_missing : bool
        Whether to accept an image that the predictions lack, as an image without detections. If False, such an image
        is an error.

    Returns
    -------
    Scores

    Raises
    ------
    PredictionsError
        If the predictions name unknown images, lack images, or name the fingerprint of another dataset, or if the
        names of files contradict the image IDs.
    DataError
        If the truth has no images, two of its images share an image_id, a place is not finite, or a radius is not a
        positive number.
    ValueError
        If a setting is out of its range.

    Notes
    -----
    The function below computes the paper's three metrics from one-to-one matching. It is short but slow, because it
    tries every assignment. A test checks that ``score`` gives the same numbers.

    >>> from itertools import permutations
    >>> from math import hypot
    >>> def reference_metrics(images, eps):
    ...     truths = detections = matched = correct = 0
    ...     for keypoints, found in images:  # rows (x, y, radius, ID) and rows (x, y, score, ID)
    ...         best = (0, [], 0.0), []
    ...         none = [None] * len(keypoints)
    ...         for chosen in permutations([*found, *none], len(keypoints)):
    ...             pairs = [(k, d) for k, d in zip(keypoints, chosen) if d is not None]
    ...             distances = [hypot(k[0] - d[0], k[1] - d[1]) for k, d in pairs]
    ...             if all(distance <= eps * k[2] for distance, (k, _) in zip(distances, pairs)):
    ...                 scores = sorted((d[2] for _, d in pairs), reverse=True)
    ...                 best = max(best, ((len(pairs), scores, -sum(distances)), pairs), key=lambda b: b[0])
    ...         truths, detections, matched = truths + len(keypoints), detections + len(found), matched + len(best[1])
    ...         for k, d in best[1]:  # a second ID at the same place with the same score makes both wrong
    ...             correct += {other[3] for other in found if other[:3] == d[:3]} == {k[3]}
    ...     return {
    ...         "detection_score": matched / truths if truths else None,
    ...         "id_matching_score": correct / matched if matched else None,
    ...         "average_false_alarm": (detections - matched) / len(images),
    ...     }

    In the paper's own formulas (`matching` "literal"), all detections of one keypoint count as matches. So the
    detection score is never lower than with one-to-one matching, and the average false alarm is never higher.

    Examples
    --------
    >>> import kpbench
    >>> dataset, predictions = kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json")
    >>> scores = kpbench.score(dataset, predictions)
    >>> scores.overall.counts["matched"], scores.overall.counts["missed"], scores["id_matching_score"]
    (22, 1, 1.0)
    """
    settings = Settings(eps, eps_radius, matching, resamples, seed)
    table = truth if isinstance(truth, Truth) else truth.truth
    if not isinstance(detections, Predictions):
        listed = list(detections)
        if len(listed) != len(table):
            raise PredictionsError(f"detections of {len(listed)} images, expected detections of {len(table)} images")
        detections = Predictions.from_detections(listed, table.image_id)
    return compute_scores(match_predictions(table, detections, settings, allow_missing=allow_missing))


def compute_scores(outcomes: Outcomes) -> Scores:
    """Compute all metrics of all groups from matched predictions.

    Examples
    --------
    >>> import kpbench
    >>> truth = kpbench.open_dataset("kpbench-data").truth
    >>> outcomes = kpbench.scoring.match_predictions(truth, kpbench.read_predictions("preds.json"))
    >>> kpbench.scoring.compute_scores(outcomes)["precision"]
    1.0
    """
    overall, *by = make_groups(outcomes)
    about = (str(outcomes.detector.get(key) or "") for key in ("name", "version"))
    name = " ".join(part for part in about if part not in ("", "unknown"))
    return Scores(overall, tuple(by), _count_confusions(outcomes), _trace_curve(outcomes), outcomes, name or "detector")


class Measured(Protocol):
    """Scores whose metrics over all images can be asked for by name."""

    def __getitem__(self, metric: str) -> float | None:
        """Return a metric; None if it is undefined."""
        ...


def check_gates(scores: Measured, least: dict[str, float], most: dict[str, float]) -> None:
    """Raise an error if a metric misses its limit. An undefined metric misses every limit.

    Parameters
    ----------
    scores : Scores or kpbench.tracking.TrackScores
    least, most : dict of str to float
        Smallest and largest accepted value of metrics over all images, by name of the metric.

    Raises
    ------
    GateFailed
        If a metric is undefined, below its value in ``least`` or above its value in ``most``. The message names every
        such metric.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.scoring.check_gates(scores, least={"detection_score": 0.9}, most={"average_false_alarm": 0.5})
    """
    failed = []
    for limits, sign, relation in ((least, 1, "at least"), (most, -1, "at most")):
        for name, limit in limits.items():
            value = scores[name]
            if value is None or sign * value < sign * limit:
                shown = "undefined" if value is None else f"{value:.6g}"
                failed.append(f"{name} is {shown}, expected {relation} {limit:g}")
    if failed:
        raise GateFailed("; ".join(failed))
