"""Machines unlike ours: no file locks, no file handles, no permission, another OpenCV. What is missing is named."""

import io
import json
import os
import resource
import shutil
import subprocess
import sys
import time
import tomllib
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from helpers import kpbench, perfect_predictions, write_dataset
from packaging.requirements import Requirement

from kpbench import open_dataset, predict, read_predictions, write_predictions
from kpbench.dataset.shard import open_shard
from kpbench.detectors.interface import LoadedDetector, load_detector
from kpbench.errors import KpbenchError, KpbenchWarning
from kpbench.images import open_images
from kpbench.opencv import PACKAGES, warn_of_opencv
from kpbench.patches.design import load_patches
from kpbench.predictions import open_coco
from kpbench.printing import correct_sidecars
from kpbench.types import Detections

CHECKOUT = Path(__file__).parents[2]
IMAGES = [[(3, 4, 2, 0)]]
NO_HANDLES = "too many files are open; raise the limit with `ulimit -n`"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A file for each reader."""
    folder = tmp_path_factory.mktemp("files")
    write_dataset(folder / "set", IMAGES)
    for suffix in ("json", "jsonl", "csv", "parquet", "h5"):
        write_predictions(folder / f"p.{suffix}", perfect_predictions(IMAGES, image_id=[0]))
    cv2.imwrite(str(folder / "a.png"), np.full((48, 64), 90, np.uint8))
    writer = cv2.VideoWriter(str(folder / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    annotation = {"image_id": 1, "category_id": 1, "keypoints": [3, 4, 2], "radius": 2}
    (folder / "coco.json").write_text(json.dumps({"images": [{"id": 1}], "annotations": [annotation]}))
    shutil.copy(CHECKOUT / "patches" / "checker.toml", folder / "patch.toml")
    kpbench("render-patches", "--svg", "--out", folder / "print")
    return folder


READERS = {
    "p.json": read_predictions,
    "p.jsonl": read_predictions,
    "p.csv": read_predictions,
    "p.parquet": read_predictions,
    "p.h5": read_predictions,
    "set/dataset.json": lambda path: open_dataset(path.parent),
    "set/shard-00000.h5": lambda path: open_shard(path).close(),
    "a.png": lambda path: next(open_images(str(path)).images),
    "a.avi": lambda path: next(open_images(str(path)).images),
    "coco.json": open_coco,
    "patch.toml": lambda path: load_patches([path]),
    "print/patches.json": lambda path: correct_sidecars(path.parent, (100.0, 100.0)),
}


@contextmanager
def no_handles():
    """Let this process open no further file."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    last = os.open(os.devnull, os.O_RDONLY)
    resource.setrlimit(resource.RLIMIT_NOFILE, (last + 1, hard))
    taken = [last]
    try:
        for _ in range(3):
            time.sleep(0.02)  # threads of pyarrow close their files late
            with suppress(OSError):
                while True:
                    taken.append(os.open(os.devnull, os.O_RDONLY))
        yield
    finally:
        for number in taken:
            os.close(number)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("name", READERS)
def test_a_process_out_of_file_handles_is_told_so_with_the_path(files, name):
    READERS[name](files / name)  # imports what it needs
    problem = None
    with no_handles():
        try:
            READERS[name](files / name)
        except KpbenchError as error:
            problem = str(error)
    place = files / name if name != "print/patches.json" else files / "print"  # the folder is listed first
    assert problem == f"{place}: cannot be read, {NO_HANDLES}"


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize(("number", "reason"), [(13, "Permission denied"), (5, "Input/output error")])
def test_a_refusal_of_the_system_is_named_with_the_path(files, name, number, reason, monkeypatch):
    """The system's calls are replaced, since tests may run as root, whom no permission stops."""
    path = files / name
    READERS[name](path)

    def refuse(original):
        def opener(opened, *more, **named):
            if str(opened) == str(path):
                raise OSError(number, os.strerror(number), str(opened))
            return original(opened, *more, **named)

        return opener

    for module, attribute in ((io, "open"), (os, "open"), (h5py, "File")):
        if (module is h5py) == name.endswith("h5"):
            monkeypatch.setattr(module, attribute, refuse(getattr(module, attribute)))
    with pytest.raises(KpbenchError) as error:
        READERS[name](path)
    assert str(error.value) == f"{path}: cannot be read, {reason}"


def test_an_unreadable_image_of_a_folder_is_named_and_the_others_go_on(here, monkeypatch):
    for name in ("a.png", "b.png", "c.png"):
        cv2.imwrite(name, np.full((48, 64), 90, np.uint8))
    original = os.open

    def refuse(path, *more):
        if str(path).endswith("b.png"):
            raise PermissionError(13, "Permission denied", str(path))
        return original(path, *more)

    monkeypatch.setattr(os, "open", refuse)
    done = kpbench("detect", here, "--detector", "orb", code=1)
    assert "kpbench: b.png: cannot be read, Permission denied" in done.stderr.splitlines()
    assert "in 3 images" in done.stdout


