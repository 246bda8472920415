"""The published results, and the page that is made from them."""

import importlib.util
import json
import re
from pathlib import Path

import pytest

from kpbench.report.charts import LIGHT_COLOURS
from kpbench.synth.suite import SuiteConfig
from kpbench.synth.suite_file import load_suite
from kpbench.writing import HEAD_BYTES, kind_of

ROOT = Path(__file__).parents[2]
RESULTS = sorted((ROOT / "benchmarks" / "results").glob("*/*.json"))

spec = importlib.util.spec_from_file_location("leaderboard", ROOT / "benchmarks" / "publish" / "leaderboard.py")
leaderboard = importlib.util.module_from_spec(spec)
spec.loader.exec_module(leaderboard)


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_a_result_follows_from_its_counts_and_names_a_frozen_suite(path):
    scores = json.loads(path.read_text())
    assert scores["schema"] == "kpbench.scores/1"
    assert scores["settings"]["eps"] == 0.1
    assert re.sub("[^A-Za-z0-9.]+", "-", scores["detector"]["name"]) == path.stem
    config = scores["provenance"]["config"]
    assert path.parent.name == leaderboard.folder_name(config)
    assert not re.search(r"[ =]/", scores["provenance"]["command"])  # no path of anybody's machine
    board = config["board"]["name"] if "board" in config else None
    size = tuple(config["size_px"])
    again = SuiteConfig(load_suite(config["suite"]), config["images"], config["seed"], size, board=board)
    assert again.to_dict()["conditions"] == config["conditions"]
    assert scores["dataset"]["images"] == config["n"] == again.n
    for group in [scores["metrics"], *(group["metrics"] for group in scores["by"])]:
        n = group["counts"]
        assert group["detection_score"] == n["matched"] / n["truths"]
        assert group["average_false_alarm"] == (n["detections"] - n["matched"]) / n["images"]
        if group["id_matching_score"] is not None:
            assert group["id_matching_score"] == n["id_correct"] / n["matched"]
    rungs = {(group["condition"], group["rung"]) for group in scores["by"]}
    assert rungs == {(c["name"], rung) for c in config["conditions"] for rung in c["rungs"]}


def test_the_leaderboard_and_the_findings_are_made_of_the_results():
    findings = (ROOT / "docs" / "results" / "findings.md").read_text()
    runs = leaderboard.load(ROOT / "benchmarks" / "results" / "paper-v1")
    assert leaderboard.findings(findings, runs) == findings
    text, _ = leaderboard.page(ROOT / "benchmarks" / "results")
    assert (ROOT / "docs" / "results" / "leaderboard.md").read_text() == text


def test_the_figure_of_the_leaderboard_shows_every_detector_in_its_colour():
    runs = leaderboard.load(ROOT / "benchmarks" / "results" / "paper-v1")
    drawn = (ROOT / "docs" / "results" / "severity.svg").read_text()
    assert kind_of(drawn[:HEAD_BYTES].encode()) == "report"
    for colour in LIGHT_COLOURS[: min(len(runs) + 1, len(LIGHT_COLOURS))]:
        assert f"stroke: {colour}" in drawn  # in the element itself: librsvg knows no variables
    assert (ROOT / "docs" / "results" / "severity.pdf").read_bytes()[:5] == b"%PDF-"
