"""Patches + random poses + background → clean image with its true keypoints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.geometry.coverage import Box, bounding_box, clip_to_image, rasterise_edges
from kpbench.geometry.homography import project_discs
from kpbench.patches.design import Patch, unit_polygons
from kpbench.types import KEYPOINT_DTYPE, Float, UInt8


@dataclass(frozen=True)
class Limits:
    """What a random scene may hold; the defaults are the paper's where it says any (§3.2).

    Attributes
    ----------
    count : most and fewest patches an image.
    minor_axis_px : smallest length of the projected disc's short axis, px, the full length.
    axis_difference : largest (major − minor) / major of the projected disc.
    radius_px : range of the disc's radius before tilt, px at the patch's distance; drawn log-uniformly.
    tilt_deg : largest tilt about each of the two axes in the patch's plane, drawn independently.
    focal : range of the focal length in image widths, drawn log-uniformly.
    black, white : ranges of the two inks, grey levels.
    """

    count: tuple[int, int] = (0, 10)
    minor_axis_px: float = 10.0
    axis_difference: float = 0.8
    radius_px: tuple[float, float] = (5.0, 80.0)
    tilt_deg: float = 75.0
    focal: tuple[float, float] = (0.6, 3.0)
    black: tuple[float, float] = (0.0, 120.0)
    white: tuple[float, float] = (180.0, 255.0)

    def __post_init__(self) -> None:
        least, most = self.radius_px
        if not 1 <= least <= most <= 4096:
            raise DataError(f"--radius-px is {least:g}:{most:g}, expected px from 1 to 4096, the smaller first")
        if 2 * most < 1.2 * self.minor_axis_px:  # else hardly a tilt keeps the short axis
            wanted = f"expected a largest of at least {0.6 * self.minor_axis_px:g}: no short axis is under"
            raise DataError(f"--radius-px is {least:g}:{most:g}, {wanted} {self.minor_axis_px:g} px")

    @classmethod
    def of_radius(cls, least_px: float, most_px: float) -> Limits:
        """Radii before tilt in this range, and no short semi-axis under the least of them or 5 px, whichever is less.

        Raises
        ------
        DataError
            If these are no two radii, or the second is less than 1.2 times the first.
        """
        return cls(minor_axis_px=2 * min(max(least_px, 1.0), 5.0), radius_px=(least_px, most_px))


@dataclass(frozen=True)
class Placement:
    """One patch in an image: its pose and its two inks in grey levels."""

    patch: Patch
    H_patch2image: Float
    black: float
    white: float


@dataclass(frozen=True)
class Mask:
    """Area coverage of one rendered patch on a box of the image, each of shape (height, width)."""

    box: Box
    black: Float
    disc: Float


@dataclass(frozen=True)
class Rendered:
    """A clean image, its true keypoints (:data:`KEYPOINT_DTYPE`), and one mask a keypoint."""

    image: UInt8
    keypoints: NDArray[Any]
    masks: tuple[Mask, ...]


def random_placements(
    rng: np.random.Generator, width_px: int, height_px: int, patches: Sequence[Patch], limits: Limits
) -> list[Placement]:
    """Draw patches that keep the limits, do not overlap, and have their centres inside the image.

    Each is seen by a camera of its own focal length. Where the image is too full for one more, fewer
    are returned than were drawn.
    """
    placements: list[Placement] = []
    taken: list[tuple[float, float, float]] = []
    count = int(rng.integers(limits.count[0], limits.count[1] + 1))
    for _ in range(25):  # mostly one is enough
        if len(placements) == count:
            break
        tried = 2 * (count - len(placements)) + 2
        poses = random_poses(rng, tried, width_px, height_px, limits)
        chosen = rng.integers(len(patches), size=tried)
        black, white = rng.uniform(*limits.black, tried), rng.uniform(*limits.white, tried)
        extent = np.array([patch.extent for patch in patches])[chosen]
        centre, reach, _, _ = project_discs(poses * np.stack([extent, extent, np.ones(tried)], axis=1)[:, None])
        for n, (x, y, r) in enumerate(np.column_stack([centre, reach]).tolist()):
            # a wide rim of a steep patch may reach beyond the horizon
            seen = math.isfinite(r) and math.isfinite(x) and math.isfinite(y)
            apart = all(math.hypot(x - x0, y - y0) > r + r0 + 2 for x0, y0, r0 in taken)
            if len(placements) < count and seen and apart:
                taken.append((x, y, r))
                placements.append(Placement(patches[chosen[n]], poses[n], float(black[n]), float(white[n])))
    return placements


def random_poses(rng: np.random.Generator, count: int, width_px: int, height_px: int, limits: Limits) -> Float:
    """Poses of single patches that keep the limits, keypoints anywhere in the image.

    Returns
    -------
    ndarray of shape (count, 3, 3)
        H_patch2image with H[:, 2, 2] = 1, hence the keypoints at (H[:, 0, 2], H[:, 1, 2]).
    """
    found = [np.zeros((0, 3, 3))]
    missing = count
    while missing > 0:
        n = 2 * missing + 4
        focal_px, radius_px = width_px * _log_uniform(rng, limits.focal, n), _log_uniform(rng, limits.radius_px, n)
        tilt = np.radians(rng.uniform(-limits.tilt_deg, limits.tilt_deg, (2, n)))
        turn = rng.uniform(0, 2 * np.pi, n)
        x, y = rng.uniform(0, 1, (2, n)) * np.array([[width_px - 1], [height_px - 1]])
        (cx, cy), (sx, sy), cz, sz = np.cos(tilt), np.sin(tilt), np.cos(turn), np.sin(turn)
        # K [r1 r2 t] / depth at the depth focal / radius, in disc radii; r1 and r2 of geometry.rotation_xyz
        H = np.empty((n, 3, 3))
        H[:, 0, 0], H[:, 0, 1] = radius_px * cy * cz, -radius_px * cy * sz
        H[:, 1, 0], H[:, 1, 1] = radius_px * (cx * sz + sx * sy * cz), radius_px * (cx * cz - sx * sy * sz)
        H[:, 2, 0] = radius_px / focal_px * (sx * sz - cx * sy * cz)
        H[:, 2, 1] = radius_px / focal_px * (sx * cz + cx * sy * sz)
        H[:, 0, :2] += (width_px - 1) / 2 * H[:, 2, :2]
        H[:, 1, :2] += (height_px - 1) / 2 * H[:, 2, :2]
        H[:, 0, 2], H[:, 1, 2], H[:, 2, 2] = x, y, 1.0
        _, major, minor, _ = project_discs(H)
        good = (2 * minor >= limits.minor_axis_px) & (major - minor <= limits.axis_difference * major)
        # none so near, as in tiny images, that its depth varies by half or more
        found.append(H[good & (np.hypot(H[:, 2, 0], H[:, 2, 1]) <= 0.5)][:missing])
        missing -= len(found[-1])
    return np.concatenate(found)


def _log_uniform(rng: np.random.Generator, span: tuple[float, float], count: int) -> Float:
    return np.exp(rng.uniform(np.log(span[0]), np.log(span[1]), count))


@lru_cache(maxsize=256)
def _edges(patch: Patch, tolerance: float) -> tuple[Float, NDArray[np.int64], int, int]:
    """Vertices of (black, disc), shape (3, N) with ones below, the place of each one's successor, and both counts."""
    black, disc = unit_polygons(patch, tolerance)
    sizes = [len(polygon) for polygon in (*black, *disc)]
    following = np.concatenate([np.roll(np.arange(n), -1) + sum(sizes[:k]) for k, n in enumerate(sizes)])
    points = np.concatenate([*black, *disc])
    inner = sum(map(len, black))
    return np.vstack([points.T, np.ones(len(points))]), following, inner, len(points) - inner


