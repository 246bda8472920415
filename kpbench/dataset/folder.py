"""Dataset folders: the manifest, its digests, and all shards read as one dataset."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.dataset.padding import pad_sample
from kpbench.dataset.shard import DATASET_SCHEMA, Shard, canonical_json, open_shard, shard_errors
from kpbench.errors import DataError, system_reason
from kpbench.files import DoubleKeyError, encode_utf8, folder_at, load_json, read_bytes, sha256_of
from kpbench.hdf5 import MOST_AHEAD
from kpbench.text import is_name
from kpbench.types import Truth, UInt8, is_ignored
from kpbench.writing import write_file

MANIFEST = "dataset.json"
LARGEST_NUMBER = 2**53
"""Every number of a manifest is smaller; other languages read larger ones inexactly."""
MOST_OPEN_SHARDS = 128
"""Largest number of shards that a dataset keeps open. Many systems allow a process 256 open files."""
SHARD_NAME = re.compile(r"shard-\d{5,}\.h5")
"""Names of the shards that kpbench writes."""
FINITE_COLUMNS = ("x", "y", "radius_major", "radius_minor", "H_patch2image")
"""Columns of a keypoint that have a finite value in every dataset."""


@dataclass(frozen=True)
class ShardEntry:
    """One shard as the manifest lists it.

    Attributes
    ----------
    file : str
        Name of the file in the dataset's folder.
    first, count : int
        The shard holds the images ``first`` to ``first + count - 1`` of the dataset.
    bytes : int
        Size of the file.
    sha256 : str
        SHA-256 of the file.

    Examples
    --------
    >>> from kpbench import open_dataset
    >>> [shard.file for shard in open_dataset("kpbench-data").shards]
    ['shard-00000.h5']
    """

    file: str
    first: int
    count: int
    bytes: int
    sha256: str


def compute_fingerprint(config: Mapping[str, Any], shards: Sequence[ShardEntry]) -> str:
    """Return the SHA-256 over the config and the digests of all shards."""
    lines = [canonical_json(config), *(shard.sha256 for shard in shards)]
    return hashlib.sha256(encode_utf8("\n".join(lines))).hexdigest()


def make_manifest(
    config: Mapping[str, Any], shards: Sequence[ShardEntry], provenance: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the content of ``dataset.json``."""
    return {
        "schema": DATASET_SCHEMA,
        "version": 1,
        "fingerprint": compute_fingerprint(config, shards),
        "seed": config.get("seed"),
        "images": sum(shard.count for shard in shards),
        "config": json.loads(canonical_json(config)),  # sorts the keys
        "shards": [vars(shard) for shard in shards],
        "provenance": dict(provenance),
    }


def write_manifest(folder: Path, content: Mapping[str, Any]) -> None:
    """Write ``dataset.json``, which makes the folder a finished dataset."""
    write_file(folder / MANIFEST, encode_utf8(json.dumps(content, indent=1, ensure_ascii=False) + "\n"))


