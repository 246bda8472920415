"""Compare the scores of detections with how often the detections are right.

References
----------
.. [1] C. Guo, G. Pleiss, Y. Sun and K. Q. Weinberger, "On calibration of modern neural networks", ICML 2017, section 2.
   https://arxiv.org/abs/1706.04599
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.types import Float

SCORE_BINS = 10
"""Number of bins of equal width between scores of 0 and 1."""


def compute_reliability(score: Float, hit: NDArray[np.bool_]) -> dict[str, Any]:
    """Compute the reliability curve of the scores and the expected calibration error (ECE) [1]_.

    The ECE is the mean distance between score and precision of the bins, weighted by their numbers of detections.

    Parameters
    ----------
    score : ndarray of shape (D,), float64
        Score of each detection. Scores can be probabilities only if all lie between 0 and 1.
    hit : ndarray of shape (D,), bool
        Whether each detection matches a true keypoint.

    Returns
    -------
    dict
        ``ece``: the error, or None if there are no detections or a score lies outside 0 to 1. ``bins``: an object for
        each bin that holds detections: ``score`` [low, high], ``detections``, ``score_mean`` and ``precision``.
        A bin holds low <= score < high; the last bin also holds 1.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.scoring.reliability import compute_reliability
    >>> found = compute_reliability(np.array([0.5, 0.5, 1.0]), np.array([True, False, True]))
    >>> found["ece"], found["bins"][0]
    (0.0, {'score': [0.5, 0.6], 'detections': 2, 'score_mean': 0.5, 'precision': 0.5})
    """
    if not len(score) or score.min() < 0 or score.max() > 1:
        return {"ece": None, "bins": []}
    edges = np.arange(SCORE_BINS + 1) / SCORE_BINS
    order = np.argsort(score)  # the order of the images would otherwise change the last bit of the means
    score, hit = score[order], hit[order]
    label = np.minimum(np.searchsorted(edges, score, side="right") - 1, SCORE_BINS - 1)
    bins = []
    for b in np.unique(label).tolist():
        inside = label == b
        bins.append({
            "score": edges[b : b + 2].tolist(),
            "detections": int(inside.sum()),
            "score_mean": float(score[inside].mean()),
            "precision": float(hit[inside].mean()),
        })  # fmt: skip
    ece = sum(b["detections"] * abs(b["score_mean"] - b["precision"]) for b in bins) / len(score)
    return {"ece": float(ece), "bins": bins}
