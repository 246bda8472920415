"""The child process that checks HDF5 files: what the system refuses, files at URLs, many files at once."""

import os
import shutil
import stat
import time
from pathlib import Path

import fsspec
import h5py
import pytest
from helpers import kpbench as run
from helpers import perfect_predictions, write_dataset

from kpbench import hdf5, open_dataset, read_predictions, write_predictions
from kpbench.dataset.shard import open_shard
from kpbench.errors import DataError, KpbenchError, PredictionsError
from kpbench.files import folder_at

CASES = Path(__file__).parent / "cases"
IMAGES = [[(3, 4, 2, 0)]]
HOSTILE = ["shard-hang.h5", "shard-bomb-27kB.h5", "shard-hang-on-open.h5"]


@pytest.fixture
def shards(tmp_path, dataset):
    """Paths of six copies of a sound shard."""
    paths = [tmp_path / f"{n}.h5" for n in range(6)]
    for path in paths:
        shutil.copy(dataset.path / "shard-00000.h5", path)
    return paths


# --- What the system refuses ---------------------------------------------------------------------------------------


@pytest.fixture(params=["shard", "predictions"])
def file(request, tmp_path):
    """An HDF5 file and the function that reads the file."""
    if request.param == "shard":
        write_dataset(tmp_path / "set", IMAGES)
        return tmp_path / "set" / "shard-00000.h5", lambda path: open_shard(path).close()
    write_predictions(tmp_path / "p.h5", perfect_predictions(IMAGES))
    return tmp_path / "p.h5", read_predictions


def problem(path, read):
    with pytest.raises((DataError, PredictionsError)) as caught:
        read(path)
    return str(caught.value)


def test_what_the_child_process_alone_is_refused_is_named(file, monkeypatch):
    """As if the system refused the child process: its answer is that of h5py for a file without permission."""
    path, read = file
    monkeypatch.setattr(hdf5, "_check_in_child", lambda *_: ("system", 13))
    assert problem(path, read) == f"{path}: cannot be read, Permission denied"


def test_a_file_that_cannot_be_opened_is_named_before_the_child_is_asked(file, monkeypatch):
    path, read = file
    original = os.open

    def refuse(opened, *more, **named):
        if str(opened) == str(path):
            raise PermissionError(13, "Permission denied", str(opened))
        return original(opened, *more, **named)

    monkeypatch.setattr(os, "open", refuse)
    monkeypatch.setattr(hdf5, "_check_in_child", None)
    assert problem(path, read) == f"{path}: cannot be read, Permission denied"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read every file")
def test_a_file_without_permission_is_named(file):
    path, read = file
    path.chmod(0)
    assert problem(path, read) == f"{path}: cannot be read, Permission denied"


@pytest.mark.parametrize("kind", ["missing", "folder", "pipe"])
def test_a_path_that_is_no_file_is_named_and_nothing_waits(file, kind):
    path, read = file
    path.unlink()
    if kind == "folder":
        path.mkdir()
    if kind == "pipe":
        os.mkfifo(path)
    reason = {
        "missing": "cannot be read, No such",
        "folder": "cannot be read, Is a directory",
        "pipe": "cannot be read, it is a pipe",
    }
    assert problem(path, read).startswith(f"{path}: ")
    assert reason[kind] in problem(path, read)


def test_commands_name_the_reason(file, monkeypatch):
    path, _ = file
    monkeypatch.setattr(hdf5, "_check_in_child", lambda *_: ("system", 13))
    if path.name == "p.h5":
        write_dataset(path.parent / "set", IMAGES)
        done = run("score", path, "--gt", path.parent / "set", code=1)
    else:
        done = run("inspect", path.parent, code=1)
    assert f"{path}: cannot be read, Permission denied" in done.stderr
    assert len(done.stderr.splitlines()) == 1


# --- Files at URLs -------------------------------------------------------------------------------------------------


def test_a_dataset_at_a_url_is_read_as_a_local_one(dataset):
    files = fsspec.filesystem("memory")
    files.put(str(dataset.path), "/child-set", recursive=True)
    there = open_dataset("memory://child-set")
    assert there.truth.keypoints.tobytes() == dataset.truth.keypoints.tobytes()
    assert [there.image(n).tobytes() for n in (5, 0)] == [dataset.image(n).tobytes() for n in (5, 0)]
    assert len([*there.verify()]) == 2


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_shard_at_a_url_is_refused(name):
    fsspec.filesystem("memory").pipe(f"/hostile/{name}", (CASES / name).read_bytes())
    started = time.process_time()
    assert problem(folder_at("memory://hostile") / name, open_shard).startswith(f"memory://hostile/{name}: ")
    assert time.process_time() - started < 2  # the time is that of the child process


