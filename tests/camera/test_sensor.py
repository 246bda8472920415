"""The sensor measured as a laboratory measures it: photon transfer, fixed pattern, and SciPy's distributions."""

import numpy as np
import pytest
from scipy import stats

from kpbench.camera import dn_per_electron, expose, mosaic
from kpbench.camera.sensor import _draw_poisson

CAMERA = {"full_well_e": 9000, "gain": 1.5, "read_noise_e": 4.0, "bits": 12, "black_dn": 64}


FEW = {"full_well_e": 80, "gain": 1, "black_dn": 1000}
"""At most 32 electrons fall on a pixel of these flat images, all of them Poisson-distributed by table."""


def flats(levels, rng, **settings):
    """Mean and temporal variance of pairs of flat images per light (EMVA 1288, 6.6)."""
    rows = []
    for level in levels:
        light = np.full((300, 400), level, np.float32)
        a, b = (expose(light, rng, **{**CAMERA, **settings}).astype(float) for _ in range(2))
        rows.append(((a.mean() + b.mean()) / 2, np.var(a - b) / 2))
    return np.array(rows).T


@pytest.mark.parametrize("settings", [{}, {"prnu": 0.01, "dsnu_e": 3.0}, FEW], ids=str)
def test_the_photon_transfer_curve_gives_gain_and_read_noise_back(settings):
    levels = np.linspace(0, 0.4, 17)
    mean, variance = flats(levels, np.random.default_rng(1), **settings)
    camera = {**CAMERA, **settings}
    black = camera["black_dn"]
    K = dn_per_electron(camera["full_well_e"], camera["gain"], 12, black)
    slope, start = np.polyfit(mean - black, variance, 1, w=1 / (variance + 1))
    assert slope == pytest.approx(K, rel=0.02)
    assert np.sqrt(start - 1 / 12) / K == pytest.approx(camera["read_noise_e"], rel=0.02)
    electrons = levels * camera["full_well_e"] / camera["gain"]
    assert np.abs((mean - black) / K - electrons).max() < 0.003 * electrons.max()


def test_few_electrons_are_poisson_distributed():
    rng = np.random.default_rng(2)
    for mean in (0.05, 0.7, 3.3, 12.9, 31.9):
        counts = _draw_poisson(np.full(200_000, mean, np.float32), rng)
        assert counts.mean() == pytest.approx(mean, rel=0.01, abs=0.003)
        assert counts.var() == pytest.approx(mean, rel=0.02, abs=0.003)
        found = np.bincount(counts.astype(int), minlength=80)[:80] / len(counts)
        assert np.abs(np.cumsum(found) - stats.poisson.cdf(np.arange(80), mean)).max() < 0.005


def test_photon_noise_meets_where_its_two_forms_meet():
    rng = np.random.default_rng(3)
    light = np.tile(np.array([31.5, 32.5], np.float32) / 1000, (400, 200))
    raw = expose(light, rng, full_well_e=1000, read_noise_e=1, bits=16) / dn_per_electron(1000, bits=16)
    assert raw[:, ::2].mean() == pytest.approx(31.5, abs=0.1)
    assert raw[:, 1::2].mean() == pytest.approx(32.5, abs=0.1)
    assert raw[:, ::2].var() == pytest.approx(32.5, rel=0.02)
    assert raw[:, 1::2].var() == pytest.approx(33.5, rel=0.02)


def test_the_fixed_pattern_belongs_to_the_camera():
    light = np.full((100, 120), 0.5, np.float32)
    settings = {**CAMERA, "prnu": 0.02, "dsnu_e": 20}

    def mean_image(seed, camera_seed):
        rng = np.random.default_rng(seed)
        return np.mean([expose(light, rng, **settings, camera_seed=camera_seed) for _ in range(24)], axis=0)

    first, again, other = mean_image(0, 5), mean_image(1, 5), mean_image(2, 6)
    assert np.corrcoef(first.ravel(), again.ravel())[0, 1] > 0.95
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.03
    electrons = 0.5 * 9000 / 1.5
    K = dn_per_electron(9000, 1.5, 12, 64)
    noise = (electrons + 4**2) / 24
    assert first.std() / K == pytest.approx(np.sqrt((0.02 * electrons) ** 2 + 20**2 + noise), rel=0.02)


def test_rows_share_their_noise():
    raw = expose(np.full((2000, 100), 0.3, np.float32), np.random.default_rng(0), **CAMERA, row_noise_e=20)
    means = raw.mean(axis=1) / dn_per_electron(9000, 1.5, 12, 64)
    assert means.std() == pytest.approx(np.sqrt(20**2 + (1800 + 16) / 100), rel=0.05)


def test_light_clips_and_exposure_multiplies():
    rng = np.random.default_rng(0)
    assert (expose(np.full((20, 20), 1.5, np.float32), rng, bits=10) == 1023).all()
    assert expose(np.zeros((20, 20), np.float32), rng, read_noise_e=0).max() == 0
    halved = expose(np.full((100, 100), 0.8, np.float32), rng, exposure=0.5, bits=10)
    assert halved.mean() == pytest.approx(0.4 * 1023, rel=0.002)
    full = expose(np.full((20, 20), 0.99, np.float32), rng, 1000, gain=0.5, read_noise_e=0, bits=10)
    assert full.max() == 512  # the well is full before the converter is
    assert expose(np.full((8, 9, 3), 0.5, np.float32), rng).shape == (8, 9, 3)


def test_the_same_seed_gives_the_same_image_and_leaves_the_light():
    light = np.random.default_rng(0).random((50, 60)).astype(np.float32)
    before = light.copy()
    a, b = (expose(light, np.random.default_rng(7), **CAMERA, prnu=0.01) for _ in range(2))
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(light, before)


def test_the_mosaic_takes_one_colour_per_pixel():
    light = np.random.default_rng(0).random((5, 7, 3)).astype(np.float32)
    found = mosaic(light, (0.5, 1, 0.25))
    for y in range(5):
        for x in range(7):
            colour = (y % 2) + (x % 2)
            assert found[y, x] == light[y, x, colour] * (0.5, 1, 0.25)[colour]
