"""Clauses of the rules of ``docs/reference/safety.md`` that no other test shows, and the places where rules hold."""

import ast
import builtins
import errno
import hashlib
import os
import resource
import signal
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import kpbench, perfect_predictions, write_dataset

from kpbench import (
    export_dataset,
    generate,
    hdf5,
    load_detector,
    merge,
    read_predictions,
    write_predictions,
)
from kpbench.dataset import generate_part
from kpbench.decoding import MOST_PIXELS, MOST_PIXELS_PER_BYTE
from kpbench.detectors.inference import TRIAL_BYTES, TRIAL_PX, TRIAL_SECONDS
from kpbench.errors import DataError
from kpbench.files import LARGEST_FILE, LARGEST_TEXT, PACKAGE, path_below, protect_read_files, read_bytes
from kpbench.hdf5_structure import LARGEST_ATTRIBUTE, LARGEST_CHUNK, MOST_OBJECTS
from kpbench.predictions.parquet_files import MOST_COLUMNS, MOST_EXPANSION, ROOM_BYTES
from kpbench.synth.synthetic import SynthConfig
from kpbench.writing import write_file

IMAGES = [[(3, 4, 2, 0), (6, 2, 2, 1)], [(5, 5, 2, 2)]]
OURS = b'{"schema": "kpbench.scores/1"}'
DOCS = PACKAGE.parent / "docs"


# --- Files of the user's -------------------------------------------------------------------------------------------


def test_a_file_that_was_read_is_not_written_even_as_its_own_kind(tmp_path):
    file, other, link = tmp_path / "file", tmp_path / "other", tmp_path / "link"
    with protect_read_files():
        write_file(file, OURS)
        write_file(file, OURS * 2)
        read_bytes(file)
        other.hardlink_to(file)
        link.symlink_to(file)
        for path in (file, other, link):
            with pytest.raises(DataError, match="this command reads it; name another file"):
                write_file(path, OURS * 3)
    assert file.read_bytes() == OURS * 2
    write_file(file, OURS * 3)


def test_merge_leaves_the_readme_of_the_user(tmp_path):
    config, folder = SynthConfig(2, size_px=(64, 64), shard_size=1), tmp_path / "set"
    for n in range(2):
        generate_part(config, folder, range(n, n + 1), workers=1)
    mine = {"README.md": b"my own", "preview.png": b"my picture"}
    for name, data in mine.items():
        (folder / name).write_bytes(data)
    for _ in range(2):
        merge(folder)
    assert {name: (folder / name).read_bytes() for name in mine} == mine


WRITERS = {
    "writing.py": "the gate",
    "locks.py": "the lock file, which is removed only if it is empty",
    "images.py": "a film's hidden part, which the gate then moves",
    "dataset/generation.py": "a hard link, which replaces nothing",
    "dataset/export.py": "removes hidden parts of an export",
    "benchmark/detection.py": "removes an empty folder",
    "detectors/program.py": "the temporary folder",
    "ui/desk.py": "removes uploads of its temporary folder",
}
"""Modules that write or remove files by themselves, and what."""
WRITING = {
    "write_bytes",
    "write_text",
    "unlink",
    "rename",
    "touch",
    "symlink_to",
    "hardlink_to",
    "rmdir",
    "copyfileobj",
}
WRITING |= {"imwrite", "VideoWriter", "rmtree", "copy2", "copyfile", "copytree", "truncate", "chmod"}


def writes(node):
    """Whether a call writes or removes a file."""
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name in WRITING or ast.unparse(node.func) in ("os.replace", "os.remove", "os.link", "shutil.move"):
        return True
    modes = [a.value for a in [*node.args, *(k.value for k in node.keywords)] if isinstance(a, ast.Constant)]
    return name == "open" and any(isinstance(m, str) and set(m) & set("wax+") and len(m) < 4 for m in modes)


def test_files_of_results_are_written_in_one_place():
    found = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Call) and writes(node)
    }
    assert found == WRITERS.keys()


