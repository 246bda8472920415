import csv
import json
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import track_scenes

from kpbench.errors import DataError
from kpbench.geometry import write_camera
from kpbench.images import ImageSource
from kpbench.predictions import read_predictions
from kpbench.types import Detections
from kpbench.ui.designer import PrintChoice, print_files
from kpbench.ui.desk import FILE_BOARD, FILE_CAMERA, MY_BOARD, VIEW_CAMERA, Desk
from kpbench.ui.watcher import MOST_PICTURES, Look, Watcher, describe_pose, point_rows, pose_numbers

pytestmark = pytest.mark.usefixtures("here")
LOOK = Look(board=track_scenes.BOARD, camera=track_scenes.CAMERA)


def write_film(name, frames=6):
    size = (track_scenes.CAMERA.width_px, track_scenes.CAMERA.height_px)
    video = cv2.VideoWriter(name, cv2.VideoWriter.fourcc(*"mp4v"), 30.0, size, False)
    for n in range(frames):
        video.write(track_scenes.shot(track_scenes.pose_at(n)))
    video.release()


def watch(sources, look=LOOK):
    watcher = Watcher()
    watcher.open(sources, look)
    watcher.wait(30)
    return watcher


def test_a_photograph_has_points_and_a_pose():
    cv2.imwrite("hidden.png", track_scenes.shot(track_scenes.pose_at(6)))
    [sight] = watch([("mine.png", "hidden.png")]).kept
    assert sight.record.file == "mine.png"
    assert len(sight.detections) == len(track_scenes.BOARD.keypoints)
    place, _ = pose_numbers(sight.record)
    assert place == pytest.approx(track_scenes.pose_at(6).t_camera, abs=1)
    assert describe_pose(sight.record).startswith(f"{track_scenes.BOARD.name}, seen: x 0.")
    rows = point_rows(sight, {0: "checker"})
    assert len(rows) == len(sight.detections)
    assert any(row["design"] == "0 checker" for row in rows)
    assert cv2.imdecode(np.frombuffer(sight.picture, np.uint8), 1).shape == (310, 406, 3)


def test_a_film_is_tracked_and_only_its_newest_picture_is_kept():
    write_film("film.mp4")
    watcher = watch([("film.mp4", "film.mp4")])
    assert [sight.record.state for sight in watcher.kept][:1] == ["seen"]
    assert watcher.kept[-1].record.state == "tracked"
    assert [bool(sight.picture) for sight in watcher.kept] == [False] * 5 + [True]
    assert watcher.is_film
    assert not watcher.is_running
    assert 0 < watcher.frames_per_s < 31


def test_a_camera_which_tells_no_times_is_tracked(monkeypatch):
    frames = ((f"{n:08d}.png", track_scenes.shot(track_scenes.pose_at(n))) for n in range(4))
    monkeypatch.setattr("kpbench.ui.watcher.open_images", lambda source: ImageSource(frames, None, None, source))
    records = [sight.record for sight in watch([("camera:0", "camera:0")]).kept]
    assert [record.state for record in records] == ["seen", "seen", "tracked", "tracked"]
    assert [record.time_s for record in records] == [None] * 4
    assert all(np.isfinite(record.filtered.translation_mm).all() for record in records)


def test_what_an_earlier_source_finds_late_is_not_kept(monkeypatch):
    ready, go_on = threading.Event(), threading.Event()

    def wait_for_both(image):
        if image.shape[1] == 80:
            ready.set()
            go_on.wait(10)
        return Detections.none()

    monkeypatch.setattr("kpbench.ui.watcher.load_detector", lambda *_: wait_for_both)
    cv2.imwrite("late.png", np.zeros((48, 80), np.uint8))
    cv2.imwrite("new.png", np.zeros((48, 64), np.uint8))
    watcher = Watcher()
    watcher.open([("late.png", "late.png")], Look())
    assert ready.wait(10)
    late = watcher._thread
    monkeypatch.setattr(Watcher, "close", lambda self: self._stop.set())  # as after its 5 s
    watcher.open([("new.png", "new.png")], Look())
    go_on.set()
    late.join()
    watcher.wait()
    assert [sight.record.file for sight in watcher.kept] == ["new.png"]


def test_files_are_those_of_the_commands():
    write_film("film.mp4", 3)
    watcher = watch([("film.mp4", "film.mp4")])
    Path("saved.json").write_bytes(watcher.predictions_file())
    predictions = read_predictions("saved.json")
    assert predictions.file == ("film.mp4",) * 3
    assert predictions.frame_index.tolist() == [0, 1, 2]
    Path("poses.csv").write_bytes(watcher.poses_file())
    rows = list(csv.DictReader(Path("poses.csv").read_text().splitlines()[1:]))
    assert [row["frame_index"] for row in rows] == ["0", "1", "2"]
    with pytest.raises(DataError, match="no image"):
        Watcher().predictions_file()


