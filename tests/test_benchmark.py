import json
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import kpbench

from kpbench.benchmark.run import bench, count_bench_images
from kpbench.dataset.export import export_dataset
from kpbench.detectors import interface as detect
from kpbench.detectors.interface import load_detector
from kpbench.errors import DataError
from kpbench.images import encode_png
from kpbench.predictions.files import read_predictions
from kpbench.synth.suite import SuiteConfig
from kpbench.synth.suite_file import load_suite

SMALL = SuiteConfig(load_suite("paper-v1"), images=2, size_px=(203, 155), only=("blur",), shard_size=10)
FEW = replace(SMALL, images=1)

DETECTOR = """
import cv2, numpy as np
from kpbench import Detections

def corners(image):
    found = cv2.goodFeaturesToTrack(image, 20, 0.1, 8)[:, 0]
    return Detections(found, np.ones(len(found)))

corners.version = "1"

def frail(image):
    if image[0, 0] % 3 == 0:
        raise ValueError("I do not like this one")
    return corners(image)
"""


@pytest.fixture
def here(here, monkeypatch):
    """The current folder: empty but for a module of detectors."""
    monkeypatch.syspath_prepend(str(here))
    sys.modules.pop("mine", None)
    (here / "mine.py").write_text(DETECTOR)
    yield here
    sys.modules.pop("mine", None)


def files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class Stop(Exception):
    pass


def stop_after(limit):
    done = 0

    def progress(images):
        nonlocal done
        done += images
        if done > limit:
            raise Stop

    return progress


def test_interrupted_at_three_places_and_resumed_is_the_same(here):
    """In the first suite, in the suite of tags, and while the second detector looks."""
    names = ("mine:corners", "aruco", "mine:frail")
    counted = []
    whole = bench([SMALL], names, "whole", workers=1, progress=counted.append)
    assert sum(counted) == count_bench_images([SMALL], names) == 32 + 8 + 32 + 8 + 32
    for limit in (15, 35, 60):
        with pytest.raises(Stop):
            bench([SMALL], names, "parts", workers=1, progress=stop_after(limit))
    parts = bench([SMALL], names, "parts", workers=1)
    assert [run.scores.to_dict() for run in parts] == [run.scores.to_dict() for run in whole]
    one, two = files(here / "whole"), files(here / "parts")
    assert one.keys() == two.keys()
    for name in one:
        assert one[name].replace(b"whole/", b"parts/") == two[name], name
    assert not list(here.glob("parts/**/*.parts"))


def test_what_is_done_is_not_done_again_unless_the_detector_is_another(here, monkeypatch):
    bench([SMALL], ["mine:corners"], "out", workers=1)
    monkeypatch.setattr("kpbench.benchmark.detection.detect_images", lambda *a: pytest.fail("looked again"))
    monkeypatch.setattr("kpbench.benchmark.run.generate", lambda *a, **k: pytest.fail("made again"))
    bench([SMALL], ["mine:corners"], "out", workers=1)
    commented = DETECTOR + "# another comment\n"
    for source, again in [(commented, False), (DETECTOR.replace('version = "1"', 'version = "2"'), True)]:
        (here / "mine.py").write_text(source)
        sys.modules.pop("mine")
        with pytest.raises(pytest.fail.Exception, match="looked again") if again else nullcontext():
            bench([SMALL], ["mine:corners"], "out", workers=1)


def test_a_detector_without_a_version_looks_again_each_time(here, monkeypatch):
    bench([SMALL], ["mine:frail"], "out", workers=1)
    monkeypatch.setattr("kpbench.benchmark.detection.detect_images", lambda *a: pytest.fail("looked again"))
    with pytest.raises(pytest.fail.Exception, match="looked again"):
        bench([SMALL], ["mine:frail"], "out", workers=1)


def test_version_settings_and_weights_are_what_a_detector_is(tmp_path):
    small = load_detector("superpoint-small")
    assert load_detector("superpoint-small").identity == small.identity
    assert load_detector("superpoint-small", 0.4).identity != small.identity
    weights = Path(detect.__file__).parent / "weights"
    (tmp_path / "same.onnx").write_bytes((weights / "superpoint-small-int8.onnx").read_bytes())
    mine = load_detector(str(tmp_path / "same.onnx")).identity
    (tmp_path / "same.onnx").write_bytes((weights / "superpoint-int8.onnx").read_bytes())
    assert load_detector(str(tmp_path / "same.onnx")).identity != mine


