"""Find boards: which detection is which point of the board.

1. Each detection may be each point of its ID, in each rotation that leaves its design unchanged: a candidate. It gives
   the derivative J of the homography from the board to the image.
2. Two candidates confirm each other if one homography explains both. Along a line, a homography moves points by
   ``H(X₂) - H(X₁) = λ J₁ (X₂ - X₁)`` with ``λ = (det J₂ / det J₁)^(1/3)``. ``J₁ - J₂ / λ`` is of rank 1, with columns
   parallel to this line.
3. From a candidate with enough confirmations, a homography is fitted, and fitted again with all detections that it
   explains.
4. Every set of points that explains as many of the same detections as the best one is an alternative.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kpbench.boards.candidates import PointCandidates, confirm_pairs, homography_errors, make_candidates
from kpbench.boards.field import LEAST_PROBABILITY, FieldMatch, match_field
from kpbench.boards.frames import MOST_BENT, MOST_SCALED, POINT_SIGMA, Frames, fit_homography, straighten
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.patches.board import Board
from kpbench.patches.symmetry import board_turns_deg
from kpbench.types import Detections, Float, Float32, Int

LEAST_MATCHED = 3
"""Smallest number of detections that make a board."""
MOST_OFF, MOST_OFF_BENT = 0.2, 0.35
"""Largest distance of a detection from its point on the board, in disc radii: with a camera, and without one."""
MOST_OFF_FIRST = 0.9
"""The same for the first fit, which extrapolates. Discs do not overlap, so the nearest point is the right one."""
WORTH_FITTING = 0.9
"""A candidate is fitted if its confirmations are at least this part of those of the best fit with its detection."""
SURE_SCORE, SHARP_BLUR = 0.9, 0.15
"""The orientation of patches is believed if their mean score is at least ``SURE_SCORE``, or if their median blur is at
most ``SHARP_BLUR`` short semi-axes. Measured with superpoint-small on training photographs: box blur of half a disc's
width turns mushrooms, all of an image alike, at scores of 0.65; right orientations have scores over 0.95."""
FEW, FEW_COST = 4, 3.0
"""Up to ``FEW`` points are believed if their cost is at most ``FEW_COST`` per degree of freedom. Measured in simulated
scenes: right points cost up to 0.4, two right ones with a false alarm 6."""
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
    agrees : ndarray of shape (n,), bool
        Whether the frame of each detection agrees with the board, not only its place and identity.
    alternatives : tuple of BoardMatch
        Other matches that explain the image as well. Their own ``alternatives`` are empty.
    is_sure : bool
        False if the points are few and fit badly, or if nothing but the orientation of the patches tells the points
        and blur makes the orientation doubtful.
    probability : float
        On a field, the probability of the points; 1 on other boards, where ``alternatives`` tells what else may be.
    evidence : float
        On a field, the logarithm of how probable the detections are with these points, up to a constant; 0 on other
        boards. :func:`kpbench.boards.find_boards` compares fields by it.
    camera : Camera or None
        Camera with which the board was found.
    frames : Frames or None
        ``detections`` without the distortion of ``camera``; computed anew if None.

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
    agrees: NDArray[np.bool_]
    alternatives: tuple[BoardMatch, ...] = ()
    is_sure: bool = True
    probability: float = 1.0
    evidence: float = 0.0
    camera: Camera | None = None
    frames: Frames | None = None

    @property
    def ambiguous(self) -> bool:
        """Whether other points of the board explain the detections as well, or the match is not sure."""
        return bool(self.alternatives) or not self.is_sure


@dataclass(frozen=True)
class Explanation:
    """Candidates that one homography explains, by detection, and the sum of their squared errors.

    ``agrees`` (n,) tells whether the frame agrees with the homography, too.
    """

    candidates: PointCandidates
    agrees: NDArray[np.bool_]
    cost: float

    @property
    def count(self) -> int:
        """Number of frames that agree."""
        return int(self.agrees.sum())

    @property
    def cost_per_freedom(self) -> float:
        """The cost divided by the degrees of freedom: 6 per frame that agrees, without the 8 of the homography."""
        return self.cost / (6 * self.count - 8)

    @property
    def detection(self) -> Int:
        """Index of each detection."""
        return self.candidates.detection


def find_board(detections: Detections, board: Board, camera: Camera | None = None) -> tuple[BoardMatch, ...]:
    """Find which detection is which keypoint of a board.

    A field (:func:`kpbench.field_board`) is found from any part of it that tells its place, about 3 x 3 patches, and
    patches that are read as another letter get their points, too. Other boards are found from three of their patches
    on. False alarms, missing patches and several copies of the board do not
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
    if not len(detections):
        return ()
    if detections.patch_id is None:
        raise DataError("the detector gives no patch IDs, which a board needs")
    frames = straighten(detections, camera)
    limit = MOST_OFF_BENT if camera is None else MOST_OFF
    if board.lattice is not None:
        fields = match_field(frames, detections.patch_id, board, board.lattice, limit)
        return tuple(_make_field_match(field, detections, board, frames, camera) for field in fields)
    candidates = make_candidates(frames, detections.patch_id, board)
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
    return _choose(explanations, detections, board, frames, camera)


