"""The tracker: what it follows, what it loses and finds again, and what it says when it guesses."""

import numpy as np
import pytest
from track_scenes import BOARD, CAMERA, FPS, detector, pose_at, shot

import kpbench
from kpbench.boards import BoardPose
from kpbench.boards.pose import rotation_vector
from kpbench.errors import DataError
from kpbench.render import Pose
from kpbench.tracking import PoseFilter, Tracker, draw_pose


def follow(frames, board=BOARD, **options):
    tracker = Tracker(board, CAMERA, detector(), **options)
    return tracker, [tracker(frame, n / FPS) for n, frame in enumerate(frames)]


def error(pose, truth):
    return (
        np.linalg.norm(pose.translation_mm - truth.t_camera),
        np.degrees(np.linalg.norm(rotation_vector(pose.rotation @ truth.R_board2camera.T))),
    )


def test_a_moving_board_is_followed_in_windows():
    _, found = follow([shot(pose_at(n), seed=n) for n in range(10)])
    assert [f.state for f in found] == ["seen", "seen", *["tracked"] * 8]
    for n, f in enumerate(found):
        mm, deg = error(f.pose, pose_at(n))
        assert mm < 1
        assert deg < 0.3
        assert f.pose.points == 6
        assert not f.pose.ambiguous
        assert error(f.filtered, pose_at(n))[0] < 1.5
        assert np.linalg.eigvalsh(f.pose.covariance).min() > 0


def test_colour_and_frames_without_a_time_are_followed():
    tracker = Tracker(BOARD, CAMERA, detector(), fps=FPS)
    states = [tracker(np.repeat(shot(pose_at(n), seed=n)[..., None], 3, axis=2)).state for n in range(4)]
    assert states == ["seen", "seen", "tracked", "tracked"]


def test_covered_patches_are_left_out():
    frames = [shot(pose_at(n), seed=n) for n in range(6)]
    xy = CAMERA.project(BOARD.points_mm[:2] @ pose_at(5).R_board2camera.T + pose_at(5).t_camera).round().astype(int)
    for x, y in xy:
        frames[5][y - 22 : y + 22, x - 22 : x + 22] = 110
    _, found = follow(frames)
    assert found[5].state == "tracked"
    assert found[5].match.points.tolist() == [2, 3, 4, 5]
    assert error(found[5].pose, pose_at(5))[0] < 1.5


def test_unreadable_and_covered_frames_are_guessed_and_then_found_again():
    frames = [shot(pose_at(n), seed=n) for n in range(9)]
    frames[5], frames[6] = None, np.full_like(frames[6], 120)
    _, found = follow(frames)
    assert [f.state for f in found[4:]] == ["tracked", "predicted", "predicted", "tracked", "tracked"]
    assert found[5].reason == "the frame cannot be read"
    assert found[6].reason == "the board was not found"
    assert found[5].pose is None
    assert error(found[6].filtered, pose_at(6))[0] < 3
    spread = [np.trace(f.filtered.covariance) for f in found]
    assert spread[4] < spread[5] < spread[6] > spread[7]  # a guess says how uncertain it is


def test_guesses_end():
    frames = [shot(pose_at(n), seed=n) for n in range(3)]
    _, found = follow([*frames, None, None, None], guess_s=0.05)
    assert [f.state for f in found[3:]] == ["predicted", "", ""]
    assert found[-1].filtered is None


def test_a_jump_is_found_in_the_whole_image():
    frames = [shot(pose_at(n, turn_deg=0), seed=n) for n in range(4)]
    elsewhere = Pose(pose_at(0).R_board2camera, np.array([100.0, 60.0, 400.0]))
    _, found = follow([*frames, shot(elsewhere)])
    assert found[-1].state == "seen"
    assert error(found[-1].pose, elsewhere)[0] < 2
    assert np.allclose(found[-1].filtered.translation_mm, found[-1].pose.translation_mm)  # the filter starts anew


def test_a_jerk_is_found_by_shifts():
    frames = [shot(pose_at(n, turn_deg=0), seed=n) for n in range(4)]
    jerk = Pose(pose_at(0).R_board2camera, pose_at(4).t_camera + np.array([18.0, -15.0, 0]))  # over a radius beside
    _, found = follow([*frames, shot(jerk)])
    assert found[-1].state == "tracked"
    assert error(found[-1].pose, jerk)[0] < 1.5


def test_a_symmetric_board_is_followed_and_stays_ambiguous():
    board = kpbench.hexagon_board(kpbench.shipped_patches()[0], 187.5)
    _, found = follow([shot(pose_at(n), board, n) for n in range(4)], board)
    assert [f.state for f in found] == ["seen", "seen", "tracked", "tracked"]
    assert all(f.pose.ambiguous for f in found)
    assert len({bool(np.trace(f.pose.rotation @ pose_at(n).R_board2camera.T) > 0) for n, f in enumerate(found)}) == 1


def test_another_film_begins_with_nothing():
    tracker, _ = follow([shot(pose_at(n), seed=n) for n in range(3)])
    tracker.reset()
    assert tracker(None, 0.0).state == ""


def test_a_frame_of_another_size_is_refused():
    with pytest.raises(DataError, match="the image has 100x80 px, expected the camera's 406x310"):
        follow([np.zeros((80, 100), np.uint8)])


def test_a_pose_is_drawn():
    tracker, found = follow([shot(pose_at(n), seed=n) for n in range(3)])
    drawn = draw_pose(shot(pose_at(2)), found[2], tracker)
    assert drawn.shape == (310, 406, 3)
    assert (drawn != shot(pose_at(2))[..., None]).any()


def steady(frame, covariance=1e-2):
    return BoardPose(np.eye(3), np.array([3.0 * frame, 0, 500.0]), covariance * np.eye(6), 0.1, 6)


def test_the_filter_learns_the_velocity_and_smooths():
    rng, motion = np.random.default_rng(0), None
    errors = []
    for n in range(60):
        noisy = BoardPose(np.eye(3), steady(n).translation_mm + rng.normal(0, 8.0, 3), 64.0 * np.eye(6), 0.1, 6)
        if motion is None:
            motion = PoseFilter(noisy, 0.0)
        else:
            motion.predict(n / FPS)
            motion.update(noisy)
        errors.append(np.linalg.norm(motion.pose.translation_mm - steady(n).translation_mm))
    assert abs(motion.velocity[3] - 90) < 100
    assert np.mean(errors[20:]) < 8.0 * np.sqrt(8 / np.pi) * 0.85


def test_the_filter_starts_anew_at_an_impossible_pose():
    motion = PoseFilter(steady(0), 0.0)
    for n in range(1, 10):
        motion.predict(n / FPS)
        motion.update(steady(n))
    motion.predict(10 / FPS)
    far = BoardPose(np.eye(3), np.array([0.0, 400.0, 900.0]), 1e-2 * np.eye(6), 0.1, 6)
    motion.update(far)
    assert np.array_equal(motion.pose.translation_mm, far.translation_mm)
    assert motion.updates == 1
