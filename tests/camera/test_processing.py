"""The processor against sums by hand, and OpenCV's other code for other types of numbers."""

import cv2
import numpy as np
import pytest

from kpbench.camera import (
    ToneCurve,
    demosaic,
    develop,
    guided_denoise,
    median_denoise,
    mosaic,
    raw_to_light,
    unsharp_mask,
    white_balance,
)

RNG = np.random.default_rng(0)
GREY = cv2.GaussianBlur(RNG.integers(0, 256, (60, 80), dtype=np.uint8), (0, 0), 1.5)
GREY[20:40, 30:60] = 220
COLOUR = np.dstack([GREY, GREY[::-1], GREY[:, ::-1]])


@pytest.mark.parametrize("method", ["bilinear", "edge-aware"])
def test_a_smooth_image_survives_the_mosaic(method):
    y, x = np.mgrid[:40, :50]
    smooth = np.dstack([200 + 3 * x + 2 * y, 900 - 4 * x + 3 * y, 500 + 2 * x - 5 * y]).astype(np.float32)
    found = demosaic(mosaic(smooth).astype(np.uint16), method)
    assert np.abs(found[2:-2, 2:-2] - smooth[2:-2, 2:-2]).max() <= 1
    assert np.abs(found - smooth).max() < 20  # the border, where slopes are mirrored


def test_bilinear_colours_are_means_of_the_nearest_pixels():
    raw = RNG.integers(0, 4096, (24, 30), dtype=np.uint16)
    found = demosaic(raw, "bilinear").astype(float)
    padded = np.pad(raw.astype(float), 1, mode="reflect")
    for y in range(24):
        for x in range(30):
            near = padded[y : y + 3, x : x + 3]
            cross, corners = near[[0, 1, 1, 2], [1, 0, 2, 1]].mean(), near[::2, ::2].mean()
            row, column = near[1, ::2].mean(), near[::2, 1].mean()
            expected = {
                (0, 0): (near[1, 1], cross, corners),
                (1, 1): (corners, cross, near[1, 1]),
                (0, 1): (row, near[1, 1], column),
                (1, 0): (column, near[1, 1], row),
            }[y % 2, x % 2]
            assert np.abs(found[y, x] - expected).max() <= 0.5


def test_edges_keep_their_side():
    """Along a grey edge, the edge-aware way makes the smaller error of green."""
    grey = np.full((40, 40), 200.0, np.float32)
    grey[:, 17:] = 3000
    raw = mosaic(np.dstack([grey] * 3)).astype(np.uint16)
    error = {m: np.abs(demosaic(raw, m)[..., 1] - grey).sum() for m in ("bilinear", "edge-aware")}
    assert error["edge-aware"] < 0.1 * error["bilinear"]


@pytest.mark.parametrize("curve", [ToneCurve("srgb"), ToneCurve("gamma", (2.4,)), ToneCurve("logarithmic", (200,))])
def test_developing_is_its_three_steps(curve):
    raw = RNG.integers(0, 1024, (50, 60, 3), dtype=np.uint16)
    gains = (2.0, 1.0, 1.6)
    steps = curve.encode(white_balance(raw_to_light(raw, 10, 64), gains))
    np.testing.assert_array_equal(develop(raw, curve, 10, 64, gains), steps)
    exact = 255 * curve.value(np.clip((raw - 64.0) / (1023 - 64) * gains, 0, 1))
    assert np.abs(steps - exact).max() < 0.55
    np.testing.assert_array_equal(develop(raw[..., 1], curve, 10, 64), steps[..., 1])


def test_all_sixteen_bits_develop():
    ramp = np.arange(2**16, dtype=np.uint16).reshape(256, 256)
    assert np.abs(develop(ramp, ToneCurve("linear"), bits=16) - ramp / 257).max() <= 0.505


@pytest.mark.parametrize("image", [GREY, COLOUR], ids=["grey", "colour"])
@pytest.mark.parametrize(("amount", "sigma", "threshold"), [(1.0, 1.0, 0), (0.5, 2.3, 4), (2.5, 0.6, 10)])
def test_sharpening_adds_the_difference_to_the_blur(image, amount, sigma, threshold):
    reach = int(np.ceil(4 * sigma))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    taps /= taps.sum()
    wide = np.pad(image.astype(float), [(reach, reach), (reach, reach), (0, 0)][: image.ndim], mode="reflect")
    h, w = image.shape[:2]
    rows = sum(t * wide[k : k + h] for k, t in enumerate(taps))
    detail = image - sum(t * rows[:, k : k + w] for k, t in enumerate(taps))
    exact = image + amount * detail * (np.abs(detail) >= threshold)
    sure = np.abs(np.abs(detail) - threshold) > 0.1  # the filter rounds to 1/16 level between rows and columns
    found = unsharp_mask(image, amount, sigma, threshold)
    assert np.abs(found - np.clip(exact, 0, 255))[sure].max() <= 0.5 + 0.1 * amount


def test_a_flat_image_stays_flat():
    flat = np.full((20, 30), 77, np.uint8)
    for found in (unsharp_mask(flat, 3, 2), guided_denoise(flat), median_denoise(flat)):
        np.testing.assert_array_equal(found, flat)


@pytest.mark.parametrize("side", [3, 5])
def test_the_median_is_the_middle_level(side):
    reach = side // 2
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(GREY, reach, mode="edge"), (side, side))
    np.testing.assert_array_equal(median_denoise(GREY, side), np.median(windows, axis=(2, 3)))


@pytest.mark.parametrize("image", [GREY, COLOUR], ids=["grey", "colour"])
@pytest.mark.parametrize(("side", "sigma"), [(3, 4.0), (5, 10.0), (15, 30.0)])
def test_the_guided_filter_is_its_formula(image, side, sigma):
    def box(values):
        pad = [(side // 2, side // 2)] * 2 + [(0, 0)] * (image.ndim - 2)
        wide = np.pad(values, pad, mode="reflect")
        return np.lib.stride_tricks.sliding_window_view(wide, (side, side), axis=(0, 1)).mean(axis=(-2, -1))

    levels = image.astype(float)
    mean = box(levels)
    variance = box(levels**2) - mean**2
    a = variance / (variance + sigma**2)
    exact = box(a) * levels + box((1 - a) * mean)
    assert np.abs(guided_denoise(image, side, sigma) - exact).max() < 0.6


def test_the_guided_filter_smooths_noise_and_keeps_edges():
    clean = np.full((100, 100), 60, np.uint8)
    clean[:, 50:] = 190
    noisy = np.clip(clean + np.random.default_rng(1).normal(0, 4, clean.shape), 0, 255).round().astype(np.uint8)
    found = guided_denoise(noisy, 5, 8.0).astype(float)
    assert (found - clean)[:, 10:40].std() < 0.4 * 4
    assert found[:, 50].mean() - found[:, 49].mean() > 125


@pytest.mark.parametrize("side", [4, 17, -1])
def test_a_square_of_the_guided_filter_has_a_middle(side):
    with pytest.raises(ValueError, match="expected an odd number of at most 15"):
        guided_denoise(GREY, side)