def _explain(candidates: PointCandidates, seeds: Int, limit: float) -> list[Explanation]:
    """Return explanations that begin with some of the candidates, each once."""
    confirmed, error = confirm_pairs(candidates[seeds], candidates)
    of_detection, of_point = _one_hot(candidates.detection), _one_hot(candidates.point)
    counts = [((confirmed.astype(np.float32) @ hot) > 0).sum(axis=1) for hot in (of_detection, of_point)]
    support = np.minimum(*counts)
    found, used, best = list[Explanation](), set[int](), np.zeros(of_detection.shape[1])
    for s in np.argsort(-support, kind="stable").tolist():
        seed = int(seeds[s])
        size = support[s] + 1
        if size < LEAST_MATCHED:
            break
        if seed in used or size < WORTH_FITTING * best[candidates.detection[seed]]:
            continue
        rows = _unique(candidates, np.flatnonzero(confirmed[s]), error[s])
        near = np.argsort(((candidates.X[rows] - candidates.X[seed]) ** 2).sum(axis=1), kind="stable")[:3]
        fitted = _fit(candidates, np.append(rows[near], seed), limit)
        if fitted is None:
            continue
        rows, explanation = fitted
        used.update(rows[explanation.agrees].tolist())
        best[explanation.detection] = np.maximum(best[explanation.detection], explanation.count)
        found.append(explanation)
    return found


def _one_hot(index: Int) -> Float32:
    """Return a matrix (S, n) with a one in the column that each of S indices names."""
    return np.asarray(index[:, None] == np.arange(index.max(initial=0) + 1), np.float32)


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


def _fit(candidates: PointCandidates, rows: Int, limit: float) -> tuple[Int, Explanation] | None:
    """Fit a homography to candidates, then to all that it explains, until they stay. Return what it explains."""
    for largest in (MOST_OFF_FIRST, limit, limit, limit):
        part = candidates[rows]
        H = fit_homography(part.X, part.xy, part.J, part.scale, part.shape)
        off, bent, scaled = homography_errors(H, candidates)
        agrees = (bent <= MOST_BENT + 3 * candidates.shape) & (scaled <= MOST_SCALED + 3 * candidates.scale)
        before, rows = rows, _unique(candidates, np.flatnonzero((off <= largest) & agrees), off)
        if len(rows) < LEAST_MATCHED:
            return None
        if largest == limit and {*before.tolist()} == {*rows.tolist()}:
            break
    squares = (off / POINT_SIGMA) ** 2 + (bent / candidates.shape) ** 2 + (scaled / candidates.scale) ** 2
    cost = float(squares[rows].sum())
    rest = np.flatnonzero((off <= limit / 2) & ~np.isin(candidates.point, candidates.point[rows]))
    rest = rest[~np.isin(candidates.detection[rest], candidates.detection[rows])]
    rows = np.append(rows, _unique(candidates, rest, off + 1e-6 * bent))
    rows = rows[np.argsort(candidates.detection[rows])]
    return rows, Explanation(candidates[rows], agrees[rows], cost)


