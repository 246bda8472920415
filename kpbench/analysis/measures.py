"""How good a design is: localisation, look-alikes among designs and in nature, pixels needed.

Distances are root mean squares in units of the ink contrast: 0.1 at a contrast of 180 grey levels is a
difference of 18 grey levels a pixel, which is what noise has to hide. See :mod:`kpbench.analysis` for how
designs are rendered, blurred and seen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from kpbench.analysis.cell_images import (
    BLUR,
    DIRECTIONS_DEG,
    HALF,
    MARGIN,
    SEEN_PX,
    TILTS_DEG,
    TURNS,
    Grid,
    attitudes,
    blurred,
    images,
    moments,
    seen_cells,
    window_weights,
)
from kpbench.geometry.camera import Camera, plane_to_camera, rotation_xyz
from kpbench.geometry.homography import project_disc
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, UInt8

NOISE, CONTRAST = 10.0, 180.0  # grey levels
SIZES_PX = (5.0, 8.0, 16.0, 45.0)
SEEN_BASIN = (1.0, 1 / 2, 1 / 3)
SEEN_IDENTITY = (1.0, 3 / 4)
SHIFT = 0.25  # of the seen radius
LOOKS_ALIKE = (0.8, 0.9)  # correlations
WINDOWS = 20_000
PAIR_STEPS = len(SEEN_IDENTITY) * (1 + (len(TILTS_DEG) - 1) * len(DIRECTIONS_DEG))  # calls of progress
STEPS = len(SIZES_PX) * len(TILTS_DEG) * 2 + PAIR_STEPS


# --- Localisation -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bound:
    """Cramér-Rao bound of the centre in px: worst direction and root mean square over both axes.

    The worst over the directions of the tilt. ``blur`` is the blur's standard deviation in disc radii.
    """

    radius_px: float
    tilt_deg: float
    blur: float
    worst_px: float
    rms_px: float


def bound(
    cells: Sequence[Float], inks: Float32, attitude: Float, blur_px: float = 0.0, rim: bool = True
) -> tuple[Float, Float]:
    """Cramér-Rao bound of the point at the cells' origin, in px, at NOISE and CONTRAST.

    Unknown are the point, the 2x2 affine deformation and both inks (8 unknowns); derivatives are central
    differences of exact renders. Fisher information of a Gaussian: S. Kay, *Fundamentals of Statistical
    Signal Processing: Estimation Theory*, 1993, eq. 3.31. Around the cells lies a known mid-grey.

    Parameters
    ----------
    cells : sequence of ndarray of shape (N, 2)
    inks : ndarray of shape (n, len(cells))
    attitude : ndarray of shape (2, 2)
        From the cells' frame to px.
    blur_px : float
    rim : bool
        False to use only pixels that the cells cover altogether, as on an unknown background.

    Returns
    -------
    worst_px, rms_px : ndarrays of shape (n,)
        Standard deviation in the worst direction, and the root mean square over the two axes; infinite
        where the image does not determine the point.
    """
    step = 0.02
    base = np.column_stack([attitude, np.zeros(2)])
    size = max(np.linalg.norm(np.concatenate(list(cells)), axis=1).max(), 1e-9)
    poses = [base]
    for row, column, move in [(0, 2, 1.0), (1, 2, 1.0), *((r, c, 1 / size) for r in (0, 1) for c in (0, 1))]:
        for sign in (1, -1):
            pose = base.copy()
            pose[row, column] += sign * step * move
            poses.append(pose)
    half = int(np.ceil(np.abs(np.concatenate(list(cells)) @ attitude.T).max() + 3 * blur_px)) + 2
    sums = np.vstack([inks, np.ones((1, len(cells)), np.float32)])
    if len(sums) < len(cells):
        parts = images(cells, np.array(poses), half, blur_px, sums)
    else:
        parts = sums @ images(cells, np.array(poses), half, blur_px)
    if not rim:
        parts = parts[:, :, np.all(parts[:, -1] > 1 - 1e-5, axis=0)]
    exact = parts.astype(np.float64).transpose(1, 0, 2)
    black, whole = exact[:-1], exact[-1]
    image = 0.5 * whole - black  # white is 1/2, black is -1/2, what surrounds them is 0
    geometric = (image[:, 1::2] - image[:, 2::2]) / (2 * step)
    J = np.concatenate([geometric, black[:, :1], whole[:1] - black[:, :1]], axis=1) * (CONTRAST / NOISE)
    F = J @ J.transpose(0, 2, 1)
    nuisance = np.linalg.pinv(F[:, 2:, 2:], rcond=1e-7, hermitian=True)
    centre = F[:, :2, :2] - F[:, :2, 2:] @ nuisance @ F[:, 2:, :2]
    information = np.linalg.eigvalsh(centre)
    known = information > 1e-5 * F[:, :2, :2].trace(axis1=1, axis2=2)[:, None]
    variance = np.where(known, 1 / np.where(known, information, 1.0), np.inf)
    return np.sqrt(variance.max(1)), np.sqrt(variance.mean(1))


def disc_bound(
    grid: Grid, inks: Float32, radius_px: float, tilt_deg: float = 0.0, blur: float = 0.0, rim: bool = True
) -> tuple[Float, Float]:
    """:func:`bound` of designs of a radius and tilt; the worst over the directions of the tilt."""
    cells = grid.cells(0.005 / radius_px)
    found = [
        bound(cells, inks, radius_px * view, blur * radius_px, rim)
        for view in attitudes(turns=1, tilts_deg=(tilt_deg,))
    ]
    return np.max([worst for worst, _ in found], axis=0), np.max([rms for _, rms in found], axis=0)


def basin(grid: Grid, inks: Float32) -> Float:
    """How unlike a design is to itself a little off the centre, in any direction and whatever part is seen.

    A blurred patch is compared with itself shifted by SHIFT of the seen radius, in any attitude. What is
    left after the best gain and offset, as a root mean square in ink contrasts, is taken in the worst of
    eight directions, the best attitude, and the worst of the seen parts SEEN_BASIN.

    Returns
    -------
    ndarray of shape (n,)
    """
    view = attitudes()
    weight = window_weights(np.eye(2)[None])[0]
    least = np.full(len(inks), np.inf)
    for seen in SEEN_BASIN:
        still, spread = moments(weight, seen_cells(grid, np.eye(2)[None], seen)[0], inks)
        for angle in 2 * np.pi * np.arange(8) / 8:
            shift = (SHIFT * SEEN_PX * np.cos(angle), SHIFT * SEEN_PX * np.sin(angle))
            best = np.zeros(len(inks), np.float32)
            for cells in seen_cells(grid, view, seen, shift):
                moved, moved_spread = moments(weight, cells, inks)
                best = np.maximum(best, np.einsum("np,np,p->n", still, moved, weight) / (spread * moved_spread))
            least = np.minimum(least, spread * np.sqrt(np.maximum(1 - best**2, 0)))
    return least


def tilt_bias(patch: Patch, radius_px: float = 45.0, tilt_deg: float = 60.0) -> float:
    """How far the centre of the patch's arcs lies from its keypoint in a tilted view, px.

    0 where straight edges cross at the keypoint. Else all that tells the centre (at least along an edge) are
    arcs, whose images' centres are not the image of their centre. Camera of the paper (1624x1240, f = 889 px).
    """
    if patch.centre_is_crossing:
        return 0.0
    camera = Camera(1624, 1240, 889.0)
    pose = plane_to_camera(rotation_xyz(0.0, tilt_deg, 0.0), [0.0, 0.0, camera.focal_px / radius_px])
    H = camera.K @ pose
    keypoint = H[:2, 2] / H[2, 2]
    disc = project_disc(H)
    return float(np.hypot(disc.x - keypoint[0], disc.y - keypoint[1]))


# --- Identity -----------------------------------------------------------------------------------------


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


# --- Nature -------------------------------------------------------------------------------------------


def sample_windows(photographs: Iterable[UInt8], rng: np.random.Generator, count: int = WINDOWS) -> UInt8:
    """Windows at random places of images at full, half and quarter size.

    Parameters
    ----------
    photographs : iterable of ndarray of shape (H, W), uint8
        Read until there are enough windows, 200 from each.
    rng : numpy.random.Generator
    count : int

    Returns
    -------
    ndarray of shape (count or fewer, side, side), uint8
        With room around the seen disc for a blur.
    """
    import cv2

    side, found, total = 2 * (HALF + MARGIN) + 1, [], 0
    for photograph in photographs:
        scale = 2.0 ** -rng.integers(0, 3)
        size = [max(side, round(scale * n)) for n in photograph.shape[::-1]]
        view = np.lib.stride_tricks.sliding_window_view(
            cv2.resize(photograph, size, interpolation=cv2.INTER_AREA), (side, side)
        )
        rows, columns = rng.integers(0, view.shape[:2], (200, 2)).T
        found.append(view[rows, columns])
        total += 200
        if total >= count:
            break
    return np.concatenate(found)[:count]


def natural_response(grid: Grid, inks: Float32, windows: UInt8, blur: float = 0.0) -> Float:
    """Share of places in images that look like a design in some attitude.

    Parameters
    ----------
    windows : ndarray of shape (N, side, side), uint8
        From :func:`sample_windows`. Those with a standard deviation under 8 grey levels count as unlike.
    blur : float
        Of designs and windows alike.

    Returns
    -------
    ndarray of shape (n, 2)
        Share of the windows whose correlation exceeds each of LOOKS_ALIKE.
    """
    weight = window_weights(np.eye(2)[None])[0]
    seen = blurred(windows.astype(np.float32), blur * SEEN_PX, HALF).reshape(len(windows), -1)
    seen = seen - (seen @ weight)[:, None]
    spread = np.sqrt((seen * seen) @ weight)
    textured = spread >= 8
    nature = (seen[textured] * weight / spread[textured, None]).T
    best = np.zeros((len(inks), nature.shape[1]), np.float32)
    for cells in seen_cells(grid, attitudes(), 1.0, blur=blur):
        image, own_spread = moments(weight, cells, inks)
        np.maximum(best, (-image / own_spread[:, None]) @ nature, out=best)  # ink is dark
    return np.array([(best > limit).sum(1) / len(windows) for limit in LOOKS_ALIKE]).T


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
        Called now and then, :data:`STEPS` times in all.
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
