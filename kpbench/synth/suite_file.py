"""Suites as TOML files: the camera, the ranges of the scenes, and the conditions with their rungs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from kpbench.camera.preset import QUANTITIES, TONES, WHOLE, CameraPreset, parse_preset
from kpbench.degrade.ladder import LADDER
from kpbench.errors import DataError
from kpbench.files import find_shipped, shipped_files
from kpbench.geometry.camera import Camera
from kpbench.patches.board_file import find_patch
from kpbench.patches.design import Patch, shipped_patches
from kpbench.synth.film import FILM_BOUNDS, FILM_KEYS, FilmPlan
from kpbench.toml import TomlTable, name_source, read_toml

SUITE_SCHEMA = "kpbench.suite/1"
SUITE_KEYS = ("schema", "name", "images", "patches", "camera", "scene", "condition", "film")
CONDITION_KEYS = ("name", "unit", "rungs", "pose", "effects", "camera", "board", "film", "clutter", "paper_px2")
BOARDS = ("hexagon", "single")
"""Boards of patches of a condition: :func:`kpbench.hexagon_board`, or one patch almost as large as the board."""
MOST_CLUTTER = 10_000
"""Largest number of look-alikes per megapixel."""
SCENE_KEYS = {
    "area_percent": (0.01, 90.0),
    "pitch_deg": (-80.0, 80.0),
    "yaw_deg": (-80.0, 80.0),
    "roll_deg": (0.0, 360.0),
    "shift_x": (-0.5, 0.5),
    "shift_y": (-0.5, 0.5),
    "white": (0.0, 255.0),
    "black": (0.0, 255.0),
    "edge": (0.0, 1.0),
    "light": (0.0, 1.0),
    "slope_x": (-1.0, 1.0),
    "slope_y": (-1.0, 1.0),
    "shadow": (0.0, 1.0),
}
"""Quantities that are drawn for a scene, and the range of values that a suite may set for each quantity.

