"""The columns that version 2 of predictions files adds: every format gives them back, or names the impossible value."""

import json
import math

import h5py
import numpy as np
import pytest

from kpbench.errors import PredictionsError
from kpbench.predictions import decode, json_files
from kpbench.predictions.files import read_predictions, write_predictions
from kpbench.types import UNKNOWN, Detections, Predictions

FORMATS = ["json", "jsonl", "csv", "parquet", "h5"]
OF_DETECTIONS = ("A_patch2image", "covariance", "blur_px", "board", "points", "probability")
HEADER = {"schema": "kpbench.predictions/2", "boards": ["hexagon-chécker", "b"]}


def some(n=12, seed=0, **change):
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 4, n)
    k = int(counts.sum())
    root = rng.normal(0, 0.1, (k, 2, 2))
    columns = {
        "patch_id": rng.integers(0, 4, k),
        "A_patch2image": rng.normal(0, 20, (k, 2, 2)),
        "covariance": root @ root.transpose(0, 2, 1),
        "blur_px": rng.random(k),
        "board": np.where(np.arange(k) % 4 == 1, -1, 1),
        "points": np.where(np.arange(k) % 4, -1, np.arange(k)),
        "probability": rng.random(k),
        "boards": ("hexagon-chécker", "b"),
        "file": tuple(f"ünï,{i}: a.png" if i % 3 else "" for i in range(n)),
        "size": np.where(np.arange(n)[:, None] == 1, 0, rng.integers(1, 5000, (n, 2))),
        "frame_index": rng.integers(-1, 2**40, n),
        "time_s": np.where(np.arange(n) == 2, np.nan, rng.random(n)),
        "ms": rng.random(n),
    }
    columns |= change
    return Predictions(
        np.arange(n) + 3, np.append(0, np.cumsum(counts)), rng.normal(size=(k, 2)), rng.random(k), **columns
    )


def assert_same(p, q):
    for name in ("image_id", "offsets", "xy", "score", *OF_DETECTIONS, *UNKNOWN):
        a, b = getattr(p, name), getattr(q, name)
        if a is None or name == "file":
            assert a == b, name
        else:
            np.testing.assert_array_equal(a, b, name)
            assert a.dtype == b.dtype


@pytest.mark.parametrize(
    "left_out", [(), OF_DETECTIONS, tuple(UNKNOWN), ("covariance", "file"), ("size", "A_patch2image")]
)
@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_gives_back_every_bit(tmp_path, suffix, left_out):
    p = some(**dict.fromkeys(left_out))
    write_predictions(tmp_path / f"p.{suffix}", p)
    assert_same(read_predictions(tmp_path / f"p.{suffix}"), p)


@pytest.mark.parametrize("suffix", FORMATS)
def test_columns_of_images_without_detections_are_kept(tmp_path, suffix):
    of_images = {"file": ("a", "", "b"), "size": [[3, 4], [0, 0], [5, 6]], "ms": [1.5, math.nan, 2]}
    p = Predictions.from_detections([Detections.none()] * 3, [1, 2, 9], **of_images)
    write_predictions(tmp_path / f"p.{suffix}", p)
    assert_same(read_predictions(tmp_path / f"p.{suffix}"), p)


@pytest.mark.parametrize("size", [1, 300])
@pytest.mark.parametrize("suffix", ["json", "jsonl"])
def test_a_file_read_in_pieces_is_the_file_read_whole(tmp_path, monkeypatch, suffix, size):
    """Of the second half of the images, some have columns that no image before has."""
    records = [json.loads(line) for line in json_files.encode_images(some(40))]
    for record in records[:20]:
        for name in UNKNOWN:
            record.pop(name, None)
    path = tmp_path / f"p.{suffix}"
    if suffix == "json":
        path.write_text(json.dumps(HEADER | {"predictions": records}))
    else:
        path.write_text("\n".join(map(json.dumps, [HEADER, *records])))
    whole = read_predictions(path)
    for module in (decode, json_files):
        monkeypatch.setattr(module, "PIECE_BYTES", size)
    assert_same(read_predictions(path), whole)
    assert whole.file[:20] == ("",) * 20
    assert whole.file[20:] == some(40).file[20:]


def test_a_key_that_is_twice_is_refused_among_new_keys(tmp_path):
    path = tmp_path / "p.json"
    record = '{"image_id": 1, "keypoints": [[1, 2]], "ms": 1, "ms": 2}'
    path.write_text(f'{{"schema": "kpbench.predictions/2", "predictions": [{record}]}}')
    with pytest.raises(PredictionsError, match="ms"):
        read_predictions(path)