@pytest.fixture
def made(here):
    write_dataset(here / "set", IMAGES)
    for name in ("a.json", "b.json"):
        write_predictions(name, perfect_predictions(IMAGES, image_id=[0, 1], dataset="set"))
    (here / "photos").mkdir()
    cv2.imwrite("photos/wall.png", np.full((40, 60), 90, np.uint8))
    (here / "mine").write_text("of the user")
    return here


COMMANDS = [
    ("score", "a.json", "--gt", "set", "--json"),
    ("score", "a.json", "--gt", "set", "--csv"),
    ("score", "a.json", "--gt", "set", "--report", ".html"),
    ("compare", "a.json", "b.json", "--gt", "set", "--json"),
    ("detect", "photos", "--detector", "orb", "--out", ".json"),
    ("detect", "photos", "--detector", "orb", "--overlay", ".mp4"),
    ("preview", "set", "--out"),
    ("analyze-patches", "--json"),
    ("analyze-patches", "--figure", ".svg"),
]
WORK = {
    "kpbench.evaluate.score",
    "kpbench.detectors.prediction._detect",
    "kpbench.dataset.card.draw_overview",
    "kpbench.analysis.analyse.measure_designs",
}


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_targets_are_refused_before_the_work(made, command, monkeypatch):
    *words, last = command
    words, suffix = (words, last) if last.startswith(".") else (command, "")
    for place in WORK:
        monkeypatch.setattr(place, lambda *a, **k: pytest.fail("the work began"))
    (made / f"mine{suffix}").write_text("of the user")
    targets = [f"mine{suffix}"] if "--overlay" in words else [f"mine{suffix}", f"no/new{suffix}"]
    for target in targets:
        [line] = kpbench(*words, target, code=1).stderr.splitlines()
        assert line.startswith(f"kpbench: {target}: ")
    assert (made / f"mine{suffix}").read_text() == "of the user"


REFUSALS = {
    errno.EROFS: "Read-only file system",
    errno.EACCES: "Permission denied",
    errno.EMFILE: "too many files are open; raise the limit with `ulimit -n`",
    errno.ENOSPC: "the disk is full",
}


@pytest.mark.parametrize("number", REFUSALS, ids=errno.errorcode.get)
@pytest.mark.parametrize("before", [None, OURS])
def test_a_target_that_the_system_refuses_is_named_with_the_path(tmp_path, number, before, monkeypatch):
    """The system's call is replaced, since tests may run as root, whom no permission stops."""
    path = tmp_path / "s.json"
    if before:
        path.write_bytes(before)
    original = builtins.open

    def refuse(file, mode="r", *more, **named):
        if set(mode) & set("wxa"):
            raise OSError(number, os.strerror(number), str(file))
        return original(file, mode, *more, **named)

    with monkeypatch.context() as patch:
        patch.setattr(builtins, "open", refuse)
        with pytest.raises(DataError) as problem:
            write_file(path, OURS * 2)
    assert str(problem.value) == f"{path}: cannot be written, {REFUSALS[number]}"
    assert [file.read_bytes() for file in tmp_path.iterdir()] == ([before] if before else [])


def test_half_of_a_pair_names_no_picture(tmp_path):
    with pytest.raises(DataError, match=r"'\\ud800\.png' is not read, expected a file below"):
        path_below(tmp_path, "\ud800.png")


# --- Ends ----------------------------------------------------------------------------------------------------------


def test_an_ended_run_leaves_no_hidden_part(tmp_path, monkeypatch):
    def interrupt(config, written, folder, shard, progress):
        (folder / f".{shard.file}.01234567.part").write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr("kpbench.dataset.generation._make_shard", interrupt)
    with pytest.raises(KeyboardInterrupt):
        generate(SynthConfig(2, size_px=(64, 64), shard_size=1), tmp_path / "set", workers=1)
    assert not [*(tmp_path / "set").iterdir()]