def rasterise(placements: Sequence[Placement], tolerance_px: float = 1e-3) -> list[Mask]:
    """Exact area coverage of patches, of any number of images at once.

    Parameters
    ----------
    placements : sequence of Placement
    tolerance_px : largest distance between a drawn edge and the true one; half of it at least is used.
    """
    if not placements:
        return []
    poses = np.stack([p.H_patch2image for p in placements])
    _, major, _, _ = project_discs(poses)
    starts, ends, counts, boxes = list[Float](), list[Float](), list[int](), list[Box]()
    # rounded to a power of two, so that polygons are reused
    for p, tolerance in zip(placements, 2.0 ** np.floor(np.log2(tolerance_px / major)), strict=True):
        vertices, following, black, disc = _edges(p.patch, float(tolerance))
        mapped = p.H_patch2image @ vertices
        points = mapped[:2] / mapped[2]
        starts.append(points)
        ends.append(points[:, following])
        counts += [black, disc]
        boxes += [bounding_box([points[:, black:].T])] * 2
    owner = np.repeat(np.arange(len(counts)), counts)
    covers = rasterise_edges(np.concatenate(starts, axis=1), np.concatenate(ends, axis=1), owner, boxes)
    return [Mask(boxes[n], covers[n], covers[n + 1]) for n in range(0, len(covers), 2)]


