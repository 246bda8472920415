"""The second look finds what was missed, and nothing that is not there."""

import numpy as np
from track_scenes import BOARD, CAMERA, detector, pose_at, shot

import kpbench
from kpbench.detectors import LoadedDetector
from kpbench.tracking import find_missed, look_twice


def half_blind(image):
    found = detector()(image)
    [match] = kpbench.find_board(found, BOARD, CAMERA)
    return found[match.index[match.points < 4]]


def test_missed_patches_are_found():
    pose, image = pose_at(3), shot(pose_at(3))
    found = half_blind(image)
    [match] = kpbench.find_board(found, BOARD, CAMERA)
    for camera in (CAMERA, None):
        more = find_missed(image, found, match, camera)
        assert more.patch_id.tolist() == [0, 1]
        true = CAMERA.project(BOARD.points_mm[4:] @ pose.R_board2camera.T + pose.t_camera)
        assert np.linalg.norm(more.xy - true, axis=1).max() < 0.3


def test_hidden_patches_are_not_found():
    pose, image = pose_at(3), shot(pose_at(3))
    x, y = CAMERA.project(BOARD.points_mm[4:5] @ pose.R_board2camera.T + pose.t_camera)[0].round().astype(int)
    image[y - 20 : y + 20, x - 20 : x + 20] = np.random.default_rng(0).integers(60, 200, (40, 40))
    found = half_blind(image)
    [match] = kpbench.find_board(found, BOARD, CAMERA)
    assert find_missed(image, found, match, CAMERA).patch_id.tolist() == [1]


def test_a_detector_that_looks_twice_finds_the_whole_board():
    twice = look_twice(LoadedDetector("half blind", "1", half_blind), [BOARD], CAMERA)
    [match] = kpbench.find_board(twice(shot(pose_at(3))), BOARD, CAMERA)
    assert sorted(match.points.tolist()) == [0, 1, 2, 3, 4, 5]