def test_a_url_whose_server_fails_is_one_line(dataset, monkeypatch):
    fsspec.filesystem("memory").put(str(dataset.path), "/broken-set", recursive=True)
    path = folder_at("memory://broken-set") / "shard-00000.h5"

    def fail(self, count):
        raise RuntimeError("connection\nlost")

    monkeypatch.setattr(hdf5._Readable, "readinto", lambda self, buffer: fail(self, 0))
    with pytest.raises(KpbenchError, match="connection"):
        open_shard(path)
    monkeypatch.undo()
    open_shard(path).close()


# --- Many files ----------------------------------------------------------------------------------------------------


def questions(monkeypatch):
    """A list that gets the names of the files of each question to the child process."""
    found, ask = [], hdf5._Child.ask

    def note(self, keys, *more):
        found.append([Path(key[0]).stem for key in keys])
        ask(self, keys, *more)

    monkeypatch.setattr(hdf5._Child, "ask", note)
    return found


def open_all(paths):
    for n, path in enumerate(paths):
        open_shard(path, paths[n + 1 :]).close()


def test_many_shards_are_one_question(shards, monkeypatch):
    asked = questions(monkeypatch)
    open_all(shards)
    assert asked == [["0", "1", "2", "3", "4", "5"]]


def test_the_truth_and_verify_ask_ahead(tmp_path, dataset, monkeypatch):
    asked = questions(monkeypatch)
    assert len(open_dataset(dataset.path).truth.keypoints)
    assert len([*open_dataset(dataset.path).verify()]) == 2
    assert asked == [["shard-00000", "shard-00001"]] * 2


def test_a_shard_that_hangs_is_named_and_the_others_are_read(shards, monkeypatch):
    shutil.copy(CASES / "shard-hang-on-open.h5", shards[2])
    asked = questions(monkeypatch)
    for n, path in enumerate(shards):
        if n == 2:
            assert "crashes over it, or takes too much" in problem(path, lambda p, n=n: open_shard(p, shards[n + 1 :]))
        else:
            open_shard(path, shards[n + 1 :]).close()
    assert asked == [["0", "1", "2", "3", "4", "5"], ["3", "4", "5"]]


def test_a_shard_that_changes_after_its_check_is_checked_again(shards):
    open_shard(shards[0], shards[1:]).close()
    open_shard(shards[1], shards[2:]).close()
    shutil.copy(shards[5], shards[5].with_name("changed"))
    with h5py.File(shards[5].with_name("changed"), "r+") as changed:
        del changed["rung"]
    shards[5].with_name("changed").replace(shards[2])
    assert "/rung is missing" in problem(shards[2], open_shard)
    open_shard(shards[3]).close()


def test_shards_are_opened_in_another_order_than_announced(shards, monkeypatch):
    open_shard(shards[0], shards[1:]).close()
    for n in (4, 1, 0, 5, 2, 3):
        open_shard(shards[n]).close()
    hdf5._child.process.kill()
    hdf5._child.process.wait()
    open_shard(shards[1]).close()


def test_a_missing_shard_is_told_when_its_turn_comes(shards):
    shards[1].unlink()
    open_shard(shards[0], shards[1:]).close()
    assert "No such file" in problem(shards[1], open_shard)


def test_predictions_between_two_shards_are_no_answer_to_the_shard(shards, tmp_path):
    write_predictions(tmp_path / "p.h5", perfect_predictions(IMAGES))
    open_shard(shards[0], [tmp_path / "p.h5", *shards[1:]]).close()
    assert len(read_predictions(tmp_path / "p.h5")) == 1
    assert "missing" in problem(tmp_path / "p.h5", open_shard)


def test_after_a_fork_each_process_has_its_own_child(shards):
    open_shard(shards[0], shards[1:]).close()
    mine = hdf5._child.process.pid
    child = os.fork()
    if not child:
        code = 1
        try:
            open_shard(shards[1]).close()
            code = 0 if hdf5._child.process.pid != mine else 2
            hdf5._stop_child()
        finally:
            os._exit(code)
    assert os.waitpid(child, 0)[1] == 0
    open_shard(shards[1]).close()
    assert hdf5._child.process.pid == mine


def test_no_pipe_is_left_open(shards):
    open_all(shards)
    hdf5._stop_child()
    before = len(os.listdir("/dev/fd"))
    open_all(shards)
    hdf5._stop_child()
    assert len(os.listdir("/dev/fd")) == before
    assert stat.S_ISREG(shards[0].stat().st_mode)
