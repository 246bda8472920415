import importlib.util
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from kpbench.degrade.blurs import blur, box_taps, disc_kernel, line_kernel
from kpbench.degrade.effects import (
    flare,
    low_light,
    noise,
    occlusion,
    polygon_cover,
    shadow_edge,
    strip_corners,
)
from kpbench.degrade.ladder import EFFECT_FUNCTIONS, LADDER, OUTLINES_OF_COVER, apply_effects, draw_effect
from kpbench.errors import DataError
from kpbench.filters import gaussian_taps
from kpbench.geometry.coverage import rasterise

RUNGS = [(effect, level) for effect, severity in LADDER.items() for level in severity.levels]
BLURS = ("blur", "gaussian-blur", "motion-blur", "defocus")


@pytest.fixture(scope="module")
def measure():
    """benchmarks/accuracy/ladder.py, which measures shifts and widths."""
    path = Path(__file__).parents[2] / "benchmarks" / "accuracy" / "ladder.py"
    spec = importlib.util.spec_from_file_location("benchmarks_ladder", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def picture(channels):
    rng = np.random.default_rng(0)
    small = rng.integers(30, 220, (12, 16, 3), dtype=np.uint8)
    image = cv2.resize(small, (160, 120))
    return image if channels == 3 else np.ascontiguousarray(image[..., 0])


def test_the_papers_rungs_are_the_papers():
    assert LADDER["blur"].levels == (3, 7, 11, 15)
    assert LADDER["dimming"].levels == (10, 20, 30, 40)
    assert LADDER["noise"].levels == (15, 30, 45, 60)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(("effect", "level"), RUNGS)
def test_a_recorded_effect_repeats_and_keeps_shape_and_input(effect, level, channels):
    image = picture(channels)
    before = image.copy()
    recorded = draw_effect(np.random.default_rng(3), effect, level, (160, 120))
    results = [apply_effects(image, np.random.default_rng(5), [recorded]) for _ in range(2)]
    assert (results[0] == results[1]).all()
    assert results[0].dtype == np.uint8
    assert results[0].shape == image.shape
    assert (results[0] != image).any()
    assert (image == before).all()
    assert draw_effect(np.random.default_rng(3), effect, level, (160, 120)) == recorded


@pytest.mark.parametrize("effect", sorted(set(LADDER) - {"dimming-literal"}))
def test_a_higher_rung_does_more(effect):
    image = picture(1)
    done = []
    for level in LADDER[effect].levels:
        worn = apply_effects(
            image, np.random.default_rng(5), [draw_effect(np.random.default_rng(3), effect, level, (160, 120))]
        )
        done.append(np.mean((worn.astype(float) - image) ** 2))
    assert (np.diff(done) > 0).all()


@pytest.mark.parametrize(
    "kernel",
    [disc_kernel(r) for r in (0.6, 2, 4, 7.3)]
    + [np.outer(t, t) for t in (gaussian_taps(0.7), gaussian_taps(4.5), box_taps(6.4))]
    + [line_kernel(length, angle) for length in (5, 10, 30) for angle in (0, 17.3, 90, 141)],
)
def test_every_kernel_is_centred_and_keeps_the_light(kernel):
    at = np.arange(len(kernel)) - len(kernel) // 2
    assert np.isclose(kernel.sum(), 1, atol=1e-12)
    assert abs(kernel.sum(axis=0) @ at) < 1e-6
    assert abs(kernel.sum(axis=1) @ at) < 1e-6


def test_a_defocused_point_is_a_disc_of_its_radius():
    kernel = disc_kernel(6.0)
    y, x = np.mgrid[: len(kernel), : len(kernel)] - len(kernel) // 2
    assert np.isclose(1 / kernel.max(), np.pi * 36, rtol=1e-3)
    assert (kernel[np.hypot(x, y) > 6.0 + 0.71] < 1e-12).all()
    assert np.isclose((kernel * (x**2 + y**2)).sum(), 36 / 2 + 1 / 6, rtol=3e-3)


@pytest.mark.parametrize("effect", BLURS)
def test_no_edge_appears_at_the_border(effect):
    flat = np.full((60, 80), 77, np.uint8)
    for level in LADDER[effect].levels:
        assert (apply_effects(flat, None, [draw_effect(np.random.default_rng(1), effect, level, (80, 60))]) == 77).all()


@pytest.mark.parametrize("effect", [e for e in LADDER if e not in ("noise", "low-light", "jpeg", "dimming-literal")])
def test_no_effect_moves_a_patch(measure, effect):
    shifts = np.array([measure.shift(effect, LADDER[effect].levels[-1], seed) for seed in range(3)])
    assert np.hypot(*shifts.T).max() < 0.01


def test_the_measurement_sees_a_shift(measure, monkeypatch):
    monkeypatch.setitem(
        EFFECT_FUNCTIONS,
        "blur",
        lambda image, kernel_px: cv2.warpAffine(
            blur(image, kernel_px), np.array([[1, 0, 0.25], [0, 1, -0.125]]), image.shape[::-1], borderValue=200
        ),
    )
    assert np.allclose(measure.shift("blur", 7, 0), (0.25, -0.125), atol=0.02)


@pytest.mark.parametrize(("effect", "level"), [(e, level) for e in BLURS for level in LADDER[e].levels])
def test_blur_is_as_wide_as_it_says(measure, effect, level):
    assert np.isclose(measure.edge_width(effect, level), level, rtol=0.05)


def test_noise_is_as_strong_as_it_says():
    flat = np.full((200, 200), 128, np.uint8)
    for sigma in (15, 30):
        assert np.isclose(noise(flat, np.random.default_rng(0), sigma).std(), sigma, rtol=0.01)


@pytest.mark.parametrize("stops", [2, 4, 7])
def test_low_light_has_the_noise_of_its_electrons(stops):
    grey = 128
    got = low_light(np.full((300, 300), grey, np.uint8), np.random.default_rng(0), stops).astype(float)
    electrons = 10_000 * grey / 255 / 2**stops
    gain = min(16, 2**stops)
    step = 10_000 / 1023 / gain  # electrons a step of the converter
    sigma = np.sqrt(electrons + 3**2 + step**2 / 12) * grey / electrons
    assert np.isclose(got.std(), np.hypot(sigma, 12**-0.5), rtol=0.02)
    assert np.isclose(got.mean(), grey, atol=4 * sigma / 300)


def test_low_light_runs_out_of_grey_levels_once_the_gain_is_spent():
    ramp = np.tile(np.arange(256, dtype=np.uint8), (200, 1))
    dark = low_light(ramp, np.random.default_rng(0), 12, full_well_e=1e9, read_noise_e=0)
    assert len(np.unique(dark)) == 5  # 1023 x 16 / 2¹² is 3.996: 0 to 4


def test_a_shadow_edge_takes_its_share_of_light_on_one_side():
    image = np.full((100, 100), 200, np.uint8)
    got = shadow_edge(image, 50, 50, 0, 0.3, 4)
    assert (got[:, :48] == 200).all()
    assert (got[:, 53:] == 60).all()
    assert got[10, 50] == 130


@pytest.mark.parametrize("level", [10, 25, 40])
def test_occlusion_hides_the_share_it_says(level):
    discs = np.array([[50.3, 60.1, 20.0], [130.0, 60.0, 12.5]])
    recorded = draw_effect(np.random.default_rng(0), "occlusion", level, (180, 120), discs)
    cover = polygon_cover(strip_corners(recorded["strips"]), (0, 0, 180, 120))
    angles = np.radians(np.arange(360))
    for x, y, radius in discs:
        rim = np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])
        disc = rasterise([[rim]], [(0, 0, 180, 120)])[0]
        assert np.isclose((disc * cover).sum() / disc.sum(), level / 100, atol=0.01)
    image = np.full((120, 180), 255, np.uint8)
    assert ((occlusion(image, recorded["strips"]) < 255) == (cover > 1 / 255)).mean() > 0.999
    part = polygon_cover(strip_corners(recorded["strips"]), (40, 30, 50, 60))
    assert np.allclose(part, cover[30:90, 40:90])


