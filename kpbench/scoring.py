"""The evaluator: true keypoints and detections in, the paper's three metrics and more out. No files here.

Conventions
-----------
A detection reaches a true keypoint if their distance is **at most** ε, a fraction of the radius of *that*
keypoint's projected circle (:class:`Settings`). One detection explains one keypoint only: of all one-to-one
assignments the one with most matches is taken, among those the one with the highest scores, then the one
with the smallest distances, then the one lower in (x, y). Identities never decide who is matched, and the
order of images, keypoints and detections changes nothing.

Metrics
-------
Each is defined by counts in :func:`_ratios`, the only place where numbers become metrics, and described
with its edge cases in ``docs/metrics.md``. What is 0/0 is undefined: None, never 0 or 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from kpbench.assignment import DUPLICATE, MATCHED, NEAR_MISS, Matches, match
from kpbench.errors import DataError, GateFailed, PredictionsError
from kpbench.keypoints import Detections, Float, Truth
from kpbench.predictions import Predictions

__all__ = ["COUNTS", "METRICS", "Group", "Matches", "Scores", "Settings", "check_gates", "evaluate", "match", "score"]

SCHEMA = "kpbench.scores/1"

Int = NDArray[np.int64]


SUMS = (
    "images",
    "truths",
    "detections",
    "matched",
    "id_correct",
    "matched_literal",
    "id_correct_literal",
    "duplicate",
    "near_miss",
)
"""What is counted an image; every count and every ratio is made of sums of these."""

RATIOS = (
    "detection_score",
    "id_matching_score",
    "average_false_alarm",
    "detection_score_literal",
    "id_matching_score_literal",
    "average_false_alarm_literal",
    "precision",
    "recall",
    "f1",
)
METRICS = (
    *RATIOS,
    "average_precision",
    "error_median_px",
    "error_p95_px",
    "error_rms_px",
    "error_median_radii",
    "error_p95_radii",
    "error_rms_radii",
)
"""Names of all metrics, as they stand in the scores file and in gates."""

COUNTS = (
    "images",
    "scenes",
    "truths",
    "detections",
    "matched",
    "id_correct",
    "wrong_id",
    "missed",
    "duplicate",
    "near_miss",
    "clutter",
    "matched_literal",
    "id_correct_literal",
)
"""Names of all counts. Truths are matched or missed; detections are matched, duplicate, near_miss or clutter."""

ENDS = ("low", "high")
MOST_KINDS = 4000  # different scenes that a bootstrap tells apart

_OF_DETECTIONS = {"average_false_alarm", "average_false_alarm_literal", "precision", "f1", "average_precision"}
_OF_IDS = {"id_matching_score", "id_matching_score_literal"}


@dataclass(frozen=True)
class Settings:
    """How to score.

    Attributes
    ----------
    eps : float
        Largest distance of a match, in radii of the true keypoint's projected circle.
    eps_radius : {"major", "minor", "mean"}
        Which semi-axis of the projected circle is the radius; "mean" is half their sum.
    matching : {"one-to-one", "literal"}
        "literal" makes the paper's formulas as printed the main ones: every detection within ε counts,
        so that a detection score can exceed 1.
    resamples : int
        Bootstrap resamples behind the intervals.
    seed : int
        Of the bootstrap.

    Raises
    ------
    ValueError
    """

    eps: float = 0.1
    eps_radius: Literal["major", "minor", "mean"] = "major"
    matching: Literal["one-to-one", "literal"] = "one-to-one"
    resamples: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.eps < np.inf:
            raise ValueError(f"eps is {self.eps}, expected a finite number of 0 or more")
        if self.eps_radius not in ("major", "minor", "mean"):
            raise ValueError(f"eps_radius is {self.eps_radius!r}, expected major, minor or mean")
        if self.matching not in ("one-to-one", "literal"):
            raise ValueError(f"matching is {self.matching!r}, expected one-to-one or literal")
        if self.resamples < 0:
            raise ValueError(f"resamples is {self.resamples}, expected 0 or more")


# --- metrics ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """Metrics of some of the images, or of the keypoints of one patch in them.

    Attributes
    ----------
    condition, rung, patch_id
        What the group is of; None stands for all.
    metrics : dict of str to float or None
        The names of :data:`METRICS`; None where a metric is undefined (0/0) or the group does not have it.
    counts : dict of str to int or None
        The names of :data:`COUNTS`; None as above.
    intervals : dict of str to (low, high) or None
        95 % bootstrap intervals of the metrics that are ratios of counts.
    """

    condition: str | None
    rung: float | None
    patch_id: int | None
    metrics: dict[str, float | None]
    counts: dict[str, int | None]
    intervals: dict[str, tuple[float, float] | None]

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
        the condition and rung, and for each over all images.
    confusion : dict
        ``ids`` (true ones, sorted) and ``matrix``: a row a true id, a column a detected id of a matched
        detection, and a last column for ids that no true keypoint has or that are contradicted. Empty
        without identities.
    curve : dict
        ``score``, ``precision``, ``recall`` and ``average_false_alarm`` when only detections of at least that
        score are kept, from the surest on; at most 201 points.
    settings : Settings
    detector : dict
    fingerprint : str
        Of the dataset, "" if unknown.
    """

    overall: Group
    by: tuple[Group, ...]
    confusion: dict[str, Any]
    curve: dict[str, list[float | None]]
    settings: Settings
    detector: dict[str, Any]
    fingerprint: str

    def __getitem__(self, name: str) -> float | None:
        """A metric over all images."""
        return self.overall.metrics[name]

    def rows(self) -> list[dict[str, Any]]:
        """A flat table: one row a group, the first overall; the bounds of an interval end in ``_low`` and ``_high``."""
        return [
            {"condition": g.condition, "rung": g.rung, "patch_id": g.patch_id}
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
            "by": [
                {"condition": g.condition, "rung": g.rung, "patch_id": g.patch_id, "metrics": g.to_dict()}
                for g in self.by
            ],
            "confusion": self.confusion,
            "curve": self.curve,
        }


