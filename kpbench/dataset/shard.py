"""Dataset folders: shards written whole or not at all, read lazily, verified byte by byte.

The format is described in ``docs/dataset.md``; this is the only module that uses h5py.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import deflate
import h5py
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.files import folder_at, is_local, write_atomic
from kpbench.types import KEYPOINT_DTYPE, Truth, UInt8

SCHEMA = "kpbench.dataset/1"
MANIFEST = "dataset.json"
# libdeflate: the output of ISA-L, zlib-ng and zlib-rs may depend on what else was in memory (docs/dataset.md)
DEFLATE_LEVEL = 1
COLUMNS = (
    "images",
    "image_id",
    "scene_id",
    "condition",
    "rung",
    "offsets",
    "keypoints",
    "degradations",
    "background",
)
MOST_OPEN = 128  # shards that are open at a time; a process may often have no more than 256 files
MOST_DEFLATE = 1100  # deflate cannot shrink more than 1032-fold; what declares more is no honest file


@dataclass(frozen=True)
class Sample:
    """One labelled image on its way to a shard.

    ``image`` is (H, W) or (H, W, 3) uint8, ``keypoints`` a :data:`KEYPOINT_DTYPE` table, ``effects`` the
    degradations in order, ``background`` the photograph's path below its folder or "".
    """

    image_id: int
    image: UInt8
    keypoints: NDArray[Any]
    effects: list[dict[str, Any]] = field(default_factory=list)
    background: str = ""
    condition: str = ""
    rung: float = float("nan")
    scene_id: int = -1


def canonical_json(content: object) -> str:
    """JSON with sorted keys and no spaces: equal contents give equal text."""
    return json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def encode_shard(
    samples: Iterable[Sample], count: int, config: Mapping[str, Any], broken: Collection[str] = ()
) -> memoryview:
    """All bytes of a shard's HDF5 file, built in memory: the same samples give the same bytes.

    Images are packed as they come, so that never more than one is held unpacked.

    Parameters
    ----------
    samples : iterable of Sample
    count : how many there are.
    config : the dataset's config.
    broken : background files that could not be decoded on the way; looked at when all samples are in.

    Raises
    ------
    ValueError
        If there are no samples or their images differ in shape.
    """
    buffer = io.BytesIO()
    # v110 file structures carry checksums, so that a flipped byte outside the data is seen on reading. Only the
    # heap of variable-length strings has none (and HDF5 can loop for ever over a damaged one): text is of fixed length.
    # Without a chunk cache a column gets its place when it is written; else it gets it when Python frees the h5py
    # object, which another thread's garbage collection can put off
    with h5py.File(buffer, "w", libver=("v110", "v110"), rdcc_nbytes=0) as file:
        kept = _write_images(file, samples, count)
        attributes = {
            "schema": SCHEMA,
            "config": canonical_json(config),
            "broken_backgrounds": canonical_json(sorted(broken)),
        }
        for name, text in attributes.items():
            file.attrs.create(name, _utf8(text), dtype=_text_type([_utf8(text)]))
        file.attrs["version"] = 1

        def column(name: str, values: NDArray[Any], **compression: Any) -> None:
            checked = {"chunks": values.shape, "fletcher32": True, **compression} if values.size else {}
            file.create_dataset(name, data=values, **checked)

        def texts(name: str, values: Sequence[str]) -> None:
            column(name, _fixed_text(values), compression="gzip", compression_opts=1)

        column("image_id", np.array([sample.image_id for sample in kept], "<i8"))
        column("scene_id", np.array([_scene(sample) for sample in kept], "<i8"))
        texts("condition", [sample.condition for sample in kept])
        column("rung", np.array([sample.rung for sample in kept], "<f8"))
        column("offsets", np.cumsum([0, *(len(sample.keypoints) for sample in kept)], dtype="<i8"))
        column("keypoints", np.concatenate([sample.keypoints for sample in kept]).astype(KEYPOINT_DTYPE))
        texts("degradations", [canonical_json(sample.effects) for sample in kept])
        texts("background", [sample.background for sample in kept])
    return buffer.getbuffer()


def _write_images(file: Any, samples: Iterable[Sample], count: int) -> list[Sample]:
    """Write ``/images``, one a chunk; return the samples without their pixels."""
    kept: list[Sample] = []
    shape: tuple[int, ...] = ()
    for sample in samples:
        if not kept:
            shape = sample.image.shape
            whole = {"chunks": (1, *shape), "compression": "gzip", "compression_opts": DEFLATE_LEVEL}
            images = file.create_dataset("images", (count, *shape), "u1", **whole)
        elif sample.image.shape != shape:
            raise ValueError(f"a shard needs images of one shape, got {shape} and {sample.image.shape}")
        packed = deflate.zlib_compress(np.ascontiguousarray(sample.image), DEFLATE_LEVEL)
        images.id.write_direct_chunk((len(kept), *(0 for _ in shape)), packed)
        kept.append(replace(sample, image=sample.image[:0]))
    if len(kept) != count or not count:
        raise ValueError(f"a shard of {count} images got {len(kept)}")
    return kept


def _text_type(packed: Sequence[bytes]) -> Any:
    """HDF5's type of UTF-8 text of a fixed length that holds all of these."""
    return h5py.string_dtype("utf-8", max(len(text) for text in [b"-", *packed]))


