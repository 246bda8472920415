import numpy as np

from kpbench.dataset.card import dataset_facts, dataset_histograms, write_card
from kpbench.dataset.generation import generate
from kpbench.render.placement import Limits
from kpbench.synth.synthetic import SynthConfig


def test_every_keypoint_is_in_every_histogram(dataset):
    made = {histogram.title: histogram for histogram in dataset_histograms(dataset)}
    assert made.pop("keypoints an image").counts.sum() == len(dataset)
    assert len(made) == 6
    for histogram in made.values():
        assert histogram.counts.sum() == len(dataset.truth.keypoints)
        assert np.isclose(histogram.shares.sum(), 1)


def test_the_card_lies_beside_the_manifest_and_tells_the_facts(dataset):
    card = (dataset.path / "README.md").read_text()
    assert card.startswith("---\npretty_name: ")
    assert all(f"| {key} | {value} |" in card for key, value in dataset_facts(dataset).items())
    assert "| 3 (mushroom) |" in card
    assert (dataset.path / "preview.png").read_bytes().startswith(b"\x89PNG")


def test_a_dataset_without_keypoints_has_a_card_too(tmp_path):
    config = SynthConfig(2, size_px=(64, 64), limits=Limits(count=(0, 0)))
    empty = generate(config, tmp_path / "set", workers=1).dataset
    write_card(empty, tmp_path)
    assert "| 0 | 2 | 100.0% |" in (tmp_path / "README.md").read_text()
