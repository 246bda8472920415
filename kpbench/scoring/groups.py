"""Divide images and keypoints into groups, and compute the metrics of each group."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kpbench.scoring.assignment import MATCHED
from kpbench.scoring.bootstrap import Interval, bootstrap_intervals, sum_by_scene
from kpbench.scoring.metrics import (
    COUNTS,
    METRICS,
    SUMS,
    compute_average_precision,
    compute_error_metrics,
    compute_ratios,
)
from kpbench.scoring.outcomes import Outcomes
from kpbench.scoring.uncertainty import (
    MatchedErrors,
    compute_uncertainty_metrics,
    estimate_nees_interval,
    measure_errors,
)
from kpbench.types import Float, Int

RADIUS_EDGES_PX = (0, 5, 10, 20, 40, 80, np.inf)
"""Edges of the bins of radii, px. A bin holds low < radius <= high."""
_NEED_DETECTIONS = {
    *("average_false_alarm", "average_false_alarm_literal", "precision", "f1", "average_precision"),
    *("detections", "duplicate", "near_miss", "clutter"),
}
"""Metrics and counts that are undefined if the false alarms of an image cannot be divided between groups."""
_NEED_IDS = {"id_matching_score", "id_matching_score_literal", "id_correct", "wrong_id", "id_correct_literal"}
"""Metrics and counts that are undefined for a detector without identities."""


class GroupKey(NamedTuple):
    """The condition, rung, patch and radii of a group; None stands for all.

    Attributes
    ----------
    condition : str or None
        Name of the condition.
    rung : float or None
        Severity within the condition.
    patch_id : int or None
        Patch ID of the true keypoints.
    radius_px : (low, high) or None
        Radii of the true keypoints, low < radius <= high. If ``high`` is None, the radii have no upper limit.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.scoring.GroupKey("blur", 7).patch_id is None
    True
    """

    condition: str | None = None
    rung: float | None = None
    patch_id: int | None = None
    radius_px: tuple[float, float | None] | None = None


@dataclass(frozen=True)
class Group:
    """The metrics over some of the images or over some of the keypoints.

    Attributes
    ----------
    key : GroupKey
        The condition, rung, patch and radii of the group.
    metrics : dict of str to float or None
        The value of each of :data:`kpbench.scoring.METRICS`; None if the metric is undefined for the group.
    counts : dict of str to int or None
        The value of each of :data:`kpbench.scoring.COUNTS`; None if the count is undefined for the group.
    intervals : dict of str to (low, high) or None
        95 % bootstrap intervals of the metrics that are ratios of counts, and of ``nees``.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> scores.overall.metrics["precision"], scores.overall.counts["missed"]
    (1.0, 1)
    """

    key: GroupKey
    metrics: dict[str, float | None]
    counts: dict[str, int | None]
    intervals: dict[str, Interval | None]

    @property
    def condition(self) -> str | None:
        """Name of the condition."""
        return self.key.condition

    @property
    def rung(self) -> float | None:
        """Severity within the condition."""
        return self.key.rung

    @property
    def patch_id(self) -> int | None:
        """Patch ID of the true keypoints."""
        return self.key.patch_id

    def to_dict(self) -> dict[str, Any]:
        """Return the ``metrics`` object of this group in the scores file."""
        return {**self.metrics, "counts": self.counts, "intervals": self.intervals}


class _Ranked(NamedTuple):
    """Values in rising order. All values are sorted once, and each group selects from the sorted values."""

    row: Int
    """Row of the keypoint or of the detection that has each value."""
    value: Float

    @classmethod
    def of(cls, row: Int, value: Float) -> _Ranked:
        order = np.argsort(value)
        return cls(row[order], value[order])


class _Units(NamedTuple):
    """The M units that groups consist of. A unit is an image, or the keypoints of one label in one image."""

    outcomes: Outcomes
    ranked: tuple[_Ranked, _Ranked, _Ranked]
    """The scores of all detections, and the errors of all matched keypoints in px and in radii."""
    errors: MatchedErrors
    """The errors of all matched keypoints, in the order of their errors in px."""
    sums: Int
    """Counts of each unit, of shape (M, 9), in the order of SUMS."""
    scene: Int
    """Scene of each unit, of shape (M,)."""
    of_truth: Int
    """Unit of each true keypoint, of shape (T,)."""
    of_detection: Int
    """Unit of each detection, of shape (D,); -1 for a detection that belongs to no unit."""
    shared: NDArray[np.bool_]
    """Whether the unit's image has several units, of shape (M,). The image's detections then belong to no unit."""

    def group(self, keys: list[GroupKey], label: Int) -> Iterator[Group]:
        """Compute a group for each key. ``label`` (M,) holds each unit's index into ``keys``."""
        any_shared = np.bincount(label, self.shared, minlength=len(keys)) > 0
        kind = np.int16 if len(keys) < 2**15 else np.int64  # numpy sorts integers of 16 bits in linear time
        label_or_none = np.append(label, -1).astype(kind)  # a detection of unit -1 gets the last label, -1
        parts = (self.of_detection, self.of_truth, self.of_truth)
        labels = (label_or_none[part][ranked.row] for part, ranked in zip(parts, self.ranked, strict=True))
        rows = [_rows_of_labels(part, len(keys)) for part in chain([label_or_none[:-1]], labels)]
        for key, shared, *rows_of_key in zip(keys, any_shared.tolist(), *rows, strict=True):
            yield self._compute(key, shared, *rows_of_key)

    def _compute(self, key: GroupKey, shared: bool, units: Int, *ranks: Int) -> Group:
        """Compute the group of some units. ``ranks`` select its values of each of ``ranked``."""
        outcomes, settings = self.outcomes, self.outcomes.settings
        sums = self.sums[units]
        total = sums.sum(axis=0)
        ratios = compute_ratios(total, settings.matching)
        metrics = {name: None if np.isnan(value) else float(value) for name, value in ratios.items()}
        n: dict[str, Any] = dict(zip(SUMS, total.tolist(), strict=True))
        score, *errors = (ranked.value[rank] for ranked, rank in zip(self.ranked, ranks, strict=True))
        hit = outcomes.matches.kind[self.ranked[0].row[ranks[0]]] == MATCHED
        metrics["average_precision"] = compute_average_precision(score, hit, n["truths"])
        metrics |= compute_error_metrics(*errors)
        of_errors = self.errors.select(ranks[1])
        metrics |= compute_uncertainty_metrics(of_errors)
        scenes = sum_by_scene(sums, self.scene[units])
        intervals = bootstrap_intervals(
            scenes, lambda s: compute_ratios(s, settings.matching), settings.resamples, settings.seed
        )
        intervals["nees"] = estimate_nees_interval(of_errors, settings.resamples, settings.seed)
        n |= {
            "scenes": len(scenes),
            "wrong_id": n["matched"] - n["id_correct"],
            "missed": n["truths"] - n["matched"],
            "clutter": n["detections"] - n["matched"] - n["duplicate"] - n["near_miss"],
        }
        undefined = (_NEED_DETECTIONS if shared else set()) | (
            _NEED_IDS if outcomes.detections.patch_id is None else set()
        )
        return Group(
            key,
            metrics={name: None if name in undefined else metrics[name] for name in METRICS},
            counts={name: None if name in undefined else n[name] for name in COUNTS},
            intervals={name: None if name in undefined else value for name, value in intervals.items()},
        )


