"""The evaluator: true keypoints and detections in, the paper's three metrics and more out. No files here.

Conventions
-----------
A detection reaches a true keypoint if their distance is **at most** ε, a fraction of the radius of *that*
keypoint's projected circle (:class:`kpbench.scoring.Settings`). One detection explains one keypoint only: of all
one-to-one assignments the one with most matches is taken, among those the one with the highest scores, then the one
with the smallest distances, then the one lower in (x, y). Identities never decide who is matched, and the
order of images, keypoints and detections changes nothing.

The chain is assignment (who explains whom) → tally (rows) → metrics and bootstrap (numbers from sums) → this module
(groups of images). ``docs/reference/metrics.md`` describes each metric with its edge cases.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np

from kpbench.errors import GateFailed, PredictionsError
from kpbench.scoring.assignment import MATCHED, matched_within
from kpbench.scoring.groups import Group, Key, make_groups
from kpbench.scoring.metrics import precision_recall
from kpbench.scoring.outcomes import Settings, Tally, tally
from kpbench.types import Detections, Predictions, Truth

SCHEMA = "kpbench.scores/1"
EPS_GRID = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0)
ENDS = ("low", "high")


@dataclass(frozen=True)
class Scores:
    """What :func:`score` returns.

    Attributes
    ----------
    overall : Group
    by : tuple of Group
        A group for each condition and rung; where the truth has several patches, also for each of them within
        the condition and rung, and for each over all images; and for each bin of radii over all images.
    confusion : dict
        ``ids`` (true ones, sorted) and ``matrix``: a row a true id, a column a detected id of a matched
        detection, and a last column for ids that no true keypoint has or that are contradicted. Empty
        without identities.
    curve : dict
        ``score``, ``precision``, ``recall`` and ``average_false_alarm`` when only detections of at least that
        score are kept, from the surest on; at most 201 points.
    tally : Tally
        The rows behind the numbers, of every true keypoint and detection.
    name : str
        What tables and charts call the detector: its name and version.
    """

    overall: Group
    by: tuple[Group, ...]
    confusion: dict[str, Any]
    curve: dict[str, list[float | None]]
    tally: Tally = field(repr=False)
    name: str = "detector"

    def __getitem__(self, name: str) -> float | None:
        """A metric over all images."""
        return self.overall.metrics[name]

    @property
    def settings(self) -> Settings:
        """How it was scored."""
        return self.tally.settings

    @property
    def detector(self) -> dict[str, Any]:
        """What the predictions file says about the detector."""
        return self.tally.detector

    @property
    def fingerprint(self) -> str:
        """Of the dataset, "" if unknown."""
        return self.tally.truth.fingerprint

    def group(self, condition: str | None, rung: float | None, patch_id: int | None = None) -> Group | None:
        """The group of a condition, rung and patch, or None if there is none."""
        return next((g for g in self.by if g.key == Key(condition, rung, patch_id)), None)

    @property
    def conditions(self) -> dict[str, list[float]]:
        """Rungs of every condition that has any, rising, conditions in the order of the first image."""
        names = dict.fromkeys(self.tally.truth.condition.tolist())
        rungs: dict[str, list[float]] = {name: [] for name in names if name}
        for g in self.by:
            if g.condition is not None and g.rung is not None and g.patch_id is None:
                rungs[g.condition].append(g.rung)
        return {name: sorted(values) for name, values in rungs.items() if values}

    @cached_property
    def eps_curve(self) -> dict[str, list[float | None]]:
        """``detection_score`` and ``average_false_alarm`` of one-to-one matching when ``eps`` is another."""
        rows = self.tally
        keypoints, truths = rows.truth.keypoints, len(rows.truth_id)
        xy = np.stack([keypoints["x"], keypoints["y"]], axis=1).astype(np.float64)
        counts = matched_within(xy, rows.truth_image, rows.radius, EPS_GRID, rows.xy, rows.score, rows.image)
        return {
            "eps": list(EPS_GRID),
            "detection_score": [n / truths if truths else None for n in counts],
            "average_false_alarm": [(len(rows.xy) - n) / len(rows.truth) for n in counts],
        }

    def rows(self) -> list[dict[str, Any]]:
        """A flat table: one row a group, the first overall; bounds end in ``_low`` and ``_high``."""
        return [
            {"condition": g.condition, "rung": g.rung, "patch_id": g.patch_id}
            | dict(zip(("radius_px_low", "radius_px_high"), g.key.radius_px or (None, None), strict=True))
            | g.metrics
            | g.counts
            | {f"{name}_{end}": both and both[k] for name, both in g.intervals.items() for k, end in enumerate(ENDS)}
            for g in (self.overall, *self.by)
        ]

    def to_dict(self) -> dict[str, Any]:
        """The scores file (``kpbench.scores/1``), without provenance."""
        return {
            "schema": SCHEMA,
            "dataset": {"fingerprint": self.fingerprint or None, "images": self.overall.counts["images"]},
            "detector": self.detector,
            "settings": asdict(self.settings),
            "metrics": self.overall.to_dict(),
            "by": [{**g.key._asdict(), "metrics": g.to_dict()} for g in self.by],
            "confusion": self.confusion,
            "curve": self.curve,
            "eps_curve": self.eps_curve,
        }


# --- groups -----------------------------------------------------------------------------------------------------


def _confusion(rows: Tally) -> dict[str, Any]:
    if rows.patch_id is None:
        return {}
    matched = rows.matched
    ids, row = np.unique(rows.truth_id, return_inverse=True)
    detected = rows.patch_id[rows.detection[matched]]
    column = np.searchsorted(ids, detected)
    known = np.append(ids, -1)[column] == detected
    known &= ~rows.contradicted[matched]
    cell = row[matched] * (len(ids) + 1) + np.where(known, column, len(ids))
    matrix = np.bincount(cell, minlength=len(ids) * (len(ids) + 1)).reshape(len(ids), len(ids) + 1)
    return {"ids": ids.tolist(), "matrix": matrix.tolist()}


def _curve(rows: Tally) -> dict[str, list[float | None]]:
    truths = len(rows.truth_id)
    _, level, hits, kept = precision_recall(rows.score, rows.kind == MATCHED, truths)
    some = np.unique(np.linspace(0, len(level) - 1, 201).astype(int)) if len(level) else np.zeros(0, int)
    level, hits, kept = level[some], hits[some], kept[some]
    return {
        "score": level.tolist(),
        "precision": (hits / kept).tolist(),
        "recall": (hits / truths).tolist() if truths else [None] * len(some),
        "average_false_alarm": ((kept - hits) / len(rows.truth)).tolist(),
    }


# --- the public calls -------------------------------------------------------------------------------------------


class HasTruth(Protocol):
    """What a dataset offers to the evaluator."""

    @property
    def truth(self) -> Truth:
        """The true keypoints."""
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
    detections : Predictions, or one Detections for each image of the truth, in its order
    eps, eps_radius, matching, resamples, seed
        See :class:`kpbench.scoring.Settings`.
    allow_missing : bool
        Take an image without prediction as one without detections, instead of refusing it.

    Raises
    ------
    PredictionsError
        If the predictions are for other images than the truth's, or for another dataset by its fingerprint.
    DataError
        If the truth holds radii or places that are no positive finite numbers.
    ValueError
        If a setting is out of its range.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> scores["detection_score"], scores.overall.intervals["detection_score"]
    """
    settings = Settings(eps, eps_radius, matching, resamples, seed)
    table = truth if isinstance(truth, Truth) else truth.truth
    if not isinstance(detections, Predictions):
        listed = list(detections)
        if len(listed) != len(table):
            raise PredictionsError(
                f"{len(listed)} images with detections, expected one for each of {len(table)} images"
            )
        detections = Predictions.from_detections(listed, table.image_id)
    return evaluate(table, detections, settings, allow_missing=allow_missing)


