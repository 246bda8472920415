import json
from dataclasses import asdict, astuple, replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.report.detail_tables import pose_table
from kpbench.report.result_files import encode_scores
from kpbench.scoring.board_pose import PoseErrors, compute_pose_errors, group_pose_errors
from kpbench.scoring.scores import score
from kpbench.synth.suite import SuiteConfig
from kpbench.synth.suite_boards import board_in_view
from kpbench.synth.suite_file import load_suite
from kpbench.types import KEYPOINT_DTYPE, Detections, Truth

CAMERA = Camera(640, 480, 500.0, (0.02, -0.01, 0.0, 0.0, 0.0))
BOARD = np.array([[np.cos(a), np.sin(a), 0] for a in np.arange(6) * np.pi / 3]) * 60.0


def turn(axis, deg):
    """Rotation about a unit axis (Rodrigues' formula)."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(np.radians(deg)) * K + (1 - np.cos(np.radians(deg))) * K @ K


def seen(R, t):
    return CAMERA.project(BOARD @ R.T + t)


TRUE = [(turn([1, 0.2, 0], tilt), np.array([20.0, -10.0, 500.0])) for tilt in (10, 30, 50)]


def truth_of(poses):
    keypoints = np.zeros(6 * len(poses), KEYPOINT_DTYPE)
    xy = np.concatenate([seen(*pose) for pose in poses])
    keypoints["x"], keypoints["y"] = xy.T
    keypoints["radius_major"] = keypoints["radius_minor"] = 20
    n = len(poses)
    ids = np.arange(n)
    return Truth(ids, np.arange(n + 1) * 6, keypoints, np.array([""] * n), np.full(n, np.nan), ids)


def errors(found):
    return compute_pose_errors(score(truth_of(TRUE), found, eps=1.0, resamples=0).outcomes, BOARD, CAMERA)


def test_exact_detections_give_the_exact_pose():
    e = errors([Detections(seen(*pose), np.ones(6)) for pose in TRUE])
    assert e.translation_percent == pytest.approx(0, abs=1e-4)
    assert e.rotation_deg == pytest.approx(0, abs=1e-4)


def test_a_known_change_of_pose_is_the_error():
    moved = [(turn([0, 0, 1], 2.0) @ R, t + np.array([0, 5.0, 0])) for R, t in TRUE]
    e = errors([Detections(seen(*pose), np.ones(6)) for pose in moved])
    distance = np.linalg.norm(TRUE[0][1])
    assert e.translation_percent == pytest.approx(100 * 5 / distance, abs=1e-3)
    assert e.rotation_deg == pytest.approx(2.0, abs=1e-3)


def test_groups_are_percentiles_of_the_images_with_a_pose():
    found = [Detections(seen(*pose)[:n], np.ones(n)) for pose, n in zip(TRUE, (6, 6, 3), strict=True)]
    run = score(replace(truth_of(TRUE), condition=np.array(["a", "a", "b"]), rung=np.zeros(3)), found, resamples=0)
    errors = PoseErrors(np.array([1.0, 3.0, np.nan]), np.array([2.0, 4.0, np.nan]))
    everything, a, b = group_pose_errors(run, errors)
    assert astuple(everything) == (None, None, 3, 2, 2.0, pytest.approx(2.9), 3.0, pytest.approx(3.9))
    assert astuple(a) == ("a", 0, 2, 2, *astuple(everything)[4:])
    assert astuple(b) == ("b", 0, 1, 0, None, None, None, None)
    schema = json.loads((Path(__file__).parents[2] / "docs" / "schemas" / "scores-1.json").read_text())
    content = json.loads(encode_scores(run, {}, group_pose_errors(run, errors)))
    jsonschema.Draft202012Validator(schema).validate(content)
    assert content["pose"] == [asdict(group) for group in (everything, a, b)]
    assert "pose" not in json.loads(encode_scores(run, {}))


def test_four_points_are_enough_and_three_are_none():
    found = [Detections(seen(*pose)[:n], np.ones(n)) for pose, n in zip(TRUE, (4, 3, 0), strict=True)]
    e = errors(found)
    assert e.rotation_deg[0] == pytest.approx(0, abs=1e-3)
    assert np.isnan(e.rotation_deg[1:]).all()
    assert np.isnan(e.translation_percent[1:]).all()


def test_false_alarms_and_identities_do_not_enter():
    found = [
        Detections(np.vstack([[[5, 5]], seen(*pose)[::-1]]), np.linspace(1, 0.5, 7), np.arange(7)) for pose in TRUE
    ]
    assert errors(found).translation_percent == pytest.approx(0, abs=1e-4)


def test_images_must_show_the_board():
    truth = truth_of(TRUE)
    rows = score(truth, [Detections.none()] * 3, resamples=0).outcomes
    with pytest.raises(DataError, match="image_id 0 has 6 keypoints, but the board has 5"):
        compute_pose_errors(rows, BOARD[:5], CAMERA)


@pytest.mark.parametrize("board", [None, "aruco"])
def test_a_suites_truth_is_its_board_seen_by_its_camera(board):
    config = SuiteConfig(load_suite("paper-v1"), images=1, size_px=(640, 480), only=("pitch",), board=board)
    points, camera = board_in_view(config.to_dict())
    views = [config.view(n) for n in range(0, config.n, 5)]
    n = len(views)
    counts = [len(view.keypoints) for view in views]
    truth = Truth(
        np.arange(n),
        np.append(0, np.cumsum(counts)),
        np.concatenate([view.keypoints for view in views]),
        np.array(["pitch"] * n),
        np.array([view.rung for view in views]),
        np.arange(n),
    )
    places = [np.stack([view.keypoints["x"], view.keypoints["y"]], axis=1) for view in views]
    exact = [Detections(xy, np.ones(len(xy))) for xy in places]
    scores = score(truth, exact, resamples=0)
    e = compute_pose_errors(scores.outcomes, points, camera)
    assert np.nanmax(e.translation_percent) < 1e-3
    groups = group_pose_errors(scores, e)
    rungs = sorted({v.rung for v in views})
    assert [(g.condition, g.rung) for g in groups] == [(None, None), *(("pitch", r) for r in rungs)]
    assert (groups[0].images, groups[0].with_pose) == (n, n)
    table = pose_table(scores, groups)
    assert table.rows[0][:4] == ("all", "all", n, n)
    assert [row[1] for row in table.rows[1:]] == [f"{r:g}" for r in rungs]


def test_other_datasets_have_no_board():
    assert board_in_view({"kind": "synth"}) is board_in_view({}) is None
