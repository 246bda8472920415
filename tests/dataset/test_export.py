import io
import json
import tarfile

import cv2
import numpy as np
import pytest

from kpbench.dataset import export
from kpbench.dataset.export import export_dataset
from kpbench.errors import DataError


def test_pycocotools_reads_the_coco_export_and_finds_our_keypoints(dataset, tmp_path):
    COCO = pytest.importorskip("pycocotools.coco").COCO
    path = export_dataset(dataset, "coco", tmp_path / "coco")
    coco = COCO(str(path))
    assert sorted(coco.getImgIds()) == dataset.truth.image_id.tolist()
    for n, image_id in enumerate(dataset.truth.image_id):
        image, keypoints = dataset[n]
        entry = coco.loadImgs([image_id])[0]
        stored = cv2.imread(str(tmp_path / "coco" / "images" / entry["file_name"]), cv2.IMREAD_GRAYSCALE)
        assert (stored == image).all()
        found = coco.loadAnns(coco.getAnnIds(imgIds=[image_id]))
        assert [a["keypoints"][:2] for a in found] == [[k["x"], k["y"]] for k in keypoints]
        assert [coco.loadCats([a["category_id"]])[0]["id"] - 1 for a in found] == keypoints["patch_id"].tolist()
        for a, k in zip(found, keypoints, strict=True):
            x, y, w, h = a["bbox"]
            assert x <= k["x"] + 0.5 <= x + w
            assert y <= k["y"] + 0.5 <= y + h
            if k["visible"] > 0.999:
                assert max(w, h) <= 2 * k["radius_major"] + 1e-3
                assert np.hypot(w, h) >= 2 * np.hypot(k["radius_major"], k["radius_minor"]) - 1e-3


def test_a_yolo_pose_parser_finds_our_keypoints(dataset, tmp_path):
    export_dataset(dataset, "yolo", tmp_path / "yolo")
    for n, image_id in enumerate(dataset.truth.image_id):
        image, keypoints = dataset[n]
        height, width = image.shape
        [label] = (tmp_path / "yolo" / "labels").glob(f"*/{image_id:08d}.txt")
        assert (tmp_path / "yolo" / "images" / label.parent.name / f"{image_id:08d}.png").is_file()
        text = label.read_text()
        rows = np.array([line.split() for line in text.splitlines()], float).reshape(-1, 8)
        assert rows[:, 0].tolist() == keypoints["patch_id"].tolist()
        assert np.allclose(rows[:, 5] * width - 0.5, keypoints["x"], atol=1e-5)
        assert np.allclose(rows[:, 6] * height - 0.5, keypoints["y"], atol=1e-5)
        assert ((rows[:, 1:7] >= 0) & (rows[:, 1:7] <= 1)).all()
    described = (tmp_path / "yolo" / "data.yaml").read_text()
    assert "train: images/train\nval: images/val\nkpt_shape: [1, 3]" in described
    assert '  0: "checker"' in described


def test_webdataset_tars_hold_our_samples_and_repeat(dataset, tmp_path):
    for name in ("one", "two"):
        export_dataset(dataset, "webdataset", tmp_path / name)
    tars = sorted((tmp_path / "one").glob("*.tar"))
    assert [p.name for p in tars] == ["shard-00000.tar", "shard-00001.tar"]
    assert all(p.read_bytes() == (tmp_path / "two" / p.name).read_bytes() for p in tars)
    n = 0
    for path in tars:
        with tarfile.open(fileobj=io.BytesIO(path.read_bytes())) as tar:
            members = tar.getmembers()
            for png, label in zip(members[::2], members[1::2], strict=True):
                image, keypoints = dataset[n]
                stored = cv2.imdecode(np.frombuffer(tar.extractfile(png).read(), np.uint8), cv2.IMREAD_GRAYSCALE)
                assert (stored == image).all()
                told = json.loads(tar.extractfile(label).read())
                assert told["image_id"] == dataset.truth.image_id[n]
                assert told["keypoints"]["x"] == keypoints["x"].tolist()
                n += 1
    assert n == len(dataset)


def test_an_export_never_mixes_with_what_is_there(dataset, tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(DataError, match="is not empty"):
        export_dataset(dataset, "coco", tmp_path)
    with pytest.raises(DataError, match="expected one of: coco, yolo, webdataset"):
        export_dataset(dataset, "voc", tmp_path / "new")


def test_names_of_designs_stay_text_in_yaml(dataset, tmp_path, monkeypatch):
    yaml = pytest.importorskip("yaml")
    called = {0: "no", 1: "a: b", 2: "wheel", 3: "1"}
    monkeypatch.setattr(export, "patch_names", lambda dataset: called)
    export_dataset(dataset, "yolo", tmp_path / "yolo")
    assert yaml.safe_load((tmp_path / "yolo" / "data.yaml").read_text())["names"] == called


def test_a_contrast_that_nobody_could_measure_is_null_in_json():
    assert export._to_json_numbers(np.array([1.5, np.nan])) == [1.5, None]
    assert export._to_json_numbers(np.array([3])) == [3]
