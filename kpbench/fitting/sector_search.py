"""Poses of designs, searched from rough places and scales.

The search uses the *core* of a design: its innermost sectors, which look the same at every size.

1. :func:`search_sectors` samples concentric circles around each place under many tilts. The outermost circle bounds the
   core.
   The samples are correlated with the core of each design in each rotation.
2. :func:`kpbench.fitting.align.align_poses` moves the poses onto the image.
3. :func:`estimate_size` measures how far the sectors reach, which gives the size of the patch.
4. :func:`core_symmetries` adds the rotations in which the core looks the same but the whole design does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from kpbench.fitting.align import Poses, rotate_poses, short_semi_axis
from kpbench.fitting.pyramid import choose_level, find_samples_outside, normalise_rows, sample_pyramid
from kpbench.fitting.templates import (
    CORE_ROTATIONS,
    WHOLE_ROTATIONS,
    DesignTemplates,
    draw_ink,
    look_up_ink,
)
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, Int

CORE_RADIUS_PX = 3.0
"""Short semi-axis of the core's circle, px of the searched level. The circle fits into patches of 5 px radius."""
SPOKES = 40
"""Samples on each circle of :func:`estimate_size`."""
RING_RADII = 0.7 * 1.12 ** np.arange(34)
"""Radii of the circles of :func:`estimate_size`, in radii of the core's circle."""
FIRST_RINGS = 12
"""Number of circles that are sampled first. Places on no patch rarely need further circles."""
AGREEING_SHARE = 0.7
"""A circle belongs to the patch only if at least this share of its votes is for the predicted ink."""
VOTING_SHARE = 0.3
"""A circle belongs to the patch only if at least this share of its samples votes for the predicted ink."""
VOTE_OFFSET = 0.4
"""A sample votes for the predicted ink if its agreement with this ink, from -1 to 1, is larger than this."""
BLOCK = 2**11
"""Largest number of poses that are measured together. This limits the memory use."""
_TILTS = ((1.0, 1), (0.6, 4), (0.36, 6), (0.22, 9))
"""Tilts that are searched: ratio of short to long semi-axis, and number of directions of the tilt."""


@lru_cache(maxsize=1)
def _tilt_maps() -> Float:
    """Return affine maps (K, 2, 2) of the unit circle to ellipses with a short semi-axis of 1, one map per tilt."""
    maps = []
    for ratio, directions in _TILTS:
        for direction in np.arange(directions) * np.pi / directions:
            c, s = np.cos(direction), np.sin(direction)
            axes = np.array([[c, -s], [s, c]])
            maps.append(axes @ np.diag([1 / ratio, 1.0]) @ axes.T)
    return np.array(maps)


def search_sectors(
    levels: Sequence[Float32], xy: Float, level: Int, templates: DesignTemplates, margin: float
) -> Poses:
    """Find the best tilt and rotation of each design at each place.

    Parameters
    ----------
    levels : list of ndarray
        From :func:`kpbench.fitting.pyramid.build_pyramid`.
    xy : ndarray of shape (N, 2)
        Places, px.
    level : ndarray of shape (N,), int64
        Pyramid level to search; the core's circle has a short semi-axis of ``CORE_RADIUS_PX · 2^level`` px.
    templates : DesignTemplates
    margin : float
        A design is dropped at a place if its correlation is lower than the best design's correlation by more than this.

    Returns
    -------
    Poses
        One or more designs per place, in the order of the places; ``A`` maps the unit circle of the core to px.
    """
    core, scale = templates.core, CORE_RADIUS_PX * 2.0**level
    starts = np.searchsorted(core.rotated_design, np.arange(len(templates.patches)))
    best = np.full((len(templates.patches), len(xy)), -1.0, np.float32)
    tilt = np.zeros(best.shape, np.int64)
    for k, map_ in enumerate(_tilt_maps()):
        values = sample_pyramid(levels, level, xy, scale[:, None, None] * map_, core.points)
        value = np.maximum.reduceat(core.rotated @ normalise_rows(values).T, starts, axis=0)
        better = value > best
        best[better], tilt[better] = value[better], k
    place, design = np.nonzero((best >= best.max(axis=0) - margin).T)
    A = scale[place, None, None] * _tilt_maps()[tilt[design, place]]
    ncc = normalise_rows(sample_pyramid(levels, level[place], xy[place], A, core.points)) @ core.rotated.T
    rotation = np.where(core.rotated_design == design[:, None], ncc, -np.inf).argmax(axis=1)
    return rotate_poses(xy[place], A, design, rotation, ncc, core)


