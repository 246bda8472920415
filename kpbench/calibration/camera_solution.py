"""Calibrate a camera from photographs of a board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kpbench.calibration.bundle import Bundle
from kpbench.calibration.observe import (
    LEAST_CORNERS,
    LEAST_PATCHES,
    Observed,
    board_points_mm,
    name_point,
    observe_photos,
)
from kpbench.calibration.projection import camera_values
from kpbench.calibration.start import solve_photos, start_camera, start_pose
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.geometry.lens import LensModel
from kpbench.patches.board import Board
from kpbench.types import Float

MOST_OUTLIERS = 0.3
"""Largest fraction of the points of a photograph that may be outliers."""
MISFIT, LEAST_MISFIT_PX = 5.0, 0.15
"""A photograph is rejected if its residuals are over ``MISFIT`` times those of most photographs, and over this, px."""
LARGEST_RMS_PX = 1.5
"""Root mean square of the residuals of most photographs, px, over which no camera explains them."""
LEAST_PHOTOS = 3
"""Smallest number of photographs of a calibration."""
FEW_PHOTOS = 20
"""Number of photographs below which the two halves tell little."""
CAMERA_NAMES = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class Halves:
    """Two halves of the photographs, solved apart.

    Attributes
    ----------
    difference : ndarray of shape (4,)
        Difference of fx, fy, cx, cy, px.
    sigma : ndarray of shape (4,)
        Stated standard deviations of the differences.
    chi2 : float
        Squared difference of all parameters of the camera, normalised by their covariance.
    p : float
        Probability of a larger chi2, if the stated covariances are right.
    """

    difference: Float
    sigma: Float
    chi2: float
    p: float


@dataclass(frozen=True)
class Calibration:
    """The result of :func:`calibrate`.

    Attributes
    ----------
    board : Board
    observed : tuple of Observed
        All photographs, with reason codes of those that were rejected.
    bundle : Bundle
        The solution of the photographs that were used, in their order.
    halves : Halves or None
        None if there are too few photographs.

    Examples
    --------
    See :func:`kpbench.calibrate`.
    """

    board: Board
    observed: tuple[Observed, ...]
    bundle: Bundle
    halves: Halves | None

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.bundle.camera

    @property
    def used(self) -> tuple[Observed, ...]:
        """The photographs that were used."""
        return tuple(o for o in self.observed if not o.reason)

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviations of fx, fy, cx, cy, px, and of the coefficients of the lens."""
        names = (*CAMERA_NAMES, *(f"lens[{n}]" for n in range(len(self.camera.distortion))))
        deviations = np.sqrt(np.diag(self.bundle.covariance))
        return {name: float(s) for name, s in zip(names, deviations, strict=False)}

    def outliers(self) -> list[tuple[str, str, float]]:
        """Return the points that were left out: photograph, name of the point, and residual in px."""
        found = list[tuple[str, str, float]]()
        parts = zip(self.used, self.bundle.points, self.bundle.inlier, self.bundle.residual, strict=True)
        for o, points, inlier, residual in parts:
            for n in np.flatnonzero(~inlier).tolist():
                name = name_point(self.board, int(points.index[n]))
                found.append((o.photo.name, name, float(np.hypot(*residual[n]))))
        return found

    def coverage(self, columns: int = 8, rows: int = 6) -> Float:
        """Return how many points lie in each cell of the image, ndarray of shape (rows, columns)."""
        width, height = self.camera.width_px, self.camera.height_px
        xy = np.concatenate([p.xy[k] for p, k in zip(self.bundle.points, self.bundle.inlier, strict=True)])
        counts, _, _ = np.histogram2d(xy[:, 1], xy[:, 0], (rows, columns), ((0, height), (0, width)))
        return np.asarray(counts)


def calibrate(
    photos: str | Path | Sequence[str | Path],
    board: Board,
    *,
    model: LensModel = "brown",
    coefficients: int = 5,
    detector: str = "superpoint-small",
    progress: Callable[[int], None] = lambda photos: None,
) -> Calibration:
    """Calibrate a camera from photographs of a board.

    Lens, poses, ratio and skew of the print, and the bow of the paper are solved together. Photographs and points that
    do not fit are left out.

    Parameters
    ----------
    photos : str, Path or a sequence of them
        Folder of photographs, or files, all of one camera with fixed zoom and focus.
    board : Board
        A board with reference marks, or any board of patches.
    model : {"brown", "fisheye"}
    coefficients : int
        0, 4, 5 or 8 coefficients of the lens for ``brown``. ``fisheye`` always has four.
    detector : str
        Name of a detector as in :func:`kpbench.load_detector`. Finds the patches of a board without marks.
    progress : callable
        Called with the number of photographs that were read since its last call.

    Returns
    -------
    Calibration

    Raises
    ------
    DataError
        If fewer than three photographs show the board, or no camera explains the photographs.

    Examples
    --------
    >>> import kpbench
    >>> board = kpbench.truth_board(kpbench.shipped_patches())
    >>> kpbench.calibrate("no-photos", board)
    Traceback (most recent call last):
     ...
    kpbench.errors.DataError: no-photos: no such photograph or folder of photographs
    """
    observed = observe_photos(photos, board, detector=detector, progress=progress)
    return solve_calibration(observed, board, model, 4 if model == "fisheye" else coefficients, str(photos))


