"""Scoring files from Python; ``tests/cli/test_score.py`` and ``test_compare.py`` look at the commands."""

import json
from dataclasses import replace

import pytest
from helpers import perfect_predictions, write_dataset

from kpbench.errors import DataError
from kpbench.evaluate import compare_files, score_file
from kpbench.predictions.files import write_predictions
from kpbench.scoring.scores import score
from kpbench.types import Detections, Predictions

IMAGES = [[(10, 10, 10, 0), (50, 10, 10, 1)], [(10, 10, 10, 0)], []]


@pytest.fixture
def here(here):
    """The current folder, with a dataset and perfect predictions for it."""
    write_dataset(here / "data", IMAGES)
    write_predictions("p.json", perfect_predictions(IMAGES, dataset="data"))
    return here


def test_a_file_scores_as_its_predictions_and_every_file_is_written(here):
    scored = score_file(
        "p.json", json_file="s.json", csv_file=here / "s.csv", report_file="r.html", eps=0.2, command=["my", "script"]
    )
    assert scored.scores.to_dict() == score(scored.dataset, perfect_predictions(IMAGES), eps=0.2).to_dict()
    content = json.loads((here / "s.json").read_text())
    assert content["provenance"] == scored.provenance
    assert content["provenance"]["command"] == "my script"
    assert "my script" in (here / "r.html").read_text()
    assert (here / "s.csv").read_text().startswith("schema,detector,dataset,source,kpbench,condition")
    assert scored.poses == ()


def test_the_truth_may_be_a_path_an_open_dataset_or_a_class_of_ones_own(here):
    dataset = score_file("p.json", "data").dataset

    class Mine:
        path, fingerprint, config, truth = here / "mine", "0" * 64, {}, replace(dataset.truth, fingerprint="")

        def image(self, index):
            raise DataError("the photographs are elsewhere")

    write_predictions("none.json", Predictions.from_detections([Detections.none()] * 3))
    messages = []
    scored = score_file("none.json", Mine(), report_file="r.html", warn=messages.append)
    assert scored.provenance["dataset"] == {
        "path": str(here / "mine"),
        "fingerprint": "0" * 64,
        "source": None,
    }
    assert messages == ["r.html shows no images: the photographs are elsewhere"]
    assert score_file("p.json", dataset).dataset is dataset


def test_a_missing_dataset_is_a_warning_where_another_is_at_hand(here):
    (here / "data").rename("kpbench-data")
    with pytest.warns(UserWarning, match="names the dataset 'data', which is not here; scoring against ./kpbench-data"):
        score_file("p.json")


def test_files_that_cannot_be_written_are_refused_before_anything_is_read(here):
    with pytest.raises(DataError, match=r"r\.doc: unknown kind of report"):
        score_file("none.json", report_file="r.doc")
    with pytest.raises(DataError, match="this command reads it"):
        compare_files(["none.json", "p.json"], json_file="p.json")


def test_the_pose_needs_a_suite(here):
    with pytest.raises(DataError, match="data: shows no known board, `pose=True` needs the dataset of a suite"):
        score_file("p.json", pose=True)


def test_files_of_one_detector_are_told_apart_by_their_names(here):
    compared = compare_files(["p.json", "p.json"], "data", json_file="c.json")
    assert [run.name for run in compared.scores] == ["detector p.json"] * 2
    assert compared.comparisons[0].first == "detector p.json"
    assert json.loads((here / "c.json").read_text())["provenance"] == compared.provenance
    with pytest.raises(ValueError, match="1 predictions files, expected two or more"):
        compare_files(["p.json"])
