"""Tone curves against formulas that are written out here once more."""

import dataclasses
import json
import math

import numpy as np
import pytest

from kpbench.camera import ToneCurve, random_tone_curve
from kpbench.errors import DataError

POINTS = [(0, 0), (0.01, 0.2), (0.3, 0.5), (1, 1)]
CURVES = [
    ToneCurve("linear"),
    ToneCurve("srgb"),
    *[ToneCurve("gamma", (g,)) for g in (0.25, 1, 1.8, 2.4, 4)],
    *[ToneCurve("logarithmic", (c,)) for c in (0.01, 100, 10_000)],
    *[ToneCurve("s-curve", (s,)) for s in (0.01, 6, 20)],
    ToneCurve("table", points=POINTS),
    *[random_tone_curve(np.random.default_rng(n)) for n in range(60)],
]
LIGHT = np.linspace(0, 1, 1001)


def srgb(x):
    return 12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055


def s_curve(x, strength):
    """The sigmoidal contrast of ImageMagick, about one half."""
    at = [1 / (1 + math.exp(strength * (0.5 - v))) for v in (srgb(x), 0.0, 1.0)]
    return (at[0] - at[1]) / (at[2] - at[1])


def warped(x, gamma, offset, *weights):
    ends = offset ** (1 / gamma), (1 + offset) ** (1 / gamma)
    u = ((x + offset) ** (1 / gamma) - ends[0]) / (ends[1] - ends[0])
    return u + sum(w * math.sin(math.pi * k * u) / (math.pi * k) for k, w in enumerate(weights, 1))


FORMULAS = {
    "linear": lambda x: x,
    "srgb": srgb,
    "gamma": lambda x, g: x ** (1 / g),
    "logarithmic": lambda x, c: math.log1p(c * x) / math.log1p(c),
    "s-curve": s_curve,
    "warped": warped,
    "table": lambda x: float(np.interp(x, *zip(*POINTS, strict=True))),
}


@pytest.mark.parametrize("curve", CURVES[:20], ids=str)
def test_a_curve_is_its_formula(curve):
    expected = [FORMULAS[curve.name](x, *curve.parameters) for x in LIGHT.tolist()]
    assert np.abs(curve.value(LIGHT) - expected).max() < 1e-13
    tolerance = 2e-7 if curve.name in ("srgb", "s-curve") else 1e-11  # the standard's two pieces miss each other
    assert np.abs(curve.light(curve.value(LIGHT)) - LIGHT).max() < tolerance


@pytest.mark.parametrize("curve", CURVES, ids=str)
def test_levels_survive_decoding_and_encoding(curve):
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    light = curve.decode(levels)
    assert light.dtype == np.float32
    assert np.all(np.diff(light.ravel()) > 0)
    np.testing.assert_array_equal(curve.encode(light), levels)
    np.testing.assert_array_equal(curve.encode(np.dstack([light] * 3)), np.dstack([levels] * 3))


@pytest.mark.parametrize("curve", CURVES[:20], ids=str)
def test_the_table_rounds_as_the_formula_does(curve):
    light = np.random.default_rng(1).random((100, 100)).astype(np.float32)
    exact = 255 * curve.value(light)
    step = 255 * (curve.value(np.minimum(light + 3e-5, 1)) - curve.value(np.maximum(light - 3e-5, 0)))
    assert np.all(np.abs(curve.encode(light) - exact) <= 0.5 + step)
    assert np.mean(curve.encode(light) == np.rint(exact)) > 0.985


def test_light_outside_the_range_is_clipped():
    assert ToneCurve("srgb").encode(np.array([[-1, 0, 1, 7]], np.float32)).tolist() == [[0, 0, 255, 255]]


def test_a_drawn_curve_is_smooth_and_neither_flat_nor_steep():
    rng = np.random.default_rng(3)
    light = np.linspace(0.05, 1, 400)
    drawn = [random_tone_curve(rng) for _ in range(60)]
    slopes = np.array([np.diff(curve.value(light)) / np.diff(light) for curve in drawn])
    assert 0.24 < slopes.min() < 0.4
    assert 2.5 < slopes.max() < 4.1
    assert np.abs(np.diff(slopes, axis=1)).max() < 0.3
    middle = np.array([curve.value(0.2) for curve in drawn])
    assert middle.min() < 0.3
    assert middle.max() > 0.5
    assert len(set(drawn)) == len(drawn)


@pytest.mark.parametrize("curve", CURVES[:20], ids=str)
def test_a_curve_is_made_again_from_its_record(curve):
    assert ToneCurve(**json.loads(json.dumps(dataclasses.asdict(curve)))) == curve


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("rec709",), "unknown tone curve 'rec709', expected one of linear, srgb"),
        (("gamma",), "has 0 parameters, expected 1"),
        (("gamma", (9,)), "has the parameter 9, expected 0.25 to 4"),
        (("gamma", (float("nan"),)), "has the parameter nan"),
        (("warped", (2, 0, 1, 1, 0, 0)), "sum over 0.95"),
        (("srgb", (), POINTS), "has points, expected none"),
        (("table",), "must increase strictly"),
        (("table", (), [(0, 0), (0.5, 0.6), (0.6, 0.6), (1, 1)]), "must increase strictly"),
        (("table", (), [(0, 0), (1, 0.9)]), "must increase strictly"),
    ],
)
def test_an_impossible_curve_is_refused(arguments, message):
    with pytest.raises(DataError, match=message):
        ToneCurve(*arguments)
