"""Groups of images and keypoints, and the metrics of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kpbench.scoring.assignment import MATCHED
from kpbench.scoring.bootstrap import Interval, by_scene, intervals
from kpbench.scoring.metrics import COUNTS, METRICS, SUMS, error_metrics, precision_recall, ratios
from kpbench.scoring.outcomes import Tally
from kpbench.types import Int

RADIUS_EDGES_PX = (0, 5, 10, 20, 40, 80, np.inf)  # bins are low < radius <= high


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


def make_groups(rows: Tally) -> Iterator[Group]:
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
