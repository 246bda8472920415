"""Poses of patches from a rough place and scale alone, by their innermost sectors, which look the same at every size.

:func:`search` samples the image on circles around the place, under a bank of tilts, and correlates with the sectors
of every design in every rotation; :func:`kpbench.fitting.align` moves what it finds onto the image; :func:`extend`
measures how far the sectors reach, which is the patch's size.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from kpbench.fitting.align import Poses, rotated, short_axis
from kpbench.fitting.pyramid import coarsest_level, normalise, outside_image, sample
from kpbench.fitting.templates import ANGLES, TURNS, Bank, look_up, soft_ink
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, Int

RING_PX = 3.0
"""Short semi-axis of the core's outermost ring, in px of the level: well inside the smallest patch's (5 px)."""


def likeness(core: Float, whole: Float) -> Float:
    """What the correlations near the centre and over the disc are worth, in units of log odds."""
    return np.asarray(-2.13 * np.log(1.01 - core) - 2.59 * np.log(1.01 - whole))


@lru_cache(maxsize=1)
def _tilts() -> Float:
    """Affine maps (K, 2, 2) whose circle has a short semi-axis of 1: long ones of 1 to 4.5 in all directions."""
    maps = []
    for ratio, directions in ((1.0, 1), (0.6, 4), (0.36, 6), (0.22, 9)):
        for direction in np.arange(directions) * np.pi / directions:
            c, s = np.cos(direction), np.sin(direction)
            axes = np.array([[c, -s], [s, c]])
            maps.append(axes @ np.diag([1 / ratio, 1.0]) @ axes.T)
    return np.array(maps)


def search(levels: Sequence[Float32], xy: Float, level: Int, known: Bank, margin: float) -> Poses:
    """Best tilt and rotation of each design at each place.

    Parameters
    ----------
    levels : from :func:`kpbench.fitting.pyramid`.
    xy : (N, 2) px.
    level : (N,) pyramid level to look at; the circle has a short semi-axis of ``3 · 2^level`` px.
    known : the designs.
    margin : designs whose correlation is worse by more than this than the best one's are left out.

    Returns
    -------
    Poses
        One to D a place, in the order of the places (all D where ``margin`` is infinite);
        ``A`` maps the unit circle of ``known.core``.
    """
    core, scale = known.core, RING_PX * 2.0**level
    starts = np.searchsorted(core.turned_which, np.arange(len(known.patches)))
    best = np.full((len(known.patches), len(xy)), -1.0, np.float32)
    tilt = np.zeros(best.shape, np.int64)
    for k, map_ in enumerate(_tilts()):
        values = sample(levels, level, xy, scale[:, None, None] * map_, core.points)
        value = np.maximum.reduceat(core.turned @ normalise(values).T, starts, axis=0)
        better = value > best
        best[better], tilt[better] = value[better], k
    place, which = np.nonzero((best >= best.max(axis=0) - margin).T)
    A = scale[place, None, None] * _tilts()[tilt[which, place]]
    ncc = normalise(sample(levels, level[place], xy[place], A, core.points)) @ core.turned.T
    best = np.where(core.turned_which == which[:, None], ncc, -np.inf).argmax(axis=1)
    return rotated(xy[place], A, which, best, ncc, core)


SPOKES = 40
RADII = 0.7 * 1.12 ** np.arange(34)
"""Radii at which :func:`extend` looks, in radii of the circle that was aligned."""
AGREE = 0.7
"""Fraction of a circle's samples that must have the predicted ink for it to belong to the patch."""


def extend(levels: Sequence[Float32], poses: Poses, known: Bank) -> Poses:
    """How far the sectors reach: turn poses of the core into poses of the unit disc.

    Each sample on the spokes of a wheel votes for or against the ink that the sectors predict; the ellipse
    with the largest sum of votes is the sectors' edge. Two edges leave the stretch along each of them open,
    so ellipses are tried that differ in it; three or more edges leave the size alone.
    """
    A = poses.A.copy()
    for rows in np.split(np.arange(len(poses)), range(BLOCK, len(poses), BLOCK)):
        # most places are no patch, and end at once
        A[rows], ended = _reach(levels, poses[rows], known, NEAR)
        far = rows[~ended]
        A[far], _ = _reach(levels, poses[far], known, len(RADII))
    return Poses(poses.xy, A, poses.which, poses.ncc)


def alike(poses: Poses, known: Bank) -> tuple[Int, Poses]:
    """Poses in every rotation in which the innermost sectors look the same and the whole design does not.

    Returns
    -------
    Rows (M,) of the given poses, in order and each once or more, and their poses.
    """
    core, whole = (np.bincount(t.turned_which, minlength=len(known.patches)) for t in (known.core, known.whole))
    # of a design that looks the same n times in a turn one in n rotations is listed
    period = 2 * np.pi * core / ANGLES
    many = np.maximum(np.rint(ANGLES / core / (TURNS / whole)), 1).astype(np.int64)
    row = np.repeat(np.arange(len(poses)), many[poses.which])
    first = np.searchsorted(row, row)
    angle = (np.arange(len(row)) - first) * period[poses.which[row]]
    c, s = np.cos(angle), np.sin(angle)
    turned = poses[row]
    return row, Poses(turned.xy, turned.A @ np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0), turned.which, turned.ncc)


