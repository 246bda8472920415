"""The evaluator: true keypoints and detections in, the paper's three metrics and more out. No files here.

Conventions
-----------
A detection reaches a true keypoint if their distance is **at most** ε, a fraction of the radius of *that*
keypoint's projected circle (:class:`kpbench.scoring.Settings`). One detection explains one keypoint only: of all
one-to-one assignments the one with most matches is taken, among those the one with the highest scores, then the one
with the smallest distances, then the one lower in (x, y). Identities never decide who is matched, and the
order of images, keypoints and detections changes nothing.

The chain is assignment (who explains whom) → tally (rows) → metrics and bootstrap (numbers from sums) → this module
(groups of images). ``docs/metrics.md`` describes each metric with its edge cases.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import GateFailed, PredictionsError
from kpbench.scoring.assignment import MATCHED, matched_within
from kpbench.scoring.bootstrap import Interval, by_scene, intervals
from kpbench.scoring.metrics import COUNTS, METRICS, SUMS, error_metrics, precision_recall, ratios
from kpbench.scoring.outcomes import Settings, Tally, tally
from kpbench.types import Detections, Predictions, Truth

SCHEMA = "kpbench.scores/1"
RADIUS_EDGES_PX = (0, 5, 10, 20, 40, 80, np.inf)  # bins are low < radius <= high
EPS_GRID = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0)
ENDS = ("low", "high")

Int = NDArray[np.int64]

_OF_DETECTIONS = {"average_false_alarm", "average_false_alarm_literal", "precision", "f1", "average_precision"}
_OF_IDS = {"id_matching_score", "id_matching_score_literal"}


class Key(NamedTuple):
    """What a group is of; None stands for all."""

    condition: str | None = None
    rung: float | None = None
    patch_id: int | None = None
    radius_px: tuple[float, float | None] | None = None  # low < radius <= high, None for no limit


@dataclass(frozen=True)
class Group:
    """Metrics of some of the images, or of some keypoints in them.

    Attributes
    ----------
    key : Key
        ``condition``, ``rung``, ``patch_id`` and ``radius_px`` of the group, each also an attribute of its own.
    metrics : dict of str to float or None
        The names of :data:`kpbench.scoring.METRICS`; None where a metric is undefined (0/0) or the group does not
        have it.
    counts : dict of str to int or None
        The names of :data:`kpbench.scoring.COUNTS`; None as above.
    intervals : dict of str to (low, high) or None
        95 % bootstrap intervals of the metrics that are ratios of counts.
    """

    key: Key
    metrics: dict[str, float | None]
    counts: dict[str, int | None]
    intervals: dict[str, Interval | None]

    @property
    def condition(self) -> str | None:
        """Name of the experiment."""
        return self.key.condition

    @property
    def rung(self) -> float | None:
        """Severity within the condition."""
        return self.key.rung

    @property
    def patch_id(self) -> int | None:
        """Identity of the true keypoints."""
        return self.key.patch_id

    def to_dict(self) -> dict[str, Any]:
        """The group's ``metrics`` object of the scores file."""
        return {**self.metrics, "counts": self.counts, "intervals": self.intervals}


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


class _Rows(NamedTuple):
    """What groups are cut from: M rows (images, or keypoints of one kind in them) of a tally."""

    tally: Tally
    sums: Int  # (M, 9)
    scene: Int  # (M,)
    of_truth: Int  # (T,) the row of each
    of_detection: Int  # (D,) the row of each, or -1
    mixed: NDArray[np.bool_]  # (M,) whether detections cannot be told to belong to the row

    def cut(self, keys: list[Key], label: Int) -> Iterator[Group]:
        """A group for each key; ``label`` (M,) is the place in ``keys`` of each row."""
        labelled = np.append(label, -1)
        whole = np.bincount(label, self.mixed, minlength=len(keys)) == 0
        parts = [_split(part, len(keys)) for part in (label, labelled[self.of_truth], labelled[self.of_detection])]
        for key, r, t, d, fine in zip(keys, *parts, whole.tolist(), strict=True):
            yield self._group(key, self.sums[r], self.scene[r], t, d, fine)

    def _group(self, key: Key, sums: Int, scene: Int, truths: Int, detections: Int, whole: bool) -> Group:
        rows, settings = self.tally, self.tally.settings
        total = sums.sum(axis=0)
        metrics: dict[str, float | None] = {
            name: None if np.isnan(value) else float(value) for name, value in ratios(total, settings.matching).items()
        }
        hit = rows.kind[detections] == MATCHED
        metrics["average_precision"] = precision_recall(rows.score[detections], hit, int(total[1]))[0]
        truths = truths[rows.matched[truths]]
        metrics |= error_metrics(rows.distance[truths], rows.radius[truths])
        units = by_scene(sums, scene)
        spread = intervals(units, lambda s: ratios(s, settings.matching), settings.resamples, settings.seed)
        n: dict[str, Any] = dict(zip(SUMS, total.tolist(), strict=True))
        n |= {
            "scenes": len(units),
            "wrong_id": n["matched"] - n["id_correct"],
            "missed": n["truths"] - n["matched"],
            "clutter": n["detections"] - n["matched"] - n["duplicate"] - n["near_miss"],
        }
        void = (set() if whole else _OF_DETECTIONS | {"detections", "duplicate", "near_miss", "clutter"}) | (
            _OF_IDS | {"id_correct", "wrong_id", "id_correct_literal"} if rows.patch_id is None else set()
        )
        return Group(
            key,
            metrics={name: None if name in void else metrics[name] for name in METRICS},
            counts={name: None if name in void else n[name] for name in COUNTS},
            intervals={name: None if name in void else value for name, value in spread.items()},
        )


