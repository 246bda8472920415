"""Suites: the configuration that determines every image of a benchmark suite, and how one image is made.

Image and truth depend only on the suite, the boards, the seed, the size, the lens and the background files.
A base scene consists of background, pose, inks and light. Every base scene is shown with every patch under every
rung. All images of a base scene share their ``scene_id`` and the random numbers of the effects. Comparisons between
patches or rungs are therefore paired.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from kpbench.camera.preset import CameraPreset
from kpbench.dataset.shard import Sample
from kpbench.degrade.ladder import draw_effect
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.patches.board import BoardLike
from kpbench.patches.tag_boards import TAG_BOARDS, tag_board
from kpbench.render.background import Background, PhotoFolder, describe_backgrounds, procedural_background
from kpbench.render.board_projection import Pose, pose_board
from kpbench.render.board_view import Appearance, board_keypoints, render_board
from kpbench.render.lookalikes import draw_lookalikes
from kpbench.seeds import (
    SUITE_BACKGROUND,
    SUITE_CAMERA,
    SUITE_CLUTTER,
    SUITE_EFFECT,
    SUITE_FIELD,
    SUITE_FILM,
    SUITE_SCENE,
    SUITE_SENSOR,
    stage_rng,
)
from kpbench.synth.camera_view import expose_board, needs_colour, photograph_board
from kpbench.synth.film import FILM_KEYS, draw_bar, draw_path, film_record
from kpbench.synth.finish import degrade_scene, discs_of
from kpbench.synth.suite_boards import BOARD_SIDE_MM, disc_outline, printed_share, suite_boards
from kpbench.synth.suite_file import Condition, Suite
from kpbench.synth.suite_view import View
from kpbench.text import did_you_mean
from kpbench.types import Float


@dataclass(frozen=True)
class SuiteConfig:
    """Configuration of a suite. The configuration and the background files determine every image.

    Attributes
    ----------
    suite : Suite
    images : int or None
        Number of base scenes; None for the suite's own number. A smaller number makes only the first base scenes.
    seed : int
        0 or more.
    size_px : (int, int) or None
        Width and height; None for the size of the calibration, if any, or the suite's own size. Without a calibration,
        the horizontal field of view does not depend on ``size_px``.
    only : tuple of str
        Names of the conditions to make; an empty tuple makes all conditions.
    backgrounds : Path or None
        Folder of photographs, or None for procedural backgrounds.
    distortion : tuple of float
        Up to five of OpenCV's coefficients k1, k2, p1, p2, k3; missing coefficients are 0.
    board : str or None
        Name of a board of tags in :data:`kpbench.patches.TAG_BOARDS`, which replaces the boards of patches. None:
        boards of patches.
    shard_size : int
        Images per shard; changes the files but no image.
    preset : CameraPreset or None
        A camera from :func:`kpbench.camera.load_camera_preset` that takes the images in linear light, in the place of
        the suite's own. Conditions of the suite may set some of its quantities. None: the suite's own camera.

    Raises
    ------
    DataError
        If a value is out of its range or a condition is unknown.

    Examples
    --------
    >>> from kpbench import SuiteConfig, load_suite
    >>> config = SuiteConfig(load_suite("paper-v1"), images=2, size_px=(203, 155), only=("blur",))
    >>> config.n  # 4 rungs x 4 patches x 2 scenes
    32
    >>> sample, broken_files = config.make(31)
    >>> sample.condition, sample.rung, sample.effects
    ('blur', 15.0, [{'effect': 'blur', 'kernel_px': 15.0}])
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
    preset: CameraPreset | None = None

    def __post_init__(self) -> None:
        width, height = self.camera.width_px, self.camera.height_px
        for is_valid, problem in (
            (
                1 <= self.scenes <= 10**6,
                f"`images` is {self.scenes}, expected a number of scenes from 1 to 1,000,000",
            ),
            (self.seed >= 0, f"`seed` is {self.seed}, expected a whole number from 0"),
            (min(width, height) >= 64, f"`size_px` is {width}x{height}, expected at least 64x64"),
            (max(width, height) <= 16384, f"`size_px` is {width}x{height}, at most 16384 a side"),
            (self.shard_size >= 1, f"`shard_size` is {self.shard_size}, expected a number of images from 1"),
            (
                self.board in (None, *TAG_BOARDS),
                f"`board` is {self.board}, expected one of: {', '.join(TAG_BOARDS)}",
            ),
            (
                self.preset is None or not self.distortion,
                "`preset` and `distortion` are both given, expected one of them",
            ),
        ):
            if not is_valid:
                raise DataError(problem)
        known = [c.name for c in self.suite.conditions]
        for name in self.only:
            if name not in known:
                problem = f"{self.suite.name} has no condition {name!r}, only: {', '.join(known)}"
                raise DataError(problem + did_you_mean(name, known))
        _ = self.presets  # raises an error if a rung's camera is impossible

    @property
    def scenes(self) -> int:
        """Number of base scenes."""
        return self.suite.images if self.images is None else self.images

    @cached_property
    def camera(self) -> Camera:
        """The camera at the configured size."""
        if self.preset is not None and self.preset.calibration is not None:
            calibration = self.preset.calibration
            return calibration.at_size(*self.size_px) if self.size_px else calibration
        return self.suite.camera(self.size_px, self.distortion)

    @cached_property
    def rungs(self) -> tuple[tuple[Condition, int], ...]:
        """Every rung as its condition and its position within the condition, in the order of the images."""
        chosen = [c for c in self.suite.conditions if not self.only or c.name in self.only]
        return tuple((c, n) for c in chosen for n in range(len(c.rungs)))

    @cached_property
    def presets(self) -> tuple[CameraPreset | None, ...]:
        """The camera of every rung."""
        preset = self.preset or self.suite.preset
        if preset is None:
            return (None,) * len(self.rungs)
        return tuple(preset.with_values({key: levels[n] for key, levels in c.camera}) for c, n in self.rungs)

    @cached_property
    def boards(self) -> tuple[BoardLike, ...]:
        """The boards. Every base scene is shown with each board under every rung, or with boards of a single patch."""
        return suite_boards(self.suite.patches, self.board, "mixed" if self.suite.film else "hexagon")

    @cached_property
    def _single_boards(self) -> tuple[BoardLike, ...]:
        """The boards of a single patch; boards of tags stay as they are."""
        return suite_boards(self.suite.patches, self.board, "single")

    @property
    def name(self) -> str:
        """Name of the suite, followed by the name of the board of tags if there is one."""
        return self.suite.name if self.board is None else f"{self.suite.name}-{self.board}"

    @property
    def n(self) -> int:
        """Number of images: rungs x boards x scenes x frames."""
        return len(self.rungs) * len(self.boards) * self.scenes * self._frames

    @property
    def _frames(self) -> int:
        """Images of a base scene under one rung."""
        return self.suite.film.frames if self.suite.film else 1

    @property
    def image_bytes(self) -> int:
        """Expected size of one image on disk."""
        return int(0.6 * self.camera.width_px * self.camera.height_px)

    @property
    def most_keypoints(self) -> int:
        """Largest number of keypoints of a board."""
        return max(len(board.keypoints) for board in self.boards)

    @cached_property
    def photos(self) -> PhotoFolder | None:
        """The opened folder of photographs; None for procedural backgrounds."""
        return None if self.backgrounds is None else PhotoFolder.open(self.backgrounds)

    @cached_property
    def _background_cache(self) -> dict[tuple[int, int], Background]:
        """Backgrounds by base scene and number of channels."""
        return {}

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key not in ("photos", "_background_cache")}

    def to_dict(self) -> dict[str, Any]:
        """Return the config that is written into the dataset.

        The config holds no path, so that a moved background folder gives the same bytes.
        """
        camera, conditions = self.camera, {c.name: c for c, _ in self.rungs}.values()
        preset = self.preset or self.suite.preset
        targets: dict[str, Any] = {"patches": [patch.to_dict() for patch in self.suite.patches]}
        if self.board is not None:
            targets = {"board": tag_board(self.board, BOARD_SIDE_MM).to_dict()}
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
            "backgrounds": describe_backgrounds(self.photos),
            "scene": {key: list(span) for key, span in self.suite.scene},
            "conditions": [describe_condition(c) for c in conditions],
            **({} if preset is None else {"preset": preset.to_dict()}),
            **({} if self.suite.film is None else {"film": self.suite.film.to_dict()}),
            **targets,
        }

    def scene_id(self, index: int) -> int:
        """Return the base scene of an image. Images are ordered by condition, rung, board, base scene and frame."""
        return index // self._frames % self.scenes

    def view(self, index: int) -> View:
        """Draw pose, inks, light and effects of one image, and compute the truth. Nothing is painted.

        Parameters
        ----------
        index : int
            0 to n − 1.
        """
        scene_id = self.scene_id(index)
        rung, which_board = divmod(index // self._frames // self.scenes, len(self.boards))
        condition, step = self.rungs[rung]
        board = (self._single_boards if condition.board == "single" else self.boards)[which_board]
        rng = stage_rng(self.seed, scene_id, SUITE_SCENE)
        drawn = {key: float(rng.uniform(*span)) for key, span in self.suite.scene}
        drawn |= {key: values[step] for key, values in condition.pose}
        if condition.paper_px2:
            board_px2 = condition.paper_px2[step] / printed_share(board)
            drawn["area_percent"] = 100 * board_px2 / (self.camera.width_px * self.camera.height_px)
        preset = self.presets[rung]
        taken = None if preset is None else preset.draw(stage_rng(self.seed, scene_id, SUITE_CAMERA))
        camera = replace(self.camera, distortion=(taken["k1"], 0.0, 0.0, 0.0)) if taken and taken["k1"] else self.camera
        inside_mm = disc_outline(board) if condition.board == "single" else None
        film, frame, record = self.suite.film, index % self._frames, None
        if film is None:
            pose = _pose(camera, board, drawn, inside_mm)
        else:
            rates = {key: levels[step] * (film.fps if key == "speed_px" else 1) for key, levels in condition.film}
            moves = stage_rng(self.seed, scene_id, SUITE_FILM)
            path = draw_path(moves, camera, board, drawn["area_percent"], **{k: rates[k] for k in FILM_KEYS})
            pose = path.pose(frame / film.fps)
            record = film_record(film, frame, pose)
        appearance = Appearance(
            drawn["black"],
            drawn["white"],
            drawn["edge"],
            drawn["light"],
            slope=(drawn["slope_x"], drawn["slope_y"]),
            shadow=drawn["shadow"],
        )
        exposed = expose_board(board, pose, camera, taken) if taken else None
        if exposed and film:
            exposed = replace(exposed, motion=path.motion(frame / film.fps, film.exposure / film.fps))
        keypoints = exposed.keypoints(camera) if exposed else board_keypoints(camera, pose, board)
        rng, size_px = stage_rng(self.seed, scene_id, SUITE_EFFECT), (self.camera.width_px, self.camera.height_px)
        discs = discs_of(keypoints)
        effects = [draw_effect(rng, name, levels[step], size_px, discs) for name, levels in condition.effects]
        if film:
            effects += draw_bar(moves, film, frame, camera, board, pose)
        what = (condition.name, condition.rungs[step], scene_id)
        return View(*what, board, pose, appearance, effects, keypoints, camera, exposed, taken, record)

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
        view = self.view(index)
        taken = view.taken
        background = self._find_background(view.scene_id, 3 if taken and needs_colour(taken) else 1)
        background = self._add_clutter(background, index, view.scene_id)
        if taken and view.exposed:
            shot = view.scene_id * self._frames + index % self._frames
            rng = stage_rng(self.seed, shot, SUITE_SENSOR)
            clean = photograph_board(background.image, view.camera, view.exposed, view.appearance, rng, taken)
        else:
            clean = render_board(background.image, self.camera, view.pose, view.board, view.appearance)
        scene = degrade_scene(clean, stage_rng(self.seed, view.scene_id, SUITE_FIELD), view.effects)
        sample = Sample(
            index,
            scene.image,
            scene.keypoints,
            [record for record in (view.frame, taken, *view.effects) if record],
            background.file,
            condition=view.condition,
            rung=view.rung,
            scene_id=view.scene_id,
        )
        return sample, background.broken_files

    def _add_clutter(self, background: Background, index: int, scene_id: int) -> Background:
        """Return the background with the look-alikes of the image's rung."""
        condition, step = self.rungs[index // self._frames // self.scenes // len(self.boards)]
        if not condition.clutter:
            return background
        image, rng = background.image.copy(), stage_rng(self.seed, scene_id, SUITE_CLUTTER)
        height, width = image.shape[:2]
        draw_lookalikes(image, rng, round(condition.clutter[step] * width * height / 1e6), self.suite.patches)
        return replace(background, image=image)

    def _find_background(self, scene_id: int, channels: int) -> Background:
        """Return the background of a base scene from the cache, or make the background.

        A base scene is used again under every rung. The cache holds as many backgrounds as a shard has images.
        """
        key = (scene_id, channels)
        if key in self._background_cache:
            return self._background_cache[key]
        rng = stage_rng(self.seed, scene_id, SUITE_BACKGROUND)
        width, height = self.camera.width_px, self.camera.height_px
        if self.photos is None:
            background = Background(procedural_background(rng, width, height, channels))
        else:
            background = self.photos.sample(rng, width, height, channels)
        if len(self._background_cache) >= self.shard_size:
            del self._background_cache[next(iter(self._background_cache))]
        self._background_cache[key] = background
        return background


def _pose(camera: Camera, board: BoardLike, drawn: dict[str, float], inside_mm: Float | None) -> Pose:
    angles = {key: drawn[key] for key in ("pitch_deg", "yaw_deg", "roll_deg")}
    shift = drawn["shift_x"], drawn["shift_y"]
    return pose_board(camera, board, drawn["area_percent"], **angles, shift=shift, inside_mm=inside_mm)


def describe_condition(condition: Condition) -> dict[str, Any]:
    """Return a condition for the config; the effects are a list, because their order matters."""
    pose = {key: list(values) for key, values in condition.pose}
    effects = [[name, list(levels)] for name, levels in condition.effects]
    described = {"name": condition.name, "rungs": list(condition.rungs), "pose": pose, "effects": effects}
    if condition.film:
        described["film"] = {key: list(values) for key, values in condition.film}
    if condition.camera:
        described["camera"] = {key: list(values) for key, values in condition.camera}
    for key in ("clutter", "paper_px2"):
        if values := getattr(condition, key):
            described[key] = list(values)
    return described | ({} if condition.board == "hexagon" else {"board": condition.board})
