"""The predicted bias against a nonlinear fit that shares no code with it but the definition of the designs."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares

import kpbench
from kpbench.analysis import BIAS_EFFECTS, analyse_patches, camera_bias, code_of, search
from kpbench.analysis.family import Family
from kpbench.errors import DesignError

NAMED = {patch.name: patch for patch in kpbench.shipped_patches()}
RADIUS, BLUR, SUB, HALF = 12.0, 1.0, 8, 17
AXIS = (np.arange((2 * HALF + 1) * SUB) + 0.5) / SUB - HALF - 0.5


def cover(patch, pose, blur):
    """Black ink as counted at 8 x 8 points a pixel, blurred by a Gaussian."""
    H = np.append(pose, 1.0).reshape(3, 3)
    x, y = np.meshgrid(AXIS, AXIS)
    u, v, w = np.linalg.solve(H, np.stack([x.ravel(), y.ravel(), np.ones(x.size)]))
    points = np.stack([u / w, v / w], axis=-1).reshape(*x.shape, 2)
    black = patch.is_black(points) & (np.hypot(*np.moveaxis(points, -1, 0)) < 1)
    pixels = black.reshape(2 * HALF + 1, SUB, 2 * HALF + 1, SUB).mean(axis=(1, 3))
    return gaussian_filter(pixels, blur)


def srgb(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("name", ["checker", "wheel"])
def test_a_nonlinear_fit_of_a_linear_camera_finds_the_predicted_bias(name):
    patch, still = NAMED[name], np.array([RADIUS, 0, 0, 0, RADIUS, 0, 0, 0])
    grid = np.linspace(0, 1, 10001)
    dark, bright = np.interp([40 / 255, 220 / 255], srgb(grid), grid)
    seen = srgb(bright + (dark - bright) * cover(patch, still, BLUR))
    near = np.hypot(*np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]) < RADIUS - 2 * BLUR - 1

    start = np.concatenate([still, [BLUR, 220 / 255, -180 / 255]])
    scale = np.array([1, 1, 1, 1, 1, 1, 1 / RADIUS, 1 / RADIUS, 1, 1, 1])

    def residuals(q):
        p = start + (q - 1) * scale  # the steps of the numerical derivatives are in proportion to q, which is near 1
        return (p[9] + p[10] * cover(patch, p[:8], p[8]) - seen)[near]

    found = start + (least_squares(residuals, np.ones(11), "3-point", diff_step=0.3, max_nfev=8).x - 1) * scale
    moved = np.hypot(found[2], found[5])
    assert moved == pytest.approx(camera_bias(patch, RADIUS, BLUR)["sRGB"], abs=0.012)
    assert (moved > 0.04) == (name == "wheel")


def test_a_design_with_half_turn_symmetry_keeps_its_centre_and_a_tone_curve_in_the_fit_helps_the_others():
    for name, patch in NAMED.items():
        plain, toned = camera_bias(patch), camera_bias(patch, knows_tone=True)
        assert list(plain) == list(BIAS_EFFECTS)
        for effect in ("sRGB", "S-curve", "ink gain"):
            assert plain[effect] < 1e-6 if name == "checker" else plain[effect] > 0.02
            assert toned[effect] < 0.006


def test_the_bias_grows_in_proportion_to_patch_and_blur():
    small, large = (camera_bias(NAMED["mushroom"], k * 16.0, k * 1.0)["sRGB"] for k in (1, 2))
    assert large == pytest.approx(2 * small, rel=0.1)


def test_a_patch_too_small_for_its_blur_has_no_bound():
    assert camera_bias(NAMED["wheel"], 5.0, 2.0)["bow"] == float("inf")


def test_a_search_with_a_limit_leaves_out_designs_that_a_camera_moves(monkeypatch):
    codes = np.array([code_of(patch) for patch in NAMED.values()], np.uint32)
    small = Family(codes, np.zeros(4, np.int64) - 1, np.zeros(4, np.int64))
    monkeypatch.setattr(search, "enumerate_family", lambda: small)
    monkeypatch.setattr(search, "basin", lambda grid, inks: np.full(len(inks), 0.2))
    with pytest.raises(DesignError, match=r"`most_bias_px` of 0\.02 leaves 1 designs"):
        search.search_designs(np.zeros((5, 21, 21), np.uint8), tuple(NAMED.values()), most_bias_px=0.02)


def test_the_limit_needs_a_search():
    with pytest.raises(DesignError, match="`search_family=True`"):
        analyse_patches(most_bias_px=0.1)
