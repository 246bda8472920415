"""Poses: against the truth of simulated views, against OpenCV, and their covariances against many draws."""

import cv2
import numpy as np
import pytest
from board_scenes import BENT, BOARDS, CAMERA, scene, view

from kpbench import Detections, estimate_pose, find_board
from kpbench.boards import BoardMatch, BoardPose, pose_distance
from kpbench.boards.pose import rotation_vector
from kpbench.errors import DataError
from kpbench.geometry import Camera

FISHEYE = Camera(1624, 1240, 700.0, (0.02, -0.01, 0.003, -0.001), "fisheye")
CAMERAS = {"straight": CAMERA, "bent": BENT, "fisheye": FISHEYE}


def truth_of(truth, match):
    R, t = truth.poses[int(truth.copy[match.index[0]])]
    return BoardPose(R, t, np.eye(6), 0.0, 6)


@pytest.mark.parametrize(
    ("name", "seen", "camera"), [("mixed", 5, "straight"), ("trefoil", 5, "bent"), ("grid", 12, "fisheye")]
)
def test_errors_are_as_large_as_the_covariance_says(name, seen, camera):
    """NEES of six degrees of freedom is 6; over n poses its standard deviation is √(12 / n)."""
    rng, nees = np.random.default_rng(1), []
    for _ in range(40):
        truth = scene(rng, BOARDS[name], CAMERAS[camera], seen)
        [match] = find_board(truth.found, BOARDS[name], CAMERAS[camera])
        pose = estimate_pose(match, CAMERAS[camera])
        if not pose.ambiguous:
            nees.append(pose_distance(pose, truth_of(truth, match)))
    assert len(nees) >= 38
    assert max(nees) < 40
    assert 4.0 < np.mean(nees) < 7.5  # below 6: where errors are large by chance, the covariance is scaled up


def test_no_pose_of_four_points_is_wrong_without_a_flag():
    rng, clear = np.random.default_rng(2), 0
    for n in range(120):
        board = BOARDS[("mixed", "trefoil", "wheel")[n % 3]]
        truth = scene(rng, board, CAMERA, 4, alarms=2)
        [match] = find_board(truth.found, board, CAMERA)
        pose, true = estimate_pose(match, CAMERA), truth_of(truth, match)
        poses = (pose, pose.second) if pose.second else (pose,)
        assert min(pose_distance(p, true) for p in poses) < 40
        assert pose.ambiguous == (pose.second is not None)
        clear += not pose.ambiguous
    assert clear >= 108


def test_opencv_finds_the_same_pose():
    rng, board = np.random.default_rng(3), BOARDS["mixed"]
    for _ in range(10):
        truth = scene(rng, board, BENT, alarms=0)
        found = Detections(truth.found.xy, truth.found.score, truth.found.patch_id, truth.found.A_patch2image)
        [match] = find_board(found, board, BENT)
        pose = estimate_pose(match, BENT)  # without covariances, all points weigh the same
        X, x = board.points_mm[match.points], match.detections.xy
        rvec = cv2.Rodrigues(pose.rotation)[0]
        args = (X, x, BENT.K, np.array(BENT.distortion), rvec, pose.translation_mm.reshape(3, 1).copy())
        rvec, tvec = cv2.solvePnPRefineLM(*args)
        np.testing.assert_allclose(pose.translation_mm, tvec.ravel(), rtol=3e-4, atol=0.1)
        again = cv2.projectPoints(X, rvec, tvec, BENT.K, np.array(BENT.distortion))[0].reshape(-1, 2)
        rms = np.sqrt(((again - x) ** 2).sum(axis=1).mean())
        assert rms <= pose.reprojection_rms_px < rms * 1.02