class Dataset:
    """A finished dataset, opened by :func:`open_dataset` and read lazily.

    ``dataset[n]`` is the pair of image n and its true keypoints. A torch DataLoader takes the dataset as it is, and
    gives batches of the arrays that :func:`kpbench.dataset.pad_sample` lists. A dataset can be pickled and used after a
    fork.

    Attributes
    ----------
    path : Path
    config : dict
        The configuration that, together with the background files, determined the images.
    fingerprint : str
        SHA-256 over config and shards.
    provenance : dict
        Versions of the software that made the images, and background files that could not be decoded.
    shards : tuple of ShardEntry

    Examples
    --------
    >>> from kpbench import open_dataset
    >>> dataset = open_dataset("kpbench-data")
    >>> image, keypoints = dataset[0]
    >>> image.shape, keypoints.dtype.names[:3]
    ((480, 640), ('x', 'y', 'patch_id'))
    """

    def __init__(self, path: Path, manifest: Mapping[str, Any]) -> None:
        self.path = path
        self._manifest = dict(manifest)
        self.config: dict[str, Any] = manifest["config"]
        self.fingerprint: str = manifest["fingerprint"]
        self.provenance: dict[str, Any] = manifest.get("provenance", {})
        self.shards = tuple(ShardEntry(**entry) for entry in manifest["shards"])
        self._starts = np.array([shard.first for shard in self.shards], np.int64)
        self._files: dict[str, Shard] = {}
        self._process = os.getpid()

    def __len__(self) -> int:
        return sum(shard.count for shard in self.shards)

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__ | {"_files": {}}
        state.pop("truth", None)
        return state

    def _open(self, n: int, in_order: bool = False) -> Shard:
        """Return the open file of shard n. If too many shards are open, close the least recently used shard.

        ``in_order`` tells that the shards after it are opened next.
        """
        if self._process != os.getpid():  # after a fork, the open files belong to the parent
            self._files, self._process = {}, os.getpid()
        name = self.shards[n].file
        file = self._files.pop(name, None) or open_shard(self.path / name, self._following(n) if in_order else ())
        if len(self._files) == MOST_OPEN_SHARDS:
            self._files.pop(next(iter(self._files))).close()
        self._files[name] = file  # the last file in the dict is the file used last
        return file

    def _following(self, n: int) -> list[Path]:
        """Return the paths of the shards after shard n."""
        return [self.path / shard.file for shard in self.shards[n + 1 : n + MOST_AHEAD]]

    def _locate(self, index: int) -> tuple[Shard, int, Path]:
        """Return the open file that holds an image, the image's row in the file, and the file's path."""
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path} has {len(self)} images, there is no index {index}")
        n = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self._open(n), index - self.shards[n].first, self.path / self.shards[n].file

    def image(self, index: int) -> UInt8:
        """Return image number ``index``, counted from 0, as a uint8 array of shape (H, W) or (H, W, 3)."""
        file, row, path = self._locate(index)
        with shard_errors(path):
            return file.image(row)

    def keypoints(self, index: int) -> NDArray[Any]:
        """Return the true keypoints of image number ``index``, a table of :data:`kpbench.KEYPOINT_DTYPE`."""
        rows = self._rows(index)
        return rows[~is_ignored(rows)]

    def ignored(self, index: int) -> NDArray[Any]:
        """Return the patches of image number ``index`` that are not judged, a table as :meth:`keypoints`."""
        rows = self._rows(index)
        return rows[is_ignored(rows)]

    def _rows(self, index: int) -> NDArray[Any]:
        file, row, path = self._locate(index)
        with shard_errors(path):
            low, high = file["offsets"][row : row + 2]
            return np.asarray(file["keypoints"][low:high])

    def image_id(self, index: int) -> int:
        """Return the ID of image number ``index``."""
        file, row, path = self._locate(index)
        with shard_errors(path):
            return int(file["image_id"][row])

    def effects(self, index: int) -> list[dict[str, Any]]:
        """Return the records of the effects that degraded image number ``index``, in the order of application."""
        file, row, path = self._locate(index)
        with shard_errors(path):
            return list(load_json(file["degradations"].asstr()[row]))

    def __getitem__(self, index: int) -> tuple[UInt8, NDArray[Any]]:
        return self.image(index), self.keypoints(index)

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, NDArray[Any]]]:
        """Return images as the samples of :func:`kpbench.dataset.pad_sample`. A torch DataLoader calls this per batch.

        The columns of keypoints are as long as the longest of these images.
        """
        read = [(*self[n], self.image_id(n)) for n in indices]
        rows = max(len(keypoints) for _, keypoints, _ in read)
        return [pad_sample(*sample, rows) for sample in read]

    def _read_columns(self, names: Sequence[str]) -> Iterator[list[NDArray[Any]]]:
        """Yield whole columns, shard by shard."""
        for n, shard in enumerate(self.shards):
            with shard_errors(self.path / shard.file):
                columns = [self._open(n, in_order=True)[name] for name in names]
                yield [data.asstr()[:].astype(str) if data.dtype.kind == "S" else data[:] for data in columns]

    @cached_property
    def truth(self) -> Truth:
        """All true keypoints as one table."""
        names = ("image_id", "keypoints", "condition", "rung", "scene_id")
        offsets, *columns = zip(*self._read_columns(("offsets", *names)), strict=True)
        counts = np.concatenate([np.diff(part) for part in offsets])
        whole: dict[str, Any] = dict(zip(names, map(np.concatenate, columns), strict=True))
        if (left_out := is_ignored(whole["keypoints"])).any():
            image, table = np.repeat(np.arange(len(counts)), counts), whole["keypoints"]
            counts = np.bincount(image[~left_out], minlength=len(counts))
            whole |= {"keypoints": table[~left_out], "ignored": table[left_out], "ignored_image": image[left_out]}
        recipe = encode_utf8(canonical_json({key: value for key, value in self.config.items() if key != "pixels"}))
        whole |= {"fingerprint": self.fingerprint, "recipe": hashlib.sha256(recipe).hexdigest()}
        return Truth(**whole, offsets=np.concatenate([[0], np.cumsum(counts)]))

    def verify(self) -> Iterator[ShardEntry]:
        """Check every field of the manifest and every byte of the shards. Yield each shard after its check.

        The versions in ``provenance`` cannot be recomputed; only their types are checked.

        Raises
        ------
        DataError
            At the first field that does not fit the shards, or the first shard that is missing, differs in a byte, or
            cannot be read. If the folder holds a shard that the manifest does not list.
        """
        manifest = self.path / MANIFEST
        expected = {"version": 1, "seed": self.config.get("seed"), "images": len(self)}
        for name, value in expected.items():
            if canonical_json(self._manifest.get(name)) != canonical_json(value):
                found = repr(self._manifest[name])[:60] if name in self._manifest else "missing"
                raise DataError(f"{manifest}: {name} is {found}, expected {value!r}")
        known = {*expected, "schema", "fingerprint", "config", "shards", "provenance"}
        for name in sorted(self._manifest.keys() - known):
            raise DataError(f"{manifest}: unknown key {name[:60]!r}")
        if fault := _find_provenance_fault(self._manifest.get("provenance"), is_whole=True):
            raise DataError(f"{manifest}: {fault}")
        listed = {shard.file for shard in self.shards}
        present = {path.name for path in self.path.glob("shard-*.h5") if SHARD_NAME.fullmatch(path.name)}
        for name in sorted(present - listed):
            raise DataError(f"{manifest}: does not list {name}, which is in its folder")
        if compute_fingerprint(self.config, self.shards) != self.fingerprint:
            raise DataError(f"{manifest}: its fingerprint does not fit its config and shards")
        image_id, broken_files = list[NDArray[np.int64]](), set[str]()
        for n, shard in enumerate(self.shards):
            path = self.path / shard.file
            digest = sha256_of(path)
            if digest != shard.sha256:
                raise DataError(f"{path}: damaged, SHA-256 is {digest[:12]}…, expected {shard.sha256[:12]}…")
            with open_shard(path, self._following(n)) as file, shard_errors(path):
                count, config = len(file["images"]), file.texts["config"]
                broken_files.update(map(str, load_json(file.texts["broken_backgrounds"])))
                keypoints = file["keypoints"][:]
                image_id.append(file["image_id"][:])
            if not all(np.isfinite(keypoints[name]).all() for name in FINITE_COLUMNS):
                raise DataError(f"{path}: a keypoint has a value that is no finite number")
            if count != shard.count:
                raise DataError(f"{manifest}: {shard.file} has count {shard.count}, expected {count}")
            if config.encode() != encode_utf8(canonical_json(self.config)):
                raise DataError(f"{manifest}: config is not that of {shard.file}")
            yield shard
        if len(np.unique(np.concatenate(image_id))) < len(self):
            raise DataError(f"{manifest}: two images of its shards have the same image_id")
        if self.provenance["broken_backgrounds"] != sorted(broken_files):
            raise DataError(f"{manifest}: broken_backgrounds are not those of its shards")


