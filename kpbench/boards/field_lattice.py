"""Lattices in detections: which patches are neighbours, and the row and the column of each in a lattice of its own.

The frame of a patch tells where its eight neighbours are. Two patches that say so of each other are an edge. From a
patch and its neighbours, a homography is fitted. It grows by the patches around it that lie on its lattice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kpbench.boards.candidates import determinants
from kpbench.boards.frames import MOST_BENT, MOST_SCALED, RIDGE, Frames, fit_homography
from kpbench.types import Float, Int

Bools = NDArray[np.bool_]
QUARTERS = np.array([[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]])
"""Rotations by 0 to 3 quarters from +x towards +y."""
QUARTER_TURNS = np.array([1, 1j, -1, -1j])
"""The same of complex numbers x + iy."""
EDGE_ANGLE, EDGE_LENGTH, EDGE_TURN, EDGE_SCALE = 0.2, 0.45, 0.4, 0.7
"""Largest errors of an edge: of its direction, rad, of the logarithm of its length, of the rotation between the frames
of its two patches, rad, and of the logarithm of the ratio of their scales."""
EIGHTHS = np.array([[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]])
"""Steps to the eight neighbours, from +x towards +y."""
FARTHEST = 2 * np.exp(2 * EDGE_LENGTH)
"""Square of the largest distance of a neighbour, in pitches, as the frame of one patch measures it."""
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
POINTS_ALONE, LEAST_CELL_SPREAD = 9, 0.3
"""From ``POINTS_ALONE`` patches on, points alone tell the homography, if the cells are not on a line nor almost: with
the variances a and b of the cells along their axes, ``a b / (a + b)`` is at least ``LEAST_CELL_SPREAD``. It is 1/3 for
3 x 3 cells, and at most 1/4 for two rows."""
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
    fits: Bools


@dataclass(frozen=True)
class Columns:
    """What growing a lattice reads of n detections.

    ``points`` (3, n) are homogeneous, ``A`` (2, 2, n) are the frames, ``weight`` (n,) is one over the size of a patch.
    The other columns (n,) are the standard deviations of the frames and the limits that follow from them.
    """

    frames: Frames
    points: Float
    A: Float
    weight: Float
    scale: Float
    shape: Float
    most_scaled_member: Float
    most_scaled: Float
    most_bent: Float


def _make_columns(frames: Frames, scale: Float, shape: Float) -> Columns:
    points, A = np.vstack([frames.xy.T, np.ones(len(frames.xy))]), np.ascontiguousarray(frames.A.transpose(1, 2, 0))
    weight = 1 / np.sqrt(determinants(frames.A))
    limits = (
        most + 3 * error for most, error in ((MOST_SCALED_MEMBER, scale), (MOST_SCALED, scale), (MOST_BENT, shape))
    )
    return Columns(frames, points, A, weight, scale, shape, *limits)


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
    columns = _make_columns(frames, scale, shape)
    (a, b), (c, d) = columns.A
    inverse = (np.array([[d, -b], [-c, a]]) / (a * d - b * c)).transpose(2, 0, 1)
    edges = _find_edges(frames, inverse, pitch, scale)
    degree = np.bincount(edges.i, minlength=n)
    free, is_seed, pieces = np.ones(n, bool), degree > 1, list[Piece]()
    seeds = np.argsort(-degree, kind="stable")
    for seed in seeds[is_seed[seeds]].tolist():
        if not free[seed]:
            continue
        for rounds in START_ROUNDS:
            start = _start(edges, seed, free, rounds)
            piece = _grow(columns, pitch, limit, start, free)
            if piece is not None:
                free[piece.rows] = False
                pieces.append(piece)
                break
    return pieces


def _find_edges(frames: Frames, inverse: Float, pitch: float, scale: Float) -> Edges:
    """Return pairs of patches whose frames agree that they are neighbours. Vectors are complex numbers here."""
    to_step = inverse / pitch
    i, j = _find_near(frames.xy, to_step)
    (a, b), (c, d) = inverse.transpose(1, 2, 0)[:, :, i]
    (e, f), (g, h) = frames.A.transpose(1, 2, 0)[:, :, j]
    across, straight = c * e + d * g - a * f - b * h, a * e + b * g + c * f + d * h
    determinant = (a * d - b * c) * (e * h - f * g)
    angle = np.arctan2(across, straight)
    quarter = np.rint(angle / (np.pi / 2))
    good = np.abs(angle - quarter * (np.pi / 2)) <= EDGE_TURN
    good &= np.abs(np.log(np.maximum(determinant, 1e-9))) <= 2 * EDGE_SCALE
    i, j, quarter = i[good], j[good], quarter[good].astype(np.int64) % 4
    dx, dy = (frames.xy[j] - frames.xy[i]).T
    to_x, to_y = (to_step[:, 0] + 1j * to_step[:, 1]).T
    there = to_x[i] * dx + to_y[i] * dy
    back = -(to_x[j] * dx + to_y[j] * dy) * QUARTER_TURNS[quarter]
    weight = 1 / (scale**2 + PERSPECTIVE**2)
    total = weight[i] + weight[j]
    mean = (there * weight[i] - back * weight[j]) / total
    sigma, length = 1 / np.sqrt(total), np.abs(mean)
    eighths = np.angle(mean) * (4 / np.pi)
    nearest = np.rint(eighths)
    off_angle, eighth = np.abs(eighths - nearest) * (np.pi / 4), nearest.astype(np.int64) % 8
    off_length = np.abs(np.log(np.maximum(length / np.where(eighth % 2, np.sqrt(2), 1.0), 1e-9)))
    good = (np.abs(there + back) <= length) & (off_angle <= EDGE_ANGLE)
    good &= off_length <= np.minimum(EDGE_LENGTH, EDGE_SIGMAS * sigma)
    error = (2 * off_angle / EDGE_ANGLE) ** 2 + (off_length / sigma) ** 2 + sigma / PERSPECTIVE
    best = np.flatnonzero(good)
    best = best[np.argsort(error[best], kind="stable")]
    i, j, eighth, quarter = i[best], j[best], eighth[best], quarter[best]
    opposite = (eighth + 4 - 2 * quarter) % 8
    both = np.array([[i, j], [j, i], [eighth, opposite], [quarter, -quarter % 4]]).transpose(0, 2, 1).reshape(4, -1)
    return Edges(both[0], both[1], EIGHTHS[both[2]], both[3])


def _find_near(xy: Float, to_step: Float) -> tuple[Int, Int]:
    """Return pairs of patches i < j of which each may be a neighbour of the other, as its frame measures distances.

    ``|to_step (p - q)|²`` is a sum of products of a row of patch q and a column of patch p.
    """
    x, y = (xy - xy.mean(axis=0)).T
    (a, b), (c, d) = to_step.transpose(1, 2, 0)
    xx, mixed, yy = a * a + c * c, 2 * (a * b + c * d), b * b + d * d
    constant = xx * x * x + mixed * x * y + yy * y * y - FARTHEST
    rows = np.array([xx, mixed, yy, -2 * xx * x - mixed * y, -2 * yy * y - mixed * x, constant])
    near = rows.T @ np.array([x * x, x * y, y * y, x, y, np.ones(len(x))]) < 0
    i, j = np.divmod(np.flatnonzero(near & near.T), len(xy))
    upper = i < j
    return i[upper], j[upper]


def _start(edges: Edges, seed: int, free: Bools, rounds: int) -> tuple[Int, Int, Int]:
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


def _grow(columns: Columns, pitch: float, limit: float, start: tuple[Int, Int, Int], free: Bools) -> Piece | None:
    """Fit a homography to patches, then to those around that lie on its lattice, until they stay."""
    rows, cell, quarter = start
    if len(rows) < LEAST_PIECE:
        return None
    fitted, before, largest = rows, rows[:0], FIRST_OFF
    for n in range(FITS):
        H = _fit(columns, fitted, cell, quarter, pitch)
        errors = _errors(H, columns, pitch)
        if errors is None:
            return None
        all_cells, off, turned, scaled, bent = errors
        low, high = cell.min(axis=0), cell.max(axis=0)
        reach = max(2, int((high - low).max()) // 2) if n else 1
        near = free & _is_between(all_cells, low - reach, high + reach)
        member = near & (off <= largest) & (scaled <= columns.most_scaled_member)
        fits = member & (scaled <= columns.most_scaled) & (bent <= columns.most_bent)
        at = _one_per_cell(np.flatnonzero(fits), all_cells, off)
        if len(at) < LEAST_PIECE or (not n and fits[rows].sum() < LEAST_START * len(rows)):
            return None
        fitted, cell, quarter = at, all_cells[at], turned[at]
        if n and np.array_equal(fitted, before):
            break
        median = float(np.partition(off[at], len(at) // 2)[len(at) // 2])
        before, largest = fitted, min(limit, max(LEAST_CUT, MEDIANS * median))
    member = near & (off <= limit) & (scaled <= columns.most_scaled_member)
    among = free & _is_between(all_cells, cell.min(axis=0), cell.max(axis=0)) & np.isfinite(off)
    if (member & among).sum() < LEAST_MEMBERS * among.sum():
        return None
    at = _one_per_cell(np.flatnonzero(member), all_cells, off - fits)
    return Piece(at, all_cells[at], off[at], H, turned[at], fits[at])


def _is_between(cells: Int, low: Int, high: Int) -> Bools:
    x, y = cells.T
    return np.asarray((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))


def _fit(columns: Columns, rows: Int, cell: Int, quarter: Int, pitch: float) -> Float:
    """Fit the homography from the lattice, in disc radii, to the image: to points alone if they lie well."""
    X = np.asarray(cell * pitch, np.float64)
    away = cell - cell.sum(axis=0) / len(cell)
    (xx, xy), (_, yy) = (away.T @ away / len(cell)).tolist()
    if len(rows) >= POINTS_ALONE and xx * yy - xy * xy >= LEAST_CELL_SPREAD * (xx + yy):
        return _fit_points(X, columns.frames.xy[rows], columns.weight[rows])
    J = np.asarray(columns.frames.A[rows] @ QUARTERS[-quarter % 4], np.float64)
    weak = FRAMES_OF_MANY if len(rows) >= MANY else 1.0
    return fit_homography(X, columns.frames.xy[rows], J, weak * columns.scale[rows], weak * columns.shape[rows])


def _fit_points(X: Float, xy: Float, weight: Float) -> Float:
    """Fit a homography to points by weighted linear least squares, as :func:`fit_homography` without frames."""
    n = len(X)
    middle, centre = X.sum(axis=0) / n, xy.sum(axis=0) / n
    away, seen = X - middle, xy - centre
    reach, gauge = np.sqrt(np.vdot(away, away) / n), np.sqrt(np.vdot(seen, seen) / n)
    G = np.empty((n, 9))
    P, (x, y) = G[:, :3], seen.T / gauge
    P[:, :2], P[:, 2] = away * (weight / reach)[:, None], weight
    G[:, 3:6], G[:, 6:] = P * x[:, None], P * y[:, None]
    moments = G.T @ G
    normal = np.zeros((9, 9))  # unknown: the homography by rows; its last element is 1, in the middle of the points
    normal[:3, :3] = normal[3:6, 3:6] = moments[:3, :3]
    normal[:3, 6:], normal[3:6, 6:] = -moments[:3, 3:6], -moments[:3, 6:]
    normal[6:, :6] = normal[:6, 6:].T
    normal[6:, 6:] = moments[3:6, 3:6] + moments[6:, 6:]
    normal.flat[::10] *= 1 + RIDGE
    h = np.linalg.solve(normal[:8, :8], -normal[:8, 8])
    H = np.append(h, 1.0).reshape(3, 3)
    to_plane = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, reach]])
    to_image = np.array([[gauge, 0, centre[0]], [0, gauge, centre[1]], [0, 0, 1.0]])
    return np.asarray(to_image @ H @ to_plane)


def _one_per_cell(rows: Int, cells: Int, off: Float) -> Int:
    """Return some of the rows, in ascending order: of those of one cell, the one that is the least off."""
    if not len(rows):
        return rows
    x, y = cells[rows].T
    y = y - y.min()
    key = (x - x.min()) * (y.max() + 1) + y
    if np.bincount(key).max() > 1:
        order = np.argsort(off[rows], kind="stable")
        rows = np.sort(rows[order[np.unique(key[order], return_index=True)[1]]])
    return rows


def _errors(H: Float, columns: Columns, pitch: float) -> tuple[Int, Float, Int, Float, Float] | None:
    """Return the nearest cell of each detection, and how far it is off, its quarters, and the errors of its frame.

    The distance is in disc radii on the board. Detections that the homography cannot show are at infinity.
    """
    with np.errstate(all="ignore"):
        try:
            X = np.linalg.inv(H) @ columns.points
        except np.linalg.LinAlgError:
            return None
        X = X[:2] / X[2]
        w = H[2, :2] @ X + H[2, 2]
        (a, b), (c, d) = H[:2, :2, None] - columns.points[:2, None] * H[2, :2, None]  # the derivative, times w
        determinant = a * d - b * c
        # the frame on the board: the inverse of the derivative times the frame in the image
        first, second = columns.A * (w / determinant)
        (e, f), (g, h) = d * first - b * second, a * second - c * first
        squared = e * h - f * g
        straight, across, scale = e + h, g - f, np.sqrt(squared)
        is_across = np.abs(across) > np.abs(straight)
        along = np.where(is_across, across, straight)
        quarter = is_across + 2 * (along < 0)
        # the distance of the frame, scaled to determinant 1, from the rotation by these quarters
        bent = np.sqrt(np.maximum((e * e + f * f + g * g + h * h) / squared + 2 - 2 * np.abs(along) / scale, 0.0))
        valid = (determinant > 0) & (w > 0) & np.isfinite(bent) & (np.abs(X).max(axis=0) < 1e6)
        X[:, ~valid] = 0.0
        cell = np.rint(X / pitch)
        x, y = X - cell * pitch
        off = np.where(valid, np.sqrt(x * x + y * y), np.inf)
        scaled = np.where(valid, np.abs(np.log(scale)), np.inf)
    return cell.T.astype(np.int64), off, quarter, scaled, bent
