"""Tell a user that a print is inverted: black and white are swapped within the patches.

Only designs whose inverse is not a design of the set can be told. The inverse of each shipped design is a shipped
design.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kpbench.detectors.interface import LoadedDetector
from kpbench.errors import KpbenchWarning
from kpbench.patches.design import Patch
from kpbench.types import Detections, UInt8

MOST_NEGATIVES = 8
"""Number of images whose negative is searched. This bounds the time, where no image shows a patch."""
LEAST_SCORE = 0.9
"""Least score of a patch in a negative. At a lower score, a false alarm would be called an inverted print."""


def find_uninvertible(patches: Sequence[Patch]) -> tuple[Patch, ...]:
    """Return the designs whose inverse is no design of the set, turned by any angle. Rim and quiet zone do not count.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.detectors.inverted import find_uninvertible
    >>> find_uninvertible(kpbench.shipped_patches())
    ()
    >>> [patch.name for patch in find_uninvertible(kpbench.shipped_patches()[:3])]
    ['wheel']
    """
    discs = [replace(patch, rim=0.0, quiet_zone=0.0) for patch in patches]
    return tuple(p for p, disc in zip(patches, discs, strict=True) if not any(_is_inverse(disc, d) for d in discs))


def _is_inverse(patch: Patch, other: Patch) -> bool:
    radii, angles, black = patch.cells
    other_radii, other_angles, other_black = other.cells
    if black.shape != other_black.shape or not np.allclose(radii, other_radii, atol=1e-6):
        return False
    width, other_width = (np.diff(a, append=a[0] + 360.0) for a in (angles, other_angles))
    turns = range(len(angles))
    return any(
        np.allclose(np.roll(width, n), other_width, atol=1e-6)
        and np.array_equal(~np.roll(black, n, axis=1), other_black)
        for n in turns
    )


@dataclass
class InvertedPrints:
    """Search the negatives of images for the designs whose inverse is no design, and warn once of an inverted print.

    The search ends when the detector has found such a design in an image itself, or after ``MOST_NEGATIVES`` images.
    """

    detector: LoadedDetector

    def __post_init__(self) -> None:
        uninvertible = find_uninvertible(self.detector.patches)
        self.names = {patch.patch_id: patch.name for patch in uninvertible}
        self.left = MOST_NEGATIVES if uninvertible else 0

    def look(self, label: str, image: UInt8, found: Detections) -> None:
        """Look at one image and its detections; ``label`` names the image."""
        if not self.left:
            return
        if self._names(found):
            self.left = 0
            return
        self.left -= 1
        try:
            negative = self.detector(np.asarray(255 - image, np.uint8))
        except Exception:  # a user's detector may raise any exception
            return
        names = self._names(negative)
        if names:
            self.left = 0
            what = f"{label}: the print is inverted: {names[0]} shows black and white swapped"
            warnings.warn(f"{what}; swap them in the print, see docs/howto/print.md", KpbenchWarning, stacklevel=2)

    def _names(self, found: Detections) -> list[str]:
        """Return the names of the sure detections whose inverse is no design."""
        ids = [] if found.patch_id is None else found.patch_id[found.score >= LEAST_SCORE].tolist()
        return [self.names[n] for n in ids if n in self.names]
