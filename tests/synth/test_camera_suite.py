"""Suites that a camera takes: reproducibility, pairs, truth, and what is refused."""

import dataclasses

import numpy as np
import pytest

from kpbench import SuiteConfig, generate, load_suite
from kpbench.camera import load_camera_preset
from kpbench.errors import DataError
from kpbench.geometry import Camera, write_camera
from kpbench.synth.suite_boards import board_in_view
from kpbench.synth.suite_file import shipped_suites

SMALL = {"images": 2, "size_px": (203, 155)}
TEXT = shipped_suites()["camera-v1"].read_text()


def test_neither_workers_nor_calls_change_a_byte(tmp_path):
    config = SuiteConfig(load_suite("camera-v1"), **SMALL, only=("moving-board", "bayer-denoise"), shard_size=16)
    one, two = (generate(config, tmp_path / str(workers), workers=workers).dataset for workers in (1, 2))
    assert one.fingerprint == two.fingerprint
    assert list(one.verify())
    record = one.effects(0)[0]
    assert record["effect"] == "camera"
    assert np.isclose(np.hypot(*record["velocity_px"]), config.suite.conditions[6].camera[0][1][0], atol=1e-3)
    assert one.config["preset"]["name"] == "camera-v1"


def test_every_condition_makes_another_image_of_the_same_scene():
    config = SuiteConfig(load_suite("camera-v1"), images=1, size_px=(406, 310))
    assert len({c.name for c in config.suite.conditions}) == 13
    images = [config.make(n)[0] for n in range(0, config.n, 4)]
    assert len({sample.image.tobytes() for sample in images}) == len(images)
    flat = {"ink-gain", "chromatic", "night", "bayer-denoise", "sharpen", "tone", "tone+ink-gain"}
    places = {s.keypoints["x"].tobytes() for s in images if s.condition in flat}
    assert len(places) == 1  # these conditions move nothing
    for sample in images:
        assert sample.image.ndim == 2
        assert (sample.keypoints["visible"] > 0.99).all()
        assert len(sample.keypoints) == (1 if sample.condition == "detail" else 6)


def test_a_camera_takes_the_scenes_of_any_suite():
    plain = SuiteConfig(load_suite("paper-v1"), **SMALL, only=("blur",))
    taken = dataclasses.replace(plain, preset=load_camera_preset("phone"))
    a, b = plain.make(0)[0], taken.make(0)[0]
    assert [effect["effect"] for effect in b.effects] == ["camera", "blur"]
    assert np.abs(a.keypoints["x"] - b.keypoints["x"]).max() < 12
    assert (a.image != b.image).any()
    assert board_in_view(taken.to_dict()) is None
    assert "preset" not in plain.to_dict()


@pytest.mark.parametrize("board", ["aruco", "charuco"])
def test_boards_of_tags_take_part(board):
    config = SuiteConfig(load_suite("camera-v1"), **SMALL, only=("ink-gain", "detail"), board=board)
    for n in (0, config.n - 1):
        assert len(config.make(n)[0].keypoints) == (8 if board == "aruco" else 6)


def test_a_calibration_gives_lens_and_size(tmp_path):
    camera = Camera(320, 240, 200.0, (-0.25, 0.05, 0.001, 0.0), focal_y_px=201.0, principal_px=(163.0, 118.0))
    write_camera(tmp_path / "mine.yaml", camera)
    preset = load_camera_preset(str(tmp_path / "mine.yaml"))
    config = SuiteConfig(load_suite("paper-v1"), images=1, only=("pitch",), preset=preset)
    assert config.camera == camera
    sample = config.make(0)[0]
    assert sample.image.shape == (240, 320)
    view = config.view(0)
    inside = np.column_stack([view.board.points_mm[:, :2], np.ones(6)]) @ view.pose.M_board2camera.T
    assert np.allclose(camera.project(inside), np.column_stack([sample.keypoints["x"], sample.keypoints["y"]]))
    with pytest.raises(DataError, match="640x470 px, expected the camera's 320x240"):
        SuiteConfig(load_suite("paper-v1"), images=1, size_px=(640, 470), preset=preset)


def test_a_lens_and_a_camera_exclude_each_other():
    with pytest.raises(DataError, match="`preset` and `distortion` are both given"):
        SuiteConfig(load_suite("paper-v1"), **SMALL, distortion=(0.1,), preset=load_camera_preset("webcam"))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("f_number = 4.0", "f_number = 0", r"camera.lens.f_number is 0, expected a number from 0.5 to 64"),
        ("bits = 12", "bit = 12", r"unknown key 'bit' in camera.sensor"),
        ('tone = ["srgb"]', 'tone = ["hdr"]', "camera.processing.tone names 'hdr'"),
        ("{ bow = [", "{ bend = [", r"unknown key 'bend' in condition\[3\].camera"),
        ("{ bow = [0.1, 0.2] }", "{ bow = [0.1] }", r"condition\[3\].camera.bow is \[0.1\]"),
        ("{ bow = [0.1, ", "{ bow = [6, ", r"condition\[3\].camera.bow\[0\] is 6, expected a number from -0.2 to 0.2"),
        ("[true, true, true]", "[true, 1, true]", r"condition\[7\].camera.bayer is \[True, 1, True\], expected a list"),
        ('["s-curve", "s-curve", "s-curve"]', '["s-curve"]', r"condition\[0\].camera.tone is \['s-curve'\], expected"),
        (
            'board = "single"',
            'board = "double"',
            r"condition\[12\].board is 'double', expected one of: hexagon, single",
        ),
    ],
)
def test_a_wrong_camera_in_a_suite_is_one_line(tmp_path, old, new, says):
    assert old in TEXT
    path = tmp_path / "mine.toml"
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(DataError, match=rf"mine\.toml: .*{says}"):
        load_suite(str(path))


def test_a_board_as_fast_as_the_shutter_is_refused(tmp_path):
    (tmp_path / "fast.toml").write_text(TEXT.replace("row_time = [0.05, 0.1, 0.2]", "row_time = [0.05, 0.1, 0.9]"))
    with pytest.raises(DataError, match=r"motion_px 2 times row_time 0\.9 is over 0\.5"):
        SuiteConfig(load_suite(str(tmp_path / "fast.toml")), images=1)
    path = tmp_path / "mine.toml"
    path.write_text('schema = "kpbench.camera/1"\nname = "mine"\n[scene]\nmotion_px = 50\nrow_time = 0.5\n')
    with pytest.raises(DataError, match=r"motion_px 50 times row_time 0\.5 is over 0\.5"):
        load_camera_preset(str(path))
    path.write_text('schema = "kpbench.camera/1"\nname = "mine"\n[scene]\nbow = 0.1\ntwist = 0.1\n')
    with pytest.raises(DataError, match="has both bow and twist"):
        load_camera_preset(str(path))
