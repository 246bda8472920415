"""Pixels of different software: shards are not mixed, and scoring tells other pixels from other scenes."""

import dataclasses
import warnings

import numpy as np
import pytest

from kpbench import Predictions, SynthConfig, generate, merge, score
from kpbench.dataset import generate_part, generation
from kpbench.errors import DataError, KpbenchWarning, PredictionsError

CONFIG = SynthConfig(n=4, size_px=(96, 64), shard_size=2)


@pytest.fixture
def make_with(monkeypatch):
    """Make something as another version of OpenCV would."""

    def make(version, function, *arguments, **options):
        with monkeypatch.context() as changed:
            changed.setattr(generation, "opencv_version", lambda: version)
            return function(*arguments, workers=1, **options)

    return make


def test_a_merge_refuses_shards_of_two_versions_of_opencv(tmp_path, make_with):
    make_with("4.98.0", generate_part, CONFIG, tmp_path / "set", range(1))
    make_with("4.99.0", generate_part, CONFIG, tmp_path / "set", range(1, 2))
    with pytest.raises(DataError, match=r"shard-00001.h5: of another dataset \(opencv is 4.99.0 there, 4.98.0 here\)"):
        merge(tmp_path / "set")


def test_a_run_is_not_resumed_with_another_version_of_opencv(tmp_path, make_with):
    make_with("4.98.0", generate_part, CONFIG, tmp_path / "set", range(1))
    with pytest.raises(DataError, match=r"opencv is 4.98.0 there, 4.99.0 here"):
        make_with("4.99.0", generate, CONFIG, tmp_path / "set", resume=True)


def test_a_users_pipeline_ties_a_dataset_to_the_processor(monkeypatch):
    written = generation.describe_config(CONFIG)
    assert written["pixels"].keys() == {"version", "machine", "opencv"}
    monkeypatch.setattr(SynthConfig, "to_dict", lambda self: {"augmentation": {"transform": {}}})
    assert generation.describe_config(CONFIG)["pixels"].keys() >= {"albumentations", "processor"}


def perfect_predictions(dataset):
    truth = dataset.truth
    xy = np.column_stack([truth.keypoints["x"], truth.keypoints["y"]])
    of_dataset = {"fingerprint": dataset.fingerprint, "truth_digest": truth.digest}
    ids = truth.keypoints["patch_id"].astype(np.int64)
    return Predictions(truth.image_id, truth.offsets, xy, np.ones(len(xy)), ids, **of_dataset)


def test_predictions_on_other_pixels_of_the_same_scenes_are_scored_with_a_warning(tmp_path, make_with):
    here, there = (make_with(version, generate, CONFIG, tmp_path / version).dataset for version in ("4.98.0", "4.99.0"))
    assert here.fingerprint != there.fingerprint
    with pytest.warns(KpbenchWarning, match="same scenes with other pixels"):
        scores = score(there.truth, perfect_predictions(here))
    assert scores["detection_score"] == 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        score(here.truth, perfect_predictions(here))


@pytest.mark.parametrize("other", [{"deteriorate": "none"}, {"seed": 1}, {"distractors": 3}])
def test_predictions_on_other_scenes_or_other_effects_are_refused(tmp_path, other):
    here = generate(CONFIG, tmp_path / "here", workers=1).dataset
    there = generate(dataclasses.replace(CONFIG, **other), tmp_path / "there", workers=1).dataset
    with pytest.raises(PredictionsError, match="made for the dataset with fingerprint"):
        score(there.truth, perfect_predictions(here))