def _fixed_text(values: Sequence[str]) -> NDArray[Any]:
    packed = [_utf8(value) for value in values]
    return np.array(packed, _text_type(packed))


def _scene(sample: Sample) -> int:
    return sample.image_id if sample.scene_id < 0 else sample.scene_id


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
    return hashlib.sha256(_utf8("\n".join(lines))).hexdigest()


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
    write_atomic(folder / MANIFEST, _utf8(json.dumps(content, indent=1, ensure_ascii=False) + "\n"))
    return mark


def _utf8(text: str) -> bytes:
    """UTF-8, and what a file's name holds beyond that escaped, as JSON has it."""
    return text.encode(errors="backslashreplace")


def recorded_digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every shard by the manifest; nothing if there is no manifest, or none that can be read."""
    try:
        shards = json.loads((folder / MANIFEST).read_text("utf-8"))["shards"]
        return {str(shard["file"]): str(shard["sha256"]) for shard in shards}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def sha256_of(path: Path) -> str:
    """SHA-256 of a file."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"{path}: cannot be read, {error.strerror}") from None


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn whatever h5py raises on a damaged file into one line."""
    try:
        yield
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        raise DataError(f"{path}: damaged or no kpbench shard ({' '.join(str(error).split())[:160]})") from None


def attribute(file: Any, name: str) -> str:
    """A text attribute of an open shard."""
    return np.bytes_(file.attrs[name]).decode()


def open_shard(path: Path) -> Any:
    """Open a shard after checking that it is what it says: plain local data of believable size.

    Raises
    ------
    DataError
        If it is damaged, of another schema, or reaches outside itself (external links or storage,
        virtual datasets, filters that HDF5 does not have built in).
    """
    with _reading(path):
        file = h5py.File(path, "r", locking="best-effort") if is_local(path) else h5py.File(path.open("rb"), "r")
    try:
        with _reading(path):
            _check_shard(file, path.stat().st_size)
    except BaseException:
        file.close()
        raise
    return file


def _check_shard(file: Any, size: int) -> None:
    schema = attribute(file, "schema")
    if schema != SCHEMA:
        raise ValueError(f"schema is {schema!r}, expected {SCHEMA!r}")
    count = -1
    for name in COLUMNS:
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"/{name} is missing or a link to elsewhere")
        data = file[name]
        if not isinstance(data, h5py.Dataset) or data.is_virtual or data.external or data.dtype.hasobject:
            raise ValueError(f"/{name} is not plain data stored in this file")
        plan = data.id.get_create_plist()
        filters = {plan.get_filter(n)[0] for n in range(plan.get_nfilters())}
        if not filters <= {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32}:
            raise ValueError(f"/{name} uses a filter that HDF5 does not have built in")
        stored = data.id.get_storage_size()
        if data.nbytes > (MOST_DEFLATE * stored if filters & {h5py.h5z.FILTER_DEFLATE} else min(stored, size)):
            raise ValueError(f"/{name} declares {data.nbytes} bytes, the file holds {stored} for it")
        if name == "images":
            count = data.shape[0]
            if data.dtype != np.uint8 or data.ndim not in (3, 4):
                raise ValueError(f"/images is {data.dtype} of shape {data.shape}, expected uint8 (N,H,W) or (N,H,W,3)")
        elif name == "keypoints":
            if data.dtype != KEYPOINT_DTYPE:
                raise ValueError("/keypoints has other columns than this version of kpbench knows")
        elif data.shape != (count + (name == "offsets"),):
            raise ValueError(f"/{name} has shape {data.shape}, which does not fit {count} images")
    offsets = file["offsets"][:]
    if offsets[0] != 0 or offsets[-1] != len(file["keypoints"]) or np.any(np.diff(offsets) < 0):
        raise ValueError("/offsets does not fit /keypoints")


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