def test_detections_in_and_out():
    d = Detections([[1, 2]], [0.5], [3], [np.eye(2)], [np.eye(2)], [1.0])
    p = Predictions.from_detections([d, Detections.none()], file=("a.png", "b.png"))
    [back, none] = p.detections()
    assert (back.A_patch2image.tolist(), back.covariance.tolist(), back.blur_px.tolist()) == (
        [np.eye(2).tolist()],
        [np.eye(2).tolist()],
        [1.0],
    )
    assert (len(none), p.file) == (0, ("a.png", "b.png"))
    with pytest.raises(PredictionsError, match="some images have covariance and others have none"):
        Predictions.from_detections([d, Detections([[1, 2]], [0.5], [3], [np.eye(2)], None, [1.0])])


def test_columns_in_which_nothing_is_known_are_none():
    p = Predictions([0], [0, 0], [], [], file=[""], size=[[0, 0]], frame_index=[-1], time_s=[math.nan], ms=[math.nan])
    assert [getattr(p, name) for name in UNKNOWN] == [None] * 5


# --- impossible values ---------------------------------------------------------------------------------------------

NAN = math.nan
COVARIANCE = "expected a symmetric, positive semi-definite matrix (2, 2) of finite numbers"
BAD = [
    ("covariance", [[[1, 0], [0, 1]], [[1, 2], [2, 1]]], f"covariance[1] is [[1.0, 2.0], [2.0, 1.0]], {COVARIANCE}"),
    ("covariance", [[[1, 0.5], [0, 1]]] * 2, f"covariance[0] is [[1.0, 0.5], [0.0, 1.0]], {COVARIANCE}"),
    ("covariance", [[[-1, 0], [0, 1]]] * 2, f"covariance[0] is [[-1.0, 0.0], [0.0, 1.0]], {COVARIANCE}"),
    ("covariance", [[[NAN, 0], [0, 1]]] * 2, f"covariance[0] is [[nan, 0.0], [0.0, 1.0]], {COVARIANCE}"),
    ("covariance", [[[1, 0], [0, 1]]], "covariance has 1 values, expected one for each of 2 keypoints"),
    ("covariance", [[1, 0, 1]] * 2, f"covariance[0] is [1, 0, 1], {COVARIANCE}"),
    (
        "A_patch2image",
        [[[1, 0], [0, NAN]]] * 2,
        "A_patch2image[0] is [[1.0, 0.0], [0.0, nan]], expected a matrix (2, 2)",
    ),
    ("A_patch2image", [[1, 2]] * 2, "A_patch2image[0] is [1, 2], expected a matrix (2, 2) of finite numbers"),
    ("blur_px", [0, -0.5], "blur_px[1] is -0.5, expected a finite number of 0 or more"),
    ("blur_px", [0, "a"], "blur_px[1] is 'a', expected a finite number of 0 or more"),
    ("size", [640.5, 480], "size is [640.5, 480], expected width and height in px, whole numbers over 0"),
    ("size", [640, 0], "size is [640, 0], expected width and height"),
    ("size", [640], "size is [640], expected width and height"),
    ("frame_index", -1, "frame_index is -1, expected a whole number of 0 or more"),
    ("frame_index", 1.5, "frame_index is 1.5, expected a whole number of 0 or more"),
    ("time_s", "now", "time_s is 'now', expected a finite number of seconds"),
    ("time_s", NAN, "time_s is inf, expected a finite number of seconds"),
    ("ms", -1, "ms is -1.0, expected milliseconds, a finite number of 0 or more"),
    ("file", 7, "file is 7, expected a text"),
]


@pytest.mark.parametrize(("name", "value", "problem"), BAD)
@pytest.mark.parametrize("suffix", ["json", "jsonl"])
def test_an_impossible_value_is_one_line(tmp_path, suffix, name, value, problem):
    good, record = {"image_id": 5, "keypoints": []}, {"image_id": 12, "keypoints": [[1, 2], [3, 4]], name: value}
    path = tmp_path / f"p.{suffix}"
    if suffix == "json":
        path.write_text(json.dumps(HEADER | {"predictions": [good, record]}))
    else:
        path.write_text("\n".join(map(json.dumps, [HEADER, good, record])))
    with pytest.raises(PredictionsError) as error:
        read_predictions(path)
    place = "predictions[1]" if suffix == "json" else "line 3"
    assert str(error.value).startswith(f"{path}: {place} (image_id 12): {problem}")
    assert "\n" not in str(error.value)


