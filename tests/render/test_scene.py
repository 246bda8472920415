import runpy
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kpbench.geometry.homography import project, project_disc
from kpbench.patches.design import shipped_patches
from kpbench.render.placement import Limits, Placement, random_placements
from kpbench.render.scene import measure_contrast, render_scene

FOUR = shipped_patches()


def placed(patch, radius_px, x, y, black=20.0, white=230.0, angle_deg=0.0, squash=1.0):
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    H = np.array([[radius_px * c, -radius_px * squash * s, x], [radius_px * s, radius_px * squash * c, y], [0, 0, 1.0]])
    return Placement(patch, H, black, white)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_random_scenes_keep_the_papers_limits(seed):
    limits = Limits()
    placements = random_placements(np.random.default_rng(seed), 640, 480, FOUR, limits)
    assert 0 <= len(placements) <= 10
    rendered = render_scene(np.full((480, 640), 128, np.uint8), placements)
    k = rendered.keypoints
    assert (2 * k["radius_minor"] >= 10 - 1e-4).all()
    assert ((k["radius_major"] - k["radius_minor"]) / k["radius_major"] <= 0.8 + 1e-6).all()
    assert ((k["x"] >= 0) & (k["x"] <= 639) & (k["y"] >= 0) & (k["y"] <= 479)).all()
    assert all(0 <= p.black <= 120 and 180 <= p.white <= 255 for p in placements)
    covered = np.zeros((480, 640))
    for mask in rendered.masks:
        x, y, w, h = mask.box
        big = np.zeros((480 + 1000, 640 + 1000))
        big[500 + y : 500 + y + h, 500 + x : 500 + x + w] = mask.disc > 1e-9  # a running sum leaves rounding behind
        covered += big[500:980, 500:1140]
    assert covered.max(initial=0) <= 1  # no pixel belongs to two patches


def test_the_two_tilts_are_drawn_independently():
    """DeepArUco++ draws both from generators of one seed, so that every marker has equal tilts."""
    rng = np.random.default_rng(0)
    tilts = []
    for _ in range(150):
        for p in random_placements(rng, 640, 480, FOUR, Limits(count=(5, 5))):
            A = p.H_patch2image[:2, :2] - np.outer(p.H_patch2image[:2, 2], p.H_patch2image[2, :2])
            values, vectors = np.linalg.eigh(A @ A.T)
            tilts.append(np.log(values[1] / values[0]) * (vectors[:, 1] ** 2 - 0.5))
    a = np.array(tilts)[:, 0]
    # were both tilts equal, the short axis would always lie on a diagonal and this spread would vanish
    assert np.abs(a).mean() > 0.2
    assert abs(np.mean(a)) < 0.15 * np.abs(a).mean() * np.sqrt(len(a)) / 5


@pytest.mark.parametrize("patch", FOUR, ids=lambda patch: patch.name)
def test_truth_is_the_projected_centre(patch):
    rng = np.random.default_rng(3)
    for p in random_placements(rng, 640, 480, (patch,), Limits(count=(6, 6))):
        k = render_scene(np.zeros((480, 640), np.uint8), [p]).keypoints[0]
        assert np.allclose([k["x"], k["y"]], project(p.H_patch2image, [[0, 0]])[0], atol=1e-9)
        ellipse = project_disc(p.H_patch2image)
        assert np.isclose(k["radius_major"], ellipse.major, rtol=1e-6)
        assert k["patch_id"] == patch.patch_id


def test_a_patch_half_outside_is_half_visible():
    for x, visible in ((30, 1.0), (-0.5, 0.5), (99.5, 0.5)):
        k = render_scene(np.zeros((60, 100), np.uint8), [placed(FOUR[0], 12, x, 30)]).keypoints
        assert np.isclose(k["visible"][0], visible, atol=1e-3)


def test_an_untouched_background_stays_and_the_inks_are_exact():
    background = np.random.default_rng(0).integers(0, 256, (80, 80, 3), dtype=np.uint8)
    rendered = render_scene(background, [placed(FOUR[0], 20, 40, 40, 33, 222)])
    far = np.hypot(*(np.mgrid[:80, :80] - 40)) > 22
    assert (rendered.image[far] == background[far]).all()
    near = np.hypot(*(np.mgrid[:80, :80] - 40)) < 18
    inks = np.unique(rendered.image[near])
    assert {33, 222} <= set(inks.tolist())
    assert inks.min() == 33
    assert inks.max() == 222


@given(st.floats(0, 60), st.floats(120, 255), st.floats(6, 40))
@settings(max_examples=25)
def test_contrast_is_white_minus_black_and_noise_does_not_bias_it(black, white, radius):
    rendered = render_scene(np.full((100, 100), 90, np.uint8), [placed(FOUR[1], radius, 50.3, 49.6, black, white)])
    assert np.isclose(measure_contrast(rendered.image, rendered.masks)[0], white - black, atol=1.5)
    dimmed = (rendered.image * 0.5).astype(np.uint8)
    assert np.isclose(measure_contrast(dimmed, rendered.masks)[0], (white - black) / 2, atol=1.5)


def test_no_patches_is_a_scene_too():
    background = np.full((64, 64), 7, np.uint8)
    rendered = render_scene(background, [])
    assert (rendered.image == 7).all()
    assert len(rendered.keypoints) == 0
    assert rendered.image is not background


@pytest.mark.parametrize("patch", FOUR, ids=lambda patch: patch.name)
def test_an_independent_fit_finds_the_true_centre(patch):
    """A few of the renders that benchmarks/accuracy/truth.py measures; its model shares no code with the renderer."""
    truth = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "accuracy" / "truth.py"))
    measure = truth["measure"]
    measure.__globals__["SUB"] = 5
    errors, _ = measure(patch, 2)
    assert errors.max() < 0.02
