"""Match detections to true keypoints one to one, in all images at once.

The best one-to-one assignment has the most matches, then the highest scores, then the smallest sum of distances. If
several assignments are equally good, the x coordinates decide, then the y coordinates. Identities do not influence the
matches. The order of images, keypoints and detections does not influence the matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kpbench.types import Float, Int

MATCHED, DUPLICATE, NEAR_MISS, CLUTTER = range(4)
"""The kinds of detections, see :attr:`Matches.kind`."""
PAIRS_PER_BLOCK = 2_000_000
"""Approximate largest number of candidate pairs that are in memory at a time."""


@dataclass(frozen=True)
class TruthPoints:
    """The true keypoints of all images as columns.

    Attributes
    ----------
    xy : ndarray of shape (T, 2), float64
        Place, px.
    radius : ndarray of shape (T,), float64
        Radius of the keypoint's disc, px. The matching threshold is given in radii.
    image : ndarray of shape (T,), int64
        Index of the image, from 0.
    least_reach_px : ndarray of shape (T,), float64, or None
        Least matching threshold, px, if the truth has errors. None: the truth is exact.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.scoring import TruthPoints
    >>> points = TruthPoints(np.array([[10.0, 10.0]]), np.array([5.0]), np.array([0]))
    >>> points.xy.shape
    (1, 2)
    """

    xy: Float
    radius: Float
    image: Int
    least_reach_px: Float | None = None

    def reach(self, eps: float) -> Float:
        """Return the largest distance of a match from each keypoint, px, at a matching threshold in radii."""
        reach = eps * self.radius
        return reach if self.least_reach_px is None else np.maximum(reach, self.least_reach_px)


@dataclass(frozen=True)
class DetectionPoints:
    """The detections in all images as columns.

    Attributes
    ----------
    xy : ndarray of shape (D, 2), float64
        Place, px.
    score : ndarray of shape (D,), float64
        Confidence; a higher score is more confident.
    image : ndarray of shape (D,), int64
        Index of the image, from 0.
    patch_id : ndarray of shape (D,), int64, or None
        Detected identity. Only :attr:`Matches.contradicted` depends on it.
    covariance : ndarray of shape (D, 2, 2), float64, or None
        Predicted covariance of the error of ``xy``, px². The matches do not depend on it.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.scoring import DetectionPoints
    >>> points = DetectionPoints(np.array([[10.0, 11.0]]), np.array([0.9]), np.array([0]))
    >>> points.patch_id is None
    True
    """

    xy: Float
    score: Float
    image: Int
    patch_id: Int | None = None
    covariance: Float | None = None

    def select(self, keep: NDArray[np.bool_]) -> DetectionPoints:
        """Return some of the detections."""
        patch_id = None if self.patch_id is None else self.patch_id[keep]
        covariance = None if self.covariance is None else self.covariance[keep]
        return DetectionPoints(self.xy[keep], self.score[keep], self.image[keep], patch_id, covariance)


@dataclass(frozen=True)
class Matches:
    """The matches of T true keypoints and D detections, in any number of images.

    Attributes
    ----------
    detection : ndarray of shape (T,), int64
        Row of the detection that is matched to the true keypoint; -1 without a match.
    distance : ndarray of shape (T,), float64
        Distance to the matched detection, px; nan without a match.
    contradicted : ndarray of shape (T,), bool
        Whether a second detection has the place and the score of the matched detection, but another identity.
        Neither identity then counts as correct, because the order of the detections must not decide between the two.
    nearest : ndarray of shape (D,), int64
        Row of the nearest true keypoint within the matching threshold; -1 without such a keypoint.
    kind : ndarray of shape (D,), uint8
        ``MATCHED``: matched to a true keypoint. ``DUPLICATE``: within the matching threshold of a true keypoint, but
        not matched. ``NEAR_MISS``: beyond every matching threshold, but within one radius of a true keypoint.
        ``CLUTTER``: all other detections.

    Examples
    --------
    >>> import kpbench
    >>> outcomes = kpbench.scoring.match_predictions(
    ...     kpbench.open_dataset("kpbench-data").truth, kpbench.read_predictions("preds.json")
    ... )
    >>> int((outcomes.matches.detection < 0).sum())  # the detector missed one keypoint
    1
    """

    detection: Int
    distance: Float
    contradicted: NDArray[np.bool_]
    nearest: Int
    kind: NDArray[np.uint8]


class _Pairs(NamedTuple):
    """P pairs of a true keypoint and a detection in the same image, as columns."""

    t: Int
    """Row of the true keypoint."""
    d: Int
    """Row of the detection."""
    distance: Float
    """Distance between the keypoint and the detection, px."""

    def select(self, rows: Int | NDArray[np.bool_]) -> _Pairs:
        return _Pairs(self.t[rows], self.d[rows], self.distance[rows])


def match(truth: TruthPoints, found: DetectionPoints, eps: float) -> Matches:
    """Match the detections of all images to the true keypoints.

    Parameters
    ----------
    truth : TruthPoints
    found : DetectionPoints
    eps : float
        Matching threshold: the largest distance of a match, in radii of the true keypoint. A pair at exactly this
        distance can match.

    Returns
    -------
    Matches
    """
    reach = truth.reach(eps)
    near = _find_pairs(truth, found, np.maximum(reach, truth.radius))
    pairs = near.select(near.distance <= reach[near.t])
    contested = _find_contested(pairs)

    detection, distance = np.full(len(truth.xy), -1), np.full(len(truth.xy), np.nan)
    won = pairs.select(_choose_matches(pairs, contested, truth, found))
    detection[won.t], distance[won.t] = won.d, won.distance

    kind = np.full(len(found.xy), CLUTTER, np.uint8)
    kind[near.d] = NEAR_MISS
    kind[pairs.d] = DUPLICATE
    kind[detection[detection >= 0]] = MATCHED
    contradicted = _find_contradicted(pairs.select(contested), detection, found)
    return Matches(detection, distance, contradicted, _find_nearest(pairs, truth, found), kind)


def count_matches(truth: TruthPoints, found: DetectionPoints, eps: Sequence[float]) -> list[int]:
    """Count the matched keypoints at each matching threshold in ``eps``, see :func:`match`."""
    near = _find_pairs(truth, found, truth.reach(max(eps)))
    counts = []
    for value in eps:
        pairs = near.select(near.distance <= truth.reach(value)[near.t])
        counts.append(len(_choose_matches(pairs, _find_contested(pairs), truth, found)))
    return counts


def _find_contested(pairs: _Pairs) -> NDArray[np.bool_]:
    """Mark the pairs that share a keypoint or a detection with another pair. Such pairs are rare."""
    t, d = pairs.t, pairs.d
    return (np.bincount(t)[t] > 1) | (np.bincount(d)[d] > 1) if len(t) else np.zeros(0, bool)


def _choose_matches(
    pairs: _Pairs, contested: NDArray[np.bool_], truth: TruthPoints, found: DetectionPoints
) -> NDArray[np.int64]:
    """Return the rows of ``pairs`` that become matches."""
    rows = np.flatnonzero(contested)
    return np.concatenate([np.flatnonzero(~contested), rows[_assign_contested(pairs.select(rows), truth, found)]])


def _find_nearest(pairs: _Pairs, truth: TruthPoints, found: DetectionPoints) -> Int:
    """Return :attr:`Matches.nearest`. The smallest x, then the smallest y breaks ties."""
    shared = np.bincount(pairs.d, minlength=len(found.xy))[pairs.d] > 1
    nearest = np.full(len(found.xy), -1)
    nearest[pairs.d[~shared]] = pairs.t[~shared]
    several = pairs.select(shared)
    x, y = truth.xy[several.t].T
    closest = several.select(_first_of_each(several.d, several.distance, x, y))
    nearest[closest.d] = closest.t
    return nearest


def _find_contradicted(contested: _Pairs, detection: Int, found: DetectionPoints) -> NDArray[np.bool_]:
    """Return :attr:`Matches.contradicted`. A twin is a detection with the place and the score of the match."""
    contradicted = np.zeros(len(detection), bool)
    if found.patch_id is not None:
        t, d = contested.t, contested.d
        t, d = t[detection[t] >= 0], d[detection[t] >= 0]
        match_of_t = detection[t]
        twin = (found.score[d] == found.score[match_of_t]) & (found.xy[d] == found.xy[match_of_t]).all(axis=1)
        contradicted[t[twin & (found.patch_id[d] != found.patch_id[match_of_t])]] = True
    return contradicted


def _find_pairs(truth: TruthPoints, found: DetectionPoints, reach: Float) -> _Pairs:
    """Return all pairs of a keypoint and a detection in the same image that are at most ``reach`` (T,) px apart.

    All images are placed side by side along one axis. The coordinate of a detection on this axis is the image's index
    times a stride, plus x. The detections are sorted by this coordinate. So two binary searches per keypoint find the
    detections within ``reach`` in x. ``slack`` covers the rounding errors of the coordinate. The distances are computed
    from the original x and y.
    """
    none = _Pairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    if not len(truth.xy) or not len(found.xy):
        return none
    low, high = (truth.xy[:, 0] - reach).min(), (truth.xy[:, 0] + reach).max()
    stride = 2 * (high - low) + 1
    slack = (1 + truth.image.max()) * stride * 1e-15
    place = np.clip(found.xy[:, 0], low, high) - low + stride * found.image
    order = np.argsort(place, kind="stable")  # fast, as the images are nearly in order
    place = place[order]
    centre = truth.xy[:, 0] - low + stride * truth.image
    first = np.searchsorted(place, centre - reach - slack, side="left")
    count = np.searchsorted(place, centre + reach + slack, side="right") - first
    ends = np.cumsum(count)
    blocks = [none]
    start = 0
    while start < len(truth.xy):
        stop = max(start + 1, int(np.searchsorted(ends, ends[start] + PAIRS_PER_BLOCK)))
        t = np.repeat(np.arange(start, stop), count[start:stop])
        number_within_t = np.arange(len(t)) - (ends[t] - count[t] - (ends[start] - count[start]))
        d = order[first[t] + number_within_t]
        with np.errstate(over="ignore"):
            distance = np.hypot(found.xy[d, 0] - truth.xy[t, 0], found.xy[d, 1] - truth.xy[t, 1])
        blocks.append(_Pairs(t, d, distance).select(distance <= reach[t]))
        start = stop
    return _Pairs(*map(np.concatenate, zip(*blocks, strict=True)))


def _first_of_each(group: Int, *keys: NDArray[Any]) -> Int:
    """Return the row of each group that has the smallest keys. The first key has priority."""
    order = np.lexsort((*reversed(keys), group))
    first: Int = order[np.append(True, np.diff(group[order]) != 0)[: len(order)]]
    return first


def _assign_contested(pairs: _Pairs, truth: TruthPoints, found: DetectionPoints) -> Int:
    """Return the rows of the contested pairs that become matches."""
    t, d, distance = pairs
    xy, score = found.xy, found.score
    # If the detections near a keypoint are near no other keypoint, the keypoint takes the best detection
    entangled = np.isin(t, t[np.bincount(d)[d] > 1]) if len(d) else np.zeros(0, bool)
    star = np.flatnonzero(~entangled)
    won = [star[_first_of_each(t[star], -score[d[star]], distance[star], xy[d[star], 0], xy[d[star], 1])]]
    # All other keypoints and detections are numbered by score and place, so that the input order breaks no ties
    rest = np.flatnonzero(entangled)
    keypoints, a = np.unique(t[rest], return_inverse=True)
    a = _rank(truth.xy[keypoints, 1], truth.xy[keypoints, 0])[a]
    detections, b = np.unique(d[rest], return_inverse=True)
    b = _rank(xy[detections, 1], xy[detections, 0], -score[detections])[b]
    nodes = len(keypoints) + len(detections)
    graph = coo_array((np.ones(len(rest)), (a, len(keypoints) + b)), shape=(nodes, nodes))
    component = connected_components(graph, directed=False)[1][a] if nodes else a
    order = np.argsort(component, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(component[order])) + 1):
        won.append(rest[rows[_assign_component(a[rows], b[rows], distance[rest[rows]], score[d[rest[rows]]])]])
    return np.concatenate(won)


def _rank(*keys: Float) -> Int:
    """Return the rank of each row in lexicographic order. The last key has priority."""
    rank = np.empty(len(keys[0]), np.int64)
    rank[np.lexsort(keys)] = np.arange(len(rank))
    return rank


def _assign_component(a: Int, b: Int, distance: Float, score: Float) -> Int:
    """Return the rows of the best one-to-one assignment within one connected component of pairs (a, b).

    The sets of detections that can be matched together form a transversal matroid. So for any positive weights that
    rise with the score, the assignment of the largest total weight has the most matches and the highest scores. The
    weight of a pair is the rank of the score, a whole number, minus a fraction proportional to the distance. The
    fractions of an assignment add up to less than 1, so distances decide only between assignments of equal scores.
    """
    if not len(a):
        return np.zeros(0, np.int64)
    (rows, row), (columns, column) = np.unique(a, return_inverse=True), np.unique(b, return_inverse=True)
    rank = np.unique(score, return_inverse=True)[1] + 1
    unit = (distance.max() or 1.0) * (min(len(rows), len(columns)) + 1)
    weight = np.zeros((len(rows), len(columns)))
    weight[row, column] = rank - distance / unit
    pair = np.full(weight.shape, -1)
    pair[row, column] = np.arange(len(a))
    chosen = pair[linear_sum_assignment(weight, maximize=True)]
    return np.asarray(chosen[chosen >= 0])
