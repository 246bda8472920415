"""How far designs are from each other, from their mirror images, and from themselves in other rotations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kpbench.analysis.cell_images import (
    DIRECTIONS_DEG,
    TILTS_DEG,
    TURNS,
    Grid,
    attitudes,
    moments,
    seen_cells,
    window_weights,
)
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32

SEEN_IDENTITY = (1.0, 3 / 4)


PAIR_STEPS = len(SEEN_IDENTITY) * (1 + (len(TILTS_DEG) - 1) * len(DIRECTIONS_DEG))  # calls of progress


def correlation_and_distance(
    grid: Grid, inks: Float32, progress: Callable[[], None] = lambda: None
) -> tuple[Float32, Float32]:
    """How alike designs can look, over all pairs of attitudes, of the mirror images too.

    The first design is seen, blurred, in every tilt of TILTS_DEG; the second may have any attitude, gain
    (positive) and offset. Mirror images are different prints but are compared as well: the worse counts.
    The worst of the seen parts SEEN_IDENTITY; both matrices are made symmetric by the worse of the two.

    Parameters
    ----------
    grid : Grid
    inks : ndarray of shape (n, cells)

    Returns
    -------
    correlation : ndarray of shape (n, n)
        Largest normalised correlation.
    distance : ndarray of shape (n, n)
        Root mean square of what the best gain and offset leave, in ink contrasts: what noise has to hide.
    """
    view = attitudes()
    flat = attitudes(turns=1)
    weights = window_weights(flat)
    both = np.concatenate([inks, grid.mirrored(inks)])
    n = len(inks)
    correlation = np.zeros((n, n), np.float32)
    distance = np.full((n, n), np.inf, np.float32)
    for seen in SEEN_IDENTITY:
        cells = seen_cells(grid, view, seen)
        for weight, own in zip(weights, cells[: len(flat)], strict=True):
            keep = weight > 0
            first, spread = moments(weight[keep], own[:, keep], inks)
            first = first * weight[keep] / spread[:, None]
            best = np.zeros((n, 2 * n), np.float32)
            for other in cells[:, :, keep]:
                second, other_spread = moments(weight[keep], other, both)
                np.maximum(best, first @ (second / other_spread[:, None]).T, out=best)
            worse = np.minimum(np.maximum(best[:, :n], best[:, n:]), 1.0)
            np.maximum(correlation, worse, out=correlation)
            np.minimum(distance, spread[:, None] * np.sqrt(1 - worse**2), out=distance)
            progress()
    return np.maximum(correlation, correlation.T), np.minimum(distance, distance.T)


def turned_distance(grid: Grid, inks: Float32) -> Float:
    """Smallest distance of each design to itself, turned in the plane by 45 degrees or more, shape (n,)."""
    return _distance_turned(grid, inks, inks, range(TURNS // 8, TURNS - TURNS // 8 + 1))


def mirrored_distance(grid: Grid, inks: Float32) -> Float:
    """Smallest distance of each design to its mirror image, turned in the plane by any angle, shape (n,)."""
    return _distance_turned(grid, inks, grid.mirrored(inks), range(TURNS))


def _distance_turned(grid: Grid, inks: Float32, others: Float32, turns: range) -> Float:
    weight = window_weights(np.eye(2)[None])[0]
    views = seen_cells(grid, attitudes(TURNS, (0.0,)), 1.0)
    first, spread = moments(weight, views[0], inks)
    best = np.zeros(len(inks))
    for turn in turns:
        other, other_spread = moments(weight, views[turn], others)
        best = np.maximum(best, np.einsum("np,np,p->n", first, other, weight) / (spread * other_spread))
    return np.asarray(spread * np.sqrt(np.maximum(1 - best**2, 0)))


def symmetry_order(patch: Patch) -> int:
    """How many rotations of a full turn leave the print as it is: 1 for a unique orientation, 0 for all."""
    _, angles, black = patch.cells
    if len(angles) == 1:
        return 0
    width = np.diff(np.append(angles, angles[0] + 360.0))
    shifts = range(len(angles))
    same = (np.allclose(np.roll(width, k), width) and (np.roll(black, k, axis=1) == black).all() for k in shifts)
    return int(sum(same))
