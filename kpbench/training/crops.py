"""Training crops: small windows with patches, boards of patches and look-alikes in them, made a batch at a time.

Several hundred a second on one core, with degradations whose strength the training loop raises.

Keypoints that no detector could find, because blur or noise has buried them, are marked to be ignored:
they are neither to be found nor to be left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.degrade import effects as degrade
from kpbench.geometry.homography import projected_discs
from kpbench.images import resize
from kpbench.patches.design import Patch
from kpbench.render.lookalikes import draw_lookalikes
from kpbench.render.scene import Limits, Placement, paint, random_poses, rasterise
from kpbench.types import Float, UInt8

Float32 = NDArray[np.float32]

MOST_KEYPOINTS = 12
IMAGE_PX = (640, 480)  # the image that a crop is thought to be cut from: focal lengths are relative to it
ZOOM = (0.35, 3.0)  # px of a photograph a px of a crop: a photograph fills images 200 to 1,800 px wide
VIEWS = {1.0: 0.2, 1.5: 0.55, 0.5: 0.25}
"""Scales at which a crop's image is shown, and how often each comes."""
VIEW_RADIUS_PX = (4.0, 40.0)
"""Radii at the scale 1.5, where what is large is left to the other scales; px of the image itself."""
DETECTABLE = 12.0
"""Least contrast / noise · √area of a keypoint that is asked for: 6 sigma at the output of a matched filter."""
FAINTEST = 4.0
"""Least contrast of a keypoint that is asked for, grey levels: 8-bit images hold little of anything fainter."""


def no_keypoints(count: int) -> Float32:
    """Keypoints (count, K, 4) of samples without any."""
    keypoints = np.zeros((count, MOST_KEYPOINTS, 4), np.float32)
    keypoints[..., 2] = -1
    return keypoints


class Disc(NamedTuple):
    """One patch that is to be drawn into a crop; ``place`` is its place in the design set."""

    placement: Placement
    place: int
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
    """Crops (count, height, width) and their keypoints (count, K, 4), see :class:`kpbench.training.Batch`."""
    images = np.zeros((count, height, width), np.uint8)
    keypoints = no_keypoints(count)
    discs: list[list[Disc]] = []
    canvases: list[UInt8] = []
    scales = rng.choice(list(VIEWS), count, p=list(VIEWS.values()))
    for scale in scales:
        image = _background(photos, rng, round(width / scale), round(height / scale))
        if rng.random() < 0.5:
            draw_lookalikes(image, rng, int(rng.integers(1, 4)), patches)
        drawn = _lay_out(rng, patches, image, Limits.of_radius(*VIEW_RADIUS_PX) if scale > 1 else Limits())
        discs.append(drawn)
        canvases.append(image)
    _paint_all(canvases, discs)
    for n in range(count):
        hidden = _occlude(canvases[n], rng, discs[n], patches) if rng.random() < 0.08 * severity else ()
        radius = min((d.minor for d in discs[n]), default=20.0)
        image, gain, kernel, sigma = _degrade(canvases[n], rng, severity, radius)
        images[n] = resize(image, width, height)
        scale = np.divide(images[n].shape, image.shape)[::-1]
        at = [((d.x + 0.5) * scale[0] - 0.5, (d.y + 0.5) * scale[1] - 0.5) for d in discs[n]]
        inside = [(x, y, d) for (x, y), d in zip(at, discs[n], strict=True) if _holds(images[n], x, y)]
        for k, (x, y, disc) in enumerate(inside[:MOST_KEYPOINTS]):
            kept = 1.0 - (kernel / (2 * disc.minor)) ** 2
            contrast = gain * (disc.placement.white - disc.placement.black) * max(kept, 0.0)
            area = np.pi * disc.major * disc.minor
            buried = contrast < max(FAINTEST, DETECTABLE * sigma / np.sqrt(area))
            small = disc.minor * scale.min() < 0.5 * Limits().minor_axis_px
            lost = buried or small or any(disc is h for h in hidden)
            keypoints[n, k] = x, y, disc.place, disc.major * scale.max() if lost else 0.0
    return images, keypoints