def estimate_size(levels: Sequence[Float32], poses: Poses, templates: DesignTemplates) -> Poses:
    """Measure how far the sectors reach, and turn poses of the core into poses of the unit disc.

    Circles of growing size are sampled around each place. Each sample votes for or against the ink that the sectors
    predict. The ellipse with the largest sum of votes inside is the outer edge of the sectors.

    Sectors with edges of two directions look the same when they are stretched along these directions, so ellipses of
    several stretches are tried. Edges of three or more directions determine the stretch.
    """
    A = poses.A.copy()
    for rows in np.split(np.arange(len(poses)), range(BLOCK, len(poses), BLOCK)):
        A[rows], complete = _fit_edge(levels, poses[rows], templates, FIRST_RINGS)
        rest = rows[~complete]
        A[rest], _ = _fit_edge(levels, poses[rest], templates, len(RING_RADII))
    return Poses(poses.xy, A, poses.design, poses.ncc)


def core_symmetries(poses: Poses, templates: DesignTemplates) -> tuple[Int, Poses]:
    """Return each pose as given, and then in every other rotation that changes the design but not its core.

    Returns
    -------
    row : ndarray of shape (M,), int64
        Index of the given pose that each pose was rotated from, ascending. Each given pose occurs once or more.
    poses : Poses
        M poses.
    """
    core, whole = (
        np.bincount(kind.rotated_design, minlength=len(templates.patches)) for kind in (templates.core, templates.whole)
    )
    # a design that looks the same n times in a full turn has distinct templates for 1/n of all rotations
    period = 2 * np.pi * core / CORE_ROTATIONS
    symmetries = np.maximum(np.rint(CORE_ROTATIONS / core / (WHOLE_ROTATIONS / whole)), 1).astype(np.int64)
    row = np.repeat(np.arange(len(poses)), symmetries[poses.design])
    first = np.searchsorted(row, row)
    angle = (np.arange(len(row)) - first) * period[poses.design[row]]
    c, s = np.cos(angle), np.sin(angle)
    given = poses[row]
    return row, Poses(given.xy, given.A @ np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0), given.design, given.ncc)


def _fit_edge(
    levels: Sequence[Float32], poses: Poses, templates: DesignTemplates, count: int
) -> tuple[Float, NDArray[np.bool_]]:
    """Fit the outer edge of the sectors within the first ``count`` circles.

    Returns
    -------
    A : ndarray of shape (N, 2, 2)
        Maps of the unit disc, px.
    complete : ndarray of shape (N,), bool
        Whether more circles would leave the result unchanged.
    """
    votes = _vote(levels, poses, templates, count)
    summed = votes * (RING_RADII * np.gradient(RING_RADII)).astype(np.float32)[:count, None]
    for ring in range(1, count):  # np.cumsum takes four times as long
        summed[:, ring] += summed[:, ring - 1]
    A, complete = poses.A.copy(), np.zeros(len(poses), bool)
    for d, patch in enumerate(templates.patches):
        rows = np.flatnonzero(poses.design == d)
        shapes, ends, known = _ellipse_ends(patch, count)
        # three tables of shape (circles x spokes, poses): sum of votes up to the circle, vote in favour, any vote
        tables = [t[rows].reshape(len(rows), count * SPOKES).T for t in (summed, votes > 0, votes != 0)]
        total, agreeing, cast = (
            (ends @ np.ascontiguousarray(t, np.float32)).T.reshape(len(rows), len(shapes), count) for t in tables
        )
        # the patch ends at the first circle that disagrees; a circle beyond can agree only by chance
        beyond = np.logical_or.accumulate(
            (agreeing < AGREEING_SHARE * cast) | (agreeing < VOTING_SHARE * SPOKES), axis=2
        )
        beyond[:, :, 0] = False
        complete[rows] = beyond[:, :, known].all(axis=1)
        best = np.where(beyond, -np.inf, total).reshape(len(rows), len(shapes) * count).argmax(axis=1)
        shape, size = np.unravel_index(best, (len(shapes), count))
        A[rows] = A[rows] @ (shapes[shape] * RING_RADII[size][:, None, None]) / patch.cells[0][1]
    return A, complete


