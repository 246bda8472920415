"""How good a design is: localisation, look-alikes among designs and in nature, pixels needed.

A design is a polar chequer, so its image is *linear* in its inks: the image of every cell is rendered
once for each attitude (exact area coverage), and a design's image, its derivatives and its correlations
with other designs are matrix products with its vector of inks. That is what makes it cheap to measure a
whole family (:mod:`kpbench.search`).

Conventions
-----------
* An *attitude* is a 2x2 matrix from the unit disc to px, rotation and foreshortening; perspective within
  one patch is left out (a patch is small), except by :func:`tilt_bias`.
* Inks are 1 for black and 0 for white; distances are root mean squares in units of the ink contrast, so
  that 0.1 at a contrast of 180 grey levels is a difference of 18 grey levels a pixel.
* What is *seen* is always a disc of :data:`SEEN_PX` radius. If it is a fraction ``seen`` of the patch, the
  patch is larger and only its inner part is looked at: a detector knows neither the scale nor the rim.
* Blur is Gaussian, its standard deviation a fraction of the seen radius. Beyond the disc the outermost
  ring goes on, so that no distance is owed to a background.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.design import Patch
from kpbench.geometry import Camera, plane_to_camera, projected_disc, rotation_xyz
from kpbench.keypoints import Float, UInt8
from kpbench.raster import box_around, coverage

__all__ = [
    "Analysis",
    "Bound",
    "DesignReport",
    "Grid",
    "analyse",
    "basin",
    "bound",
    "correlation_and_distance",
    "natural_response",
    "pixels_needed",
    "sample_windows",
    "symmetry_order",
    "tilt_bias",
]

NOISE, CONTRAST = 10.0, 180.0  # grey levels
SIZES_PX = (5.0, 8.0, 16.0, 45.0)
TILTS_DEG = (0.0, 30.0, 60.0)
DIRECTIONS_DEG = (0.0, 45.0, 90.0, 135.0)  # of the tilt, in the image
TURNS = 24  # rotations in the plane that are compared, 15 degrees apart
SEEN_PX = 5.0
BLUR = 0.2
SEEN_BASIN = (1.0, 1 / 2, 1 / 3)
SEEN_IDENTITY = (1.0, 3 / 4)
SHIFT = 0.25  # of the seen radius
LOOKS_ALIKE = (0.8, 0.9)  # correlations
WINDOWS = 20_000
HALF = int(SEEN_PX) + 1

Float32 = NDArray[np.float32]


# --- Cells and their images ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Grid:
    """A polar chequer that several designs fit on.

    Attributes
    ----------
    radii : tuple of float
        Outer radii of the rings, ascending, in disc radii.
    angles_deg : tuple of float
        Borders of the sectors, ascending, in [0, 360).
    """

    radii: tuple[float, ...]
    angles_deg: tuple[float, ...]

    @classmethod
    def of(cls, patches: Sequence[Patch]) -> Grid:
        """The coarsest grid on which all the designs fit."""
        radii = np.unique(np.round(np.concatenate([p.cells[0][1:] for p in patches]), 9))
        angles = np.unique(np.round(np.concatenate([p.cells[1] for p in patches]), 9))
        if len(angles) < 3:  # cells must be narrower than half a turn
            angles = np.unique(np.concatenate([angles, [0.0, 90.0, 180.0, 270.0]]))
        return cls(tuple(radii.tolist()), tuple(angles.tolist()))

    @property
    def shape(self) -> tuple[int, int]:
        """Rings, sectors."""
        return len(self.radii), len(self.angles_deg)

    def _middles(self) -> tuple[Float, Float]:
        radii, angles = np.append(0.0, self.radii), np.array(self.angles_deg)
        return (radii[1:] + radii[:-1]) / 2, (angles + np.append(angles[1:], angles[0] + 360.0)) / 2

    def inks(self, patches: Sequence[Patch]) -> Float32:
        """Inks of the designs, shape (n, cells), ring by ring; a patch that ends early keeps its outer ring's inks."""
        radius, angle = self._middles()
        rows = []
        for patch in patches:
            at = np.minimum(radius, patch.extent - 1e-6)[:, None, None]
            turned = np.radians(angle)[None, :, None]
            rows.append(patch.is_black(np.concatenate([at * np.cos(turned), at * np.sin(turned)], -1)).ravel())
        return np.array(rows, np.float32)

    def cells(self, tolerance: float, reach: float = 0.0) -> list[Float]:
        """Every cell as a polygon of the patch frame; the outermost ring reaches to ``reach`` at least.

        Neighbours share the vertices of their common border, so that cells of one ink add up without a
        seam. ``tolerance`` is in disc radii, see :func:`kpbench.outline.flatten`.
        """
        radii = np.append(0.0, self.radii)
        radii[-1] = max(radii[-1], reach)
        polygons = []
        ends = np.append(self.angles_deg[1:], self.angles_deg[0] + 360.0)
        for inner, outer in zip(radii[:-1], radii[1:], strict=True):
            for start, end in zip(self.angles_deg, ends, strict=True):
                near, far = _arc(inner, start, end, tolerance), _arc(outer, start, end, tolerance)
                polygons.append(np.concatenate([far, near[::-1]]))
        return polygons


