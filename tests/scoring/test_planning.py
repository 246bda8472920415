import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import kpbench, write_dataset
from scipy import stats

from kpbench.dataset.folder import open_dataset
from kpbench.errors import DataError
from kpbench.predictions.files import write_predictions
from kpbench.scoring.planning import count_scenes, plan_scenes
from kpbench.scoring.scores import score
from kpbench.types import Detections, Predictions

KEYPOINTS, SCENES = 8, 30


@pytest.fixture
def hits(here):
    """Matches of two detectors in each scene; their predictions lie in a.json and b.json."""
    truth = [(20 * (k + 1), 20, 10, 0) for k in range(KEYPOINTS)]
    write_dataset(here / "kpbench-data", [truth] * SCENES)
    hits = np.random.default_rng(0).binomial(KEYPOINTS, 0.7, (2, SCENES))
    for name, counts in zip("ab", hits.tolist(), strict=True):
        found = [Detections([point[:2] for point in truth[:n]] or np.zeros((0, 2)), [1] * n) for n in counts]
        write_predictions(f"{name}.json", Predictions.from_detections(found, detector={"name": name}))
    return hits / KEYPOINTS


def test_sigma_is_the_standard_deviation_of_equal_scenes(hits):
    for files, values in ((("a",), hits[0]), (("a", "b"), hits[0] - hits[1])):
        pilots = [argument for name in files for argument in ("--pilot", f"{name}.json")]
        shown = kpbench("plan", *pilots, "--margin", 0.02, "--json", "plan.json").stdout
        content = json.loads(Path("plan.json").read_text())
        [plan] = content["plans"]
        assert content["detectors"] == list(files)
        assert (plan["metric"], plan["margin"], plan["pilot_scenes"]) == ("detection_score", 0.02, SCENES)
        assert plan["sigma"] == pytest.approx(np.std(values, ddof=1))
        assert plan["scenes"] == count_scenes(plan["sigma"], 0.02, paired=len(files) == 2)
        assert f" {plan['scenes']} " in shown


@pytest.mark.parametrize("sigma", [0.012, 0.05, 0.1, 0.3])
def test_one_detector_gets_the_smallest_number_whose_interval_fits(sigma):
    n = np.arange(2, 5000)
    fits = stats.t.ppf(0.975, n - 1) * sigma / np.sqrt(n) <= 0.01
    assert count_scenes(sigma, 0.01, paired=False) == n[fits][0]


@pytest.mark.parametrize("sigma", [0.012, 0.05, 0.1, 0.3])
def test_two_equal_detectors_get_the_power(sigma):
    n = count_scenes(sigma, 0.01, paired=True)
    power = stats.nct.sf(stats.t.ppf(0.975, n - 1), n - 1, 0.01 / (sigma / np.sqrt(n)))
    assert power == pytest.approx(0.9, abs=0.015)


def test_a_margin_or_metric_that_means_nothing_is_refused(hits):
    scores = score(open_dataset("kpbench-data"), [Detections.none()] * SCENES)
    for settings, problem in (
        ({"margin": 0}, "the margin is 0, expected a positive number"),
        ({"margin": 1, "metric": "nees"}, "there is no plan for nees, only for detection_score"),
        ({"margin": 1}, "detection score has no spread between the 30 scenes of the pilot, expected a pilot of more"),
    ):
        with pytest.raises(DataError, match=problem):
            plan_scenes(scores, **settings)
    other = replace(scores, outcomes=replace(scores.outcomes, settings=replace(scores.settings, eps=0.5)))
    with pytest.raises(DataError, match="not scored on the same images"):
        plan_scenes(scores, other, margin=0.1)


def test_wrong_usage(hits):
    problem = "expected one or two of --detector, or one or two of --pilot"
    assert problem in kpbench("plan", "--margin", 1, code=2).stderr
    assert problem in kpbench("plan", "--margin", 1, "--pilot", "a.json", "--detector", "orb", code=2).stderr
    assert "--gt names the dataset" in kpbench("plan", "--margin", 1, "--gt", "x", "--detector", "orb", code=2).stderr


def test_a_pilot_run(here):
    small = ("--images", 3, "--size", "203x155", "--only", "blur", "--workers", 1)
    shown = kpbench("plan", "--detector", "orb", "--margin", 0.1, "--metric", "average_false_alarm", *small).stdout
    assert shown.splitlines()[0].endswith("scenes for average_false_alarm within 0.1")
    assert shown.splitlines()[1].startswith("all images")
    assert "sigma between 3 scenes" in shown.splitlines()[2]