def test_the_covariance_is_that_of_the_errors_of_many_draws():
    rng, board = np.random.default_rng(4), BOARDS["trefoil"]
    poses, draws, R, t = [view(np.random.default_rng(8), board, CAMERA)], [], None, None
    for _ in range(120):
        truth = scene(rng, board, CAMERA, alarms=0, poses=poses)
        [match] = find_board(truth.found, board, CAMERA)
        pose = estimate_pose(match, CAMERA)
        R, t = poses[0]
        draws.append(np.append(rotation_vector(R @ pose.rotation.T), t - pose.translation_mm))
    L = np.linalg.inv(np.linalg.cholesky(pose.covariance))
    spread = np.linalg.eigvalsh(L @ np.cov(np.array(draws).T) @ L.T)
    assert spread.min() > 0.4
    assert spread.max() < 1.9


def test_a_symmetric_board_has_the_other_pose_as_second():
    truth = scene(np.random.default_rng(5), BOARDS["checker"], CAMERA, alarms=0)
    [match] = find_board(truth.found, BOARDS["checker"], CAMERA)
    pose = estimate_pose(match, CAMERA)
    assert pose.ambiguous
    assert pose.second.second is None
    turn = np.degrees(np.linalg.norm(rotation_vector(pose.second.rotation @ pose.rotation.T)))
    assert turn == pytest.approx(180, abs=0.5)
    assert min(pose_distance(p, truth_of(truth, match)) for p in (pose, pose.second)) < 40


def test_a_distant_board_has_a_second_pose():
    """Thirty times its size away, the points do not tell which side of the board is nearer."""
    board, c, s = BOARDS["trefoil"], np.cos(0.7), np.sin(0.7)
    R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    truth = scene(np.random.default_rng(6), board, CAMERA, alarms=0, poses=[(R, np.array([0.0, 0, 6000]))])
    truth.found.covariance[:] = 0.05**2 * np.eye(2)
    [match] = find_board(truth.found, board, CAMERA)
    pose = estimate_pose(match, CAMERA)
    assert pose.ambiguous
    angles = [np.degrees(np.linalg.norm(rotation_vector(p.rotation @ R.T))) for p in (pose, pose.second)]
    assert min(angles) < 5 < max(angles)


def test_quaternions_and_rotation_vectors_are_those_of_the_rotation():
    rng = np.random.default_rng(7)
    vectors = [*rng.normal(0, 1, (20, 3)), np.zeros(3), [np.pi, 0, 0], [0, -np.pi, 0], [1e-9, 0, 0], [0, 3.1415, 0.001]]
    for vector in vectors:
        R = cv2.Rodrigues(np.array(vector, float))[0]
        np.testing.assert_allclose(cv2.Rodrigues(rotation_vector(R))[0], R, atol=1e-9)
        x, y, z, w = BoardPose(R, np.zeros(3), np.eye(6), 0.0, 4).quaternion_xyzw
        assert w >= 0
        rows = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
        np.testing.assert_allclose(rows, R[0], atol=1e-9)


def test_what_has_no_pose_is_said_in_one_line():
    board = BOARDS["grid"]

    def match(points):
        n, xy = len(points), CAMERA.project(board.points_mm[points] + [0, 0, 500])
        frames = np.tile(26 * np.eye(2), (n, 1, 1))
        ids = np.array([board.keypoints[k].patch_id for k in points])
        found = Detections(xy, np.ones(n), ids, frames)
        return BoardMatch(board, np.arange(n), np.array(points), found, np.ones(n, bool))

    assert estimate_pose(match([0, 1, 2, 4]), CAMERA).points == 4
    three = estimate_pose(match([0, 1, 4]), CAMERA)
    assert three.ambiguous
    assert three.reprojection_rms_px < 1e-3
    with pytest.raises(DataError, match="board 'grid': 2 points, expected at least 3"):
        estimate_pose(match([0, 1]), CAMERA)
    with pytest.raises(DataError, match="4 points on one line"):
        estimate_pose(match([0, 3, 6, 9]), CAMERA)
    fold = Camera(1624, 1240, 889.0, (-0.9, 0.0, 0.0, 0.0))
    with pytest.raises(DataError, match="lens shows no such points"):
        estimate_pose(match([0, 2, 9, 11]), Camera(1624, 1240, 200.0, fold.distortion))
