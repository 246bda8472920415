"""Compute metrics from counts, scores and distances.

A metric that would be 0/0 is undefined. An undefined metric is nan in arrays and None in results, never 0 or 1.
``docs/reference/metrics.md`` describes each metric with its edge cases.
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
"""Names of the nine counts per image. Their sums give all ratios, and all other counts except ``scenes``."""

PAPER_METRICS = ("detection_score", "id_matching_score", "average_false_alarm")
"""Names of the paper's three metrics."""

RATIOS = (
    *PAPER_METRICS,
    *(f"{name}_literal" for name in PAPER_METRICS),
    "precision",
    "recall",
    "f1",
)
"""Names of the metrics that are ratios of counts. Only these metrics and ``nees`` have intervals."""

METRICS = (
    *RATIOS,
    "average_precision",
    "error_median_px",
    "error_p95_px",
    "error_rms_px",
    "error_median_radii",
    "error_p95_radii",
    "error_rms_radii",
    "bias_px",
    "bias_u_px",
    "bias_v_px",
    "bias_tilt_px",
    "scatter_px",
    "sigma_median_px",
    "nees",
)
"""Names of all metrics, as in the scores file."""

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
"""Names of all counts.

A true keypoint is matched or missed. A detection is matched, a duplicate, a near miss or clutter.
"""

LABELS = {
    "detection_score": "detection score",
    "id_matching_score": "ID matching score",
    "average_false_alarm": "false alarms per image",
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
    "bias_px": "bias (px)",
    "bias_u_px": "bias along u of the patch (px)",
    "bias_v_px": "bias along v of the patch (px)",
    "bias_tilt_px": "bias along the tilt (px)",
    "scatter_px": "scatter, RMS (px)",
    "sigma_median_px": "predicted sigma, median (px)",
    "nees": "NEES",
}
"""The label of each metric in tables and charts."""


def compute_ratios(sums: NDArray[Any], matching: str) -> dict[str, Float]:
    """Compute the metrics that are ratios of sums.

    Parameters
    ----------
    sums : ndarray of shape (..., 9)
        Sums over images, in the order of :data:`kpbench.scoring.SUMS`.
    matching : {"one-to-one", "literal"}
        As in :class:`kpbench.scoring.Settings`.

    Returns
    -------
    dict of str to ndarray of shape (...)
        The metrics by name; nan where undefined.

    Examples
    --------
    >>> import numpy as np, kpbench
    >>> sums = np.array([1, 4, 5, 3, 3, 3, 3, 1, 0])  # 1 image, 4 truths, 5 detections, 3 matched, ...
    >>> float(kpbench.scoring.compute_ratios(sums, "one-to-one")["detection_score"])
    0.75
    """
    images, truths, detections, matched, id_correct, literal, id_literal = np.moveaxis(sums, -1, 0)[:7].astype(float)

    def divide(part: Float, whole: Float) -> Float:
        return np.asarray(np.divide(part, whole, out=np.full(np.shape(part), np.nan), where=whole > 0))

    values = {
        "detection_score": divide(matched, truths),
        "id_matching_score": divide(id_correct, matched),
        "average_false_alarm": divide(detections - matched, images),
        "detection_score_literal": divide(literal, truths),
        "id_matching_score_literal": divide(id_literal, literal),
        "average_false_alarm_literal": divide(detections - literal, images),
        "precision": divide(matched, detections),
        "recall": divide(matched, truths),
        "f1": divide(2 * matched, truths + detections),
    }
    if matching == "literal":
        values |= {name: values[f"{name}_literal"] for name in PAPER_METRICS}
    return values


def count_above_thresholds(score: Float, hit: NDArray[np.bool_]) -> tuple[Float, Float, Float]:
    """Count the matches and the detections at or above each score threshold.

    The matching prefers high scores. So the number of matches at or above a threshold stays the same if all detections
    below the threshold are removed. One matching therefore serves all thresholds. Equal scores share a threshold.

    Parameters
    ----------
    score : ndarray of shape (D,), float64
        Scores of the detections, in rising order.
    hit : ndarray of shape (D,), bool
        Whether each detection is a match.

    Returns
    -------
    threshold : ndarray of shape (K,), float64
        The distinct scores, in falling order.
    matches, detections : ndarray of shape (K,), float64
        Number of matches, and number of detections, at or above each threshold.
    """
    first = np.flatnonzero(np.append(True, np.diff(score) != 0)[: len(score)])[::-1]
    matches_from = np.cumsum(hit[::-1])[::-1]  # the number of matches from each detection on
    return score[first], matches_from[first].astype(np.float64), (len(score) - first).astype(np.float64)


def compute_average_precision(score: Float, hit: NDArray[np.bool_], truths: int) -> float | None:
    """Compute the area under the precision-recall curve, without interpolation.

    The area is the sum of (recallₖ − recallₖ₋₁) · precisionₖ over all thresholds k, in falling order.

    Parameters
    ----------
    score, hit : ndarray of shape (D,)
        As for :func:`count_above_thresholds`.
    truths : int
        Number of true keypoints. The result is None if ``truths`` is 0.
    """
    _, matches, detections = count_above_thresholds(score, hit)
    return float(np.sum(np.diff(matches, prepend=0.0) / truths * matches / detections)) if truths else None


def compute_error_metrics(error_px: Float, error_radii: Float) -> dict[str, float | None]:
    """Compute the median, the 95th percentile and the RMS of errors, in px and in radii.

    Parameters
    ----------
    error_px : ndarray of shape (M,), float64
        Distance of each matched keypoint to its detection, px, in rising order. The order of the images would otherwise
        change the last bit of the RMS.
    error_radii : ndarray of shape (M,), float64
        The same distances in radii of the keypoints, in rising order.
    """
    metrics: dict[str, float | None] = {}
    for unit, error in (("px", error_px), ("radii", error_radii)):
        some = len(error) > 0
        median, p95 = np.percentile(error, [50, 95]).tolist() if some else (None, None)
        metrics[f"error_median_{unit}"], metrics[f"error_p95_{unit}"] = median, p95
        metrics[f"error_rms_{unit}"] = float(np.sqrt(np.mean(error**2))) if some else None
    return metrics
