"""The ladder of effects: the levels of each effect, and how an effect is drawn and applied."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kpbench.degrade.blurs import blur, defocus, gaussian_blur, motion_blur
from kpbench.degrade.effects import (
    Effect,
    brightness,
    dimming,
    flare,
    jpeg,
    low_light,
    noise,
    occlusion,
    shadow_edge,
    strip_corners,
)
from kpbench.degrade.occluders import draw_cable, draw_hand, limb_outlines, limbs
from kpbench.degrade.weather import rain, rainfall, shadow
from kpbench.errors import DataError
from kpbench.portable import arctan2, cos_sin_of
from kpbench.types import Float, UInt8

Discs = Float
"""The discs of the patches that an effect may aim at: ndarray of shape (n, 3), x, y and radius in px."""
Draw = Callable[[np.random.Generator, float, tuple[int, int], Discs], Effect]
"""``draw(rng, level, (width_px, height_px), discs)`` returns the record of an effect."""


@dataclass(frozen=True)
class Severity:
    """The levels of an effect of the ladder.

    Attributes
    ----------
    levels : tuple of float
        Standard levels, from mild to severe. The shipped suites take their rungs from these levels.
    unit : str
        Unit of the levels.
    bounds : (float, float)
        Least and largest level.
    draw : callable
        Draws the parameters that the level leaves open, such as an angle or a place, and returns the record of
        the effect.

    Examples
    --------
    >>> from kpbench.degrade import LADDER
    >>> LADDER["noise"].levels, LADDER["noise"].unit
    ((15, 30, 45, 60), 'grey levels')
    """

    levels: tuple[float, ...]
    unit: str
    bounds: tuple[float, float]
    draw: Draw


def _draw_seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))


def _draw_angle_deg(rng: np.random.Generator, end_deg: float) -> float:
    return round(float(rng.uniform(0, end_deg)), 1)


def _set_parameter(effect: str, parameter: str, **fixed: Any) -> Draw:
    """Make a draw function for an effect whose only open parameter is the level."""
    return lambda rng, level, size_px, discs: {"effect": effect, parameter: level, **fixed}


def _draw_jpeg(rng: np.random.Generator, level: float, size_px: tuple[int, int], discs: Discs) -> Effect:
    return {"effect": "jpeg", "quality": float(round(level))}


def _draw_motion_blur(rng: np.random.Generator, level: float, size_px: tuple[int, int], discs: Discs) -> Effect:
    return {"effect": "motion_blur", "length_px": level, "angle_deg": _draw_angle_deg(rng, 180)}


def _draw_shadow_edge(rng: np.random.Generator, level: float, size_px: tuple[int, int], discs: Discs) -> Effect:
    """Draw an edge across one of the patches, through a point up to half a radius off the centre in x and in y."""
    x, y, radius = discs[int(rng.integers(len(discs)))]
    x, y = (x, y) + radius * rng.uniform(-0.5, 0.5, 2)
    place = {"x": round(float(x), 2), "y": round(float(y), 2), "angle_deg": _draw_angle_deg(rng, 360)}
    return {"effect": "shadow_edge", **place, "light": round(1 - level / 100, 6), "penumbra_px": round(radius / 8, 2)}


def _draw_rainfall(rng: np.random.Generator, level: float, size_px: tuple[int, int], discs: Discs) -> Effect:
    seed, streaks = _draw_seed(rng), round(level * size_px[0] * size_px[1] / 1e6)
    slant_deg = round(float(rng.uniform(-20, 20)), 1)
    length_px = round(0.04 * size_px[0], 2)
    return {"effect": "rainfall", "seed": seed, "streaks": streaks, "length_px": length_px, "slant_deg": slant_deg}


def _draw_occlusion(rng: np.random.Generator, level: float, size_px: tuple[int, int], discs: Discs) -> Effect:
    """Draw one strip per patch that covers ``level`` percent of the patch's disc from a random side."""
    border = np.linspace(1, -1, 2001)
    rise = np.sqrt(1 - border**2)
    hidden = (arctan2(rise, border) - border * rise) / np.pi  # share of a unit disc beyond x = border
    start = float(np.interp(level / 100, hidden, border))
    end = 1.3  # far end of the strip, radii from the patch's centre: beyond the disc
    strips = []
    for x, y, radius in discs:
        angle_deg, grey = _draw_angle_deg(rng, 360), float(rng.integers(20, 236))
        c, s = cos_sin_of(np.radians(angle_deg))
        length, middle = (end - start) * radius, (end + start) / 2 * radius
        strip = (x + c * middle, y + s * middle, length, 2 * end * radius)
        strips.append([*(round(float(v), 3) for v in strip), angle_deg, grey])
    return {"effect": "occlusion", "strips": strips}


