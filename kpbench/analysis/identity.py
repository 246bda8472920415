"""Identity: how similar a design looks to other designs, to itself after a rotation, and to its mirror image.

The distance of two designs is the root mean square of the difference between their images, divided by the ink contrast
(white minus black). At a contrast of 180 grey levels, a distance of 0.1 is a difference of 18 grey levels. Noise below
this difference hardly makes one design look like the other.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kpbench.analysis.cell_images import (
    TILT_DIRECTIONS_DEG,
    TILTS_DEG,
    TURNS,
    PolarGrid,
    attitudes,
    mean_free_images,
    render_cells,
    window_weights,
)
from kpbench.types import Float, Float32

PARTS_OF_IDENTITY = (1.0, 3 / 4)  # fractions of the patch's radius that the window shows
IDENTITY_STEPS = len(PARTS_OF_IDENTITY) * (1 + (len(TILTS_DEG) - 1) * len(TILT_DIRECTIONS_DEG))
"""Number of steps that :func:`correlation_and_distance` reports."""


def correlation_and_distance(
    grid: PolarGrid, inks: Float32, progress: Callable[[int], None] = lambda steps: None
) -> tuple[Float32, Float32]:
    """Return the largest correlation and the smallest distance of each pair of designs, over all views.

    Both designs are blurred. The first design is seen in every tilt of :data:`~kpbench.analysis.cell_images.TILTS_DEG`,
    without rotation in the plane. The second design and its mirror image are seen in every attitude. A positive gain
    and an offset fit the second image to the first image. The window shows each fraction of the patch's radius in
    :data:`PARTS_OF_IDENTITY` in turn. Each pair is compared in both orders, so both results are symmetric.

    Parameters
    ----------
    grid : PolarGrid
    inks : ndarray of shape (n, cells), float32
    progress : callable
        Called with the number of steps finished since the last call. The numbers add up to :data:`IDENTITY_STEPS`.

    Returns
    -------
    correlation : ndarray of shape (n, n), float32
        Largest normalised correlation of each pair.
    distance : ndarray of shape (n, n), float32
        Smallest distance of each pair.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.analysis import PolarGrid, correlation_and_distance
    >>> patches = kpbench.shipped_patches()[:2]
    >>> grid = PolarGrid.of(patches)
    >>> correlation, distance = correlation_and_distance(grid, grid.inks(patches))
    >>> round(float(distance[0, 1]), 3)
    0.215
    """
    view = attitudes()
    flat = attitudes(turns=1)
    weights = window_weights(flat)
    both = np.concatenate([inks, grid.mirror_inks(inks)])
    n = len(inks)
    correlation = np.zeros((n, n), np.float32)
    distance = np.full((n, n), np.inf, np.float32)
    for seen in PARTS_OF_IDENTITY:
        cells = render_cells(grid, view, seen)
        for weight, own in zip(weights, cells[: len(flat)], strict=True):
            keep = weight > 0
            first, spread = mean_free_images(weight[keep], own[:, keep], inks)
            first = first * weight[keep] / spread[:, None]
            best = np.zeros((n, 2 * n), np.float32)
            for other in cells[:, :, keep]:
                second, other_spread = mean_free_images(weight[keep], other, both)
                np.maximum(best, first @ (second / other_spread[:, None]).T, out=best)
            worse = np.minimum(np.maximum(best[:, :n], best[:, n:]), 1.0)
            np.maximum(correlation, worse, out=correlation)
            np.minimum(distance, spread[:, None] * np.sqrt(1 - worse**2), out=distance)
            progress(1)
    return np.maximum(correlation, correlation.T), np.minimum(distance, distance.T)


def turned_distance(grid: PolarGrid, inks: Float32) -> Float:
    """Return the smallest distance of each design to itself rotated by 45 to 315 degrees, shape (n,)."""
    return _distance_over_turns(grid, inks, inks, range(TURNS // 8, TURNS - TURNS // 8 + 1))


def mirrored_distance(grid: PolarGrid, inks: Float32) -> Float:
    """Return the smallest distance of each design to its mirror image in any rotation, shape (n,)."""
    return _distance_over_turns(grid, inks, grid.mirror_inks(inks), range(TURNS))


def _distance_over_turns(grid: PolarGrid, inks: Float32, others: Float32, turns: range) -> Float:
    weight = window_weights(np.eye(2)[None])[0]
    views = render_cells(grid, attitudes(TURNS, (0.0,)), 1.0)
    first, spread = mean_free_images(weight, views[0], inks)
    best = np.zeros(len(inks))
    for turn in turns:
        other, other_spread = mean_free_images(weight, views[turn], others)
        best = np.maximum(best, np.einsum("np,np,p->n", first, other, weight) / (spread * other_spread))
    return np.asarray(spread * np.sqrt(np.maximum(1 - best**2, 0)))
