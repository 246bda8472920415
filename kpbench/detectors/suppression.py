"""Of places that are near each other the best one stays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from kpbench.types import Float


def suppress(xy: Float, score: Float, distance_px: float | Float) -> NDArray[np.int64]:
    """Non-maximum suppression: indices of the points that have no better kept one within a distance.

    Parameters
    ----------
    xy : ndarray of shape (n, 2), px
    score : ndarray of shape (n,)
    distance_px : float or ndarray of shape (n,)
        Reach of a point, over worse ones.

    Returns
    -------
    ndarray of shape (k,), int64
        Best first; equal scores in order of x, then y.
    """
    order = np.lexsort((xy[:, 1], xy[:, 0], -score))
    reach = np.broadcast_to(np.asarray(distance_px, np.float64), score.shape)[order]
    kept = np.ones(len(order), bool)
    if len(order):
        pairs = cKDTree(xy[order]).query_pairs(reach.max(), output_type="ndarray")
        better, worse = pairs.min(axis=1), pairs.max(axis=1)  # order is from the best on
        near = np.hypot(*(xy[order[better]] - xy[order[worse]]).T) < reach[better]
        by_rank = np.flatnonzero(near)[np.argsort(better[near], kind="stable")]
        for one, other in zip(better[by_rank].tolist(), worse[by_rank].tolist(), strict=True):
            if kept[one]:  # all that is better than this one has been seen
                kept[other] = False
    return order[kept]
