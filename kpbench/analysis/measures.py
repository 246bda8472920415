"""All measures of designs: of each design, and between each pair of designs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from kpbench.analysis.bias import camera_bias
from kpbench.analysis.cell_images import BLUR, TILTS_DEG, WINDOW_PX, PolarGrid
from kpbench.analysis.identity import (
    IDENTITY_STEPS,
    PARTS_OF_IDENTITY,
    correlation_and_distance,
    mirrored_distance,
    turned_distance,
)
from kpbench.analysis.localisation import CONTRAST, NOISE, PARTS_OF_BASIN, Bound, basin, design_bound, tilt_bias
from kpbench.analysis.natural_images import LOOKS_ALIKE, natural_response
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, UInt8

SIZES_PX = (5.0, 8.0, 16.0, 45.0)
"""Radii of the disc for which bounds are computed, px."""
MEASURE_STEPS = len(SIZES_PX) * len(TILTS_DEG) * 2 + IDENTITY_STEPS
"""Number of steps that :func:`measure_designs` reports."""


@dataclass(frozen=True)
class DesignMeasures:
    """All measures of one design.

    Attributes
    ----------
    name : str
    patch_id : int
    centre_is_crossing : bool
        See :attr:`kpbench.Patch.centre_is_crossing`.
    symmetry_order : int
        See :attr:`kpbench.Patch.symmetry_order`.
    turned_distance, mirrored_distance : float
        Smallest distances from the design to itself rotated by 45 to 315 degrees, and to its mirror image, in ink
        contrasts.
    tilt_bias_px : float
        Distance between the keypoint and the centre of the disc's ellipse at a tilt of 60 degrees. 0 if straight edges
        determine the keypoint.
    camera_bias_px, camera_bias_toned_px : dict of str to float
        Distance by which an effect of a camera moves the centre, by name of the effect, see
        :func:`kpbench.analysis.camera_bias`: for a fit that takes the camera for linear, and for a fit with an unknown
        tone curve.
    black_fraction : float
        Black share of the design's area.
    pixels_needed : float
        Smallest disc radius in px at which a circle of 2 px diameter fits into every region of one ink.
    bounds : tuple of Bound
        One bound for each combination of disc radius, tilt and blur.
    bound_without_rim_px : float
        Bound in the worst direction, for a frontal view at 5 px radius on an unknown background. Infinite if the inside
        of the patch alone does not determine the centre.
    basin : float
        Difference between the design and its shifted copy, in ink contrasts, see :func:`kpbench.analysis.basin`.
    natural_response, natural_response_blurred : tuple of float
        Share of image windows whose correlation with the design is above 0.8, and share above 0.9. For the second
        tuple, the design and the windows are blurred.

    Examples
    --------
    >>> import kpbench
    >>> checker = kpbench.analysis.analyse_patches().analysis.designs[0]  # doctest: +SKIP
    >>> round(checker.bound_at(radius_px=5.0).worst_px, 4)  # doctest: +SKIP
    0.0162
    """

    name: str
    patch_id: int
    centre_is_crossing: bool
    symmetry_order: int
    turned_distance: float
    mirrored_distance: float
    tilt_bias_px: float
    camera_bias_px: dict[str, float]
    camera_bias_toned_px: dict[str, float]
    black_fraction: float
    pixels_needed: float
    bounds: tuple[Bound, ...]
    bound_without_rim_px: float
    basin: float
    natural_response: tuple[float, ...]
    natural_response_blurred: tuple[float, ...]

    @property
    def sizes_px(self) -> list[float]:
        """The radii that bounds were computed for, px, the smallest first."""
        return sorted({bound.radius_px for bound in self.bounds})

    def bound_at(self, radius_px: float, tilt_deg: float = 0.0, blur: float = 0.0) -> Bound:
        """Return the element of ``bounds`` with this disc radius, tilt and blur."""
        wanted = (radius_px, tilt_deg, blur)
        return next(b for b in self.bounds if (b.radius_px, b.tilt_deg, b.blur) == wanted)


@dataclass(frozen=True)
class Analysis:
    """Measures of several designs, and of each pair of designs.

    Attributes
    ----------
    designs : tuple of DesignMeasures
    correlation, distance : ndarray of shape (n, n), float32
        See :func:`kpbench.analysis.correlation_and_distance`.

    Examples
    --------
    >>> import kpbench
    >>> analysis = kpbench.analysis.analyse_patches().analysis  # doctest: +SKIP
    >>> analysis.nearest(0)[0]  # doctest: +SKIP
    'mushroom'
    """

    designs: tuple[DesignMeasures, ...]
    correlation: Float32
    distance: Float32

    def nearest(self, n: int) -> tuple[str, float]:
        """Return name and distance of the design most similar to design n; ("", inf) if there is no other design."""
        others = np.where(np.arange(len(self.designs)) == n, np.inf, self.distance[n])
        closest = int(np.argmin(others))
        return (self.designs[closest].name, float(others[closest])) if len(others) > 1 else ("", float("inf"))

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the JSON file; infinite bounds are null."""
        settings = {
            "noise": NOISE,
            "contrast": CONTRAST,
            "seen_px": WINDOW_PX,
            "blur": BLUR,
            "seen_basin": PARTS_OF_BASIN,
            "seen_identity": PARTS_OF_IDENTITY,
            "looks_alike": LOOKS_ALIKE,
        }
        table = {
            "schema": "kpbench.analysis/1",
            "settings": settings,
            "designs": [asdict(design) for design in self.designs],
            "distance": self.distance.tolist(),
            "correlation": self.correlation.tolist(),
        }
        finite: dict[str, Any] = _without_infinity(table)
        return finite


