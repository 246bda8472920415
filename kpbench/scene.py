"""Patches + random poses + background → clean image with its true keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.design import Patch, unit_polygons
from kpbench.geometry import Camera, Ellipse, plane_to_camera, project, projected_disc, rotation_xyz
from kpbench.keypoints import KEYPOINT_DTYPE, Float, UInt8
from kpbench.raster import Box, box_around, coverage

__all__ = ["Limits", "Placement", "Rendered", "measure_contrast", "random_placements", "render_scene", "stream"]


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


def stream(seed: int, index: int, stage: int) -> np.random.Generator:
    """Random numbers of one stage of one image, independent of every other stage and image."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(index, stage))))


def random_placements(
    rng: np.random.Generator, width_px: int, height_px: int, patches: Sequence[Patch], limits: Limits
) -> list[Placement]:
    """Draw patches that keep the limits, do not overlap, and have their centres inside the image.

    Each is seen by a camera of its own focal length. Where the image is too full for one more, fewer
    are returned than were drawn.
    """
    placements: list[Placement] = []
    taken: list[tuple[float, float, float]] = []
    for _ in range(rng.integers(limits.count[0], limits.count[1] + 1)):
        patch = patches[int(rng.integers(len(patches)))]
        for _attempt in range(50):
            H = _random_pose(rng, width_px, height_px, limits)
            grown = projected_disc(H @ np.diag([patch.extent, patch.extent, 1.0]))
            if all(np.hypot(grown.x - x, grown.y - y) > grown.major + r + 2 for x, y, r in taken):
                taken.append((grown.x, grown.y, grown.major))
                placements.append(Placement(patch, H, rng.uniform(*limits.black), rng.uniform(*limits.white)))
                break
    return placements


def _random_pose(rng: np.random.Generator, width_px: int, height_px: int, limits: Limits) -> Float:
    """H_patch2image with H[2, 2] = 1, hence the keypoint at (H[0, 2], H[1, 2])."""
    while True:
        focal_px = width_px * np.exp(rng.uniform(*np.log(limits.focal)))
        K = Camera(width_px, height_px, focal_px).K
        x_deg, y_deg = rng.uniform(-limits.tilt_deg, limits.tilt_deg, 2)
        R = rotation_xyz(x_deg, y_deg, rng.uniform(0, 360))
        depth = focal_px / np.exp(rng.uniform(*np.log(limits.radius_px)))  # in disc radii
        x, y = rng.uniform(0, width_px - 1), rng.uniform(0, height_px - 1)
        t = depth * np.array([(x - K[0, 2]) / focal_px, (y - K[1, 2]) / focal_px, 1.0])
        H = K @ plane_to_camera(R, t) / depth
        if np.hypot(H[2, 0], H[2, 1]) > 0.5:  # so near, as in tiny images, that its depth varies by half or more
            continue
        ellipse = projected_disc(H)
        if 2 * ellipse.minor >= limits.minor_axis_px and _axis_difference(ellipse) <= limits.axis_difference:
            return np.asarray(H)


def _axis_difference(ellipse: Ellipse) -> float:
    return (ellipse.major - ellipse.minor) / ellipse.major


def render_scene(background: UInt8, placements: Sequence[Placement]) -> Rendered:
    """Draw patches onto a background with exact area coverage.

    Parameters
    ----------
    background : ndarray of shape (H, W) or (H, W, 3), uint8; not changed.
    placements : sequence of Placement

    Returns
    -------
    Rendered
        ``keypoints["contrast"]`` is that of the clean image, see :func:`measure_contrast`.
    """
    image = background.copy()
    keypoints = np.zeros(len(placements), KEYPOINT_DTYPE)
    ellipses = [projected_disc(p.H_patch2image) for p in placements]
    regions: list[list[Float]] = []
    boxes: list[Box] = []
    for placement, ellipse in zip(placements, ellipses, strict=True):
        # edges true to 1/1000 px; the tolerance is rounded to a power of two so that polygons are reused
        tolerance = 2.0 ** np.floor(np.log2(1e-3 / ellipse.major))
        black, disc = unit_polygons(placement.patch, tolerance)
        H = placement.H_patch2image
        projected = [[project(H, p) for p in black], [project(H, p) for p in disc]]
        regions += projected
        boxes += [box_around(projected[1])] * 2
    covers = coverage(regions, boxes)
    masks = []
    for n, (placement, ellipse) in enumerate(zip(placements, ellipses, strict=True)):
        mask = Mask(boxes[2 * n], covers[2 * n], covers[2 * n + 1])
        masks.append(mask)
        visible = _paint(image, mask, placement.black, placement.white)
        x, y = project(placement.H_patch2image, [[0.0, 0.0]])[0]
        axes = (ellipse.major, ellipse.minor, ellipse.angle_deg)
        keypoints[n] = (x, y, placement.patch.patch_id, *axes, placement.H_patch2image, visible, 0.0)
    rendered = Rendered(image, keypoints, tuple(masks))
    keypoints["contrast"] = measure_contrast(image, masks)
    return rendered


def inside_image(box: Box, image: UInt8) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of the image and of the box for the part of a box that lies in the image."""
    x, y, w, h = box
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + w, image.shape[1]), min(y + h, image.shape[0])
    x1, y1 = max(x0, x1), max(y0, y1)
    return (slice(y0, y1), slice(x0, x1)), (slice(y0 - y, y1 - y), slice(x0 - x, x1 - x))


def _paint(image: UInt8, mask: Mask, black: float, white: float) -> float:
    """Draw one patch in place; return the fraction of it that lies in the image."""
    there, here = inside_image(mask.box, image)
    disc = mask.disc[here]
    ink = white * disc - (white - black) * mask.black[here]
    below = 1.0 - disc
    if image.ndim == 3:
        ink, below = ink[..., None], below[..., None]
    image[there] = np.rint(image[there] * below + ink).astype(np.uint8)
    return float(disc.sum() / mask.disc.sum())


def measure_contrast(image: UInt8, masks: Sequence[Mask]) -> Float:
    """White minus black of each patch as it stands in the image, grey levels, shape (n,).

    The slope of a least-squares line of grey level against the black share of each pixel that lies
    wholly on the patch: unbiased by noise, lowered by blur and shadow. nan where nothing of the patch, or
    only one of its inks, is in the image.
    """
    contrast = np.full(len(masks), np.nan)
    for n, mask in enumerate(masks):
        there, here = inside_image(mask.box, image)
        grey = image[there] if image.ndim == 2 else image[there].mean(axis=2)
        inside = mask.disc[here] > 1 - 1e-6
        share, grey = mask.black[here][inside], grey[inside].astype(np.float64)
        if share.size and np.ptp(share) > 1e-3:
            centred = share - share.mean()
            contrast[n] = -(centred @ grey) / (centred @ centred)
    return contrast
