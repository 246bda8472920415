"""Names that are no text: bytes of file names that are no UTF-8, and halves of surrogate pairs in JSON."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import kpbench

ODD = os.fsdecode(b"odd\xff")
"""A name with a byte that is no UTF-8."""
SURROGATE = "\ud800"


def run(*words):
    """Run a command as a process of its own: OpenCV ends the process over a name that it cannot open."""
    words = [os.fsencode(str(word)) for word in words]
    return subprocess.run([sys.executable, "-m", "kpbench", *words], capture_output=True, env=ENVIRONMENT)


ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(kpbench.__file__).parents[1]), "PYTHONUTF8": "1"}


@pytest.fixture
def photos(here):
    """Two images and a file that is no image, whose names and whose folder's name are no UTF-8."""
    folder = here / ODD
    folder.mkdir()
    image = cv2.imencode(".png", np.full((60, 80), 90, np.uint8))[1].tobytes()
    for name, content in ((f"a{ODD}.png", image), ("b.png", image), (f"z{ODD}.png", b"no image")):
        (folder / name).write_bytes(content)
    return folder


def test_detect_and_degrade_over_a_folder_of_such_names(photos):
    done = run("detect", ODD, "--out", "p.json", "--overlay", "drawn", "--workers", 1)
    assert done.returncode == 1
    assert b"Traceback" not in done.stderr
    assert done.stderr.startswith(b"kpbench: zodd\\udcff.png: cannot be decoded\n")
    assert len(kpbench.read_predictions("p.json")) == 3
    assert sorted(os.listdir(b"drawn")) == [b"aodd\xff.png", b"b.png"]
    (photos / f"z{ODD}.png").unlink()
    done = run("degrade", ODD, "--effect", "blur", "--level", 3, "--out", "worn")
    assert done.returncode == 0, done.stderr
    assert b"worn/aodd\\udcff.png" in done.stdout
    assert sorted(os.listdir(b"worn")) == [b"aodd\xff.png", b"b.png"]


def test_a_dataset_of_such_a_name_is_scored_with_all_outputs(here, dataset):
    shutil.copytree(dataset.path, here / ODD)
    for suffix in ("json", "jsonl", "csv", "h5"):
        predictions = kpbench.Predictions.from_detections(
            [kpbench.Detections.none()] * 6, detector={"name": SURROGATE, "by": [ODD]}, dataset=ODD
        )
        kpbench.write_predictions(f"p.{suffix}", predictions)
        read = kpbench.read_predictions(f"p.{suffix}")
        assert (read.dataset, read.detector) == ("odd\\udcff", {"name": "\\ud800", "by": ["odd\\udcff"]})
    outputs = ("--json", "s.json", "--csv", "s.csv", "--report", "r.html")
    done = run("score", "p.h5", "--gt", ODD, *outputs)
    assert done.returncode == 0, done.stderr
    assert json.loads(Path("s.json").read_text())["provenance"]["dataset"]["path"] == "odd\\udcff"
    assert Path("r.html").read_text()


@pytest.mark.parametrize("name", [SURROGATE + ".png", ODD + ".png", "a\0b.png"])
def test_annotations_that_name_such_files_are_scored_with_a_report(here, name):
    if name == ODD + ".png":
        Path(name).write_bytes(cv2.imencode(".png", np.full((60, 80), 90, np.uint8))[1].tobytes())
    annotation = {"image_id": 0, "category_id": 1, "keypoints": [30, 30, 2], "radius": 5}
    truth = {"images": [{"id": 0, "file_name": name}], "annotations": [annotation]}
    Path("truth.json").write_text(json.dumps(truth))
    detections = [{"image_id": 0, "keypoints": [[5, 5]]}]
    header = {"schema": "kpbench.predictions/1", "detector": {"name": SURROGATE}, "dataset": SURROGATE}
    Path("p.json").write_text(json.dumps(header | {"predictions": detections}))
    outputs = ("--json", "s.json", "--csv", "s.csv", "--report", "r.html")
    done = run("score", "p.json", "--gt", "truth.json", *outputs)
    assert done.returncode == 0, done.stderr
    assert b"Traceback" not in done.stderr
    assert ("data:image" in Path("r.html").read_text().partition("<main")[2]) == (name == ODD + ".png")
    truth["images"][0]["condition"] = SURROGATE
    Path("truth.json").write_text(json.dumps(truth))
    done = run("score", "p.json", "--gt", "truth.json", *outputs)
    assert (done.returncode, done.stderr.count(b"\n")) == (1, 1), done.stderr
    assert b"condition is '\\ud800', expected a text" in done.stderr


def test_a_video_of_such_a_name_is_refused_in_one_line(photos):
    Path(f"{ODD}.avi").write_bytes(b"RIFF")
    done = run("detect", f"{ODD}.avi", "--out", "p.json")
    line = b"its name is no UTF-8 text, expected another name for a video"
    assert (done.returncode, done.stderr) == (1, b"kpbench: odd\\udcff.avi: " + line + b"\n")
    done = run("detect", photos / "b.png", "--out", "p.json", "--overlay", f"{ODD}.mp4")
    assert (done.returncode, done.stderr) == (1, b"kpbench: odd\\udcff.mp4: " + line + b"\n")


def test_one_module_hands_files_to_opencv():
    package = Path(kpbench.__file__).parent
    for path in package.rglob("*.py"):
        text = path.read_text()
        assert "cv2.imread(" not in text, path
        if path.name != "decoding.py":
            assert text.count("cv2.imdecode(") == (path.name == "effects.py"), path  # of what it encoded itself
