from dataclasses import replace

import numpy as np
import pytest
from helpers import rotation

from kpbench.degrade.blurs import blur
from kpbench.degrade.effects import noise
from kpbench.fitting.design_fit import fit
from kpbench.fitting.pyramid import build_pyramid
from kpbench.patches.design import shipped_patches
from kpbench.render.background import procedural_background
from kpbench.render.placement import Placement
from kpbench.render.scene import render_scene

PATCHES = shipped_patches()


def render_design(patch, A, xy, bend=(0.0, 0.0), size=90, background=120):
    H = np.eye(3)
    H[:2, :2] = A + np.outer(xy, bend)
    H[:2, 2] = xy
    H[2, :2] = bend
    return render_scene(np.full((size, size), background, np.uint8), [Placement(patch, H, 40, 210)]).image


def fit_one(image, xy, A, patch):
    return fit(build_pyramid(image, 0), np.array([xy]), np.array([A]), [patch])


@pytest.mark.parametrize("patch", PATCHES, ids=lambda patch: patch.name)
def test_a_clean_patch_is_fitted_exactly(patch):
    xy, A = np.array([44.3, 45.8]), rotation(25) @ np.diag([22.0, 13.0]) @ rotation(70)
    found = fit_one(
        render_design(patch, A, xy), xy + np.array([0.5, -0.4]), A @ np.array([[1.02, -0.01], [0.015, 1.01]]), patch
    )
    assert np.hypot(*(found.xy[0] - xy)) < 0.01
    assert found.black[0] == pytest.approx(40, abs=1.5)
    assert found.white[0] == pytest.approx(210, abs=1.5)
    assert found.ncc[0] > 0.999
    assert found.noise[0] < 2.5


@pytest.mark.parametrize("patch", PATCHES, ids=lambda patch: patch.name)
def test_no_blur_moves_the_centre_and_its_width_is_found(patch):
    xy, A = np.array([45.2, 44.6]), rotation(10) @ np.diag([26.0, 20.0]) @ rotation(140)
    image = blur(render_design(patch, A, xy), 7)
    found = fit_one(image, xy + np.array([0.4, 0.3]), A, patch)
    assert np.hypot(*(found.xy[0] - xy)) < 0.05
    assert found.blur_px[0] == pytest.approx(2.0, abs=0.25)  # a box of 7 px: sqrt((49 - 1) / 12)


def test_perspective_moves_the_centre_of_no_ring():
    wheel = next(patch for patch in PATCHES if len(patch.cells[0]) > 2)
    xy, A = np.array([45.2, 44.6]), rotation(10) @ np.diag([34.0, 20.0]) @ rotation(140)
    found = fit_one(render_design(wheel, A, xy, bend=(0.06, -0.03)), xy, A, wheel)
    assert np.hypot(*(found.xy[0] - xy)) < 0.03


@pytest.mark.parametrize("number", range(len(PATCHES)))
def test_the_error_is_near_the_bound_and_has_no_bias(number):
    """Twice the Cramér-Rao bound of 0.012 to 0.019 px (affine, perspective and inks unknown)."""
    patch, rng, errors = PATCHES[number], np.random.default_rng(number), []
    for _ in range(30):
        xy, A = 30 + rng.uniform(-0.5, 0.5, 2), 12.0 * rotation(rng.uniform(0, 360))
        image = noise(render_design(patch, A, xy, size=60), rng, 10)
        errors.append(fit_one(image, xy + rng.normal(0, 0.3, 2), A, patch).xy[0] - xy)
    assert np.sqrt(np.mean(np.square(errors))) < 0.038
    assert np.abs(np.mean(errors, axis=0)).max() < 0.02


def test_the_wrong_design_fits_worse():
    xy, A = np.array([44.3, 45.8]), 20.0 * rotation(33)
    for n, patch in enumerate(PATCHES):
        fits = [fit_one(render_design(patch, A, xy), xy, A, other).ncc[0] for other in PATCHES]
        assert int(np.argmax(fits)) == n
        assert sorted(fits)[-2] < 0.9


def test_a_patch_at_the_border_is_fitted_on_what_is_there():
    xy, A = np.array([3.3, 40.2]), 20.0 * rotation(15)
    found = fit_one(render_design(PATCHES[0], A, xy), xy + np.array([0.3, 0.3]), A, PATCHES[0])
    assert np.hypot(*(found.xy[0] - xy)) < 0.03


def test_a_wide_surround_on_any_texture_keeps_the_model_before_the_camera():
    rng, wide = np.random.default_rng(1), replace(PATCHES[0], rim=0.5, quiet_zone=1.5)
    levels = build_pyramid(procedural_background(rng, 320, 240), 0)
    xy, scale, angle = rng.uniform(60, 180, (40, 2)), rng.uniform(20, 60, 40), rng.uniform(0, 360, 40)
    A = np.array([size * rotation(deg) @ np.diag([1.0, 0.6]) for size, deg in zip(scale, angle, strict=True)])
    assert np.isfinite(fit(levels, xy, A, [wide] * 40).xy).all()


def test_where_there_is_no_patch_nothing_breaks():
    flat = build_pyramid(np.full((40, 40), 100, np.uint8), 0)
    found = fit(flat, np.array([[20.0, 20.0], [-300.0, 5.0]]), np.array([np.eye(2) * 8] * 2), [PATCHES[0]] * 2)
    assert (found.ncc < 0.1).all()
    none = fit(flat, np.zeros((0, 2)), np.zeros((0, 2, 2)), [])
    assert none.xy.shape == (0, 2)
    assert none.ncc.shape == (0,)


@pytest.mark.parametrize("patch", PATCHES, ids=lambda patch: patch.name)
def test_noise_does_not_move_the_size_of_a_small_patch(patch):
    """The edges of a checker do not tell its size; the starting pose, which saw the rim, does."""
    xy, A = np.array([44.3, 45.8]), np.eye(2) * 6.0
    clean = blur(render_design(patch, A, xy), 3)
    found = [fit_one(noise(clean, np.random.default_rng(k), 10.0), xy, A, patch).A[0] for k in range(12)]
    sizes = np.sqrt(np.linalg.det(found)) / 6.0
    assert np.abs(sizes - 1).max() < 0.08
