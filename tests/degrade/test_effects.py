import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kpbench.degrade.blurs import blur, box_taps, line_kernel, motion_blur
from kpbench.degrade.effects import dimming, noise
from kpbench.degrade.ladder import (
    EFFECT_FUNCTIONS,
    LADDER_MIX,
    apply_effects,
    draw_effect,
    draw_ladder_mix,
    draw_paper_mix,
)
from kpbench.degrade.weather import rain, shadow


def picture(channels=1):
    rng = np.random.default_rng(0)
    shape = (60, 80) if channels == 1 else (60, 80, 3)
    return rng.integers(30, 220, shape, dtype=np.uint8)


def apply_mix(image, seed):
    rng = np.random.default_rng(seed)
    return apply_effects(image, rng, draw_paper_mix(rng))


@given(st.floats(1, 31))
def test_box_taps_are_centred_and_as_wide_as_asked(kernel_px):
    taps = box_taps(kernel_px)
    offset = np.arange(len(taps)) - len(taps) // 2
    assert abs(taps @ offset) < 1e-9
    assert np.isclose(taps.sum(), 1)
    assert np.isclose(1 / taps.max(), kernel_px)


@given(st.floats(1, 25), st.floats(0, 360))
def test_motion_kernels_are_centred(length_px, angle_deg):
    kernel = line_kernel(length_px, angle_deg)
    reach = len(kernel) // 2
    assert np.isclose(kernel.sum(), 1)
    assert abs(kernel.sum(axis=0) @ np.arange(-reach, reach + 1)) < 1e-9
    assert abs(kernel.sum(axis=1) @ np.arange(-reach, reach + 1)) < 1e-9


def test_a_motion_kernel_has_the_length_and_direction_asked_for():
    kernel = line_kernel(12, 30)
    y, x = np.mgrid[: len(kernel), : len(kernel)] - len(kernel) // 2
    along = x * np.cos(np.radians(30)) + y * np.sin(np.radians(30))
    # variance of a uniform line of length L is L²/12; a pixel adds 1/12 of its own
    assert np.isclose((kernel * along**2).sum(), 12**2 / 12 + 1 / 12, rtol=0.02)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(
    "effect",
    [
        lambda image: blur(image, 7),
        lambda image: blur(image, 4),
        lambda image: motion_blur(image, 9, 33),
        lambda image: dimming(image, 20),
        lambda image: noise(image, np.random.default_rng(1), 20),
        lambda image: shadow(image, 5),
        lambda image: rain(image, 5),
        lambda image: apply_mix(image, 4),
    ],
)
def test_effects_keep_shape_and_input_and_repeat(effect, channels):
    image = picture(channels)
    before = image.copy()
    result = effect(image)
    assert result.shape == image.shape
    assert result.dtype == np.uint8
    assert (image == before).all()
    assert (effect(image) == result).all()
    assert (result != image).any()


def test_blur_is_the_mean_of_its_box():
    image = picture()
    assert abs(int(blur(image, 7)[30, 40]) - image[27:34, 37:44].mean()) <= 0.5


def test_noise_has_the_deviation_asked_for_and_is_seeded():
    flat = np.full((200, 200), 128, np.uint8)
    got = noise(flat, np.random.default_rng(0), 15).astype(float)
    assert abs(got.std() - 15) < 0.2
    assert abs(got.mean() - 128) < 0.3
    assert (noise(flat, np.random.default_rng(1), 15) != got).any()


def test_dimming_follows_the_law_asked_for():
    white = np.full((4, 4), 255, np.uint8)
    assert [int(dimming(white, k)[0, 0]) for k in (10, 20, 30, 40)] == [153, 92, 55, 33]
    assert [int(dimming(white, k, "literal")[0, 0]) for k in (10, 20)] == [2, 0]  # black at once


def test_the_paper_mix_records_what_it_did():
    image = picture()
    seen = set()
    for seed in range(60):
        effects = draw_paper_mix(np.random.default_rng(seed))
        result = apply_mix(image, seed)
        assert 1 <= len(effects) <= 3
        names = [entry["effect"] for entry in effects]
        assert names == sorted(names, key=list(EFFECT_FUNCTIONS).index)
        seen.update(names)
        if "noise" not in names:
            assert (apply_effects(image, np.random.default_rng(0), effects) == result).all()
    assert seen == {"shadow", "rain", "motion_blur", "blur", "brightness", "noise"}


def test_the_ladder_mix_climbs_to_the_severest_rung_and_records_it():
    image, discs = picture(), np.array([[60.0, 50.0, 14.0]])
    levels: dict[str, list[float]] = {}
    for seed in range(400):
        rng = np.random.default_rng(seed)
        effects = draw_ladder_mix(rng, (80, 60), discs)
        result = apply_effects(image, rng, effects)
        assert result.shape == image.shape
        assert 1 <= len(effects) <= 2
        for entry in effects:
            levels.setdefault(entry["effect"], []).append(next(v for v in entry.values() if not isinstance(v, str)))
        if not {"noise", "low_light"} & {entry["effect"] for entry in effects}:
            assert (apply_effects(image, np.random.default_rng(0), effects) == result).all()
    assert levels.keys() == {name.replace("-", "_").replace("rain", "rainfall") for name in LADDER_MIX}
    for effect, severest in {"blur": 15, "noise": 60, "motion_blur": 30, "low_light": 9, "dimming": 40}.items():
        assert 0.7 * severest < max(levels[effect]) <= severest
        assert min(levels[effect]) < 0.3 * severest
    assert min(levels["jpeg"]) < 30 < 70 < max(levels["jpeg"]) <= 100


@pytest.mark.parametrize("effect", ["shadow", "rain"])
def test_weather_has_the_statistics_of_the_papers_library(effect):
    """The mean and the spread of many images, and the share of untouched pixels, are those of albumentations."""
    import albumentations

    transform = {
        "shadow": albumentations.RandomShadow(shadow_roi=(0, 0, 1, 1), p=1),
        "rain": albumentations.RandomRain(p=1),
    }[effect]
    own = {"shadow": shadow, "rain": rain}[effect]
    image = np.full((240, 320, 3), 120, np.uint8)
    ours, theirs = [], []
    for seed in range(120):
        transform.set_random_seed(seed)
        ours.append(own(image[..., 0], seed))
        theirs.append(transform(image=image)["image"][..., 0])
    for measure in (np.mean, np.std, np.max):
        a, b = ([float(measure(one)) for one in many] for many in (ours, theirs))
        assert abs(np.mean(a) - np.mean(b)) < 4 * np.sqrt((np.var(a) + np.var(b)) / 120) + 0.5
        assert 0.6 < (np.std(a) + 0.1) / (np.std(b) + 0.1) < 1.6


def test_a_quality_between_two_is_recorded_as_the_one_applied():
    assert draw_effect(np.random.default_rng(0), "jpeg", 7.6, (20, 20))["quality"] == 8.0
