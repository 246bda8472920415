import csv
import json

import pytest
from helpers import kpbench, write_dataset

from kpbench.predictions.files import write_predictions
from kpbench.types import Detections, Predictions


@pytest.fixture
def here(here):
    write_dataset(here / "kpbench-data", [[(10, 10, 10, 0), (50, 10, 10, 1)]] * 12)
    good = Detections([[10, 10], [50, 10]], [1, 1], [0, 1])
    write_predictions("good.json", Predictions.from_detections([good] * 12, detector={"name": "d"}))
    poor = [good if k % 3 else Detections.none() for k in range(12)]
    write_predictions("poor.csv", Predictions.from_detections(poor, detector={"name": "d"}))
    return here


def test_the_command_tells_who_is_better_and_exits(here):
    result = kpbench(
        "compare", "good.json", "poor.csv", "--fail-on-regression", "--json", "c.json", "--report", "c.html"
    )
    line = next(line for line in result.stdout.splitlines() if "detection score" in line)
    assert line.split()[:2] == ["d", "poor.csv"]
    assert "better" in line
    content = json.loads((here / "c.json").read_text())
    assert content["schema"] == "kpbench.comparison/1"
    assert content["comparisons"][0]["differences"][0]["difference"] == pytest.approx(1 / 3)
    assert [p["file"] for p in content["provenance"]["predictions"]] == ["good.json", "poor.csv"]
    assert "d good.json against the others" in (here / "c.html").read_text()
    worse = kpbench("compare", "poor.csv", "good.json", "--fail-on-regression", code=1)
    assert worse.stderr.startswith(
        "kpbench: detection score of d poor.csv is worse than that of d good.json by -0.3333 ["
    )
    assert "Traceback" not in worse.output
    assert kpbench("compare", "poor.csv", "good.json").stderr == ""


def test_wrong_usage(here):
    assert "expected two or more predictions files" in kpbench("compare", "good.json", code=2).stderr
    refused = kpbench("compare", "a.json", "b.json", "--report", "x.doc", code=2)
    assert "expected a file ending in .html, .md, .tex" in refused.stderr


def test_predictions_of_other_images_do_not_fit(here):
    rows = list(csv.reader((here / "poor.csv").read_text().splitlines()))
    (here / "poor.csv").write_text("\n".join(",".join(row) for row in rows[1:-2]))
    refused = kpbench("compare", "good.json", "poor.csv", code=1)
    assert "poor.csv does not fit kpbench-data" in refused.stderr


def test_no_worse_must_be_shown(here):
    kpbench("compare", "good.json", "poor.csv", "--no-worse", "detection_score=0.01", "--json", "c.json")
    first = json.loads((here / "c.json").read_text())["comparisons"][0]["differences"][0]
    assert (first["p"], first["p_holm"]) == (2 / 2**4, None)  # 4 of 12 scenes differ
    refused = kpbench("compare", "poor.csv", "good.json", "--no-worse", "detection_score=0.01", code=1).stderr
    assert refused.startswith("kpbench: detection score of d poor.csv may be worse than that of d good.json by more")
    refused = kpbench("compare", "no.json", "gone.json", "--no-worse", "nees=0.1", code=1).stderr
    assert refused.startswith("kpbench: nees is not compared, only"), "before a file is read"


def test_the_table_of_images_adds_up(here):
    kpbench("score", "poor.csv", "--images-csv", "images.csv", "--json", "s.json")
    rows = list(csv.DictReader((here / "images.csv").read_text().splitlines()))
    counts = json.loads((here / "s.json").read_text())["metrics"]["counts"]
    assert len(rows) == 12
    assert [row["matched"] for row in rows[:2]] == ["0", "2"]
    for name in ("truths", "detections", "matched", "duplicate"):
        assert sum(int(row[name]) for row in rows) == counts[name]
