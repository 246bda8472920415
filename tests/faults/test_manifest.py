"""``kpbench verify`` covers every field of ``dataset.json``: a field that is changed is named."""

import json
import shutil

import h5py
import numpy as np
import pytest
from helpers import kpbench

from kpbench import open_dataset
from kpbench.dataset.folder import compute_fingerprint
from kpbench.errors import DataError
from kpbench.files import sha256_of


@pytest.fixture
def changed(tmp_path, dataset):
    """A function that copies the dataset, changes its manifest, and returns the one line that ``verify`` prints."""

    def change(how, refingerprint=False):
        folder = tmp_path / "set"
        shutil.copytree(dataset.path, folder)
        content = json.loads((folder / "dataset.json").read_text())
        how(content)
        if refingerprint:
            shards = [type(dataset.shards[0])(**shard) for shard in content["shards"]]
            content["fingerprint"] = compute_fingerprint(content["config"], shards)
        (folder / "dataset.json").write_text(json.dumps(content))
        [line] = kpbench("verify", folder, code=1).stderr.splitlines()
        assert line.startswith(f"kpbench: {folder / 'dataset.json'}: ")
        return line.split("dataset.json: ", 1)[1]

    return change


def entry(name, value, n=0):
    return lambda content: content["shards"][n].update({name: value})


CHANGES = [
    (lambda c: c.update(version=2), "version is 2, expected 1"),
    (lambda c: c.update(version=True), "version is True, expected 1"),
    (lambda c: c.update(version=1.0), "version is 1.0, expected 1"),
    (lambda c: c.pop("version"), "version is missing, expected 1"),
    (lambda c: c.update(seed=12), "seed is 12, expected 0"),
    (lambda c: c.update(seed="0"), "seed is '0', expected 0"),
    (lambda c: c.pop("seed"), "seed is missing, expected 0"),
    (lambda c: c.update(images=7), "images is 7, expected 6"),
    (lambda c: c.update(images=-1), "images is -1, expected 6"),
    (lambda c: c.update(images=10**30), f"images is {10**30}, expected 6"),
    (lambda c: c.pop("images"), "images is missing, expected 6"),
    (lambda c: c.update(fingerprint="0" * 64), "its fingerprint does not fit its config and shards"),
    (lambda c: c.update(fingerprint=3), "fingerprint is no text"),
    (lambda c: c["config"].update(seed=12), "seed is 0, expected 12"),
    (lambda c: c["config"].update(n=5), "its fingerprint does not fit"),
    (lambda c: c.update(config=[]), "config is no object"),
    (lambda c: c.update(provenance=[]), "provenance is no object, expected an object with versions and broken_backgr"),
    (lambda c: c.pop("provenance"), "provenance is missing, expected an object with versions and broken_backgrounds"),
    (lambda c: c["provenance"].clear(), "provenance has no keys, expected"),
    (lambda c: c["provenance"].pop("versions"), "provenance has broken_backgrounds, expected"),
    (lambda c: c["provenance"].pop("broken_backgrounds"), "provenance has versions, expected"),
    (lambda c: c["provenance"].update(more=1), "provenance has broken_backgrounds, more, versions, expected"),
    (lambda c: c["provenance"].update(versions=3), "provenance: versions is no object of texts"),
    (lambda c: c["provenance"]["versions"].update(numpy=2.0), "provenance: versions is no object of texts"),
    (lambda c: c["provenance"].update(broken_backgrounds=[1]), "provenance: broken_backgrounds is no list of texts"),
    (lambda c: c["provenance"].update(broken_backgrounds=["a.jpg"]), "broken_backgrounds are not those of its shards"),
    (lambda c: c["config"].update(patches=3), "config: patches is no list of objects"),
    (lambda c: c["config"].update(patches=[{"id": "a", "name": "b"}]), "config: patches is no list of objects"),
    (lambda c: c["config"].update(patches=[{"id": 1, "name": 2}]), "config: patches is no list of objects"),
    (lambda c: c.pop("schema"), "not a dataset manifest"),
    (lambda c: c.pop("config"), "not a dataset manifest"),
    (lambda c: c.pop("shards"), "not a dataset manifest"),
    (lambda c: c.pop("fingerprint"), "not a dataset manifest"),
    (lambda c: c.update(more=1), "unknown key 'more'"),
    (lambda c: c["shards"].append(c["shards"][1]), "shards[2]: shard-00001.h5 is listed twice"),
    (lambda c: c["shards"].append(c["shards"][0] | {"first": 6}), "shards[2]: shard-00000.h5 is listed twice"),
    (lambda c: c["shards"].reverse(), "shards[0]: first is 4, expected 0"),
    (lambda c: c["shards"].pop(), "images is 6, expected 4"),
    (lambda c: c["shards"].clear(), "lists no shards"),
    (entry("first", 1), "shards[0]: first is 1, expected 0"),
    (entry("first", 3, 1), "shards[1]: first is 3, expected 4"),
    (entry("first", 10**30, 1), f"shards[1]: first is {10**30}, expected a whole number of 0 or more"),
    (entry("count", 2**60), f"shards[0]: count is {2**60}, expected a whole number of 0 or more"),
    (entry("first", False), "shards[0]: first is False, expected a whole number of 0 or more"),
    (entry("first", 0.0), "shards[0]: first is 0.0, expected a whole number of 0 or more"),
    (entry("count", 3), "shards[1]: first is 4, expected 3"),
    (entry("count", 0, 1), "shards[1]: count is 0, expected 1 or more"),
    (entry("count", -4), "shards[0]: count is -4, expected a whole number of 0 or more"),
    (entry("count", "4"), "shards[0]: count is '4', expected a whole number of 0 or more"),
    (entry("bytes", "4"), "shards[0]: bytes is '4', expected a whole number of 0 or more"),
    (entry("sha256", None), "shards[0]: sha256 is None, expected a text"),
    (entry("file", 3), "shards[0]: file is 3, expected a text"),
    (entry("file", "../set/shard-00000.h5"), "shard '../set/shard-00000.h5' is not a plain file name"),
    (entry("file", "a\nb.h5"), r"shard 'a\nb.h5' is not a plain file name"),
    (entry("file", "a\0b.h5"), r"shard 'a\x00b.h5' is not a plain file name"),
    (entry("file", "\ud800.h5"), r"shard '\ud800.h5' is not a plain file name"),
    (entry("more", 3), "not a dataset manifest"),
]