def _draw_flare(rng: np.random.Generator, level: float, size_px: tuple[int, int], discs: Discs) -> Effect:
    """Draw a lamp, one to four radii from the centre of one of the patches."""
    x, y, radius = discs[int(rng.integers(len(discs)))]
    (c, s), distance = cos_sin_of(rng.uniform(0, 2 * np.pi)), radius * rng.uniform(1, 4)
    place = {"x": round(float(x + distance * c), 2), "y": round(float(y + distance * s), 2)}
    return {"effect": "flare", **place, "strength": level, "reach_px": round(0.15 * size_px[0], 2)}


LADDER: dict[str, Severity] = {
    "blur": Severity((3, 7, 11, 15), "px", (1, 501), _set_parameter("blur", "kernel_px")),
    "dimming": Severity((10, 20, 30, 40), "k", (0, 1000), _set_parameter("dimming", "k")),
    "dimming-literal": Severity((10, 20, 30, 40), "k", (0, 1000), _set_parameter("dimming", "k", law="literal")),
    "noise": Severity((15, 30, 45, 60), "grey levels", (0, 1000), _set_parameter("noise", "sigma")),
    "gaussian-blur": Severity((1, 2, 3, 4.5), "px", (0.1, 100), _set_parameter("gaussian_blur", "sigma_px")),
    "motion-blur": Severity((5, 10, 20, 30), "px", (0.1, 500), _draw_motion_blur),
    "defocus": Severity((2, 4, 6, 9), "px", (0.1, 250), _set_parameter("defocus", "radius_px")),
    "shadow-edge": Severity((30, 50, 70, 90), "% of the light", (0, 100), _draw_shadow_edge),
    "rain": Severity((500, 1000, 2000, 4000), "streaks a megapixel", (0, 1e5), _draw_rainfall),
    "jpeg": Severity((50, 25, 10, 5), "quality", (1, 100), _draw_jpeg),
    "low-light": Severity((4, 6, 8, 9), "stops", (0, 14), _set_parameter("low_light", "stops")),
    "occlusion": Severity((10, 20, 30, 40), "% of each patch", (0.1, 99), _draw_occlusion),
    "flare": Severity((60, 120, 180, 240), "grey levels", (0, 1000), _draw_flare),
    "hand": Severity((20, 35, 50, 65), "% of the board", (0, 100), draw_hand),
    "cable": Severity((1, 2, 4, 8), "cables", (1, 64), draw_cable),
}
"""The severity of each effect, by the effect's name."""


def draw_effect(
    rng: np.random.Generator, effect: str, level: float, size_px: tuple[int, int], discs: Discs | None = None
) -> Effect:
    """Return the record of an effect at a level. Parameters that the level leaves open, such as an angle, are drawn.

    Parameters
    ----------
    rng : numpy.random.Generator
    effect : str
        A key of :data:`LADDER`.
    level : float
        Any number within the effect's bounds, in the effect's unit. The number need not be a standard level.
    size_px : (int, int)
        Width and height of the image.
    discs : ndarray of shape (n, 3), optional
        x, y and radius (px) of the patches that shadow edge, occlusion and flare aim at. Without patches, these effects
        aim at one random place.

    Returns
    -------
    dict
        The record of the effect, for :func:`apply_effects`.

    Raises
    ------
    DataError
        If there is no such effect, or the level is out of the effect's bounds.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import draw_effect
    >>> draw_effect(np.random.default_rng(0), "motion-blur", 10, (640, 480))
    {'effect': 'motion_blur', 'length_px': 10, 'angle_deg': 7.4}
    """
    if effect not in LADDER:
        raise DataError(f"there is no effect {effect!r}, only: {', '.join(LADDER)}")
    severity = LADDER[effect]
    low, high = severity.bounds
    if not low <= level <= high:
        raise DataError(f"{effect} takes a level from {low:g} to {high:g} ({severity.unit}), not {level:g}")
    if discs is None or not len(discs):
        width, height = size_px
        discs = np.array([[rng.uniform(0.2, 0.8) * width, rng.uniform(0.2, 0.8) * height, 0.05 * width]])
    return severity.draw(rng, level, size_px, discs)