def test_what_cannot_be_read_is_one_line_with_the_given_name_and_the_rest_is_looked_at():
    Path("a.mp4").write_bytes(b"\0" * 1000)
    Path("b.png").write_bytes(b"no picture")
    cv2.imwrite("c.png", np.full((80, 100), 128, np.uint8))
    watcher = watch([("film.mp4", "a.mp4"), ("../b.png", "b.png"), ("c.png", "c.png")])
    assert [problem.split(":")[0] for problem in watcher.problems] == ["film.mp4", "../b.png", "c.png"]
    assert "expected the camera's 406x310" in watcher.problems[2]
    [sight] = watch([("c.png", "c.png")], Look()).kept
    assert describe_pose(sight.record) == "no pose: no board is chosen"


def test_a_film_is_frozen_and_ended():
    write_film("film.mp4", 20)
    watcher = Watcher()
    watcher.open([("film.mp4", "film.mp4")], Look())
    while not watcher.kept:
        watcher.wait(0.02)
    watcher.is_frozen = True
    count = -1
    while len(watcher.kept) != count:
        count = len(watcher.kept)
        watcher.wait(0.5)
    assert count < 20
    assert watcher.is_running
    watcher.close()
    assert not watcher._thread.is_alive()


def test_few_pictures_of_photographs_are_kept():
    cv2.imwrite("c.png", np.full((48, 64), 128, np.uint8))
    watcher = watch([("c.png", "c.png")] * (MOST_PICTURES + 2), Look("orb"))
    assert [bool(sight.picture) for sight in watcher.kept] == [False] * 2 + [True] * MOST_PICTURES


def test_a_desk_takes_files_by_what_they_hold(tmp_path):
    desk = Desk(tmp_path / "folder")
    desk.folder.mkdir()
    files = print_files(desk.design, PrintChoice("hexagon"), ["svg"])
    write_camera("camera.yaml", track_scenes.CAMERA)
    contents = {
        "../../board.json": files["hexagon-trefoil.json"],
        "camera.yaml": Path("camera.yaml").read_bytes(),
        "mine.toml": b'name = "mine"\nid = 9\nsemicircles = [{ start_deg = 0, ink = "black" }]\n',
    }
    for name, content in contents.items():
        path = desk.place_for(name, (".json", ".yaml", ".toml"))
        assert path.parent == desk.folder
        path.write_bytes(content)
        desk.take(name, path)
    assert (desk.board_name, desk.camera_name, desk.design.name) == (FILE_BOARD, FILE_CAMERA, "mine")
    assert desk.look().board.name == "hexagon-trefoil"
    assert desk.look().camera.focal_px == track_scenes.CAMERA.focal_px
    with pytest.raises(DataError, match=r"^/etc/passwd: expected a file ending in \.json"):
        desk.place_for("/etc/passwd", (".json",))
    for name, content in (
        ("bad.json", json.dumps({"camera": 1})),
        ("bad.toml", 'designs = ["/etc/passwd"]\n[grid]\nrows = 2\ncolumns = 2\n'),
    ):
        bad = desk.place_for(name, (".json", ".toml"))
        bad.write_text(content)
        with pytest.raises(DataError, match=f"^{name}: ") as caught:
            desk.take(name, bad)
        assert "passwd" not in str(caught.value)


def test_a_desk_looks_for_the_board_of_the_design_page(tmp_path):
    desk = Desk(tmp_path, board_name=MY_BOARD, camera_name=VIEW_CAMERA)
    with pytest.raises(DataError, match="patches to cut out"):
        desk.look()
    desk.choice = PrintChoice("hexagon", "shipped")
    with pytest.raises(DataError, match="4 boards"):
        desk.look()
    desk.choice = PrintChoice("hexagon")
    assert desk.look().board.name == "hexagon-trefoil"
    assert desk.look().view_deg == 65


def test_a_list_of_files_is_no_film(tmp_path):
    desk = Desk(tmp_path)
    path = desk.place_for("../list.mp4", (".mp4",))
    path.write_text("ffconcat version 1.0\nfile /etc/passwd\n")
    with pytest.raises(DataError, match=r"^\.\./list\.mp4: cannot be opened as a video, expected AVI"):
        desk.drop([("../list.mp4", path)])
    assert not path.exists()


def test_old_files_and_downloads_go(tmp_path):
    desk = Desk(tmp_path)
    for _ in range(2):
        path = desk.place_for("a.png", (".png",))
        cv2.imwrite(str(path), np.full((48, 64), 128, np.uint8))
        desk.drop([("a.png", path)])
        desk.watcher.wait()
    assert list(tmp_path.iterdir()) == [path]
    keys = [desk.offer(f"{n}", b"x").rpartition("/")[2] for n in range(20)]
    assert [desk.fetch(key) is not None for key in keys] == [False] * 4 + [True] * 16