def evaluate(
    truth: Truth, predictions: Predictions, settings: Settings | None = None, *, allow_missing: bool = False
) -> Scores:
    """As :func:`score`, on the tables themselves."""
    return summarise(tally(truth, predictions, settings, allow_missing=allow_missing))


def summarise(rows: Tally) -> Scores:
    """All metrics of a tally."""
    overall, *by = make_groups(rows)
    told = (str(rows.detector.get(key) or "") for key in ("name", "version"))
    name = " ".join(part for part in told if part not in ("", "unknown"))
    return Scores(overall, tuple(by), _confusion(rows), _curve(rows), rows, name or "detector")


def check_gates(scores: Scores, least: dict[str, float], most: dict[str, float]) -> None:
    """Hold the overall metrics against limits; an undefined metric meets none.

    Raises
    ------
    GateFailed
        Naming every metric that is below ``least`` or above ``most``.
    """
    failed = []
    for limits, sign, relation in ((least, 1, "at least"), (most, -1, "at most")):
        for name, limit in limits.items():
            value = scores[name]
            if value is None or sign * value < sign * limit:
                failed.append(
                    f"{name} is {'undefined' if value is None else f'{value:.6g}'}, expected {relation} {limit:g}"
                )
    if failed:
        raise GateFailed("; ".join(failed))
