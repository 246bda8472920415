"""Numbers from counts: the only place where sums become metrics. Nothing here knows images or files.

What is 0/0 is undefined: nan in arrays here, None in results, never 0 or 1. ``docs/reference/metrics.md`` describes
each metric with its edge cases.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.types import Float

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

PAPER_METRICS = ("detection_score", "id_matching_score", "average_false_alarm")
RATIOS = (
    *PAPER_METRICS,
    *(f"{name}_literal" for name in PAPER_METRICS),
    "precision",
    "recall",
    "f1",
)
"""The metrics that are ratios of sums over images, and so have intervals."""

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


LABELS = {
    "detection_score": "detection score",
    "id_matching_score": "ID matching score",
    "average_false_alarm": "false alarms an image",
    "detection_score_literal": "detection score, as printed",
    "id_matching_score_literal": "ID matching score, as printed",
    "average_false_alarm_literal": "false alarms, as printed",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
    "average_precision": "average precision",
    "error_median_px": "error, median (px)",
    "error_p95_px": "error, 95th percentile (px)",
    "error_rms_px": "error, RMS (px)",
    "error_median_radii": "error, median (radii)",
    "error_p95_radii": "error, 95th percentile (radii)",
    "error_rms_radii": "error, RMS (radii)",
}
"""What people read for the names of metrics."""


def ratios(sums: NDArray[Any], matching: str) -> dict[str, Float]:
    """The metrics of :data:`RATIOS` from sums of shape (..., 9), each of shape (...); nan where undefined.

    ``matching`` is that of :class:`kpbench.scoring.Settings`.
    """
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
        values |= {name: values[f"{name}_literal"] for name in PAPER_METRICS}
    return values


def precision_recall(score: Float, hit: NDArray[np.bool_], truths: int) -> tuple[float | None, Float, Float, Float]:
    """Average precision, and (thresholds, matches, detections) above each, from the surest detection on.

    ``score`` and ``hit`` (whether it is a match) are of shape (D,), in any order.

    A threshold cannot split equal scores, so their order among each other does not matter.
    The assignment prefers high scores, so cutting detections off below a threshold leaves the number of matches above
    it as it is: one matching serves all thresholds.
    """
    every, hits = np.sort(score), np.sort(score[hit])  # sorting values is several times faster than sorting indices
    first = np.flatnonzero(np.append(True, np.diff(every) != 0)[: len(every)])[::-1]
    level = every[first]
    kept = (len(every) - first).astype(np.float64)
    matched = (len(hits) - np.searchsorted(hits, level[::-1], side="left")[::-1]).astype(np.float64)
    area = float(np.sum(np.diff(matched, prepend=0.0) / truths * matched / kept)) if truths else None
    return area, level, matched, kept


def error_metrics(distance: Float, radius: Float) -> dict[str, float | None]:
    """Median, 95th percentile and RMS of the distances (px) of matched keypoints, in px and in their radii (px)."""
    metrics: dict[str, float | None] = {}
    for unit, error in (("px", distance), ("radii", distance / radius)):
        error = np.sort(error)  # so that the order of images does not change the last bit
        some = len(error) > 0
        median, p95 = np.percentile(error, [50, 95]).tolist() if some else (None, None)
        metrics[f"error_median_{unit}"], metrics[f"error_p95_{unit}"] = median, p95
        metrics[f"error_rms_{unit}"] = float(np.sqrt(np.mean(error**2))) if some else None
    return metrics
