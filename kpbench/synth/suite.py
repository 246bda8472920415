"""Suites: the benchmark's experiments as data, and the recipe of every image in them.

A suite is a TOML file (``benchmarks/suites``): a camera, what a scene may look like, and conditions with
their rungs. Image and truth are a function of (suite, seed, size, lens, background files) and of nothing
else. One base scene - background, pose, inks, light - is seen with every patch under every rung, and its
images share their ``scene_id``; so do the random numbers of the effects. Comparisons are paired.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.dataset.shard import Sample
from kpbench.degrade.ladder import apply, climb
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.patches.board import BoardLike, hexagon_board
from kpbench.patches.design import shipped_patches
from kpbench.patches.tag_boards import TAG_BOARDS, tag_board
from kpbench.render.background import Background, PhotoFolder, procedural
from kpbench.render.board_view import Look, Pose, board_keypoints, pose_board, render_board
from kpbench.render.scene import measure_contrast
from kpbench.seeds import SUITE_BACKGROUND, SUITE_EFFECT, SUITE_FIELD, SUITE_SCENE, stream
from kpbench.synth.finish import share_open
from kpbench.synth.suite_file import Condition, Suite
from kpbench.types import Float

BOARD_SIDE_MM = 187.5  # a disc of 30 mm


@dataclass(frozen=True)
class Shot:
    """What one image of a suite will show, before anything is painted."""

    condition: str
    rung: float
    scene: int
    board: BoardLike
    pose: Pose
    look: Look
    effects: list[dict[str, Any]]
    keypoints: NDArray[Any]


@dataclass(frozen=True)
class SuiteConfig:
    """All that a suite's images are a function of, besides the background files.

    Attributes
    ----------
    suite : Suite
    images : base scenes; None for the suite's own number. Fewer are the first of more.
    seed : any whole number from 0.
    size_px : (width, height); None for the suite's own. The field of view stays.
    only : names of conditions; empty for all.
    backgrounds : folder of photographs, or None for procedural ones.
    distortion : OpenCV's k1, k2, p1, p2, k3; what is left out is 0.
    board : one of :data:`kpbench.patches.TAG_BOARDS` in the place of the suite's boards of patches, or None.
    shard_size : images a shard; changes the files but no image.

    Raises
    ------
    DataError
        If a value is out of its range or a condition is not known.
    """

    suite: Suite
    images: int | None = None
    seed: int = 0
    size_px: tuple[int, int] | None = None
    only: tuple[str, ...] = ()
    backgrounds: Path | None = None
    distortion: tuple[float, ...] = ()
    board: str | None = None
    shard_size: int = 100  # 200 MB of pixels at 1624x1240

    def __post_init__(self) -> None:
        def need(good: bool, what: str) -> None:
            if not good:
                raise DataError(what)

        width, height = self.camera.width_px, self.camera.height_px
        need(1 <= self.scenes <= 10**6, f"--images is {self.scenes}, expected a number of scenes from 1 to 1,000,000")
        need(self.seed >= 0, f"--seed is {self.seed}, expected a whole number from 0")
        need(min(width, height) >= 64, f"--size is {width}x{height}, expected at least 64x64")
        need(max(width, height) <= 16384, f"--size is {width}x{height}, at most 16384 a side")
        need(self.shard_size >= 1, f"the shard size is {self.shard_size}, expected a number of images from 1")
        need(self.board in (None, *TAG_BOARDS), f"--board is {self.board}, expected one of: {', '.join(TAG_BOARDS)}")
        known = [c.name for c in self.suite.conditions]
        for name in self.only:
            need(name in known, f"{self.suite.name} has no condition {name!r}, only: {', '.join(known)}")

    @property
    def scenes(self) -> int:
        """Number of base scenes."""
        return self.suite.images if self.images is None else self.images

    @cached_property
    def camera(self) -> Camera:
        """The camera at the size asked for."""
        return self.suite.camera(self.size_px, self.distortion)

    @cached_property
    def rungs(self) -> tuple[tuple[Condition, int], ...]:
        """Every rung in the order of the images, as (condition, position in it)."""
        chosen = [c for c in self.suite.conditions if not self.only or c.name in self.only]
        return tuple((c, n) for c in chosen for n in range(len(c.rungs)))

    @cached_property
    def boards(self) -> tuple[BoardLike, ...]:
        """The boards that are seen in every scene under every rung."""
        if self.board is not None:
            return (tag_board(self.board, BOARD_SIDE_MM),)
        return tuple(hexagon_board(patch, BOARD_SIDE_MM) for patch in self.suite.patches)

    @property
    def name(self) -> str:
        """Of the suite, and of the board if it is not the suite's own."""
        return self.suite.name if self.board is None else f"{self.suite.name}-{self.board}"

    @property
    def n(self) -> int:
        """Number of images: rungs x boards x scenes."""
        return len(self.rungs) * len(self.boards) * self.scenes

    @property
    def image_bytes(self) -> int:
        """Expected size on disk of one image."""
        return int(0.6 * self.camera.width_px * self.camera.height_px)

    @cached_property
    def photos(self) -> PhotoFolder | None:
        """The listed background folder."""
        return None if self.backgrounds is None else PhotoFolder.open(self.backgrounds)

    @cached_property
    def _kept(self) -> dict[int, Background]:
        return {}

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key not in ("photos", "_kept")}

    def to_dict(self) -> dict[str, Any]:
        """What is written into the dataset: no path, so that a moved folder gives the same bytes."""
        photos, camera = self.photos, self.camera
        source: dict[str, Any] = {"kind": "procedural"}
        if photos is not None:
            source = {"kind": "photographs", "files": len(photos.files), "listing_sha256": photos.digest}
        conditions = {c.name: c for c, _ in self.rungs}.values()
        shown: dict[str, Any] = {"patches": [patch.to_dict() for patch in self.suite.patches]}
        if self.board is not None:
            shown = {"board": tag_board(self.board, BOARD_SIDE_MM).to_dict()}
        return {
            "kind": "suite",
            "suite": self.suite.name,
            "n": self.n,
            "images": self.scenes,
            "seed": self.seed,
            "size_px": [camera.width_px, camera.height_px],
            "focal_px": camera.focal_px,
            "distortion": list(camera.distortion),
            "shard_size": self.shard_size,
            "backgrounds": source,
            "scene": {key: list(span) for key, span in self.suite.scene},
            "conditions": [_listed(c) for c in conditions],
            **shown,
        }

    def scene(self, index: int) -> int:
        """The base scene of an image: images are ordered by condition, rung, board and scene."""
        return index % self.scenes

    def shot(self, index: int) -> Shot:
        """Pose, light, effects and truth of one image; nothing is painted."""
        scene = self.scene(index)
        rung, which = divmod(index // self.scenes, len(self.boards))
        condition, step = self.rungs[rung]
        rng = stream(self.seed, scene, SUITE_SCENE)
        drawn = {key: float(rng.uniform(*span)) for key, span in self.suite.scene}
        drawn |= {key: values[step] for key, values in condition.pose}
        tilt = {key: drawn[key] for key in ("pitch_deg", "yaw_deg", "roll_deg")}
        board = self.boards[which]
        shift = (drawn["shift_x"], drawn["shift_y"])
        pose = pose_board(self.camera, board, drawn["area_percent"], shift=shift, **tilt)
        slope = (drawn["slope_x"], drawn["slope_y"])
        look = Look(drawn["black"], drawn["white"], drawn["edge"], drawn["light"], slope, drawn["shadow"])
        keypoints = board_keypoints(self.camera, pose, board)
        discs = np.column_stack([keypoints["x"], keypoints["y"], keypoints["radius_major"].astype(np.float64)])
        rng = stream(self.seed, scene, SUITE_EFFECT)
        size = (self.camera.width_px, self.camera.height_px)
        effects = [climb(rng, name, levels[step], size, discs) for name, levels in condition.effects]
        return Shot(condition.name, condition.rungs[step], scene, board, pose, look, effects, keypoints)

    def make(self, index: int) -> tuple[Sample, tuple[str, ...]]:
        """Image ``index``, and the broken background files met on the way."""
        shot = self.shot(index)
        background = self._background(shot.scene)
        clean = render_board(background.image, self.camera, shot.pose, shot.board, shot.look)
        image = apply(clean.image, stream(self.seed, shot.scene, SUITE_FIELD), shot.effects)
        keypoints = clean.keypoints
        keypoints["visible"] *= share_open(image, shot.effects, clean.masks)
        keypoints["contrast"] = measure_contrast(image, clean.masks)
        sample = Sample(index, image, keypoints, shot.effects, background.file, shot.condition, shot.rung, shot.scene)
        return sample, background.broken

    def _background(self, scene: int) -> Background:
        """The background of a scene; as many as a shard holds are kept, as every scene comes back under each rung."""
        if scene in self._kept:
            return self._kept[scene]
        rng, (width, height) = stream(self.seed, scene, SUITE_BACKGROUND), (self.camera.width_px, self.camera.height_px)
        if self.photos is None:
            background = Background(procedural(rng, width, height))
        else:
            background = self.photos.sample(rng, width, height, 1)
        if len(self._kept) >= self.shard_size:
            del self._kept[next(iter(self._kept))]
        self._kept[scene] = background
        return background


def _listed(condition: Condition) -> dict[str, Any]:
    """A condition for the config; effects as a list, because their order counts."""
    pose = {key: list(values) for key, values in condition.pose}
    effects = [[name, list(levels)] for name, levels in condition.effects]
    return {"name": condition.name, "rungs": list(condition.rungs), "pose": pose, "effects": effects}


def board_in_view(config: Mapping[str, Any]) -> tuple[Float, Camera] | None:
    """The board that a suite's images show, from its dataset's config.

    Returns
    -------
    points_mm : ndarray of shape (K, 3)
        Its keypoints with z = 0, in the order of the truth.
    camera : Camera
        None in the place of both if the dataset is of no suite.
    """
    if config.get("kind") != "suite":
        return None
    width, height = config["size_px"]
    k1, k2, p1, p2, k3 = config["distortion"]
    camera = Camera(width, height, config["focal_px"], (k1, k2, p1, p2, k3))
    if "board" in config:
        return np.array([[x, y, 0.0] for _, x, y, _ in config["board"]["keypoints"]]), camera
    return hexagon_board(shipped_patches()[0], BOARD_SIDE_MM).points_mm, camera  # the same places whatever the patch
