import gc
import json
import sys
from pathlib import Path

import h5py
import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kpbench.errors import DataError, PredictionsError
from kpbench.predictions import decode, json_files
from kpbench.predictions.files import read_predictions, write_predictions
from kpbench.types import Detections, Predictions

FORMATS = ["json", "jsonl", "csv", "parquet", "h5"]
HEADER = {"schema": "kpbench.predictions/1"}


def some(n=5, ids=True, seed=0):
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 4, n)
    k = int(counts.sum())
    return Predictions(
        image_id=rng.permutation(n) + 3,
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        xy=rng.normal(0, 300, (k, 2)),
        score=rng.random(k),
        patch_id=rng.integers(0, 4, k) if ids else None,
        detector={"name": "ünï", "version": "1"},
        dataset="some/where",
        fingerprint="a" * 64,
    )


def as_dict(p):
    return {
        i: (d.xy.tolist(), d.score.tolist(), None if d.patch_id is None else d.patch_id.tolist())
        for i, d in zip(p.image_id.tolist(), p.detections(), strict=True)
    }


# --- round trips ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ids", [True, False])
@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_gives_back_every_bit(tmp_path, suffix, ids):
    p = some(20, ids)
    path = tmp_path / f"preds.{suffix}"
    write_predictions(path, p)
    q = read_predictions(str(path))
    assert as_dict(q) == as_dict(p)
    assert (q.detector, q.dataset, q.fingerprint) == (p.detector, p.dataset, p.fingerprint)
    first = path.read_bytes()
    write_predictions(path, p)
    assert path.read_bytes() == first
    assert [f.name for f in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", FORMATS)
def test_images_without_detections_are_kept(tmp_path, suffix):
    path = tmp_path / f"preds.{suffix}"
    write_predictions(path, Predictions.from_detections([Detections.none()] * 3, [4, 2, 9]))
    q = read_predictions(path)
    assert sorted(q.image_id.tolist()) == [2, 4, 9]
    assert q.offsets.tolist() == [0, 0, 0, 0]


FINITE = st.floats(allow_nan=False, allow_infinity=False)


@given(st.dictionaries(st.integers(0, 2**53), st.lists(st.tuples(FINITE, FINITE, FINITE, st.integers(0, 2**40)))))
@settings(max_examples=25, deadline=None)
def test_any_finite_numbers_survive_all_formats(tmp_path_factory, images):
    folder = tmp_path_factory.mktemp("any")
    p = Predictions.from_detections(
        [Detections([r[:2] for r in d], [r[2] for r in d], [r[3] for r in d]) for d in images.values()], list(images)
    )
    expected = {i: d[:2] for i, d in as_dict(p).items()}
    for suffix in FORMATS:
        write_predictions(folder / f"p.{suffix}", p)
        q = read_predictions(folder / f"p.{suffix}")
        assert {i: d[:2] for i, d in as_dict(q).items()} == expected
        if len(p.xy):
            assert as_dict(q) == as_dict(p)


def test_the_documented_json_is_read(tmp_path):
    path = tmp_path / "p.json"
    path.write_text(
        '{"schema": "kpbench.predictions/1", "dataset": "d", "detector": {"name": "n"}, "predictions": ['
        '{"image_id": 0, "keypoints": [[1, 2.5], [3, 4]], "scores": [1, 0.5], "ids": [0, 3]}, '
        '{"image_id": 1, "keypoints": []}]}'
    )
    p = read_predictions(path)
    assert as_dict(p) == {0: ([[1, 2.5], [3, 4]], [1, 0.5], [0, 3]), 1: ([], [], [])}
    assert (p.dataset, p.detector) == ("d", {"name": "n"})


def test_scores_and_ids_may_be_left_out(tmp_path):
    path = tmp_path / "p.json"
    path.write_text(json.dumps({**HEADER, "predictions": [{"image_id": 3, "keypoints": [[1, 2]]}]}))
    assert as_dict(read_predictions(path)) == {3: ([[1, 2]], [1], None)}
    path = tmp_path / "p.csv"
    path.write_text("y,image_id,x\n1,3,2\n5,1,4\n7,3,6\n")  # columns and images in any order
    assert as_dict(read_predictions(path)) == {1: ([[4, 5]], [1], None), 3: ([[2, 1], [6, 7]], [1, 1], None)}


def test_csv_from_a_spreadsheet(tmp_path):
    path = tmp_path / "p.CSV"
    path.write_bytes("\ufeffimage_id,x,y,score,id\r\n0,1,2,0.5,3\r\n7,,,,\r\n".encode())
    assert as_dict(read_predictions(path)) == {0: ([[1, 2]], [0.5], [3]), 7: ([], [], [])}


def test_h5_and_parquet_of_other_makers_and_types(tmp_path):
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file["image_id"], file["offsets"] = np.array([4, 5], "u2"), np.array([0, 1, 2], "i4")
        file["xy"] = np.array([[1, 2], [3, 4]], "f4")
    assert as_dict(read_predictions(tmp_path / "p.h5")) == {4: ([[1, 2]], [1], None), 5: ([[3, 4]], [1], None)}
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"image_id": np.array([5, 4], "i2"), "x": np.array([3, 1], "f4"), "y": [4, 2]})
    frame.to_parquet(tmp_path / "p.parquet")
    assert as_dict(read_predictions(tmp_path / "p.parquet")) == {4: ([[1, 2]], [1], None), 5: ([[3, 4]], [1], None)}


