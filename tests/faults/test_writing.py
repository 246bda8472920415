"""A file of the user's is never replaced, truncated or deleted: one gate for all writes."""

import os
import shutil
import stat
import threading

import cv2
import numpy as np
import pytest
from helpers import digests, kpbench, perfect_predictions, write_dataset

from kpbench import open_dataset, write_predictions
from kpbench.dataset.generation import generate
from kpbench.errors import DataError
from kpbench.synth.synthetic import SynthConfig
from kpbench.writing import kind_of, move_file, remove_file, require_writable, write_file

IMAGES = [[(3, 4, 2, 0), (6, 2, 2, 1)], [(5, 5, 2, 2)]]
OURS, OTHER = b'{"schema": "kpbench.scores/1"}', b"<!-- kpbench.report/1 -->\n"


@pytest.fixture
def made(here):
    """A dataset, its truth as COCO, predictions and a photograph of the user's, in the current folder."""
    write_dataset(here / "set", IMAGES)
    kpbench("export", "set", "--format", "coco", "--out", "coco")
    for name in ("a.json", "b.csv"):
        write_predictions(name, perfect_predictions(IMAGES, image_id=[0, 1], dataset="set"))
    (here / "photos").mkdir()
    cv2.imwrite("photos/wall.png", np.full((40, 60), 90, np.uint8))
    (here / "notes.txt").write_text("of the user")
    return here


SCORE = ("score", "a.json", "--gt", "set")
TARGETS = [
    (*SCORE, "--json"),
    (*SCORE, "--csv"),
    (*SCORE, "--report", "{}.html"),
    ("compare", "a.json", "b.csv", "--gt", "set", "--json"),
    ("detect", "photos", "--detector", "template", "--out", "{}.json"),
    ("detect", "photos/wall.png", "--out", "new.json", "--overlay", "{}.png"),
    ("preview", "set", "--out", "{}.png"),
    ("analyze-patches", "--json"),
]


@pytest.mark.parametrize("arguments", TARGETS, ids=lambda a: f"{a[0]}{a[-2] if '{' in a[-1] else a[-1]}")
def test_a_file_of_the_users_is_named_and_stays(made, arguments, monkeypatch):
    name = "mine" + (os.path.splitext(arguments[-1])[1] if "{" in arguments[-1] else ".json")
    (made / name).write_text("of the user")
    arguments = (*arguments[:-1], name) if "{" in arguments[-1] else (*arguments, name)
    if arguments[0] == "analyze-patches":
        from kpbench.analysis import localisation, measures
        from kpbench.analysis.natural_images import sample_windows

        monkeypatch.setattr(measures, "SIZES_PX", (5.0,))
        monkeypatch.setattr(localisation, "PARTS_OF_BASIN", (1.0,))
        monkeypatch.setattr(sample_windows, "__defaults__", (100,))
    result = kpbench(*arguments, code=1)
    assert result.stderr.splitlines()[-1] == (
        f"kpbench: {name}: exists, and kpbench did not write it; name another file, or move it elsewhere"
    )
    assert (made / name).read_text() == "of the user"


@pytest.mark.parametrize(
    "arguments",
    [
        ("score", "a.json", "--gt", "coco/annotations.json", "--json", "coco/annotations.json"),
        ("score", "a.json", "--gt", "coco/annotations.json", "--csv", "coco/annotations.json"),
        ("score", "a.json", "--gt", "set", "--json", "a.json"),
        ("score", "a.json", "--gt", "set", "--json", "set/dataset.json"),
        ("score", "a.json", "--gt", "set", "--csv", "set/shard-00000.h5"),
        ("compare", "a.json", "b.csv", "--gt", "set", "--json", "b.csv"),
        ("detect", "set", "--out", "set/dataset.json"),
        ("detect", "coco/images", "--out", "coco/annotations.json"),
        ("detect", "coco/images/00000000.png", "--out", "new.json", "--overlay", "link.png"),
    ],
    ids=" ".join,
)
def test_what_a_command_reads_it_never_writes(made, arguments):
    (made / "link.png").symlink_to("coco/images/00000000.png")
    before = {path: path.read_bytes() for path in made.rglob("*") if path.is_file()}
    result = kpbench(*arguments, code=1)
    assert len(result.stderr.splitlines()) == 1
    assert all(path.read_bytes() == data for path, data in before.items())


def test_pictures_of_the_users_are_not_drawn_over(made):
    (made / "b").mkdir()
    for command in (
        ("detect", "photos", "--out", "new.json", "--overlay", "b"),
        ("degrade", "photos", "--effect", "blur", "--level", "1", "--out", "b"),
    ):
        (made / "b" / "wall.png").write_bytes(b"of the user")
        assert "b/wall.png: exists, and kpbench did not write it" in kpbench(*command, code=1).stderr
        assert (made / "b" / "wall.png").read_bytes() == b"of the user"
        (made / "b" / "wall.png").unlink()
        kpbench(*command)
        kpbench(*command)  # what kpbench drew is drawn again
        (made / "b" / "wall.png").unlink()


def test_overwrite_and_resume_leave_what_the_user_put_into_a_dataset(tmp_path):
    config, folder = SynthConfig(2, size_px=(64, 64), shard_size=1), tmp_path / "set"
    generate(config, folder, workers=1)
    mine = {"shard-notes.h5": b"notes", "README.md": b"my own", "shard-1.h5": b"mine", "preview.png": b"my picture"}
    for name, data in mine.items():
        (folder / name).write_bytes(data)
    for options in ({"overwrite": True}, {"resume": True}):
        generate(config, folder, workers=1, **options)
        assert {name: (folder / name).read_bytes() for name in mine} == mine
    (folder / "shard-00000.h5").write_bytes(b"mine")
    with pytest.raises(DataError, match=r"shard-00000\.h5: would be removed, but kpbench did not write it"):
        generate(config, folder, workers=1, overwrite=True)
    assert (folder / "shard-00000.h5").read_bytes() == b"mine"
    assert (folder / "shard-00001.h5").exists()
    assert (folder / "dataset.json").exists()