def window(
    photo: UInt8, rng: np.random.Generator, width: int, height: int, zoom: tuple[float, float] | None = None
) -> UInt8:
    """A part of a photograph in a given size, mirrored half of the time.

    ``zoom`` is the range of px of the photograph a px of the crop; None: from half the photograph to all of it.
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


def _background(photos: Sequence[UInt8], rng: np.random.Generator, width: int, height: int) -> UInt8:
    """Mostly photographs, of any contrast and brightness; now and then an even surface."""
    if rng.random() < 0.08:
        return np.full((height, width), rng.integers(256), np.uint8)
    image = window(photos[int(rng.integers(len(photos)))], rng, width, height, ZOOM)
    if rng.random() < 0.5:
        middle = rng.uniform(60, 200)
        table = np.clip(middle + rng.uniform(0.4, 1.6) * (np.arange(256) - 127.0), 0, 255).astype(np.uint8)
        image = np.asarray(cv2.LUT(image, table), np.uint8)
    return image


def _holds(image: UInt8, x: float, y: float) -> bool:
    return bool(-0.5 <= x < image.shape[1] - 0.5 and -0.5 <= y < image.shape[0] - 0.5)


def _lay_out(rng: np.random.Generator, patches: Sequence[Patch], image: UInt8, limits: Limits) -> list[Disc]:
    """Choose the patches of one crop; draw the paper below them into the image, if there is any."""
    height, width = image.shape
    on_board = rng.random() < 0.5
    asked = int(rng.choice(5, p=(0.15, 0.3, 0.22, 0.18, 0.15)))
    if asked == 0:
        if on_board:
            _paper(image, rng, _poses(rng, rng.uniform(0, 1, (1, 2)) * (width, height), limits)[0])
        return []
    # centres may lie a little outside: what remains of such a patch is no keypoint
    at = rng.uniform(-0.1, 1.1, (1 if on_board else asked, 2)) * (width, height) - 0.5
    poses = _poses(rng, at, limits)
    if on_board:
        first = poses[0]
        _paper(image, rng, first)
        # a hexagon of circumradius 0.36 S for patches of diameter 0.16 S; other boards are tighter or looser
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
    centres, majors, minors, _ = projected_discs(poses)
    alike = rng.random() < 0.5
    which = rng.integers(len(patches), size=len(poses))
    black = rng.uniform(*limits.black, len(poses))
    white = rng.uniform(*limits.white, len(poses))
    if on_board:
        black[:], white[:] = black[0], white[0]
        if alike:
            which[:] = which[0]
    discs: list[Disc] = []
    for n, H in enumerate(poses):
        patch = patches[which[n]]
        (x, y), reach = centres[n], patch.extent * majors[n]
        seen = -reach < x < width + reach and -reach < y < height + reach and majors[n] < 4 * width
        apart = all(np.hypot(x - d.x, y - d.y) > reach + d.placement.patch.extent * d.major for d in discs)
        if seen and apart:
            placement = Placement(patch, H, float(black[n]), float(white[n]))
            discs.append(Disc(placement, int(which[n]), H[0, 2], H[1, 2], majors[n], minors[n]))
    return discs


def _poses(rng: np.random.Generator, at_px: Float, limits: Limits) -> Float:
    """Poses as in a whole image, with their keypoints moved to given places (N, 2): the crop is cut around them."""
    poses = random_poses(rng, len(at_px), *IMAGE_PX, limits)
    poses[:, :2] += (at_px - poses[:, :2, 2])[:, :, None] * poses[:, 2:]
    return poses


def _paper(image: UInt8, rng: np.random.Generator, H: Float) -> None:
    """A sheet in the plane of the patches: mostly lighter than the white ink, some of it grey or dark."""
    grey = rng.uniform(170, 255) if rng.random() < 0.75 else rng.uniform(0, 255)
    low, high = -rng.uniform(1.3, 12.0, 2), rng.uniform(1.3, 12.0, 2)
    corners = np.array([[low[0], low[1], 1], [high[0], low[1], 1], [high[0], high[1], 1], [low[0], high[1], 1]]) @ H.T
    if np.all(corners[:, 2] > 0.05):
        points = np.clip(corners[:, :2] / corners[:, 2:], -4000, 4000)
        cv2.fillConvexPoly(image, np.round(points * 16).astype(np.int32), grey, cv2.LINE_AA, 4)


def _occlude(image: UInt8, rng: np.random.Generator, discs: Sequence[Disc], patches: Sequence[Patch]) -> list[Disc]:
    """Put things over the patches; returns those of which more than a third is hidden."""
    before = image.copy()
    draw_lookalikes(image, rng, int(rng.integers(1, 4)), patches)
    changed = (image != before).astype(np.float32)
    hidden = []
    for disc in discs:
        place = np.zeros_like(before)
        cv2.circle(place, (round(disc.x), round(disc.y)), max(2, round((disc.major + disc.minor) / 2)), 1, -1)
        if (changed * place).sum() > place.sum(dtype=np.float32) / 3:
            hidden.append(disc)
    return hidden


def _paint_all(canvases: Sequence[UInt8], discs: Sequence[Sequence[Disc]]) -> None:
    """Draw the patches of a whole batch with one call of the rasteriser."""
    drawn = [(image, disc.placement) for image, row in zip(canvases, discs, strict=True) for disc in row]
    # edges true to 1/64 px: cheaper than in a benchmark image, and still below what noise leaves
    masks = rasterise([placement for _, placement in drawn], 1 / 64)
    for (image, placement), mask in zip(drawn, masks, strict=True):
        paint(image, mask, placement.black, placement.white)


def _degrade(
    image: UInt8, rng: np.random.Generator, severity: float, radius: float
) -> tuple[UInt8, float, float, float]:
    """Light, blur, noise, compression; returns (image, gain, kernel width in px, noise in grey levels)."""
    gain, kernel, sigma = 1.0, 0.0, 0.6  # rounding, and what a sensor adds at best
    work = image.astype(np.float32)
    if rng.random() < 0.3 * severity:
        work, factor = _shade(work, rng)
        gain *= factor
    if rng.random() < 0.08 * severity:
        work = 0.7 * _rain(work, rng)
        gain *= 0.7
        sigma += 4.0
    if rng.random() < 0.6 * severity + 0.2:
        work, kernel = _soften(work, rng, severity, radius)
    draw = rng.random()
    if draw < 0.35 * severity:  # the dimming ladder reaches 0.6^4
        factor = 0.6 ** rng.uniform(0.0, 4.3)
        work *= np.float32(factor)
        gain *= factor
        if rng.random() < 0.3:  # low light: photons, then read noise
            photons = rng.uniform(1.0, 8.0)
            level = np.maximum(work, 0.0) * np.float32(photons)
            work += rng.standard_normal(work.shape, dtype=np.float32) * np.sqrt(level) / np.float32(photons)
            sigma += float(np.sqrt(work.mean().clip(0) / photons))
    elif draw < 0.5 * severity:
        factor = rng.uniform(0.4, 1.5)
        offset = rng.uniform(-40, 40)
        work = work * np.float32(factor) + np.float32(offset)
        gain *= min(factor, 1.0)
    draw = rng.random()
    if draw < 0.75:
        strong = draw < 0.35 * severity
        added = rng.uniform(5, 70) * severity if strong else np.exp(rng.uniform(np.log(0.5), np.log(6.0)))
        work += rng.standard_normal(work.shape, dtype=np.float32) * np.float32(added)
        sigma += added
    result = np.clip(np.rint(work), 0, 255).astype(np.uint8)
    if rng.random() < 0.25 * severity:
        quality = int(rng.uniform(25, 95))
        coded = cv2.imencode(".jpg", result, (cv2.IMWRITE_JPEG_QUALITY, quality))[1]
        result = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)
        sigma += (100 - quality) / 15
    return result, gain, kernel, sigma


def _shade(work: Float32, rng: np.random.Generator) -> tuple[Float32, float]:
    """A shadow with one straight border, sharp or soft; now and then a glare, or jagged shadows with many borders."""
    height, width = work.shape
    kind = rng.random()
    if kind < 0.3:
        return _jagged(work, rng)
    if kind < 0.4:
        x = (np.arange(width, dtype=np.float32) - np.float32(rng.uniform(0, width))) / np.float32(rng.uniform(8, width))
        y = (np.arange(height, dtype=np.float32) - np.float32(rng.uniform(0, height))) / np.float32(
            rng.uniform(8, height)
        )
        glare = np.float32(rng.uniform(40, 200)) * np.exp(-(x**2 + y[:, None] ** 2))
        return np.asarray(work + glare, np.float32), 0.5
    angle = rng.uniform(0, 2 * np.pi)
    x = (np.arange(width, dtype=np.float32) - np.float32(rng.uniform(0, width))) * np.float32(np.cos(angle))
    y = (np.arange(height, dtype=np.float32) - np.float32(rng.uniform(0, height))) * np.float32(np.sin(angle))
    ramp = np.clip((y[:, None] + x) / np.float32(np.exp(rng.uniform(0, np.log(width)))) + 0.5, 0, 1)
    factor = rng.uniform(0.2, 0.9)
    return np.asarray(work * (1 - np.float32(1 - factor) * ramp), np.float32), factor


def _jagged(work: Float32, rng: np.random.Generator) -> tuple[Float32, float]:
    """One or two shadows of five corners anywhere in and around the crop, their sides crossing each other."""
    height, width = work.shape
    light, least = np.ones_like(work), 1.0
    for _ in range(rng.integers(1, 3)):
        corners = np.rint(rng.uniform(-1.0, 2.0, (5, 2)) * (width, height)).astype(np.int32)
        factor = float(rng.uniform(0.3, 0.8))
        light *= np.where(cv2.fillPoly(np.zeros(work.shape, np.uint8), [corners], 1) > 0, np.float32(factor), 1)
        least *= factor
    return work * light, least


def _rain(work: Float32, rng: np.random.Generator) -> Float32:
    """Short bright streaks of one slant, a little out of focus."""
    height, width = work.shape
    count = rng.integers(10, 60)
    start = rng.uniform(-10, 1, (count, 2)) + rng.uniform(0, 1, (count, 2)) * (width + 10, height + 10)
    step = np.array([rng.uniform(-8, 8), rng.uniform(8, 20)])
    lines = np.rint(np.stack([start, start + step], axis=1)).astype(np.int32)
    streaked = cv2.polylines(work, list(lines), False, rng.uniform(160, 230))
    reach = int(rng.choice([1, 3, 5, 7]))
    return np.asarray(cv2.blur(streaked, (reach, reach), borderType=degrade.BORDER), np.float32)


def _soften(work: Float32, rng: np.random.Generator, severity: float, radius: float) -> tuple[Float32, float]:
    """One of four blurs, no wider than what leaves something of a patch of this radius."""
    widest = 1.5 + severity * (min(1.4 * radius, 19.0) - 1.5)
    width = float(rng.uniform(1.0, max(widest, 1.5)))
    kind = rng.integers(4)
    if kind == 1:  # a Gaussian of the box's standard deviation
        return np.asarray(cv2.GaussianBlur(work, (0, 0), width / np.sqrt(12)), np.float32), width
    if kind == 2:
        kernel = degrade.line_kernel(round(1.5 * width), float(rng.integers(0, 180)))
    elif kind == 3:  # defocus
        side = np.arange(-int(width / 2 + 1), int(width / 2 + 1) + 1)
        disc = np.clip(width / 2 + 0.5 - np.hypot(side, side[:, None]), 0, 1)
        kernel = disc / disc.sum()
    else:
        kernel = np.outer(taps := degrade.box_taps(width), taps)
    return np.asarray(cv2.filter2D(work, -1, kernel, borderType=degrade.BORDER), np.float32), width
