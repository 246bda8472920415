"""Training samples, made on the fly. The seed of the training and the index of a batch determine the batch.

There are two kinds of samples. Scenes are whole images, like the images of ``kpbench synth``. Crops
(:mod:`kpbench.training.crops`) are small windows, degraded with a severity that the recipe sets.
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
from kpbench.render.background import PhotoFolder, is_in_part, procedural_background
from kpbench.render.placement import Limits, random_placements
from kpbench.render.scene import render_scene
from kpbench.training.crops import MOST_KEYPOINTS, cut_window, empty_keypoints, make_crops
from kpbench.types import Float32, UInt8
from kpbench.workers import run_in_order

PHOTO_PX = 640
"""Longest side of a photograph, px; larger photographs are shrunk."""
LEAST_PHOTO_PX = 8
"""Least short side of a photograph after it was shrunk, px; narrower photographs are left out."""


@dataclass(frozen=True)
class SampleConfig:
    """Kind and size of the training samples, and number of different scenes.

    Attributes
    ----------
    kind : str
        "crops" or "scenes".
    size : (int, int)
        Width and height of a sample, px; multiples of 8.
    set_size : int
        Number of different scenes. Sample i shows scene number ``i % set_size``. Crops ignore ``set_size``: no crop is
        repeated.

    Raises
    ------
    DataError
        If a value is out of its range.

    Examples
    --------
    >>> from kpbench.training import SampleConfig
    >>> SampleConfig(size=(64, 64)).kind
    'crops'
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
    """Images and keypoints of B samples; each sample has K rows of keypoints.

    Attributes
    ----------
    images : ndarray of shape (B, H, W), uint8
    keypoints : ndarray of shape (B, K, 4), float32
        Columns: x, px; y, px; index of the design; ignore radius, px. The index is -1 in rows without a keypoint. The
        detector must find the keypoints with an ignore radius of 0. A keypoint with a positive ignore radius is
        ignored: the detector head is not trained within this radius.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.training import Batch
    >>> Batch(np.zeros((2, 64, 64), np.uint8), np.full((2, 12, 4), -1, np.float32)).images.shape
    (2, 64, 64)
    """

    images: UInt8
    keypoints: Float32


def load_photos(folder: str | Path | None, part: str) -> list[UInt8]:
    """Load the training photographs or the validation photographs of a folder, in grey, sorted by path.

    Photographs are shrunk to a long side of at most 640 px. Broken photographs are left out. Photographs whose short
    side is then under 8 px are left out.

    Parameters
    ----------
    folder : path or None
        Folder of photographs. None: 64 procedural textures replace the photographs.
    part : str
        "validation" or "training", see :meth:`kpbench.render.PhotoFolder.open`.

    Raises
    ------
    DataError
        If the folder holds no photographs, or if all photographs of the part are left out.

    Examples
    --------
    >>> from kpbench.training import load_photos
    >>> textures = load_photos(None, "validation")
    >>> len(textures), textures[0].shape
    (7, (480, 640))
    """
    if folder is None:
        numbers = [n for n in range(64) if is_in_part(n, part)]
        return [procedural_background(np.random.default_rng([2410, n]), 640, 480) for n in numbers]
    photos = PhotoFolder.open(folder, part)
    read = (decode_photo(photos.path / name, 1) for name in photos.files)
    shrunk = (_shrink(image) for image in read if image is not None)
    good = [image for image in shrunk if min(image.shape) >= LEAST_PHOTO_PX]
    if not good:
        raise DataError(
            f"{folder}: none of the {len(photos.files)} photographs for {part} can be decoded (every tenth validates)"
        )
    return good


def _shrink(image: UInt8) -> UInt8:
    """Return a photograph with a long side of at most ``PHOTO_PX``."""
    scale = PHOTO_PX / max(image.shape)
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
    """Make one batch.

    Parameters
    ----------
    config : SampleConfig
    patches : sequence of Patch
    photos : sequence of ndarray of shape (H, W), uint8
        Backgrounds, see :func:`load_photos`.
    seed, index : int
        Seed of the training, and index of the batch.
    count : int
        Number of samples.
    severity : float
        From 0 to 1. For crops: severity of the degradations; at 0, crops have only slight blur and noise. For scenes:
        probability that a scene is degraded.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.training import SampleConfig, load_photos, make_batch
    >>> photos = load_photos(None, "training")
    >>> batch = make_batch(SampleConfig(), kpbench.shipped_patches(), photos, seed=0, index=0, count=8, severity=0.5)
    >>> batch.images.shape, batch.keypoints.shape
    ((8, 96, 96), (8, 12, 4))
    """
    rng = np.random.default_rng([seed, index])
    if config.kind == "scenes":
        return _make_scenes(config, patches, photos, rng, seed, index * count, count, severity)
    return Batch(*make_crops(*config.size, patches, photos, rng, count, severity))


@dataclass(frozen=True)
class BatchJob:
    """Order for one batch: index of the batch, number of samples, and severity (see :func:`make_batch`)."""

    index: int
    count: int
    severity: float


def training_batches(
    config: SampleConfig,
    patches: Sequence[Patch],
    folder: str | Path | None,
    seed: int,
    jobs: Iterable[BatchJob],
    workers: int,
) -> Iterator[Batch]:
    """Yield training batches in the order of their jobs; worker processes make the batches in advance.

    The worker processes are spawned, not forked. They therefore hold neither torch nor its threads.

    Parameters
    ----------
    config : SampleConfig
    patches : sequence of Patch
    folder : path or None
        Photographs for backgrounds, see :func:`load_photos`.
    seed : int
    jobs : iterable of BatchJob
    workers : int
        Number of worker processes; 0: this process makes the batches.

    Raises
    ------
    DataError
        If the photographs cannot be loaded (see :func:`load_photos`), or if a worker process dies.
    """
    _training_photos.cache_clear()
    return run_in_order(partial(_run_job, config, tuple(patches), folder, seed), jobs, workers)


def _run_job(
    config: SampleConfig, patches: Sequence[Patch], folder: str | Path | None, seed: int, job: BatchJob
) -> Batch:
    return make_batch(config, patches, _training_photos(folder), seed, job.index, job.count, job.severity)


@lru_cache(maxsize=1)
def _training_photos(folder: str | Path | None) -> list[UInt8]:
    """Load the training photographs once per process."""
    return load_photos(folder, "training")


def _make_scenes(
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
    keypoints = empty_keypoints(count)
    for n in range(count):
        fixed = np.random.default_rng([seed, 1, (first + n) % config.set_size])
        background = cut_window(photos[int(fixed.integers(len(photos)))], fixed, width, height)
        rendered = render_scene(background, random_placements(fixed, width, height, patches, Limits()))
        image = apply_effects(rendered.image, rng, draw_paper_mix(rng)) if rng.random() < severity else rendered.image
        images[n] = image
        for k, row in enumerate(rendered.keypoints[:MOST_KEYPOINTS]):
            keypoints[n, k] = row["x"], row["y"], [p.patch_id for p in patches].index(row["patch_id"]), 0.0
    return Batch(images, keypoints)