def test_a_detector_that_raises_is_named_and_counted_and_the_rest_goes_on(here):
    arguments = ["--images", 1, "--size", "203x155", "--only", "blur,noise", "--workers", 1, "--out", "out"]
    arguments += ["--detector", "mine:frail", "--detector", "mine:corners"]
    done = kpbench("bench", *arguments, code=1)
    scores = json.loads((here / "out/scores/paper-v1/mine-frail.json").read_text())
    failures = scores["detector"]["failures"]
    assert 0 < len(failures) < 32
    assert f"mine:frail failed on {len(failures)} images, which count as no detections" in done.stdout
    assert "mine:frail failed on" in (here / "out/paper-v1.html").read_text()
    assert f"mine:frail on paper-v1: image_id {failures[0][0]}: ValueError: I do not like this one" in (done.stderr)
    assert f"kpbench: detectors failed on {len(failures)} images, which count as no detections\n" in done.stderr
    kept = read_predictions(next(here.glob("out/predictions/*/mine-frail-*.json")))
    assert len(kept) == 32
    assert {i for i, d in zip(kept.image_id, kept.detections(), strict=True) if not len(d)} >= {f[0] for f in failures}
    healthy = json.loads((here / "out/scores/paper-v1/mine-corners.json").read_text())
    assert healthy["dataset"]["images"] == 32
    assert healthy["provenance"]["config"]["suite"] == "paper-v1"
    page = (here / "out/paper-v1.html").read_text()
    assert "photographs; ours: simulated" in page
    assert "mine:corners" in done.stdout


def test_the_command_tells_the_difference_to_the_paper(here):
    arguments = ["--images", "1", "--size", "203x155", "--only", "blur", "--workers", "1", "--out", "out"]
    done = kpbench("bench", *arguments, "--detector", "mine:corners")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in done.stdout.splitlines() if "|" in line]
    paper = next(row for row in rows if row[:2] == ["detection", "paper"])
    ours = next(row for row in rows if row[:2] == ["detection", "mine:corners"])
    less = next(row for row in rows if row[:2] == ["detection", "mine:corners less the paper"])
    assert paper[2:] == ["photographs", "1.000", "0.986", "0.882", "0.605"]
    for theirs, value, between in zip(paper[3:], ours[3:], less[3:], strict=True):
        assert abs(float(value.split()[0]) - float(theirs) - float(between.split()[0])) < 0.0011
    kpbench("bench", "--quick", "--images", 3, code=2)


def test_two_detectors_of_one_name_are_refused(here):
    (here / "mine.py").write_text(DETECTOR + "class A:\n    name = 'aruco'\n    detect = staticmethod(corners)\n")
    with pytest.raises(DataError, match=r"the detectors 'aruco' and 'aruco' would be one file, aruco\.json"):
        bench([SMALL], ["aruco", "mine:A"], "out")


PROGRAM = """
import json, sys
from pathlib import Path

files = sorted(Path(sys.argv[-2]).iterdir())
Path("calls.txt").open("a").write(f"{len(files)} ")
predictions = []
for file in files:
    size = file.stat().st_size
    if size % 3 == 0 and "--frail" in sys.argv:
        sys.exit("cannot bear this image")
    predictions.append({"image_id": int(file.stem), "keypoints": [[size, 3.5]], "ids": [2]})
out = {"schema": "kpbench.predictions/1", "predictions": predictions}
Path(sys.argv[-1]).write_text(json.dumps(out))
"""