NEAR = 12
"""Radii of a first look."""
BLOCK = 2**11
"""Poses at once: memory does not grow with the image."""


def _reach(levels: Sequence[Float32], poses: Poses, known: Bank, count: int) -> tuple[Float, NDArray[np.bool_]]:
    """Maps (N, 2, 2) of the unit disc, looking at so many radii, and whether more of them would change nothing (N,)."""
    votes = _votes(levels, poses, known, count)
    summed = votes * (RADII * np.gradient(RADII)).astype(np.float32)[:count, None]
    for ring in range(1, count):  # np.cumsum takes four times as long
        summed[:, ring] += summed[:, ring - 1]
    A, ended = poses.A.copy(), np.zeros(len(poses), bool)
    for d, patch in enumerate(known.patches):
        rows = np.flatnonzero(poses.which == d)
        shapes, ends, certain = _ellipses(patch, count)
        # (radii x spokes, rows) of what the votes add up to, those in favour, and all that were cast
        tables = [t[rows].reshape(len(rows), count * SPOKES).T for t in (summed, votes > 0, votes != 0)]
        total, yes, cast = (
            (ends @ np.ascontiguousarray(t, np.float32)).T.reshape(len(rows), len(shapes), count) for t in tables
        )
        # beyond the first circle that disagrees, what agrees is chance
        alien = np.logical_or.accumulate((yes < AGREE * cast) | (yes < 0.3 * SPOKES), axis=2)
        alien[:, :, 0] = False
        ended[rows] = alien[:, :, certain].all(axis=1)
        best = np.where(alien, -np.inf, total).reshape(len(rows), len(shapes) * count).argmax(axis=1)
        shape, size = np.unravel_index(best, (len(shapes), count))
        A[rows] = A[rows] @ (shapes[shape] * RADII[size][:, None, None]) / patch.cells[0][1]
    return A, ended


def _votes(levels: Sequence[Float32], poses: Poses, known: Bank, count: int) -> Float32:
    """From -1.4 (the other ink) to 0.6 (the predicted ink), 0 outside the image: (N, radii, spokes)."""
    spokes, radii = _spokes(), RADII[:count]
    ink = np.array([look_up(soft_ink(p, False), spokes) for p in known.patches], np.float32)
    predicted = ink[poses.which][:, None]
    shape = (len(poses), len(radii), len(spokes))
    xy = np.repeat(poses.xy, len(radii), axis=0)
    A = (poses.A[:, None] * radii[:, None, None]).reshape(-1, 2, 2)
    grey = sample(levels, coarsest_level(short_axis(A), RING_PX, levels), xy, A, spokes).reshape(shape)
    core = grey[:, radii <= 1.0].mean(axis=1)
    light = predicted[:, 0] > 0
    white = (core * light).sum(axis=1) / light.sum(axis=1)
    black = (core * ~light).sum(axis=1) / (~light).sum(axis=1)
    middle, half = (white + black) / 2, np.maximum((white - black) / 2, 1.0)
    agree = grey - middle.astype(np.float32)[:, None, None]
    agree *= np.sign(predicted) / half.astype(np.float32)[:, None, None]
    np.clip(agree, -1, 1, out=agree)
    agree -= np.float32(0.4)
    votes: Float32 = agree * np.abs(predicted)
    rows, outside = outside_image(levels[0], xy, A, spokes)
    votes.reshape(-1, len(spokes))[rows] *= ~outside
    return votes


@lru_cache(maxsize=64)
def _ellipses(patch: Patch, count: int) -> tuple[Float, csr_array, int]:
    """Shapes (G, 2, 2) to try, samples where each ends (G x radii, radii x spokes), last radius at which all do."""
    shapes = _stretches(patch)
    reach = 1 / np.linalg.norm(np.einsum("gij,sj->gsi", np.linalg.inv(shapes), _spokes()), axis=2)
    shift = np.rint(np.log(reach) / np.log(RADII[1] / RADII[0])).astype(np.int64)
    ring = np.clip(np.arange(count)[:, None] + shift[:, None], 0, count - 1)  # (G, radii, spokes)
    column = (ring * SPOKES + np.arange(SPOKES)).ravel()
    row = np.repeat(np.arange(len(column) // SPOKES), SPOKES)
    ends = csr_array((np.ones(len(column), np.float32), (row, column)), (row[-1] + 1, count * SPOKES))
    return shapes, ends, max(count - 1 - int(shift.max()), 0)


def _spokes() -> Float:
    turn = np.arange(SPOKES) * (2 * np.pi / SPOKES)
    return np.column_stack([np.cos(turn), np.sin(turn)])


@lru_cache(maxsize=64)
def _stretches(patch: Patch) -> Float:
    """Maps (G, 2, 2) of the patch frame that leave the innermost edges where they are, of determinant 1."""
    _, angles, black = patch.cells
    edges = np.unique(np.round(angles[black[0] != np.roll(black[0], 1)] % 180.0, 6))
    if len(edges) > 2:
        return np.eye(2)[None]
    first = edges[0] if len(edges) else 0.0
    second = edges[1] if len(edges) == 2 else first + 90.0
    basis = np.array([[np.cos(np.radians(a)), np.sin(np.radians(a))] for a in (first, second)]).T
    growth = 1.2 ** np.arange(-5, 6)
    return np.array([basis @ np.diag([g, 1 / g]) @ np.linalg.inv(basis) for g in growth])
