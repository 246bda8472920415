"""Training samples made on the fly: a batch is a function of (config, seed, index) and of nothing else.

Two kinds: ``scenes`` are whole images as ``kpbench synth`` writes them; ``crops`` are small windows
with patches, boards of patches and look-alikes in them, made a batch at a time, several hundred a second
on one core, with degradations whose strength the training loop raises.

Keypoints that no detector could find, because blur or noise has buried them, are marked to be ignored:
they are neither to be found nor to be left out.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench import degrade
from kpbench.background import PhotoFolder, procedural
from kpbench.design import Patch
from kpbench.detectors.superpoint import resize
from kpbench.geometry import projected_discs
from kpbench.keypoints import Float, UInt8
from kpbench.lookalikes import draw_lookalikes
from kpbench.scene import Limits, Placement, paint, random_placements, random_poses, rasterise, render_scene
from kpbench.workers import one_thread

__all__ = ["Batch", "Job", "SampleConfig", "load_photos", "make_batch", "stream"]

Float32 = NDArray[np.float32]

MOST_KEYPOINTS = 12
VALIDATION_EVERY = 10
IMAGE_PX = (640, 480)  # the image that a crop is thought to be cut from: focal lengths are relative to it
ZOOM = (0.35, 3.0)  # px of a photograph a px of a crop: a photograph fills images 200 to 1,800 px wide
VIEWS = {1.0: 0.5, 1.5: 0.35, 0.5: 0.15}
"""Scales at which a crop's image is shown, as the detector looks at all of them, and how often each comes."""
VIEW_RADIUS_PX = (5.0, 40.0)
"""Radii at the scale 1.5, where what is large is left to the other scales; px of the image itself."""
DETECTABLE = 15.0
"""Least contrast / noise · √area of a keypoint that is asked for: 7.5 sigma at the output of a matched filter."""
FAINTEST = 4.0
"""Least contrast of a keypoint that is asked for, grey levels: 8-bit images hold little of anything fainter."""


@dataclass(frozen=True)
class SampleConfig:
    """What the training sees.

    Attributes
    ----------
    kind : str
        "crops" or "scenes", see the module.
    size : (int, int)
        Width and height of a sample, px, multiples of 8.
    set_size : int
        Scenes only: how many different scenes there are; sample i shows scene i modulo this.
    """

    kind: str = "crops"
    size: tuple[int, int] = (96, 96)
    set_size: int = 20_000


class Batch(NamedTuple):
    """Images (B, H, W) uint8, and keypoints (B, K, 4) float32.

    A keypoint is x, y (px), place of its patch in the design set (−1: there is none) and ignore radius
    (px): 0 for one that is to be found; else nothing is asked for within that distance.
    """

    images: UInt8
    keypoints: Float32


def load_photos(folder: str | Path | None, part: str) -> list[UInt8]:
    """Photographs of a folder in grey, in the order of their names; broken ones are left out.

    Parameters
    ----------
    folder : path or None
        None gives 64 procedural textures.
    part : str
        "validation" (every tenth) or "training" (the others); one photograph alone is both.

    Raises
    ------
    DataError
        As :meth:`kpbench.background.PhotoFolder.open`.
    """

    def kept(n: int, count: int) -> bool:
        return count == 1 or (n % VALIDATION_EVERY == 0) == (part == "validation")

    if folder is None:
        return [procedural(np.random.default_rng([2410, n]), 640, 480) for n in range(64) if kept(n, 64)]
    photos = PhotoFolder.open(folder)
    files = [name for n, name in enumerate(photos.files) if kept(n, len(photos.files))]
    read = (cv2.imread(str(photos.path / name), cv2.IMREAD_GRAYSCALE) for name in files)
    return [_at_most(np.asarray(image, np.uint8)) for image in read if image is not None]


def _at_most(image: NDArray[np.uint8], side: int = 640) -> UInt8:
    scale = side / max(image.shape)
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return image


def make_batch(
    config: SampleConfig,
    patches: Sequence[Patch],
    photos: Sequence[UInt8],
    seed: int,
    index: int,
    count: int,
    severity: float,
) -> Batch:
    """The ``count`` samples of batch ``index``.

    Parameters
    ----------
    config : SampleConfig
    patches : sequence of Patch
    photos : sequence of ndarray of shape (H, W), uint8
    seed, index : int
    count : int
    severity : float
        0: clean images; 1: the full range of degradations.
    """
    rng = np.random.default_rng([seed, index])
    if config.kind == "scenes":
        return _scenes(config, patches, photos, rng, seed, index * count, count, severity)
    return _crops(config, patches, photos, rng, count, severity)


