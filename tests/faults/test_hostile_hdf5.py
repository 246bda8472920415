"""HDF5 files made to crash, hang or flood a reader are refused in one line: predictions and shards alike."""

import os
import shutil
import signal
import time
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest

import kpbench
from kpbench import hdf5
from kpbench.dataset.shard import open_shard
from kpbench.errors import DataError, PredictionsError

CASES = Path(__file__).parent / "cases"


def predictions(path):
    found = kpbench.Detections([[1.0, 2.0], [3.0, 4.0]], [0.5, 0.25], [0, 1])
    kpbench.write_predictions(path, kpbench.Predictions.from_detections([found, found]))
    return path


@pytest.fixture
def files(tmp_path, dataset):
    """A predictions file and a shard, and for each the function that reads the file."""
    shutil.copy(dataset.path / "shard-00000.h5", tmp_path / "shard.h5")
    return {
        "predictions": (predictions(tmp_path / "p.h5"), kpbench.read_predictions, "score", "header"),
        "shard": (tmp_path / "shard.h5", lambda path: open_shard(path).close(), "rung", "config"),
    }


def refused(path, read):
    with pytest.raises((DataError, PredictionsError)) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", ["preds-segv.h5", "preds-hang.h5"])
def test_a_heap_of_variable_length_text_that_crashes_or_hangs_the_library(name):
    started = time.process_time()
    refused(CASES / name, kpbench.read_predictions)
    assert time.process_time() - started < 2  # the time is that of the child process


@pytest.mark.parametrize("name", ["shard-hang.h5", "shard-bomb-27kB.h5", "shard-hang-on-open.h5"])
def test_a_shard_that_hangs_or_floods_the_library(name):
    refused(CASES / name, open_shard)


def soft(file, name):
    del file[name]
    file[name] = h5py.SoftLink("/xy")


def external_link(file, name):
    del file[name]
    file[name] = h5py.ExternalLink("/etc/hostname", "/x")


def group(file, name):
    del file[name]
    file.create_group(name)


def replaced(**options):
    def change(file, name):
        count = len(file[name])
        del file[name]
        file.create_dataset(name, **{"shape": (count,), "dtype": "<f8"} | options)

    return change


def deflate_twice(file, name):
    count = len(file[name])
    del file[name]
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((count,))
    plan.set_deflate(9)
    plan.set_deflate(9)
    h5py.h5d.create(file.id, name.encode(), h5py.h5t.IEEE_F64LE, h5py.h5s.create_simple((count,)), plan)
    file[name].id.write_direct_chunk((0,), zlib.compress(zlib.compress(bytes(8 * count))))


def large_chunk(file, name):
    """A chunk of 2 GB within a file of kilobytes."""
    replaced(chunks=(2**28,), maxshape=(None,), compression="gzip")(file, name)


def unpacked_chunk(file, name):
    count = len(file[name])
    replaced(chunks=(count,), fletcher32=True)(file, name)
    file[name].id.write_direct_chunk((0,), bytes(8 * count), filter_mask=1)


CHANGES = {
    "soft link": (soft, "missing or a link to elsewhere"),
    "external link": (external_link, "missing or a link to elsewhere"),
    "group": (group, "not plain data"),
    "text of variable length": (replaced(dtype=h5py.string_dtype()), "is object of shape"),
    "references": (replaced(dtype=h5py.ref_dtype), "is object of shape"),
    "enumeration": (replaced(dtype=h5py.enum_dtype({"a": 0})), "of shape"),
    "compound": (replaced(dtype=[("a", "<f8")]), "of shape"),
    "no dimension": (replaced(shape=()), "of shape ()"),
    "other filter": (replaced(chunks=(2,), compression="lzf"), "filters number 32000"),
    "deflate twice": (deflate_twice, "filters gzip, gzip"),
    "large chunk": (large_chunk, "chunks of 2147483648 bytes"),
    "more than stored": (replaced(shape=(10**9,), chunks=(1000,), fletcher32=True), "declares 8000000000 bytes"),
    "chunk without its filter": (unpacked_chunk, "a chunk that is not packed"),
}


