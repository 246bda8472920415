"""Boards in predictions, files of poses, boards from sidecars, and the rotations of boards."""

import csv
import json

import numpy as np
import pytest
from board_scenes import BOARDS, CAMERA, MIXED, PATCHES, scene

from kpbench import Board, Detections, Predictions, load_board, print_boards
from kpbench.boards import POSE_COLUMNS, locate_boards, write_poses
from kpbench.errors import DataError, DesignError
from kpbench.patches import BoardKeypoint, board_turns_deg, load_boards, pose_problem


def located(n=3, size=(1624, 1240), camera=CAMERA):
    rng = np.random.default_rng(1)
    truths = [scene(rng, MIXED) for _ in range(n)]
    found = [*(truth.found for truth in truths), truths[0].found[:0]]
    about = {"size": [size] * (n + 1), "file": [f"{k}.png" for k in range(n + 1)]}
    predictions = Predictions.from_detections(found, **about)
    return truths, *locate_boards(predictions, [MIXED, BOARDS["checker"]], camera)


def test_predictions_say_which_point_of_which_board_each_detection_is():
    truths, predictions, records = located()
    point = np.concatenate([truth.point for truth in truths])
    np.testing.assert_array_equal(predictions.points, point)
    np.testing.assert_array_equal(predictions.board, np.where(point >= 0, 0, -1))
    assert predictions.boards == ("mixed", "hexagon-checker")
    assert [(r.image_id, r.board, r.pose is None) for r in records[:2]] == [
        (0, "mixed", False),
        (0, "hexagon-checker", True),
    ]
    assert [r.reason for r in records[-2:]] == ["the board was not found"] * 2


def test_points_of_an_ambiguous_match_are_not_written():
    truth = scene(np.random.default_rng(2), BOARDS["checker"])
    predictions, [record] = locate_boards(Predictions.from_detections([truth.found]), [BOARDS["checker"]], CAMERA)
    np.testing.assert_array_equal(predictions.board, np.where(truth.point >= 0, 0, -1))
    assert (predictions.points == -1).all()
    assert record.pose.ambiguous


def test_csv_and_json_lines_hold_the_same_poses(tmp_path):
    truths, _, records = located()
    write_poses(tmp_path / "p.csv", records)
    write_poses(tmp_path / "p.jsonl", records)
    write_poses(tmp_path / "p.jsonl", records)  # its own file may be replaced
    header, *lines = (tmp_path / "p.jsonl").read_text().splitlines()
    assert json.loads(header) == {"schema": "kpbench.poses/1"}
    first, *text = (tmp_path / "p.csv").read_text().splitlines()
    assert json.loads(first.removeprefix("# ")) == {"schema": "kpbench.poses/1"}
    rows = list(csv.DictReader(text))
    assert tuple(rows[0]) == POSE_COLUMNS
    assert len(rows) == len(lines) == len(records) == 8
    for row, line, record in zip(rows, map(json.loads, lines), records, strict=True):
        assert row["board"] == line["board"] == record.board
        assert row["reason"] == (line["reason"] or "")
        if record.pose is None:
            assert line["rotation"] is None
            assert row["tx_mm"] == row["covariance_11"] == ""
            continue
        R, _ = truths[record.image_id].poses[0]
        np.testing.assert_allclose(line["rotation"], R, atol=0.05)
        assert [float(row[f"t{axis}_mm"]) for axis in "xyz"] == line["translation_mm"]
        assert [float(row[f"q{axis}"]) for axis in "xyzw"] == line["quaternion_xyzw"]
        assert float(row["covariance_16"]) == line["covariance"][0][5] == line["covariance"][5][0]
        assert (row["state"], row["ambiguous"], row["points"]) == ("seen", "0", "6")


def test_a_size_that_is_not_the_cameras_is_refused_and_a_whole_number_scale_is_not():
    with pytest.raises(DataError, match=r"^0\.png: the image has 800x600 px, expected the camera's 1624x1240"):
        located(size=(800, 600))
    truths, _, records = located(size=(3248, 2480))  # the points of the small image lie in a quarter of the large one
    assert records[0].pose.translation_mm[2] != pytest.approx(truths[0].poses[0][1][2], rel=0.2)
    assert [r.reason for r in located(camera=None)[2][:1]] == ["there is no camera"]