def test_detections_in_and_out():
    listed = [Detections([[1, 2]], [0.5], [3]), Detections.none(False), Detections([[3, 4], [5, 6]], [1, 0], [0, 1])]
    p = Predictions.from_detections(listed)
    assert p.image_id.tolist() == [0, 1, 2]
    for a, b in zip(p.detections(), listed, strict=True):
        assert a.xy.tolist() == b.xy.tolist()
        assert a.score.tolist() == b.score.tolist()
    with pytest.raises(PredictionsError, match="some images have ids and others have none"):
        Predictions.from_detections([*listed, Detections([[1, 2]], [0.5])])
    assert Predictions.from_detections([Detections([[1, 2]], [0.5])]).patch_id is None


# --- bad input: one line that says where ------------------------------------------------------------------------


def record(n=12, **change):
    good = {"image_id": n, "keypoints": [[1.0, 2.0], [3.0, 4.0]], "scores": [0.5, 0.25], "ids": [0, 1]}
    return {k: v for k, v in {**good, **change}.items() if v is not ...}


NAN, INF = float("nan"), float("inf")
BAD_RECORDS = [
    (record(keypoints=[[1, 2], [NAN, 4.0]]), "(image_id 12): keypoints[1] is [nan, 4.0], expected two finite numbers"),
    (record(keypoints=[[1, 2], [3, -INF]]), "(image_id 12): keypoints[1] is [3.0, -inf], expected two finite numbers"),
    (record(keypoints=[[1, 2], [3]]), "(image_id 12): keypoints[1] is [3], expected two finite numbers"),
    (record(keypoints=[[1, 2], [3, 4, 5]]), "(image_id 12): keypoints[1] is [3, 4, 5], expected two finite numbers"),
    (record(keypoints=[[1, 2], 3]), "(image_id 12): keypoints[1] is 3, expected two finite numbers"),
    (record(keypoints=[[1, 2], "ab"]), "(image_id 12): keypoints[1] is 'ab', expected two finite numbers"),
    (record(keypoints=[[1, None], [3, 4]]), "(image_id 12): keypoints[0] is [1, None], expected two finite numbers"),
    (record(keypoints=[[1, True], [3, 4]]), "(image_id 12): keypoints[0] is [1, True], expected two finite numbers"),
    (record(keypoints=[["1", "2"], [3, 4]]), "(image_id 12): keypoints[0] is ['1', '2'], expected two finite numbers"),
    (record(keypoints=[[1, 10**400], [3, 4]]), "(image_id 12): keypoints[0] is [1, 1000"),
    (record(keypoints=5), "(image_id 12): keypoints is 5, expected a list"),
    (record(keypoints=...), "(image_id 12): no keypoints, expected a list"),
    (record(scores=[1]), "(image_id 12): scores has 1 values, expected one for each of 2 keypoints"),
    (record(scores=[1, NAN]), "(image_id 12): scores[1] is nan, expected a finite number"),
    (record(scores=[1, "high"]), "(image_id 12): scores[1] is 'high', expected a finite number"),
    (record(scores=0.5), "(image_id 12): scores is 0.5, expected a list"),
    (record(scores=...), "(image_id 12): no scores, which other images have"),
    (record(ids=[0, 1, 2]), "(image_id 12): ids has 3 values, expected one for each of 2 keypoints"),
    (record(ids=[0, -1]), "(image_id 12): ids[1] is -1, expected a patch id, 0 or more"),
    (record(ids=[0, 1.5]), "(image_id 12): ids[1] is 1.5, expected a patch id, 0 or more"),
    (record(ids=[0, 2**63]), "(image_id 12): ids[1] is 9223372036854775808, expected a patch id, 0 or more"),
    (record(ids=None), "(image_id 12): no ids, which other images have"),
    (record(image_id=7), "(image_id 7): the image occurs twice, first at 0"),
    (record(image_id=-1), "(image_id -1): image_id is negative, expected 0 or more"),
    (record(image_id=2**63), f"(image_id {2**63}): image_id is {2**63}, expected a whole number of 64 bits"),
    (record(image_id="12"), "(image_id '12'): image_id is '12', expected a whole number"),
    (record(image_id=...), ": no image_id, expected a whole number"),
    (
        record(labels=[1, 2]),
        "(image_id 12): unknown key 'labels', expected A_patch2image, blur_px, board, covariance, file, frame_index",
    ),
    ([1, 2], " is a list, expected an object"),
]


