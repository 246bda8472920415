"""Training samples made on the fly: a batch is a function of (config, seed, index) and of nothing else.

Two kinds: ``scenes`` are whole images as ``kpbench synth`` writes them; ``crops`` are small windows
(:mod:`kpbench.training`) with degradations whose strength the training loop raises.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from kpbench.degrade.ladder import apply_effects, draw_paper_mix
from kpbench.errors import DataError
from kpbench.images import decode_photo
from kpbench.patches.design import Patch
from kpbench.render.background import PhotoFolder, procedural_background
from kpbench.render.placement import Limits, random_placements
from kpbench.render.scene import render_scene
from kpbench.training.crops import MOST_KEYPOINTS, make_crops, no_keypoints, window
from kpbench.types import Float32, UInt8
from kpbench.workers import run_in_order

VALIDATION_EVERY = 10


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

    def __post_init__(self) -> None:
        if min(self.size) < 8 or any(side % 8 for side in self.size) or self.set_size < 1:
            raise DataError(
                f"samples: size {list(self.size)} and set_size {self.set_size}, expected multiples of 8, and at least 1"
            )


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
        As :meth:`kpbench.render.PhotoFolder.open`, or if none of the part can be decoded.
    """

    def kept(n: int, count: int) -> bool:
        return count == 1 or (n % VALIDATION_EVERY == 0) == (part == "validation")

    if folder is None:
        return [procedural_background(np.random.default_rng([2410, n]), 640, 480) for n in range(64) if kept(n, 64)]
    photos = PhotoFolder.open(folder)
    files = [name for n, name in enumerate(photos.files) if kept(n, len(photos.files))]
    read = (decode_photo(photos.path / name, 1) for name in files)
    good = [image for image in (_at_most(image) for image in read if image is not None) if min(image.shape) >= 8]
    if not good:
        raise DataError(
            f"{folder}: none of the {len(files)} photographs for {part} can be decoded (every tenth validates)"
        )
    return good


def _at_most(image: UInt8, side: int = 640) -> UInt8:
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
    return Batch(*make_crops(*config.size, patches, photos, rng, count, severity))


@dataclass(frozen=True)
class Job:
    """One batch to make: its index, its number of samples, and the severity of its degradations."""

    index: int
    count: int
    severity: float


def training_batches(
    config: SampleConfig,
    patches: Sequence[Patch],
    folder: str | Path | None,
    seed: int,
    jobs: Iterable[Job],
    workers: int,
) -> Iterator[Batch]:
    """Yield training batches in the order of their jobs, made ahead by worker processes.

    The worker processes are spawned, not forked: they load neither torch nor its threads.

    Parameters
    ----------
    config : SampleConfig
    patches : sequence of Patch
    folder : path or None
        Photographs for backgrounds, see :func:`load_photos`.
    seed : int
    jobs : iterable of Job
    workers : int
        Number of worker processes. With 0, this process makes the batches.

    Raises
    ------
    DataError
        As :func:`load_photos`, or if a worker process dies.
    """
    _training_photos.cache_clear()
    return run_in_order(partial(_run_job, config, tuple(patches), folder, seed), jobs, workers)


def _run_job(config: SampleConfig, patches: Sequence[Patch], folder: str | Path | None, seed: int, job: Job) -> Batch:
    return make_batch(config, patches, _training_photos(folder), seed, job.index, job.count, job.severity)


@lru_cache(maxsize=1)
def _training_photos(folder: str | Path | None) -> list[UInt8]:
    """Load the photographs once per process."""
    return load_photos(folder, "training")


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
    keypoints = no_keypoints(count)
    for n in range(count):
        fixed = np.random.default_rng([seed, 1, (first + n) % config.set_size])
        background = window(photos[int(fixed.integers(len(photos)))], fixed, width, height)
        rendered = render_scene(background, random_placements(fixed, width, height, patches, Limits()))
        image = apply_effects(rendered.image, rng, draw_paper_mix(rng)) if rng.random() < severity else rendered.image
        images[n] = image
        for k, row in enumerate(rendered.keypoints[:MOST_KEYPOINTS]):
            keypoints[n, k] = row["x"], row["y"], [p.patch_id for p in patches].index(row["patch_id"]), 0.0
    return Batch(images, keypoints)