def _arc(radius: float, start_deg: float, end_deg: float, tolerance: float) -> Float:
    if radius == 0.0:
        return np.zeros((1, 2))
    count = max(2, int(np.ceil(np.radians(end_deg - start_deg) / np.sqrt(16 * tolerance / radius))))
    angle = np.radians(np.linspace(start_deg, end_deg, count + 1))
    step = angle[1] - angle[0]
    at = np.full(count + 1, radius * np.sqrt(step / np.sin(step)))  # equal area, as outline.flatten
    at[[0, -1]] = radius
    return np.column_stack([at * np.cos(angle), at * np.sin(angle)])


def attitudes(turns: int = TURNS, tilts_deg: Sequence[float] = TILTS_DEG) -> Float:
    """Foreshortened turns of the unit disc, shape (P, 2, 2); those without a turn come first."""

    def turn(degrees: float) -> Float:
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        return np.array([[c, -s], [s, c]])

    views = [np.eye(2)] if 0.0 in tilts_deg else []
    for tilt in tilts_deg:
        if tilt:
            squeeze = np.diag([np.cos(np.radians(tilt)), 1.0])
            views += [turn(d) @ squeeze @ turn(-d) for d in DIRECTIONS_DEG]
    return np.array([view @ turn(360.0 * n / turns) for n in range(turns) for view in views])


def images(polygons: Sequence[Float], poses: Float, half: int, blur_px: float = 0.0) -> Float32:
    """Exact coverage of polygons in a square window about the origin.

    Parameters
    ----------
    polygons : sequence of ndarray of shape (N, 2)
    poses : ndarray of shape (P, 2, 3)
        ``[A | shift]`` from the polygons' frame to px.
    half : int
        The window has ``2 * half + 1`` pixels a side, the origin in its middle.
    blur_px : float
        Standard deviation of a Gaussian.

    Returns
    -------
    ndarray of shape (P, len(polygons), (2 * half + 1)**2), float32
    """
    from scipy.ndimage import gaussian_filter1d

    side = 2 * half + 1
    out = np.empty((len(poses), len(polygons), side * side), np.float32)
    margin = half + (int(np.ceil(4 * blur_px)) + 1 if blur_px else 0)
    for pose, image in zip(poses, out, strict=True):
        placed = [p @ pose[:, :2].T + pose[:, 2] for p in polygons]
        x, y, w, h = box_around(placed)
        reach = max(-x, -y, x + w - 1, y + h - 1, margin)
        covered = np.array(coverage([[p] for p in placed], [(-reach, -reach, 2 * reach + 1, 2 * reach + 1)] * len(placed)))
        covered = covered[:, reach - margin : reach + margin + 1, reach - margin : reach + margin + 1]
        if blur_px:
            for axis in (1, 2):
                covered = gaussian_filter1d(covered, blur_px, axis, mode="nearest")
        cut = margin - half
        image[:] = covered[:, cut : cut + side, cut : cut + side].reshape(len(polygons), -1)
    return out


def _poses(attitude: Float, shift_px: Sequence[float] = (0.0, 0.0)) -> Float:
    return np.concatenate([attitude, np.broadcast_to(np.array(shift_px)[None, :, None], (len(attitude), 2, 1))], 2)


def _seen(grid: Grid, attitude: Float, seen: float, shift_px: Sequence[float] = (0.0, 0.0)) -> Float32:
    """Blurred cells, (P, cells, pixels), of patches so large that ``seen`` of their radius is SEEN_PX."""
    farthest = np.hypot(HALF + 4 * BLUR * SEEN_PX, HALF + 4 * BLUR * SEEN_PX) + SHIFT * SEEN_PX + 2
    reach = farthest * seen / SEEN_PX / np.linalg.svd(attitude, compute_uv=False).min()
    cells = grid.cells(0.01 * seen / SEEN_PX, float(reach))
    return images(cells, _poses(SEEN_PX / seen * attitude, shift_px), HALF, BLUR * SEEN_PX)