@pytest.mark.parametrize(("how", "problem"), CHANGES, ids=[problem[:40] for _, problem in CHANGES])
def test_a_field_that_is_changed_is_named(changed, how, problem):
    assert changed(how).startswith(problem)


def test_a_count_that_fits_all_but_the_shard_is_named(changed):
    def move_an_image(content):
        content["shards"][0]["count"], content["shards"][1]["first"], content["shards"][1]["count"] = 3, 3, 3

    assert changed(move_an_image) == "shard-00000.h5 has count 3, expected 4"


def test_a_config_with_a_fingerprint_that_fits_is_compared_with_that_of_the_shards(changed):
    problem = changed(lambda content: content["config"].update(n=5), refingerprint=True)
    assert problem == "config is not that of shard-00000.h5"


def test_a_sound_dataset_is_as_written(dataset):
    assert [shard.count for shard in open_dataset(dataset.path).verify()] == [4, 2]


@pytest.mark.parametrize("name", ["a", "../a", "/a"])
def test_the_number_of_a_shard_that_no_memory_holds_is_one_line(tmp_path, name):
    shard = {"file": name, "first": 10**23, "count": 1, "bytes": 1, "sha256": ""}
    content = {"schema": "kpbench.dataset/1", "fingerprint": "", "config": {}, "shards": [shard]}
    (tmp_path / "dataset.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"dataset\.json: "):
        open_dataset(tmp_path)


@pytest.mark.parametrize("name", ["shard-00002.h5", "shard-99999.h5", "shard-123456.h5"])
def test_a_shard_that_the_manifest_does_not_list_is_named(tmp_path, dataset, name):
    folder = shutil.copytree(dataset.path, tmp_path / "set")
    shutil.copy(folder / "shard-00000.h5", folder / name)
    [line] = kpbench("verify", folder, code=1).stderr.splitlines()
    assert line.endswith(f"dataset.json: does not list {name}, which is in its folder")


def test_files_of_the_user_in_the_folder_are_no_shards(tmp_path, dataset):
    folder = shutil.copytree(dataset.path, tmp_path / "set")
    for name in ("shard-notes.h5", "predictions.h5", "notes.txt"):
        (folder / name).write_bytes(b"mine")
    assert "2 shards" in kpbench("verify", folder).stdout or list(open_dataset(folder).verify())


TWICE = {
    "manifest": ('"seed": 0,', '"seed": 0, "seed": 0,'),
    "config": ('"config": {', '"config": {"kind": "synth",'),
    "shard": ('"first": 0,', '"first": 0, "first": 0,'),
    "escaped": ('"images": 6,', '"images": 6, "im\\u0061ges": 6,'),
}


@pytest.mark.parametrize("place", TWICE)
def test_a_key_that_is_there_twice_is_named(tmp_path, dataset, place):
    folder = shutil.copytree(dataset.path, tmp_path / "set")
    text = (folder / "dataset.json").read_text()
    assert TWICE[place][0] in text
    (folder / "dataset.json").write_text(text.replace(*TWICE[place], 1))
    with pytest.raises(DataError, match=r"dataset\.json: .*key '(seed|kind|first|images)' is there twice"):
        open_dataset(folder)


@pytest.mark.parametrize("text", ['["a", 1]', "[[1], {}]", "5", '"a"', "{", "null"])
def test_odd_backgrounds_in_a_shard_are_one_line(tmp_path, dataset, text):
    folder = shutil.copytree(dataset.path, tmp_path / "set")
    content = json.loads((folder / "dataset.json").read_text())
    path = folder / content["shards"][0]["file"]
    with h5py.File(path, "r+") as file:
        file.attrs["broken_backgrounds"] = np.bytes_(text)
    content["shards"][0] |= {"bytes": path.stat().st_size, "sha256": sha256_of(path)}
    shards = [type(dataset.shards[0])(**shard) for shard in content["shards"]]
    content["fingerprint"] = compute_fingerprint(content["config"], shards)
    (folder / "dataset.json").write_text(json.dumps(content))
    [line] = kpbench("verify", folder, code=1).stderr.splitlines()
    assert "background" in line or "damaged or no kpbench shard" in line
