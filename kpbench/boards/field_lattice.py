"""Lattices in detections: which patches are neighbours, and the row and the column of each in a lattice of its own.

The frame of a patch tells where its eight neighbours are. Two patches that say so of each other are an edge. From a
patch and its neighbours, a homography is fitted. It grows by the patches around it that lie on its lattice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kpbench.boards.candidates import determinants
from kpbench.boards.frames import MOST_BENT, MOST_SCALED, Frames, fit_homography
from kpbench.types import Float, Int

QUARTERS = np.array([[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]])
"""Rotations by 0 to 3 quarters from +x towards +y."""
EDGE_ANGLE, EDGE_LENGTH, EDGE_TURN, EDGE_SCALE = 0.2, 0.45, 0.4, 0.7
"""Largest errors of an edge: of its direction, rad, of the logarithm of its length, of the rotation between the frames
of its two patches, rad, and of the logarithm of the ratio of their scales."""
PERSPECTIVE = 0.1
"""Standard deviation of the change of scale from a patch to its neighbour."""
EDGE_SIGMAS = 2.5
"""Largest error of the logarithm of the length of an edge, in standard deviations."""
START_ROUNDS = (2, 1)
"""Steps from the first patch to those of the first fit: at first, and if these do not fit."""
LEAST_START = 0.75
"""Part of the patches of the first fit that must fit."""
LEAST_PIECE = 4
"""Smallest number of patches that make a lattice."""
MANY, FRAMES_OF_MANY = 6, 30.0
"""From ``MANY`` patches on, points tell the homography, and the errors of frames are taken to be larger by this factor:
frames bias the perspective."""
FAR = 100_003
"""More than the rows of any field."""
FITS = 12
"""Largest number of fits of a homography as it grows."""
MEDIANS, LEAST_CUT = 5.0, 0.2
"""A patch that is fitted is at most this many times farther off than the median patch, or this far off, disc radii."""
LEAST_MEMBERS = 0.6
"""Part of the detections between the patches of a lattice that must lie on it, too."""
FIRST_OFF = 0.6
"""Largest distance of a patch from its place in the first fit, in disc radii."""
MOST_SCALED_MEMBER = 0.5
"""Largest error of the logarithm of the scale of a patch of the lattice, plus three standard deviations."""


@dataclass(frozen=True)
class Edges:
    """Pairs of neighbours, the best first: patch j is at ``step`` (E, 2) from patch i, as patch i is turned.

    The frame of patch j is that of patch i, rotated by ``quarter`` (E,) quarters.
    """

    i: Int
    j: Int
    step: Int
    quarter: Int


@dataclass(frozen=True)
class Piece:
    """Patches on one lattice.

    ``rows`` (m,) are detections, ``cell`` (m, 2) their places (column, row), ``off`` (m,) their distances from these
    places in disc radii. ``H`` maps the lattice, in disc radii, to the image. ``quarter`` (m,) is the rotation of each
    frame, and ``fits`` (m,) tells whether the frame agrees with ``H``.
    """

    rows: Int
    cell: Int
    off: Float
    H: Float
    quarter: Int
    fits: NDArray[np.bool_]


def find_pieces(frames: Frames, pitch: float, scale: Float, shape: Float, limit: float) -> list[Piece]:
    """Return the lattices in detections, each detection once.

    Parameters
    ----------
    frames : Frames
        Detections with finite points and frames of positive determinant.
    pitch : float
        Distance of neighbours, in disc radii.
    scale, shape : ndarray of shape (n,)
        Standard deviations of each frame, see :func:`kpbench.boards.frames.frame_errors`.
    limit : float
        Largest distance of a patch from its place, in disc radii.
    """
    n = len(frames.xy)
    inverse = np.asarray(np.linalg.inv(frames.A), np.float64)
    edges = _find_edges(frames, inverse, pitch, scale)
    degree = np.bincount(edges.i, minlength=n)
    free, is_seed, pieces = np.ones(n, bool), degree > 1, list[Piece]()
    for seed in np.argsort(-degree, kind="stable").tolist():
        if not free[seed] or not is_seed[seed]:
            continue
        for rounds in START_ROUNDS:
            start = _start(edges, seed, free, rounds)
            piece = _grow(frames, pitch, scale, shape, limit, start, free)
            if piece is not None:
                free[piece.rows] = False
                pieces.append(piece)
                break
    return pieces


def _find_edges(frames: Frames, inverse: Float, pitch: float, scale: Float) -> Edges:
    to_step = inverse / pitch
    dx, dy = (v - v[:, None] for v in frames.xy.T)
    (a, b), (c, d) = to_step.transpose(1, 2, 0)[..., None]
    u, v = a * dx + b * dy, c * dx + d * dy
    near = u * u + v * v < 2 * np.exp(2 * EDGE_LENGTH)
    i, j = np.nonzero(near & near.T)
    off_diagonal = i != j
    i, j = i[off_diagonal], j[off_diagonal]
    turned = inverse[i] @ frames.A[j]
    angle = np.arctan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1])
    quarter = np.rint(angle / (np.pi / 2)).astype(np.int64)
    good = np.abs(angle - quarter * (np.pi / 2)) <= EDGE_TURN
    good &= np.abs(np.log(np.maximum(determinants(turned), 1e-9))) / 2 <= EDGE_SCALE
    there = np.stack([u[i, j], v[i, j]], axis=1)
    back = (QUARTERS[quarter % 4] @ np.stack([u[j, i], v[j, i]], axis=1)[:, :, None])[:, :, 0]
    weight = 1 / (scale**2 + PERSPECTIVE**2)
    total = weight[i] + weight[j]
    mean = (there * weight[i, None] - back * weight[j, None]) / total[:, None]
    sigma = 1 / np.sqrt(total)
    good &= ((there + back) ** 2).sum(axis=1) <= (mean**2).sum(axis=1)
    direction = np.arctan2(mean[:, 1], mean[:, 0])
    eighth = np.rint(direction / (np.pi / 4))
    step = np.rint(np.stack([np.cos(eighth * (np.pi / 4)), np.sin(eighth * (np.pi / 4))], axis=1) * 1.2).astype(int)
    off_angle = np.abs(direction - eighth * (np.pi / 4))
    length = np.sqrt((mean**2).sum(axis=1) / np.maximum((step**2).sum(axis=1), 1))
    off_length = np.abs(np.log(np.maximum(length, 1e-9)))
    good &= (off_angle <= EDGE_ANGLE) & (off_length <= np.minimum(EDGE_LENGTH, EDGE_SIGMAS * sigma))
    best = np.flatnonzero(good)
    error = (2 * off_angle / EDGE_ANGLE) ** 2 + (off_length / sigma) ** 2 + sigma / PERSPECTIVE
    best = best[np.argsort(error[best], kind="stable")]
    return Edges(i[best], j[best], step[best], quarter[best] % 4)


def _start(edges: Edges, seed: int, free: NDArray[np.bool_], rounds: int) -> tuple[Int, Int, Int]:
    """Return patches within a few edges of a seed, their cells relative to it, and the quarters of their frames."""
    n = len(free)
    cell, quarter, placed = np.zeros((n, 2), np.int64), np.zeros(n, np.int64), np.zeros(n, bool)
    placed[seed] = True
    for _ in range(rounds):
        e = np.flatnonzero(placed[edges.i] & ~placed[edges.j] & free[edges.j])
        e = e[np.sort(np.unique(edges.j[e], return_index=True)[1])]
        before, new = edges.i[e], edges.j[e]
        at = cell[before] + (QUARTERS[quarter[before]] @ edges.step[e][:, :, None])[:, :, 0]
        taken = np.concatenate([cell[placed], at])
        first = np.unique(taken[:, 0] * FAR + taken[:, 1], return_index=True)[1]
        first = np.sort(first[first >= placed.sum()]) - placed.sum()
        e, before, new, at = e[first], before[first], new[first], at[first]
        cell[new] = at
        quarter[new] = (quarter[before] + edges.quarter[e]) % 4
        placed[new] = True
    rows = np.flatnonzero(placed)
    return rows, cell[rows], quarter[rows]


def _grow(
    frames: Frames,
    pitch: float,
    scale: Float,
    shape: Float,
    limit: float,
    start: tuple[Int, Int, Int],
    free: NDArray[np.bool_],
) -> Piece | None:
    """Fit a homography to patches, then to those around that lie on its lattice, until they stay."""
    rows, cell, quarter = start
    if len(rows) < LEAST_PIECE:
        return None
    pool = np.flatnonzero(free)
    xy, A = frames.xy[pool], frames.A[pool]
    fitted, before, largest = rows, rows[:0], FIRST_OFF
    for n in range(FITS):
        J = np.asarray(frames.A[fitted] @ QUARTERS[-quarter % 4], np.float64)
        weak = FRAMES_OF_MANY if len(fitted) >= MANY else 1.0
        H = fit_homography(
            np.asarray(cell * pitch, np.float64), frames.xy[fitted], J, weak * scale[fitted], weak * shape[fitted]
        )
        errors = _errors(H, xy, A, pitch)
        if errors is None:
            return None
        all_cells, off, turned, scaled, bent = errors
        low, high = cell.min(axis=0), cell.max(axis=0)
        reach = max(2, int((high - low).max()) // 2) if n else 0
        near = ((all_cells >= low - reach) & (all_cells <= high + reach)).all(axis=1)
        member = near & (off <= largest) & (scaled <= MOST_SCALED_MEMBER + 3 * scale[pool])
        fits = member & (scaled <= MOST_SCALED + 3 * scale[pool]) & (bent <= MOST_BENT + 3 * shape[pool])
        at = _one_per_cell(np.flatnonzero(fits), all_cells, off)
        if len(at) < LEAST_PIECE or (not n and len(at) < LEAST_START * len(rows)):
            return None
        fitted, cell, quarter = pool[at], all_cells[at], turned[at]
        if n and np.array_equal(fitted, before):
            break
        before, largest = fitted, min(limit, max(LEAST_CUT, MEDIANS * float(np.median(off[at]))))
    member = near & (off <= limit) & (scaled <= MOST_SCALED_MEMBER + 3 * scale[pool])
    low, high = cell.min(axis=0), cell.max(axis=0)
    among = ((all_cells >= low) & (all_cells <= high)).all(axis=1) & np.isfinite(off)
    if (member & among).sum() < LEAST_MEMBERS * among.sum():
        return None
    at = _one_per_cell(np.flatnonzero(member), all_cells, off - fits)
    return Piece(pool[at], all_cells[at], off[at], H, turned[at], fits[at])


def _one_per_cell(rows: Int, cells: Int, off: Float) -> Int:
    """Return some of the rows, in ascending order: of those of one cell, the one that is the least off."""
    rows = rows[np.argsort(off[rows], kind="stable")]
    key = cells[rows, 0] * FAR + cells[rows, 1]
    return np.sort(rows[np.unique(key, return_index=True)[1]])


def _errors(H: Float, xy: Float, A: Float, pitch: float) -> tuple[Int, Float, Int, Float, Float] | None:
    """Return the nearest cell of each detection, and how far it is off, its quarters, and the errors of its frame.

    The distance is in disc radii on the board. Detections that the homography cannot show are at infinity.
    """
    with np.errstate(all="ignore"):
        try:
            back = np.linalg.inv(H)
        except np.linalg.LinAlgError:
            return None
        X = xy @ back[:2, :2].T + back[:2, 2]
        X /= (xy @ back[2, :2] + back[2, 2])[:, None]
        w = X @ H[2, :2] + H[2, 2]
        (a, b), (c, d) = ((H[:2, :2] - xy[:, :, None] * H[2, :2]) / w[:, None, None]).transpose(1, 2, 0)
        determinant = a * d - b * c
        frame = (np.array([[d, -b], [-c, a]]) / determinant).transpose(2, 0, 1) @ A
        scale = np.sqrt(determinants(frame))
        angle = np.arctan2(frame[:, 1, 0] - frame[:, 0, 1], frame[:, 0, 0] + frame[:, 1, 1])
        quarter = np.nan_to_num(np.rint(angle / (np.pi / 2))).astype(np.int64)
        bent = np.sqrt(((frame / scale[:, None, None] - QUARTERS[quarter % 4]) ** 2).sum(axis=(1, 2)))
        valid = (determinant > 0) & (w > 0) & np.isfinite(bent) & (np.abs(X).max(axis=1) < 1e6)
        X[~valid] = 0.0
        cell = np.rint(X / pitch).astype(np.int64)
        off = np.where(valid, np.sqrt(((X - cell * pitch) ** 2).sum(axis=1)), np.inf)
        scaled = np.where(valid, np.abs(np.log(scale)), np.inf)
    return cell, off, quarter % 4, scaled, bent