def _ratios(sums: NDArray[Any], matching: str) -> dict[str, Float]:
    """Metrics from sums of shape (..., 9), each of shape (...); nan where undefined."""
    images, truths, detections, matched, id_correct, literal, id_literal = np.moveaxis(sums, -1, 0)[:7].astype(float)

    def per(part: Float, whole: Float) -> Float:
        return np.asarray(np.divide(part, whole, out=np.full(np.shape(part), np.nan), where=whole > 0))

    values = {
        "detection_score": per(matched, truths),
        "id_matching_score": per(id_correct, matched),
        "average_false_alarm": per(detections - matched, images),
        "detection_score_literal": per(literal, truths),
        "id_matching_score_literal": per(id_literal, literal),
        "average_false_alarm_literal": per(detections - literal, images),
        "precision": per(matched, detections),
        "recall": per(matched, truths),
        "f1": per(2 * matched, truths + detections),
    }
    if matching == "literal":
        values |= {name: values[f"{name}_literal"] for name in RATIOS[:3]}
    return values


def _intervals(sums: NDArray[Any], scene: Int, settings: Settings) -> tuple[int, dict[str, tuple[float, float] | None]]:
    """Number of scenes, and 95 % percentile intervals from a bootstrap over them.

    Images of one scene are not independent, so scenes are drawn, not images. Drawing C scenes with replacement
    is drawing how often each *kind* of scene (equal sums) comes up, a multinomial; so a million scenes
    cost as much as the few hundred different ones among them.
    """
    order = np.argsort(scene, kind="stable")
    starts = np.flatnonzero(np.append(True, np.diff(scene[order]) != 0)[: len(order)])
    scenes = len(starts)
    if scenes < 2 or not settings.resamples:
        return scenes, dict.fromkeys(RATIOS)
    sums = sums if scenes == len(sums) else np.add.reduceat(sums[order], starts)
    kinds, many = _unique_rows(sums)
    rng = np.random.default_rng(settings.seed)
    if len(kinds) > MOST_KINDS:  # pool scenes at random: the sums of equal-sized pools vary as much
        shuffled = np.repeat(kinds, many, axis=0)[rng.permutation(scenes)]
        kinds = np.add.reduceat(shuffled, np.linspace(0, scenes, MOST_KINDS, endpoint=False).astype(int))
        many = np.ones(MOST_KINDS, np.int64)
    drawn = rng.multinomial(many.sum(), many / many.sum(), size=settings.resamples)
    result: dict[str, tuple[float, float] | None] = {}
    for name, values in _ratios(drawn.astype(float) @ kinds, settings.matching).items():
        values = values[np.isfinite(values)]
        low, high = np.percentile(values, [2.5, 97.5]).tolist() if len(values) else (np.nan, np.nan)
        result[name] = (low, high) if len(values) else None
    return scenes, result