def processes(group):
    """Number of processes of a process group that are not zombies."""
    stats = [path.read_text().rpartition(")")[2].split() for path in Path("/proc").glob("[0-9]*/stat") if path.exists()]
    return sum(int(fields[2]) == group and fields[0] != "Z" for fields in stats)


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="reads /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL], ids=lambda n: n.name)
def test_workers_in_the_middle_of_a_long_shard_end_with_their_parent(here, number):
    words = "-m kpbench synth --n 8000 --size 640x480 --shard-size 4000 --workers 2 --out set"
    inherited = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # SIGHUP is ignored under nohup
    try:
        run = subprocess.Popen([sys.executable, *words.split()], stderr=subprocess.DEVNULL, start_new_session=True)
    finally:
        signal.signal(signal.SIGHUP, inherited)
    try:
        until = time.monotonic() + 60
        while processes(run.pid) < 4 and time.monotonic() < until:  # with multiprocessing's resource tracker
            time.sleep(0.1)
        time.sleep(5)
        assert processes(run.pid) >= 4
        run.send_signal(number)  # to the parent alone
        run.wait(20)
        until = time.monotonic() + 10
        while processes(run.pid) and time.monotonic() < until:
            time.sleep(0.1)
        assert not processes(run.pid)
    finally:
        if processes(run.pid):
            os.killpg(run.pid, signal.SIGKILL)


def test_no_line_of_opencv_libtiff_or_ffmpeg_is_seen(here):
    """Pictures and films that these libraries print lines about while they read them."""
    tags = [(256, 32), (257, 24), (258, 8), (259, 1), (262, 1), (273, 8), (277, 1), (278, 24), (279, 5)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    Path("a.tif").write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(904))
    film = cv2.VideoWriter("film.avi", cv2.VideoWriter.fourcc(*"MJPG"), 5, (64, 48))
    for _ in range(3):
        film.write(np.full((48, 64, 3), 90, np.uint8))
    film.release()
    data = bytearray(Path("film.avi").read_bytes())
    start = data.find(b"\xff\xd8\xff", data.find(b"\xff\xd8\xff") + 3)
    data[start : start + 200] = bytes(200)
    Path("film.avi").write_bytes(data)
    for name, expected in (("a.tif", ""), ("film.avi", "kpbench: film.avi: frame 1 of 3 cannot be read")):
        words = [sys.executable, "-m", "kpbench", "detect", name, "--detector", "orb"]
        done = subprocess.run(words, capture_output=True, text=True)
        assert all(line.startswith("kpbench: ") for line in done.stderr.splitlines()), done.stderr
        assert expected in done.stderr


# --- Limits, docs and types ----------------------------------------------------------------------------------------


def test_the_child_process_of_hdf5_has_a_memory_limit(tmp_path):
    write_predictions(tmp_path / "p.h5", perfect_predictions(IMAGES))
    read_predictions(tmp_path / "p.h5")
    soft, _ = resource.prlimit(hdf5._child.process.pid, resource.RLIMIT_AS)
    assert 0 < soft < hdf5.CHECK_MEMORY + 2**32


