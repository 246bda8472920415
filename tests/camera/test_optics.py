"""The lens against Bessel functions, sums by hand, and formulas written out once more."""

import cv2
import numpy as np
import pytest
from scipy import ndimage, special

from kpbench.camera import blur_linear, chromatic_scales, psf_kernel, vignetting

LENSES = [(0.55, 2.0, 3.0, 0.0), (0.55, 2.8, 1.4, 0.7), (0.5, 8.0, 3.45, 0.0), (0.5, 8, 2.0, 1.5), (0.55, 4, 3.0, 6.0)]


def radii(kernel):
    reach = len(kernel) // 2
    steps = np.arange(-reach, reach + 1)
    return np.hypot(steps, steps[:, None])


@pytest.mark.parametrize("lens", [*LENSES, (0, 1, 1, 3.0)])
def test_a_kernel_is_symmetric_with_the_sum_one(lens):
    kernel = psf_kernel(*lens)
    assert kernel.min() >= 0
    assert abs(kernel.sum() - 1) < 1e-12
    for other in (kernel[::-1], kernel[:, ::-1], kernel.T):
        assert np.abs(kernel - other).max() < 1e-12


def test_the_airy_disc_holds_its_share_of_the_light():
    unit = 8.0  # px per wavelength x f-number; the first dark ring is 1.22 of them
    kernel = psf_kernel(0.5, 16.0, 1.0, reach_px=120)
    r = radii(kernel)
    v = np.pi * r / unit

    def encircled(at):  # Rayleigh's formula; Born & Wolf 8.5.2, eq. 18
        return 1 - special.j0(at) ** 2 - special.j1(at) ** 2

    whole = encircled(np.pi * 120.5 / unit)  # of the square, about that of the circle in it
    for dark, share in ((3.8317, 0.838), (7.0156, 0.910), (10.1735, 0.938)):
        assert kernel[v <= dark].sum() * whole == pytest.approx(share, abs=0.003)
        assert share == pytest.approx(encircled(dark), abs=5e-4)
    expected = (2 * special.j1(v) / np.where(v > 0, v, 1)) ** 2
    expected[120, 120] = 1
    assert np.abs(kernel / kernel.max() - expected).max() < 2e-3


@pytest.mark.parametrize("lens", LENSES)
def test_a_kernel_transfers_contrast_as_the_lens_does(lens):
    wavelength, f_number, pixel, radius = lens
    kernel = psf_kernel(*lens)
    reach = len(kernel) // 2
    for frequency in (0.05, 0.1, 0.2, 0.3, 0.4):
        share = min(frequency * wavelength * f_number / pixel, 1)
        expected = 2 / np.pi * (np.arccos(share) - share * np.sqrt(1 - share**2))
        x = 2 * np.pi * radius * frequency
        expected *= 2 * special.j1(x) / x if x else 1
        found = (kernel.sum(axis=0) * np.cos(2 * np.pi * frequency * np.arange(-reach, reach + 1))).sum()
        assert found == pytest.approx(expected, abs=0.06)


def test_the_largest_defocus_has_a_kernel():
    assert psf_kernel(0.55, 2, 3, 35.0).shape == (75, 75)
    with pytest.raises(ValueError, match="defocus_px is 36, expected 0 to 35"):
        psf_kernel(0.55, 2, 3, 36)


def test_defocus_alone_is_a_disc():
    kernel = psf_kernel(0, 1, 1, 12.0)
    r = radii(kernel)
    assert kernel[r < 12.5].sum() > 0.98
    assert np.average(r**2, weights=kernel) == pytest.approx(12**2 / 2, rel=0.03)


@pytest.mark.parametrize("side", [3, 5, 9, 15])
@pytest.mark.parametrize("shape", [(37, 52), (40, 33, 3)])
def test_blur_is_the_weighted_sum(side, shape):
    rng = np.random.default_rng(side)
    light = rng.random(shape).astype(np.float32) * 3
    kernel = rng.random((side, side))  # not symmetric: it is a correlation
    planes = np.atleast_3d(light).astype(np.float64)
    expected = np.dstack(
        [ndimage.correlate(p, kernel / kernel.sum(), mode="mirror") for p in np.moveaxis(planes, 2, 0)]
    )
    blurred = blur_linear(light, kernel)
    assert blurred.dtype == np.float32
    assert blurred.shape == shape
    assert np.abs(blurred.reshape(expected.shape) - expected).max() < 6e-6 * side


@pytest.mark.parametrize("side", [5, 11])
def test_blurred_sums_are_exact(side):
    """The largest light and the longest sums: whole numbers come out of both ways without an error."""
    rng = np.random.default_rng(0)
    whole = rng.integers(0, 2**14, (64, 80))
    kernel = rng.integers(1, 9, (side, side)).astype(float)
    kernel[0, 0] += 2**10 - kernel.sum()
    exact = cv2.filter2D(whole.astype(float), -1, kernel, borderType=cv2.BORDER_REFLECT_101)
    found = blur_linear((whole / 2**10).astype(np.float32), kernel)
    np.testing.assert_array_equal(found, (exact / 2**20).astype(np.float32))


def test_a_flat_image_stays_flat():
    flat = np.full((30, 40), 0.375, np.float32)
    for lens in LENSES:
        np.testing.assert_array_equal(blur_linear(flat, psf_kernel(*lens)), flat)


def test_light_falls_with_cos4_and_the_polynomial():
    light = np.random.default_rng(0).random((48, 64, 3)).astype(np.float32)
    found = vignetting(light, focal_length_px=50, polynomial=(-0.2, 0.05), centre_px=(20, 25))
    for x, y in ((0, 0), (63, 47), (20, 25), (40, 3)):
        r = np.hypot(x - 20, y - 25)
        rho = r / np.hypot(32, 24)
        factor = np.cos(np.arctan(r / 50)) ** 4 * (1 - 0.2 * rho**2 + 0.05 * rho**4)
        assert found[y, x] == pytest.approx(light[y, x] * factor, rel=1e-6)
    np.testing.assert_array_equal(found[25, 20], light[25, 20])


def test_colours_part_at_the_corner():
    red, green, blue = chromatic_scales(0.8, -0.4, (800, 600))
    assert (red - 1) * 500 == pytest.approx(0.8)
    assert green == 1
    assert (blue - 1) * 500 == pytest.approx(-0.4)
