"""Ignored patches: detections near them count neither way; from a shard, from COCO, and through the copies."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

import kpbench
from kpbench.dataset.card import dataset_facts
from kpbench.dataset.generation import generate
from kpbench.dataset.labelled import open_labelled
from kpbench.dataset.shard import Sample
from kpbench.report.summary import summarise_scores
from kpbench.scoring.scores import score
from kpbench.types import KEYPOINT_DTYPE, LABELLED_KEYPOINT_DTYPE, Detections, Truth


def table(xy, radius, dtype=KEYPOINT_DTYPE):
    keypoints = np.zeros(len(xy), dtype)
    keypoints["x"], keypoints["y"] = np.reshape(xy, (-1, 2)).T
    keypoints["radius_major"] = keypoints["radius_minor"] = radius
    keypoints["H_patch2image"] = np.eye(3)
    return keypoints


def most_matches(distance, reach):
    """Largest number of one-to-one matches, by trying every assignment."""
    t, d = distance.shape
    slots = [*range(d), *[-1] * t]
    return max(
        sum(k >= 0 for k in chosen)
        for chosen in itertools.permutations(slots, t)
        if all(k < 0 or distance[n, k] <= reach[n] for n, k in enumerate(chosen))
    )


def test_counts_are_those_of_brute_force():
    """On a coarse grid, with ties and detections near both kinds of patches."""
    rng = np.random.default_rng(5)
    for _ in range(300):
        judged, ignored, found = (rng.integers(0, 6, (rng.integers(0, high), 2)) for high in (4, 4, 5))
        radius, radius_ignored = rng.choice([5.0, 10.0, 20.0], len(judged)), rng.choice([5.0, 10.0], len(ignored))
        truth = Truth(
            np.arange(1), np.array([0, len(judged)]), table(judged, radius), np.array([""]), np.array([np.nan]),
            np.arange(1), ignored=table(ignored, radius_ignored), ignored_image=np.zeros(len(ignored), int),
        )  # fmt: skip
        scores = score(truth, [Detections(found, np.ones(len(found)), np.zeros(len(found)))], resamples=0)
        distance = np.linalg.norm(judged[:, None] - found, axis=2).reshape(len(judged), len(found))
        matched = most_matches(distance, 0.1 * radius)
        is_near = (np.linalg.norm(found[:, None] - ignored, axis=2) <= 0.1 * radius_ignored).any(axis=1)
        chosen = scores.outcomes.matches.detection[scores.outcomes.matched]
        assert scores.overall.counts["matched"] == matched
        assert scores.overall.counts["truths"] == len(judged)
        left = len(found) - scores.overall.counts["detections"]
        assert left == scores.ignored["detections"]
        # every detection that is left out is near an ignored patch; every one that stays is matched or near none
        assert is_near.sum() - matched <= left <= is_near.sum()
        kept = scores.outcomes.detections.xy
        unmatched = np.delete(kept, chosen, axis=0)
        assert not (np.linalg.norm(unmatched[:, None] - ignored, axis=2) <= 0.1 * radius_ignored).any()


class Photographs:
    """Three labelled images: each with two judged patches and one ignored patch, far apart."""

    n, shard_size, image_bytes, most_keypoints = 3, 2, 4000, 3

    def to_dict(self):
        patches = [patch.to_dict() for patch in kpbench.shipped_patches()]
        return {"kind": "photographs", "source": "photographs", "n": 3, "shard_size": 2, "patches": patches}

    def scene_id(self, index):
        return index

    def make(self, index):
        keypoints = table([[20, 20], [60, 20], [20, 60]], 12.0, LABELLED_KEYPOINT_DTYPE)
        keypoints["H_patch2image"][:, 0, 0] = keypoints["H_patch2image"][:, 1, 1] = 12.0
        keypoints["H_patch2image"][:, :2, 2] = np.stack([keypoints["x"], keypoints["y"]], axis=1)
        keypoints["sigma_x"] = keypoints["sigma_y"] = 0.01
        keypoints["patch_id"] = 0, 1, 2
        keypoints["sigma_x"][2] = keypoints["sigma_y"][2] = np.inf
        return Sample(index, np.full((80, 80), 90, np.uint8), keypoints, condition="free"), ()


FOUND = [Detections([[20, 20], [20.5, 60], [70, 70]], [1.0, 0.9, 0.8], [0, 2, 0])] * 3
EXPECTED = {"truths": 6, "matched": 3, "missed": 3, "detections": 6, "clutter": 3}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return generate(Photographs(), tmp_path_factory.mktemp("ignored") / "set", workers=1).dataset


def check_counts(labelled):
    scores = score(labelled, FOUND, resamples=0)
    assert {name: scores.overall.counts[name] for name in EXPECTED} == EXPECTED
    assert scores.ignored == {"patches": 3, "detections": 3}
    return scores


def test_a_dataset_keeps_them_apart(dataset):
    assert list(dataset.verify())
    assert [len(dataset[n][1]) for n in range(3)] == [2, 2, 2]
    assert dataset.ignored(1)["patch_id"].tolist() == [2]
    assert dataset.__getitems__([0, 1])[0]["xy"].shape == (2, 2)
    scores = check_counts(dataset)
    assert scores.to_dict()["dataset"]["ignored"] == {"patches": 3, "detections": 3}
    assert "ignored      3 patches, 3 detections at them" in summarise_scores(scores)
    assert "6, and 3 ignored" in dataset_facts(dataset)["keypoints"]


def test_coco_tells_them_as_crowds_without_visible_keypoints(dataset, tmp_path):
    path = kpbench.export_dataset(dataset, "coco", tmp_path / "coco")
    content = json.loads(path.read_text())
    crowds = [a for a in content["annotations"] if a["iscrowd"]]
    assert [(a["keypoints"], a["num_keypoints"], a["category_id"]) for a in crowds] == [([20.0, 60.0, 0], 0, 3)] * 3
    check_counts(open_labelled(path))


def test_pycocotools_ignores_them(dataset, tmp_path):
    coco_module, eval_module = pytest.importorskip("pycocotools.coco"), pytest.importorskip("pycocotools.cocoeval")
    coco = coco_module.COCO(str(kpbench.export_dataset(dataset, "coco", tmp_path / "coco")))
    results = coco.loadRes([
        {"image_id": n, "category_id": int(d.patch_id[k]) + 1, "keypoints": [*d.xy[k].tolist(), 2], "score": 1.0}
        for n, d in enumerate(FOUND)
        for k in range(3)
    ])  # fmt: skip
    judge = eval_module.COCOeval(coco, results, "keypoints")
    judge.params.kpt_oks_sigmas = np.array([0.1])
    judge.evaluate()
    parts = [p for p in judge.evalImgs if p is not None and p["aRng"] == judge.params.areaRng[0]]
    assert sum(int(np.logical_not(p["dtIgnore"][0]).sum()) for p in parts) == 6
    assert sum(int(np.sum(p["dtIgnore"][0])) for p in parts) == 3


@pytest.mark.parametrize("of", ["dataset", "coco"])
def test_degraded_copies_keep_them(dataset, tmp_path, of):
    source = dataset.path if of == "dataset" else kpbench.export_dataset(dataset, "coco", tmp_path / "coco").parent
    config = kpbench.synth.DegradeConfig(Path(source), kpbench.load_suite("paper-v1"), only=("noise",))
    noisy = generate(config, tmp_path / "noisy", workers=1).dataset
    assert len(noisy) == 15
    assert len(noisy.truth.ignored) == 15
    assert noisy.ignored(14)[["x", "y", "patch_id"]].tolist() == [(20.0, 60.0, 2)]
    assert np.isfinite(noisy.truth.keypoints["sigma_x"]).all()


def test_crowds_of_others_without_a_radius_are_skipped(tmp_path):
    crowd = {"image_id": 1, "category_id": 1, "keypoints": [0, 0, 0], "iscrowd": 1}
    content = {"images": [{"id": 1, "file_name": "1.png"}], "annotations": [crowd, crowd]}
    (tmp_path / "truth.json").write_text(json.dumps(content))
    assert open_labelled(tmp_path / "truth.json").truth.ignored is None