def _windows(attitude: Float) -> Float32:
    """Weights of the pixels of the seen disc under each attitude, (P, pixels), summing to 1."""
    disc = _arc(1.0, 0.0, 360.0, 1e-3)[:-1]
    weight = images([disc], _poses(SEEN_PX * attitude), HALF)[:, 0]
    return np.asarray(weight / weight.sum(1, keepdims=True))


def _moments(weight: Float32, cells: Float32, inks: Float32) -> tuple[Float32, Float32]:
    """Images of designs without their weighted mean, (n, pixels), and their standard deviations, (n,)."""
    image = inks @ cells
    image = image - (image @ weight)[:, None]
    return image, np.sqrt(np.maximum((image * image) @ weight, 1e-9))


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
    parts = images(cells, np.array(poses), half, blur_px).astype(np.float64)
    whole = parts.sum(1)
    inside = np.all(whole > 1 - 1e-5, axis=0) if not rim else np.ones(whole.shape[1], bool)
    parts, whole = parts[:, :, inside], whole[:, inside]
    black = np.einsum("nc,kcp->nkp", inks, parts)
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
        bound(cells, inks, radius_px * view, blur * radius_px, rim) for view in attitudes(turns=1, tilts_deg=(tilt_deg,))
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
    weight = _windows(np.eye(2)[None])[0]
    least = np.full(len(inks), np.inf)
    for seen in SEEN_BASIN:
        still, spread = _moments(weight, _seen(grid, np.eye(2)[None], seen)[0], inks)
        for angle in 2 * np.pi * np.arange(8) / 8:
            shift = (SHIFT * SEEN_PX * np.cos(angle), SHIFT * SEEN_PX * np.sin(angle))
            best = np.zeros(len(inks), np.float32)
            for cells in _seen(grid, view, seen, shift):
                moved, moved_spread = _moments(weight, cells, inks)
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
    disc = projected_disc(H)
    return float(np.hypot(disc.x - keypoint[0], disc.y - keypoint[1]))


# --- Identity -----------------------------------------------------------------------------------------


