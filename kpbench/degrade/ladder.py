"""The ladder: which effect at which level, drawn for an image, and applied."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from kpbench.degrade.effects import (
    Effect,
    blur,
    brightness,
    defocus,
    dimming,
    flare,
    gaussian_blur,
    jpeg,
    low_light,
    motion_blur,
    noise,
    occlusion,
    rainfall,
    shadow_edge,
)
from kpbench.degrade.weather import rain, shadow
from kpbench.errors import DataError
from kpbench.types import Float, UInt8

Discs = Float
"""Patches in an image that an effect may aim at, shape (n, 3): x, y and radius in px."""


Draw = Callable[[np.random.Generator, float, tuple[int, int], Discs], Effect]


@dataclass(frozen=True)
class Rungs:
    """One effect of the ladder: its levels from mild to severe, their unit, and the least and most it takes.

    ``draw(rng, level, (width_px, height_px), discs)`` gives the effect as a dict; what is not set by the
    level (an angle, a place) is drawn.
    """

    levels: tuple[float, ...]
    unit: str
    bounds: tuple[float, float]
    draw: Draw


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))


def _angle(rng: np.random.Generator, end: float) -> float:
    return round(float(rng.uniform(0, end)), 1)


def _draw_motion_blur(rng: np.random.Generator, level: float, size: tuple[int, int], discs: Discs) -> Effect:
    return {"effect": "motion_blur", "length_px": level, "angle_deg": _angle(rng, 180)}


def _draw_shadow_edge(rng: np.random.Generator, level: float, size: tuple[int, int], discs: Discs) -> Effect:
    """Across one of the patches, off its centre by up to half its radius."""
    x, y, radius = discs[int(rng.integers(len(discs)))]
    x, y = (x, y) + radius * rng.uniform(-0.5, 0.5, 2)
    where = {"x": round(float(x), 2), "y": round(float(y), 2), "angle_deg": _angle(rng, 360)}
    return {"effect": "shadow_edge", **where, "light": round(1 - level / 100, 6), "penumbra_px": round(radius / 8, 2)}


def _draw_occlusion(rng: np.random.Generator, level: float, size: tuple[int, int], discs: Discs) -> Effect:
    """A strip from a random side over every patch, so that ``level`` percent of its circle is hidden."""
    reach = np.linspace(1, -1, 2001)
    hidden = (np.arccos(reach) - reach * np.sqrt(1 - reach**2)) / np.pi  # share of a unit disc beyond x = reach
    start = float(np.interp(level / 100, hidden, reach))
    strips = []
    for x, y, radius in discs:
        angle_deg, grey = _angle(rng, 360), float(rng.integers(20, 236))
        c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
        length, middle = (1.3 - start) * radius, (1.3 + start) / 2 * radius
        strip = (x + c * middle, y + s * middle, length, 2.6 * radius)
        strips.append([*(round(float(v), 3) for v in strip), angle_deg, grey])
    return {"effect": "occlusion", "strips": strips}


def _draw_flare(rng: np.random.Generator, level: float, size: tuple[int, int], discs: Discs) -> Effect:
    """The lamp stands one to four radii beside one of the patches."""
    x, y, radius = discs[int(rng.integers(len(discs)))]
    angle, away = rng.uniform(0, 2 * np.pi), radius * rng.uniform(1, 4)
    where = {"x": round(float(x + away * np.cos(angle)), 2), "y": round(float(y + away * np.sin(angle)), 2)}
    return {"effect": "flare", **where, "strength": level, "reach_px": round(0.15 * size[0], 2)}


def _draw_rainfall(rng: np.random.Generator, level: float, size: tuple[int, int], discs: Discs) -> Effect:
    fixed = {"streaks": round(level * size[0] * size[1] / 1e6), "length_px": round(0.04 * size[0], 2)}
    return {"effect": "rainfall", "seed": _seed(rng), **fixed, "slant_deg": round(float(rng.uniform(-20, 20)), 1)}


def _set(effect: str, parameter: str, **fixed: Any) -> Draw:
    """An effect that a level sets wholly."""
    return lambda rng, level, size, discs: {"effect": effect, parameter: level, **fixed}


def _draw_jpeg(rng: np.random.Generator, level: float, size: tuple[int, int], discs: Discs) -> Effect:
    return {"effect": "jpeg", "quality": float(round(level))}


LADDER: dict[str, Rungs] = {
    "blur": Rungs((3, 7, 11, 15), "px", (1, 501), _set("blur", "kernel_px")),
    "dimming": Rungs((10, 20, 30, 40), "k", (0, 1000), _set("dimming", "k")),
    "dimming-literal": Rungs((10, 20, 30, 40), "k", (0, 1000), _set("dimming", "k", law="literal")),
    "noise": Rungs((15, 30, 45, 60), "grey levels", (0, 1000), _set("noise", "sigma")),
    "gaussian-blur": Rungs((1, 2, 3, 4.5), "px", (0.1, 100), _set("gaussian_blur", "sigma_px")),
    "motion-blur": Rungs((5, 10, 20, 30), "px", (0.1, 500), _draw_motion_blur),
    "defocus": Rungs((2, 4, 6, 9), "px", (0.1, 250), _set("defocus", "radius_px")),
    "shadow-edge": Rungs((30, 50, 70, 90), "% of the light", (0, 100), _draw_shadow_edge),
    "rain": Rungs((500, 1000, 2000, 4000), "streaks a megapixel", (0, 1e5), _draw_rainfall),
    "jpeg": Rungs((50, 25, 10, 5), "quality", (1, 100), _draw_jpeg),
    "low-light": Rungs((4, 6, 8, 9), "stops", (0, 14), _set("low_light", "stops")),
    "occlusion": Rungs((10, 20, 30, 40), "% of each patch", (0.1, 99), _draw_occlusion),
    "flare": Rungs((60, 120, 180, 240), "grey levels", (0, 1000), _draw_flare),
}
"""Effect → its rungs. Stacks are effects applied one after the other."""


def climb(
    rng: np.random.Generator, effect: str, level: float, size_px: tuple[int, int], discs: Discs | None = None
) -> Effect:
    """Draw what a level leaves open; the result goes into :func:`apply`.

    Parameters
    ----------
    rng
    effect : a key of :data:`LADDER`.
    level : any number in the effect's unit, not only one of its rungs.
    size_px : (width, height) of the image.
    discs : ndarray of shape (n, 3), optional
        x, y and radius of the patches that shadow edge, occlusion and flare aim at; one random place if left out.

    Raises
    ------
    DataError
        If there is no such effect, or the level makes no sense for it.
    """
    if effect not in LADDER:
        raise DataError(f"there is no effect {effect!r}, only: {', '.join(LADDER)}")
    rungs = LADDER[effect]
    low, high = rungs.bounds
    if not low <= level <= high:
        raise DataError(f"{effect} takes a level from {low:g} to {high:g} ({rungs.unit}), not {level:g}")
    if discs is None or not len(discs):
        width, height = size_px
        discs = np.array([[rng.uniform(0.2, 0.8) * width, rng.uniform(0.2, 0.8) * height, 0.05 * width]])
    return rungs.draw(rng, level, size_px, discs)


def paper_mix(image: UInt8, rng: np.random.Generator) -> tuple[UInt8, list[dict[str, Any]]]:
    """The paper's deteriorations (§2.2): one to three of six, drawn without repetition.

    The paper gives no strengths; these follow the defaults of the library that it used, and the order
    is that of light and camera: shadow, rain, motion blur, blur, brightness, noise.

    Returns
    -------
    image : ndarray of the same shape, uint8
    effects : list of dict
        What was applied, in order, with the parameters that were drawn.
    """
    drawn: dict[str, dict[str, Any]] = {
        "shadow": {"seed": int(rng.integers(2**31))},
        "rain": {"seed": int(rng.integers(2**31))},
        "motion_blur": {"length_px": int(rng.integers(3, 10)), "angle_deg": int(rng.integers(180))},
        "blur": {"kernel_px": int(rng.choice([3, 5, 7]))},
        "brightness": {"factor": round(rng.uniform(0.5, 1.3), 3)},
        "noise": {"sigma": round(rng.uniform(5, 30), 2)},
    }
    chosen = rng.permutation(len(drawn))[: rng.integers(1, 4)]
    effects = [{"effect": name, **drawn[name]} for n, name in enumerate(drawn) if n in chosen]
    return apply(image, rng, effects), effects


LADDER_MIX = (
    "occlusion", "rain", "shadow-edge", "dimming", "flare", "motion-blur", "defocus", "gaussian-blur", "blur",
    "low-light", "noise", "jpeg",
)  # fmt: skip
"""What :func:`ladder_mix` draws from, in the order of scene, light, lens, sensor and file."""


def ladder_mix(image: UInt8, rng: np.random.Generator, discs: Discs) -> tuple[UInt8, list[Effect]]:
    """One or two effects of the ladder, at levels from nothing to their severest rung, uniform.

    Parameters and returns as for :func:`paper_mix`; ``discs`` as for :func:`climb`.
    """
    size_px = (image.shape[1], image.shape[0])
    chosen = rng.permutation(len(LADDER_MIX))[: rng.integers(1, 3)]
    effects = []
    for name in (LADDER_MIX[n] for n in sorted(chosen)):
        rungs = LADDER[name]
        mildest = rungs.bounds[rungs.levels[0] > rungs.levels[-1]]
        level = round(mildest + float(rng.random()) * (rungs.levels[-1] - mildest), 0 if name == "jpeg" else 2)
        effects.append(climb(rng, name, level, size_px, discs))
    return apply(image, rng, effects), effects


FUNCTIONS: dict[str, Callable[..., UInt8]] = {
    "shadow": shadow,
    "rain": rain,
    "motion_blur": motion_blur,
    "blur": blur,
    "brightness": brightness,
    "dimming": dimming,
    "noise": noise,
    "gaussian_blur": gaussian_blur,
    "defocus": defocus,
    "shadow_edge": shadow_edge,
    "rainfall": rainfall,
    "jpeg": jpeg,
    "low_light": low_light,
    "occlusion": occlusion,
    "flare": flare,
}


DRAWS_A_FIELD = ("noise", "low_light")


def apply(image: UInt8, rng: np.random.Generator, effects: list[Effect]) -> UInt8:
    """Apply recorded effects in order; noise and low light take their fields from ``rng``."""
    for entry in effects:
        parameters = {key: value for key, value in entry.items() if key != "effect"}
        if entry["effect"] in DRAWS_A_FIELD:
            parameters["rng"] = rng
        image = FUNCTIONS[entry["effect"]](image, **parameters)
    return image