def _choose(
    explanations: list[Explanation], detections: Detections, board: Board, frames: Frames, camera: Camera | None
) -> tuple[BoardMatch, ...]:
    """Return the best explanations that share no detection, each with its alternatives."""
    chosen = list[list[Explanation]]()
    for e in sorted(explanations, key=lambda e: (-e.count, e.cost)):
        rivals = [group for group in chosen if np.isin(e.detection, group[0].detection).any()]
        if not rivals:
            chosen.append([e])
        for group in rivals:
            best = group[0]
            limit = best.cost + EXCLUDED * max(1.0, best.cost_per_freedom)
            if e.count == best.count and e.cost <= limit and not any(_are_equal(e, o) for o in group):
                group.append(e)

    def make(e: Explanation, *others: Explanation) -> BoardMatch:
        c, found = e.candidates, detections[e.detection]
        assert found.A_patch2image is not None
        found = replace(found, A_patch2image=found.A_patch2image @ c.turn)
        straight = frames[e.detection]
        straight = replace(straight, A=straight.A @ c.turn)
        is_sure = _has_sharp_patches(found) or not _depends_on_frames(c.point, board)
        is_sure &= e.count > FEW or e.cost_per_freedom <= FEW_COST
        return BoardMatch(
            board, c.detection, c.point, found, e.agrees, tuple(map(make, others)), is_sure, 1.0, 0.0, camera, straight
        )

    return tuple(make(*group) for group in chosen)


def _make_field_match(
    field: FieldMatch, detections: Detections, board: Board, frames: Frames, camera: Camera | None
) -> BoardMatch:
    order = np.argsort(field.rows)
    rows, turn = field.rows[order], field.turn[order]
    d, straight = detections, frames[rows]
    assert d.A_patch2image is not None
    assert d.patch_id is not None
    optional = (None if column is None else column[rows] for column in (d.covariance, d.blur_px))
    found = Detections(d.xy[rows], d.score[rows], d.patch_id[rows], d.A_patch2image[rows] @ turn, *optional)
    straight = Frames(straight.xy, straight.A @ turn, straight.covariance)
    of_board = board, rows, field.points[order], found, field.agrees[order], ()
    is_sure = field.probability >= LEAST_PROBABILITY
    return BoardMatch(*of_board, is_sure, field.probability, field.evidence, camera, straight)


def _has_sharp_patches(found: Detections) -> bool:
    """Return whether the orientation of patches can be believed."""
    if found.score.mean() >= SURE_SCORE:
        return True
    if found.blur_px is None or found.A_patch2image is None:
        return False
    short = np.linalg.svd(found.A_patch2image, compute_uv=False)[:, 1]
    return bool(np.median(found.blur_px / short) <= SHARP_BLUR)


def _depends_on_frames(points: Int, board: Board) -> bool:
    """Return whether places and identities alone leave several points to choose from.

    Four points fit any four points of their identities. More points only fit a rotation of the whole board.
    """
    ids = [k.patch_id for k in board.keypoints]
    if len(points) <= FEW and any(ids.count(ids[n]) > 1 for n in points):
        return True
    return bool(board_turns_deg(board, by_place=True))


def _are_equal(first: Explanation, second: Explanation) -> bool:
    """Return whether two explanations pair the same detections with the same points."""
    a, b = first.candidates, second.candidates
    return np.array_equal(a.detection, b.detection) and np.array_equal(a.point, b.point)
