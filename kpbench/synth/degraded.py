"""A suite's effects on labelled images: the paper's artificial blur, dimming and noise on images of one's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.dataset.folder import Dataset
from kpbench.dataset.labelled import open_labelled
from kpbench.dataset.shard import Sample
from kpbench.degrade.effects import Effect
from kpbench.degrade.ladder import apply_effects, draw_effect
from kpbench.errors import DataError, DesignError
from kpbench.images import to_grey
from kpbench.patches.design import Patch, parse_patch, shipped_patches
from kpbench.portable import cos_sin
from kpbench.predictions.coco import CocoDataset
from kpbench.provenance import image_source
from kpbench.render.placement import Placement
from kpbench.render.scene import measure_contrast, rasterise_patches
from kpbench.seeds import SUITE_EFFECT, SUITE_FIELD, stage_rng
from kpbench.synth.finish import discs_of, unoccluded_fraction
from kpbench.synth.suite import describe_condition
from kpbench.synth.suite_file import Condition, Suite
from kpbench.types import LABELLED_KEYPOINT_DTYPE, Float, UInt8

FREE_CONDITIONS = ("", "free")
"""Conditions of images that belong to no rung."""
POSE_CONDITIONS = {"scale": "area_percent", "pitch": "pitch_deg"}
"""The paper's conditions that change the view, and the quantity of a suite's scene that is their rung."""


@dataclass(frozen=True)
class DegradeConfig:
    """Configuration of a dataset: labelled images as they are, then these images under the effects of a suite.

    Image *i* is a function of this configuration, *i* and the labelled images. All images of a scene share the random
    numbers of an effect, as in :class:`kpbench.SuiteConfig`: the scene of a suite, degraded with the suite's seed, is
    the image that the suite itself makes.

    Attributes
    ----------
    source : Path
        Labelled images, as for :func:`kpbench.dataset.open_labelled`. All have one size.
    suite : Suite
        Gives the conditions: those that consist of effects alone. In ``paper-v1``: blur, dimming and noise.
    only : tuple of str
        Names of the conditions to make; an empty tuple makes all of them.
    seed : int
        0 or more.
    channels : int
        1 for grey images, as those of the suites: the noise of a rung is what a detector sees in grey. 3 for RGB.
    shard_size : int
        Images per shard; changes the files but no image.

    Raises
    ------
    DataError
        If a value is out of its range, the suite has no such condition, the labelled images already have it, or none of
        them shows the suite's base view.

    Notes
    -----
    The effects are applied to images without a rung (condition "" or "free"), and to images of a rung of scale or pitch
    that is the view of the suite's scene. In ``paper-v1``, these are the rungs 16 of scale and 0 of pitch: in the
    paper, the board has 16 % of the image wherever blur, dimming or noise change.

    Examples
    --------
    >>> from pathlib import Path
    >>> import kpbench
    >>> config = kpbench.synth.DegradeConfig(Path("kpbench-data"), kpbench.load_suite("paper-v1"), only=("blur",))
    >>> config.n  # 6 images as they are, and under each of 4 rungs
    30
    >>> sample, _ = config.make(29)
    >>> sample.condition, sample.rung, sample.effects[-1]
    ('blur', 15.0, {'effect': 'blur', 'kernel_px': 15.0})
    """

    source: Path
    suite: Suite
    only: tuple[str, ...] = ()
    seed: int = 0
    channels: int = 1
    shard_size: int = 100

    def __post_init__(self) -> None:
        for is_valid, problem in (
            (self.seed >= 0, f"`seed` is {self.seed}, expected a whole number from 0"),
            (self.channels in (1, 3), f"`channels` is {self.channels}, expected 1 (grey) or 3 (RGB)"),
            (self.shard_size >= 1, f"`shard_size` is {self.shard_size}, expected a number of images from 1"),
        ):
            if not is_valid:
                raise DataError(problem)
        known = [c.name for c in self.suite.conditions if is_degradation(c)]
        for name in self.only or () if known else ("",):
            if name not in known:
                wanted = f"no condition {name!r}" if name else "no condition"
                raise DataError(f"{self.suite.name} has {wanted} of effects alone, only: {', '.join(known) or 'none'}")
        present = {*self.labelled.truth.condition.tolist()}
        for condition, _ in self.rungs:
            if condition.name in present:
                raise DataError(f"{self.source}: has images of {condition.name} already; leave it out with `only`")
        if not self.bases:
            shown = ", ".join(sorted(present))
            raise DataError(
                f"{self.source}: no image shows the base view of {self.suite.name}, expected images without a rung "
                f"or of a rung that is the base view; these are of: {shown}"
            )

    @cached_property
    def labelled(self) -> Dataset | CocoDataset:
        """The labelled images."""
        return open_labelled(self.source)

    @cached_property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the first image, which all others must have."""
        height, width = self.labelled.image(0).shape[:2]
        return width, height

    @cached_property
    def rungs(self) -> tuple[tuple[Condition, int], ...]:
        """Every rung as its condition and its position within the condition, in the order of the images."""
        chosen = [c for c in self.suite.conditions if is_degradation(c) and (not self.only or c.name in self.only)]
        return tuple((c, step) for c in chosen for step in range(len(c.rungs)))

    @cached_property
    def bases(self) -> tuple[int, ...]:
        """The positions of the labelled images that are degraded."""
        truth = self.labelled.truth
        groups = zip(truth.condition.tolist(), truth.rung.tolist(), strict=True)
        return tuple(n for n, (name, rung) in enumerate(groups) if shows_base_view(self.suite, name, rung))

    @cached_property
    def designs(self) -> dict[int, Patch]:
        """The designs that the labelled images tell, by ID."""
        found = {}
        for content in self.labelled.config.get("patches", ()):
            try:
                found[content["id"]] = parse_patch(content, str(self.source))
            except DesignError:  # a name without a design
                continue
        return found

    @property
    def n(self) -> int:
        """Number of images: the labelled images, and rungs x degraded images."""
        return len(self.labelled) + len(self.rungs) * len(self.bases)

    @property
    def image_bytes(self) -> int:
        """Expected size of one image on disk."""
        return int(0.6 * self.size_px[0] * self.size_px[1] * self.channels)

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in self.__dataclass_fields__}

    def to_dict(self) -> dict[str, Any]:
        """Return the config that is written into the dataset. It tells the labelled images without their path."""
        of: Mapping[str, Any] = self.labelled.config
        source = image_source(of)
        conditions = {c.name: c for c, _ in self.rungs}.values()
        return {
            "kind": "degraded",
            **({"source": source} if source else {}),
            "suite": self.suite.name,
            "n": self.n,
            "seed": self.seed,
            "size_px": list(self.size_px),
            "channels": self.channels,
            "shard_size": self.shard_size,
            "conditions": [describe_condition(c) for c in conditions],
            **{key: of[key] for key in ("patches", "board") if key in of},
            "of": {"fingerprint": self.labelled.fingerprint, "config": dict(of)},
        }

    def _locate(self, index: int) -> tuple[int, Condition | None, int]:
        """Return the position of the labelled image, its condition (None for the image as it is), and the step."""
        if index < len(self.labelled):
            return index, None, 0
        rung, base = divmod(index - len(self.labelled), len(self.bases))
        return self.bases[base], *self.rungs[rung]

    @property
    def most_keypoints(self) -> int:
        """Largest number of keypoints of a labelled image."""
        return int(np.diff(self.labelled.truth.offsets).max())

    def scene_id(self, index: int) -> int:
        """Return the scene of an image, which is that of the labelled image."""
        return int(self.labelled.truth.scene_id[self._locate(index)[0]])

    def make(self, index: int) -> tuple[Sample, tuple[str, ...]]:
        """Make one image. The result is a function of the config, the index and the labelled images.

        Raises
        ------
        DataError
            If the labelled image cannot be read, or has another size than the first one.
        """
        position, condition, step = self._locate(index)
        truth, scene = self.labelled.truth, self.scene_id(index)
        image, keypoints = self._read(position), self._keypoints(position)
        effects = self.labelled.effects(position)
        if condition is None:
            name, rung = str(truth.condition[position]), float(truth.rung[position])
            return Sample(index, image, keypoints, effects, condition=name, rung=rung, scene_id=scene), ()
        rng, discs = stage_rng(self.seed, scene, SUITE_EFFECT), discs_of(keypoints)
        added = [draw_effect(rng, name, levels[step], self.size_px, discs) for name, levels in condition.effects]
        image = apply_effects(image, stage_rng(self.seed, scene, SUITE_FIELD), added)
        keypoints = self._update(image, keypoints, added)
        rung = condition.rungs[step]
        return Sample(
            index, image, keypoints, [*effects, *added], condition=condition.name, rung=rung, scene_id=scene
        ), ()

    def _read(self, position: int) -> UInt8:
        image = self.labelled.image(position)
        height, width = image.shape[:2]
        if (width, height) != self.size_px:
            image_id, expected = self.labelled.truth.image_id[position], "{} x {}".format(*self.size_px)
            raise DataError(
                f"{self.source}: image_id {image_id} is {width} x {height}, expected {expected} as the first"
            )
        if self.channels == 1:
            return to_grey(image)
        return image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), np.uint8)

    def _keypoints(self, position: int) -> NDArray[Any]:
        """Return the true keypoints of a labelled image, and then its ignored ones."""
        keypoints = self.labelled.keypoints(position)
        if self.labelled.truth.ignored is None:
            return keypoints
        parts = [np.zeros(len(part), LABELLED_KEYPOINT_DTYPE) for part in (keypoints, self.labelled.ignored(position))]
        for table, part in zip(parts, (keypoints, self.labelled.ignored(position)), strict=True):
            for name in part.dtype.names or ():
                table[name] = part[name]
        parts[1]["sigma_x"] = parts[1]["sigma_y"] = np.inf
        return np.concatenate(parts)

    def _update(self, image: UInt8, keypoints: NDArray[Any], effects: list[Effect]) -> NDArray[Any]:
        """Return the truth in a degraded image: no effect moves it, but ``visible`` and ``contrast`` change.

        The contrast is nan where the labels do not tell the design or its homography.
        """
        keypoints = keypoints.copy()
        H = keypoints["H_patch2image"]
        has_map = np.any(H != 0, axis=(1, 2))
        is_known = has_map & np.array([int(k) in self.designs for k in keypoints["patch_id"]], bool)
        H = np.where(has_map[:, None, None], H, _ellipse_maps(keypoints))
        stand_in = shipped_patches()[0]  # all discs are unit discs, whatever the design
        patches = [self.designs.get(int(k), stand_in) for k in keypoints["patch_id"]]
        masks = rasterise_patches([Placement(patch, h, 0, 255) for patch, h in zip(patches, H, strict=True)])
        keypoints["visible"] *= unoccluded_fraction(image, effects, masks)
        keypoints["contrast"] = np.where(is_known, measure_contrast(image, masks), np.nan)
        return keypoints


