import csv
import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import pytest
from helpers import kpbench, perfect_predictions, write_dataset

from kpbench.dataset.export import export_dataset
from kpbench.dataset.folder import open_dataset
from kpbench.files import sha256_of
from kpbench.predictions.files import write_predictions
from kpbench.scoring.metrics import COUNTS, METRICS
from kpbench.types import Detections, Predictions

IMAGES = [[(10, 10, 10, 0), (50, 10, 10, 1)], [(10, 10, 10, 0)], [], [(30, 30, 20, 1)]]


def perfect(images=IMAGES, **about):
    return perfect_predictions(images, **about)


def complaint(*args):
    """The one line of an error."""
    lines = kpbench("score", *args, code=1).stderr.splitlines()
    lines = [line for line in lines if "lie outside of" not in line]  # the images have 8 x 8 px
    assert len(lines) == 1
    return lines[0]


def test_the_plain_call_finds_kpbench_data(here):
    write_dataset(here / "kpbench-data", IMAGES)
    write_predictions("preds.json", perfect(detector={"name": "oracle", "version": "2"}))
    result = kpbench("score", "preds.json")
    assert result.stderr == ""
    lines = result.stdout.splitlines()
    assert lines[0] == "predictions  preds.json, oracle 2"
    assert "keypoints    4: 4 matched (0 with a wrong ID), 0 missed" in lines
    assert "detection score                1.0000 [1.0000, 1.0000]" in lines
    assert "false alarms per image         0.0000 [0.0000, 0.0000]" in lines
    assert "as printed" not in result.stdout  # nothing differs


def test_undefined_is_na_and_the_printed_reading_is_shown_where_it_differs(here):
    write_dataset(here / "kpbench-data", IMAGES, condition="blur")
    twice = Detections([[10, 10], [10.5, 10]], [1, 0.5], [0, 0])
    none = Detections.none()
    write_predictions("p.json", Predictions.from_detections([twice, none, none, none]))
    lines = kpbench("score", "p.json").stdout.splitlines()
    rows = {tuple(line.split()[:3]): line.split() for line in lines if line.startswith(("blur ", "all "))}
    assert next(line for line in lines if line.startswith("detection score")).startswith(
        "detection score                0.25"
    )
    assert next(line for line in lines if line.startswith("detection score, as")).split()[4] == "0.5000"
    zero = ["0.0000", "[0.0000,", "0.0000]"]
    assert rows["blur", "1", "all"][4:] == ["2", "2", *zero, "n/a", *zero * 3, "n/a", "n/a"]
    assert list(rows) == [
        ("blur", "0", "all"), ("blur", "1", "all"), ("blur", "0", "0"), ("blur", "0", "1"), ("blur", "1", "0"),
        ("blur", "1", "1"), ("all", "all", "0"), ("all", "all", "1"), ("all", "all", "all"),
    ]  # fmt: skip
    literal = kpbench("score", "p.json", "--matching", "literal").stdout
    assert "detection score                0.5000" in literal