def test_strips_beyond_the_image_change_nothing():
    image = picture(3)
    assert (occlusion(image, [[-500.0, 20.0, 30.0, 10.0, 45.0, 0.0]]) == image).all()


def test_flare_adds_light_and_takes_none():
    image = picture(1)
    got = flare(image, 40, 30, 120, 25).astype(int)
    assert (got >= image).all()
    assert abs(got[30, 40] - min(255, int(image[30, 40]) + 120)) <= 8  # a ghost may lie there


def test_a_dimmed_picture_by_the_printed_law_is_black():
    image = picture(1)
    rng = np.random.default_rng(0)
    worn = [
        apply_effects(image, rng, [draw_effect(rng, "dimming-literal", k, (160, 120))]).max() for k in (10, 20, 30, 40)
    ]
    assert worn[0] <= 2
    assert worn[1:] == [0, 0, 0]


@pytest.mark.parametrize(
    ("effect", "level", "says"),
    [
        ("fog", 3, "there is no effect 'fog', only: blur, dimming"),
        ("blur", 0, r"blur takes a level from 1 to 501 \(px\), not 0"),
        ("jpeg", 101, r"jpeg takes a level from 1 to 100 \(quality\), not 101"),
        ("low-light", float("nan"), "low-light takes a level from 0 to 14"),
    ],
)
def test_a_level_that_makes_no_sense_is_told(effect, level, says):
    with pytest.raises(DataError, match=says):
        draw_effect(np.random.default_rng(0), effect, level, (160, 120))