def render_scene(background: UInt8, placements: Sequence[Placement]) -> Rendered:
    """Draw patches onto a background with exact area coverage, edges true to 1/1000 px.

    Parameters
    ----------
    background : ndarray of shape (H, W) or (H, W, 3), uint8; not changed.
    placements : sequence of Placement

    Returns
    -------
    Rendered
        ``keypoints["contrast"]`` is nan, see :func:`measure_contrast`.
    """
    image = background.copy()
    masks = rasterise(placements)
    visible = [paint(image, m, p.black, p.white) for m, p in zip(masks, placements, strict=True)]
    return Rendered(image, tabulate(placements, visible), tuple(masks))


def tabulate(placements: Sequence[Placement], visible: Sequence[float]) -> NDArray[Any]:
    """The :data:`KEYPOINT_DTYPE` table of patches of which these fractions are visible; ``contrast`` is nan."""
    keypoints = np.zeros(len(placements), KEYPOINT_DTYPE)
    if placements:
        H = keypoints["H_patch2image"] = np.stack([p.H_patch2image for p in placements])
        _, keypoints["radius_major"], keypoints["radius_minor"], keypoints["axis_angle"] = project_discs(H)
        keypoints["x"], keypoints["y"] = H[:, 0, 2] / H[:, 2, 2], H[:, 1, 2] / H[:, 2, 2]
        keypoints["patch_id"] = [p.patch.patch_id for p in placements]
        keypoints["visible"] = visible
    keypoints["contrast"] = np.nan
    return keypoints


def paint(image: UInt8, mask: Mask, black: float, white: float) -> float:
    """Draw one patch in place; return the fraction of it that lies in the image."""
    there, here = clip_to_image(mask.box, image)
    disc = mask.disc[here]
    if not disc.size:
        return 0.0
    ink = white * disc - (white - black) * mask.black[here]
    below = 1.0 - disc
    if image.ndim == 3:
        ink, below = ink[..., None], below[..., None]
    image[there] = np.rint(image[there] * below + ink)
    return float(disc.sum() / mask.disc.sum())


def share_inside(image: UInt8, mask: Mask) -> float:
    """The fraction of a patch that lies in the image."""
    _, here = clip_to_image(mask.box, image)
    return float(mask.disc[here].sum() / mask.disc.sum())


def measure_contrast(image: UInt8, masks: Sequence[Mask]) -> Float:
    """White minus black of each patch as it stands in the image, grey levels, shape (n,).

    The slope of a least-squares line of grey level against the black share of each pixel that lies
    wholly on the patch: unbiased by noise, lowered by blur and shadow. nan where nothing of the patch, or
    only one of its inks, is in the image.
    """
    contrast = np.full(len(masks), np.nan)
    for n, mask in enumerate(masks):
        there, here = clip_to_image(mask.box, image)
        part = image[there]
        grey = (part if part.ndim == 2 else part.mean(axis=2)).astype(np.float64).ravel()
        share = mask.black[here].ravel()
        inside = (mask.disc[here].ravel() > 1 - 1e-6).astype(np.float64)  # as weights, which is quicker than picking
        count = inside.sum()
        weighted = inside * share
        # sums, not @: a threaded BLAS costs more than it gives here
        if count and (variation := (weighted * share).sum() - weighted.sum() ** 2 / count) > 1e-6 * count:
            contrast[n] = (weighted.sum() * (inside * grey).sum() / count - (weighted * grey).sum()) / variation
    return contrast
