"""The whole recipe, from nothing to a detector with networks of its own."""

import shutil

import numpy as np
import pytest

from kpbench.dataset.folder import open_dataset
from kpbench.detectors.superpoint import SuperPointDetector
from kpbench.detectors.verification import VERIFIER_NETWORKS
from kpbench.errors import DataError
from kpbench.images import to_grey
from kpbench.patches.design import shipped_patches
from kpbench.training.loop import TrainOptions, train
from kpbench.training.pipeline import make_weights
from kpbench.training.recipe import load_recipe, parse_recipe
from kpbench.training.verifier.labels import FIT_TOLERANCE, mark_correct

CONTENT = {
    "name": "tiny",
    "batch": 4,
    "network": {
        "widths": [4, 4, 8, 8], "depths": [1, 1, 1, 1], "down": "stride", "head_width": 8, "descriptor_width": 8,
    },
    "phases": [{"samples": 8}],
    "verifier": {
        "ellipse_epochs": 1,
        "judge_epochs": 1,
        "sets": [
            {"images": 3, "seed": 1, "size": [160, 120], "deteriorate": "none"},
            {"images": 2, "seed": 2, "size": [160, 120], "camera": "everyday", "radius_px": [20.0, 40.0]},
        ],
        "test": {"images": 2, "seed": 3, "size": [160, 120]},
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a training, and the names of the steps of each of its three runs."""
    folder, recipe = tmp_path_factory.mktemp("run"), parse_recipe(CONTENT, "tiny.toml")
    assert train(recipe, folder, options=TrainOptions(workers=0, validation_images=1))
    runs = []
    for minutes in (-1.0, None, None):
        lines: list[str] = []
        settings = {"patches": shipped_patches(), "minutes": minutes, "workers": 0, "threads": 1, "say": lines.append}
        finished = make_weights(recipe, folder, None, **settings)
        runs.append((finished, [line for line in lines if line.endswith(": made")]))
    return folder, runs


def test_a_run_without_time_does_nothing_the_next_one_all_and_the_last_nothing(made):
    folder, runs = made
    assert [(finished, len(steps)) for finished, steps in runs] == [(False, 0), (True, 7), (True, 0)]
    assert sorted(path.name for path in (folder / "weights").glob("*.onnx")) == sorted(
        ["tiny.onnx", "tiny-int8.onnx", *(f"{name}.onnx" for name in VERIFIER_NETWORKS)]
    )
    assert {path.name for path in (folder / "sets").iterdir()} == {
        "none-none-usual-1", "paper-everyday-20-40-2", "paper-none-usual-3",
    }  # fmt: skip


def test_the_weights_are_a_detector_that_verifies_with_the_networks_beside_it(made, tmp_path):
    folder, _ = made
    own = SuperPointDetector(folder / "weights" / "tiny-int8.onnx")
    shutil.copy(folder / "weights" / "tiny-int8.onnx", tmp_path / "alone.onnx")
    alone = SuperPointDetector(tmp_path / "alone.onnx")
    assert own.version != alone.version
    own(np.full((96, 96), 128, np.uint8))


def test_the_threshold_leaves_no_false_alarm_too_many_on_the_test_images(made):
    folder, _ = made
    test, weights = open_dataset(folder / "sets" / "paper-none-usual-3"), folder / "weights" / "tiny-int8.onnx"
    counts = []
    for threshold in (0.0, None):
        detector, wrong = SuperPointDetector(weights, threshold=threshold), 0
        for image, keypoints in test:
            found = detector(to_grey(image))
            wrong += int((~mark_correct(found.xy, found.patch_id, keypoints, FIT_TOLERANCE)).sum())
        counts.append(wrong)
    assert counts[0] > 0  # without a threshold there are false alarms
    assert counts[1] == 0  # 0.04 of two images is less than one


def test_a_damaged_network_beside_the_weights_is_one_line(made, tmp_path):
    folder, _ = made
    shutil.copytree(folder / "weights", tmp_path / "weights")
    (tmp_path / "weights" / "first-judge.onnx").write_bytes(b"nonsense")
    with pytest.raises(DataError, match=r"first-judge\.onnx: cannot be read as an ONNX model"):
        SuperPointDetector(tmp_path / "weights" / "tiny-int8.onnx")
    shutil.copy(folder / "weights" / "ellipse.onnx", tmp_path / "weights" / "first-judge.onnx")
    with pytest.raises(DataError, match=r"first-judge\.onnx: cannot be run"):
        SuperPointDetector(tmp_path / "weights" / "tiny-int8.onnx")


def test_the_reference_recipe_makes_all_weights():
    config = load_recipe("reference").verifier
    assert config is not None
    assert sum(part.images for part in config.sets) >= 20_000
    seeds = [part.seed for part in (*config.sets, config.test)]
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"sets": []}, "at least one set"),
        ({"first_sets": 9}, "first_sets is 9, expected a number from 1 to 2"),
        ({"test": {"images": 2, "radius_px": [3.0]}}, "radius_px needs two numbers"),
        ({"test": {"images": 2, "deteriorate": "rust"}}, "deteriorate is 'rust'"),
    ],
)
def test_a_wrong_verifier_table_is_one_line(change, line):
    with pytest.raises(DataError, match=line):
        parse_recipe(CONTENT | {"verifier": CONTENT["verifier"] | change}, "tiny.toml")


def test_a_recipe_without_the_table_is_refused(tmp_path):
    with pytest.raises(DataError, match="no table `verifier`"):
        make_weights(load_recipe("paper"), tmp_path, None, patches=shipped_patches())
