"""How good a design is: localisation, look-alikes among designs and in nature, pixels needed.

Distances are root mean squares in units of the ink contrast: 0.1 at a contrast of 180 grey levels is a
difference of 18 grey levels a pixel, which is what noise has to hide. See :mod:`kpbench.analysis` for how
designs are rendered, blurred and seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from kpbench.analysis.cell_images import (
    BLUR,
    SEEN_PX,
    TILTS_DEG,
    Grid,
)
from kpbench.analysis.identity import (
    PAIR_STEPS,
    SEEN_IDENTITY,
    correlation_and_distance,
    mirrored_distance,
    symmetry_order,
    turned_distance,
)
from kpbench.analysis.localisation import CONTRAST, NOISE, SEEN_BASIN, Bound, basin, disc_bound, tilt_bias
from kpbench.analysis.natural_images import LOOKS_ALIKE, natural_response
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, UInt8

SIZES_PX = (5.0, 8.0, 16.0, 45.0)
ANALYSIS_STEPS = len(SIZES_PX) * len(TILTS_DEG) * 2 + PAIR_STEPS


# --- Nature -------------------------------------------------------------------------------------------


def pixels_needed(grid: Grid, inks: Float32, samples: int = 128) -> Float:
    """Disc radius in px at which the smallest region of one ink holds a circle of 2 px diameter, shape (n,)."""
    from scipy.ndimage import distance_transform_edt, label

    at = (np.arange(samples) + 0.5) * 2 / samples - 1
    u, v = np.meshgrid(at, at)
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


# --- Report -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DesignReport:
    """All measures of one design; lengths in px, distances in ink contrasts.

    ``bound_without_rim_px`` is the worst direction's bound at 5 px radius where the background is unknown;
    infinite if the inside alone does not determine the centre.
    """

    name: str
    patch_id: int
    centre_is_crossing: bool
    symmetry_order: int
    turned_distance: float
    mirrored_distance: float
    tilt_bias_px: float
    black_fraction: float
    pixels_needed: float
    bounds: tuple[Bound, ...]
    bound_without_rim_px: float
    basin: float
    natural_response: tuple[float, ...]
    natural_response_blurred: tuple[float, ...]

    def bound_at(self, radius_px: float, tilt_deg: float = 0.0, blur: float = 0.0) -> Bound:
        """One of :attr:`bounds`."""
        wanted = (radius_px, tilt_deg, blur)
        return next(b for b in self.bounds if (b.radius_px, b.tilt_deg, b.blur) == wanted)


@dataclass(frozen=True)
class Analysis:
    """Measures of several designs, and between each pair of them."""

    designs: tuple[DesignReport, ...]
    correlation: Float32
    distance: Float32

    def nearest(self, n: int) -> tuple[str, float]:
        """Name of the design that looks most like design n, and its distance; ("", inf) if it is alone."""
        others = np.where(np.arange(len(self.designs)) == n, np.inf, self.distance[n])
        closest = int(np.argmin(others))
        return (self.designs[closest].name, float(others[closest])) if len(others) > 1 else ("", float("inf"))

    def to_dict(self) -> dict[str, Any]:
        """The content of the JSON file; infinite bounds are null."""
        settings = {
            "noise": NOISE,
            "contrast": CONTRAST,
            "seen_px": SEEN_PX,
            "blur": BLUR,
            "seen_basin": SEEN_BASIN,
            "seen_identity": SEEN_IDENTITY,
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


def analyse(patches: Sequence[Patch], windows: UInt8, progress: Callable[[], None] = lambda: None) -> Analysis:
    """Measure designs.

    Parameters
    ----------
    patches : sequence of Patch
    windows : ndarray of shape (N, side, side), uint8
        From :func:`sample_windows`.
    progress : callable
        Called now and then, :data:`ANALYSIS_STEPS` times in all.
    """
    grid = Grid.of(patches)
    inks = grid.inks(patches)
    bounds: list[list[Bound]] = [[] for _ in patches]
    for radius in SIZES_PX:
        for tilt in TILTS_DEG:
            for blur in (0.0, BLUR):
                worst, rms = disc_bound(grid, inks, radius, tilt, blur)
                for n, found in enumerate(bounds):
                    found.append(Bound(radius, tilt, blur, float(worst[n]), float(rms[n])))
                progress()
    without_rim = disc_bound(grid, inks, SIZES_PX[0], rim=False)[0]
    correlation, distance = correlation_and_distance(grid, inks, progress)
    measures = zip(
        patches,
        turned_distance(grid, inks),
        mirrored_distance(grid, inks),
        _black_fraction(grid, inks),
        pixels_needed(grid, inks),
        bounds,
        without_rim,
        basin(grid, inks),
        natural_response(grid, inks, windows),
        natural_response(grid, inks, windows, BLUR),
        strict=True,
    )
    reports = tuple(
        DesignReport(
            p.name,
            p.patch_id,
            p.centre_is_crossing,
            symmetry_order(p),
            float(turned),
            float(mirrored),
            tilt_bias(p),
            float(black),
            float(pixels),
            tuple(found),
            float(hidden),
            float(bound_to_centre),
            tuple(sharp.tolist()),
            tuple(blurred.tolist()),
        )
        for p, turned, mirrored, black, pixels, found, hidden, bound_to_centre, sharp, blurred in measures
    )
    return Analysis(reports, correlation, distance)


def _black_fraction(grid: Grid, inks: Float32) -> Float:
    radii = np.append(0.0, grid.radii)
    width = np.diff(np.append(grid.angles_deg, grid.angles_deg[0] + 360.0)) / 360.0
    area = np.outer(np.diff(radii**2), width).ravel() / radii[-1] ** 2
    return np.asarray(inks @ area)