def test_refused_in_one_line(tmp_path):
    predictions = Predictions.from_detections([Detections.none()])
    with pytest.raises(DataError, match="two boards have the name 'mixed'"):
        locate_boards(predictions, [MIXED, MIXED])
    with pytest.raises(DataError, match=r"poses\.txt: unknown kind of poses file, expected \.csv or \.jsonl"):
        write_poses(tmp_path / "poses.txt", [])


def test_a_sidecar_gives_the_board_back(here):
    print_boards([MIXED, BOARDS["trefoil"]], page="a3")
    board = load_board("patches-print/mixed.json")
    assert board.digest == MIXED.digest
    assert board.name == "mixed"
    assert load_board("patches-print/hexagon-trefoil.json").digest == BOARDS["trefoil"].digest


BAD = [
    ({"schema": "kpbench.sheet/1"}, "schema is 'kpbench.sheet/1', expected 'kpbench.board/1'"),
    ({"keypoints": []}, "keypoints is [], expected a list of objects"),
    ({"side_mm": [1]}, "side_mm is [1], expected a list of 2 numbers"),
    (
        {"patches": [{"id": 0, "name": "mine", "digest": "0"}]},
        "patches[0] is the design 'mine' with ID 0, which is not",
    ),
]


@pytest.mark.parametrize(("change", "message"), BAD, ids=[next(iter(change)) for change, _ in BAD])
def test_a_damaged_sidecar_is_one_line(here, change, message):
    print_boards([MIXED], page="a3")
    content = json.loads((here / "patches-print/mixed.json").read_text()) | change
    (here / "bad.json").write_text(json.dumps(content))
    with pytest.raises(DesignError) as caught:
        load_board("bad.json")
    assert str(caught.value).startswith(f"bad.json: {message}")


def test_no_sidecar_at_all_is_one_line(here):
    for text, message in (("{", "no sidecar of a board"), ("[1]", "no sidecar of a board, expected a JSON object")):
        (here / "bad.json").write_text(text)
        with pytest.raises(DesignError, match=f"bad.json: {message}"):
            load_board("bad.json")
    with pytest.raises(DesignError, match="sets all diameters"):
        load_board("bad.json", diameter_mm=3.0)
    with pytest.raises(DesignError, match="none: no such file, expected hexagon, grid, truth, field or a board's file"):
        load_boards("none")


def points(*places, patch=PATCHES[1]):
    keypoints = tuple(BoardKeypoint(patch, x, y, turn, 10.0) for x, y, turn in places)
    return Board("points", 400, 400, keypoints)


SQUARE = [(50, 50, 0), (-50, 50, 90), (-50, -50, 180), (50, -50, 270)]


@pytest.mark.parametrize(
    ("board", "turns", "problem"),
    [
        (BOARDS["checker"], (180.0,), "it looks the same after a turn of 180 degrees"),
        (BOARDS["trefoil"], (), ""),
        (BOARDS["grid"], (), ""),
        (MIXED, (), ""),
        (points(*SQUARE), (90.0, 180.0, 270.0), "it looks the same after a turn of 90 degrees"),
        (points((50, 51, 0), *SQUARE[1:]), (), ""),
        (points(*[(x, y, 0) for x, y, _ in SQUARE]), (), ""),
        (
            points(*[(x, y, 0) for x, y, _ in SQUARE], patch=PATCHES[0]),
            (180.0,),
            "it looks the same after a turn of 180 degrees",
        ),
        (points((0, 0, 0)), (), "it has 1 keypoints, expected at least 4"),
        (points(*[(30 * k, 0, 0) for k in range(4)]), (), "its keypoints are on one line"),
    ],
)
def test_rotations_that_leave_a_board_unchanged(board, turns, problem):
    assert board_turns_deg(board) == turns
    assert pose_problem(board) == problem
