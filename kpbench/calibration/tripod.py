"""Tripod series: photographs of one fixed scene, in which the easy ones give truth to the hard ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from kpbench.calibration.bundle import Bundle
from kpbench.calibration.observe import LEAST_CORNERS, Observed
from kpbench.errors import DataError, GateFailed
from kpbench.types import Float

EASY_SHARE = 0.5
"""Least number of marks of an easy photograph, in parts of the largest number in its series."""
MOST_DRIFT_PX = 0.25
"""Largest motion of a patch between two easy photographs of a series, px."""
NEVER_FOUND = ("no-marks", "few-points", "no-pose", "wrong-board", "outliers", "does-not-fit")
"""Reason codes of photographs that may be hard photographs of a series."""


@dataclass(frozen=True)
class Hard:
    """Where a hard photograph of a series gets its truth from.

    Attributes
    ----------
    series : str
        Folder of the series.
    easy : Observed
        The first easy photograph of the series.
    row : int
        Its row in the bundle.
    drift_px : float
        Largest motion of a patch between two easy photographs of the series, px.
    """

    series: str
    easy: Observed
    row: int
    drift_px: float


def find_hard_photos(
    observed: Sequence[Observed],
    bundle: Bundle,
    board_mm: Float,
    centres_mm: Float,
    folders: Sequence[str],
    source: str,
) -> tuple[list[Observed], dict[str, Hard]]:
    """Find the hard photographs of tripod series, and the easy one that each gets its truth from.

    A photograph is easy if it was solved, and shows at least half of the marks that the best one of its series shows.
    The names of the files, without their folders, tell the order in which they were taken. A hard photograph needs an
    easy one before and one after it.

    Parameters
    ----------
    observed : sequence of Observed
        All photographs; those without reason are the photographs of the bundle.
    bundle : Bundle
    board_mm : ndarray of shape (N, 2)
        The X-corners of the marks.
    centres_mm : ndarray of shape (n, 2)
        The patches.
    folders : sequence of str
        Folders of the series, relative to that of the photographs; "." for all photographs.
    source : str
        What messages name.

    Returns
    -------
    observed : list of Observed
        A hard photograph that has no easy one before or after it has the reason ``not-between``.
    hard : dict of str to Hard
        By name of the photograph.

    Raises
    ------
    DataError
        If a folder has no photographs, or fewer than two easy ones.
    GateFailed
        If camera or board moved between two easy photographs.
    """
    row_of = {o.photo.name: n for n, o in enumerate(o for o in observed if not o.reason)}
    done, found = {o.photo.name: o for o in observed}, dict[str, Hard]()
    for folder in folders:
        inside = [o for o in observed if is_inside(o.photo.name, folder)]
        place = f"{source}: series {folder!r}"
        if not inside:
            raise DataError(f"{place} has no photographs")
        inside.sort(key=lambda o: PurePosixPath(o.photo.name).name)
        most = max((len(o.points) for o in inside if not o.reason), default=0)
        easy = [o for o in inside if not o.reason and len(o.points) >= max(LEAST_CORNERS, EASY_SHARE * most)]
        if len(easy) < 2:
            raise DataError(f"{place}: {len(easy)} photographs show enough marks, expected one before and one after")
        best = easy[0]
        drift_px = 0.0
        for o in easy:
            rows = row_of[best.photo.name], row_of[o.photo.name]
            moved_px = _measure_drift(bundle, *rows, board_mm, centres_mm)
            if moved_px > MOST_DRIFT_PX:
                pair = " and ".join(each.photo.name for each in inside if each in (best, o))
                raise GateFailed(
                    f"{place}: camera or board moved by {moved_px:.2f} px between {pair}, expected a fixed scene"
                )
            drift_px = max(drift_px, moved_px)
        first, last = inside.index(easy[0]), inside.index(easy[-1])
        for n, o in enumerate(inside):
            if o in easy or (o.reason and o.reason not in NEVER_FOUND):
                continue
            if first < n < last:
                found[o.photo.name] = Hard(folder, best, row_of[best.photo.name], drift_px)
            elif o.reason:
                done[o.photo.name] = Observed(o.photo, o.points, "not-between")
    return list(done.values()), found


def is_inside(name: str, folder: str) -> bool:
    """Return whether a photograph lies in the folder of a series; "." is the folder of all photographs."""
    return folder == "." or PurePosixPath(name).is_relative_to(folder)


def _measure_drift(bundle: Bundle, a: int, b: int, board_mm: Float, centres_mm: Float) -> float:
    """Return the largest motion of a patch between two photographs, px, by an affine fit to the motions of marks.

    What the fit would find by chance is subtracted.
    """
    rows_a, rows_b = (np.flatnonzero(bundle.inlier[n]) for n in (a, b))
    first, second = bundle.points[a][rows_a], bundle.points[b][rows_b]
    index, at_a, at_b = np.intersect1d(first.index, second.index, return_indices=True)
    if len(index) < LEAST_CORNERS:
        return np.inf
    motion = second.xy[at_b] - first.xy[at_a]
    A, at_patches = (np.column_stack([places, np.ones(len(places))]) for places in (board_mm[index], centres_mm))
    affine = np.linalg.lstsq(A, motion, rcond=None)[0]
    noise = ((motion - A @ affine) ** 2).sum() / (len(A) - 3)  # squared px, x and y together
    by_chance = noise * np.einsum("ni,ij,nj->n", at_patches, np.linalg.inv(A.T @ A), at_patches)
    return float(np.sqrt(max(0.0, (((at_patches @ affine) ** 2).sum(axis=1) - by_chance).max())))