def test_a_whole_picture_of_900_megapixels_is_refused_before_memory_is_taken(here):
    """Its file of 110 kB holds all pixels, so that only the limit of OpenCV keeps it out."""
    chunks = {
        b"IHDR": struct.pack(">IIBBBBB", 30_000, 30_000, 1, 0, 0, 0, 0),
        b"IDAT": zlib.compress(bytes(30_000 * 3751)),
        b"IEND": b"",
    }
    data = b"\x89PNG\r\n\x1a\n"
    for kind, content in chunks.items():
        data += struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
    Path("large.png").write_bytes(data)
    code = (
        "import re; from pathlib import Path; from kpbench.images import read_rgb\n"
        "assert read_rgb(Path('large.png')) is None\n"
        # not ru_maxrss, which starts at the size of the process that started this one
        "status = Path('/proc/self/status').read_text()\n"
        "assert int(re.search(r'VmHWM:\\s*(\\d+)', status)[1]) < 500_000\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert not done.returncode, done.stderr


def test_the_docs_state_the_limits():
    safety = (DOCS / "reference" / "safety.md").read_text()
    shards = (DOCS / "reference" / "dataset-format.md").read_text()
    for text in (
        f"weights | {LARGEST_FILE >> 30} GiB |",
        f"pipelines of `--augment` | {LARGEST_TEXT >> 20} MiB |",
        f"| a picture | {MOST_PIXELS // 10**6} megapixels;",
        f"| {TRIAL_BYTES >> 20} MiB and {TRIAL_SECONDS:g} s for {TRIAL_PX} ",
    ):
        assert text in safety, text
    said = " ".join((shards + (DOCS / "reference" / "predictions-format.md").read_text()).split())
    assert f"at most {LARGEST_CHUNK >> 30} GiB, an attribute at most {LARGEST_ATTRIBUTE >> 20} MiB" in said
    assert f"a file at most {MOST_OBJECTS}" in said
    assert f"whole or floating numbers, at most {MOST_COLUMNS};" in said
    assert f"numbers of at most {ROOM_BYTES >> 20} MiB plus {MOST_EXPANSION} times the size of the file" in said
    assert f"have at most {MOST_PIXELS_PER_BYTE:,} pixels per byte" in (DOCS / "reference" / "detectors.md").read_text()
    assert f"{hdf5.CHECK_MEMORY >> 30} GiB of memory, and {hdf5.CHECK_SECONDS:g} s of processor time" in said


def test_the_docs_warn_of_inverted_prints():
    assert "No detector can tell an inverted print" in (DOCS / "reference" / "detectors.md").read_text()
    assert "Do not use it otherwise" in (DOCS / "howto" / "print.md").read_text()


def test_the_package_says_that_it_is_typed():
    assert (PACKAGE / "py.typed").is_file()
    assert not Path(PACKAGE / "py.typed").read_text().strip()


@pytest.mark.parametrize("kind", ["text", "link", "pipe"])
def test_the_log_of_a_training_is_no_file_of_the_users(tmp_path, kind):
    from kpbench.errors import DataError
    from kpbench.training.run_log import open_log

    diary = tmp_path / "diary"
    diary.write_text("dear diary\n")
    log = tmp_path / "log.jsonl"
    if kind == "text":
        log.write_text("dear diary\n")
    elif kind == "link":
        log.symlink_to(diary)
    else:
        os.mkfifo(log)
    with pytest.raises(DataError, match=r"log\.jsonl"), open_log(tmp_path, active=True, tensorboard=False):
        pass
    assert diary.read_text() == "dear diary\n"


def test_an_export_keeps_hidden_files_of_the_users(here):
    dataset = write_dataset(here / "set", IMAGES)
    (here / "out").mkdir()
    digest = hashlib.sha256(f"{dataset.fingerprint} ".encode()).hexdigest()
    mark = f"kpbench.export/1 coco {digest}\n"
    (here / "out" / ".kpbench-unfinished").write_text(mark)
    (here / "out" / ".notes.part").write_text("mine")
    (here / "out" / ".annotations.json.0123abcd.part").write_text("half")
    export_dataset(dataset, "coco", here / "out")
    assert (here / "out" / ".notes.part").read_text() == "mine"
    assert not (here / "out" / ".annotations.json.0123abcd.part").exists()


def test_a_limit_of_the_users_on_memory_stays_when_files_are_checked():
    code = (
        "import resource; from kpbench.memory import limit_process; limit_process(2**28, 0); "
        "print(*resource.getrlimit(resource.RLIMIT_AS))"
    )
    done = subprocess.run(
        ["bash", "-c", 'ulimit -v 8000000 && exec "$0" -c "$1"', sys.executable, code], capture_output=True, text=True
    )
    soft, hard = map(int, done.stdout.split())
    assert hard == 8_000_000 * 1024
    assert soft < 2**32


def test_a_program_gets_its_images_in_a_folder_whose_name_is_no_text(here, monkeypatch):
    folder = os.fsencode(here) + b"/t\xff"
    os.mkdir(folder)
    monkeypatch.setenv("TMPDIR", os.fsdecode(folder))
    monkeypatch.setattr("tempfile.tempdir", None)
    (here / "finder.py").write_text(
        "import json, os, sys\n"
        "names = sorted(os.listdir(sys.argv[1]))\n"
        "found = [{'image_id': n, 'keypoints': []} for n, _ in enumerate(names)]\n"
        "json.dump({'schema': 'kpbench.predictions/1', 'predictions': found}, open(sys.argv[2], 'w'))\n"
    )
    command = f"program:{sys.executable} {here / 'finder.py'}"
    assert len(load_detector(command)(np.zeros((40, 50), np.uint8))) == 0
