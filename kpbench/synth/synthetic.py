"""Synthetic sets: the configuration that determines every image, and how one image is made."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.camera.preset import CameraPreset
from kpbench.dataset.shard import Sample
from kpbench.degrade.effects import Effect
from kpbench.degrade.ladder import draw_ladder_mix, draw_paper_mix
from kpbench.errors import DataError
from kpbench.memory import require_memory
from kpbench.patches.design import Patch, shipped_patches
from kpbench.render.background import PHOTO_PARTS, Background, PhotoFolder, describe_backgrounds, procedural_background
from kpbench.render.lookalikes import draw_lookalikes
from kpbench.render.placement import Limits, random_placements
from kpbench.render.scene import render_scene
from kpbench.seeds import (
    SYNTH_AUGMENTATION,
    SYNTH_BACKGROUND,
    SYNTH_CAMERA,
    SYNTH_DETERIORATION,
    SYNTH_LOOKALIKES,
    SYNTH_SCENE,
    stage_rng,
)
from kpbench.synth.camera_view import photograph_scene
from kpbench.synth.finish import augment_scene, degrade_scene, discs_of
from kpbench.synth.user_pipeline import try_pipeline

DETERIORATIONS = ("none", "paper", "ladder")
MOST_SYNTH_PIXELS = 2**26
"""Largest number of pixels of an image."""
SYNTH_BYTES_PER_PIXEL = 64
"""Memory that the making of an image needs per pixel, bytes. Measured on RGB images, with the paper's effects."""


