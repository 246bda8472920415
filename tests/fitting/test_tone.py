"""The fit behind tone curves that it is not told: benchmarks/accuracy/tone_bias.py, in small."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from kpbench import shipped_patches
from kpbench.fitting.drawing import tone_curve, tone_slopes

PATH = Path(__file__).parents[2] / "benchmarks" / "accuracy" / "tone_bias.py"


@pytest.fixture(scope="module")
def tone_bias():
    spec = importlib.util.spec_from_file_location("benchmarks_tone_bias", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("patch", shipped_patches(), ids=lambda patch: patch.name)
@pytest.mark.parametrize("curve", ["linear", "sRGB", "S-curve", "logarithmic"])
def test_a_tone_curve_does_not_move_the_centre(tone_bias, patch, curve):
    """Without the curve among the unknowns, three of the designs move by 0.04 to 0.26 px."""
    errors = tone_bias.measure(patch, 20, 2, tone_bias.CURVES[curve], noise=2.0, draws=10, seed=4)
    assert np.hypot(*errors.mean(axis=0)) < 0.025


def test_the_derivatives_of_the_tone_curve_are_those_of_its_values():
    ink, step = np.linspace(0, 1, 41, dtype=np.float32), np.float32(1e-3)
    toned, (slope, even, odd) = tone_curve(ink, 0.4, -0.3), tone_slopes(ink, 0.4, -0.3)
    assert toned[0] == 0
    assert toned[-1] == 1
    up, down = (tone_curve(ink + s, 0.4, -0.3) for s in (step, -step))
    np.testing.assert_allclose((up - down) / (2 * step), slope, atol=2e-3)
    np.testing.assert_allclose(tone_curve(ink, 1.4, -0.3) - toned, even, atol=1e-6)
    np.testing.assert_allclose(tone_curve(ink, 0.4, 0.7) - toned, odd, atol=1e-6)