def _unique_rows(table: NDArray[Any]) -> tuple[NDArray[Any], Int]:
    """The different rows of a table of counts, in a fixed order, and how often each is there."""
    sizes = table.max(axis=0).astype(object) + 1
    if np.prod(sizes) >= 2**62:
        return np.unique(table, axis=0, return_counts=True)
    code = np.ravel_multi_index(tuple(table.T), tuple(int(size) for size in sizes))
    _, first, many = np.unique(code, return_index=True, return_counts=True)
    return table[first], many


def _curve(score: Float, hit: NDArray[np.bool_], truths: int) -> tuple[float | None, Float, Float, Float]:
    """Average precision, and (thresholds, matches, detections) above each, from scores that fall or stay.

    A threshold cannot split equal scores, so their order among each other does not matter.
    The assignment prefers high scores, so cutting detections off below a threshold leaves the number of matches above
    it as it is: one matching serves all thresholds.
    """
    last = np.flatnonzero(np.append(np.diff(score) != 0, True)[: len(score)])
    matched, kept = np.cumsum(hit)[last].astype(np.float64), (last + 1).astype(np.float64)
    area = float(np.sum(np.diff(matched, prepend=0.0) / truths * matched / kept)) if truths else None
    return area, score[last], matched, kept


def _split(label: Int, groups: int) -> list[Int]:
    """Rows of each label 0 … groups - 1, in their order; others are left out."""
    if groups < 2**15:
        label = label.astype(np.int16)  # which numpy sorts in linear time
    order = np.argsort(label, kind="stable")
    edges = np.searchsorted(label[order], np.arange(groups + 1))
    return [order[a:b] for a, b in pairwise(edges.tolist())]


@dataclass(frozen=True)
class _Rows:
    """Everything the metrics are made of: T true keypoints; D detections, surest first; N images."""

    # of the true keypoints, (T,)
    truth_image: Int
    truth_id: Int
    radius: Float
    distance: Float  # nan where not matched
    matched: NDArray[np.bool_]
    correct: NDArray[np.bool_]  # matched with the right identity
    # of the detections, (D,)
    image: Int
    score: Float
    kind: NDArray[np.uint8]
    nearest: Int
    literally_correct: NDArray[np.bool_]  # the nearest keypoint in reach has its identity
    has_ids: bool
    # of the images, (N,)
    scene: Int
    settings: Settings

    def sums(self, row_of_truth: Int, row_of_detection: Int, rows: int) -> NDArray[np.int64]:
        """(rows, 9) counts in the order of :data:`SUMS`; detections in row -1 are left out."""

        def count(row: Int) -> Int:
            return np.bincount(row[row >= 0], minlength=rows)

        reaching = self.nearest >= 0
        columns = [
            np.ones(rows, np.int64),
            count(row_of_truth),
            count(row_of_detection),
            count(row_of_truth[self.matched]),
            count(row_of_truth[self.correct]),
            count(row_of_truth[self.nearest[reaching]]),
            count(row_of_truth[self.nearest[self.literally_correct]]),
            count(row_of_detection[self.kind == DUPLICATE]),
            count(row_of_detection[self.kind == NEAR_MISS]),
        ]
        return np.stack(columns, axis=1)

    def group(
        self, key: tuple[Any, Any, Any], sums: Int, scene: Int, truths: Int, detections: Int, whole: bool
    ) -> Group:
        """Metrics of the rows given; ``whole`` says whether detections can be told to belong to the group."""
        total = sums.sum(axis=0)
        metrics: dict[str, float | None] = {
            name: None if np.isnan(value) else float(value)
            for name, value in _ratios(total, self.settings.matching).items()
        }
        hit = self.kind[detections] == MATCHED
        metrics["average_precision"] = _curve(self.score[detections], hit, int(total[1]))[0]
        distance = self.distance[truths]
        for unit, error in (("px", distance), ("radii", distance / self.radius[truths])):
            error = np.sort(error[~np.isnan(error)])  # sorted: the order of images must not change the last bit
            some = len(error) > 0
            median, p95 = np.percentile(error, [50, 95]).tolist() if some else (None, None)
            metrics[f"error_median_{unit}"], metrics[f"error_p95_{unit}"] = median, p95
            metrics[f"error_rms_{unit}"] = float(np.sqrt(np.mean(error**2))) if some else None
        scenes, intervals = _intervals(sums, scene, self.settings)
        n: dict[str, Any] = dict(zip(SUMS, total.tolist(), strict=True))
        n |= {
            "scenes": scenes,
            "wrong_id": n["matched"] - n["id_correct"],
            "missed": n["truths"] - n["matched"],
            "clutter": n["detections"] - n["matched"] - n["duplicate"] - n["near_miss"],
        }
        void = (set() if whole else _OF_DETECTIONS | {"detections", "duplicate", "near_miss", "clutter"}) | (
            set() if self.has_ids else _OF_IDS | {"id_correct", "wrong_id", "id_correct_literal"}
        )
        return Group(
            *key,
            metrics={name: None if name in void else metrics[name] for name in METRICS},
            counts={name: None if name in void else n[name] for name in COUNTS},
            intervals={name: None if name in void else value for name, value in intervals.items()},
        )


