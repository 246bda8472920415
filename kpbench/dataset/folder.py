"""The dataset folder: manifest, digests, and reading all its shards as one dataset."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.dataset.shard import SCHEMA, _reading, canonical_json, encode_utf8, open_shard
from kpbench.errors import DataError
from kpbench.files import folder_at, sha256_of, write_atomic
from kpbench.types import Truth, UInt8

MANIFEST = "dataset.json"


MOST_OPEN = 128  # shards that are open at a time; a process may often have no more than 256 files


@dataclass(frozen=True)
class ShardEntry:
    """One shard as the manifest lists it: images ``first`` to ``first + count - 1`` of the dataset."""

    file: str
    first: int
    count: int
    bytes: int
    sha256: str


def fingerprint(config: Mapping[str, Any], shards: Sequence[ShardEntry]) -> str:
    """SHA-256 over the config and the digests of all shards."""
    lines = [canonical_json(config), *(shard.sha256 for shard in shards)]
    return hashlib.sha256(encode_utf8("\n".join(lines))).hexdigest()


def write_manifest(
    folder: Path, config: Mapping[str, Any], shards: Sequence[ShardEntry], provenance: Mapping[str, Any]
) -> str:
    """Write ``dataset.json``, which makes the folder a finished dataset; return its fingerprint."""
    mark = fingerprint(config, shards)
    content = {
        "schema": SCHEMA,
        "version": 1,
        "fingerprint": mark,
        "seed": config.get("seed"),
        "images": sum(shard.count for shard in shards),
        "config": json.loads(canonical_json(config)),  # in one order of keys
        "shards": [vars(shard) for shard in shards],
        "provenance": dict(provenance),
    }
    write_atomic(folder / MANIFEST, encode_utf8(json.dumps(content, indent=1, ensure_ascii=False) + "\n"))
    return mark


def recorded_digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every shard by the manifest; nothing if there is no manifest, or none that can be read."""
    try:
        shards = json.loads((folder / MANIFEST).read_text("utf-8"))["shards"]
        return {str(shard["file"]): str(shard["sha256"]) for shard in shards}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


