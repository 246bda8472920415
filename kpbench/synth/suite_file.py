"""Suites as TOML files: which conditions, which rungs, which scenes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kpbench.degrade.ladder import LADDER
from kpbench.errors import DataError, DesignError
from kpbench.files import read_toml, shipped_folder
from kpbench.geometry.camera import Camera
from kpbench.patches.board import find_patch, keys, number
from kpbench.patches.design import Patch, shipped_patches

SCHEMA = "kpbench.suite/1"


SCENE_KEYS = {  # least and most that a suite may ask for
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


Levels = tuple[tuple[str, tuple[float, ...]], ...]


@dataclass(frozen=True)
class Condition:
    """One experiment: ``pose`` and ``effects`` list, by name, a value for each rung; effects are in order."""

    name: str
    unit: str
    rungs: tuple[float, ...]
    pose: Levels
    effects: Levels


@dataclass(frozen=True)
class Suite:
    """A suite as its file gives it; ``scene`` holds (least, most) of everything that is drawn for a scene."""

    name: str
    images: int
    patches: tuple[Patch, ...]
    size_px: tuple[int, int]
    lens_mm: float
    pixel_um: float
    scene: tuple[tuple[str, tuple[float, float]], ...]
    conditions: tuple[Condition, ...]

    def camera(self, size_px: tuple[int, int] | None = None, distortion: tuple[float, ...] = ()) -> Camera:
        """The camera at another image size with the same horizontal field of view."""
        width, height = size_px or self.size_px
        focal_px = self.lens_mm / (self.pixel_um / 1000) * width / self.size_px[0]
        k1, k2, p1, p2, k3 = (*distortion, *(0.0,) * (5 - len(distortion)))
        return Camera(width, height, focal_px, (k1, k2, p1, p2, k3))


def shipped_suites() -> dict[str, Path]:
    """The suites that ship with kpbench: name to file."""
    return {path.stem: path for path in sorted(shipped_folder("suites").glob("*.toml"))}


def load_suite(name: str) -> Suite:
    """Read a suite: a shipped one by its name, or any by the path of its TOML file.

    Raises
    ------
    DataError
        If there is none, or one line that names the file, the key and what was expected.
    """
    shipped = shipped_suites()
    path = shipped.get(name, Path(name))
    if name not in shipped and path.suffix != ".toml":
        raise DataError(f"there is no suite {name!r}, only: {', '.join(shipped)}, or a .toml file of your own")
    table = read_toml(path, DataError)
    try:
        return _parse_suite(table)
    except (DesignError, DataError) as error:
        raise DataError(f"{path}: {error}") from None


def _parse_suite(table: Mapping[str, Any]) -> Suite:
    keys(table, "the suite", ("schema", "name", "images", "patches", "camera", "scene", "condition"))
    if table.get("schema") != SCHEMA:
        raise DataError(f"schema is {table.get('schema')!r}, expected {SCHEMA!r}")
    camera = keys(table.get("camera"), "camera", ("size_px", "lens_mm", "pixel_um"))
    listed = {key: table.get(key) for key in ("patches", "condition")}
    for key, value in listed.items():
        if not isinstance(value, list) or not value:
            raise DataError(f"{key} is {value!r}, expected a list")
    scene = keys(table.get("scene"), "scene", tuple(SCENE_KEYS))
    conditions = tuple(_parse_condition(entry, f"condition[{n}]") for n, entry in enumerate(table["condition"]))
    names = [c.name for c in conditions]
    if len(set(names)) < len(names):
        raise DataError(f"two conditions share a name, among: {', '.join(names)}")
    width, height = _numbers(camera.get("size_px"), "camera.size_px", (64, 16384), 2)
    return Suite(
        name=_text(table.get("name"), "name"),
        images=int(number(table, "images", 1, 1e6)),
        patches=tuple(find_patch(shipped_patches(), key) for key in table["patches"]),
        size_px=(int(width), int(height)),
        lens_mm=number(camera, "lens_mm", 0.01, 1e4, "camera."),
        pixel_um=number(camera, "pixel_um", 0.01, 1e3, "camera."),
        scene=tuple((key, _span(scene.get(key), f"scene.{key}", bounds)) for key, bounds in SCENE_KEYS.items()),
        conditions=conditions,
    )


def _parse_condition(entry: object, place: str) -> Condition:
    table = keys(entry, place, ("name", "unit", "rungs", "pose", "effects"))
    rungs = _numbers(table.get("rungs"), f"{place}.rungs", (-1e6, 1e6))
    pose = keys(table.get("pose", {}), f"{place}.pose", tuple(SCENE_KEYS))
    effects = keys(table.get("effects", {}), f"{place}.effects", tuple(LADDER))

    def levels(part: Mapping[str, Any], name: str, bounds: Mapping[str, tuple[float, float]]) -> Levels:
        return tuple((k, _numbers(v, f"{place}.{name}.{k}", bounds[k], len(rungs))) for k, v in part.items())

    return Condition(
        name=_text(table.get("name"), f"{place}.name"),
        unit=_text(table.get("unit"), f"{place}.unit"),
        rungs=rungs,
        pose=levels(pose, "pose", SCENE_KEYS),
        effects=levels(effects, "effects", {name: rung.bounds for name, rung in LADDER.items()}),
    )


def _text(value: object, place: str) -> str:
    if not isinstance(value, str) or not value:
        raise DataError(f"{place} is {value!r}, expected a text")
    return value


def _numbers(value: object, place: str, bounds: tuple[float, float], count: int | None = None) -> tuple[float, ...]:
    if not isinstance(value, list) or not value or (count is not None and len(value) != count):
        raise DataError(f"{place} is {value!r}, expected a list of {'' if count is None else f'{count} '}numbers")
    return tuple(number({place: v}, place, *bounds) for v in value)


def _span(value: object, place: str, bounds: tuple[float, float]) -> tuple[float, float]:
    """One number as (number, number), or [least, most]."""
    least, most = _numbers(value if isinstance(value, list) else [value] * 2, place, bounds, 2)
    if least > most:
        raise DataError(f"{place} is {value!r}, expected [least, most]")
    return least, most