@pytest.mark.parametrize("kind", ["predictions", "shard"])
@pytest.mark.parametrize("change", CHANGES)
def test_what_is_no_plain_data_is_refused(files, kind, change):
    path, read, column, _ = files[kind]
    with h5py.File(path, "r+") as file:
        CHANGES[change][0](file, column)
    message = refused(path, read)
    assert CHANGES[change][1] in message or "filters gzip, expected at most fletcher32" in message


@pytest.mark.parametrize("kind", ["predictions", "shard"])
def test_texts_of_odd_types_are_refused(files, kind):
    path, read, _, attribute = files[kind]
    for value in (np.zeros(3), [b"a", b"b"], h5py.Empty("S4"), np.bytes_(b"\xff\xfe"), 1.5):
        with h5py.File(path, "r+") as file:
            file.attrs[attribute] = value
        refused(path, read)


@pytest.mark.parametrize("kind", ["predictions", "shard"])
def test_a_file_of_many_objects_is_refused(files, kind):
    path, read, _, _ = files[kind]
    with h5py.File(path, "r+") as file:
        for n in range(100):
            file.create_group(f"g{n}")
    assert "objects, expected at most 64" in refused(path, read)


def test_a_header_of_variable_length_is_read(files):
    path = files["predictions"][0]
    with h5py.File(path, "r+") as file:
        file.attrs["header"] = '{"schema": "kpbench.predictions/1", "detector": {"name": "é"}}'
    assert kpbench.read_predictions(path).detector == {"name": "é"}


def test_an_image_chunk_that_holds_another_number_of_bytes_is_refused(tmp_path, dataset):
    for n, packed in enumerate((zlib.compress(bytes(10)), zlib.compress(bytes(10**6)), b"junk")):
        path = tmp_path / f"{n}.h5"
        shutil.copy(dataset.path / "shard-00000.h5", path)
        with h5py.File(path, "r+") as file:
            file["images"].id.write_direct_chunk((1, 0, 0), packed)
        shard = open_shard(path)
        assert shard.image(0).tobytes() == dataset.image(0).tobytes()
        with pytest.raises(ValueError, match="image 1"):
            shard.image(1)
        shard.close()


def test_a_shard_without_a_chunk_of_an_image_is_refused(tmp_path, dataset):
    path = tmp_path / "shard.h5"
    shutil.copy(dataset.path / "shard-00000.h5", path)
    with h5py.File(path, "r+") as file:
        shape, packed = file["images"].shape, file["images"].id.read_direct_chunk((0, 0, 0))[1]
        del file["images"]
        images = file.create_dataset("images", shape, "u1", chunks=(1, *shape[1:]), compression="gzip")
        for n in range(shape[0] - 1):
            images.id.write_direct_chunk((n, 0, 0), packed)
    assert "/images has 3 chunks, expected 4" in refused(path, open_shard)


def test_only_one_module_opens_hdf5_files_for_reading():
    package = Path(kpbench.__file__).parent
    for path in package.rglob("*.py"):
        if path.name != "hdf5.py":
            assert 'h5py.File(path, "r"' not in path.read_text()
            assert "h5py.File(path)" not in path.read_text()


def test_a_child_process_that_is_gone_is_started_anew(files):
    path = files["predictions"][0]
    kpbench.read_predictions(path)
    first = hdf5._child.process
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    assert len(kpbench.read_predictions(path)) == 2
    assert hdf5._child.process.pid != first.pid


def test_a_relative_path_and_a_name_that_is_no_utf8_are_read(here):
    name = os.fsdecode(b"\xff.h5")
    predictions(Path(name))
    assert len(kpbench.read_predictions(name)) == 2