def _without_infinity(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_infinity(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_without_infinity(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def measure_designs(
    patches: Sequence[Patch], windows: UInt8, progress: Callable[[int], None] = lambda steps: None
) -> Analysis:
    """Return all measures of designs.

    Parameters
    ----------
    patches : sequence of Patch
    windows : ndarray of shape (N, side, side), uint8
        From :func:`kpbench.analysis.background_windows`.
    progress : callable
        Called with the number of steps finished since the last call. The numbers add up to :data:`MEASURE_STEPS`.
    """
    grid = PolarGrid.of(patches)
    inks = grid.inks(patches)
    bounds: list[list[Bound]] = [[] for _ in patches]
    for radius in SIZES_PX:
        for tilt in TILTS_DEG:
            for blur in (0.0, BLUR):
                worst, rms = design_bound(grid, inks, radius, tilt, blur)
                for n, found in enumerate(bounds):
                    found.append(Bound(radius, tilt, blur, float(worst[n]), float(rms[n])))
                progress(1)
    without_rim = design_bound(grid, inks, SIZES_PX[0], rim=False)[0]
    correlation, distance = correlation_and_distance(grid, inks, progress)
    measures = {
        "turned_distance": turned_distance(grid, inks),
        "mirrored_distance": mirrored_distance(grid, inks),
        "black_fraction": _black_fraction(grid, inks),
        "pixels_needed": pixels_needed(grid, inks),
        "bound_without_rim_px": without_rim,
        "basin": basin(grid, inks),
    }
    natural, natural_blurred = (natural_response(grid, inks, windows, blur).tolist() for blur in (0.0, BLUR))
    designs = tuple(
        DesignMeasures(
            name=patch.name,
            patch_id=patch.patch_id,
            centre_is_crossing=patch.centre_is_crossing,
            symmetry_order=patch.symmetry_order,
            tilt_bias_px=tilt_bias(patch),
            camera_bias_px=camera_bias(patch),
            camera_bias_toned_px=camera_bias(patch, knows_tone=True),
            bounds=tuple(bounds[n]),
            natural_response=tuple(natural[n]),
            natural_response_blurred=tuple(natural_blurred[n]),
            **{name: float(values[n]) for name, values in measures.items()},
        )
        for n, patch in enumerate(patches)
    )
    return Analysis(designs, correlation, distance)


def pixels_needed(grid: PolarGrid, inks: Float32, samples: int = 128) -> Float:
    """Return the smallest disc radius in px at which a circle of 2 px diameter fits into every region of one ink.

    Parameters
    ----------
    grid : PolarGrid
    inks : ndarray of shape (n, cells), float32
    samples : int
        Regions are found on a square grid with this many samples along the disc's diameter.

    Returns
    -------
    ndarray of shape (n,), float64

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.analysis import PolarGrid, pixels_needed
    >>> patches = kpbench.shipped_patches()
    >>> grid = PolarGrid.of(patches)
    >>> pixels_needed(grid, grid.inks(patches)).round(1)
    array([2.4, 3.6, 3.6, 3.6])
    """
    from scipy.ndimage import distance_transform_edt, label

    axis = (np.arange(samples) + 0.5) * 2 / samples - 1
    u, v = np.meshgrid(axis, axis)
    ring = np.minimum(np.searchsorted(grid.radii, np.hypot(u, v), side="right"), grid.shape[0] - 1)
    sector = np.searchsorted(grid.angles_deg, np.degrees(np.arctan2(v, u)) % 360.0, side="right") - 1
    cell = ring * grid.shape[1] + sector % grid.shape[1]
    inside = np.hypot(u, v) < 1
    needed = np.empty(len(inks))
    for n, ink in enumerate(inks):
        radii = []
        for region in (inside & (ink[cell] > 0), inside & (ink[cell] == 0)):
            depth = distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1]
            labels, parts = label(region)
            radii += [depth[labels == part + 1].max() * 2 / samples for part in range(parts)]
        needed[n] = 1 / min(radii)
    return needed


def _black_fraction(grid: PolarGrid, inks: Float32) -> Float:
    radii = np.append(0.0, grid.radii)
    width = np.diff(np.append(grid.angles_deg, grid.angles_deg[0] + 360.0)) / 360.0
    area = np.outer(np.diff(radii**2), width).ravel() / radii[-1] ** 2
    return np.asarray(inks @ area)
