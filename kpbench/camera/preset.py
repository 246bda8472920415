"""Cameras as TOML files: for each quantity a value, or a range from which every image draws its own value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kpbench.camera.tone import ToneCurve, random_tone_curve
from kpbench.errors import DataError
from kpbench.files import find_shipped, shipped_files
from kpbench.geometry.camera import Camera
from kpbench.geometry.camera_file import CALIBRATION_SUFFIXES, read_camera
from kpbench.portable import cos_sin_of
from kpbench.toml import TomlTable, name_source, read_toml

CAMERA_SCHEMA = "kpbench.camera/1"
TONES = ("linear", "srgb", "s-curve", "gamma", "logarithmic", "random")
"""Tone curves of a preset. "s-curve", "gamma" and "logarithmic" take ``tone_parameter``; "random" draws a curve."""
QUANTITIES: dict[str, dict[str, tuple[float, float, float]]] = {
    "lens": {
        "wavelength_um": (0.0, 20.0, 0.55),
        "f_number": (0.5, 64.0, 2.8),
        "pixel_um": (0.3, 100.0, 3.0),
        "defocus_px": (0.0, 35.0, 0.0),
        "corner_loss": (0.0, 1.0, 0.0),
        "k1": (-0.5, 0.5, 0.0),
        "red_px": (-20.0, 20.0, 0.0),
        "blue_px": (-20.0, 20.0, 0.0),
    },
    "scene": {
        "motion_px": (0.0, 100.0, 0.0),
        "turn_deg": (0.0, 45.0, 0.0),
        "row_time": (0.0, 1.0, 0.0),
        "ink_gain": (-0.1, 0.1, 0.0),
        "bow": (-0.2, 0.2, 0.0),
        "twist": (-0.2, 0.2, 0.0),
        "detail": (0, 20, 0),
    },
    "sensor": {
        "full_well_e": (10.0, 1e6, 10_000.0),
        "exposure": (1e-4, 16.0, 1.0),
        "read_noise_e": (0.0, 1000.0, 2.0),
        "prnu": (0.0, 0.5, 0.0),
        "dsnu_e": (0.0, 1000.0, 0.0),
        "row_noise_e": (0.0, 1000.0, 0.0),
        "bits": (6, 14, 10),
    },
    "processing": {
        "balance_error": (0.0, 0.5, 0.0),
        "tone_parameter": (0.01, 10_000.0, 2.2),
        "denoise_sigma": (0.0, 50.0, 0.0),
        "sharpen_amount": (0.0, 10.0, 0.0),
        "sharpen_sigma_px": (0.3, 10.0, 1.0),
        "jpeg_quality": (0, 100, 0),
    },
}
"""Least value, greatest value and default of each quantity of each table of a camera's file."""
WHOLE = ("bits", "jpeg_quality", "detail")
MOST_SHIFT_PER_ROW = 0.5
"""Largest product of the speed of a patch (px per exposure) and the row time (exposures per row)."""
GAIN_STEP = 2.0**-10
"""Drawn ink gains are multiples of this, in disc radii, so that images share cached outlines."""