def test_a_lock_that_is_a_link_truncates_nothing(tmp_path):
    (tmp_path / "diary").write_text("of the user")
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / ".kpbench.lock").symlink_to(tmp_path / "diary")
    with pytest.raises(DataError, match="it is a symbolic link"):
        generate(SynthConfig(1, size_px=(64, 64)), tmp_path / "set", workers=1)
    assert (tmp_path / "diary").read_text() == "of the user"


def test_a_link_is_followed_and_a_device_and_a_pipe_are_written_through(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "link"
    link.symlink_to("elsewhere/file")
    for data in (OURS, OURS * 2):
        write_file(link, data)
        assert link.is_symlink()
        assert (tmp_path / "elsewhere" / "file").read_bytes() == data
    null = tmp_path / "null"
    null.symlink_to(os.devnull)
    write_file(null, OURS)
    assert stat.S_ISCHR(null.stat().st_mode)
    pipe, read = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    write_file(pipe, OURS)
    reader.join(10)
    assert read == [OURS]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(DataError, match="loop: cannot be written"):
        write_file(loop, OURS)


def test_the_mode_is_kept_and_a_new_file_gets_that_of_the_umask(tmp_path):
    file = tmp_path / "file"
    old = os.umask(0o027)
    try:
        write_file(file, OURS)
        assert stat.S_IMODE(file.stat().st_mode) == 0o640
        file.chmod(0o604)
        write_file(file, OURS * 2)
        assert stat.S_IMODE(file.stat().st_mode) == 0o604
    finally:
        os.umask(old)


def test_only_a_file_of_the_same_kind_is_replaced(tmp_path):
    file = tmp_path / "file"
    for old, new, says in [
        (b"mine", OURS, "kpbench did not write it"),
        (b"kpbench.patch/1", OURS, "kpbench did not write it"),
        (OTHER, OURS, r"of another kind \(kpbench.report\)"),
        (OURS, b"no mark", r"of another kind \(kpbench.scores\)"),
    ]:
        file.write_bytes(old)
        part = tmp_path / "part"
        part.write_bytes(new)
        for write in (lambda new=new: write_file(file, new), lambda part=part: move_file(part, file)):
            with pytest.raises(DataError, match=says):
                write()
            assert file.read_bytes() == old
    with pytest.raises(DataError, match="would be removed"):
        remove_file(file, "report")
    for old in (b"", OURS):
        file.write_bytes(old)
        write_file(file, OURS * 2)
        assert file.read_bytes() == OURS * 2
    remove_file(file, "scores")
    assert not file.exists()


def test_what_cannot_be_written_is_known_before_the_work(tmp_path):
    (tmp_path / "mine").write_bytes(b"mine")
    for path, says in [
        (tmp_path, "it is a folder"),
        (tmp_path / "no" / "file", "there is no folder"),
        (tmp_path / "mine", "kpbench did not write it"),
        (tmp_path / "mine" / "file", "cannot be written, Not a directory"),
    ]:
        with pytest.raises(DataError, match=says):
            require_writable(path, "scores")
    require_writable(tmp_path / "new", "scores")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_every_file_of_every_command_tells_its_kind(made):
    """A second run of any command replaces its own files: each has a mark at its start or its end."""
    commands = [
        (*SCORE, "--json", "s.json", "--csv", "s.csv", "--report", "r.html"),
        (*SCORE, "--report", "r.md"),
        (*SCORE, "--report", "r.tex"),
        ("compare", "a.json", "b.csv", "--gt", "set", "--json", "c.json", "--report", "c.html"),
        ("detect", "photos", "--out", "p.json", "--overlay", "drawn"),
        ("detect", "photos", "--out", "p.jsonl", "--overlay", "film.mp4"),
        ("detect", "photos", "--out", "p.csv", "--overlay", "film.avi"),
        ("detect", "photos/wall.png", "--out", "p.h5", "--overlay", "one.jpg"),
        ("detect", "photos", "--out", "p.parquet"),
        ("preview", "set", "--out", "sheet.png"),
        ("degrade", "photos", "--effect", "blur", "--level", "1", "--out", "worse"),
        ("render-patches", "--out", "print", "--svg", "--pdf", "--png", "--dxf"),
        ("render-patches", "--out", "boards", "--board", "hexagon", "--patch", "wheel"),
    ]
    for command in commands:
        kpbench(*command)
    for path in sorted(made.rglob("*")):
        if path.is_file() and path.parent.name not in ("photos", "set") and path.suffix != ".txt":
            data = path.read_bytes()
            assert kind_of(data[:65536], data[-16384:]), path
    before = digests(made / "print")
    for command in commands:
        kpbench(*command)
    assert digests(made / "print") == before
    film = cv2.VideoCapture("film.avi")
    assert film.read()[0]
    shutil.rmtree(made / "set")
    with pytest.raises(DataError):
        open_dataset(made / "set")


def test_a_lock_with_content_is_the_users(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / ".kpbench.lock").write_text("of the user")
    generate(SynthConfig(1, size_px=(64, 64)), tmp_path / "set", workers=1)
    assert (tmp_path / "set" / ".kpbench.lock").read_text() == "of the user"