def test_files_hold_what_the_screen_shows(here):
    data = write_dataset(here / "kpbench-data", IMAGES, condition="blur")
    write_predictions("p.json", perfect(detector={"name": "oracle"}))
    args = ["p.json", "--json", "s.json", "--csv", "s.csv", "--eps", "0.2", "--eps-radius", "minor"]
    kpbench("score", *args)
    content = json.loads((here / "s.json").read_text())
    assert content["schema"] == "kpbench.scores/1"
    assert content["dataset"] == {"fingerprint": data.fingerprint, "images": 4}
    assert content["detector"] == {"name": "oracle"}
    assert content["settings"]["eps"] == 0.2
    assert content["settings"]["eps_radius"] == "minor"
    assert content["settings"]["matching"] == "one-to-one"
    assert set(content["metrics"]) == {*METRICS, "counts", "intervals"}
    assert tuple(content["metrics"]["counts"]) == COUNTS
    assert content["metrics"]["detection_score"] == 1
    assert content["by"][0]["condition"] == "blur"
    assert content["provenance"]["predictions"] == [{"file": "p.json", "sha256": sha256_of(here / "p.json")}]
    assert content["provenance"]["dataset"] == {
        "path": "kpbench-data",
        "fingerprint": data.fingerprint,
        "source": None,
    }
    with (here / "s.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1 + len(content["by"])
    assert [rows[0][k] for k in ("condition", "rung", "patch_id")] == ["", "", ""]
    for row, group in zip(rows[1:], content["by"], strict=True):
        assert row["rung"] == ("" if group["rung"] is None else str(group["rung"]))
        for name in METRICS:
            value = group["metrics"][name]
            assert (float(row[name]) if row[name] else None) == value
    schema = json.loads((Path(__file__).parents[2] / "docs" / "schemas" / "scores-1.json").read_text())
    jsonschema.Draft202012Validator(schema).validate(content)
    before = (here / "s.json").read_bytes()
    kpbench("score", *args)
    assert (here / "s.json").read_bytes() == before


def test_where_the_dataset_is_found(here):
    write_dataset(here / "kpbench-data", [[(10, 10, 10, 0)]] * 2)
    other = write_dataset(here / "other", IMAGES)
    (here / "sub").mkdir()
    write_dataset(here / "sub" / "beside", [[]])

    def images(*args):
        return next(
            line.split()[1] for line in kpbench("score", *args).stdout.splitlines() if line.startswith("images")
        )

    write_predictions("p.json", perfect())
    assert images("p.json", "--gt", "other") == "4"
    write_predictions("p.json", perfect(dataset="other"))
    assert images("p.json") == "4"
    write_predictions("sub/p.json", perfect([[]], dataset="beside"))
    assert images("sub/p.json") == "1"
    write_predictions("p.json", perfect([[]] * 2, dataset="gone"))
    result = kpbench("score", "p.json")
    assert (
        result.stderr == "kpbench: p.json names the dataset 'gone', which is not here; scoring against ./kpbench-data\n"
    )
    write_predictions("p.json", perfect(dataset=other.fingerprint))
    assert images("p.json", "--gt", "other") == "4"
    mark = open_dataset("kpbench-data").fingerprint
    assert complaint("p.json") == (
        f"kpbench: p.json does not fit kpbench-data: made for the dataset with fingerprint "
        f"{other.fingerprint[:12]}…, but this dataset's is {mark[:12]}…"
    )


def test_without_any_dataset_the_way_out_is_named(here):
    write_predictions("p.json", perfect())
    assert complaint("p.json") == (
        "kpbench: p.json: names no dataset, and there is no ./kpbench-data; name one with --gt"
    )
    write_predictions("p.json", perfect(dataset="gone"))
    assert "names the dataset 'gone', which is not here, and there is no" in complaint("p.json")
    assert complaint("p.json", "--gt", "gone").startswith("kpbench: gone: no dataset there")


def test_images_must_be_the_same(here):
    write_dataset(here / "kpbench-data", IMAGES)
    write_predictions("few.json", perfect(IMAGES[:3]))
    assert complaint("few.json") == (
        "kpbench: few.json does not fit kpbench-data: no prediction for image_id 3; 1 of 4 images are missing "
        "(--allow-missing takes them as images without detections)"
    )
    assert "4: 3 matched" in kpbench("score", "few.json", "--allow-missing").stdout
    write_predictions("many.json", perfect([*IMAGES, []]))
    assert complaint("many.json", "--allow-missing").startswith(
        "kpbench: many.json does not fit kpbench-data: image_id 4 is not in the dataset (4 images, image_id 0 to 3)"
    )


def test_bad_predictions_are_one_line(here):
    write_dataset(here / "kpbench-data", IMAGES)
    (here / "p.json").write_text(
        '{"schema": "kpbench.predictions/1", "predictions": [{"image_id": 12, "keypoints": [[1, 2], [NaN, 4.0]]}]}'
    )
    assert complaint("p.json") == (
        "kpbench: p.json: predictions[0] (image_id 12): keypoints[1] is [nan, 4.0], expected two finite numbers"
    )
    assert complaint("none.json") == "kpbench: none.json: cannot be read, No such file or directory"


def test_gates(here):
    write_dataset(here / "kpbench-data", IMAGES)
    write_predictions("p.json", perfect([*IMAGES[:3], [(0, 0, 1, 1)]]))
    kpbench("score", "p.json", "--min", "detection_score=0.75", "--max", "average_false_alarm=0.25")
    result = kpbench(
        "score",
        "p.json",
        "--min",
        "detection_score=0.8",
        "--max",
        "average_false_alarm=0.2",
        "--json",
        "s.json",
        code=1,
    )
    assert result.stderr == (
        "kpbench: detection_score is 0.75, expected at least 0.8; average_false_alarm is 0.25, expected at most 0.2\n"
    )
    assert "detection score                0.7500" in result.stdout  # the scores are shown and written all the same
    assert (here / "s.json").exists()


@pytest.mark.parametrize(
    "args",
    [
        ["--min", "detection=1"],
        ["--min", "detection_score"],
        ["--min", "detection_score=high"],
        ["--max", "recall=nan"],
        ["--eps", "-1"],
        ["--eps-radius", "x"],
        ["--matching", "x"],
    ],
)
def test_wrong_usage_is_exit_2(here, args):
    assert "Usage" in kpbench("score", "p.json", *args, code=2).stderr


def test_a_folder_that_cannot_be_written_is_one_line(here):
    write_dataset(here / "kpbench-data", IMAGES)
    write_predictions("p.json", perfect())
    assert "no/s.json: cannot be written" in complaint("p.json", "--json", "no/s.json")


def test_coco_truth_scores_as_the_dataset_that_it_was_exported_from(here):
    data = write_dataset(here / "kpbench-data", IMAGES, condition="blur")
    export_dataset(data, "coco", here / "coco")
    write_predictions("p.json", perfect([*IMAGES[:3], [(30.5, 30, 20, 0)]]))
    kpbench("score", "p.json", "--json", "a.json")
    out = kpbench("score", "p.json", "--gt", "coco/annotations.json", "--json", "b.json", "--report", "r.html").stdout
    assert "dataset      coco/annotations.json" in out
    a, b = (json.loads((here / name).read_text()) for name in ("a.json", "b.json"))
    without_homographies = dict.fromkeys(("bias_px", "bias_u_px", "bias_v_px", "scatter_px"))
    assert a["metrics"] | without_homographies == b["metrics"]
    assert [group | {"metrics": group["metrics"] | without_homographies} for group in a["by"]] == b["by"]
    assert "data:image/jpeg" in (here / "r.html").read_text()
    for image in (here / "coco" / "images").iterdir():
        image.unlink()
    assert (
        "r.html shows no images"
        in kpbench("score", "p.json", "--gt", "coco/annotations.json", "--report", "r.html").stderr
    )
    assert json.loads((here / "b.json").read_text())["dataset"]["fingerprint"] == data.fingerprint


def test_the_coco_export_is_known_by_its_datasets_fingerprint(here):
    data = write_dataset(here / "kpbench-data", IMAGES)
    export_dataset(data, "coco", here / "coco")
    write_predictions("p.json", replace(perfect(), fingerprint=data.fingerprint))
    kpbench("score", "p.json", "--gt", "coco/annotations.json")
    write_predictions("p.json", replace(perfect(), fingerprint="a" * 64))
    assert "made for the dataset with fingerprint aaaaaaaaaaaa" in complaint("p.json", "--gt", "coco/annotations.json")
    content = json.loads((here / "coco/annotations.json").read_text())
    (here / "other.json").write_text(json.dumps(content | {"info": {"description": "of another tool"}}))
    write_predictions("p.json", replace(perfect(), fingerprint=sha256_of(here / "other.json")))
    kpbench("score", "p.json", "--gt", "other.json")


def test_coco_truth_with_one_radius_and_results(here):
    content = {
        "images": [{"id": 5, "file_name": "a.png"}, {"id": 2}],
        "annotations": [
            {"image_id": 2, "category_id": 1, "keypoints": [10, 10, 2], "radius": 10},
            {"image_id": 5, "category_id": 2, "keypoints": [10, 10, 1], "radius_major": 10, "radius_minor": 5},
            {"image_id": 5, "category_id": 2, "keypoints": [0, 0, 0], "radius": 10},
        ],
    }
    (here / "gt.json").write_text(json.dumps(content))
    results = [
        {"image_id": 5, "category_id": 2, "keypoints": [10.5, 10, 1], "score": 0.9},
        {"image_id": 5, "category_id": 1, "keypoints": [90, 10, 1], "score": 0.2},
    ]
    (here / "results.json").write_text(json.dumps(results))
    assert "no prediction for image_id 2" in complaint("results.json", "--gt", "gt.json")
    kpbench("score", "results.json", "--gt", "gt.json", "--allow-missing", "--json", "s.json")
    metrics = json.loads((here / "s.json").read_text())["metrics"]
    assert metrics["counts"]["truths"] == 2
    assert (metrics["detection_score"], metrics["id_matching_score"], metrics["average_false_alarm"]) == (0.5, 1, 0.5)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"radius": None}, "annotations[0] (image_id 0): has no radius"),
        ({"radius": "4"}, "annotations[0] (image_id 0): radius is '4', expected a number of px"),
        ({"keypoints": [1, 2]}, "annotations[0] (image_id 0): keypoints is [1, 2], expected one keypoint [x, y, v]"),
        (
            {"keypoints": [1, None, 2]},
            "annotations[0] (image_id 0): keypoints is [1, None, 2], expected one keypoint [x, y, v]",
        ),
        ({"image_id": 4}, "annotations[0]: image_id is 4, but there is no such image"),
        ({"category_id": "1"}, "annotations[0] (image_id 0): category_id is '1', expected a whole number from 1"),
    ],
)
def test_bad_coco_truth_is_one_line(here, change, problem):
    entry = {"image_id": 0, "category_id": 1, "keypoints": [10, 10, 2], "radius": 10} | change
    (here / "gt.json").write_text(json.dumps({"images": [{"id": 0}], "annotations": [entry]}))
    write_predictions("p.json", perfect([[]]))
    assert complaint("p.json", "--gt", "gt.json").startswith(f"kpbench: gt.json: {problem}")


@pytest.mark.parametrize(
    ("text", "problem"),
    [("{", "the file is cut off or no JSON"), ("[]", "holds a list"), ("{}", "has no list 'images'")],
)
def test_no_coco_truth_is_one_line(here, text, problem):
    (here / "gt.json").write_text(text)
    write_predictions("p.json", perfect([[]]))
    assert complaint("p.json", "--gt", "gt.json").startswith(f"kpbench: gt.json: {problem}")
    assert complaint("p.json", "--gt", "none.json").startswith("kpbench: none.json: cannot be read")


def test_what_is_read_is_not_written(here):
    write_dataset(here / "kpbench-data", IMAGES)
    write_predictions("preds.json", perfect())
    before = Path("preds.json").read_bytes()
    for arguments in (
        ["score", "preds.json", "--json", "preds.json"],
        ["score", "preds.json", "--json", "a.html", "--report", "a.html"],
        ["compare", "preds.json", "preds.json", "--json", "preds.json"],
    ):
        refused = kpbench(*arguments, code=1)
        assert "this command reads it, or writes it twice" in refused.stderr
    assert Path("preds.json").read_bytes() == before
    assert not Path("a.html").exists()