def test_a_program_is_run_on_many_images_at_once_and_on_one_by_one_if_it_fails(here):
    (here / "find.py").write_text(PROGRAM)
    command = f"program:{sys.executable} -I -S find.py"
    (run,) = bench([FEW], [command], "out", workers=1)
    assert (here / "calls.txt").read_text() == "16 "
    found = read_predictions(run.predictions)
    assert found.patch_id.tolist() == [2] * 16
    size = [len(encode_png(run.dataset.image(n), "program-input")) for n in range(16)]
    assert found.xy[:, 0].tolist() == size
    (frail,) = bench([FEW], [f"{command} --frail"], "out", workers=1)
    assert [image_id for image_id, _ in frail.failures] == [n for n in range(16) if size[n] % 3 == 0]
    assert frail.failures[0][1].endswith("exit code 1, cannot bear this image")
    assert (here / "calls.txt").read_text() == "16 " * 2 + "1 " * 16


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("raise SystemExit(3)", "exit code 3, nothing on stderr"),
        ("pass", "wrote no predictions file where its last argument says"),
        (
            'import sys; open(sys.argv[2], \'w\').write(\'{"schema": "kpbench.predictions/1", "predictions": []}\')',
            "no prediction for image 00000000.png",
        ),
    ],
)
def test_a_program_that_does_not_do_its_work_is_one_line(here, code, says):
    (here / "bad.py").write_text(code)
    (run,) = bench([replace(FEW, only=("scale",))], [f"program:{sys.executable} -I -S bad.py"], "out", workers=1)
    assert len(run.failures) == 28
    assert says in run.failures[0][1]
    assert "\n" not in run.failures[0][1]


def test_two_suites_of_one_name_are_refused(here):
    refused = kpbench("bench", "--suite", "paper-v1", "--suite", "paper-v1", "--quick", code=2)
    assert "two suites have the same name: paper-v1, paper-v1" in refused.output


def test_a_folder_of_other_files_is_left_alone(here):
    (here / "photos").mkdir()
    (here / "photos" / "scores.json").write_text("mine")
    with pytest.raises(DataError, match=r"photos: holds other files \(scores.json"):
        bench([SMALL], ["aruco"], "photos")
    refused = kpbench("demo", "--n", 1, "--out", "photos", code=1)
    assert "photos: holds other files (scores.json, ...), expected a new or an empty folder" in refused.output
    assert [path.name for path in (here / "photos").iterdir()] == ["scores.json"]


def test_a_dataset_is_benched_as_a_suite_is(here, dataset, monkeypatch):
    arguments = ["bench", "--dataset", dataset.path, "--detector", "mine:corners", "--workers", 1, "--out", "out"]
    done = kpbench(*arguments)
    assert "out/set.html: the report of set" in done.stdout
    assert "<title>set, simulated</title>" in (here / "out/set.html").read_text()
    scores = json.loads((here / "out/scores/set/mine-corners.json").read_text())
    assert scores["provenance"]["dataset"]["source"] == "simulated"
    kpbench("detect", dataset.path, "--detector", "mine:corners", "--out", "preds.json")
    kpbench("score", "preds.json", "--json", "own.json")
    assert scores["metrics"] == json.loads((here / "own.json").read_text())["metrics"]
    monkeypatch.setattr("kpbench.benchmark.detection.detect_images", lambda *a: pytest.fail("looked again"))
    kpbench(*arguments)
    refused = kpbench("bench", "--dataset", dataset.path, "--detector", "aruco", "--out", "out", code=1)
    assert "shows patches, but aruco looks for the board aruco" in refused.stderr
    for option in (["--quick"], ["--suite", "paper-v1"], ["--images", "3"]):
        kpbench("bench", "--dataset", dataset.path, *option, code=2)


def test_the_images_of_annotations_are_looked_at_each_time(here, dataset, monkeypatch):
    folder = export_dataset(dataset, "coco", here / "labels").parent
    for path in (folder, folder / "annotations.json"):
        kpbench("bench", "--dataset", path, "--detector", "orb", "--workers", 1, "--out", "out")
        assert "<title>labels, simulated</title>" in (here / "out/labels.html").read_text()
    monkeypatch.setattr("kpbench.benchmark.detection.detect_images", lambda *a: pytest.fail("looked again"))
    with pytest.raises(pytest.fail.Exception, match="looked again"):
        kpbench("bench", "--dataset", folder, "--detector", "orb", "--workers", 1, "--out", "out")