def _groups(truth: Truth, rows: _Rows) -> Iterator[Group]:
    """Overall; each condition and rung; each patch within them; each patch over all images."""
    n = len(truth)
    sums = rows.sums(rows.truth_image, rows.image, n)

    def level(
        keys: Sequence[tuple[Any, Any, Any]],
        label: Int,
        sums: Int,
        scene: Int,
        truths: Int,
        detections: Int,
        mixed: NDArray[np.bool_],
    ) -> Iterator[Group]:
        """Groups of rows; ``label`` (M,) is the group of a row, ``truths`` and ``detections`` the row of each."""
        labelled = np.append(label, -1)
        whole = np.bincount(label, mixed, minlength=len(keys)) == 0
        for key, r, t, d, fine in zip(
            keys,
            _split(label, len(keys)),
            _split(labelled[truths], len(keys)),
            _split(labelled[detections], len(keys)),
            whole.tolist(),
            strict=True,
        ):
            yield rows.group(key, sums[r], scene[r], t, d, fine)

    images = (sums, rows.scene, rows.truth_image, rows.image, np.zeros(n, bool))
    yield from level([(None, None, None)], np.zeros(n, np.int64), *images)

    conditions, condition = np.unique(truth.condition, return_inverse=True)
    rungs, rung = np.unique(truth.rung, return_inverse=True)
    codes, code = np.unique(condition * len(rungs) + rung, return_inverse=True)
    keys = [(str(conditions[c // len(rungs)]) or None, _whole(rungs[c % len(rungs)]), None) for c in codes]
    parted = [key[:2] for key in keys] != [(None, None)]
    if parted:
        yield from level(keys, code, *images)

    patches, patch = np.unique(rows.truth_id, return_inverse=True)
    if len(patches) < 2:
        return
    # Rows are now (image, patch). A false alarm belongs to a patch only where an image shows no other.
    unit, of_truth = np.unique(rows.truth_image * len(patches) + patch, return_inverse=True)
    of_image, of_patch = unit // len(patches), unit % len(patches)
    mixed = (np.bincount(of_image, minlength=n) > 1)[of_image]
    owner = np.full(n, -1)
    owner[of_image[~mixed]] = np.flatnonzero(~mixed)
    of_detection = owner[rows.image]
    units = (rows.sums(of_truth, of_detection, len(unit)), rows.scene[of_image], of_truth, of_detection, mixed)
    if parted:
        codes, label = np.unique(code[of_image] * len(patches) + of_patch, return_inverse=True)
        both = [(*keys[c // len(patches)][:2], int(patches[c % len(patches)])) for c in codes]
        yield from level(both, label, *units)
    yield from level([(None, None, int(p)) for p in patches], of_patch, *units)


def _whole(rung: float) -> float | None:
    """A rung as it is written: 15, not 15.0; None for nan."""
    if np.isnan(rung):
        return None
    return int(rung) if float(rung).is_integer() else float(rung)


def _confusion(truth_id: Int, found: Matches, patch_id: Int | None) -> dict[str, Any]:
    if patch_id is None:
        return {}
    matched = found.detection >= 0
    ids, row = np.unique(truth_id, return_inverse=True)
    detected = patch_id[found.detection[matched]]
    column = np.searchsorted(ids, detected)
    known = np.append(ids, -1)[column] == detected
    known &= ~found.contradicted[matched]
    cell = row[matched] * (len(ids) + 1) + np.where(known, column, len(ids))
    matrix = np.bincount(cell, minlength=len(ids) * (len(ids) + 1)).reshape(len(ids), len(ids) + 1)
    return {"ids": ids.tolist(), "matrix": matrix.tolist()}


def _curve_table(rows: _Rows, images: int) -> dict[str, list[float | None]]:
    truths = len(rows.truth_id)
    _, level, hits, kept = _curve(rows.score, rows.kind == MATCHED, truths)
    some = np.unique(np.linspace(0, len(level) - 1, 201).astype(int)) if len(level) else np.zeros(0, int)
    level, hits, kept = level[some], hits[some], kept[some]
    return {
        "score": level.tolist(),
        "precision": (hits / kept).tolist(),
        "recall": (hits / truths).tolist() if truths else [None] * len(some),
        "average_false_alarm": ((kept - hits) / images).tolist(),
    }


# --- the public calls -------------------------------------------------------------------------------------------


class HasTruth(Protocol):
    """What a dataset offers to the evaluator."""

    @property
    def truth(self) -> Truth: ...


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
        See :class:`Settings`.
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
    settings = settings or Settings()
    if not len(truth):
        raise DataError("the dataset has no images")
    image = _image_of_detections(truth, predictions, allow_missing)
    keypoints = truth.keypoints
    truth_xy = np.stack([keypoints["x"], keypoints["y"]], axis=1).astype(np.float64)
    major, minor = keypoints["radius_major"].astype(np.float64), keypoints["radius_minor"].astype(np.float64)
    radius = {"major": major, "minor": minor, "mean": (major + minor) / 2}[settings.eps_radius]
    truth_image = np.repeat(np.arange(len(truth)), np.diff(truth.offsets))
    fine = np.isfinite(truth_xy).all(axis=1) & np.isfinite(radius) & (radius > 0)
    if not fine.all():
        row = int(np.argmin(fine))
        raise DataError(
            f"image_id {truth.image_id[truth_image[row]]}: a true keypoint at {truth_xy[row].tolist()} has radius "
            f"{radius[row]}, expected finite numbers and a radius over 0"
        )
    truth_id = keypoints["patch_id"].astype(np.int64)
    # Where nothing was detected it does not matter whether the detector would have told identities
    ids = predictions.patch_id if len(predictions.xy) else np.zeros(0, np.int64)
    found = match(truth_xy, truth_image, radius, settings.eps, predictions.xy, predictions.score, image, ids)
    correct, literally = np.zeros(len(truth_xy), bool), np.zeros(len(image), bool)
    if ids is not None:
        t, d = np.flatnonzero(found.detection >= 0), np.flatnonzero(found.nearest >= 0)
        correct[t] = (ids[found.detection[t]] == truth_id[t]) & ~found.contradicted[t]
        literally[d] = ids[d] == truth_id[found.nearest[d]]
    surest = np.argsort(-predictions.score, kind="stable")
    rows = _Rows(
        truth_image=truth_image,
        truth_id=truth_id,
        radius=radius,
        distance=found.distance,
        matched=found.detection >= 0,
        correct=correct,
        image=image[surest],
        score=predictions.score[surest],
        kind=found.kind[surest],
        nearest=found.nearest[surest],
        literally_correct=literally[surest],
        has_ids=ids is not None,
        scene=truth.scene_id,
        settings=settings,
    )
    overall, *by = _groups(truth, rows)
    return Scores(
        overall=overall,
        by=tuple(by),
        confusion=_confusion(truth_id, found, ids),
        curve=_curve_table(rows, len(truth)),
        settings=settings,
        detector=predictions.detector,
        fingerprint=truth.fingerprint,
    )


def _image_of_detections(truth: Truth, predictions: Predictions, allow_missing: bool) -> Int:
    """Position in the truth of each detection's image, after checking that both are of the same images."""
    named = predictions.fingerprint or predictions.dataset or ""
    if re.fullmatch("[0-9a-f]{64}", named) and truth.fingerprint and named != truth.fingerprint:
        raise PredictionsError(
            f"made for the dataset with fingerprint {named[:12]}…, but this dataset's is {truth.fingerprint[:12]}…"
        )
    order = np.argsort(truth.image_id, kind="stable")
    ids = truth.image_id[order]
    if np.any(ids[1:] == ids[:-1]):
        raise DataError(f"the dataset has image_id {ids[:-1][ids[1:] == ids[:-1]][0]} twice")
    place = np.searchsorted(ids, predictions.image_id)
    unknown = np.append(ids, -1)[place] != predictions.image_id
    span = f"{len(ids)} images, image_id {ids[0]} to {ids[-1]}"
    if unknown.any():
        raise PredictionsError(
            f"image_id {predictions.image_id[unknown].min()} is not in the dataset ({span}); "
            f"{np.count_nonzero(unknown)} predictions are for images that it does not have"
        )
    missing = np.ones(len(ids), bool)
    missing[place] = False
    if missing.any() and not allow_missing:
        raise PredictionsError(
            f"no prediction for image_id {ids[missing][0]}; {np.count_nonzero(missing)} of {len(ids)} images are "
            f"missing (--allow-missing takes them as images without detections)"
        )
    return np.repeat(order[place], np.diff(predictions.offsets))


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
