"""Two runs at once, signals, and odd ends: nothing is lost, nothing is half-written, one line says what happened."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import digests, kpbench, perfect_predictions, write_dataset

from kpbench import bench, export_dataset, load_suite, open_dataset, write_predictions
from kpbench.detectors.program import run_program
from kpbench.errors import DataError
from kpbench.locks import LOCK_FILE, lock_folder
from kpbench.synth.suite import SuiteConfig

COMMAND = [sys.executable, "-m", "kpbench"]
IMAGES = [[(3, 4, 2, 0), (6, 2, 2, 1)], [(5, 5, 2, 2)], [(4, 4, 2, 3)]]


def running(group):
    """Number of processes of a process group that are not zombies."""
    count = 0
    for entry in filter(str.isdigit, os.listdir("/proc")):
        try:
            fields = Path(f"/proc/{entry}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        count += int(fields[2]) == group and fields[0] != "Z"
    return count


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="reads /proc")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_ends_a_run_as_ctrl_c_does(here, number, code):
    words = ["synth", "--n", "4000", "--size", "320x240", "--shard-size", "10", "--workers", "2", "--out", "set"]
    options = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    inherited = signal.signal(number, signal.SIG_DFL)  # SIGHUP is ignored under nohup
    try:
        started = subprocess.Popen([*COMMAND, *words], **options)
    finally:
        signal.signal(number, inherited)
    with started as run:
        until = time.monotonic() + 30
        while not list(here.glob("set/shard-*")) and time.monotonic() < until:
            time.sleep(0.05)
        os.killpg(run.pid, number)  # to all processes, as a batch system and a terminal do
        _, errors = run.communicate(timeout=20)
    assert run.returncode == code
    assert errors == "kpbench: interrupted: finished shards are kept in set; add --resume to continue the run\n"
    left = [path.name for path in (here / "set").iterdir()]
    assert left
    assert all(name.startswith("shard-") for name in left)
    until = time.monotonic() + 5
    while running(run.pid) and time.monotonic() < until:
        time.sleep(0.05)
    assert running(run.pid) == 0


@pytest.mark.parametrize("file_format", ["coco", "yolo", "webdataset"])
def test_an_interrupted_export_is_marked_and_continues(tmp_path, file_format):
    dataset = write_dataset(tmp_path / "set", IMAGES)
    export_dataset(dataset, file_format, tmp_path / "whole")

    def interrupt(count, seen=[]):  # noqa: B006
        seen.append(count)
        if len(seen) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_dataset(dataset, file_format, tmp_path / "out", interrupt)
    assert (tmp_path / "out" / ".kpbench-unfinished").exists()
    other = write_dataset(tmp_path / "other", IMAGES[:1])
    with pytest.raises(DataError, match="holds another unfinished export"):
        export_dataset(other, file_format, tmp_path / "out")
    export_dataset(dataset, file_format, tmp_path / "out")
    for folder in ("", "images", "labels"):
        if (tmp_path / "whole" / folder).is_dir():
            assert digests(tmp_path / "out" / folder) == digests(tmp_path / "whole" / folder)
    with pytest.raises(DataError, match="is not empty"):
        export_dataset(dataset, file_format, tmp_path / "out")


def test_a_second_bench_or_training_in_one_folder_is_refused(here):
    suite = SuiteConfig(load_suite("paper-v1"), images=1, size_px=(203, 155), only=("blur",))
    (here / "run").mkdir()
    with lock_folder(here / "run"):
        with pytest.raises(DataError, match="another kpbench run is writing to it"):
            bench([suite], ["orb"], "run", workers=1)
        (here / "tiny.toml").write_text(TINY)
        words = ("train", "--config", "tiny.toml", "--out", "run", "--workers", "0")
        assert kpbench(*words, code=1).stderr == "kpbench: run: another kpbench run is writing to it\n"
    assert not (here / "run" / LOCK_FILE).exists()


TINY = """
name = "tiny"
batch = 4

[network]
widths = [4, 4, 8, 8]
depths = [1, 1, 1, 1]
down = "stride"
head_width = 8
descriptor_width = 8
ids = 4

[[phases]]
samples = 4
"""

PROGRAM = """#!{python}
import json, subprocess, sys
subprocess.Popen(["sleep", "60"])  # keeps the streams of this program open
sys.stderr.buffer.write(b"\\xff\\xfe odd \\x1b[31m\\n")
sys.stdout.buffer.write(b"\\xff" * 100000)
if "fail" in sys.argv:
    sys.exit(3)
content = {{"schema": "kpbench.predictions/1", "predictions": [{{"image_id": 0, "keypoints": [[1, 2]]}}]}}
open(sys.argv[-1], "w").write(json.dumps(content))
"""


def test_a_program_with_odd_output_and_a_child_in_the_background(here):
    program = here / "program"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    image = np.zeros((8, 8), np.uint8)
    start = time.monotonic()
    assert run_program(str(program), [image])[0].xy.tolist() == [[1, 2]]
    with pytest.raises(DataError, match="exit code 3, \ufffd\ufffd odd"):
        run_program(f"{program} fail", [image])
    assert time.monotonic() - start < 20


def test_closed_streams_and_messages_of_c_libraries(here):
    """Two processes in all: what OpenCV and libpng print of a damaged picture is not seen, nor written into a file."""
    write_dataset(here / "set", IMAGES)
    write_predictions("p.json", perfect_predictions(IMAGES, image_id=[0, 1, 2], dataset="set"))
    (here / "photos").mkdir()
    picture = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8))[1].tobytes()
    (here / "photos" / "a.png").write_bytes(picture[:1000] + bytes(50) + picture[1050:])
    (here / "photos" / "b.png").write_bytes(picture)
    line = " ".join([*COMMAND, "detect", "photos", "--detector", "template", "--out", "new.json"])
    done = subprocess.run(line, shell=True, capture_output=True, text=True)
    assert done.returncode == 1
    assert all(text.startswith("kpbench: ") for text in done.stderr.splitlines()), done.stderr
    line = " ".join([*COMMAND, "score", "p.json", "--gt", "set", "--json", "s.json", "2>&-", "0<&-"])
    done = subprocess.run(line, shell=True, capture_output=True, text=True)
    assert done.returncode == 0
    assert "detection score" in done.stdout
    assert (here / "s.json").read_bytes().startswith(b"{")
    assert len(open_dataset(here / "set")) == 3