@dataclass(frozen=True)
class CameraPreset:
    """A camera, and how its images differ.

    Attributes
    ----------
    name : str
    spans : tuple of (str, (float, float))
        Least and greatest value of each quantity of :data:`QUANTITIES`. Each image draws its value uniformly.
    tones : tuple of str
        Tone curves, see :data:`TONES`. Each image draws one of them.
    has_bayer_pattern : bool
        Whether the sensor of a colour image has colour filters.
    camera_seed : int
        Identity of the camera, which fixes the fixed pattern of the sensor.
    calibration : Camera or None
        Lens and image size from a calibration file. None: the lens has the quantity ``k1``, and any image size.

    Examples
    --------
    >>> from kpbench.camera import load_camera_preset
    >>> preset = load_camera_preset("webcam")
    >>> preset.name, preset.has_bayer_pattern
    ('webcam', True)
    """

    name: str
    spans: tuple[tuple[str, tuple[float, float]], ...]
    tones: tuple[str, ...]
    has_bayer_pattern: bool
    camera_seed: int = 0
    calibration: Camera | None = None

    def __post_init__(self) -> None:
        most = {name: max(map(abs, span)) for name, span in self.spans}
        if most["motion_px"] * most["row_time"] > MOST_SHIFT_PER_ROW:
            raise DataError(
                f"camera {self.name!r}: motion_px {most['motion_px']:g} times row_time {most['row_time']:g} is over "
                f"{MOST_SHIFT_PER_ROW:g}, expected a shutter that is faster than the patches"
            )
        if most["bow"] and most["twist"]:
            raise DataError(f"camera {self.name!r} has both bow and twist, expected one of them")

    def with_values(self, values: Mapping[str, float | str | bool]) -> CameraPreset:
        """Return the same camera with fixed values of some quantities, ``tone`` and ``bayer`` included.

        Examples
        --------
        >>> from kpbench.camera import load_camera_preset
        >>> preset = load_camera_preset("webcam").with_values({"bits": 8, "tone": "linear"})
        >>> dict(preset.spans)["bits"], preset.tones
        ((8.0, 8.0), ('linear',))
        """
        spans = tuple((key, (float(values[key]),) * 2 if key in values else span) for key, span in self.spans)
        tones = (str(values["tone"]),) if "tone" in values else self.tones
        bayer = bool(values.get("bayer", self.has_bayer_pattern))
        return replace(self, spans=spans, tones=tones, has_bayer_pattern=bayer)

    def draw(self, rng: np.random.Generator) -> dict[str, Any]:
        """Draw the values of one image.

        Parameters
        ----------
        rng : numpy.random.Generator

        Returns
        -------
        dict
            The record of the effect ``camera``, for :func:`kpbench.camera.photograph`.

        Examples
        --------
        >>> import numpy as np
        >>> from kpbench.camera import load_camera_preset
        >>> record = load_camera_preset("industrial").draw(np.random.default_rng(0))
        >>> record["effect"], record["tone"]
        ('camera', {'name': 'linear', 'parameters': []})
        """
        drawn: dict[str, Any] = {"effect": "camera", "preset": self.name, "camera_seed": self.camera_seed}
        for name, (low, high) in self.spans:
            value = low + (high - low) * float(rng.random())
            drawn[name] = round(value) if name in WHOLE else round(value, 4)
        c, s = cos_sin_of(2 * np.pi * float(rng.random()))
        length = drawn.pop("motion_px")
        drawn["velocity_px"] = [round(length * c, 4), round(length * s, 4)]
        drawn["ink_gain"] = round(drawn["ink_gain"] / GAIN_STEP) * GAIN_STEP
        z, (c, s) = float(rng.uniform(-1, 1)), cos_sin_of(2 * np.pi * float(rng.random()))
        across, turn = float(np.sqrt(1 - z * z)), drawn["turn_deg"]
        drawn["turn_deg"] = [round(turn * v, 4) for v in (across * c, across * s, z)]
        drawn["axis_deg"] = round(180 * float(rng.random()), 2)
        drawn["detail_seed"] = int(rng.integers(2**31))
        error = drawn.pop("balance_error")
        drawn["balance"] = [round(1 + error * float(rng.uniform(-1, 1)), 4) for _ in ("red", "blue")]
        curve = self._draw_tone(rng, drawn.pop("tone_parameter"))
        drawn["tone"] = {"name": curve.name, "parameters": list(curve.parameters)}
        return drawn | {"bayer": self.has_bayer_pattern}

    def _draw_tone(self, rng: np.random.Generator, parameter: float) -> ToneCurve:
        name = self.tones[int(rng.integers(len(self.tones)))]
        if name == "random":
            return random_tone_curve(rng)
        return ToneCurve(name, () if name in ("linear", "srgb") else (parameter,))

    def to_dict(self) -> dict[str, Any]:
        """Return the preset for the config of a dataset."""
        spans = {name: low if low == high else [low, high] for name, (low, high) in self.spans}
        return {
            "name": self.name,
            **spans,
            "tone": list(self.tones),
            "bayer": self.has_bayer_pattern,
            "camera_seed": self.camera_seed,
            **({} if self.calibration is None else {"calibration": self.calibration.to_dict()}),
        }


def shipped_cameras() -> dict[str, Path]:
    """Return the files of the cameras that ship with kpbench, keyed by the cameras' names.

    Examples
    --------
    >>> from kpbench.camera import shipped_cameras
    >>> list(shipped_cameras())
    ['action-cam', 'everyday', 'industrial', 'phone', 'webcam']
    """
    return shipped_files("cameras")


def load_camera_preset(name: str) -> CameraPreset:
    """Read a camera.

    Parameters
    ----------
    name : str
        Name of a shipped camera, path of a TOML file, or path of a calibration file, see
        :func:`kpbench.geometry.read_camera`. A calibration gives the lens and the size of the images. Of such a camera,
        all else is ideal: a linear tone curve, little noise, no processing.

    Raises
    ------
    DataError
        If there is no such camera, or a value in its file is wrong. The message names the file, the key and the
        expected value.

    Examples
    --------
    >>> from kpbench.camera import load_camera_preset
    >>> load_camera_preset("phone").tones
    ('s-curve', 'random')
    """
    if Path(name).suffix.lower() in CALIBRATION_SUFFIXES:
        spans = tuple(
            (key, (default, default)) for table in QUANTITIES.values() for key, (_, _, default) in table.items()
        )
        return CameraPreset("calibration", spans, ("linear",), False, calibration=read_camera(name))
    path = find_shipped("cameras", name, "camera")
    content = read_toml(path, DataError)
    with name_source(path, DataError):
        table = TomlTable(content, ("schema", "name", "seed", *QUANTITIES), DataError)
        table.require_schema(CAMERA_SCHEMA)
        return parse_preset(table, table.name(), table.whole_number("seed", 0, 2**31) if "seed" in table else 0)


def parse_preset(table: TomlTable, name: str, camera_seed: int = 0) -> CameraPreset:
    """Read the tables of :data:`QUANTITIES` from a table, and make a camera of them."""
    spans: list[tuple[str, tuple[float, float]]] = []
    tones: tuple[str, ...] = ("srgb",)
    has_bayer_pattern = False
    for part, quantities in QUANTITIES.items():
        more = {"sensor": ("bayer",), "processing": ("tone",)}.get(part, ())
        entries = table.table(part, (*quantities, *more), {})
        for key, (low, high, default) in quantities.items():
            spans.append((key, entries.span(key, low, high) if key in entries else (default, default)))
        if "bayer" in entries and part == "sensor":
            has_bayer_pattern = entries.flag("bayer")
        if "tone" in entries and part == "processing":
            tones = tuple(map(str, entries.entries("tone", "a list of tone curves")))
            if unknown := [tone for tone in tones if tone not in TONES]:
                raise DataError(f"{entries.path('tone')} names {unknown[0]!r}, expected some of: {', '.join(TONES)}")
    return CameraPreset(name, tuple(spans), tones, has_bayer_pattern, camera_seed)
