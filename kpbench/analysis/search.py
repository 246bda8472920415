"""The search that chose the shipped designs: the best four of a family.

A design is kept if

* its centre is a crossing of straight edges,
* a circle of 2 px diameter fits into every region of one ink at a disc radius of 4 px,
* its basin is at least 0.10 (a single corner has a basin of 0.041),
* its Cramér-Rao bound without the rim's pixels is at most 0.05 px at a disc radius of 5 px,
* at most one in 500 windows of natural images looks like the design (a correlation above 0.8),
* if a limit is given: a camera moves its centre by at most this, see :func:`kpbench.analysis.camera_bias`.

Of all sets of four designs, the best set is the set whose closest two designs are farthest apart. If several sets tie,
the next closest pairs of the sets decide.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.analysis.bias import camera_bias
from kpbench.analysis.family import FAMILY_GRID, code_of, enumerate_family, inks_of
from kpbench.analysis.identity import IDENTITY_STEPS, correlation_and_distance
from kpbench.analysis.localisation import basin, design_bound
from kpbench.analysis.measures import SIZES_PX, pixels_needed
from kpbench.analysis.natural_images import natural_response
from kpbench.errors import DesignError
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, UInt8

MOST_PIXELS_NEEDED = 4.0  # px, radius of the disc
LEAST_BASIN = 0.10  # ink contrasts
MOST_BOUND_PX = 0.05  # at 5 px radius, without the rim
MOST_NATURAL = 1 / 500  # share of windows with a correlation above 0.8
SET_SIZE = 4
SEARCH_STEPS = 7 + IDENTITY_STEPS
"""Number of steps that :func:`search_designs` reports."""


def best_sets(distance: Float32, size: int, count: int) -> list[tuple[int, ...]]:
    """Return the sets whose closest two members are farthest apart, best first. The next closest pairs decide ties.

    Parameters
    ----------
    distance : ndarray of shape (n, n), float32
    size : int
        Number of members of a set.
    count : int
        Largest number of sets that are returned.

    Returns
    -------
    list of tuple of int
        Indices of the members.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.analysis import best_sets
    >>> distance = np.abs(np.subtract.outer([0, 1, 5, 9], [0, 1, 5, 9])).astype(np.float32)
    >>> best_sets(distance, size=3, count=1)
    [(0, 2, 3)]
    """
    n = len(distance)
    pairs = np.unique(distance[np.triu_indices(n, 1)])
    low, high = 0, len(pairs)  # at least `count` sets have all distances >= pairs[low], or low is 0
    while high - low > 1:
        middle = (low + high) // 2
        found = _cliques(distance >= pairs[middle], size)
        low, high = (
            (middle, high) if sum(1 for _, _ in zip(found, range(count), strict=False)) == count else (low, middle)
        )
    sets = list(_cliques(distance >= pairs[low], size)) if len(pairs) else []
    return sorted(sets, key=lambda members: tuple(-pair_distances(distance, members)))[:count]


def pair_distances(distance: Float32, members: tuple[int, ...]) -> Float32:
    """Return the distances within a set, closest first."""
    inside = distance[np.ix_(members, members)]
    return np.sort(inside[np.triu_indices(len(members), 1)])


def _cliques(apart: NDArray[np.bool_], size: int) -> Iterator[tuple[int, ...]]:
    """Yield every set of ``size`` indices whose pairs are all ``apart``, each set in ascending order."""

    def grow(members: tuple[int, ...], candidates: NDArray[np.int64]) -> Iterator[tuple[int, ...]]:
        if len(members) == size:
            yield members
            return
        for n, new in enumerate(candidates):
            later = candidates[n + 1 :]
            yield from grow((*members, int(new)), later[apart[new, later]])

    yield from grow((), np.arange(len(apart)))


@dataclass(frozen=True)
class SearchResult:
    """Result of :func:`search_designs`.

    Attributes
    ----------
    counts : dict of str to int
        Number of designs that remain after each step, by name of the step, in order.
    median_bound_px, median_basin, median_pixels_needed : float
        Medians over all designs of the family whose centre is a crossing. The bound is for a frontal view at 5 px
        radius.
    sets : tuple of tuples of Patch
        The best sets, best first.
    distances : tuple of ndarray of shape (6,)
        Distances of the pairs within each set, closest first.

    Examples
    --------
    >>> import kpbench
    >>> found = kpbench.analysis.analyse_patches(search_family=True).search  # doctest: +SKIP
    >>> found.counts["different"]  # doctest: +SKIP
    3064
    """

    counts: dict[str, int]
    median_bound_px: float
    median_basin: float
    median_pixels_needed: float
    sets: tuple[tuple[Patch, ...], ...]
    distances: tuple[Float32, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the entry ``search`` of the JSON file."""
        return {
            "counts": self.counts,
            "median": {
                "bound_px": self.median_bound_px,
                "basin": self.median_basin,
                "pixels_needed": self.median_pixels_needed,
            },
            "sets": [
                {"designs": [p.to_dict() for p in patches], "distances": distances.tolist()}
                for patches, distances in zip(self.sets, self.distances, strict=True)
            ],
        }