def _find_provenance_fault(content: object, is_whole: bool) -> str | None:
    """Return what is wrong with the provenance of a manifest, or None. Unless ``is_whole``, parts may be absent."""
    expected = "expected an object with versions and broken_backgrounds"
    if not isinstance(content, dict):
        return f"provenance is {'missing' if content is None else 'no object'}, {expected}"
    if is_whole and content.keys() != {"versions", "broken_backgrounds"}:
        return f"provenance has {', '.join(sorted(content))[:60] or 'no keys'}, {expected}"
    versions, broken = content.get("versions", {}), content.get("broken_backgrounds", [])
    if not isinstance(versions, dict) or not all(isinstance(text, str) for text in versions.values()):
        return "provenance: versions is no object of texts"
    if not isinstance(broken, list) or not all(isinstance(text, str) for text in broken):
        return "provenance: broken_backgrounds is no list of texts"
    return None


def open_dataset(path: str | Path) -> Dataset:
    """Open a finished dataset.

    Parameters
    ----------
    path : str or Path
        Folder, or a URL that fsspec reaches, such as ``s3://bucket/name``.

    Returns
    -------
    Dataset

    Raises
    ------
    DataError
        If there is no dataset, the dataset is unfinished, or a shard is missing or has the wrong size.

    Examples
    --------
    >>> from kpbench import open_dataset
    >>> len(open_dataset("kpbench-data"))
    6
    """
    folder = folder_at(path)
    dataset = _read_manifest(folder)
    if not dataset.shards:
        raise DataError(f"{folder / MANIFEST}: lists no shards")
    for shard in dataset.shards:
        if not is_name(shard.file):
            raise DataError(f"{folder / MANIFEST}: shard {shard.file!r} is not a plain file name")
        try:
            size = (folder / shard.file).stat().st_size
        except FileNotFoundError:
            raise DataError(f"{folder / shard.file}: missing, listed in {MANIFEST}") from None
        except OSError as error:
            raise DataError(f"{folder / shard.file}: cannot be read, {system_reason(error) or error}") from None
        if size != shard.bytes:
            raise DataError(f"{folder / shard.file}: damaged, has {size} bytes, expected {shard.bytes}")
    return dataset