def correlation_and_distance(grid: Grid, inks: Float32, progress: Callable[[], None] = lambda: None) -> tuple[Float32, Float32]:
    """How alike designs can look, over all pairs of attitudes, of the mirror images too.

    The first design is seen, blurred, in every tilt of TILTS_DEG; the second may have any attitude, gain
    (positive) and offset. Mirror images are different prints but are compared as well: the worse counts.
    The worst of the seen parts SEEN_IDENTITY; both matrices are made symmetric by the worse of the two.

    Parameters
    ----------
    grid : Grid
        Must map to itself under a mirror (angles symmetric about 0), else mirror images are left out.
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
    weights = _windows(flat)
    both = np.concatenate([inks, mirrored(grid, inks)])
    n = len(inks)
    correlation = np.zeros((n, n), np.float32)
    distance = np.full((n, n), np.inf, np.float32)
    for seen in SEEN_IDENTITY:
        cells = _seen(grid, view, seen)
        for weight, own in zip(weights, cells[: len(flat)], strict=True):
            keep = weight > 0
            first, spread = _moments(weight[keep], own[:, keep], inks)
            first = first * weight[keep] / spread[:, None]
            best = np.zeros((n, 2 * n), np.float32)
            for other in cells[:, :, keep]:
                second, other_spread = _moments(weight[keep], other, both)
                np.maximum(best, first @ (second / other_spread[:, None]).T, out=best)
            worse = np.minimum(np.maximum(best[:, :n], best[:, n:]), 1.0)
            np.maximum(correlation, worse, out=correlation)
            np.minimum(distance, spread[:, None] * np.sqrt(1 - worse**2), out=distance)
            progress()
    return np.maximum(correlation, correlation.T), np.minimum(distance, distance.T)


def mirrored(grid: Grid, inks: Float32) -> Float32:
    """Inks of the mirror images, (n, cells); those given where the grid has no mirror symmetry."""
    angles = np.array(grid.angles_deg)
    if not np.allclose(np.sort(-angles % 360.0), angles):
        return inks
    middle = grid._middles()[1] % 360.0
    order = [int(np.argmin(np.abs((middle + a + 180.0) % 360.0 - 180.0))) for a in middle]
    return inks.reshape(len(inks), *grid.shape)[:, :, order].reshape(len(inks), -1)


def turned_distance(grid: Grid, inks: Float32) -> Float:
    """Smallest distance of each design to itself, turned in the plane by 45 degrees or more, shape (n,)."""
    weight = _windows(np.eye(2)[None])[0]
    still, *turned = _seen(grid, attitudes(TURNS, (0.0,)), 1.0)
    first, spread = _moments(weight, still, inks)
    best = np.zeros(len(inks))
    for cells in turned[TURNS // 8 - 1 : TURNS - TURNS // 8]:
        other, other_spread = _moments(weight, cells, inks)
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
    return sum(same)


# --- Nature -------------------------------------------------------------------------------------------


def sample_windows(photographs: Iterable[UInt8], rng: np.random.Generator, count: int = WINDOWS) -> Float32:
    """Windows at random places of images at full, half and quarter size.

    Parameters
    ----------
    photographs : iterable of ndarray of shape (H, W), uint8
        Read until there are enough windows, 200 from each.
    rng : numpy.random.Generator
    count : int

    Returns
    -------
    ndarray of shape (count or fewer, pixels), float32, blurred as the designs are.
    """
    import cv2

    side, found, total = 2 * HALF + 1, [], 0
    for photograph in photographs:
        scale = 2.0 ** -rng.integers(0, 3)
        size = [max(side, round(scale * n)) for n in photograph.shape[::-1]]
        image = cv2.resize(photograph, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        image = cv2.GaussianBlur(image, (0, 0), BLUR * SEEN_PX)
        view = np.lib.stride_tricks.sliding_window_view(image, (side, side))
        rows, columns = rng.integers(0, view.shape[:2], (200, 2)).T
        found.append(view[rows, columns].reshape(200, -1))
        total += 200
        if total >= count:
            break
    return np.concatenate(found)[:count]


def natural_response(grid: Grid, inks: Float32, windows: Float32) -> Float:
    """Share of places in images that look like a design in some attitude.

    Parameters
    ----------
    windows : ndarray of shape (N, pixels)
        From :func:`sample_windows`. Those with a standard deviation under 8 grey levels count as unlike.

    Returns
    -------
    ndarray of shape (n, 2)
        Share of the windows whose correlation exceeds each of LOOKS_ALIKE.
    """
    weight = _windows(np.eye(2)[None])[0]
    windows = windows - (windows @ weight)[:, None]
    spread = np.sqrt((windows * windows) @ weight)
    textured = spread >= 8
    nature = (windows[textured] * weight / spread[textured, None]).T.astype(np.float32)
    best = np.zeros((len(inks), nature.shape[1]), np.float32)
    for cells in _seen(grid, attitudes(), 1.0):
        image, own_spread = _moments(weight, cells, inks)
        np.maximum(best, (image / own_spread[:, None]) @ nature, out=best)
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
    tilt_bias_px: float
    black_fraction: float
    pixels_needed: float
    bounds: tuple[Bound, ...]
    bound_without_rim_px: float
    basin: float
    natural_response: tuple[float, ...]

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


def analyse(patches: Sequence[Patch], windows: Float32, progress: Callable[[], None] = lambda: None) -> Analysis:
    """Measure designs.

    Parameters
    ----------
    patches : sequence of Patch
    windows : ndarray of shape (N, pixels)
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
        _black_fraction(grid, inks),
        pixels_needed(grid, inks),
        bounds,
        without_rim,
        basin(grid, inks),
        natural_response(grid, inks, windows),
        strict=True,
    )
    reports = tuple(
        DesignReport(
            p.name,
            p.patch_id,
            p.centre_is_crossing,
            symmetry_order(p),
            float(turned),
            tilt_bias(p),
            float(black),
            float(pixels),
            tuple(found),
            float(hidden),
            float(bound_to_centre),
            tuple(float(share) for share in natural),
        )
        for p, turned, black, pixels, found, hidden, bound_to_centre, natural in measures
    )
    return Analysis(reports, correlation, distance)


STEPS = len(SIZES_PX) * len(TILTS_DEG) * 2 + len(SEEN_IDENTITY) * (1 + (len(TILTS_DEG) - 1) * len(DIRECTIONS_DEG))


def _black_fraction(grid: Grid, inks: Float32) -> Float:
    radii = np.append(0.0, grid.radii)
    width = np.diff(np.append(grid.angles_deg, grid.angles_deg[0] + 360.0)) / 360.0
    area = np.outer(np.diff(radii**2), width).ravel() / radii[-1] ** 2
    return np.asarray(inks @ area)
