import os
import pickle

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kpbench.dataset import folder
from kpbench.dataset.folder import ShardEntry, make_manifest, open_dataset, write_manifest
from kpbench.dataset.shard import Sample, encode_shard, open_shard
from kpbench.errors import DataError
from kpbench.files import sha256_of
from kpbench.types import KEYPOINT_DTYPE
from kpbench.writing import write_file

CONFIG = {"seed": 3, "kind": "test"}


def samples(count=4, first=0, shape=(40, 50)):
    rng = np.random.default_rng(first)
    for n in range(first, first + count):
        keypoints = np.zeros(n % 3, KEYPOINT_DTYPE)
        keypoints["x"] = rng.uniform(0, 50, len(keypoints))
        keypoints["patch_id"] = n % 4
        keypoints["H_patch2image"] = rng.normal(size=(len(keypoints), 3, 3))
        effects = [{"effect": "blur", "kernel_px": 3}]
        yield Sample(n, rng.integers(0, 256, shape, dtype=np.uint8), keypoints, effects, "a/ü.jpg", "blur", 3.0, n // 2)


def write_dataset(folder, counts=(4, 3), shape=(40, 50)):
    folder.mkdir(parents=True, exist_ok=True)
    entries, first = [], 0
    for k, count in enumerate(counts):
        data = encode_shard(samples(count, first, shape), count, CONFIG)
        path = folder / f"shard-{k:05d}.h5"
        write_file(path, data)
        entries.append(ShardEntry(path.name, first, count, len(data), sha256_of(path)))
        first += count
    write_manifest(folder, make_manifest(CONFIG, entries, {"versions": {}, "broken_backgrounds": []}))
    return folder


@pytest.mark.parametrize("shape", [(40, 50), (40, 50, 3)])
def test_what_is_written_is_read_back(tmp_path, shape):
    data = open_dataset(write_dataset(tmp_path / "set", shape=shape))
    expected = [*samples(4, 0, shape), *samples(3, 4, shape)]
    assert len(data) == 7
    for n, sample in enumerate(expected):
        image, keypoints = data[n]
        assert (image == sample.image).all()
        assert (keypoints == sample.keypoints).all()
        assert data.effects(n) == sample.effects
    truth = data.truth
    assert truth.image_id.tolist() == list(range(7))
    assert truth.scene_id.tolist() == [0, 0, 1, 1, 2, 2, 3]
    assert set(truth.condition) == {"blur"}
    assert truth.offsets.tolist() == [0, 0, 1, 3, 3, 4, 6, 6]
    assert (truth.keypoints == np.concatenate([s.keypoints for s in expected])).all()
    assert len(list(data.verify())) == 2
    with pytest.raises(IndexError):
        data.image(7)


def test_stock_h5py_reads_a_shard_without_kpbench(tmp_path):
    folder = write_dataset(tmp_path / "set")
    with h5py.File(folder / "shard-00000.h5") as file:
        assert file["images"].compression == "gzip"
        assert file["images"].chunks == (1, 40, 50)
        assert (file["images"][2] == list(samples(4))[2].image).all()
        assert file["keypoints"]["x"].dtype == np.float64


def test_the_same_samples_give_the_same_bytes():
    assert encode_shard(samples(), 4, CONFIG) == encode_shard(samples(), 4, CONFIG)


def test_the_bytes_do_not_depend_on_when_objects_are_freed(monkeypatch):
    before, kept, create = encode_shard(samples(), 4, CONFIG), [], h5py.Group.create_dataset

    def create_and_keep(*arguments, **options):
        kept.append(create(*arguments, **options))
        return kept[-1]

    monkeypatch.setattr(h5py.Group, "create_dataset", create_and_keep)
    assert encode_shard(samples(), 4, CONFIG) == before


def test_a_dataset_survives_pickling_and_forking(tmp_path):
    data = open_dataset(write_dataset(tmp_path / "set"))
    expected = data.image(5)
    assert (pickle.loads(pickle.dumps(data)).image(5) == expected).all()
    child = os.fork()
    if child == 0:
        os._exit(0 if (data.image(5) == expected).all() else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("whole") / "set", (4,))


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_a_flipped_byte_is_found_by_verify_and_never_crashes_a_reader(whole, tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("flipped")
    original = (whole / "shard-00000.h5").read_bytes()
    place = data.draw(st.integers(0, len(original) - 1))
    damaged = bytearray(original)
    damaged[place] ^= 1 << data.draw(st.integers(0, 7))
    (folder / "shard-00000.h5").write_bytes(damaged)
    (folder / "dataset.json").write_bytes((whole / "dataset.json").read_bytes())
    broken = open_dataset(folder)
    with pytest.raises(DataError, match=r"shard-00000\.h5: damaged, SHA-256"):
        list(broken.verify())
    sound = open_dataset(whole)
    error = None
    try:  # without verify: either one clear line, or the right content (an unused byte), never wrong truth
        same = (broken.truth.keypoints == sound.truth.keypoints).all()
        same &= (broken.truth.offsets == sound.truth.offsets).all()
        same &= all((broken.image(n) == sound.image(n)).all() for n in range(len(sound)))
    except DataError as caught:
        error = str(caught)
    assert same if error is None else "shard-00000.h5" in error and "\n" not in error


@pytest.mark.parametrize("keep", [0, 1, 100, 5000, -1])
def test_a_truncated_shard_is_refused(whole, tmp_path, keep):
    original = (whole / "shard-00000.h5").read_bytes()
    (tmp_path / "shard-00000.h5").write_bytes(original[:keep])
    (tmp_path / "dataset.json").write_bytes((whole / "dataset.json").read_bytes())
    with pytest.raises(DataError, match=r"damaged, has \d+ bytes, expected"):
        open_dataset(tmp_path)
    with pytest.raises(DataError, match="damaged or no kpbench shard"):
        open_shard(tmp_path / "shard-00000.h5")


def test_a_shard_that_reaches_outside_itself_is_refused(tmp_path, whole):
    secret = tmp_path / "secret.bin"
    secret.write_bytes(bytes(range(256)) * 100)

    def replaced(name, make):
        path = tmp_path / f"{name}.h5"
        path.write_bytes((whole / "shard-00000.h5").read_bytes())
        with h5py.File(path, "a") as file:
            del file["images"]
            make(file)
        with pytest.raises(DataError) as caught:
            open_shard(path)
        return str(caught.value)

    shape = (4, 40, 50)
    external = [(str(secret), 0, 8000)]
    assert "not plain data stored in this file" in replaced(
        "external", lambda f: f.create_dataset("images", shape, "u1", external=external)
    )
    layout = h5py.VirtualLayout(shape, "u1")
    layout[:] = h5py.VirtualSource(str(whole / "shard-00000.h5"), "images", shape)
    assert "not plain data stored in this file" in replaced(
        "virtual", lambda f: f.create_virtual_dataset("images", layout)
    )

    def link(file):
        file["images"] = h5py.ExternalLink(str(whole / "shard-00000.h5"), "/images")

    assert "a link to elsewhere" in replaced("link", link)
    assert "/images has 0 chunks, expected 40000" in replaced(
        "huge", lambda f: f.create_dataset("images", (4, 500000, 500000), "u1", chunks=(1, 5000, 5000), compression=1)
    )
    assert "filters number 32000, expected at most gzip, each once" in replaced(
        "filter", lambda f: f.create_dataset("images", shape, "u1", chunks=shape, compression="lzf")
    )


def test_nothing_is_kept_in_the_heap_of_variable_length_data(whole):
    # it has no checksum: HDF5 was seen to loop for ever over one that had a flipped bit
    data = (whole / "shard-00000.h5").read_bytes()
    assert b"OHDR" in data  # object headers with checksums
    assert b"GCOL" not in data


def test_an_atomic_write_leaves_the_old_file_or_the_new_one(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_file(path, b"% kpbench.report/1\n old")
    monkeypatch.setattr(os, "fsync", lambda fd: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(DataError, match="the disk is full"):
        write_file(path, b"% kpbench.report/1\n new")
    assert path.read_bytes() == b"% kpbench.report/1\n old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda f: (f / "dataset.json").unlink(), "an unfinished dataset (no dataset.json)"),
        (lambda f: (f / "shard-00001.h5").unlink(), "shard-00001.h5: missing, listed in dataset.json"),
        (lambda f: (f / "dataset.json").write_text("{"), "dataset.json: not a dataset manifest"),
        (lambda f: (f / "dataset.json").write_text("{}"), "dataset.json: not a dataset manifest"),
        (lambda f: (f / "dataset.json").write_text('{"schema": "other"}'), "schema is 'other'"),
    ],
)
def test_a_damaged_folder_is_one_line(tmp_path, damage, says):
    folder = write_dataset(tmp_path / "set")
    damage(folder)
    with pytest.raises(DataError) as caught:
        open_dataset(folder)
    assert says in str(caught.value)


def test_a_missing_folder_says_how_to_make_one(tmp_path):
    with pytest.raises(DataError, match="no dataset there"):
        open_dataset(tmp_path / "nowhere")


def test_many_shards_need_few_open_files(tmp_path, monkeypatch):
    monkeypatch.setattr(folder, "MOST_OPEN_SHARDS", 2)
    data = open_dataset(write_dataset(tmp_path / "set", counts=(2, 2, 2, 2, 2)))
    assert data.truth.image_id.tolist() == list(range(10))
    expected = [sample for first in range(0, 10, 2) for sample in samples(2, first)]
    for n in (9, 0, 5, 1, 8):
        assert (data.image(n) == expected[n].image).all()
        assert len(data._files) <= 2
