"""Candidates: what each detection may be, which candidates confirm each other, and what a homography says of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kpbench.boards.frames import Frames, frame_errors
from kpbench.errors import DataError
from kpbench.patches.board import Board
from kpbench.types import Float, Int

PAIR_ANGLE, PAIR_LENGTH, PAIR_OFFSET = 0.2, 0.3, 0.3
"""Two candidates confirm each other up to these errors of directions, rad, and of the logarithm of lengths, plus the
errors of their frames, plus ``PAIR_OFFSET`` radii of a disc over their distance."""


@dataclass(frozen=True)
class PointCandidates:
    """S candidates: a detection, a point of the board, and the derivative J of the homography that they give.

    The board's unit is the mean radius of its discs. ``turn`` (S, 2, 2) rotates the frame of the detection. ``scale``
    and ``shape`` are the standard deviations of J, see :func:`kpbench.boards.frames.frame_errors`.
    """

    detection: Int
    point: Int
    turn: Float
    xy: Float
    X: Float
    J: Float
    scale: Float
    shape: Float

    def __getitem__(self, rows: Int) -> PointCandidates:
        of_board = self.X[rows], self.J[rows], self.scale[rows], self.shape[rows]
        return PointCandidates(self.detection[rows], self.point[rows], self.turn[rows], self.xy[rows], *of_board)


def make_candidates(frames: Frames, patch_id: Int, board: Board) -> PointCandidates:
    """Return every pair of a detection and a point of its ID, in every rotation that leaves the design unchanged."""
    for k in board.keypoints:
        if not k.patch.symmetry_order:
            raise DataError(f"board {board.name!r}: {k.patch.name!r} looks the same in every direction")
    points, turns, to_patch = board.orientations
    ids, diameter_mm = np.array([(k.patch_id, k.diameter_mm) for k in board.keypoints]).T
    unit_mm = float(diameter_mm.mean()) / 2
    usable = np.isfinite(frames.xy[:, 0]) & (determinants(frames.A) > 0)
    detection, row = np.nonzero((patch_id[:, None] == ids[points]) & usable[:, None])
    X = board.points_mm[points[row], :2] / unit_mm
    J = unit_mm * frames.A[detection] @ turns[row] @ to_patch[row]
    scale, shape = np.array([frame_errors(k.patch) for k in board.keypoints]).T
    of_board = X, J, scale[points[row]], shape[points[row]]
    return PointCandidates(detection, points[row], turns[row], frames.xy[detection], *of_board)


def determinants(matrices: Float) -> Float:
    """Return the determinants of matrices (n, 2, 2), faster than NumPy."""
    return np.asarray(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])


def confirm_pairs(seed: PointCandidates, other: PointCandidates) -> tuple[NDArray[np.bool_], Float]:
    """Return which candidates confirm each other, (S, T), and how badly they do, (S, T)."""
    det_seed, det_other = determinants(seed.J)[:, None], determinants(other.J)
    (X, Y), (x, y) = (other.X.T[:, None] - seed.X.T[:, :, None]), (other.xy.T[:, None] - seed.xy.T[:, :, None])
    ratio = np.cbrt(det_other) / np.cbrt(det_seed)
    length = np.maximum(np.hypot(x, y), 1e-12)
    offset = PAIR_OFFSET * (np.sqrt(det_seed) + np.sqrt(det_other)) / (2 * length)
    error = np.zeros_like(length)
    near = (seed.detection[:, None] != other.detection) & (seed.point[:, None] != other.point)
    sigma = seed.scale[:, None] + other.scale
    for J, factor, shape in ((seed.J[:, None], ratio, seed.shape[:, None]), (other.J, 1 / ratio, other.shape)):
        u, v = J[..., 0, 0] * X + J[..., 0, 1] * Y, J[..., 1, 0] * X + J[..., 1, 1] * Y
        predicted = np.maximum(np.hypot(u, v), 1e-12)
        sine = np.abs(u * y - v * x) / (predicted * length)
        near &= (u * x + v * y > 0) & (sine <= PAIR_ANGLE + 2 * shape + offset)
        stretch = np.abs(np.log(length / (factor * predicted)))
        near &= stretch <= PAIR_LENGTH + 2 * sigma + offset
        error += sine + stretch / (1 + 8 * sigma)
    s, t = np.nonzero(near)
    across = np.stack([-y[s, t], x[s, t]], axis=-1)[:, None]  # the derivatives across are parallel on the board
    first, second = (across @ seed.J[s])[:, 0], (across @ other.J[t])[:, 0]
    sine = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    size = np.hypot(first[:, 0], first[:, 1]) * np.hypot(second[:, 0], second[:, 1])
    near[s, t] = (sine <= (PAIR_ANGLE + 2 * (seed.shape[s] + other.shape[t])) * size) & ((first * second).sum(1) > 0)
    return near, error


def homography_errors(H: Float, candidates: PointCandidates) -> tuple[Float, Float, Float]:
    """Return the errors of all candidates under a homography: of the points, and of the frames' shape and log scale.

    Points and shapes are measured on the board, in disc radii; inf for a candidate that the homography cannot show.
    """
    X, J = candidates.X, candidates.J
    w = X @ H[2, :2] + H[2, 2]
    with np.errstate(all="ignore"):
        seen = (X @ H[:2, :2].T + H[:2, 2]) / w[:, None]
        expected = (H[:2, :2] - seen[:, :, None] * H[2, :2]) / w[:, None, None]
        (a, b), (c, d) = expected.transpose(1, 2, 0)
        back = np.array([[d, -b], [-c, a]]).transpose(2, 0, 1) / (a * d - b * c)[:, None, None]
        frame = back @ J
        scale = np.sqrt(determinants(frame))
        bent = np.sqrt(((frame / scale[:, None, None] - np.eye(2)) ** 2).sum(axis=(1, 2)))
        offset = (back @ (candidates.xy - seen)[..., None])[..., 0]
        off = np.hypot(offset[:, 0], offset[:, 1])
        valid = (a * d - b * c > 0) & np.isfinite(bent) & np.isfinite(off)
        errors = off, bent, np.abs(np.log(scale))
    off, bent, scaled = (np.where(valid, error, np.inf) for error in errors)
    return off, bent, scaled
