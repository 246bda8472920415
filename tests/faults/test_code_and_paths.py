"""No code of the current folder runs, and no name in a file leads out of the folder that it belongs to."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import kpbench, perfect_predictions, write_dataset

from kpbench import load_board, load_detector, load_patches, load_suite, open_dataset, write_predictions
from kpbench.errors import DataError, KpbenchError
from kpbench.files import PACKAGE, path_below, shipped_folder
from kpbench.predictions.coco import open_coco
from kpbench.text import is_name
from kpbench.training.recipe import load_recipe
from kpbench.workers import run_in_order

IMAGES = [[(3, 4, 2, 0), (6, 2, 2, 1)], [(5, 5, 2, 2)]]

# --- Code ----------------------------------------------------------------------------------------------------------

PLANTED = (
    *(
        "albumentations",
        "apriltag",
        "click",
        "cv2",
        "deflate",
        "distributed",
        "h5py",
        "jinja2",
        "lazy_loader",
        "locus",
        "matplotlib",
        "msgspec",
        "napa_vision",
    ),
    *(
        "numpy",
        "onnxruntime",
        "pandas",
        "PIL",
        "pyarrow",
        "reportlab",
        "scipy",
        "threadpoolctl",
        "tqdm",
        "upath",
        "yaml",
    ),
    *("argparse", "csv", "json", "multiprocessing", "pickle", "socket", "typing"),
)
"""Modules that kpbench imports: those it needs, those that are optional, and some of Python's own."""


def plant(folder):
    """Put modules into a folder that leave a file behind when they are imported."""
    for name in PLANTED:
        code = f"import os\nopen({str(folder / 'ran-')!r} + {name!r} + '-%d' % os.getpid(), 'w')\n"
        (folder / f"{name}.py").write_text(code + "raise ImportError('planted')\n")


def run(folder, *command):
    environment = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
    environment.pop("PYTHONSAFEPATH", None)
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return done, sorted(path.name for path in folder.glob("ran-*"))


@pytest.mark.parametrize("start", ["module", "script"])
def test_modules_in_the_current_folder_stay_unread(tmp_path, start):
    """Worker processes, and packages that are imported late or that are optional, included."""
    plant(tmp_path)
    if start == "module":
        line = "-m kpbench synth --n 2 --size 64x64 --shard-size 1 --workers 2 --out set --deteriorate ladder"
        done, ran = run(tmp_path, sys.executable, *shlex.split(line))
        assert (tmp_path / "set" / "dataset.json").exists(), done.stderr
    else:  # several commands in one process, as the script starts them
        (tmp_path / "bin").mkdir()
        chain = (
            "from kpbench.cli import main\n"
            "def run(line):\n"
            "    try: main(line.split(), prog_name='kpbench')\n"
            "    except SystemExit as end: print(line, '->', end.code)\n"
            "if __name__ == '__main__':\n"
            "    run('synth --n 1 --size 64x64 --workers 1 --out set')\n"
            "    run('detect set --detector superpoint-small --workers 1 --out a.csv')\n"
            "    run('detect set --detector apriltag --workers 1 --out b.parquet')\n"
            "    run('score a.csv --gt set --report report.html')\n"
        )
        (tmp_path / "bin" / "kpbench").write_text(chain)
        done, ran = run(tmp_path, sys.executable, str(tmp_path / "bin" / "kpbench"))
        assert done.stdout.count("-> 0") == 4, done.stdout + done.stderr
    assert not ran