class Dataset:
    """A finished dataset folder, read lazily; made by :func:`open_dataset`.

    It can be pickled and used after a fork: file handles belong to the process that opened them.

    Attributes
    ----------
    path : Path
    config : dict
        What the images are a function of, together with the backgrounds.
    fingerprint : str
        SHA-256 over config and shards.
    shards : tuple of ShardEntry
    """

    def __init__(self, path: Path, manifest: Mapping[str, Any]) -> None:
        self.path = path
        self.config: dict[str, Any] = manifest["config"]
        self.fingerprint: str = manifest["fingerprint"]
        self.provenance: dict[str, Any] = manifest.get("provenance", {})
        self.shards = tuple(ShardEntry(**entry) for entry in manifest["shards"])
        self._starts = np.array([shard.first for shard in self.shards], np.int64)
        self._files: dict[str, Any] = {}
        self._process = os.getpid()

    def __len__(self) -> int:
        return sum(shard.count for shard in self.shards)

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__ | {"_files": {}}
        state.pop("truth", None)
        return state

    def _shard(self, n: int) -> Any:
        if self._process != os.getpid():
            self._files, self._process = {}, os.getpid()
        name = self.shards[n].file
        file = self._files.pop(name, None) or open_shard(self.path / name)
        if len(self._files) == MOST_OPEN:
            self._files.pop(next(iter(self._files))).close()
        self._files[name] = file  # last, as the one used last
        return file

    def _locate(self, index: int) -> tuple[Any, int, Path]:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path} has {len(self)} images, there is no index {index}")
        n = int(np.searchsorted(self._starts, index, side="right")) - 1
        return self._shard(n), index - self.shards[n].first, self.path / self.shards[n].file

    def image(self, index: int) -> UInt8:
        """The image at a position (not image id), (H, W) or (H, W, 3) uint8."""
        file, row, path = self._locate(index)
        with _reading(path):
            return np.asarray(file["images"][row])

    def keypoints(self, index: int) -> NDArray[Any]:
        """True keypoints of one image, a :data:`KEYPOINT_DTYPE` table."""
        file, row, path = self._locate(index)
        with _reading(path):
            low, high = file["offsets"][row : row + 2]
            return np.asarray(file["keypoints"][low:high])

    def effects(self, index: int) -> list[dict[str, Any]]:
        """The degradations applied to one image, in order, with their parameters."""
        file, row, path = self._locate(index)
        with _reading(path):
            return list(json.loads(file["degradations"].asstr()[row]))

    def __getitem__(self, index: int) -> tuple[UInt8, NDArray[Any]]:
        """(image, keypoints), so that a torch DataLoader can take the dataset as it is."""
        return self.image(index), self.keypoints(index)

    def _parts(self, names: Sequence[str]) -> Iterator[list[NDArray[Any]]]:
        """Whole columns of one shard after the other."""
        for n, shard in enumerate(self.shards):
            with _reading(self.path / shard.file):
                found = [self._shard(n)[name] for name in names]
                yield [data.asstr()[:].astype(str) if data.dtype.kind == "S" else data[:] for data in found]

    @cached_property
    def truth(self) -> Truth:
        """All true keypoints as one table."""
        names = ("image_id", "keypoints", "condition", "rung", "scene_id")
        offsets, *columns = zip(*self._parts(("offsets", *names)), strict=True)
        counts = np.concatenate([np.diff(part) for part in offsets])
        whole = dict(zip(names, map(np.concatenate, columns), strict=True))
        return Truth(**whole, offsets=np.concatenate([[0], np.cumsum(counts)]), fingerprint=self.fingerprint)

    def verify(self) -> Iterator[ShardEntry]:
        """Check every shard against the manifest, yielding each one that is whole.

        Raises
        ------
        DataError
            At the first shard that is missing, differs in a byte, or cannot be read.
        """
        if fingerprint(self.config, self.shards) != self.fingerprint:
            raise DataError(f"{self.path / MANIFEST}: its fingerprint does not fit its config and shards")
        for shard in self.shards:
            path = self.path / shard.file
            found = sha256_of(path)
            if found != shard.sha256:
                raise DataError(f"{path}: damaged, SHA-256 is {found[:12]}…, expected {shard.sha256[:12]}…")
            open_shard(path).close()
            yield shard


def open_dataset(path: str | Path) -> Dataset:
    """Open a finished dataset folder, of this machine or at a URL that fsspec reaches.

    Raises
    ------
    DataError
        If there is none, if its run was not finished, or if a shard is missing or of the wrong size.
    """
    folder = folder_at(path)
    try:
        manifest = json.loads((folder / MANIFEST).read_text("utf-8"))
        if manifest["schema"] != SCHEMA:
            raise DataError(f"{folder / MANIFEST}: schema is {manifest['schema']!r}, expected {SCHEMA!r}")
        dataset = Dataset(folder, manifest)
    except FileNotFoundError:
        if any(folder.glob("shard-*.h5")):
            raise DataError(f"{folder}: an unfinished dataset (no {MANIFEST}); finish it with --resume") from None
        raise DataError(f"{folder}: no dataset there (no {MANIFEST}); `kpbench synth` makes one") from None
    except NotADirectoryError:
        raise DataError(f"{folder}: a file, expected the folder of a dataset") from None
    except OSError as error:
        raise DataError(f"{folder / MANIFEST}: cannot be read, {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise DataError(
            f"{folder / MANIFEST}: not a dataset manifest, expected JSON with schema, config, fingerprint and shards"
        ) from None
    if not dataset.shards:
        raise DataError(f"{folder / MANIFEST}: lists no shards")
    for shard in dataset.shards:
        if Path(shard.file).name != shard.file:
            raise DataError(f"{folder / MANIFEST}: shard {shard.file!r} is not a plain file name")
        try:
            size = (folder / shard.file).stat().st_size
        except OSError:
            raise DataError(f"{folder / shard.file}: missing, listed in {MANIFEST}") from None
        if size != shard.bytes:
            raise DataError(f"{folder / shard.file}: damaged, has {size} bytes, expected {shard.bytes}")
    return dataset
