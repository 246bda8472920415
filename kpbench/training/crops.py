"""Training crops: small images with patches, boards of patches and look-alikes. One call makes a batch.

One core makes several hundred crops per second. A keypoint that blur or noise hides is marked as ignored: the network
learns neither to report nor to suppress this keypoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from kpbench.geometry.homography import project_disc_sizes
from kpbench.images import resize
from kpbench.patches.design import Patch
from kpbench.render.detail import paint_detail
from kpbench.render.lookalikes import draw_lookalikes
from kpbench.render.placement import Limits, Placement, random_poses
from kpbench.render.scene import Mask, measure_contrast, paint_patch, rasterise_patches
from kpbench.training.crop_effects import degrade_crop
from kpbench.types import Float, Float32, UInt8

MOST_KEYPOINTS = 12
"""Number of rows of keypoints per sample. If a sample has more keypoints, the surplus keypoints are left out."""
IMAGE_PX = (640, 480)
"""Width and height, px, of the image that a crop is imagined to be cut from. Focal lengths are drawn relative to this
width."""
ZOOM = (0.35, 3.0)
"""Range of the scale of a background, in px of the photograph per px of the crop before it is resized."""
VIEW_SCALES = {1.0: 0.2, 1.5: 0.55, 0.5: 0.25}
"""Factor by which a crop is resized after it was drawn → probability of this factor."""
ENLARGED_RADIUS_PX = (4.0, 40.0)
"""Smallest and largest radius of a patch in crops that are enlarged, px before the enlargement. Other crops use the
default radii of :class:`kpbench.render.Limits`."""
LEAST_SIGNAL = 12.0
"""Least value of contrast · √area / noise; keypoints with a lower value are ignored. The signal-to-noise
ratio of a matched filter is then 6, because the inks differ from their mean by half the contrast."""
SOILED_SHARE, LEAST_SOILED_PX = 0.25, 5.0
"""Probability that patches of a crop carry detail, and the shortest semi-axis of such a patch, px."""
QUIET_SHARE, QUIET_ZONES = 0.25, (0.1, 0.3)
"""Probability that the patches of a crop have a quiet zone, and its widths, disc radii."""
LEAST_KEYPOINT_CONTRAST = 4.0
"""Least contrast, grey levels; keypoints with a lower contrast are ignored. At lower contrasts, rounding to 8 bits
destroys most of the pattern."""


def empty_keypoints(count: int) -> Float32:
    """Return rows (count, MOST_KEYPOINTS, 4) that hold no keypoint."""
    keypoints = np.zeros((count, MOST_KEYPOINTS, 4), np.float32)
    keypoints[..., 2] = -1
    return keypoints


class Disc(NamedTuple):
    """A patch of a crop: its placement, the index of its design, and its centre and semi-axes in px."""

    placement: Placement
    design: int
    x: float
    y: float
    major: float
    minor: float


def make_crops(
    width: int,
    height: int,
    patches: Sequence[Patch],
    photos: Sequence[UInt8],
    rng: np.random.Generator,
    count: int,
    severity: float,
) -> tuple[UInt8, Float32]:
    """Return crops (count, height, width) and their keypoints; see :class:`kpbench.training.Batch`."""
    images = np.zeros((count, height, width), np.uint8)
    keypoints = empty_keypoints(count)
    discs: list[list[Disc]] = []
    canvases: list[UInt8] = []
    scales = rng.choice(list(VIEW_SCALES), count, p=list(VIEW_SCALES.values()))
    for scale in scales:
        image = _draw_background(photos, rng, round(width / scale), round(height / scale))
        if rng.random() < 0.5:
            draw_lookalikes(image, rng, int(rng.integers(1, 4)), patches)
        drawn = _place_patches(rng, patches, image, Limits.of_radius(*ENLARGED_RADIUS_PX) if scale > 1 else Limits())
        discs.append(drawn)
        canvases.append(image)
    masks = _paint_all(canvases, discs)
    for n in range(count):
        _soil(canvases[n], rng, discs[n])
        hidden = _occlude(canvases[n], rng, discs[n], patches) if rng.random() < 0.12 * severity else ()
        radius = min((d.minor for d in discs[n]), default=20.0)
        degraded = degrade_crop(canvases[n], rng, severity, radius)
        contrasts = measure_contrast(degraded.clean, masks[n])
        images[n] = resize(degraded.image, width, height)
        scale = np.divide(images[n].shape, degraded.image.shape)[::-1]
        k = 0
        for disc, contrast in zip(discs[n], contrasts.tolist(), strict=True):
            x, y = (disc.x + 0.5) * scale[0] - 0.5, (disc.y + 0.5) * scale[1] - 0.5
            if k == MOST_KEYPOINTS or not _contains(images[n], x, y):
                continue
            least = LEAST_SIGNAL * degraded.sigma / np.sqrt(np.pi * disc.major * disc.minor)
            is_seen = contrast >= max(LEAST_KEYPOINT_CONTRAST, least)  # False for nan
            is_small = disc.minor * scale.min() < 0.5 * Limits().minor_axis_px
            is_lost = not is_seen or is_small or any(disc is h for h in hidden)
            keypoints[n, k] = x, y, disc.design, disc.major * scale.max() if is_lost else 0.0
            k += 1
    return images, keypoints


def cut_window(
    photo: UInt8, rng: np.random.Generator, width: int, height: int, zoom: tuple[float, float] | None = None
) -> UInt8:
    """Cut a random window out of a photograph, resize the window, and mirror it with probability 0.5.

    ``zoom`` : range of the scale, in px of the photograph per px of the result. None: the range from 0.5 to 1 times the
    largest scale at which the window fits into the photograph.
    """
    rows, columns = photo.shape
    largest = min(columns / width, rows / height)
    least, most = zoom or (0.5 * largest, largest)
    scale = min(np.exp(rng.uniform(np.log(least), np.log(most))), largest)
    w, h = max(8, int(width * scale)), max(8, int(height * scale))
    x, y = rng.integers(columns - w + 1), rng.integers(rows - h + 1)
    how = cv2.INTER_AREA if scale > 1 else cv2.INTER_LINEAR
    image = cv2.resize(photo[y : y + h, x : x + w], (width, height), interpolation=how)
    return np.ascontiguousarray(image[:, ::-1] if rng.random() < 0.5 else image, np.uint8)


def _draw_background(photos: Sequence[UInt8], rng: np.random.Generator, width: int, height: int) -> UInt8:
    """Draw a background: a window of a photograph, half of the time with changed contrast, or rarely an even grey."""
    if rng.random() < 0.08:
        return np.full((height, width), rng.integers(256), np.uint8)
    image = cut_window(photos[int(rng.integers(len(photos)))], rng, width, height, ZOOM)
    if rng.random() < 0.5:
        middle = rng.uniform(60, 200)
        table = np.clip(middle + rng.uniform(0.4, 1.6) * (np.arange(256) - 127.0), 0, 255).astype(np.uint8)
        image = np.asarray(cv2.LUT(image, table), np.uint8)
    return image


def _contains(image: UInt8, x: float, y: float) -> bool:
    return bool(-0.5 <= x < image.shape[1] - 0.5 and -0.5 <= y < image.shape[0] - 0.5)


def _place_patches(rng: np.random.Generator, patches: Sequence[Patch], image: UInt8, limits: Limits) -> list[Disc]:
    """Return the patches of one crop. In half of the crops, draw a sheet of paper under the patches."""
    height, width = image.shape
    on_board = rng.random() < 0.5
    count = int(rng.choice(5, p=(0.15, 0.3, 0.22, 0.18, 0.15)))
    if count == 0:
        if on_board:
            _draw_paper(image, rng, _poses_at(rng, rng.uniform(0, 1, (1, 2)) * (width, height), limits)[0])
        return []
    # a centre may lie a little outside the crop; such a patch is visible in part and gives no keypoint
    at = rng.uniform(-0.1, 1.1, (1 if on_board else count, 2)) * (width, height) - 0.5
    poses = _poses_at(rng, at, limits)
    if on_board:
        first = poses[0]
        _draw_paper(image, rng, first)
        # on a hexagon board of side S, patches of radius 0.08 S lie on a circle of radius 0.36 S, which is 4.5 patch
        # radii; the random factor stands for boards with closer patches and with patches further apart
        ring, turn = 4.5 * np.exp(rng.uniform(-0.6, 0.3)), rng.uniform(0, 2 * np.pi)
        corners = turn + np.arange(6) * np.pi / 3
        offsets = ring * np.column_stack([np.cos(corners), np.sin(corners)]) - ring * np.array(
            [np.cos(turn), np.sin(turn)]
        )
        steps = np.tile(np.eye(3), (6, 1, 1))
        steps[:, :2, 2] = offsets
        turns = np.zeros((6, 3, 3))
        spin = rng.uniform(0, 2 * np.pi, 6) if rng.random() < 0.5 else np.zeros(6)
        turns[:, 0, 0], turns[:, 0, 1], turns[:, 1, 0], turns[:, 1, 1] = (
            np.cos(spin),
            -np.sin(spin),
            np.sin(spin),
            np.cos(spin),
        )
        turns[:, 2, 2] = 1.0
        poses = first @ steps @ turns
        poses = poses[poses[:, 2, 2] > 0.2]
        poses /= poses[:, 2:, 2:]
    centres, majors, minors = project_disc_sizes(poses)
    one_design = rng.random() < 0.5
    design = rng.integers(len(patches), size=len(poses))
    black = rng.uniform(*limits.black, len(poses))
    white = rng.uniform(*limits.white, len(poses))
    if on_board:
        black[:], white[:] = black[0], white[0]
        if one_design:
            design[:] = design[0]
    discs: list[Disc] = []
    quiet_zone = float(rng.choice(QUIET_ZONES)) if rng.random() < QUIET_SHARE else 0.0
    for n, H in enumerate(poses):
        patch = patches[design[n]]
        patch = replace(patch, quiet_zone=max(patch.quiet_zone, quiet_zone))
        (x, y), reach = centres[n], patch.extent * majors[n]
        seen = -reach < x < width + reach and -reach < y < height + reach and majors[n] < 4 * width
        apart = all(np.hypot(x - d.x, y - d.y) > reach + d.placement.patch.extent * d.major for d in discs)
        if seen and apart:
            placement = Placement(patch, H, float(black[n]), float(white[n]))
            discs.append(Disc(placement, int(design[n]), H[0, 2], H[1, 2], majors[n], minors[n]))
    return discs


def _poses_at(rng: np.random.Generator, at_px: Float, limits: Limits) -> Float:
    """Draw poses in an image of ``IMAGE_PX``, and move their keypoints to the points ``at_px`` (N, 2) of the crop."""
    poses = random_poses(rng, len(at_px), *IMAGE_PX, limits)
    poses[:, :2] += (at_px - poses[:, :2, 2])[:, :, None] * poses[:, 2:]
    return poses


def _draw_paper(image: UInt8, rng: np.random.Generator, H: Float) -> None:
    """Draw a sheet of paper in the plane of the patches: light in three of four cases, otherwise of any grey level."""
    grey = rng.uniform(170, 255) if rng.random() < 0.75 else rng.uniform(0, 255)
    low, high = -rng.uniform(1.3, 12.0, 2), rng.uniform(1.3, 12.0, 2)
    corners = np.array([[low[0], low[1], 1], [high[0], low[1], 1], [high[0], high[1], 1], [low[0], high[1], 1]]) @ H.T
    if np.all(corners[:, 2] > 0.05):
        points = np.clip(corners[:, :2] / corners[:, 2:], -4000, 4000)
        cv2.fillConvexPoly(image, np.round(points * 16).astype(np.int32), grey, cv2.LINE_AA, 4)


def _occlude(image: UInt8, rng: np.random.Generator, discs: Sequence[Disc], patches: Sequence[Patch]) -> list[Disc]:
    """Draw look-alikes at random places. Return the patches that the look-alikes hide by more than a third."""
    before = image.copy()
    draw_lookalikes(image, rng, int(rng.integers(1, 4)), patches)
    changed = (image != before).astype(np.float32)
    hidden = []
    for disc in discs:
        covered = np.zeros_like(before)
        cv2.circle(covered, (round(disc.x), round(disc.y)), max(2, round((disc.major + disc.minor) / 2)), 1, -1)
        if (changed * covered).sum() > covered.sum(dtype=np.float32) / 3:
            hidden.append(disc)
    return hidden


def _soil(image: UInt8, rng: np.random.Generator, discs: Sequence[Disc]) -> None:
    """Paint detail onto some of the patches of a crop: hubs, screws, ropes, tape, creases, dirt and glare."""
    if rng.random() < SOILED_SHARE:
        for disc in discs:
            if disc.minor >= LEAST_SOILED_PX and rng.random() < 0.6:
                H = disc.placement.H_patch2image
                paint_detail(image, H, rng, int(rng.integers(1, 4)), white=rng.uniform(0.5, 1.0))


def _paint_all(canvases: Sequence[UInt8], discs: Sequence[Sequence[Disc]]) -> list[list[Mask]]:
    """Draw the patches of a whole batch with one call of the rasteriser. Return the masks of each crop."""
    drawn = [(image, disc.placement) for image, row in zip(canvases, discs, strict=True) for disc in row]
    # an edge error of 1/64 px is far below the noise; the exact edges of benchmark images would take longer
    masks = rasterise_patches([placement for _, placement in drawn], 1 / 64)
    for (image, placement), mask in zip(drawn, masks, strict=True):
        paint_patch(image, mask, placement.black, placement.white)
    rest = iter(masks)
    return [[next(rest) for _ in row] for row in discs]
