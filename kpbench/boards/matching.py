"""Find boards: which detection is which point of the board.

1. Each detection may be each point of its ID, in each rotation that leaves its design unchanged: a candidate. It gives
   the derivative J of the homography from the board to the image.
2. Two candidates confirm each other if one homography explains both. Along a line, a homography moves points by
   ``H(X₂) - H(X₁) = λ J₁ (X₂ - X₁)`` with ``λ = (det J₂ / det J₁)^(1/3)``, and ``J₁ - J₂ / λ`` is of rank 1, with
   columns parallel to this line.
3. From a candidate with enough confirmations, a homography is fitted, and fitted again with all detections that it
   explains.
4. Every set of points that explains as many of the same detections as the best one is an alternative.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kpbench.boards.frames import Frames, fit_homography, straighten
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.patches.board import Board
from kpbench.types import Detections, Float, Int

LEAST_MATCHED = 3
"""Smallest number of detections that make a board."""
PAIR_SLOPE, PAIR_OFFSET, PAIR_FRAME = 0.15, 0.3, 0.2
"""Two candidates confirm each other up to an error of ``PAIR_SLOPE`` times their distance plus ``PAIR_OFFSET`` radii,
and up to a relative error ``PAIR_FRAME`` of their frames."""
MOST_OFF, MOST_OFF_BENT = 0.2, 0.35
"""Largest distance of a detection from its point on the board, in disc radii: with a camera, and without one."""
MOST_TURNED = 0.35
"""Largest difference of a frame from its prediction, as Frobenius norm relative to the disc."""
MOST_OFF_FIRST = 0.8
"""``MOST_OFF`` of the first fit, which extrapolates. Discs do not overlap, so the nearest point is the right one."""
SIGMA = 0.02
"""Standard deviation of the errors of points and of entries of frames, in disc radii, for comparing alternatives."""
EXCLUDED = 50.0
"""Difference of two sums of squared errors, in ``SIGMA``, from which the worse explanation is excluded."""
MOST_PAIRS = 400_000
"""Largest number of pairs of candidates that are compared at a time."""


@dataclass(frozen=True)
class BoardMatch:
    """A board that was found in an image.

    Attributes
    ----------
    board : Board
    index : ndarray of shape (n,), int64
        The board's detections, as indices of the detections given to :func:`find_board`.
    points : ndarray of shape (n,), int64
        Index of the board's keypoint for each of these detections.
    detections : Detections
        These detections. Of the rotations that leave a design unchanged, ``A_patch2image`` has the one of the board.
    alternatives : tuple of BoardMatch
        Other matches that explain the image as well. Their own ``alternatives`` are empty.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> board = kpbench.hexagon_board(kpbench.shipped_patches()[0], side_mm=100.0)  # the same after half a turn
    >>> found = kpbench.Detections(
    ...     2 * board.points_mm[:, :2] + [320, 240], np.ones(6), np.zeros(6, int), np.tile(16 * np.eye(2), (6, 1, 1))
    ... )
    >>> [match] = kpbench.find_board(found, board)
    >>> match.ambiguous, [other.points.tolist() for other in (match, *match.alternatives)]
    (True, [[0, 1, 2, 3, 4, 5], [3, 4, 5, 0, 1, 2]])
    """

    board: Board
    index: Int
    points: Int
    detections: Detections
    alternatives: tuple[BoardMatch, ...] = ()

    @property
    def ambiguous(self) -> bool:
        """Whether other points of the board explain the detections as well."""
        return bool(self.alternatives)


@dataclass(frozen=True)
class PointCandidates:
    """S candidates: a detection, a point of the board, and the derivative J of the homography that they give.

    The board's unit is the mean radius of its discs. ``turn`` (S, 2, 2) rotates the frame of the detection.
    """

    detection: Int
    point: Int
    turn: Float
    xy: Float
    X: Float
    J: Float

    def __getitem__(self, rows: Int) -> PointCandidates:
        return PointCandidates(
            self.detection[rows], self.point[rows], self.turn[rows], self.xy[rows], self.X[rows], self.J[rows]
        )


@dataclass(frozen=True)
class Explanation:
    """PointCandidates that one homography explains, by detection, and the sum of their squared errors."""

    candidates: PointCandidates
    cost: float

    @property
    def detection(self) -> Int:
        """Index of each detection."""
        return self.candidates.detection


def find_board(detections: Detections, board: Board, camera: Camera | None = None) -> tuple[BoardMatch, ...]:
    """Find which detection is which keypoint of a board.

    A board is found from three of its patches on. False alarms, missing patches and several copies of the board do not
    matter. Without a camera, a lens may bend the board by about a third of a disc's radius.

    Parameters
    ----------
    detections : Detections
        Detections of one image, with ``patch_id`` and ``A_patch2image``.
    board : Board
    camera : Camera, optional
        Camera of the image. Its lens may be bent.

    Returns
    -------
    tuple of BoardMatch
        One per copy of the board, the most points first; empty if the board is not found. If several sets of points
        explain the image, as on a symmetric board, the match is ``ambiguous`` and lists all of them.

    Raises
    ------
    DataError
        If the detections have no identities or no affine frames, or a design of the board looks the same in every
        direction.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> board = kpbench.grid_board(kpbench.shipped_patches(), rows=2, columns=2, diameter_mm=20.0, pitch_mm=40.0)
    >>> found = kpbench.Detections(  # seen from the front, 3 px per mm
    ...     xy=3 * board.points_mm[::-1, :2] + [320, 240],
    ...     score=np.ones(4),
    ...     patch_id=[k.patch_id for k in board.keypoints[::-1]],
    ...     A_patch2image=np.tile(30 * np.eye(2), (4, 1, 1)),
    ... )
    >>> [match] = kpbench.find_board(found, board)
    >>> match.points.tolist(), match.ambiguous
    ([3, 2, 1, 0], False)
    """
    if detections.patch_id is None:
        raise DataError("the detector gives no patch IDs, which a board needs")
    frames = straighten(detections, camera)
    limit = MOST_OFF_BENT if camera is None else MOST_OFF
    candidates = _make_candidates(frames, detections.patch_id, board)
    explanations, left = list[Explanation](), np.argsort(-detections.score, kind="stable")
    left = left[np.isin(left, candidates.detection)]
    while len(left) >= LEAST_MATCHED:
        per_detection = np.bincount(candidates.detection, minlength=len(detections))[left]
        count = max(1, int(np.searchsorted(np.cumsum(per_detection) * len(candidates.detection), MOST_PAIRS)))
        seeds = np.flatnonzero(np.isin(candidates.detection, left[:count]))
        explanations += _explain(candidates, seeds, limit)
        explained = np.concatenate([left[:0], *(e.detection for e in explanations)])
        left = left[count:]
        left = left[~np.isin(left, explained)]
    return _choose(explanations, detections, board)


def _make_candidates(frames: Frames, patch_id: Int, board: Board) -> PointCandidates:
    """Return every pair of a detection and a point of its ID, in every rotation that leaves the design unchanged."""
    for k in board.keypoints:
        if not k.patch.symmetry_order:
            raise DataError(f"board {board.name!r}: {k.patch.name!r} looks the same in every direction")
    points, turns, to_patch = board.orientations
    ids, diameter_mm = np.array([(k.patch_id, k.diameter_mm) for k in board.keypoints]).T
    unit_mm = float(diameter_mm.mean()) / 2
    usable = np.isfinite(frames.xy[:, 0]) & (_det(frames.A) > 0)
    detection, row = np.nonzero((patch_id[:, None] == ids[points]) & usable[:, None])
    J = unit_mm * frames.A[detection] @ turns[row] @ to_patch[row]
    X = board.points_mm[points[row], :2] / unit_mm
    return PointCandidates(detection, points[row], turns[row], frames.xy[detection], X, J)


def _det(matrices: Float) -> Float:
    """Return the determinants of matrices (n, 2, 2), faster than NumPy."""
    return np.asarray(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])


def _confirm(seed: PointCandidates, other: PointCandidates) -> tuple[NDArray[np.bool_], Float]:
    """Return which candidates confirm each other, (S, T), and the relative errors of their distances, (S, T)."""
    det_seed, det_other = _det(seed.J)[:, None], _det(other.J)
    ratio = np.cbrt(det_other) / np.cbrt(det_seed)
    (X, Y), (x, y) = (other.X.T[:, None] - seed.X.T[:, :, None]), (other.xy.T[:, None] - seed.xy.T[:, :, None])
    (a, b), (c, d) = seed.J.transpose(1, 2, 0)[..., None]
    error = np.hypot(ratio * (a * X + b * Y) - x, ratio * (c * X + d * Y) - y)
    (a, b), (c, d) = other.J.transpose(1, 2, 0)
    error += np.hypot((a * X + b * Y) / ratio - x, (c * X + d * Y) / ratio - y)
    length = np.hypot(x, y)
    near = error <= 2 * PAIR_SLOPE * length + PAIR_OFFSET * (np.sqrt(det_seed) + np.sqrt(det_other))
    near &= (seed.detection[:, None] != other.detection) & (seed.point[:, None] != other.point) & (length > 0)
    s, t = np.nonzero(near)
    difference = seed.J[s] - other.J[t] / ratio[s, t, None, None]
    across = (x[s, t, None] * difference[:, 1] - y[s, t, None] * difference[:, 0]) / length[s, t, None]
    size = np.sqrt((seed.J[s] ** 2).sum(axis=(1, 2)))
    near[s, t] = np.hypot(across[:, 0], across[:, 1]) <= PAIR_FRAME * size
    return near, error / np.maximum(length, 1e-300)


def _explain(candidates: PointCandidates, seeds: Int, limit: float) -> list[Explanation]:
    """Return explanations that begin with some of the candidates, each once."""
    confirmed, error = _confirm(candidates[seeds], candidates)
    of_detection = candidates.detection == np.arange(candidates.detection.max(initial=0) + 1)[:, None]
    support = ((confirmed.astype(np.float32) @ of_detection.T.astype(np.float32)) > 0).sum(axis=1)
    found, used, best = list[Explanation](), set[int](), np.zeros(len(of_detection))
    for s in np.argsort(-support, kind="stable").tolist():
        seed = int(seeds[s])
        size = support[s] + 1
        if size < LEAST_MATCHED:
            break
        if seed in used or size < 0.6 * best[candidates.detection[seed]]:
            continue
        rows = _unique(candidates, np.flatnonzero(confirmed[s]), error[s])
        near = np.argsort(((candidates.X[rows] - candidates.X[seed]) ** 2).sum(axis=1), kind="stable")[:3]
        fitted = _fit(candidates, np.append(rows[near], seed), limit)
        if fitted is None:
            continue
        rows, cost = fitted
        used.update(rows.tolist())
        explanation = Explanation(candidates[rows[np.argsort(candidates.detection[rows])]], cost)
        best[explanation.detection] = np.maximum(best[explanation.detection], len(rows))
        found.append(explanation)
    return found


def _unique(candidates: PointCandidates, rows: Int, error: Float) -> Int:
    """Return some of the rows, least error first, so that each detection and each point occurs once."""
    kept, detections, points = list[int](), set[int](), set[int]()
    for row in rows[np.argsort(error[rows], kind="stable")].tolist():
        d, p = int(candidates.detection[row]), int(candidates.point[row])
        if d not in detections and p not in points:
            kept.append(row)
            detections.add(d)
            points.add(p)
    return np.array(kept, np.int64)


def _fit(candidates: PointCandidates, rows: Int, limit: float) -> tuple[Int, float] | None:
    """Fit a homography to candidates, then to all that it explains, until they stay. Return them and their cost."""
    for largest in (MOST_OFF_FIRST, limit, limit, limit):
        H = fit_homography(candidates.X[rows], candidates.xy[rows], candidates.J[rows])
        point_error, frame_error = _errors(H, candidates)
        near = np.flatnonzero((point_error <= largest) & (frame_error <= MOST_TURNED))
        before, rows = rows, _unique(candidates, near, point_error)
        if len(rows) < LEAST_MATCHED:
            return None
        if largest == limit and {*before.tolist()} == {*rows.tolist()}:
            break
    cost = (point_error[rows] ** 2 + frame_error[rows] ** 2).sum() / SIGMA**2
    return rows, float(cost)


def _errors(H: Float, candidates: PointCandidates) -> tuple[Float, Float]:
    """Return the errors of points and frames, in disc radii, of all candidates under a homography.

    Both are measured on the board; inf for a candidate that the homography cannot show.
    """
    X, J = candidates.X, candidates.J
    w = X @ H[2, :2] + H[2, 2]
    with np.errstate(all="ignore"):
        seen = (X @ H[:2, :2].T + H[:2, 2]) / w[:, None]
        expected = (H[:2, :2] - seen[:, :, None] * H[2, :2]) / w[:, None, None]
        (a, b), (c, d) = expected.transpose(1, 2, 0)
        back = np.array([[d, -b], [-c, a]]).transpose(2, 0, 1) / (a * d - b * c)[:, None, None]
        frame = np.sqrt(((back @ J - np.eye(2)) ** 2).sum(axis=(1, 2)))
        offset = np.einsum("nij,nj->ni", back, candidates.xy - seen)
        point = np.hypot(offset[:, 0], offset[:, 1])
        valid = (a * d - b * c > 0) & np.isfinite(frame) & np.isfinite(point)
    return np.where(valid, point, np.inf), np.where(valid, frame, np.inf)


def _choose(explanations: list[Explanation], detections: Detections, board: Board) -> tuple[BoardMatch, ...]:
    """Return the best explanations that share no detection, each with its alternatives."""
    chosen = list[list[Explanation]]()
    for e in sorted(explanations, key=lambda e: (-len(e.detection), e.cost)):
        rivals = [group for group in chosen if np.isin(e.detection, group[0].detection).any()]
        if not rivals:
            chosen.append([e])
        for group in rivals:
            best = group[0]
            limit = best.cost + EXCLUDED * max(1.0, best.cost / (6 * len(best.detection) - 8))
            if len(e.detection) == len(best.detection) and e.cost <= limit and not any(_are_equal(e, o) for o in group):
                group.append(e)

    def make(e: Explanation, *others: Explanation) -> BoardMatch:
        c, found = e.candidates, detections[e.detection]
        assert found.A_patch2image is not None
        found = replace(found, A_patch2image=found.A_patch2image @ c.turn)
        return BoardMatch(board, c.detection, c.point, found, tuple(map(make, others)))

    return tuple(make(*group) for group in chosen)


def _are_equal(first: Explanation, second: Explanation) -> bool:
    """Return whether two explanations pair the same detections with the same points."""
    a, b = first.candidates, second.candidates
    return np.array_equal(a.detection, b.detection) and np.array_equal(a.point, b.point)
