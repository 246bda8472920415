"""What will be refused is refused before the work; every message is one line and names its place."""

import stat
import subprocess
import sys
import threading

import cv2
import numpy as np
import pytest
from helpers import kpbench, perfect_predictions, write_dataset

from kpbench import bench, load_suite, write_predictions, write_suite_reports
from kpbench.dataset import generate_part
from kpbench.dataset.generation import generate
from kpbench.detectors.program import run_program
from kpbench.errors import DataError
from kpbench.synth.suite import SuiteConfig
from kpbench.synth.synthetic import SynthConfig
from kpbench.writing import kind_of

COMMAND = [sys.executable, "-m", "kpbench"]
IMAGES = [[(3, 4, 2, 0), (6, 2, 2, 1)], [(5, 5, 2, 2)]]


def foreign(path, data=b"of the user"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("source", ["photos", "photos/a.jpg", "set", "film.avi"])
@pytest.mark.parametrize("where", ["folder", "file"])
def test_a_drawing_that_will_be_refused_is_refused_before_the_work(here, source, where, monkeypatch):
    (here / "photos").mkdir()
    cv2.imwrite("photos/a.jpg", np.full((40, 60), 90, np.uint8))
    write_dataset(here / "set", IMAGES)
    film = cv2.VideoWriter("film.avi", cv2.VideoWriter.fourcc(*"MJPG"), 5, (64, 48))
    for _ in range(2):
        film.write(np.full((48, 64, 3), 90, np.uint8))
    film.release()
    drawn = {"set": "00000001.png", "film.avi": "00000001.png"}.get(source, "a.jpg.png")
    if where == "file":
        drawn = "out.png" if source == "photos/a.jpg" else "out.mp4"
    path = foreign(here / "drawn" / drawn)
    target = "drawn" if where == "folder" else f"drawn/{drawn}"
    works = []
    monkeypatch.setattr("kpbench.detectors.prediction._detect", lambda *a: works.append(a))
    result = kpbench("detect", source, "--detector", "orb", "--out", "p.json", "--overlay", target, code=1)
    assert f"drawn/{drawn}: exists, and kpbench did not write it" in result.stderr
    assert not works
    assert not (here / "p.json").exists()
    assert path.read_bytes() == b"of the user"


def test_a_degraded_image_that_will_be_refused_is_refused_before_the_work(here):
    (here / "photos" / "deep").mkdir(parents=True)
    for name in ("a.png", "deep/b.jpg"):
        cv2.imwrite(f"photos/{name}", np.full((40, 60), 90, np.uint8))
    foreign(here / "worse" / "deep" / "b.jpg.png")
    result = kpbench("degrade", "photos", "--effect", "blur", "--level", "1", "--out", "worse", code=1)
    assert result.stderr.startswith("kpbench: worse/deep/b.jpg.png: exists, and kpbench did not write it")
    assert not (here / "worse" / "a.png").exists()


def test_a_foreign_manifest_is_refused_before_the_shards_are_made(tmp_path, monkeypatch):
    config, folder = SynthConfig(2, size_px=(64, 64), shard_size=1), tmp_path / "set"
    generate(config, folder, workers=1)
    (folder / "shard-00001.h5").unlink()
    foreign(folder / "dataset.json", b'{"mine": 1}')
    made = []
    monkeypatch.setattr("kpbench.dataset.generation._make_shard", lambda *a: made.append(a))
    monkeypatch.setattr("kpbench.dataset.generation.find_finished_shards", lambda *a: made.append(a))
    for work in (lambda: generate(config, folder, workers=1, resume=True), lambda: kpbench("merge", folder)):
        with pytest.raises((DataError, AssertionError), match=r"dataset\.json: exists, and kpbench did not write it"):
            work()
    assert not made
    assert (folder / "dataset.json").read_bytes() == b'{"mine": 1}'


def test_a_run_does_not_both_resume_and_overwrite(tmp_path):
    config = SynthConfig(2, size_px=(64, 64), shard_size=1)
    generate(config, tmp_path / "set", workers=1)
    before = (tmp_path / "set" / "shard-00000.h5").stat().st_mtime_ns
    for make in (generate, lambda *a, **k: generate_part(*a, range(1), **k)):
        for folder in ("set", "new"):
            with pytest.raises(DataError, match="`resume=True` and `overwrite=True` exclude each other"):
                make(config, tmp_path / folder, workers=1, resume=True, overwrite=True)
    assert (tmp_path / "set" / "shard-00000.h5").stat().st_mtime_ns == before
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("file", ["preds.json", "scores.json", "contact-sheet.png"])
def test_the_demo_refuses_before_it_makes_images(here, file):
    assert "detector 'nope' is not known" in kpbench("demo", "--out", "new", "--detector", "nope", code=1).stderr
    assert not (here / "new").exists()
    (here / "old" / "print").mkdir(parents=True)
    foreign(here / "old" / file)
    result = kpbench("demo", "--out", "old", "--n", "1", code=1)
    assert result.stderr.startswith(f"kpbench: old/{file}: exists, and kpbench did not write it")
    assert not (here / "old" / "data").exists()


def test_a_print_is_refused_as_a_whole(here):
    foreign(here / "print" / "patches.json")
    result = kpbench("render-patches", "--out", "print", "--svg", code=1)
    assert result.stderr.startswith("kpbench: print/patches.json: exists, and kpbench did not write it")
    assert [path.name for path in (here / "print").iterdir()] == ["patches.json"]


def test_every_message_is_a_line_of_moderate_length(here):
    write_dataset(here / "set", IMAGES)
    for name in ("n" * 5000, "a/" * 2500, "nul\0", "line\nfeed" * 900):
        write_predictions("p.json", perfect_predictions(IMAGES, image_id=[0, 1], dataset=name))
        result = kpbench("score", "p.json", code=1)
        assert result.stderr.startswith("kpbench: p.json: names the dataset '")
        assert len(result.stderr.splitlines()) == 1
        assert len(result.stderr) < 1000
        (here / "set").rename("kpbench-data")
        result = kpbench("score", "p.json")
        assert result.stderr.startswith("kpbench: p.json names the dataset '")
        assert len(result.stderr) < 1000
        (here / "kpbench-data").rename("set")


def test_bad_images_have_a_line_each(here):
    (here / "photos").mkdir()
    cv2.imwrite("photos/good.png", np.full((40, 60), 90, np.uint8))
    for name in ("bad.jpg", "worse.png"):
        (here / "photos" / name).write_bytes(b"no image")
    result = kpbench("degrade", "photos", "--effect", "blur", "--level", "1", "--out", "new", code=1)
    assert result.stderr.splitlines() == [
        "kpbench: bad.jpg: cannot be decoded",
        "kpbench: worse.png: cannot be decoded",
        "kpbench: new: lacks 2 images, which cannot be read; the others are done",
    ]


def test_patches_are_for_the_template_detector():
    for name in ("orb", "superpoint"):
        result = kpbench("detect", "photos", "--detector", name, "--patches", "/dev/null", code=2)
        assert f"--patches is for the template detector; {name} does not take designs" in result.stderr


SUITE = SuiteConfig(load_suite("paper-v1"), images=1, size_px=(96, 72), only=("blur",))
DETECTORS = """
from kpbench import Detections
class A:
    name, version = "a/b", "1"
    def detect(self, image):
        return Detections([[1.0, 2.0]], [0.5])
class B(A):
    name = "a-b"
class C(A):
    name = "c"
    version = None
"""


@pytest.fixture
def detectors(here, monkeypatch):
    """A module with detectors that the test may name, in the current folder."""
    (here / "named_alike.py").write_text(DETECTORS)
    monkeypatch.delitem(sys.modules, "named_alike", raising=False)
    return here


def test_a_bench_refuses_two_detectors_whose_files_have_one_name(detectors):
    with pytest.raises(DataError, match=r"the detectors 'a/b' and 'a-b' would be one file, a-b\.json"):
        bench([SUITE], ["named_alike:A", "named_alike:B"], "bench", workers=1)
    assert not (detectors / "bench" / "suites").exists()


def test_a_bench_removes_only_its_own_parts(detectors):
    run = bench([SUITE], ["named_alike:A"], "bench", workers=1)[0]
    parts = run.predictions.with_suffix(".parts")
    assert not parts.exists()
    for data in (b"of the user", b'{"schema": "kpbench.predictions/1"}'):
        run.predictions.unlink()
        notes = foreign(parts / "notes.json", data)
        again = bench([SUITE], ["named_alike:A"], "bench", workers=1)[0]
        assert again.scores.overall.to_dict() == run.scores.overall.to_dict()
        assert [path.name for path in parts.iterdir()] == ["notes.json"]
        assert notes.read_bytes() == data
    bench([SUITE], ["named_alike:A"], "bench", workers=1)  # no part is missing
    run.predictions.unlink()
    foreign(parts / "00000000.json")
    with pytest.raises(DataError, match=r"parts/00000000\.json: exists, and kpbench did not write it"):
        bench([SUITE], ["named_alike:A"], "bench", workers=1)
    assert (parts / "00000000.json").read_bytes() == b"of the user"
    for path in parts.iterdir():
        path.unlink()
    parts.rmdir()
    mine = foreign(detectors / "mine" / "00000000.json", run.predictions.name.encode())
    parts.symlink_to(mine.parent)
    with pytest.raises(DataError, match=r"\.parts: is a symbolic link"):
        bench([SUITE], ["named_alike:A"], "bench", workers=1)
    assert parts.is_symlink()
    assert mine.read_bytes() == run.predictions.name.encode()


def test_a_bench_of_a_detector_without_a_version_leaves_what_is_the_users(detectors):
    run = bench([SUITE], ["named_alike:C"], "bench", workers=1)[0]
    notes = foreign(run.predictions.with_suffix(".parts") / "notes.json")
    stale = foreign(notes.with_name("00000000.json"), b'{"schema": "kpbench.predictions/1", "predictions": []}')
    bench([SUITE], ["named_alike:C"], "bench", workers=1)
    assert notes.read_bytes() == b"of the user"
    assert not stale.exists()
    foreign(run.predictions)
    with pytest.raises(DataError, match="would be removed, but kpbench did not write it"):
        bench([SUITE], ["named_alike:C"], "bench", workers=1)
    assert run.predictions.read_bytes() == b"of the user"


@pytest.mark.parametrize("file", ["paper-v1.html", "paper-v1.md", "scores/paper-v1/a-b.json"])
def test_a_bench_refuses_its_reports_before_the_work(detectors, file):
    (detectors / "bench" / "suites").mkdir(parents=True)
    path = foreign(detectors / "bench" / file)
    with pytest.raises(DataError, match=r"exists, and kpbench did not write it"):
        bench([SUITE], ["named_alike:A"], "bench", workers=1)
    assert not [*(detectors / "bench" / "suites").iterdir()]
    path.unlink()
    runs = bench([SUITE], ["named_alike:A"], "bench", workers=1)
    write_suite_reports(runs, "bench")
    assert kind_of(path.read_bytes())


PROGRAM = """#!{python}
import os, sys
os.{make}
"""


@pytest.mark.parametrize("make", ["mkfifo(sys.argv[-1])", "mkdir(sys.argv[-1])", "symlink('/dev/zero', sys.argv[-1])"])
def test_a_program_whose_predictions_are_no_file(here, make):
    program = here / "program"
    program.write_text(PROGRAM.format(python=sys.executable, make=make))
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    problems = []

    def work():
        with pytest.raises(DataError, match="wrote no predictions file where its last argument says") as problem:
            run_program(str(program), [np.zeros((8, 8), np.uint8)])
        problems.append(problem)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(20)
    assert problems


@pytest.mark.parametrize("command", ["nope", "./notes.txt", "'python", "", "."])
def test_a_program_that_cannot_be_started_is_refused_before_the_work(here, command):
    foreign(here / "notes.txt")
    for words in (("demo", "--out", "new"), ("bench", "--quick", "--out", "new")):
        result = kpbench(*words, "--detector", f"program:{command}", code=1)
        assert "there is no program" in result.stderr or "No closing quotation" in result.stderr
        assert len(result.stderr.splitlines()) == 1
    assert [path.name for path in here.rglob("*")] == ["notes.txt"]


@pytest.mark.parametrize(
    "line",
    ["inspect nope 2>/dev/full", "inspect nope >/dev/full 2>/dev/full", "inspect set >/dev/full", "inspect set 1>&-"],
)
def test_the_exit_code_of_a_full_stream(here, line):
    write_dataset(here / "set", IMAGES)
    done = subprocess.run(" ".join([*COMMAND, line]), shell=True, capture_output=True, text=True)
    assert done.returncode == int("full" in line)
    assert len(done.stderr.splitlines()) <= 1


def test_a_film_without_a_frame_that_can_be_read_is_named(here, monkeypatch):
    film = cv2.VideoWriter("film.avi", cv2.VideoWriter.fourcc(*"MJPG"), 5, (64, 48))
    for _ in range(3):
        film.write(np.full((48, 64, 3), 90, np.uint8))
    film.release()
    monkeypatch.setattr("kpbench.films._video_frames", lambda *a: iter([None] * 3))
    result = kpbench("detect", "film.avi", "--detector", "orb", "--out", "p.json", code=1)
    assert result.stderr == (
        "kpbench: detector orb: failed on all 3 images, first film.avi: frames 0 to 2 of 3 cannot be read\n"
    )