:func:`kpbench.render.pose_board` explains the pose. :class:`kpbench.render.Appearance` explains the inks and the light.
"""

CAMERA_BOUNDS = {key: bounds[:2] for table in QUANTITIES.values() for key, bounds in table.items()}
"""Range of the values that a condition may set for each quantity of a camera."""
Levels = tuple[tuple[str, tuple[float, ...]], ...]
"""Names of quantities or effects, each with one value per rung."""
CameraLevels = tuple[tuple[str, tuple[float | str | bool, ...]], ...]
"""Quantities of the camera, each with one value per rung."""


@dataclass(frozen=True)
class Condition:
    """One experiment of a suite.

    Attributes
    ----------
    name, unit : str
    rungs : tuple of float
        Severities from mild to severe, in ``unit``.
    pose : tuple of (str, tuple of float)
        Quantities of the scene that the condition sets, each with one value per rung.
    effects : tuple of (str, tuple of float)
        Effects in the order in which they are applied, each with one level per rung.
    camera : tuple of (str, tuple of float, str or bool)
        Quantities of the camera that the condition sets, each with one value per rung: those of
        :data:`kpbench.camera.preset.QUANTITIES`, ``tone`` and ``bayer``.
    board : {"hexagon", "single"}
        See :data:`BOARDS`.
    film : tuple of (str, tuple of float)
        Quantities of :data:`kpbench.synth.film.FILM_KEYS`, each with one value per rung; empty if the suite has no
        films.
    clutter : tuple of float
        Look-alikes on the background, per megapixel of the image, one value per rung; empty for none.
    paper_px2 : tuple of float
        Printed area per keypoint, px², one value per rung: the board is as near as this needs, see
        :func:`kpbench.synth.suite_boards.printed_share`. Empty: the scene's ``area_percent`` sets the distance.

    Examples
    --------
    >>> from kpbench import load_suite
    >>> blur = load_suite("paper-v1").conditions[2]
    >>> blur.rungs, blur.effects
    ((3.0, 7.0, 11.0, 15.0), (('blur', (3.0, 7.0, 11.0, 15.0)),))
    """

    name: str
    unit: str
    rungs: tuple[float, ...]
    pose: Levels
    effects: Levels
    camera: CameraLevels = ()
    board: str = "hexagon"
    film: Levels = ()
    clutter: tuple[float, ...] = ()
    paper_px2: tuple[float, ...] = ()


@dataclass(frozen=True)
class Suite:
    """The content of a suite's file.

    Attributes
    ----------
    name : str
    images : int
        Number of base scenes.
    patches : tuple of Patch
    size_px : (int, int)
        Width and height of the camera's images.
    lens_mm : float
        Focal length.
    pixel_um : float
        Side of a pixel.
    scene : tuple of (str, (float, float))
        Name, least value and greatest value of each quantity that is drawn for a scene, see :data:`SCENE_KEYS`.
    conditions : tuple of Condition
    preset : CameraPreset or None
        The camera that takes the images, in linear light. None: a linear world, in which inks keep their levels.
    film : FilmPlan or None
        Every base scene is a film. None: every base scene is one image.

    Examples
    --------
    >>> from kpbench import load_suite
    >>> camera = load_suite("paper-v1").camera((812, 620))
    >>> round(camera.focal_px)
    444
    """

    name: str
    images: int
    patches: tuple[Patch, ...]
    size_px: tuple[int, int]
    lens_mm: float
    pixel_um: float
    scene: tuple[tuple[str, tuple[float, float]], ...]
    conditions: tuple[Condition, ...]
    preset: CameraPreset | None = None
    film: FilmPlan | None = None

    def camera(self, size_px: tuple[int, int] | None = None, distortion: tuple[float, ...] = ()) -> Camera:
        """Return the camera of the suite, or a camera of another image size with the same horizontal field of view.

        Parameters
        ----------
        size_px : (int, int), optional
            Width and height of the image. None: the suite's own size.
        distortion : tuple of float
            Up to five of OpenCV's coefficients k1, k2, p1, p2, k3; missing coefficients are 0.
        """
        width, height = size_px or self.size_px
        focal_px = self.lens_mm / (self.pixel_um / 1000) * width / self.size_px[0]
        k1, k2, p1, p2, k3 = (*distortion, *(0.0,) * (5 - len(distortion)))
        return Camera(width, height, focal_px, (k1, k2, p1, p2, k3))


def shipped_suites() -> dict[str, Path]:
    """Return the files of the suites that ship with kpbench, keyed by the suites' names.

    Examples
    --------
    >>> from kpbench.synth import shipped_suites
    >>> list(shipped_suites())
    ['camera-v1', 'extended-v1', 'extended-v2', 'paper-v1', 'video-v1']
    """
    return shipped_files("suites")


def load_suite(name: str) -> Suite:
    """Read a suite.

    Parameters
    ----------
    name : str
        Name of a shipped suite, or path of a TOML file.

    Raises
    ------
    DataError
        If there is no such suite, or a value in its file is wrong. The message names the file, the key and the
        expected value.

    Examples
    --------
    >>> from kpbench import load_suite
    >>> [condition.name for condition in load_suite("paper-v1").conditions]
    ['scale', 'pitch', 'blur', 'dimming', 'noise']
    """
    path = find_shipped("suites", name, "suite")
    content = read_toml(path, DataError)
    with name_source(path, DataError):
        return _parse_suite(TomlTable(content, SUITE_KEYS, DataError))


def _parse_suite(table: TomlTable) -> Suite:
    table.require_schema(SUITE_SCHEMA)
    camera = table.table("camera", ("size_px", "lens_mm", "pixel_um", *QUANTITIES))
    scene = table.table("scene", SCENE_KEYS)
    table.entries("condition", "a list of tables")
    conditions = tuple(_parse_condition(entry) for entry in table.tables("condition", CONDITION_KEYS))
    names = [c.name for c in conditions]
    if len(set(names)) < len(names):
        raise DataError(f"two conditions share a name, among: {', '.join(names)}")
    film = FilmPlan.parse(table.table("film", ("frames", "fps", "exposure", "occluded"))) if "film" in table else None
    if any(bool(c.film) != (film is not None) for c in conditions):
        raise DataError("expected a table `film` in the suite and in every condition, or in none")
    has_preset = film is not None or any(key in camera for key in QUANTITIES) or any(c.camera for c in conditions)
    width, height = camera.numbers("size_px", 64, 16384, 2, whole=True)
    return Suite(
        name=table.name(),
        images=table.whole_number("images", 1, 1_000_000),
        patches=tuple(find_patch(shipped_patches(), key) for key in table.entries("patches", "a list of names or ids")),
        size_px=(int(width), int(height)),
        lens_mm=camera.number("lens_mm", 0.01, 1e4),
        pixel_um=camera.number("pixel_um", 0.01, 1e3),
        scene=tuple((key, scene.span(key, *bounds)) for key, bounds in SCENE_KEYS.items()),
        conditions=conditions,
        preset=parse_preset(camera, table.name()) if has_preset else None,
        film=film,
    )


def _parse_condition(table: TomlTable) -> Condition:
    table.entries("rungs", "a list of numbers")
    rungs = table.numbers("rungs", -1e6, 1e6)
    pose = table.table("pose", SCENE_KEYS, {})
    effects = table.table("effects", LADDER, {})
    camera = table.table("camera", (*CAMERA_BOUNDS, "tone", "bayer"), {})
    film = table.table("film", FILM_KEYS, {})
    return Condition(
        name=table.name(),
        unit=table.text("unit"),
        rungs=rungs,
        pose=tuple((key, pose.numbers(key, *SCENE_KEYS[key], len(rungs))) for key in pose.values),
        effects=tuple((key, effects.numbers(key, *LADDER[key].bounds, len(rungs))) for key in effects.values),
        camera=tuple((key, _parse_camera_levels(camera, key, len(rungs))) for key in camera.values),
        board=table.choice("board", BOARDS, "hexagon"),
        film=tuple((key, film.numbers(key, *FILM_BOUNDS[key], len(rungs))) for key in FILM_KEYS if film.values),
        clutter=table.numbers("clutter", 0, MOST_CLUTTER, len(rungs)) if "clutter" in table else (),
        paper_px2=table.numbers("paper_px2", 1, 1e7, len(rungs)) if "paper_px2" in table else (),
    )


def _parse_camera_levels(camera: TomlTable, key: str, count: int) -> tuple[float | str | bool, ...]:
    if key not in ("tone", "bayer"):
        low, high = CAMERA_BOUNDS[key]
        return camera.numbers(key, low, high, count, key in WHOLE)
    expected = f"a list of {count} " + ("times true or false" if key == "bayer" else f"of: {', '.join(TONES)}")
    values = camera.entries(key, expected)
    if len(values) != count or not all(isinstance(v, bool) if key == "bayer" else v in TONES for v in values):
        raise camera.problem(key, expected)
    return tuple(values)