def draw_paper_mix(rng: np.random.Generator) -> list[Effect]:
    """Draw one to three of the paper's six deteriorations (§2.2), without repetition.

    The paper gives no strengths. The strengths drawn here follow the defaults of the library that the paper used. The
    effects are in the order in which light and camera cause them: shadow, rain, motion blur, blur, brightness, noise.

    Parameters
    ----------
    rng : numpy.random.Generator

    Returns
    -------
    list of dict
        The records of the effects, for :func:`apply_effects`.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import draw_paper_mix
    >>> draw_paper_mix(np.random.default_rng(2))
    [{'effect': 'motion_blur', 'length_px': 3, 'angle_deg': 53}]
    """
    parameters: dict[str, dict[str, Any]] = {
        "shadow": {"seed": _draw_seed(rng)},
        "rain": {"seed": _draw_seed(rng)},
        "motion_blur": {"length_px": int(rng.integers(3, 10)), "angle_deg": int(rng.integers(180))},
        "blur": {"kernel_px": (3, 5, 7)[int(rng.integers(3))]},
        "brightness": {"factor": round(rng.uniform(0.5, 1.3), 3)},
        "noise": {"sigma": round(rng.uniform(5, 30), 2)},
    }
    chosen = rng.permutation(len(parameters))[: rng.integers(1, 4)]
    return [{"effect": name, **parameters[name]} for n, name in enumerate(parameters) if n in chosen]


LADDER_MIX = (
    "occlusion", "rain", "shadow-edge", "dimming", "flare", "motion-blur", "defocus", "gaussian-blur", "blur",
    "low-light", "noise", "jpeg",
)  # fmt: skip
"""The effects that :func:`draw_ladder_mix` draws from, in the order of scene, light, lens, sensor and file."""


def draw_ladder_mix(rng: np.random.Generator, size_px: tuple[int, int], discs: Discs | None = None) -> list[Effect]:
    """Draw one or two effects of the ladder. The levels are uniform between no effect and the severest standard level.

    Parameters
    ----------
    rng : numpy.random.Generator
    size_px : (int, int)
        Width and height of the image.
    discs : ndarray of shape (n, 3), optional
        See :func:`draw_effect`.

    Returns
    -------
    list of dict
        The records of the effects, for :func:`apply_effects`.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import draw_ladder_mix
    >>> draw_ladder_mix(np.random.default_rng(1), (640, 480))
    [{'effect': 'blur', 'kernel_px': 8.69}]
    """
    chosen = rng.permutation(len(LADDER_MIX))[: rng.integers(1, 3)]
    effects = []
    for name in (LADDER_MIX[n] for n in sorted(chosen)):
        severity = LADDER[name]
        harmless = severity.bounds[severity.levels[0] > severity.levels[-1]]  # the upper bound if the levels fall
        level = round(harmless + float(rng.random()) * (severity.levels[-1] - harmless), 0 if name == "jpeg" else 2)
        effects.append(draw_effect(rng, name, level, size_px, discs))
    return effects


EFFECT_FUNCTIONS: dict[str, Callable[..., UInt8]] = {
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
    "limbs": limbs,
}
"""The function of each effect, by the name in the effect's record."""
OUTLINES_OF_COVER: dict[str, Callable[[Effect], list[Float]]] = {
    "occlusion": lambda record: strip_corners(record["strips"]),
    "limbs": lambda record: limb_outlines(record["limbs"]),
}
"""Effects that hide what is behind them, and the function that returns the outlines of what they lay over an image."""
RANDOM_FIELD_EFFECTS = ("noise", "low_light")
"""Effects that draw random numbers for every pixel. Their records do not hold these numbers."""


def apply_effects(image: UInt8, rng: np.random.Generator, effects: Sequence[Effect]) -> UInt8:
    """Apply recorded effects to an image, in order.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
        The array stays unchanged.
    rng : numpy.random.Generator
        Gives the random fields of ``noise`` and ``low_light``. All other parameters are in the records.
    effects : sequence of dict
        Records from :func:`draw_effect`.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import apply_effects
    >>> image = np.array([[0, 0, 90, 0, 0]], np.uint8)
    >>> apply_effects(image, np.random.default_rng(0), [{"effect": "blur", "kernel_px": 3}])
    array([[ 0, 30, 30, 30,  0]], dtype=uint8)
    """
    for record in effects:
        parameters = {key: value for key, value in record.items() if key != "effect"}
        if record["effect"] in RANDOM_FIELD_EFFECTS:
            parameters["rng"] = rng
        image = EFFECT_FUNCTIONS[record["effect"]](image, **parameters)
    return image