@pytest.mark.parametrize(("bad", "problem"), BAD_RECORDS, ids=range(len(BAD_RECORDS)))
def test_a_bad_record_is_named(tmp_path, bad, problem):
    records = [record(7), bad, record(20)]
    path = tmp_path / "preds.json"
    path.write_text(json.dumps({**HEADER, "predictions": records}))
    with pytest.raises(PredictionsError) as error:
        read_predictions(path)
    gap = " " if problem.startswith("(") else ""
    assert str(error.value).startswith(f"{path}: predictions[1]{gap}{problem}")
    assert "\n" not in str(error.value)
    path = tmp_path / "preds.jsonl"
    path.write_text("\n".join(map(json.dumps, [HEADER, *records])))
    with pytest.raises(PredictionsError) as error:
        read_predictions(path)
    assert str(error.value).startswith(f"{path}: line 3{gap}{problem}")


BAD_FILES = [
    ("p.json", b"", "the file is empty"),
    ("p.csv", b"", "the file is empty"),
    ("p.json", json.dumps({**HEADER, "predictions": [record()]})[:-9].encode(), "the file is cut off or no JSON"),
    ("p.json", b"\x89PNG\r\n", "the file is cut off or no JSON"),
    ("p.json", b"[" * 100_000, "the file is cut off or no JSON"),
    ("p.json", b"3", "holds a number, expected an object with schema 'kpbench.predictions/2'"),
    ("p.json", b"[3]", "results[0] is a number, expected an object"),
    (
        "p.json",
        b'[{"image_id": 1, "category_id": 0, "keypoints": [1, 2, 2], "score": 1}]',
        "results[0] (image_id 1): category_id is 0, expected a whole number from 1",
    ),
    (
        "p.json",
        b'[{"image_id": 1, "category_id": 1, "keypoints": [1, 2], "score": 1}]',
        "results[0] (image_id 1): keypoints is [1, 2], expected one keypoint [x, y, v] of numbers",
    ),
    (
        "p.json",
        b'[{"image_id": 1, "category_id": 1, "keypoints": [1, 2, 2]}]',
        "results[0] (image_id 1): no score, expected a finite number",
    ),
    (
        "p.json",
        b'[{"image_id": 1, "category_id": 1, "keypoints": [1, NaN, 2], "score": 1}]',
        "results[0] (image_id 1): y is blank, expected a finite number",
    ),
    ("p.json", b"{}", "schema is missing, expected 'kpbench.predictions/2'"),
    ("p.json", b'{"schema": "coco"}', "schema is 'coco', expected 'kpbench.predictions/2'"),
    ("p.json", json.dumps(HEADER).encode(), "predictions is missing or null, expected a list"),
    ("p.json", json.dumps({**HEADER, "model": 1, "predictions": []}).encode(), "unknown key 'model', expected boards"),
    ("p.json", json.dumps({**HEADER, "dataset": 1, "predictions": []}).encode(), "dataset is a number, expected"),
    ("p.json", json.dumps({**HEADER, "detector": "x", "predictions": []}).encode(), "detector is a text, expected an"),
    ("p.jsonl", json.dumps(record()).encode(), "schema is missing"),
    ("p.jsonl", json.dumps(HEADER).encode() + b'\n{"image_id": 0, "keyp', "line 2 is cut off or no JSON"),
    ("p.txt", b"x", "unknown kind of predictions file, expected .json, .jsonl, .csv, .parquet or .h5"),
    ("p.csv", b"image_id,u,v\n1,2,3\n", "line 1 has columns image_id,u,v, expected image_id,x,y,score,id"),
    ("p.csv", b"image_id,x,y,x\n1,2,3,4\n", "line 1 has columns image_id,x,y,x, expected"),
    ("p.csv", b"1,2,3\n", "line 1 has columns 1,2,3, expected image_id,x,y"),
    ("p.csv", b"# {\"schema\": \"x\"}\nimage_id,x,y\n", "schema is 'x', expected"),
    ("p.csv", b"# note\nimage_id,x,y\n", "line 1, after #, is cut off or no JSON"),
    ("p.csv", b"image_id,x,y\n1,2,3\n1,two,3\n", "line 3: x is 'two', expected a finite number"),
    ("p.csv", b"image_id,x,y\n1,2,3\n1.5,2,3\n", "line 3: image_id is '1.5', expected a whole number"),
    ("p.csv", b"image_id,x,y\n,2,3\n", "line 2: image_id is '', expected a whole number"),
    ("p.csv", b"image_id,x,y\n9223372036854775808,2,3\n", "line 2: image_id is '9223372036854775808', expected"),
    ("p.csv", b"image_id,x,y\n-4,2,3\n", "line 2: image_id is -4, expected 0 or more"),
    ("p.csv", b"image_id,x,y\n1,2,3\n1,2,3,4\n", "line 3 has 4 values, expected 3"),
    ("p.csv", b"image_id,x,y\n1,2,3\n1,2\n", "line 3 has 2 values, expected 3"),
    ("p.csv", b"image_id,x,y\n1,2,3\n\n1,2,3\n", "line 3 has 0 values, expected 3"),
    ("p.csv", b"image_id,x,y\n1,inf,3\n", "line 2 (image_id 1): x is inf, expected a finite number"),
    ("p.csv", b"image_id,x,y,score\n1,nan,3,1\n", "line 2: x is 'nan', expected a finite number"),
    ("p.csv", b"image_id,x,y,id\n1,2,3,-1\n", "line 2 (image_id 1): id is -1.0, expected a patch id, a whole number"),
    ("p.csv", b"image_id,x,y,id\n1,2,3,\n", "line 2 (image_id 1): id is blank, expected a patch id, a whole number"),
    ("p.csv", b"# {\"schema\": \"kpbench.predictions/1\"}\nimage_id,x,y\n1,a,2\n", "line 3: x is 'a'"),
    ("p.parquet", b"PAR1 and no more", "damaged or no Parquet file ("),
    ("p.h5", b"\x89HDF\r\n\x1a\n and no more", "damaged or no HDF5 file ("),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "problem"), BAD_FILES, ids=range(len(BAD_FILES)))
