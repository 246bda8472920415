import shutil
from dataclasses import replace

import numpy as np
import pytest

import kpbench
from kpbench.detectors.inference import open_session
from kpbench.detectors.verification import FIRST_JUDGE, SECOND_JUDGE, WEIGHTS
from kpbench.training.verifier.dataset_images import image_refs
from kpbench.training.verifier.ellipse import collect_places, train_ellipse
from kpbench.training.verifier.judge_samples import read_image
from kpbench.training.verifier.judges import train_judges

RNG = np.random.default_rng(0)
SURROUNDINGS = RNG.uniform(0, 255, (3, 4, 32, 32)).astype(np.float32)
VIEW = RNG.uniform(-1, 1, (40, 2, 32, 32)).astype(np.float32)


@pytest.fixture(scope="module")
def small_dataset(tmp_path_factory):
    """Four small images with several patches each."""
    config = replace(kpbench.SynthConfig(4, seed=1, size_px=(240, 180)), deteriorate="none")
    return kpbench.generate(config, tmp_path_factory.mktemp("sets") / "set", workers=1).dataset


def outputs(file, **inputs):
    return open_session(file.read_bytes())[0].run(None, inputs)


def test_the_ellipse_network_is_trained_and_written(small_dataset, tmp_path):
    lines = []
    train_ellipse([small_dataset], small_dataset, tmp_path, epochs=1, batch=64, workers=0, threads=1, say=lines.append)
    log_odds, shift, log_map = outputs(tmp_path / "ellipse.onnx", surroundings=SURROUNDINGS)
    assert (log_odds.shape, shift.shape, log_map.shape) == ((3,), (3, 2), (3, 2, 2))
    assert lines[0].startswith("train on ")
    assert lines[-1].endswith("ellipse.onnx: 1380387 bytes")


def test_the_judges_are_trained_and_written(small_dataset, tmp_path):
    lines = []
    train_judges([small_dataset], small_dataset, tmp_path, epochs=1, batch=64, workers=0, threads=1, say=lines.append)
    for name, columns in ((FIRST_JUDGE, 9), (SECOND_JUDGE, 22)):
        evidence = np.zeros((len(VIEW), columns), np.float32)
        log_odds, shift, log_map = outputs(tmp_path / f"{name}.onnx", view=VIEW, evidence=evidence)
        assert (log_odds.shape, shift.shape, log_map.shape) == ((40,), (40, 2), (40, 2, 2))
    assert any(line.startswith("second judge") for line in lines)


def test_a_training_from_the_shipped_weights_begins_with_what_they_give(small_dataset, tmp_path):
    train_ellipse([small_dataset], small_dataset, tmp_path, epochs=0, from_shipped=True, workers=0, threads=1)
    files = tmp_path / "ellipse.onnx", WEIGHTS / "ellipse.onnx"
    ours, shipped = (outputs(file, surroundings=SURROUNDINGS) for file in files)
    for one, other in zip(ours[1:], shipped[1:], strict=True):  # the log odds are calibrated anew
        assert np.abs(one - other).max() < 0.1


def test_a_network_replaces_an_earlier_one_and_a_foreign_file_is_refused_before_the_training(small_dataset, tmp_path):
    for _ in range(2):
        train_ellipse([small_dataset], small_dataset, tmp_path, epochs=0, from_shipped=True, workers=0, threads=1)
    for train, name in ((train_ellipse, "ellipse"), (train_judges, SECOND_JUDGE)):
        (tmp_path / f"{name}.onnx").write_bytes(b"of the user")
        with pytest.raises(kpbench.KpbenchError, match=f"{name}.onnx: exists, and kpbench did not write it"):
            train([], small_dataset, tmp_path, workers=0, threads=1)


def test_draws_depend_on_the_images_and_not_on_how_the_folder_is_called(small_dataset, tmp_path, monkeypatch):
    shutil.copytree(small_dataset.path, tmp_path / "copy")
    monkeypatch.chdir(tmp_path)
    spellings = [
        small_dataset,
        kpbench.open_dataset("copy"),
        kpbench.open_dataset(tmp_path / ".." / tmp_path.name / "copy"),
    ]
    places = [collect_places(None, image_refs(spelling)[3], True) for spelling in spellings]
    speckled = [read_image(image_refs(spelling)[3], True)[0] for spelling in spellings]
    plain = read_image(image_refs(small_dataset)[3], False)[0]
    for other, image in zip(places, speckled, strict=True):
        assert all(np.array_equal(one, two) for one, two in zip(other, places[0], strict=True))
        assert np.array_equal(image, speckled[0])
    assert not np.array_equal(speckled[0], plain)