# --- File locks ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def nolock(tmp_path_factory):
    """A library that lets every ``flock`` fail, as some network file systems do."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler")
    library = tmp_path_factory.mktemp("nolock") / "nolock.so"
    source = Path(__file__).parent / "cases" / "nolock.c"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    return library


@pytest.mark.parametrize("number", [37, 11], ids=["ENOLCK", "EAGAIN"])
def test_without_file_locks_shards_are_read_and_written(tmp_path, nolock, number):
    work = (
        "from kpbench import KpbenchError, SynthConfig, generate\n"
        "try: print(len(list(generate(SynthConfig(2, size_px=(64, 64)), 'set', workers=1).dataset.verify())))\n"
        "except KpbenchError as error: print(error)\n"
    )
    environment = os.environ | {"LD_PRELOAD": str(nolock), "FLOCK_ERRNO": str(number)}
    environment["PYTHONPATH"] = str(CHECKOUT)
    done = subprocess.run([sys.executable, "-c", work], cwd=tmp_path, env=environment, capture_output=True, text=True)
    said = "KpbenchWarning: set: cannot be locked; let no other run write to it"
    if number == 11:  # what flock answers if another run holds the lock
        assert done.stdout == "set: another kpbench run is writing to it\n"
    else:
        assert done.stdout == "1\n", done.stderr
        assert done.stderr.count(said) == 1


def test_a_file_that_the_user_has_open_is_read_beside(files):
    with h5py.File(files / "set" / "shard-00000.h5"), h5py.File(files / "p.h5"):
        assert open_dataset(files / "set").image(0).shape == (8, 8)
        assert len(read_predictions(files / "p.h5")) == 1
    data = open_dataset(files / "set")
    data.image(0)
    with h5py.File(files / "set" / "shard-00000.h5") as file:
        assert len(file["images"]) == 1


# --- Versions ------------------------------------------------------------------------------------------------------


def versions(monkeypatch, opencv, **installed):
    def version(name):
        if name.replace("-", "_") in installed:
            return installed[name.replace("-", "_")]
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(cv2, "__version__", opencv)
    monkeypatch.setattr("kpbench.opencv.metadata.version", version)


def test_another_major_version_of_opencv_is_said(monkeypatch):
    versions(monkeypatch, "5.0.1", opencv_python_headless="5.0.1")
    with pytest.warns(KpbenchWarning, match=r"OpenCV 5\.0\.1 is in use: kpbench is tested with OpenCV 4; pixels and"):
        warn_of_opencv()


def test_several_versions_side_by_side_are_said_in_one_line(monkeypatch):
    versions(monkeypatch, "5.0.1", opencv_python="5.0.1", opencv_python_headless="4.14.0.94")
    with pytest.warns(KpbenchWarning) as said:
        warn_of_opencv()
    [line] = [str(warning.message) for warning in said]
    assert "opencv-python-headless 4.14.0.94, opencv-python 5.0.1 are installed side by side, keep one" in line


@pytest.mark.parametrize("others", [{}, {"opencv_python": "4.12.0.88"}])
def test_one_version_is_no_reason_to_warn(monkeypatch, others):
    versions(monkeypatch, "4.12.0", opencv_python_headless="4.12.0.88", **others)
    warn_of_opencv()


def test_predictions_and_datasets_tell_the_opencv_that_was_in_use(files, monkeypatch):
    data = open_dataset(files / "set")
    detector = LoadedDetector("nothing", "1", lambda image: Detections.none())
    versions(monkeypatch, "5.0.1")
    with pytest.warns(KpbenchWarning, match="OpenCV 5"):
        found = predict(data, detector).predictions
    assert found.detector == {"name": "nothing", "version": "1", "opencv": "5.0.1"}
    identity = load_detector("orb").identity
    monkeypatch.undo()
    assert load_detector("orb").identity != identity


def test_the_pinned_versions_are_allowed_ones():
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    pins = dict(line.split("==") for line in (CHECKOUT / "constraints.txt").read_text().lower().split())
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    wanted = [Requirement(text) for group in groups for text in group]
    checked = [r for r in wanted if r.name.lower() in pins]
    assert len(checked) > 20
    for requirement in checked:
        assert requirement.specifier.contains(pins[requirement.name.lower()]), requirement
    assert PACKAGES[0] in {requirement.name for requirement in wanted}


def test_pillow_is_new_enough_for_letters_of_any_size():
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    [pillow] = [Requirement(text) for text in project["dependencies"] if text.startswith("pillow")]
    assert not pillow.specifier.contains("10.0.1")
    assert pillow.specifier.contains("10.1.0")