def search_designs(
    windows: UInt8,
    known: tuple[Patch, ...] = (),
    count: int = 2,
    most_bias_px: float | None = None,
    progress: Callable[[int], None] = lambda steps: None,
) -> SearchResult:
    """Return the best sets of four designs of the family; the module's docstring states the rule.

    Parameters
    ----------
    windows : ndarray of shape (N, side, side), uint8
        From :func:`kpbench.analysis.background_windows`.
    known : tuple of Patch
        Designs that keep their names and IDs in the result. The name of any other design is its code.
    count : int
        Largest number of sets that are returned.
    most_bias_px : float, optional
        Largest bias of a fit that takes the camera for linear, under any effect but the bow. None: any bias.
    progress : callable
        Called with the number of steps finished since the last call. The numbers add up to :data:`SEARCH_STEPS`.

    Raises
    ------
    DesignError
        If fewer than four designs are left.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.analysis import background_windows, search_designs
    >>> found = search_designs(background_windows(), kpbench.shipped_patches())  # doctest: +SKIP
    >>> [patch.name for patch in found.sets[0]]  # doctest: +SKIP
    ['checker', 'trefoil', 'wheel', 'mushroom']
    """
    family = enumerate_family()
    codes = family.classes
    counts = {"painted": len(family.codes), "different": len(codes)}
    inks = inks_of(codes)
    innermost = inks[:, :8]
    edges = innermost != np.roll(innermost, 1, axis=1)
    measures: list[Float] = []
    named = {code_of(p): p for p in known}

    def design(code: np.uint32, nth: int) -> Patch:
        """Return the known design of this code, or else a design with the ID ``len(named) + nth``."""
        return named.get(int(code)) or family.patch(int(code), f"{code:08x}", len(named) + nth)

    def keep(name: str, chosen: NDArray[np.bool_]) -> None:
        nonlocal codes, inks, measures
        codes, inks, measures = codes[chosen], inks[chosen], [m[chosen] for m in measures]
        counts[name] = len(codes)
        progress(1)

    keep("centre is a crossing", (edges[:, :4] | edges[:, 4:]).sum(1) >= 2)
    measures = [pixels_needed(FAMILY_GRID, inks)]
    progress(1)
    measures += [basin(FAMILY_GRID, inks), design_bound(FAMILY_GRID, inks, SIZES_PX[0])[0]]
    pixels, basins, bounds = measures
    median_bound, median_basin, median_pixels = (float(np.median(m)) for m in (bounds, basins, pixels))
    keep("large regions", pixels <= MOST_PIXELS_NEEDED)
    keep("bound centre", measures[1] >= LEAST_BASIN)
    keep("bound without rim", design_bound(FAMILY_GRID, inks, SIZES_PX[0], rim=False)[0] <= MOST_BOUND_PX)
    keep("rare in images", natural_response(FAMILY_GRID, inks, windows)[:, 0] <= MOST_NATURAL)
    if most_bias_px is not None:
        keep("bias of a camera", np.array([_bias(design(code, 0)) for code in codes]) <= most_bias_px)
    else:
        progress(1)
    if len(codes) < SET_SIZE:
        raise DesignError(f"`most_bias_px` of {most_bias_px} leaves {len(codes)} designs, expected at least {SET_SIZE}")
    distance = correlation_and_distance(FAMILY_GRID, inks, progress)[1]
    sets = best_sets(distance, SET_SIZE, count)
    patches = tuple(tuple(design(code, n) for n, code in enumerate(codes[list(members)])) for members in sets)
    patches = tuple(tuple(sorted(members, key=lambda p: p.patch_id)) for members in patches)
    distances = tuple(pair_distances(distance, members) for members in sets)
    return SearchResult(counts, median_bound, median_basin, median_pixels, patches, distances)


def _bias(patch: Patch) -> float:
    """Return the largest bias under the effects whose bias does not depend on the paper's shape, px."""
    return max(px for effect, px in camera_bias(patch).items() if effect != "bow")
