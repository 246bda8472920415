"""Dataset folders: shards written whole or not at all, read lazily, verified byte by byte.

The format is described in ``docs/reference/dataset-format.md``; this is the only module that uses h5py.
"""

from __future__ import annotations

import io
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import deflate
import h5py
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.files import is_local
from kpbench.types import KEYPOINT_DTYPE, UInt8

SCHEMA = "kpbench.dataset/1"
# libdeflate: the output of ISA-L, zlib-ng and zlib-rs may depend on what else was in memory
# (docs/reference/dataset-format.md)
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
            file.attrs.create(name, encode_utf8(text), dtype=_text_type([encode_utf8(text)]))
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
    packed = [encode_utf8(value) for value in values]
    return np.array(packed, _text_type(packed))


def _scene(sample: Sample) -> int:
    return sample.image_id if sample.scene_id < 0 else sample.scene_id


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


def encode_utf8(text: str) -> bytes:
    """UTF-8, and what a file's name holds beyond that escaped, as JSON has it."""
    return text.encode(errors="backslashreplace")