# --- hands and cables ---------------------------------------------------------------------------------------------

BOARD = np.array([[x, y, 16.0] for x, y in ((120, 80), (180, 80), (210, 120), (180, 160), (120, 160), (90, 120))])


@pytest.mark.parametrize("effect", ["hand", "cable"])
def test_a_limb_hides_what_its_outline_covers_and_more_with_the_level(effect):
    image, shares = np.full((240, 300), 128, np.uint8), []
    for level in LADDER[effect].levels:
        record = draw_effect(np.random.default_rng(4), effect, level, (300, 240), BOARD)
        cover = polygon_cover(OUTLINES_OF_COVER["limbs"](record), (0, 0, 300, 240))
        drawn = apply_effects(image, np.random.default_rng(0), [record]) != 128
        assert (drawn <= (cover > 0)).all()
        assert drawn[cover > 0.999].mean() > 0.9  # some limbs are as grey as the image
        shares.append(cover.mean())
    assert shares == sorted(shares)
    assert shares[-1] > 1.5 * shares[0]


def test_more_cables_keep_the_first_ones():
    one, four = (draw_effect(np.random.default_rng(4), "cable", n, (300, 240), BOARD)["limbs"] for n in (1, 4))
    assert four[: len(one)] == one
    assert len(four) == 4 * len(one)


def test_a_limb_is_the_hull_of_two_discs():
    [outline] = OUTLINES_OF_COVER["limbs"]({"limbs": [[10.0, 20.0, 60.0, 20.0, 8.0, 4.0, 0.0]]})
    assert np.allclose([outline[:, 0].min(), outline[:, 0].max()], [2, 64], atol=0.1)
    area = abs(np.sum(outline[:, 0] * np.roll(outline[:, 1], -1) - np.roll(outline[:, 0], -1) * outline[:, 1])) / 2
    grid = np.stack(np.meshgrid(np.arange(0, 70, 0.25), np.arange(0, 40, 0.25)), -1)
    t = np.linspace(0, 1, 400)[:, None, None]
    inside = (np.hypot(grid[..., 0] - (10 + 50 * t), grid[..., 1] - 20) <= 8 - 4 * t).any(axis=0)
    assert np.isclose(area, inside.sum() / 16, rtol=0.01)
