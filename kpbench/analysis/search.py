"""The search that chose the shipped designs: a family of designs, and the best four of it.

The family: up to three semi-circles with radii of 1, 2/3, 1/2 or 1/3 and angles in steps of 45 degrees,
painted black, white or inverting on a black or white disc. Rotations and mirror images of a design count
as one. Its cells are four rings by eight sectors, hence a design is a code of 32 bits.

The rule: keep the designs whose centre is a crossing of straight edges, whose smallest region holds a
2-px circle at 4 px radius, whose centre is bound more than twice as well as that of a corner (basin at
least 0.10, a corner's is 0.041), whose bound without the rim is at most 0.05 px at 5 px radius, and which
at most one place in 500 of an image looks like.
Of all sets of four of them take the one whose closest two designs are farthest apart; of equal sets the
one whose next closest two are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.analysis.cell_images import Grid
from kpbench.analysis.identity import PAIR_STEPS, correlation_and_distance
from kpbench.analysis.localisation import basin, disc_bound
from kpbench.analysis.measures import SIZES_PX, pixels_needed
from kpbench.analysis.natural_images import natural_response
from kpbench.patches.design import Patch, SemiCircle
from kpbench.types import Float, Float32, UInt8

RADII = (1.0, 2 / 3, 1 / 2, 1 / 3)
ANGLES_DEG = tuple(45.0 * n for n in range(8))
SEMICIRCLES = 3
FAMILY_GRID = Grid(tuple(sorted(RADII)), ANGLES_DEG)

MOST_PIXELS_NEEDED = 4.0
LEAST_BASIN = 0.10
MOST_BOUND_PX = 0.05  # at 5 px radius, without the rim
MOST_NATURAL = 1 / 500  # of all places with a correlation over 0.8
SET_SIZE = 4
SEARCH_STEPS = 6 + PAIR_STEPS  # calls of progress

Codes = NDArray[np.uint32]


# --- The family ---------------------------------------------------------------------------------------


def _strokes() -> list[tuple[SemiCircle, np.uint32]]:
    """Every semi-circle and the bits that it covers; bit ``8 * ring + sector``."""
    found = []
    for radius in RADII:
        rings = FAMILY_GRID.radii.index(radius) + 1
        for sector, angle in enumerate(ANGLES_DEG):
            bits = sum(1 << (8 * ring + (sector + n) % 8) for ring in range(rings) for n in range(4))
            found += [(SemiCircle(radius, angle, ink), np.uint32(bits)) for ink in ("black", "white", "invert")]
    return found


STROKES = _strokes()


def paint(codes: Codes, stroke: int) -> Codes:
    """The designs with one more semi-circle."""
    semicircle, bits = STROKES[stroke]
    if semicircle.ink == "invert":
        return codes ^ bits
    return codes | bits if semicircle.ink == "black" else codes & ~bits


def canonical(codes: Codes) -> Codes:
    """The least code among a design's rotations and their mirror images."""
    rings = codes.astype("<u4").view(np.uint8).reshape(-1, 4)
    backwards = np.packbits(np.unpackbits(rings[..., None], axis=-1), axis=-1, bitorder="little")[..., 0]
    orbit = [
        ((side << turn) | (side >> (8 - turn) % 8 if turn else side)).astype(np.uint8)
        for side in (rings, backwards)
        for turn in range(8)
    ]
    return np.asarray(np.min([np.ascontiguousarray(r).view("<u4")[:, 0] for r in orbit], axis=0), np.uint32)


def code_of(patch: Patch) -> int:
    """Canonical code of a design of the family's grid; the caller knows that it fits there."""
    bits = FAMILY_GRID.inks([patch])[0].astype(np.uint64)
    return int(canonical(np.array([(bits << np.arange(32, dtype=np.uint64)).sum()], np.uint32))[0])


@dataclass(frozen=True)
class Family:
    """All designs that can be painted, and how each was painted first, with the fewest semi-circles.

    Attributes
    ----------
    codes : ndarray of shape (N,), uint32
    parents : ndarray of shape (N,), int64
        The design before the last semi-circle; -1 for a bare disc.
    strokes : ndarray of shape (N,), int64
        The last semi-circle.
    """

    codes: Codes
    parents: NDArray[np.int64]
    strokes: NDArray[np.int64]

    @cached_property
    def classes(self) -> Codes:
        """One code for each class of rotations and mirror images, ascending."""
        return np.unique(canonical(self.codes))

    def patch(self, code: int, name: str, patch_id: int) -> Patch:
        """A design of the family as a Patch."""
        at = int(np.flatnonzero(self.codes == code)[0])
        semicircles: list[SemiCircle] = []
        while self.parents[at] >= 0:
            semicircles.insert(0, STROKES[self.strokes[at]][0])
            at = int(self.parents[at])
        return Patch(name, patch_id, "black" if self.codes[at] else "white", tuple(semicircles))


def enumerate_family() -> Family:
    """Paint every design, those with fewer semi-circles first."""
    codes = np.array([0, 0xFFFFFFFF], np.uint32)
    parents, strokes = np.full(2, -1), np.full(2, -1)
    layer = np.arange(2)
    for _ in range(SEMICIRCLES):
        painted = np.concatenate([paint(codes[layer], n) for n in range(len(STROKES))])
        new, first = np.unique(painted, return_index=True)
        fresh = ~np.isin(new, codes)
        new, first = new[fresh], first[fresh]
        stroke, parent = np.divmod(first, len(layer))
        parents, strokes = np.append(parents, layer[parent]), np.append(strokes, stroke)
        layer = len(codes) + np.arange(len(new))
        codes = np.append(codes, new)
    return Family(codes, parents, strokes)