@dataclass(frozen=True)
class Job:
    """One batch to make: its index, its number of samples, and the severity of its degradations."""

    index: int
    count: int
    severity: float


def stream(
    config: SampleConfig,
    patches: Sequence[Patch],
    folder: str | Path | None,
    seed: int,
    jobs: Iterable[Job],
    workers: int,
) -> Iterator[Batch]:
    """Training batches in the order of their jobs, made ahead by worker processes (0: by this one).

    The processes are started afresh, not forked: they load neither torch nor its threads.
    """
    if workers == 0:
        _start_worker(config, patches, folder, seed)
        yield from map(_work, jobs)
        return
    spawn = multiprocessing.get_context("spawn")
    arguments = (config, tuple(patches), folder, seed)
    pool = ProcessPoolExecutor(workers, spawn, initializer=_start_worker, initargs=(*arguments, True))
    ahead: deque[Future[Batch]] = deque()
    try:
        for job in jobs:
            ahead.append(pool.submit(_work, job))
            if len(ahead) > 4 * workers:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_worker: dict[str, Any] = {}


def _start_worker(
    config: SampleConfig, patches: Sequence[Patch], folder: str | Path | None, seed: int, own: bool = False
) -> None:
    if own:  # the main process decides when to stop, and takes its workers with it
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        one_thread()
    photos = load_photos(folder, "training")
    _worker.update(config=config, patches=patches, photos=photos, seed=seed)


def _work(job: Job) -> Batch:
    return make_batch(**_worker, index=job.index, count=job.count, severity=job.severity)


def _scenes(
    config: SampleConfig,
    patches: Sequence[Patch],
    photos: Sequence[UInt8],
    rng: np.random.Generator,
    seed: int,
    first: int,
    count: int,
    severity: float,
) -> Batch:
    width, height = config.size
    images = np.zeros((count, height, width), np.uint8)
    keypoints = _no_keypoints(count)
    for n in range(count):
        fixed = np.random.default_rng([seed, 1, (first + n) % config.set_size])
        background = _window(photos[int(fixed.integers(len(photos)))], fixed, width, height)
        rendered = render_scene(background, random_placements(fixed, width, height, patches, Limits()))
        image = degrade.paper_mix(rendered.image, rng)[0] if rng.random() < severity else rendered.image
        images[n] = image
        for k, row in enumerate(rendered.keypoints[:MOST_KEYPOINTS]):
            keypoints[n, k] = row["x"], row["y"], [p.patch_id for p in patches].index(row["patch_id"]), 0.0
    return Batch(images, keypoints)


def _no_keypoints(count: int) -> Float32:
    keypoints = np.zeros((count, MOST_KEYPOINTS, 4), np.float32)
    keypoints[..., 2] = -1
    return keypoints


# Crops -------------------------------------------------------------------------------------------------


class Disc(NamedTuple):
    """One patch that is to be drawn into a crop; ``place`` is its place in the design set."""

    placement: Placement
    place: int
    x: float
    y: float
    major: float
    minor: float


def _crops(
    config: SampleConfig,
    patches: Sequence[Patch],
    photos: Sequence[UInt8],
    rng: np.random.Generator,
    count: int,
    severity: float,
) -> Batch:
    width, height = config.size
    images = np.zeros((count, height, width), np.uint8)
    keypoints = _no_keypoints(count)
    discs: list[list[Disc]] = []
    canvases: list[UInt8] = []
    scales = rng.choice(list(VIEWS), count, p=list(VIEWS.values()))
    for scale in scales:
        image = _background(photos, rng, round(width / scale), round(height / scale))
        if rng.random() < 0.5:
            draw_lookalikes(image, rng, int(rng.integers(1, 4)), patches)
        drawn = _lay_out(rng, patches, image, Limits(radius_px=VIEW_RADIUS_PX) if scale > 1 else Limits())
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
    return Batch(images, keypoints)


def _window(
    photo: UInt8, rng: np.random.Generator, width: int, height: int, zoom: tuple[float, float] | None = None
) -> UInt8:
    """A crop of a photograph, mirrored half of the time.

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
    image = _window(photos[int(rng.integers(len(photos)))], rng, width, height, ZOOM)
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
    """A shadow with one straight border, sharp or soft; now and then a glare instead."""
    height, width = work.shape
    if rng.random() < 0.15:
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