def _vote(levels: Sequence[Float32], poses: Poses, templates: DesignTemplates, count: int) -> Float32:
    """Return votes (N, circles, spokes) between -1.4, for the other ink, and 0.6, for the predicted ink.

    The vote of a sample outside the image is 0.
    """
    spokes, radii = _spoke_points(), RING_RADII[:count]
    ink = np.array([look_up_ink(draw_ink(patch, False), spokes) for patch in templates.patches], np.float32)
    predicted = ink[poses.design][:, None]
    shape = (len(poses), len(radii), len(spokes))
    xy = np.repeat(poses.xy, len(radii), axis=0)
    A = (poses.A[:, None] * radii[:, None, None]).reshape(-1, 2, 2)
    level = choose_level(short_semi_axis(A), CORE_RADIUS_PX, levels)
    grey = sample_pyramid(levels, level, xy, A, spokes).reshape(shape)
    core = grey[:, radii <= 1.0].mean(axis=1)
    light = predicted[:, 0] > 0
    white = (core * light).sum(axis=1) / light.sum(axis=1)
    black = (core * ~light).sum(axis=1) / (~light).sum(axis=1)
    middle, half = (white + black) / 2, np.maximum((white - black) / 2, 1.0)
    agreement = grey - middle.astype(np.float32)[:, None, None]
    agreement *= np.sign(predicted) / half.astype(np.float32)[:, None, None]
    np.clip(agreement, -1, 1, out=agreement)
    agreement -= np.float32(VOTE_OFFSET)
    votes: Float32 = agreement * np.abs(predicted)
    rows, outside = find_samples_outside(levels[0], xy, A, spokes)
    votes.reshape(-1, len(spokes))[rows] *= ~outside
    return votes


@lru_cache(maxsize=64)
def _ellipse_ends(patch: Patch, count: int) -> tuple[Float, csr_array, int]:
    """Return the shapes of ellipses that are tried, and for each ellipse the samples on its boundary.

    Returns
    -------
    shapes : ndarray of shape (G, 2, 2)
    ends : sparse array of shape (G · circles, circles · spokes)
        A row is an ellipse of one shape and size, a column is a sample. On each spoke, the entry is 1 for the sample
        that is nearest to the boundary of the ellipse.
    known : int
        Index of the last size at which every ellipse lies within the circles that were sampled.
    """
    shapes = _stretches_along_edges(patch)
    reach = 1 / np.linalg.norm(np.einsum("gij,sj->gsi", np.linalg.inv(shapes), _spoke_points()), axis=2)
    shift = np.rint(np.log(reach) / np.log(RING_RADII[1] / RING_RADII[0])).astype(np.int64)
    ring = np.clip(np.arange(count)[:, None] + shift[:, None], 0, count - 1)  # (G, circles, spokes)
    column = (ring * SPOKES + np.arange(SPOKES)).ravel()
    row = np.repeat(np.arange(len(column) // SPOKES), SPOKES)
    ends = csr_array((np.ones(len(column), np.float32), (row, column)), (row[-1] + 1, count * SPOKES))
    return shapes, ends, max(count - 1 - int(shift.max()), 0)


def _spoke_points() -> Float:
    angle = np.arange(SPOKES) * (2 * np.pi / SPOKES)
    return np.column_stack([np.cos(angle), np.sin(angle)])


@lru_cache(maxsize=64)
def _stretches_along_edges(patch: Patch) -> Float:
    """Return maps (G, 2, 2) of the patch frame that keep areas and the directions of the innermost edges."""
    _, angles, black = patch.cells
    edges = np.unique(np.round(angles[black[0] != np.roll(black[0], 1)] % 180.0, 6))
    if len(edges) > 2:
        return np.eye(2)[None]
    first = edges[0] if len(edges) else 0.0
    second = edges[1] if len(edges) == 2 else first + 90.0
    basis = np.array([[np.cos(np.radians(a)), np.sin(np.radians(a))] for a in (first, second)]).T
    growth = 1.2 ** np.arange(-5, 6)
    return np.array([basis @ np.diag([g, 1 / g]) @ np.linalg.inv(basis) for g in growth])