def inks_of(codes: Codes) -> Float32:
    """Inks on FAMILY_GRID, (n, 32)."""
    return ((codes[:, None] >> np.arange(32, dtype=np.uint32)) & 1).astype(np.float32)


# --- The sets -----------------------------------------------------------------------------------------


def best_sets(distance: Float32, size: int, count: int) -> list[tuple[int, ...]]:
    """The sets whose closest two members are farthest apart, best first; ties by the next closest two.

    Parameters
    ----------
    distance : ndarray of shape (n, n)
    size, count : int
        Members of a set, and how many sets are wanted (fewer if there are no more).
    """
    n = len(distance)
    pairs = np.unique(distance[np.triu_indices(n, 1)])
    low, high = 0, len(pairs)  # sets with all distances >= pairs[low] suffice, or there are no more at all
    while high - low > 1:
        middle = (low + high) // 2
        found = _cliques(distance >= pairs[middle], size)
        low, high = (
            (middle, high) if sum(1 for _, _ in zip(found, range(count), strict=False)) == count else (low, middle)
        )
    sets = list(_cliques(distance >= pairs[low], size)) if len(pairs) else []
    return sorted(sets, key=lambda members: tuple(-pair_distances(distance, members)))[:count]


def pair_distances(distance: Float32, members: tuple[int, ...]) -> Float32:
    """Distances within a set, closest first."""
    inside = distance[np.ix_(members, members)]
    return np.sort(inside[np.triu_indices(len(members), 1)])


def _cliques(apart: NDArray[np.bool_], size: int) -> Iterator[tuple[int, ...]]:
    """Every set of ``size`` indices that are pairwise ``apart``, each once, ascending."""

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
    """What the search found.

    Attributes
    ----------
    counts : dict
        Designs left after each step of the rule, in order.
    median_bound_px, median_basin, median_pixels_needed : float
        Over all designs of the family whose centre is a crossing; the bound at 5 px, frontal.
    sets : tuple of tuples of Patch
        The best set and the runner-up.
    distances : tuple of ndarray of shape (6,)
        Of the pairs within each set, closest first.
    """

    counts: dict[str, int]
    median_bound_px: float
    median_basin: float
    median_pixels_needed: float
    sets: tuple[tuple[Patch, ...], ...]
    distances: tuple[Float32, ...]

    def to_dict(self) -> dict[str, Any]:
        """The ``search`` entry of the JSON file."""
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


def search(
    windows: UInt8, known: tuple[Patch, ...] = (), count: int = 2, progress: Callable[[], None] = lambda: None
) -> SearchResult:
    """Apply the rule (see the module's docstring) to the whole family.

    Parameters
    ----------
    windows : ndarray of shape (N, side, side), uint8
        From :func:`kpbench.analysis.sample_windows`.
    known : tuple of Patch
        Designs that keep their names and ids where they are found; others are named by their code.
    count : int
        How many sets to give.
    progress : callable
        Called now and then, :data:`SEARCH_STEPS` times in all.
    """
    family = enumerate_family()
    codes = family.classes
    counts = {"painted": len(family.codes), "different": len(codes)}
    inks = inks_of(codes)
    innermost = inks[:, :8]
    edges = innermost != np.roll(innermost, 1, axis=1)
    measures: list[Float] = []

    def keep(name: str, chosen: NDArray[np.bool_]) -> None:
        nonlocal codes, inks, measures
        codes, inks, measures = codes[chosen], inks[chosen], [m[chosen] for m in measures]
        counts[name] = len(codes)
        progress()

    keep("centre is a crossing", (edges[:, :4] | edges[:, 4:]).sum(1) >= 2)
    measures = [pixels_needed(FAMILY_GRID, inks)]
    progress()
    measures += [basin(FAMILY_GRID, inks), disc_bound(FAMILY_GRID, inks, SIZES_PX[0])[0]]
    pixels, bound_to_centre, bounds = measures
    median_bound, median_basin, median_pixels = (float(np.median(m)) for m in (bounds, bound_to_centre, pixels))
    keep("large regions", pixels <= MOST_PIXELS_NEEDED)
    keep("bound centre", measures[1] >= LEAST_BASIN)
    keep("bound without rim", disc_bound(FAMILY_GRID, inks, SIZES_PX[0], rim=False)[0] <= MOST_BOUND_PX)
    keep("rare in images", natural_response(FAMILY_GRID, inks, windows)[:, 0] <= MOST_NATURAL)
    distance = correlation_and_distance(FAMILY_GRID, inks, progress)[1]
    sets = best_sets(distance, SET_SIZE, count)
    named = {code_of(p): p for p in known}
    patches = tuple(
        tuple(
            named.get(int(code)) or family.patch(int(code), f"{code:08x}", len(named) + n)
            for n, code in enumerate(codes[list(members)])
        )
        for members in sets
    )
    patches = tuple(tuple(sorted(members, key=lambda p: p.patch_id)) for members in patches)
    distances = tuple(pair_distances(distance, members) for members in sets)
    return SearchResult(counts, median_bound, median_basin, median_pixels, patches, distances)
