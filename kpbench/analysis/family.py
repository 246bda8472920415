"""The family of designs among which the search chooses.

A design of the family has up to three semi-circles with radii of 1, 2/3, 1/2 or 1/3 and angles in steps of 45 degrees.
The semi-circles are painted onto a black or a white disc. A semi-circle is black, is white, or inverts the ink below. A
*stroke* is a semi-circle of one radius, angle and ink.

The cells of a design are four rings by eight sectors. A design therefore has a *code* of 32 bits: bit ``8 * ring +
sector`` is 1 if the cell is black. A design, its rotations and their mirror images form a *class*. The *canonical code*
of a class is the smallest code of its members.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kpbench.analysis.cell_images import PolarGrid
from kpbench.patches.design import Patch, SemiCircle
from kpbench.types import Float32

FAMILY_RADII = (1.0, 2 / 3, 1 / 2, 1 / 3)
FAMILY_ANGLES_DEG = tuple(45.0 * n for n in range(8))
MOST_SEMICIRCLES = 3
FAMILY_GRID = PolarGrid(tuple(sorted(FAMILY_RADII)), FAMILY_ANGLES_DEG)
"""The rings and sectors of all designs of the family."""

Codes = NDArray[np.uint32]


def _strokes() -> list[tuple[SemiCircle, np.uint32]]:
    """Return every stroke with the bits of the cells that the stroke covers."""
    found = []
    for radius in FAMILY_RADII:
        rings = FAMILY_GRID.radii.index(radius) + 1
        for sector, angle in enumerate(FAMILY_ANGLES_DEG):
            bits = sum(1 << (8 * ring + (sector + n) % 8) for ring in range(rings) for n in range(4))
            found += [(SemiCircle(radius, angle, ink), np.uint32(bits)) for ink in ("black", "white", "invert")]
    return found


STROKES = _strokes()


def paint_semicircle(codes: Codes, stroke: int) -> Codes:
    """Return the codes after one more semi-circle is painted; ``stroke`` is an index into :data:`STROKES`."""
    semicircle, bits = STROKES[stroke]
    if semicircle.ink == "invert":
        return codes ^ bits
    return codes | bits if semicircle.ink == "black" else codes & ~bits


def canonical_codes(codes: Codes) -> Codes:
    """Return the canonical code of each design's class."""
    rings = codes.astype("<u4").view(np.uint8).reshape(-1, 4)
    mirrored = np.packbits(np.unpackbits(rings[..., None], axis=-1), axis=-1, bitorder="little")[..., 0]
    orbit = [
        ((side << turn) | (side >> (8 - turn) % 8 if turn else side)).astype(np.uint8)
        for side in (rings, mirrored)
        for turn in range(8)
    ]
    return np.asarray(np.min([np.ascontiguousarray(r).view("<u4")[:, 0] for r in orbit], axis=0), np.uint32)


def code_of(patch: Patch) -> int:
    """Return the canonical code of a design whose cells lie on :data:`FAMILY_GRID`.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.analysis import code_of
    >>> f"{code_of(kpbench.shipped_patches()[0]):08x}"
    '33333333'
    """
    bits = FAMILY_GRID.inks([patch])[0].astype(np.uint64)
    return int(canonical_codes(np.array([(bits << np.arange(32, dtype=np.uint64)).sum()], np.uint32))[0])


@dataclass(frozen=True)
class Family:
    """All designs that can be painted, each with a shortest list of strokes that paints the design.

    Attributes
    ----------
    codes : ndarray of shape (N,), uint32
        Code of each design.
    parents : ndarray of shape (N,), int64
        Index of the design before the last stroke; -1 for a bare disc.
    strokes : ndarray of shape (N,), int64
        Index of the last stroke in :data:`STROKES`; -1 for a bare disc.
    """

    codes: Codes
    parents: NDArray[np.int64]
    strokes: NDArray[np.int64]

    @cached_property
    def classes(self) -> Codes:
        """Canonical code of each class, ascending."""
        return np.unique(canonical_codes(self.codes))

    def patch(self, code: int, name: str, patch_id: int) -> Patch:
        """Return a design of the family as a patch."""
        at = int(np.flatnonzero(self.codes == code)[0])
        semicircles: list[SemiCircle] = []
        while self.parents[at] >= 0:
            semicircles.insert(0, STROKES[self.strokes[at]][0])
            at = int(self.parents[at])
        return Patch(name, patch_id, "black" if self.codes[at] else "white", tuple(semicircles))


def enumerate_family() -> Family:
    """Paint every design of the family: first the bare discs, then designs of one, two and three strokes.

    Examples
    --------
    >>> from kpbench.analysis import enumerate_family
    >>> family = enumerate_family()
    >>> len(family.codes), len(family.classes)
    (45364, 3064)
    """
    codes = np.array([0, 0xFFFFFFFF], np.uint32)
    parents, strokes = np.full(2, -1), np.full(2, -1)
    layer = np.arange(2)
    for _ in range(MOST_SEMICIRCLES):
        painted = np.concatenate([paint_semicircle(codes[layer], n) for n in range(len(STROKES))])
        new, first = np.unique(painted, return_index=True)
        is_new = ~np.isin(new, codes)
        new, first = new[is_new], first[is_new]
        stroke, parent = np.divmod(first, len(layer))
        parents, strokes = np.append(parents, layer[parent]), np.append(strokes, stroke)
        layer = len(codes) + np.arange(len(new))
        codes = np.append(codes, new)
    return Family(codes, parents, strokes)


def inks_of(codes: Codes) -> Float32:
    """Return the inks of designs on :data:`FAMILY_GRID`, shape (n, 32).

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.analysis import inks_of
    >>> inks_of(np.array([0x000000FF], np.uint32))[0, :10].tolist()
    [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0]
    """
    return ((codes[:, None] >> np.arange(32, dtype=np.uint32)) & 1).astype(np.float32)
