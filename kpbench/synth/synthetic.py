"""A synthetic set: what its images are a function of, and how one is made."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from kpbench.dataset.shard import Sample
from kpbench.degrade.ladder import ladder_mix, paper_mix
from kpbench.errors import DataError
from kpbench.patches.design import Patch, shipped_patches
from kpbench.render.background import Background, PhotoFolder, procedural
from kpbench.render.lookalikes import draw_lookalikes
from kpbench.render.scene import (
    Limits,
    measure_contrast,
    random_placements,
    rasterise,
    render_scene,
    share_inside,
    tabulate,
)
from kpbench.seeds import (
    SYNTH_AUGMENTATION,
    SYNTH_BACKGROUND,
    SYNTH_DETERIORATION,
    SYNTH_LOOKALIKES,
    SYNTH_SCENE,
    stream,
)
from kpbench.synth.finish import share_open
from kpbench.synth.user_pipeline import augment


@dataclass(frozen=True)
class SynthConfig:
    """All that a synthetic set is a function of, besides the background files.

    Attributes
    ----------
    n : number of images.
    seed : any whole number from 0.
    size_px : (width, height).
    channels : 1 (grey) or 3 (RGB).
    deteriorate : "none", "paper" (:func:`kpbench.degrade.paper_mix`) or "ladder" (:func:`kpbench.degrade.ladder_mix`);
        the scenes are the same.
    shard_size : images a shard; changes the files but no image.
    backgrounds : folder of photographs, or None for procedural ones.
    distractors : look-alikes an image (:mod:`kpbench.render`), up to so many; the scenes are the same.
    augmentation : an albumentations pipeline (:func:`kpbench.synth.load_augmentation`), applied last.
    limits : what a scene may hold.
    patches : the designs to place.

    Raises
    ------
    DataError
        If a value is out of its range.
    """

    n: int
    seed: int = 0
    size_px: tuple[int, int] = (640, 480)
    channels: int = 1
    deteriorate: str = "paper"
    shard_size: int = 500
    backgrounds: Path | None = None
    distractors: int = 0
    augmentation: str | None = None
    limits: Limits = field(default_factory=Limits)
    patches: tuple[Patch, ...] = field(default_factory=shipped_patches)

    def __post_init__(self) -> None:
        def need(good: bool, what: str) -> None:
            if not good:
                raise DataError(what)

        need(1 <= self.n <= 10**9, f"--n is {self.n}, expected a number of images from 1 to 1,000,000,000")
        need(self.seed >= 0, f"--seed is {self.seed}, expected a whole number from 0")
        need(min(self.size_px) >= 64, f"--size is {self.size_px[0]}x{self.size_px[1]}, expected at least 64x64")
        need(max(self.size_px) <= 16384, f"--size is {self.size_px[0]}x{self.size_px[1]}, at most 16384 a side")
        need(self.channels in (1, 3), f"--channels is {self.channels}, expected 1 or 3")
        modes = ("none", "paper", "ladder")
        need(self.deteriorate in modes, f"--deteriorate is {self.deteriorate!r}, expected one of {', '.join(modes)}")
        need(0 <= self.distractors <= 1000, f"--distractors is {self.distractors}, expected a number from 0 to 1000")
        largest = 2 * max(self.size_px)
        said = f"--radius-px goes up to {self.limits.radius_px[1]:g}, expected at most {largest} at this size"
        need(self.limits.radius_px[1] <= largest, said)
        need(self.shard_size >= 1, f"--shard-size is {self.shard_size}, expected a number of images from 1")

    @cached_property
    def photos(self) -> PhotoFolder | None:
        """The listed background folder."""
        return None if self.backgrounds is None else PhotoFolder.open(self.backgrounds)

    def to_dict(self) -> dict[str, Any]:
        """What is written into the dataset: no path, so that a moved folder gives the same bytes."""
        photos = self.photos
        source: dict[str, Any] = {"kind": "procedural"}
        if photos is not None:
            source = {"kind": "photographs", "files": len(photos.files), "listing_sha256": photos.digest}
        return {
            "kind": "synth",
            "n": self.n,
            "seed": self.seed,
            "size_px": list(self.size_px),
            "channels": self.channels,
            "deteriorate": self.deteriorate,
            "shard_size": self.shard_size,
            "backgrounds": source,
            "distractors": self.distractors,
            "augmentation": self.augmentation and json.loads(self.augmentation),
            "limits": {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self.limits).items()},
            "patches": [patch.to_dict() for patch in self.patches],
        }

    @property
    def image_bytes(self) -> int:
        """Expected size on disk: photographs deflate to about two thirds, noise hardly at all."""
        width, height = self.size_px
        return int(width * height * self.channels * (0.85 if self.deteriorate == "paper" else 0.7))

    def scene(self, index: int) -> int:
        """Every image is a scene of its own."""
        return index

    def make(self, index: int) -> tuple[Sample, tuple[str, ...]]:
        """Image ``index`` of the set, and the broken background files met on the way.

        A function of (self, index, background files) and of nothing else.
        """
        width, height = self.size_px
        background = self._background(stream(self.seed, index, SYNTH_BACKGROUND))
        if self.distractors:
            rng = stream(self.seed, index, SYNTH_LOOKALIKES)
            draw_lookalikes(background.image, rng, int(rng.integers(self.distractors + 1)), self.patches)
        placements = random_placements(stream(self.seed, index, SYNTH_SCENE), width, height, self.patches, self.limits)
        scene = render_scene(background.image, placements)
        image, effects = scene.image, list[dict[str, Any]]()
        keypoints, masks = scene.keypoints, scene.masks
        if self.deteriorate == "paper":
            image, effects = paper_mix(image, stream(self.seed, index, SYNTH_DETERIORATION))
        elif self.deteriorate == "ladder":
            discs = np.column_stack([keypoints[name] for name in ("x", "y", "radius_major")]).astype(np.float64)
            image, effects = ladder_mix(image, stream(self.seed, index, SYNTH_DETERIORATION), discs)
            keypoints["visible"] *= share_open(image, effects, masks)
        if self.augmentation is not None:
            seed = int(stream(self.seed, index, SYNTH_AUGMENTATION).integers(2**31))
            before = share_open(image, effects, masks)
            image, moved = augment(image, placements, self.augmentation, seed)
            placements = [placement for placement in moved if placement is not None]
            masks = tuple(rasterise(placements))
            keypoints = tabulate(placements, [share_inside(image, mask) for mask in masks])
            keypoints["visible"] *= before[[placement is not None for placement in moved]]
            effects = [*effects, {"effect": "augmentation", "seed": seed}]
        keypoints["contrast"] = measure_contrast(image, masks)
        return Sample(index, image, keypoints, effects, background.file), background.broken

    def _background(self, rng: np.random.Generator) -> Background:
        width, height = self.size_px
        if self.photos is None:
            return Background(procedural(rng, width, height, self.channels))
        return self.photos.sample(rng, width, height, self.channels)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "photos"}