BAD_ROWS = [
    ("covariance_xx,covariance_xy,covariance_yy", "1,2,1", "line 3 (image_id 5): covariance[0] is [[1.0, 2.0], [2.0"),
    (
        "covariance_xx,covariance_xy,covariance_yy",
        "1,,1",
        "line 3 (image_id 5): covariance_xy is blank, expected a fin",
    ),
    ("covariance_xx,covariance_xy", "1,0", "line 1 has columns image_id,x,y,covariance_xx,covariance_xy, expected"),
    ("blur_px", "-1", "line 3 (image_id 5): blur_px[0] is -1.0, expected a finite number of 0 or more"),
    ("width,height", "640.5,480", "line 3: width is '640.5', expected a whole number under"),
    ("width,height", "640,", "line 3 (image_id 5): size is [640, 0], expected width and height"),
    ("width,height", "0,480", "line 3 (image_id 5): width is 0.0, expected px, a whole number over 0"),
    ("frame_index", "-1", "line 3 (image_id 5): frame_index is -1.0, expected a whole number of 0 or more"),
    ("ms", "-2", "line 3 (image_id 5): ms is -2.0, expected milliseconds"),
    ("ms", "soon", "line 3: ms is 'soon', expected a finite number"),
    ("file", "b.png", "line 4 (image_id 5): file is 'a.png', expected 'b.png' as in line 3"),
]


@pytest.mark.parametrize(("columns", "cells", "problem"), BAD_ROWS)
def test_an_impossible_cell_is_one_line(tmp_path, columns, cells, problem):
    path = tmp_path / "p.csv"
    good = {"covariance_xx": "1", "covariance_xy": "0", "file": "a.png"}
    last = ",".join(good.get(name, "1") for name in columns.split(","))
    path.write_text(
        f"image_id,x,y,{columns}\n4,1,2,{last}\n5,1,2,{cells}\n5,3,4,{cells if 'file' not in columns else last}\n"
    )
    with pytest.raises(PredictionsError) as error:
        read_predictions(path)
    assert str(error.value).startswith(f"{path}: {problem}")


def test_a_probability_lies_between_0_and_1(tmp_path):
    header = HEADER | {"boards": ["a"]}
    record = {"image_id": 12, "keypoints": [[1, 2]], "board": [0], "points": [3], "probability": [1.5]}
    (tmp_path / "p.json").write_text(json.dumps(header | {"predictions": [record]}))
    with pytest.raises(PredictionsError, match=r"probability\[0\] is 1\.5, expected a number from 0 to 1"):
        read_predictions(tmp_path / "p.json")


@pytest.mark.parametrize(
    ("name", "values", "problem"),
    [
        ("covariance", np.ones((3, 2, 2)) * [[1, 2], [2, 1]], "predictions[0] (image_id 0): covariance[0] is [[1.0"),
        ("covariance", np.ones((3, 4)), "/covariance is float64 of shape (3, 4), expected numbers"),
        ("covariance", np.ones((3, 2, 3)), "/covariance has shape (3, 2, 3), expected (K, 2, 2)"),
        ("blur_px", np.ones(2), "blur_px has shape (2,), expected (3,)"),
        ("probability", np.ones(3), "probability is given without board and points"),
        ("size", np.ones((1, 2)), "/size is float64 of shape (1, 2), expected numbers"),
        ("file", np.array([b"\xff"]), "/file holds a name that is not UTF-8 text"),
        ("file", np.array([b"a", b"b"]), "1 images have 2 file names, expected one per image"),
    ],
)
def test_an_impossible_column_of_hdf5_is_one_line(tmp_path, name, values, problem):
    path = tmp_path / "p.h5"
    with h5py.File(path, "w") as file:
        file["image_id"], file["offsets"], file["xy"] = [0], [0, 3], np.ones((3, 2))
        file[name] = values
    with pytest.raises(PredictionsError) as error:
        read_predictions(path)
    assert str(error.value).startswith(f"{path}: {problem}")


def test_a_parquet_file_that_repeats_a_long_name_takes_little_memory(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    rows = 20_000  # with a text of its own for each row, 4 GB
    table = pa.table({"image_id": np.arange(rows), "x": np.ones(rows), "y": np.ones(rows)})
    names = pa.DictionaryArray.from_arrays(np.zeros(rows, np.int32), ["a" * 200_000])
    pq.write_table(table.append_column("file", names), tmp_path / "p.parquet")
    p = read_predictions(tmp_path / "p.parquet")
    assert len({id(name) for name in p.file}) == 1


def test_a_column_of_names_that_are_numbers_is_refused(tmp_path):
    pandas = pytest.importorskip("pandas")
    pandas.DataFrame({"image_id": [1], "x": [1.0], "y": [2.0], "file": [3]}).to_parquet(tmp_path / "p.parquet")
    with pytest.raises(PredictionsError, match="column file holds no texts"):
        read_predictions(tmp_path / "p.parquet")


def test_a_size_in_memory_that_is_not_whole_is_refused():
    with pytest.raises(PredictionsError, match="size holds numbers that are not whole"):
        Predictions([0], [0, 0], [], [], size=[[640.5, 480]])


def test_a_name_that_no_text_holds_is_written(tmp_path):
    p = Predictions.from_detections([Detections.none()], file=["a\udcff.png"])
    for suffix in FORMATS:
        write_predictions(tmp_path / f"p.{suffix}", p)
        assert read_predictions(tmp_path / f"p.{suffix}").file == ("a\\udcff.png",)
