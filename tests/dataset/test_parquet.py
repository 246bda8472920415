"""Exports to Parquet, read by pyarrow, and where they are installed by ``datasets`` and mlcroissant."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from kpbench.dataset import split_scenes
from kpbench.dataset.export import export_dataset

pq = pytest.importorskip("pyarrow.parquet")


@pytest.fixture(scope="module")
def folder(dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("parquet") / "out"
    export_dataset(dataset, "parquet", out)
    return out


def check_row(dataset, row, image):
    n = row["image_id"]
    expected, keypoints = dataset[n]
    assert np.array_equal(np.asarray(image), expected)
    assert len(row["keypoints"]) == len(keypoints)
    for point, k in zip(row["keypoints"], keypoints, strict=True):
        assert (point["x"], point["y"], point["patch_id"]) == (k["x"], k["y"], k["patch_id"])
        assert point["H_patch2image"] == k["H_patch2image"].tolist()


def test_the_files_hold_the_images_and_the_truth_by_split(dataset, folder):
    expected = split_scenes(dataset.truth)
    for split, name in (("train", "train"), ("val", "validation")):
        rows = pq.read_table(folder / "data" / f"{name}-00000-of-00001.parquet").to_pylist()
        assert [row["image_id"] for row in rows] == [n for n in range(6) if expected[n] == split]
        for row in rows:
            check_row(dataset, row, Image.open(io.BytesIO(row["image"]["bytes"])))
            assert row["rung"] is None


def test_equal_datasets_give_equal_files(dataset, folder, tmp_path):
    export_dataset(dataset, "parquet", tmp_path / "again")
    files = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert all((folder / name).read_bytes() == (tmp_path / "again" / name).read_bytes() for name in files)


def test_hugging_face_datasets_loads_the_splits(dataset, folder, tmp_path):
    datasets = pytest.importorskip("datasets")
    loaded = datasets.load_dataset(str(folder), cache_dir=str(tmp_path))
    assert {name: len(part) for name, part in loaded.items()} == {"train": 5, "validation": 1}
    for part in loaded.values():
        for row in part:
            check_row(dataset, row, row["image"])


def test_croissant_names_every_file_and_column(folder):
    described = json.loads((folder / "croissant.json").read_text())
    for files in described["distribution"]:
        assert list(folder.glob(files["includes"]))
    columns = {field["source"]["extract"]["column"] for field in described["recordSet"][0]["field"]}
    assert columns == set(pq.read_schema(folder / "data" / "train-00000-of-00001.parquet").names)


def test_mlcroissant_validates_and_reads_the_records(dataset, folder):
    mlcroissant = pytest.importorskip("mlcroissant")
    described = mlcroissant.Dataset(str(folder / "croissant.json"))
    assert not described.metadata.issues.errors
    records = [record for name in ("train", "validation") for record in described.records(name)]
    assert len(records) == 6
    for record in records:
        image_id = record.get("train/image_id", record.get("validation/image_id"))
        xs = next(value for name, value in record.items() if name.endswith("/keypoints_x"))
        assert np.array_equal(xs if xs is not None else [], dataset.keypoints(int(image_id))["x"])
