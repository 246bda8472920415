"""Which detection explains which true keypoint: one-to-one, over all images at once.

Most matches first, then the highest scores, then the smallest distances, then place in (x, y). Identities
never decide, and the order of images, keypoints and detections changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kpbench.types import Float, Int

MATCHED, DUPLICATE, NEAR_MISS, CLUTTER = range(4)
"""What a detection is: see :class:`Matches`."""
PAIRS_AT_ONCE = 2_000_000  # candidate pairs in memory at a time


@dataclass(frozen=True)
class Matches:
    """Who was matched to whom, for T true keypoints and D detections of any number of images.

    Attributes
    ----------
    detection : ndarray of shape (T,), int64
        The detection that a true keypoint was matched to, or -1.
    distance : ndarray of shape (T,), float64, px
        To that detection; nan where there is none.
    contradicted : ndarray of shape (T,), bool
        Whether another detection equals the matched one in place and score but not in identity: then the
        detector has not said which identity it means, and no order may decide it.
    nearest : ndarray of shape (D,), int64
        The nearest true keypoint that a detection reaches, matched or not, or -1.
    kind : ndarray of shape (D,), uint8
        ``MATCHED``; ``DUPLICATE``: it reaches a keypoint that another detection explains; ``NEAR_MISS``: it
        reaches none, but lies within one radius of one; ``CLUTTER``: all else.
    """

    detection: Int
    distance: Float
    contradicted: NDArray[np.bool_]
    nearest: Int
    kind: NDArray[np.uint8]


def match(
    truth_xy: Float,
    truth_image: Int,
    radius: Float,
    eps: float,
    xy: Float,
    score: Float,
    image: Int,
    patch_id: Int | None = None,
) -> Matches:
    """Match the detections of all images at once.

    Parameters
    ----------
    truth_xy : ndarray of shape (T, 2), px
    truth_image : ndarray of shape (T,)
        Number of the image, 0 or more, of each true keypoint.
    radius : ndarray of shape (T,), px
    eps : float
        In radii; a distance equal to ``eps * radius`` is a match.
    xy : ndarray of shape (D, 2), px
    score : ndarray of shape (D,)
    image : ndarray of shape (D,)
    patch_id : ndarray of shape (D,), optional
        Used for ``contradicted`` only.
    """
    reach = eps * radius
    t, d, distance = _pairs_within(truth_xy, truth_image, np.maximum(reach, radius), xy, image)
    kind = np.full(len(xy), CLUTTER, np.uint8)
    kind[d] = NEAR_MISS
    inside = distance <= reach[t]
    t, d, distance = t[inside], d[inside], distance[inside]
    kind[d] = DUPLICATE

    contested = _contested(t, d)
    detection, gap = np.full(len(truth_xy), -1), np.full(len(truth_xy), np.nan)
    won = _explain(t, d, distance, contested, truth_xy, xy, score)
    detection[t[won]], gap[t[won]] = d[won], distance[won]
    kind[detection[detection >= 0]] = MATCHED

    shared = np.bincount(d, minlength=len(xy))[d] > 1
    nearest = np.full(len(xy), -1)
    nearest[d[~shared]] = t[~shared]
    torn = np.flatnonzero(shared)
    closest = torn[_best(d[torn], distance[torn], truth_xy[t[torn], 0], truth_xy[t[torn], 1])]
    nearest[d[closest]] = t[closest]

    contradicted = np.zeros(len(truth_xy), bool)
    if patch_id is not None:
        t, d = t[contested], d[contested]
        t, d = t[detection[t] >= 0], d[detection[t] >= 0]
        twin = (score[d] == score[detection[t]]) & (xy[d] == xy[detection[t]]).all(axis=1)
        contradicted[t[twin & (patch_id[d] != patch_id[detection[t]])]] = True
    return Matches(detection, gap, contradicted, nearest, kind)


def matched_within(
    truth_xy: Float, truth_image: Int, radius: Float, eps: Sequence[float], xy: Float, score: Float, image: Int
) -> list[int]:
    """How many keypoints are matched at each ``eps``; parameters are those of :func:`match`."""
    t, d, distance = _pairs_within(truth_xy, truth_image, max(eps) * radius, xy, image)
    counts = []
    for value in eps:
        near = distance <= value * radius[t]
        pairs = t[near], d[near], distance[near]
        counts.append(len(_explain(*pairs, _contested(*pairs[:2]), truth_xy, xy, score)))
    return counts


def _contested(t: Int, d: Int) -> NDArray[np.bool_]:
    """Which pairs share a keypoint or a detection with another; nearly none do."""
    return (np.bincount(t)[t] > 1) | (np.bincount(d)[d] > 1) if len(t) else np.zeros(0, bool)


def _explain(
    t: Int, d: Int, distance: Float, contested: NDArray[np.bool_], truth_xy: Float, xy: Float, score: Float
) -> Int:
    """Rows of the pairs that are matches."""
    rows = np.flatnonzero(contested)
    won = _resolve(t[rows], d[rows], distance[rows], truth_xy, xy, score)
    return np.concatenate([np.flatnonzero(~contested), rows[won]])


def _pairs_within(truth_xy: Float, truth_image: Int, reach: Float, xy: Float, image: Int) -> tuple[Int, Int, Float]:
    """All (keypoint, detection) pairs of one image that are at most ``reach`` (of the keypoint) apart, in px.

    All images lie side by side on one sorted axis, image number times a stride plus x, so that one binary
    search a keypoint finds who is near in x. The axis is coarse; the distance itself is exact.
    """
    nothing = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    if not len(truth_xy) or not len(xy):
        return nothing
    low, high = (truth_xy[:, 0] - reach).min(), (truth_xy[:, 0] + reach).max()
    stride = 2 * (high - low) + 1
    slack = (1 + truth_image.max()) * stride * 1e-15
    place = np.clip(xy[:, 0], low, high) - low + stride * image
    order = np.argsort(place)
    place = place[order]
    centre = truth_xy[:, 0] - low + stride * truth_image
    first = np.searchsorted(place, centre - reach - slack, side="left")
    many = np.searchsorted(place, centre + reach + slack, side="right") - first
    ends = np.cumsum(many)
    found = [nothing]
    start = 0
    while start < len(truth_xy):  # in blocks, to bound the memory
        stop = max(start + 1, int(np.searchsorted(ends, ends[start] + PAIRS_AT_ONCE)))
        t = np.repeat(np.arange(start, stop), many[start:stop])
        within = np.arange(len(t)) - (ends[t] - many[t] - (ends[start] - many[start]))
        d = order[first[t] + within]
        with np.errstate(over="ignore"):
            distance = np.hypot(xy[d, 0] - truth_xy[t, 0], xy[d, 1] - truth_xy[t, 1])
        near = distance <= reach[t]
        found.append((t[near], d[near], distance[near]))
        start = stop
    ts, ds, distances = zip(*found, strict=True)
    return np.concatenate(ts), np.concatenate(ds), np.concatenate(distances)


def _best(group: Int, *keys: NDArray[Any]) -> Int:
    """Of each group the row that is smallest in ``keys``, the first key counting most."""
    order = np.lexsort((*reversed(keys), group))
    first: Int = order[np.append(True, np.diff(group[order]) != 0)[: len(order)]]
    return first


def _resolve(t: Int, d: Int, distance: Float, truth_xy: Float, xy: Float, score: Float) -> Int:
    """Which of the contested pairs are matches."""
    # Detections that no other keypoint wants: the best of them takes the keypoint
    entangled = np.isin(t, t[np.bincount(d)[d] > 1]) if len(d) else np.zeros(0, bool)
    star = np.flatnonzero(~entangled)
    won = [star[_best(t[star], -score[d[star]], distance[star], xy[d[star], 0], xy[d[star], 1])]]
    # The rest in canonical numbers (best detection first), so that no input order can be felt
    rest = np.flatnonzero(entangled)
    keypoints, a = np.unique(t[rest], return_inverse=True)
    a = _rank(truth_xy[keypoints, 1], truth_xy[keypoints, 0])[a]
    detections, b = np.unique(d[rest], return_inverse=True)
    b = _rank(xy[detections, 1], xy[detections, 0], -score[detections])[b]
    nodes = len(keypoints) + len(detections)
    graph = coo_array((np.ones(len(rest)), (a, len(keypoints) + b)), shape=(nodes, nodes))
    component = connected_components(graph, directed=False)[1][a] if nodes else a
    order = np.argsort(component, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(component[order])) + 1):
        won.append(rest[rows[_assign(a[rows], b[rows], distance[rest[rows]], score[d[rest[rows]]])]])
    return np.concatenate(won)


def _rank(*keys: Float) -> Int:
    """Position of each row when sorted by the last key, then the one before, …"""
    rank = np.empty(len(keys[0]), np.int64)
    rank[np.lexsort(keys)] = np.arange(len(rank))
    return rank


def _assign(a: Int, b: Int, distance: Float, score: Float) -> Int:
    """Rows of the optimal one-to-one assignment within one connected component of pairs (a, b).

    The sets of detections that can be matched together are a matroid (a transversal one). So with *any* positive
    weights that rise with the score, the heaviest assignment has most matches and the highest scores. Whole
    numbers, the rank of the score, leave the fraction to the distances: their sum counts less than one rank.
    """
    if not len(a):
        return np.zeros(0, np.int64)
    (rows, row), (columns, column) = np.unique(a, return_inverse=True), np.unique(b, return_inverse=True)
    rank = np.unique(score, return_inverse=True)[1] + 1
    unit = (distance.max() or 1.0) * (min(len(rows), len(columns)) + 1)
    gain = np.zeros((len(rows), len(columns)))
    gain[row, column] = rank - distance / unit
    pair = np.full(gain.shape, -1)
    pair[row, column] = np.arange(len(a))
    chosen = pair[linear_sum_assignment(gain, maximize=True)]
    return np.asarray(chosen[chosen >= 0])