def test_a_module_of_ones_own_is_found_last_and_does_not_replace_a_package(here, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    plant(here)
    (here / "mine_of_k2.py").write_text("from kpbench import Detections\ndef find(image): return Detections.none()\n")
    load_detector("template")
    assert str(here) not in sys.path
    assert len(load_detector("mine_of_k2:find")(np.zeros((9, 9), np.uint8))) == 0
    assert sys.path[-1] == str(here)
    with pytest.raises(DataError, match="module 'csv' has no attribute 'find'"):
        load_detector("csv:find")
    assert not list(here.glob("ran-*"))


def search_path(n):
    return os.environ.get("PYTHONSAFEPATH"), sys.flags.safe_path, sys.path


def test_a_worker_searches_where_its_parent_does_and_the_programs_that_it_starts_do_as_usual():
    [(variable, safe, path)] = run_in_order(search_path, [0], workers=1)
    assert variable is None
    assert safe
    assert path == sys.path
    assert "PYTHONSAFEPATH" not in os.environ


def test_python_m_starts_from_a_folder_that_holds_the_package(tmp_path):
    """A checkout that is not installed: the folder is searched, but last."""
    (tmp_path / "kpbench").symlink_to(PACKAGE)
    (tmp_path / "click.py").write_text("raise SystemExit('planted')")
    done, _ = run(tmp_path, sys.executable, "-m", "kpbench", "--version")
    assert done.stdout.startswith("kpbench"), done.stderr


# --- Names ---------------------------------------------------------------------------------------------------------

BAD_NAMES = {
    "absolute": "/tmp/escaped/suite",
    "above": "../escaped",
    "below": "a/b",
    "Windows": "C:\\a",
    "backslash": "a\\b",
    "hidden": ".name",
    "option": "-name",
    "space": " name",
    "empty": "",
    "line feed": "a\nb",
    "escape": "a\x1b[31mred",
    "C1": "a\x9b31m",
    "right to left": "a\u202egnp",
    "NUL": "a\0b",
    "markup": "a <script>alert(1)</script>",
    "formula": "=cmd|' /C calc'!A0",
    "quote": 'a"b',
    "long": "n" * 101,
    "number": 7,
    "list": ["a"],
}
GOOD_NAMES = ["paper-v1", "motion-blur+low-light", "a name", "v1.2_x", "Würfel", "e\u0301", "板", "n" * 100, "+"]


def toml_text(value):
    return json.dumps(value)  # the texts and lists above read the same in TOML


def suite_text(name):
    text = (shipped_folder("suites") / "paper-v1.toml").read_text()
    return text.replace('"paper-v1"', name)


def patch_text(name):
    return f'name = {name}\nid = 7\nsemicircles = [{{ start_deg = 0, ink = "black" }}]\n'


READERS = {
    "suite": (load_suite, suite_text),
    "condition": (load_suite, lambda name: suite_text('"paper-v1"').replace('name = "scale"', f"name = {name}")),
    "recipe": (load_recipe, lambda name: f"name = {name}\nbatch = 1\nphases = [{{ samples = 1 }}]\n"),
    "board": (load_board, lambda name: f"name = {name}\ngrid = {{ rows = 1, columns = 1 }}\n"),
    "patch": (lambda path: load_patches([path])[0], patch_text),
}


@pytest.mark.parametrize("kind", READERS)
def test_a_name_is_a_name(tmp_path, kind):
    read, text = READERS[kind]
    path = tmp_path / "file.toml"
    for name in BAD_NAMES.values():
        assert not is_name(name)
        path.write_text(text(toml_text(name)), "utf-8")
        with pytest.raises(KpbenchError) as problem:
            read(str(path))
        line = str(problem.value)
        assert line.startswith(f"{path}: "), line
        assert ".name is" in line or " name is" in line, line
        assert "expected a name" in line
        assert len(line.splitlines()) == 1
    for name in GOOD_NAMES:
        assert is_name(name)
        path.write_text(text(toml_text(name)), "utf-8")
        found = read(str(path))
        assert name in (found.name, *(c.name for c in getattr(found, "conditions", ())))


def test_a_board_without_a_name_has_the_name_of_its_file(tmp_path):
    path = tmp_path / "my board (copy).toml"
    path.write_text("grid = { rows = 1, columns = 1 }")
    assert load_board(path).name == "my board (copy)"


@pytest.mark.parametrize(
    ("kind", "command"),
    [
        ("suite", "suite bad.toml"),
        ("suite", "bench --suite bad.toml"),
        ("recipe", "train --config bad.toml"),
        ("board", "render-patches --board bad.toml"),
        ("patch", "render-patches --design bad.toml"),
        ("patch", "synth --n 1 --patches bad.toml"),
        ("patch", "analyze-patches bad.toml"),
    ],
)
def test_commands_write_nothing_outside_their_folder(here, kind, command):
    (here / "bad.toml").write_text(READERS[kind][1](toml_text(str(here / "escaped" / "name"))))
    result = kpbench(*command.split(), code=1)
    assert "expected a name" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert [path.name for path in here.iterdir()] == ["bad.toml"]


@pytest.mark.parametrize("file", ["", ".", "..", "../set/shard-00000.h5", "/etc/passwd", "a\0", 5, None, ["a"]])
def test_a_manifest_names_files_of_its_folder(tmp_path, file):
    write_dataset(tmp_path / "set", IMAGES)
    manifest = tmp_path / "set" / "dataset.json"
    content = json.loads(manifest.read_text())
    content["shards"][0]["file"] = file
    manifest.write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"is not a plain file name|expected a text"):
        open_dataset(tmp_path / "set")