def solve_calibration(
    observed: Sequence[Observed], board: Board, model: LensModel, coefficients: int, source: str
) -> Calibration:
    """Solve a camera from the points of photographs. See :func:`calibrate`."""
    board_mm = board_points_mm(board)
    used = _require_photos(observed, source)
    size = used[0].photo.size_px
    camera = start_camera([o.points for o in used], board_mm, size, model, coefficients)
    observed, bundle = solve_and_reject(observed, board_mm, camera, source, has_marks=bool(board.references))
    require_explained(bundle, source)
    return Calibration(board, tuple(observed), bundle, compare_halves(bundle, board_mm))


def require_explained(bundle: Bundle, source: str) -> None:
    """Refuse photographs that no camera explains."""
    rms = float(np.median(bundle.rms_px()))
    if rms > LARGEST_RMS_PX:
        raise DataError(
            f"{source}: no camera explains the photographs, the residuals are {rms:.1f} px (median); expected "
            "photographs of this board by one camera with fixed zoom and focus"
        )


def solve_and_reject(
    observed: Sequence[Observed],
    board_mm: Float,
    camera: Camera,
    source: str,
    *,
    solve_camera: bool = True,
    has_marks: bool = True,
) -> tuple[list[Observed], Bundle]:
    """Solve photographs, and again without those that do not fit."""
    least = LEAST_CORNERS if has_marks else LEAST_PATCHES
    observed = [
        Observed(o.photo, o.points, "no-pose") if not o.reason and start_pose(o.points, board_mm, camera) is None else o
        for o in observed
    ]
    while True:
        used = _require_photos(observed, source, LEAST_PHOTOS if solve_camera else 1)
        bundle = solve_photos([o.points for o in used], board_mm, camera, solve_camera=solve_camera)
        rms, reasons = bundle.rms_px(), dict[str, str]()
        limit = max(MISFIT * float(np.nanmedian(rms)), LEAST_MISFIT_PX)
        for o, value, inlier in zip(used, rms, bundle.inlier, strict=True):
            if inlier.sum() < least or inlier.mean() < 1 - MOST_OUTLIERS:
                reasons[o.photo.name] = "outliers"
            elif value > limit:
                reasons[o.photo.name] = "does-not-fit"
        if not reasons:
            return observed, bundle
        observed = [
            Observed(o.photo, o.points, reasons[o.photo.name]) if not o.reason and o.photo.name in reasons else o
            for o in observed
        ]
        camera = bundle.camera


def _require_photos(observed: Sequence[Observed], source: str, least: int = LEAST_PHOTOS) -> list[Observed]:
    used = [o for o in observed if not o.reason]
    if len(used) < least:
        counts = dict[str, int]()
        for o in observed:
            if o.reason:
                counts[o.reason] = counts.get(o.reason, 0) + 1
        why = ", ".join(f"{reason} {count}" for reason, count in sorted(counts.items(), key=lambda item: -item[1]))
        raise DataError(
            f"{source}: {len(used)} of {len(observed)} photographs show the board, expected at least {least}"
            + (f" (rejected: {why})" if why else "")
        )
    return used


def compare_halves(bundle: Bundle, board_mm: Float) -> Halves | None:
    """Solve the first and the second half of the photographs apart, in the order of their names.

    Each half solves the camera, also if it is known; its parameters are compared.
    """
    from scipy.stats import chi2

    half = len(bundle.points) // 2
    if half < LEAST_PHOTOS:
        return None
    parts = [solve_photos(bundle.points[rows], board_mm, bundle.camera) for rows in (slice(0, half), slice(half, None))]
    count = 4 + len(bundle.camera.distortion)
    difference = camera_values(parts[0].camera) - camera_values(parts[1].camera)
    covariance = sum(part.covariance[:count, :count] for part in parts) + np.zeros((count, count))
    scale = 1 / np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    whitened = np.linalg.lstsq(covariance * scale[:, None] * scale, difference * scale, rcond=1e-10)[0]
    value = float(difference * scale @ whitened)
    return Halves(difference[:4], np.sqrt(np.diag(covariance))[:4], value, float(chi2.sf(value, count)))
