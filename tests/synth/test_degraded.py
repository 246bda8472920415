"""A suite's effects on labelled images: what comes out, and what the result says that it is."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers import digests, kpbench, write_dataset

from kpbench import SuiteConfig, generate, load_suite, open_dataset
from kpbench.dataset.export import export_dataset
from kpbench.predictions.files import write_predictions
from kpbench.provenance import describe_images, image_source
from kpbench.synth import DegradeConfig
from kpbench.types import Detections, Predictions

PAPER = load_suite("paper-v1")
SMALL = SuiteConfig(PAPER, images=2, size_px=(203, 155), only=("scale",), seed=3)


@pytest.fixture(scope="module")
def scales(tmp_path_factory):
    """The condition scale: seven rungs, four patches, two scenes."""
    return generate(SMALL, tmp_path_factory.mktemp("scales") / "set", workers=1).dataset


def test_a_scene_of_a_suite_becomes_the_image_that_the_suite_makes(scales):
    """Blur and dimming, noise and its random field, rung by rung; and the truth with its contrast."""
    config = DegradeConfig(scales.path, PAPER, seed=3)
    assert config.n == 56 + 12 * 8
    made = [config.make(n)[0] for n in range(config.n)]
    for n in range(56):
        assert (made[n].image == scales.image(n)).all()
        assert made[n].keypoints.tobytes() == scales.keypoints(n).tobytes()
        assert (made[n].condition, made[n].rung) == ("scale", scales.truth.rung[n])
    suite = replace(SMALL, only=("blur", "dimming", "noise"))
    assert suite.n == len(made) - 56
    for n, degraded in enumerate(made[56:]):
        own, _ = suite.make(n)
        assert (degraded.image == own.image).all()
        assert (degraded.condition, degraded.rung, degraded.scene_id) == (own.condition, own.rung, own.scene_id)
        assert degraded.effects == own.effects
        for name in own.keypoints.dtype.names:
            assert np.allclose(degraded.keypoints[name], own.keypoints[name], atol=1e-4, equal_nan=True), name


def test_an_occlusion_hides_as_much_as_in_the_suite(scales):
    suite = load_suite("extended-v1")
    config = DegradeConfig(scales.path, suite, ("occlusion",), seed=3)
    own = SuiteConfig(suite, images=2, size_px=(203, 155), only=("occlusion",), seed=3)
    for n in range(own.n):
        visible = [sample.keypoints["visible"] for sample in (config.make(56 + n)[0], own.make(n)[0])]
        assert np.allclose(*visible, atol=1e-6)
        assert visible[0].max() < 0.95


def test_the_command_gives_the_same_bytes_whatever_makes_them(scales, here):
    arguments = ["degrade", scales.path, "--suite", "paper-v1", "--only", "dimming,noise", "--seed", "5"]
    done = kpbench(*arguments, "--out", "one", "--workers", 1)
    assert "one: 120 images, 2 shards, fingerprint" in done.stdout
    kpbench(*arguments, "--out", "two", "--workers", 2)
    assert digests(here / "one") == digests(here / "two")
    (here / "two" / "dataset.json").unlink()
    (here / "two" / "shard-00001.h5").unlink()
    kpbench(*arguments, "--out", "two", "--workers", 1, "--resume")
    assert digests(here / "one") == digests(here / "two")
    kpbench("verify", "one")
    other = kpbench(*arguments[:-1], "6", "--out", "two", "--workers", 1, "--resume", code=1)
    assert "of another dataset (seed is 5 there, 6 here)" in other.stderr
    degraded = open_dataset("one")
    assert sorted({*degraded.truth.condition}) == ["dimming", "noise", "scale"]
    assert str(scales.path) not in (here / "one" / "dataset.json").read_text()


def test_a_coco_file_of_photographs_is_degraded(here):
    rng = np.random.default_rng(0)
    for name in "ab":
        cv2.imwrite(f"{name}.png", rng.integers(0, 255, (60, 80, 3), np.uint8))
    content = {
        "info": {"source": "photographs"},
        "images": [{"id": 5, "file_name": "a.png"}, {"id": 7, "file_name": "b.png", "condition": "pitch", "rung": 40}],
        "annotations": [{"image_id": 5, "category_id": 2, "keypoints": [40, 30, 2], "radius": 9}],
    }  # fmt: skip
    (here / "annotations.json").write_text(json.dumps(content))
    kpbench("degrade", ".", "--suite", "paper-v1", "--out", "degraded", "--workers", 1)
    degraded = open_dataset("degraded")
    truth = degraded.truth
    assert len(degraded) == 2 + 12  # the rung 40 of pitch is not degraded
    assert truth.condition.tolist()[:2] == ["", "pitch"]
    assert {*truth.scene_id[2:]} == {5}
    assert all(degraded.keypoints(n)[["x", "y", "patch_id"]].tolist() == [(40, 30, 1)] for n in range(2, 14))
    assert np.isnan(truth.keypoints["contrast"]).all()
    blurred = cv2.blur(cv2.cvtColor(cv2.imread("a.png"), cv2.COLOR_BGR2GRAY), (3, 3), borderType=cv2.BORDER_REFLECT_101)
    assert np.abs(degraded.image(2).astype(int) - blurred).max() <= 1
    kpbench("degrade", "annotations.json", "--suite", "paper-v1", "--channels", 3, "--out", "rgb", "--workers", 1)
    assert (open_dataset("rgb").image(0) == cv2.imread("a.png")[..., ::-1]).all()
    cv2.imwrite("b.png", np.zeros((50, 80), np.uint8))
    line = kpbench("degrade", ".", "--suite", "paper-v1", "--out", "third", "--workers", 1, code=1).stderr
    assert "image_id 7 is 80 x 50, expected 80 x 60 as the first" in line


def test_what_cannot_be_degraded_is_one_line(here, scales):
    write_dataset(here / "blurred", [[(3, 4, 2, 0)]] * 2, "blur")
    write_dataset(here / "pitched", [[(3, 4, 2, 0)]] * 2, "rain")
    write_dataset(here / "plain", [[(3, 4, 2, 0)]] * 2)
    for arguments, problem in (
        (["blurred", "--suite", "paper-v1"], "blurred: has images of blur already; leave it out with --only"),
        (["pitched", "--suite", "paper-v1"], "no image shows the base view of paper-v1"),
        (["plain", "--suite", "camera-v1"], "camera-v1 has no condition of effects alone"),
        (["plain", "--suite", "paper-v1", "--only", "pitch"], "no condition 'pitch' of effects alone, only: blur"),
        (["plain", "--suite", "paper-v1", "--channels", 2], "--channels is 2, expected 1 (grey) or 3 (RGB)"),
        (["plain", "--suite", "paper-v1", "--out", "plain", "--overwrite"], "plain: holds the images themselves"),
        (["nothing", "--suite", "paper-v1"], "nothing: no dataset there"),
    ):
        line = kpbench("degrade", *arguments, code=1).stderr
        assert problem in line
        assert line.count("\n") == 1
    assert len(open_dataset("plain")) == 2
    for arguments in (["plain"], ["plain", "--resume"], ["plain", "--suite", "paper-v1", "--effect", "blur"]):
        kpbench("degrade", *arguments, code=2)
    assert "a dataset, expected images; --suite degrades" in kpbench(
        "degrade", "plain", "--effect", "blur", "--level", 3, code=1
    ).stderr  # fmt: skip


@pytest.mark.parametrize(
    ("config", "source"),
    [
        ({"kind": "synth"}, "simulated"),
        ({"kind": "suite", "source": "photographs"}, "simulated"),
        ({"kind": "degraded", "source": "simulated photographs"}, "simulated photographs"),
        ({"source": "photographs"}, "photographs"),
        ({"source": "photos"}, ""),
        ({"source": ["photographs"]}, ""),
        ({}, ""),
    ],
)
def test_what_images_are_follows_from_the_config(config, source):
    assert image_source(config) == source
    assert describe_images(2, source) == f"2 {source or 'images'}{' images' * (source == 'simulated')}"


@pytest.mark.parametrize("source", ["simulated photographs", "photographs"])
def test_every_report_tells_what_the_images_are(here, dataset, source):
    """Simulated images never become photographs, on any way from a dataset to a table."""
    content = json.loads(export_dataset(dataset, "coco", "plain").read_text())
    content["info"]["source"] = source
    (here / "plain" / "annotations.json").write_text(json.dumps(content))
    kpbench("degrade", "plain", "--suite", "paper-v1", "--only", "blur", "--out", "degraded", "--workers", 1)
    kpbench("merge", "merged", "degraded")
    kpbench("export", "merged", "--format", "coco", "--out", "again")
    kpbench("degrade", "again", "--suite", "paper-v1", "--only", "noise", "--out", "twice", "--workers", 1)
    kpbench("export", "twice", "--format", "yolo", "--out", "yolo")
    for card in ("degraded", "merged", "again", "twice", "yolo"):
        text = (here / card / "README.md").read_text().splitlines()
        what = f"{source} images" if source == "simulated" else source or "images"
        assert any(line.startswith("# Keypoint patches, ") and line.endswith(f" {what}") for line in text)
    truth = open_dataset("twice").truth
    found = Predictions.from_detections([Detections.none() for _ in truth.image_id], truth.image_id)
    write_predictions(here / "preds.json", found)
    files = ["scores.json", "table.csv", "report.html", "report.md", "report.tex"]
    reports = ["--json", files[0], "--csv", files[1]]
    kpbench("score", "preds.json", "--gt", "twice", *reports, "--report", files[2])
    for name in files[3:]:
        kpbench("score", "preds.json", "--gt", "twice", "--report", name)
    kpbench("bench", "--dataset", "twice", "--detector", "orb", "--out", "bench", "--workers", 1)
    assert json.loads((here / files[0]).read_text())["provenance"]["dataset"]["source"] == (source or None)
    assert (here / files[1]).read_text().splitlines()[1].split(",")[3] == source
    for name in (*files[2:], "bench/twice.html", "bench/twice.md"):
        text = (here / name).read_text()
        assert f"ours: {source or 'not told'})" in text, name
        assert f"54 {what} in 6 scenes" in text, name
        if source.startswith("simulated"):
            assert not [line for line in text.splitlines() if "photographs" in line.replace("simulated photographs", "")
                        and "paper" not in line]  # fmt: skip