# --- File names in COCO --------------------------------------------------------------------------------------------


@pytest.fixture
def coco(here):
    """An annotations file below ``data``, and a picture of the user's beside that folder."""
    (here / "data" / "images").mkdir(parents=True)
    for path in ("secret.png", "data/good.png", "data/images/in.png"):
        cv2.imwrite(path, np.full((8, 8), 200, np.uint8))
    (here / "data" / "link.png").symlink_to(here / "secret.png")
    (here / "data" / "out").symlink_to(here)
    (here / "data" / "inner.png").symlink_to("good.png")

    def write(file_name):
        content = {"images": [{"id": 0, "file_name": file_name}], "annotations": []}
        content["annotations"] = [{"image_id": 0, "category_id": 1, "keypoints": [3, 3, 2], "radius": 2}]
        (here / "data" / "truth.json").write_text(json.dumps(content))
        return open_coco(here / "data" / "truth.json")

    return write


OUTSIDE = [
    "../secret.png",
    "images/../../secret.png",
    "..\\secret.png",
    "{here}/secret.png",
    "{here}/data/good.png",
    "link.png",
    "out/secret.png",
    "C:\\secret.png",
    "C:secret.png",
    "\\\\host\\share\\secret.png",
    "good.png\0",
]


@pytest.mark.parametrize("name", OUTSIDE)
def test_pictures_outside_the_folder_of_the_annotations_are_not_read(here, coco, name):
    with pytest.raises(DataError, match="expected a file below"):
        coco(name.format(here=here)).image(0)


@pytest.mark.parametrize("name", ["good.png", "./good.png", "in.png", "images/in.png", "inner.png"])
def test_pictures_below_the_folder_are_read(coco, name):
    assert coco(name).image(0).shape == (8, 8, 3)


def test_a_report_embeds_no_picture_from_elsewhere(here, coco):
    coco(str(here / "secret.png"))
    write_predictions("none.json", perfect_predictions([[]], image_id=[0]))
    result = kpbench("score", "none.json", "--gt", "data/truth.json", "--report", "report.html")
    assert [
        line for line in result.stderr.splitlines() if "shows no images" in line and "expected a file below" in line
    ]
    assert "data:image" not in (here / "report.html").read_text().partition("<main")[2]


def test_a_relative_folder_may_hold_the_file(here, monkeypatch):
    (here / "a").mkdir()
    (here / "a" / "x").write_text("")
    assert path_below(Path("a"), "x") == Path("a/x")
    assert path_below(Path(), "a/x") == Path("a/x")