def make_groups(outcomes: Outcomes) -> Iterator[Group]:
    """Compute all groups of the matched predictions.

    Yields
    ------
    Group
        First a group of all images. Then a group for each condition and rung; for each patch within each condition and
        rung; for each patch over all images; and for each bin of radii over all images. Groups
        for patches are made only if the truth has several patches, and groups for bins only if radii fall into several
        bins. Images without condition and rung form no group of their own.
    """
    truth, n = outcomes.truth, len(outcomes.truth)
    image_of_truth, image_of_detection = outcomes.truth_points.image, outcomes.detections.image
    matched = np.flatnonzero(outcomes.matched)
    errors = measure_errors(outcomes, matched)
    order = errors.rank(outcomes.matches.distance[matched])
    matched, errors = matched[order], errors.select(order)
    distance = outcomes.matches.distance[matched]
    ranked = (
        _Ranked(outcomes.ranking, outcomes.detections.score[outcomes.ranking]),
        _Ranked(matched, distance),
        _Ranked.of(matched, distance / outcomes.truth_points.radius[matched]),
    )
    images = _Units(
        outcomes,
        ranked,
        errors,
        outcomes.image_sums,
        truth.scene_id,
        image_of_truth,
        image_of_detection,
        np.zeros(n, bool),
    )
    yield from images.group([GroupKey()], np.zeros(n, np.int64))

    conditions, condition = np.unique(truth.condition, return_inverse=True)
    rungs, rung = np.unique(truth.rung, return_inverse=True)
    codes, code = _number(condition * len(rungs) + rung)
    keys = [GroupKey(str(conditions[c // len(rungs)]) or None, as_written(rungs[c % len(rungs)])) for c in codes]
    has_conditions = keys != [GroupKey()]
    if has_conditions:  # images without condition and rung would have the key of all images
        yield from (group for group in images.group(keys, code) if group.key != GroupKey())

    patches, patch = _number(outcomes.truth_id)
    if len(patches) > 1:
        of_image, of_patch, units = _divide_images(images, patch, len(patches))
        if has_conditions:
            codes, label = _number(code[of_image] * len(patches) + of_patch)
            both = [keys[c // len(patches)]._replace(patch_id=int(patches[c % len(patches)])) for c in codes]
            groups = units.group(both, label)
            yield from (group for group in groups if group.key._replace(patch_id=None) != GroupKey())
        yield from units.group([GroupKey(patch_id=int(p)) for p in patches], of_patch)

    bin_of_truth = np.searchsorted(RADIUS_EDGES_PX, outcomes.truth_points.radius) - 1
    bins, size = _number(bin_of_truth)
    if len(bins) > 1:
        _, of_size, units = _divide_images(images, size, len(bins))
        edges = [(RADIUS_EDGES_PX[b], RADIUS_EDGES_PX[b + 1]) for b in bins]
        radii = [(low, None if np.isinf(high) else high) for low, high in edges]
        units = units._replace(shared=np.ones(len(of_size), bool))  # a false alarm has no radius
        yield from units.group([GroupKey(radius_px=span) for span in radii], of_size)


def _divide_images(images: _Units, label: Int, labels: int) -> tuple[Int, Int, _Units]:
    """Divide each image into units. A unit holds the keypoints of one label.

    If an image has a single unit, the detections in the image belong to this unit. Otherwise the detections belong to
    no unit, because a false alarm has no label.

    Parameters
    ----------
    label : ndarray of shape (T,), int64
        Label of each true keypoint, from 0 to ``labels`` - 1.

    Returns
    -------
    of_image, of_label : ndarray of shape (M,), int64
        Image and label of each unit.
    units : _Units
    """
    outcomes, n = images.outcomes, len(images.sums)
    unit, of_truth = _number(images.of_truth * labels + label)
    of_image, of_label = unit // labels, unit % labels
    shared = (np.bincount(of_image, minlength=n) > 1)[of_image]
    unit_of_image = np.full(n, -1)
    unit_of_image[of_image[~shared]] = np.flatnonzero(~shared)
    of_detection = unit_of_image[images.of_detection]
    sums = outcomes.sum_rows(of_truth, of_detection, len(unit))
    scene = outcomes.truth.scene_id[of_image]
    return (
        of_image,
        of_label,
        _Units(outcomes, images.ranked, images.errors, sums, scene, of_truth, of_detection, shared),
    )


def _number(values: Int) -> tuple[Int, Int]:
    """Return the distinct values in rising order, and the index of each value among these, as ``np.unique`` does.

    If the values lie close together, they are not sorted, which takes many times as long.
    """
    low, high = (int(values.min()), int(values.max())) if len(values) else (0, 0)
    if high - low > 4 * len(values):
        return np.unique(values, return_inverse=True)
    is_there = np.bincount(values - low, minlength=1) > 0
    return np.flatnonzero(is_there) + low, (np.cumsum(is_there) - 1)[values - low]


def _rows_of_labels(label: NDArray[Any], labels: int) -> list[Int]:
    """Return the rows of each label from 0 to ``labels`` - 1, in rising order. Rows of other labels are left out."""
    order = np.argsort(label, kind="stable")
    edges = np.cumsum(np.bincount(label + 1, minlength=labels + 1))
    return [order[a:b] for a, b in pairwise(edges.tolist())]


def as_written(rung: float) -> float | None:
    """Return a rung as suites write it: 15 rather than 15.0; None for nan."""
    if np.isnan(rung):
        return None
    return int(rung) if float(rung).is_integer() else float(rung)