def _read_manifest(folder: Path) -> Dataset:
    """Return the dataset that the manifest of a folder describes. The shards are not checked."""
    manifest = folder / MANIFEST
    try:
        content = load_json(read_bytes(manifest).decode())
        if content["schema"] != DATASET_SCHEMA:
            raise DataError(f"{manifest}: schema is {content['schema']!r}, expected {DATASET_SCHEMA!r}")
        shards = [ShardEntry(**entry) for entry in content["shards"]]
        fault = _find_fault(content["config"], content["fingerprint"], shards)
        fault = fault or _find_provenance_fault(content.get("provenance", {}), is_whole=False)
    except FileNotFoundError:
        if any(folder.glob("shard-*.h5")):
            raise DataError(f"{folder}: an unfinished dataset (no {MANIFEST}); resume the run that makes it") from None
        raise DataError(f"{folder}: no dataset there (no {MANIFEST}); `kpbench synth` makes one") from None
    except NotADirectoryError:
        raise DataError(f"{folder}: a file, expected the folder of a dataset") from None
    except OSError as error:
        raise DataError(f"{manifest}: cannot be read, {system_reason(error) or error}") from None
    except DoubleKeyError as error:
        raise DataError(f"{manifest}: {error}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
        raise DataError(f"{manifest}: not a dataset manifest, expected schema, config, fingerprint, shards") from None
    if fault:
        raise DataError(f"{manifest}: {fault}")
    return Dataset(folder, content)


def _find_fault(config: object, fingerprint: object, shards: Sequence[ShardEntry]) -> str | None:
    """Return the first field of a manifest whose type or value is impossible, or None."""
    if not isinstance(config, dict):
        return "config is no object"
    if not isinstance(fingerprint, str):
        return "fingerprint is no text"
    patches = config.get("patches", [])
    if not isinstance(patches, list) or not all(map(_is_patch, patches)):
        return "config: patches is no list of objects with a whole number id and a text name"
    first, files = 0, set[str]()
    for n, shard in enumerate(shards):
        for name, value in vars(shard).items():
            is_text = name in ("file", "sha256")
            if is_text and not isinstance(value, str):
                return f"shards[{n}]: {name} is {repr(value)[:40]}, expected a text"
            if not is_text and (type(value) is not int or not 0 <= value < LARGEST_NUMBER):
                return f"shards[{n}]: {name} is {repr(value)[:40]}, expected a whole number of 0 or more"
        if Path(shard.file).name != shard.file or not shard.file.isprintable():
            return f"shard {shard.file[:80]!r} is not a plain file name"
        if shard.file in files:
            return f"shards[{n}]: {shard.file} is listed twice"
        if shard.first != first:
            return f"shards[{n}]: first is {shard.first}, expected {first}"
        if not shard.count:
            return f"shards[{n}]: count is 0, expected 1 or more"
        first += shard.count
        files.add(shard.file)
    return None


def _is_patch(content: object) -> bool:
    return isinstance(content, dict) and type(content.get("id")) is int and isinstance(content.get("name"), str)
