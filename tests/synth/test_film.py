"""Films of video-v1: their truth, their speed, what is hidden, and that a frame depends on nothing but its number."""

import numpy as np
import pytest

from kpbench import SuiteConfig, load_suite
from kpbench.errors import DataError
from kpbench.synth.film import draw_path
from kpbench.synth.suite_boards import film_board
from kpbench.synth.suite_file import shipped_suites

TEXT = shipped_suites()["video-v1"].read_text()
SMALL = {"images": 2, "seed": 3, "size_px": (406, 310)}


def config(**changes):
    return SuiteConfig(load_suite("video-v1"), **{**SMALL, **changes})


def test_a_film_is_a_scene_of_frames():
    made = config()
    assert made.n == 4 * 1 * 2 * 60
    views = [made.view(n) for n in (0, 59, 60, 120, 479)]
    assert [(v.rung, v.scene_id, v.frame["frame_index"]) for v in views] == [
        (5, 0, 0),
        (5, 0, 59),
        (5, 1, 0),
        (10, 0, 0),
        (40, 1, 59),
    ]
    assert views[1].frame["time_s"] == pytest.approx(59 / 30)
    assert [made.scene_id(n) for n in (0, 59, 60, 120)] == [0, 0, 1, 0]


def test_frames_do_not_depend_on_other_frames():
    made, again = config(), config(images=1)
    one, other = made.make(57)[0], again.make(57)[0]
    assert (one.image == other.image).all()
    assert one.effects == other.effects
    assert (one.image != made.make(56)[0].image).any()


def test_the_truth_is_the_recorded_pose_and_the_board_stays_in_the_image():
    made = config()
    board, camera = film_board(made.to_dict())
    for n in range(0, made.n, 41):
        view = made.view(n)
        R, t = (np.array(view.frame[name]) for name in ("rotation", "translation_mm"))
        xy = np.column_stack([view.keypoints["x"], view.keypoints["y"]])
        assert np.allclose(camera.project(board.points_mm @ R.T + t), xy, atol=1e-6)
        assert (xy > 0).all()
        assert (xy < [405, 309]).all()


def test_the_speeds_are_reached_and_not_exceeded():
    camera, board = config().camera, config().boards[0]
    speeds, turns = [], []
    for seed in range(8):
        path = draw_path(np.random.default_rng(seed), camera, board, 6.0, speed_px=300.0, turn_deg_s=100.0)
        poses = [path.pose(k / 120) for k in range(600)]
        xy = camera.project(np.array([pose.t_camera for pose in poses]))
        speeds.append(120 * np.linalg.norm(np.diff(xy, axis=0), axis=1).max())
        R = np.array([pose.R_board2camera for pose in poses])
        cosine = (np.trace(R[1:] @ R[:-1].transpose(0, 2, 1), axis1=1, axis2=2) - 1) / 2
        turns.append(120 * np.degrees(np.arccos(cosine).max()))
    assert 200 < min(speeds) <= max(speeds) < 301
    assert 60 < min(turns) <= max(turns) < 130  # the angles of a pose do not turn about orthogonal axes


def test_a_bar_passes_before_the_board_in_a_fifth_of_the_frames():
    made = config()
    hidden = [n for n in range(60) if any(e["effect"] == "occlusion" for e in made.view(n).effects)]
    assert len(hidden) == 12
    assert hidden == list(range(hidden[0], hidden[0] + 12))
    middle = made.make(hidden[6])[0]
    assert middle.keypoints["visible"].min() < 0.5


def test_moving_boards_are_blurred():
    slow, fast = (config().view(n).exposed.motion for n in (30, 3 * 120 + 30))
    assert np.linalg.norm(fast.velocity_mm) > 3 * np.linalg.norm(slow.velocity_mm) > 0


def test_other_suites_have_no_films():
    assert film_board(SuiteConfig(load_suite("paper-v1")).to_dict()) is None
    assert "film" not in SuiteConfig(load_suite("paper-v1")).to_dict()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("frames = 60", "frames = 1", r"film.frames is 1, expected a whole number from 2"),
        ("occluded = 0.2", "occluded = 2", r"film.occluded is 2, expected a number from 0 to 1"),
        ("speed_px = [5, 10, 20, 40]", "speed_px = [5]", r"condition\[0\].film.speed_px is \[5\]"),
        ("film = {", "pose = { pitch_deg = [0, 0, 0, 0] } #", "expected a table `film` in the suite and in every"),
    ],
)
def test_a_wrong_film_is_one_line(tmp_path, old, new, says):
    assert old in TEXT
    (tmp_path / "mine.toml").write_text(TEXT.replace(old, new, 1))
    with pytest.raises(DataError, match=rf"mine\.toml: .*{says}"):
        load_suite(str(tmp_path / "mine.toml"))


def test_a_board_that_cannot_move_is_refused(tmp_path):
    (tmp_path / "mine.toml").write_text(TEXT.replace("area_percent = [3, 10]", "area_percent = [60, 60]"))
    with pytest.raises(DataError, match="area_percent is 60, expected a board that can move in the image"):
        SuiteConfig(load_suite(str(tmp_path / "mine.toml")), **SMALL).view(0)