@dataclass(frozen=True)
class SynthConfig:
    """Configuration of a synthetic set. The configuration and the background files determine every image.

    Attributes
    ----------
    n : int
        Number of images.
    seed : int
        0 or more.
    size_px : (int, int)
        Width and height of the images.
    channels : {1, 3}
        1 for grey, 3 for RGB.
    deteriorate : {"none", "paper", "ladder"}
        How the scenes are degraded: not at all, by :func:`kpbench.degrade.draw_paper_mix`, or by
        :func:`kpbench.degrade.draw_ladder_mix`. The scenes themselves do not depend on ``deteriorate``.
    shard_size : int
        Images per shard; changes the files but no image.
    backgrounds : Path or None
        Folder of photographs, or None for procedural backgrounds.
    photo_part : {"all", "training", "validation"}
        Which photographs of the folder are used, see :meth:`kpbench.render.PhotoFolder.open`.
    distractors : int
        Largest number of look-alikes per image, see :func:`kpbench.render.draw_lookalikes`. The patches of a scene
        do not depend on ``distractors``.
    camera : CameraPreset or None
        A camera from :func:`kpbench.camera.load_camera_preset` that takes the scenes in linear light. None for
        a linear world: inks keep their levels. The patches of a scene do not depend on ``camera``, but move with the
        lens. ``deteriorate`` is applied to the finished image.
    augmentation : str or None
        An albumentations pipeline from :func:`kpbench.synth.load_augmentation`, applied last.
    limits : Limits
        Ranges within which the scenes are drawn.
    patches : tuple of Patch
        The designs to place.

    Raises
    ------
    DataError
        If a value is out of its range.

    Examples
    --------
    >>> from kpbench import SynthConfig
    >>> config = SynthConfig(n=10, size_px=(160, 120), deteriorate="none")
    >>> sample, broken_files = config.make(3)
    >>> sample.image.shape, len(sample.keypoints)
    ((120, 160), 1)
    """

    n: int
    seed: int = 0
    size_px: tuple[int, int] = (640, 480)
    channels: int = 1
    deteriorate: str = "paper"
    shard_size: int = 500
    backgrounds: Path | None = None
    photo_part: str = "all"
    distractors: int = 0
    camera: CameraPreset | None = None
    augmentation: str | None = None
    limits: Limits = field(default_factory=Limits)
    patches: tuple[Patch, ...] = field(default_factory=shipped_patches)

    def __post_init__(self) -> None:
        size, largest_radius = f"{self.size_px[0]}x{self.size_px[1]}", self.limits.radius_px[1]
        modes, most = ", ".join(DETERIORATIONS), 2 * max(self.size_px)
        for is_valid, problem in (
            (1 <= self.n <= 10**9, f"`n` is {self.n}, expected a number of images from 1 to 1,000,000,000"),
            (self.seed >= 0, f"`seed` is {self.seed}, expected a whole number from 0"),
            (min(self.size_px) >= 64, f"`size_px` is {size}, expected at least 64x64"),
            (max(self.size_px) <= 16384, f"`size_px` is {size}, at most 16384 a side"),
            (
                self.size_px[0] * self.size_px[1] <= MOST_SYNTH_PIXELS,
                f"`size_px` is {size}, expected at most {MOST_SYNTH_PIXELS} pixels",
            ),
            (
                self.photo_part in PHOTO_PARTS,
                f"`photo_part` is {self.photo_part!r}, expected one of {', '.join(PHOTO_PARTS)}",
            ),
            (self.channels in (1, 3), f"`channels` is {self.channels}, expected 1 or 3"),
            (
                self.deteriorate in DETERIORATIONS,
                f"`deteriorate` is {self.deteriorate!r}, expected one of {modes}",
            ),
            (
                0 <= self.distractors <= 1000,
                f"`distractors` is {self.distractors}, expected a number from 0 to 1000",
            ),
            (
                largest_radius <= most,
                f"`limits.radius_px` goes up to {largest_radius:g}, expected at most {most} at this size",
            ),
            (
                self.camera is None or self.augmentation is None,
                "`camera` and `augmentation` are both given, expected one of them",
            ),
            (self.shard_size >= 1, f"`shard_size` is {self.shard_size}, expected a number of images from 1"),
        ):
            if not is_valid:
                raise DataError(problem)
        require_memory(SYNTH_BYTES_PER_PIXEL * self.size_px[0] * self.size_px[1], f"`size_px`: an image of {size}")
        if self.camera is not None and self.camera.calibration is not None:
            self.camera.calibration.at_size(*self.size_px)
        if self.augmentation is not None:
            try_pipeline(self.augmentation, self.size_px, self.channels)

    @cached_property
    def photos(self) -> PhotoFolder | None:
        """The opened folder of photographs; None for procedural backgrounds."""
        return None if self.backgrounds is None else PhotoFolder.open(self.backgrounds, self.photo_part)

    def to_dict(self) -> dict[str, Any]:
        """Return the config that is written into the dataset.

        The config holds no path, so that a moved background folder gives the same bytes.
        """
        return {
            "kind": "synth",
            "n": self.n,
            "seed": self.seed,
            "size_px": list(self.size_px),
            "channels": self.channels,
            "deteriorate": self.deteriorate,
            "shard_size": self.shard_size,
            "backgrounds": describe_backgrounds(self.photos),
            "distractors": self.distractors,
            **({} if self.camera is None else {"camera": self.camera.to_dict()}),
            "augmentation": self.augmentation and json.loads(self.augmentation),
            "limits": {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self.limits).items()},
            "patches": [patch.to_dict() for patch in self.patches],
        }

    @property
    def image_bytes(self) -> int:
        """Expected size of one image on disk. PNG shrinks photographs to about two thirds and hardly shrinks noise."""
        width, height = self.size_px
        return int(width * height * self.channels * (0.85 if self.deteriorate == "paper" else 0.7))

    @property
    def most_keypoints(self) -> int:
        """Largest number of patches per image."""
        return self.limits.count[1]

    def scene_id(self, index: int) -> int:
        """Return the base scene of an image; every image has its own base scene."""
        return index

    def make(self, index: int) -> tuple[Sample, tuple[str, ...]]:
        """Make one image. The result is a function of the config, the index and the background files.

        Parameters
        ----------
        index : int
            0 to n − 1.

        Returns
        -------
        sample : Sample
        broken_files : tuple of str
            Background files that were tried and could not be decoded.
        """
        width, height = self.size_px
        background = self._make_background(stage_rng(self.seed, index, SYNTH_BACKGROUND))
        if self.distractors:
            rng = stage_rng(self.seed, index, SYNTH_LOOKALIKES)
            draw_lookalikes(background.image, rng, int(rng.integers(self.distractors + 1)), self.patches)
        placements = random_placements(
            stage_rng(self.seed, index, SYNTH_SCENE), width, height, self.patches, self.limits
        )
        taken = list[Effect]()
        if self.camera is None:
            scene = render_scene(background.image, placements)
        else:
            rng = stage_rng(self.seed, index, SYNTH_CAMERA)
            taken = [self.camera.draw(rng)]
            scene = photograph_scene(background.image, placements, rng, taken[0], self.camera.calibration)
        rng = stage_rng(self.seed, index, SYNTH_DETERIORATION)
        effects = self._draw_effects(rng, scene.keypoints)
        scene = degrade_scene(scene, rng, effects)
        effects = [*taken, *effects]
        if self.augmentation is not None:
            seed = int(stage_rng(self.seed, index, SYNTH_AUGMENTATION).integers(2**31))
            scene = augment_scene(scene, placements, effects, self.augmentation, seed)
            effects = [*effects, {"effect": "augmentation", "seed": seed}]
        return Sample(index, scene.image, scene.keypoints, effects, background.file), background.broken_files

    def _draw_effects(self, rng: np.random.Generator, keypoints: NDArray[Any]) -> list[Effect]:
        if self.deteriorate == "paper":
            return draw_paper_mix(rng)
        if self.deteriorate == "ladder":
            return draw_ladder_mix(rng, self.size_px, discs_of(keypoints))
        return []

    def _make_background(self, rng: np.random.Generator) -> Background:
        width, height = self.size_px
        if self.photos is None:
            return Background(procedural_background(rng, width, height, self.channels))
        return self.photos.sample(rng, width, height, self.channels)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "photos"}
