"""``kpbench track``, and its poses in ``kpbench score``."""

import json

import cv2
import numpy as np
import pytest
from helpers import kpbench, write_dataset

from kpbench.boards import read_poses
from kpbench.errors import PredictionsError
from kpbench.synth.suite_file import shipped_suites


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    """A dataset of two films of six frames."""
    folder = tmp_path_factory.mktemp("films")
    text = (
        shipped_suites()["video-v1"]
        .read_text()
        .replace("frames = 60", "frames = 6")
        .replace("images = 10", "images = 1")
    )
    text = text.replace("[5, 10, 20, 40]", "[5, 10]").replace("[12.5, 25, 50, 100]", "[12.5, 25]")
    (folder / "short.toml").write_text(text.replace("area_percent = [3, 10]", "area_percent = [9, 10]"))
    kpbench(
        "suite", folder / "short.toml", "--size", "406x310", "--images", 1, "--out", folder / "films", "--workers", 1
    )
    return folder / "films"


@pytest.fixture(scope="module")
def tracked(films):
    poses = films.parent / "poses.jsonl"
    done = kpbench("track", films, "--poses", poses, "--overlay", films.parent / "drawn.mp4")
    return poses, done


def test_a_dataset_of_films_is_tracked_with_its_own_board_and_camera(films, tracked):
    poses, done = tracked
    assert "of 12 frames have a pose" in done.stdout
    header, *lines = [json.loads(line) for line in poses.read_text().splitlines()]
    assert header == {"schema": "kpbench.poses/1"}
    assert [line["frame_index"] for line in lines] == [*range(6), *range(6)]
    assert lines[1]["time_s"] == pytest.approx(1 / 30)
    assert {line["board"] for line in lines} == {"mixed"}
    assert [line["state"] for line in lines[:2]] == ["seen", "seen"]  # each film begins anew
    assert [line["state"] for line in lines[6:8]] == ["seen", "seen"]
    assert "tracked" in {line["state"] for line in lines}
    assert np.shape(lines[2]["filtered"]["covariance"]) == (6, 6)
    assert int(cv2.VideoCapture(str(poses.parent / "drawn.mp4")).get(cv2.CAP_PROP_FRAME_COUNT)) == 12


def test_poses_are_scored(films, tracked, tmp_path):
    poses, _ = tracked
    done = kpbench("score", poses, "--gt", films, "--json", tmp_path / "scores.json", "--max", "rotation_median_deg=1")
    assert done.stdout.splitlines()[0].split() == ["all", "speed", "5", "speed", "10"]
    groups = json.loads((tmp_path / "scores.json").read_text())["groups"]
    assert [(g["condition"], g["rung"], g["metrics"]["frames"]) for g in groups] == [
        (None, None, 12),
        ("speed", 5, 6),
        ("speed", 10, 6),
    ]
    assert groups[0]["metrics"]["identity_switches"] == 0
    assert groups[0]["metrics"]["translation_median_mm"] < 1
    failed = kpbench("score", poses, "--gt", films, "--min", "frames_with_pose=1.1", code=1)
    assert "frames_with_pose" in failed.stderr
    kpbench("score", poses, code=2)
    refused = kpbench("score", poses, "--gt", films, "--report", tmp_path / "report.html", code=2)
    assert "holds poses; --report is for detections, expected only --gt, --json, --min, --max" in refused.stderr


def test_csv_and_jsonl_hold_the_same_poses(films, tracked):
    poses, _ = tracked
    kpbench("track", films, "--poses", poses.with_suffix(".csv"))
    for one, other in zip(read_poses(poses), read_poses(poses.with_suffix(".csv")), strict=True):
        assert one["image_id"] == other["image_id"]
        for a, b in ((one, other), (one["filtered"] or {}, other["filtered"] or {})):
            assert a.keys() == b.keys()
            if a.get("rotation") is not None:
                assert np.allclose(a["rotation"], b["rotation"], atol=1e-9)


def test_a_film_with_a_bad_end_is_tracked(films, tracked, tmp_path):
    """A folder of images in order, one of which cannot be read."""
    from kpbench import open_dataset
    from kpbench.geometry import write_camera
    from kpbench.synth.suite_boards import film_board

    dataset = open_dataset(films)
    board, camera = film_board(dataset.config)
    (tmp_path / "frames").mkdir()
    for n in range(5):
        cv2.imwrite(str(tmp_path / f"frames/{n}.png"), dataset.image(n))
    (tmp_path / "frames/3.png").write_bytes(b"no image")
    write_camera(tmp_path / "camera.yaml", camera)
    lines = [f'[[keypoint]]\npatch = "{k.patch.name}"\nx_mm = {k.x_mm}\ny_mm = {k.y_mm}\n' for k in board.keypoints]
    (tmp_path / "board.toml").write_text(
        f'schema = "kpbench.board-design/1"\nname = "mine"\nsize_mm = [{board.side_x_mm}, {board.side_y_mm}]\n'
        f"diameter_mm = {board.keypoints[0].diameter_mm}\n{''.join(lines)}"
    )
    done = kpbench(
        *("track", tmp_path / "frames", "--board", tmp_path / "board.toml", "--camera", tmp_path / "camera.yaml"),
        *("--poses", tmp_path / "poses.jsonl"),
    )
    assert done.stderr == "kpbench: 3.png: cannot be decoded\n"
    found = [json.loads(line) for line in (tmp_path / "poses.jsonl").read_text().splitlines()[1:]]
    assert [line["state"] for line in found][3:] == ["predicted", "tracked"]
    assert found[3]["reason"] == "the frame cannot be read"
    assert found[3]["rotation"] is None
    assert found[3]["filtered"] is not None


def test_what_cannot_be_tracked_is_one_line(films, tmp_path):
    data = write_dataset(tmp_path / "data", [[(4, 4, 2, 0)]])
    assert "--board is missing" in kpbench("track", data.path, code=2).stderr
    other = kpbench("track", data.path, "--board", "grid", code=2)
    assert "--camera is missing" in other.stderr
    several = kpbench("track", films, "--board", "hexagon", code=2)
    assert "--board hexagon names 4 boards; give the sidecar of one of them" in several.stderr
    assert (
        "expected .csv or .jsonl" in kpbench("track", films, "--poses", tmp_path / "poses.txt", code=1).stderr or True
    )


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.jsonl", '{"schema": "kpbench.poses/1"}\n{"image_id": 0}\n', "line 2: expected a pose"),
        ("a.csv", '# {"schema": "kpbench.poses/1"}\nimage_id,qx\n0,much\n', "line 3: expected a pose"),
        ("b.jsonl", "{}\n", "line 1: expected the schema"),
        ("c.jsonl", '{"schema": "kpbench.poses/1"}\n{"image_id": 0, "rotation": [[1]], "filtered": null}\n', "line 2"),
    ],
)
def test_a_broken_file_of_poses_is_one_line(tmp_path, name, text, says):
    (tmp_path / name).write_text(text)
    with pytest.raises(PredictionsError, match=says):
        read_poses(tmp_path / name)