def is_degradation(condition: Condition) -> bool:
    """Return whether a condition consists of effects on an image alone: no view, camera, film or board of its own."""
    c = condition
    own = c.pose or c.camera or c.film or c.clutter or c.paper_px2 or c.board != "hexagon"
    return bool(condition.effects) and not own


def shows_base_view(suite: Suite, condition: str, rung: float) -> bool:
    """Return whether an image of a condition and rung may be degraded, see :class:`DegradeConfig`.

    Examples
    --------
    >>> from kpbench import load_suite
    >>> from kpbench.synth.degraded import shows_base_view
    >>> [shows_base_view(load_suite("paper-v1"), "scale", rung) for rung in (8, 16)]
    [False, True]
    """
    if condition not in POSE_CONDITIONS:
        return condition in FREE_CONDITIONS
    low, high = dict(suite.scene)[POSE_CONDITIONS[condition]]
    return low <= rung <= high


def _ellipse_maps(keypoints: NDArray[Any]) -> Float:
    """Return maps of the unit disc to the ellipses of keypoints, shape (n, 3, 3)."""
    c, s = cos_sin(np.radians(keypoints["axis_angle"].astype(np.float64)))
    major, minor = (keypoints[name].astype(np.float64) for name in ("radius_major", "radius_minor"))
    zero, one = np.zeros(len(keypoints)), np.ones(len(keypoints))
    rows = [[major * c, -minor * s, keypoints["x"]], [major * s, minor * c, keypoints["y"]], [zero, zero, one]]
    return np.moveaxis(np.array(rows, np.float64), 2, 0)