def test_a_bad_file_is_one_line(tmp_path, name, content, problem):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(PredictionsError) as error:
        read_predictions(path)
    assert str(error.value).startswith(f"{path}: {problem}")
    assert "\n" not in str(error.value)
    assert gc.isenabled()  # paused while reading


@pytest.mark.filterwarnings("ignore:.*it may be cut off:kpbench.errors.KpbenchWarning")
@pytest.mark.parametrize("suffix", FORMATS)
def test_every_cut_of_a_file_is_refused(tmp_path, suffix):
    whole, cut = tmp_path / f"whole.{suffix}", tmp_path / f"cut.{suffix}"
    p = some(6)
    write_predictions(whole, p)
    data = whole.read_bytes()
    lengths = {1, len(data) // 3, len(data) // 2, len(data) - len(data) // 10}
    for n in lengths:
        cut.write_bytes(data[:n])
        try:
            q = read_predictions(cut)
        except PredictionsError:
            continue
        # formats of lines cannot tell that lines are gone; the score command then misses images
        assert suffix in ("csv", "jsonl")
        assert len(q.xy) < len(p.xy)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_that_is_not_there(tmp_path, suffix):
    path = tmp_path / f"none.{suffix}"
    with pytest.raises(PredictionsError, match=r"none\.\w+: cannot be read, No such file"):
        read_predictions(path)
    path.mkdir()
    with pytest.raises(PredictionsError, match="cannot be read"):
        read_predictions(path)


def bad_h5(path, change):
    write_predictions(path, some())
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def elsewhere(file):
    del file["xy"]
    file["xy"] = h5py.ExternalLink("/etc/hostname", "/x")


def virtual(file):
    shape = file["xy"].shape
    del file["xy"]
    layout = h5py.VirtualLayout(shape, "f8")
    layout[...] = h5py.VirtualSource("other.h5", "xy", shape)
    file.create_virtual_dataset("xy", layout)


def external(file):
    shape = file["xy"].shape
    del file["xy"]
    file.create_dataset("xy", shape, "f8", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])


