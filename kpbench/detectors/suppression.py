"""Non-maximum suppression: of points near each other, the best is kept."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from kpbench.types import Float, Int


def suppress(xy: Float, score: Float, distance_px: float | Float) -> Int:
    """Return the indices of the points that no better point suppresses.

    Points are visited from the best to the worst. A kept point suppresses every worse point within its distance.
    Suppressed points suppress no other point.

    Parameters
    ----------
    xy : ndarray of shape (n, 2)
        Points, px.
    score : ndarray of shape (n,)
        Higher is better.
    distance_px : float or ndarray of shape (n,)
        Distance within which a kept point suppresses worse points, px.

    Returns
    -------
    ndarray of shape (k,), int64
        Best first; equal scores in the order of x, then y.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.detectors import suppress
    >>> suppress(np.array([[0.0, 0.0], [3.0, 0.0], [9.0, 0.0]]), np.array([0.5, 0.9, 0.7]), 5.0)
    array([1, 2])
    """
    order = np.lexsort((xy[:, 1], xy[:, 0], -score))
    reach = np.broadcast_to(np.asarray(distance_px, np.float64), score.shape)[order]
    kept = np.ones(len(order), bool)
    if len(order):
        pairs = cKDTree(xy[order]).query_pairs(reach.max(), output_type="ndarray")
        better, worse = pairs.min(axis=1), pairs.max(axis=1)  # the best point has rank 0
        near = np.hypot(*(xy[order[better]] - xy[order[worse]]).T) < reach[better]
        by_rank = np.flatnonzero(near)[np.argsort(better[near], kind="stable")]
        for one, other in zip(better[by_rank].tolist(), worse[by_rank].tolist(), strict=True):
            if kept[one]:  # all points better than `one` have been visited
                kept[other] = False
    return order[kept]
