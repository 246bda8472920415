"""Scenes that a camera takes: presets, reproducibility, and truth."""

import dataclasses

import numpy as np
import pytest

import kpbench
from kpbench import SynthConfig, generate, shipped_patches
from kpbench.camera import ToneCurve, load_camera_preset, shipped_cameras
from kpbench.errors import DataError
from kpbench.fitting import build_pyramid
from kpbench.render import Placement
from kpbench.synth.camera_view import photograph_scene

SMALL = {"size_px": (160, 120), "deteriorate": "none"}


@pytest.mark.parametrize("name", ["industrial", "webcam", "phone", "action-cam"])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_sample_is_a_function_of_config_and_index(name, channels):
    config = SynthConfig(n=3, seed=1, channels=channels, camera=load_camera_preset(name), **SMALL)
    first, again = (config.make(2)[0] for _ in range(2))
    assert first.image.shape == ((120, 160) if channels == 1 else (120, 160, 3))
    assert np.array_equal(first.image, again.image)
    assert first.keypoints.tobytes() == again.keypoints.tobytes()
    assert first.effects[0]["effect"] == "camera"
    assert first.effects[0]["preset"] == name


def test_neither_workers_nor_shards_change_a_byte(tmp_path):
    config = SynthConfig(n=6, seed=2, shard_size=3, camera=load_camera_preset("webcam"), **SMALL)
    one, two = (generate(config, tmp_path / str(workers), workers=workers).dataset for workers in (1, 2))
    assert one.fingerprint == two.fingerprint
    assert one.config["camera"]["name"] == "webcam"
    assert list(one.verify())


PLAIN = {
    "effect": "camera", "preset": "none", "camera_seed": 0, "wavelength_um": 0.55, "f_number": 2.8, "pixel_um": 6.0,
    "defocus_px": 0.0, "corner_loss": 0.0, "k1": 0.0, "red_px": 0.0, "blue_px": 0.0, "velocity_px": [0.0, 0.0],
    "turn_deg": [0.0, 0.0, 0.0], "row_time": 0.0, "ink_gain": 0.0, "bow": 0.0, "twist": 0.0, "axis_deg": 30.0,
    "detail": 0, "detail_seed": 0,
    "full_well_e": 1e6, "exposure": 1.0, "read_noise_e": 0.0, "prnu": 0.0, "dsnu_e": 0.0, "row_noise_e": 0.0,
    "bits": 12, "balance": [1.0, 1.0], "tone": {"name": "srgb", "parameters": []}, "denoise_sigma": 0.0,
    "sharpen_amount": 0.0, "sharpen_sigma_px": 1.0, "jpeg_quality": 0, "bayer": False,
}  # fmt: skip


def take(record, radius=18.0, xy=(60.3, 44.6), patch=1):
    H = np.array([[radius, 0, xy[0]], [0, radius, xy[1]], [0, 0, 1]])
    background = np.full((90, 120), 150, np.uint8)
    rng = np.random.default_rng(0)
    return photograph_scene(background, [Placement(shipped_patches()[patch], H, 40, 220)], rng, PLAIN | record)


def test_inks_keep_their_levels_behind_the_tone_curve_of_the_scene():
    image = take({}).image
    assert abs(int(image[4, 4]) - 150) <= 1
    assert abs(int(np.percentile(image[30:60, 45:75], 2)) - 40) <= 2
    assert abs(int(np.percentile(image[30:60, 45:75], 98)) - 220) <= 2


@pytest.mark.parametrize("patch", range(4))
@pytest.mark.parametrize(
    "record",
    [
        {"k1": -0.2},
        {"velocity_px": [1.0, 0.5]},
        {"velocity_px": [0.3, 0.2], "row_time": 0.04, "k1": -0.1},
        {"defocus_px": 1.5},
    ],
)
def test_the_centre_of_the_picture_is_the_true_centre(patch, record):
    """A fit finds the true centre behind lens, motion and rolling shutter, in linear tone and without noise.

    The fit knows uneven blur to first order only, so that longer motion still moves it.
    """
    linear = {"tone": {"name": "linear", "parameters": []}}
    scene = take(linear | record, patch=patch, xy=(40.2, 30.7))
    (keypoint,) = scene.keypoints
    xy, H = np.array([keypoint["x"], keypoint["y"]]), keypoint["H_patch2image"]
    A = H[:2, :2] - np.outer(H[:2, 2], H[2, :2])
    levels = build_pyramid(scene.image, 0)
    found = kpbench.fit(levels, xy[None] + 0.4, A[None], [shipped_patches()[patch]])
    assert np.hypot(*(found.xy[0] - xy)) < 0.05


def test_a_patch_whose_centre_leaves_the_image_is_not_drawn():
    assert len(take({"k1": 0.4}, xy=(118.9, 88.9)).keypoints) == 0


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ('name = "../x"', "name is '../x'"),
        ("[lens]\nf_number = [8, 4]", r"lens.f_number is \[8, 4\], expected \[least, most\]"),
        ("[lens]\nfnumber = 4", "unknown key 'fnumber' in lens"),
        ('[processing]\ntone = ["hdr"]', "processing.tone names 'hdr'"),
        ("[sensor]\nbits = 99", "sensor.bits is 99"),
        ("[sensor]\nbayer = 1", "sensor.bayer is 1"),
    ],
)
def test_a_wrong_value_in_a_camera_is_named(tmp_path, change, problem):
    head = 'schema = "kpbench.camera/1"\n'
    path = tmp_path / "mine.toml"
    path.write_text(head + change if change.startswith("name") else f'{head}name = "mine"\n{change}\n')
    with pytest.raises(DataError, match=f"mine.toml: {problem}"):
        load_camera_preset(str(path))


def test_every_shipped_camera_draws_records_within_its_ranges():
    for name in shipped_cameras():
        preset = load_camera_preset(name)
        spans, rng = dict(preset.spans), np.random.default_rng(3)
        for _ in range(20):
            record = preset.draw(rng)
            for key in ("f_number", "exposure", "read_noise_e", "sharpen_amount", "k1"):
                assert spans[key][0] - 1e-4 <= record[key] <= spans[key][1] + 1e-4
            ToneCurve(record["tone"]["name"], tuple(record["tone"]["parameters"]))


def test_a_camera_and_a_pipeline_of_ones_own_exclude_each_other():
    config = SynthConfig(n=1, camera=load_camera_preset("webcam"), **SMALL)
    with pytest.raises(DataError, match="`camera` and `augmentation` are both given"):
        dataclasses.replace(config, augmentation='{"transform": {}}')