def bomb(file):
    del file["score"]
    file.create_dataset("score", (10**12,), "f8", chunks=(10**6,), compression="gzip")


def renamed(file):
    file["scores"] = file["score"]


def text(file):
    del file["score"]
    file["score"] = ["a"] * len(file["xy"])


def broken_offsets(file):
    file["offsets"][-1] += 1


def schema(file):
    file.attrs["header"] = '{"schema": "other"}'


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (elsewhere, "/xy is missing or a link to elsewhere"),
        (virtual, "/xy is not plain data stored in this file"),
        (external, "/xy is not plain data stored in this file"),
        (bomb, "/score declares 8000000000000 bytes, the file holds 0 for it"),
        (renamed, "unknown dataset /scores, expected image_id, offsets, xy, score, id"),
        (text, "/score is object of shape"),
        (broken_offsets, "offsets do not run from 0 to"),
        (schema, "schema is 'other', expected"),
        (lambda file: file.pop("offsets"), "/offsets is missing or a link to elsewhere"),
    ],
)
def test_h5_that_lies_is_refused(tmp_path, change, problem):
    path = bad_h5(tmp_path / "p.h5", change)
    with pytest.raises(PredictionsError) as error:
        read_predictions(path)
    assert str(error.value).startswith(f"{path}: {problem}")