def _groups(rows: Tally) -> Iterator[Group]:
    """Overall; each condition and rung; each patch within them and over all images; each bin of radii."""
    truth, n = rows.truth, len(rows.truth)
    images = _Rows(rows, rows.image_sums, truth.scene_id, rows.truth_image, rows.image, np.zeros(n, bool))
    yield from images.cut([Key()], np.zeros(n, np.int64))

    conditions, condition = np.unique(truth.condition, return_inverse=True)
    rungs, rung = np.unique(truth.rung, return_inverse=True)
    codes, code = np.unique(condition * len(rungs) + rung, return_inverse=True)
    keys = [Key(str(conditions[c // len(rungs)]) or None, _whole(rungs[c % len(rungs)])) for c in codes]
    parted = keys != [Key()]
    if parted:  # images without a condition, beside others that have one, are no group: it would read as all of them
        yield from (group for group in images.cut(keys, code) if group.key != Key())

    patches, patch = np.unique(rows.truth_id, return_inverse=True)
    if len(patches) > 1:
        of_image, of_patch, units = _units(rows, patch, len(patches))
        if parted:
            codes, label = np.unique(code[of_image] * len(patches) + of_patch, return_inverse=True)
            both = [keys[c // len(patches)]._replace(patch_id=int(patches[c % len(patches)])) for c in codes]
            yield from (group for group in units.cut(both, label) if group.key._replace(patch_id=None) != Key())
        yield from units.cut([Key(patch_id=int(p)) for p in patches], of_patch)

    bins, size = np.unique(np.searchsorted(RADIUS_EDGES_PX, rows.radius) - 1, return_inverse=True)
    if len(bins) > 1:
        _, of_size, units = _units(rows, size, len(bins))
        edges = [(RADIUS_EDGES_PX[b], RADIUS_EDGES_PX[b + 1]) for b in bins]
        spans = [(low, None if np.isinf(high) else high) for low, high in edges]
        yield from units._replace(mixed=np.ones(len(of_size), bool)).cut([Key(radius_px=s) for s in spans], of_size)


def _units(rows: Tally, label: Int, labels: int) -> tuple[Int, Int, _Rows]:
    """Keypoints of one label in one image as rows; gives their images, their labels, and the rows.

    A false alarm has no label of its own: it belongs to the label of the image's keypoints if they share one.
    """
    n = len(rows.truth)
    unit, of_truth = np.unique(rows.truth_image * labels + label, return_inverse=True)
    of_image, of_label = unit // labels, unit % labels
    mixed = (np.bincount(of_image, minlength=n) > 1)[of_image]
    owner = np.full(n, -1)
    owner[of_image[~mixed]] = np.flatnonzero(~mixed)
    of_detection = owner[rows.image]
    sums = rows.sums(of_truth, of_detection, len(unit))
    return of_image, of_label, _Rows(rows, sums, rows.truth.scene_id[of_image], of_truth, of_detection, mixed)


def _split(label: Int, groups: int) -> list[Int]:
    """Rows of each label 0 … groups - 1, in their order; others are left out."""
    if groups < 2**15:
        label = label.astype(np.int16)  # which numpy sorts in linear time
    order = np.argsort(label, kind="stable")
    edges = np.searchsorted(label[order], np.arange(groups + 1))
    return [order[a:b] for a, b in pairwise(edges.tolist())]


def _whole(rung: float) -> float | None:
    """A rung as it is written: 15, not 15.0; None for nan."""
    if np.isnan(rung):
        return None
    return int(rung) if float(rung).is_integer() else float(rung)


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
    overall, *by = _groups(rows)
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