def test_parquet_with_text_or_nulls(tmp_path):
    pandas = pytest.importorskip("pandas")
    path = tmp_path / "p.parquet"
    pandas.DataFrame({"image_id": [1], "x": ["a"], "y": [2.0]}).to_parquet(path)
    with pytest.raises(PredictionsError, match="column x holds no plain numbers"):
        read_predictions(path)
    pandas.DataFrame({"image_id": pandas.array([1, None], "Int64"), "x": [1.0, 2], "y": [2.0, 3]}).to_parquet(path)
    with pytest.raises(PredictionsError, match="column image_id holds no plain numbers"):
        read_predictions(path)
    pandas.DataFrame({"image_id": [1, 1], "x": [1.0, 2], "y": [2.0, None]}).to_parquet(path)
    with pytest.raises(PredictionsError, match=r"row 1 \(image_id 1\): y is blank"):
        read_predictions(path)


def test_without_pyarrow_the_pip_line_is_shown(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (tmp_path / "p.parquet").write_bytes(b"PAR1")
    with pytest.raises(PredictionsError, match=r"p\.parquet: Parquet needs pyarrow: pip install pyarrow$"):
        read_predictions(tmp_path / "p.parquet")
    with pytest.raises(PredictionsError, match=r"pip install pyarrow$"):
        write_predictions(tmp_path / "q.parquet", some())


def test_arrays_that_do_not_fit_each_other():
    with pytest.raises(PredictionsError, match="offsets do not run from 0 to 1 keypoints in 1 images"):
        Predictions([0], [0, 2], [[1, 2]], [1])
    with pytest.raises(PredictionsError, match="1 keypoints, 2 scores and 1 ids"):
        Predictions([0], [0, 1], [[1, 2]], [1, 2], [0])


# --- writing ----------------------------------------------------------------------------------------------------


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "p.json"
    write_predictions(path, some())
    before = path.read_bytes()
    broken = some(7)
    object.__setattr__(broken, "detector", {"name": object()})
    with pytest.raises(TypeError):
        write_predictions(path, broken)
    assert path.read_bytes() == before
    assert [f.name for f in tmp_path.iterdir()] == ["p.json"]
    with pytest.raises(PredictionsError, match=r"p\.xml: unknown kind of predictions file"):
        write_predictions(tmp_path / "p.xml", some())
    with pytest.raises(DataError, match="cannot be written"):
        write_predictions(tmp_path / "none" / "p.json", some())


def test_the_json_is_what_the_schema_says(tmp_path):
    path = tmp_path / "p.json"
    p = some(4)
    write_predictions(path, p)
    content = json.loads(path.read_text())
    assert list(content) == ["schema", "dataset", "fingerprint", "detector", "predictions"]
    assert content["schema"] == "kpbench.predictions/2"
    for n, (entry, d) in enumerate(zip(content["predictions"], p.detections(), strict=True)):
        assert entry == {
            "image_id": int(p.image_id[n]),
            "keypoints": d.xy.tolist(),
            "scores": d.score.tolist(),
            "ids": d.patch_id.tolist(),
        }


# --- large files, COCO, the schema -------------------------------------------------------------------------------


def test_a_file_read_in_pieces_is_the_file_read_whole(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    counts = rng.integers(0, 4, 60)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    k = offsets[-1]
    p = Predictions(
        np.arange(60), offsets, rng.normal(size=(k, 2)), rng.random(k), rng.integers(0, 4, k), {"a": "}, {"}
    )
    for name in ("p.json", "p.jsonl"):
        write_predictions(tmp_path / name, p)
        whole = read_predictions(tmp_path / name)
        for size in (1, 50, 400):
            for module in (decode, json_files):
                monkeypatch.setattr(module, "PIECE_BYTES", size)
            cut = read_predictions(tmp_path / name)
            for field in ("image_id", "offsets", "xy", "score", "patch_id"):
                np.testing.assert_array_equal(getattr(cut, field), getattr(whole, field))
            assert cut.detector == {"a": "}, {"}
            monkeypatch.undo()


RECORD = '{"image_id": %d, "keypoints": [[1, 2]], "scores": [1], "ids": [0]}'


@pytest.mark.parametrize(
    ("records", "problem"),
    [
        (f"{RECORD % 0} {RECORD % 1}", "cut off or no JSON"),
        (f"{RECORD % 0},, {RECORD % 1}", "cut off or no JSON"),
        (f"{RECORD % 0}, {RECORD % 1},", "cut off or no JSON"),
        (f"{RECORD % 0}, {RECORD % 0}", r"predictions[1] (image_id 0): the image occurs twice, first at 0"),
        (f"{RECORD % 0}, {RECORD % 1}".replace("1, 2", "1, NaN", 1), "keypoints[0] is [1.0, nan]"),
        (f'{RECORD % 0}, {{"image_id": 1, "keypoints": [[1, 2]]}}', "predictions[1] (image_id 1): no scores, which"),
        (f'{RECORD % 0}, {{"image_id": 1, "keypoints": []}}, 7', "predictions[2] is a number, expected an object"),
    ],
)
@pytest.mark.parametrize("size", [1, 10**6])
def test_pieces_complain_as_the_whole_does(tmp_path, monkeypatch, records, problem, size):
    monkeypatch.setattr(decode, "PIECE_BYTES", size)
    path = tmp_path / "p.json"
    path.write_text(f'{{"schema": "kpbench.predictions/1", "predictions": [{records}]}}')
    with pytest.raises(PredictionsError) as error:
        read_predictions(path)
    assert problem in str(error.value)


def test_what_looks_like_the_list_inside_a_text_is_not_taken_for_it(tmp_path, monkeypatch):
    monkeypatch.setattr(decode, "PIECE_BYTES", 1)
    path = tmp_path / "p.json"
    content = {
        "schema": "kpbench.predictions/1",
        "detector": {"note": '"predictions": [', "predictions": [1]},
        "predictions": [{"image_id": 4, "keypoints": []}],
    }
    path.write_text(json.dumps(content))
    assert read_predictions(path).image_id.tolist() == [4]


def test_coco_results_are_predictions(tmp_path):
    path = tmp_path / "results.json"
    entries = [
        {"image_id": 7, "category_id": 1, "keypoints": [10.25, 20, 2], "score": 0.5},
        {"image_id": 3, "category_id": 4, "keypoints": [1, 2, 0], "score": 1, "bbox": [0, 0, 1, 1]},
        {"image_id": 7, "category_id": 2, "keypoints": [3, 4, 1], "score": 0.25},
    ]
    path.write_text(json.dumps(entries))
    p = read_predictions(path)
    assert p.image_id.tolist() == [3, 7]
    assert p.offsets.tolist() == [0, 1, 3]
    assert p.xy.tolist() == [[1, 2], [10.25, 20], [3, 4]]
    assert p.score.tolist() == [1, 0.5, 0.25]
    assert p.patch_id.tolist() == [3, 0, 1]
    path.write_text("[]")
    assert len(read_predictions(path)) == 0


ROOT = Path(__file__).parents[2]


def test_the_published_schema_says_what_the_reader_says(tmp_path):
    schema = json.loads((ROOT / "docs" / "schemas" / "predictions-2.json").read_text())
    validator = jsonschema.Draft202012Validator(schema)
    validator.check_schema(schema)
    full = Detections([[1.5, 2]], [0.5], [3], [np.eye(2)], [np.eye(2)], [1.0])
    of_images = {"file": ("a", ""), "size": [[3, 4], [0, 0]], "frame_index": [0, -1], "ms": [1.5, np.nan]}
    about = {"detector": {"name": "mine"}, "dataset": "d", "fingerprint": "f" * 64}
    p = Predictions.from_detections([full, Detections.none()], **about, **of_images)
    write_predictions(tmp_path / "p.json", p)
    assert not list(validator.iter_errors(json.loads((tmp_path / "p.json").read_text())))
    good = {"image_id": 0, "keypoints": [[1, 2]], "scores": [1], "ids": [0]}
    changes = [
        {}, {"ids": None}, {"image_id": -1}, {"image_id": 1.5}, {"keypoints": [[1, 2, 3]]}, {"keypoints": [["1", 2]]},
        {"scores": ["1"]}, {"ids": [-1]}, {"ids": [0.5]}, {"score": [1]}, {"keypoints": None},
        {"covariance": [[[1, 0], [0, 1]]]}, {"covariance": [[1, 0]]}, {"blur_px": [-1]}, {"blur_px": [0]},
        {"A_patch2image": [[[1, 0], [0]]]}, {"file": "a"}, {"file": 1}, {"size": [3, 4]}, {"size": [3]},
        {"size": [0, 4]}, {"size": [3.5, 4]}, {"frame_index": -1}, {"frame_index": None}, {"time_s": -1}, {"ms": -1},
    ]  # fmt: skip
    for change in changes:
        content = {"schema": "kpbench.predictions/2", "predictions": [good | change]}
        (tmp_path / "q.json").write_text(json.dumps(content))
        try:
            read_predictions(tmp_path / "q.json")
            read = True
        except PredictionsError:
            read = False
        assert validator.is_valid(content) == read, change


def test_a_header_of_fixed_length_is_read(tmp_path):
    path = tmp_path / "p.h5"
    write_predictions(path, some())
    with h5py.File(path, "r+") as file:
        text = str(file.attrs["header"])
        del file.attrs["header"]
        file.attrs["header"] = np.bytes_(text.encode())
    assert read_predictions(path).detector == some().detector


def test_blank_lines_at_the_end_of_a_csv_are_left_out(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("image_id,x,y\n0,1,2\n1,,\n\n \n")
    assert read_predictions(path).xy.tolist() == [[1.0, 2.0]]
    path.write_text("image_id,x,y\n0,1,2\n\n1,,\n")
    with pytest.raises(PredictionsError, match="line 3 has 0 values, expected 3"):
        read_predictions(path)


# --- Long lists in pieces ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 30, 10**6])
@pytest.mark.parametrize("indent", [None, 1])
@pytest.mark.parametrize("names", [("one", "two"), ("two", "one")])
def test_long_lists_are_split_in_any_order(monkeypatch, size, indent, names):
    monkeypatch.setattr(decode, "PIECE_BYTES", size)
    lists = {"one": [{"a": 1}, {"b": {"c": [2]}, "d": "x"}, {}], "two": [{"image_id": 3, "l": [[]]}]}
    rest = {"first": [], "middle": [{"x": 1}], "last": "]"}
    content = {"first": [], names[0]: lists[names[0]], "middle": [{"x": 1}], names[1]: lists[names[1]], "last": "]"}
    frame, found = decode.split_lists(json.dumps(content, indent=indent).encode(), "one", "two")
    assert [[r for piece in pieces for r in json.loads(piece)] for pieces in found] == list(lists.values())
    assert frame == rest


@pytest.mark.parametrize(
    "text",
    [
        b'{"x": {"one": [{"a": 1}]}, "one": []}',
        b'{"x": {"one": [{"a": 1}]}, "one": [{"a": 2}]}',
        b'{"one": [{"a": 1}], "one": [{"a": 2}]}',
        b'{"one": [{"a": [{"b": 1}]}]}',
        b'{"one": [{"s": "}]"}]}',
        b'{"one": [{"s": "}, {"}]}',
        b'{"one": [{"a": 1}\f,{"a": 2}]}',
        b'{"one": [{"a": 1}\f]}',
        b'{"one": [{"a": 1}]]}',
        b'{"one": [{"a": 1}',
        b'[{"a": 1}]',
        b'{"one": []}',
    ],
)
def test_a_list_that_is_elsewhere_or_cannot_be_split_is_never_taken(monkeypatch, text):
    monkeypatch.setattr(decode, "PIECE_BYTES", 1)

    def read():
        _, [pieces] = decode.split_lists(text, "one")
        return [json.loads(piece) for piece in pieces]

    with pytest.raises(ValueError):
        read()
