"""Shards: HDF5 files that hold some images of a dataset and their true keypoints. Opening a shard checks the file.

``docs/reference/dataset-format.md`` describes the format.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import deflate
import h5py
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError, system_reason
from kpbench.files import encode_utf8
from kpbench.hdf5 import open_hdf5
from kpbench.hdf5_structure import Column, Layout
from kpbench.types import KEYPOINT_DTYPE, LABELLED_KEYPOINT_DTYPE, UInt8

DATASET_SCHEMA = "kpbench.dataset/1"
DEFLATE_LEVEL = 1
"""Level of libdeflate, which always gives the same bytes for the same input. ISA-L, zlib-ng and zlib-rs may not."""
LEAST_SHRINKING = 0.75
"""Images that level 1 shrinks to more than this fraction are stored: shrinking noise takes longer than all else."""
_INT, _FLOAT = Column((np.dtype("<i8"),), ("fletcher32",)), Column((np.dtype("<f8"),), ("fletcher32",))
_TEXT = Column("S", ("gzip", "fletcher32"))
SHARD_COLUMNS = {
    "images": Column((np.dtype("u1"),), ("gzip",), ndim=(3, 4), is_large=True),
    "image_id": _INT,
    "scene_id": _INT,
    "condition": _TEXT,
    "rung": _FLOAT,
    "offsets": _INT,
    "keypoints": Column((KEYPOINT_DTYPE, LABELLED_KEYPOINT_DTYPE), ("fletcher32",)),
    "degradations": _TEXT,
    "background": _TEXT,
}
SHARD_TEXTS = ("schema", "config", "broken_backgrounds")
SHARD_LAYOUT = Layout(SHARD_COLUMNS, SHARD_TEXTS, has_others=True)


@dataclass(frozen=True)
class Sample:
    """One labelled image, before it is written into a shard.

    Attributes
    ----------
    image_id : int
    image : ndarray of shape (H, W) or (H, W, 3), uint8
        Grey or RGB.
    keypoints : ndarray of shape (n,), KEYPOINT_DTYPE or LABELLED_KEYPOINT_DTYPE
    effects : list of dict
        Records of the degradations, in order.
    background : str
        Path of the photograph relative to the folder of photographs; "" for a procedural background.
    condition : str
        Name of the condition; "" if the image belongs to no condition.
    rung : float
        Rung of the condition; nan if the image belongs to no condition.
    scene_id : int
        ID of the base scene, the same for all images of the scene. -1 if no other image shows the scene.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import KEYPOINT_DTYPE
    >>> from kpbench.dataset import Sample
    >>> Sample(0, np.zeros((48, 64), np.uint8), np.zeros(2, KEYPOINT_DTYPE)).scene_id
    -1
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
    """Return JSON with sorted keys and no spaces, so that equal contents give equal text."""
    return json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def encode_shard(
    samples: Iterable[Sample], count: int, config: Mapping[str, Any], broken_files: Collection[str] = ()
) -> memoryview:
    """Build a shard in memory and return its bytes. The same samples give the same bytes.

    Each image is compressed as soon as it is made. At most one uncompressed image is in memory.

    Parameters
    ----------
    samples : iterable of Sample
    count : int
        Number of samples.
    config : mapping
        Config of the dataset.
    broken_files : collection of str
        Background files that could not be decoded. The collection is read after the last sample. The iterator over
        the samples may therefore still add files.

    Raises
    ------
    ValueError
        If there are no samples, or their images differ in shape.
    """
    buffer = io.BytesIO()
    # HDF5's file structures of v110 have checksums, so that reading also finds a flipped byte outside the data. Only
    # the heap of variable-length strings has no checksum, and HDF5 can loop for ever over a damaged heap. Text is
    # therefore stored in fixed length.
    # Without a chunk cache, a column gets its place in the file when the column is written. With a cache, the column
    # would get its place when Python frees the h5py object, at a time that depends on other threads.
    with h5py.File(buffer, "w", libver=("v110", "v110"), rdcc_nbytes=0) as file:
        written = _write_images(file, samples, count)
        attributes = {
            "schema": DATASET_SCHEMA,
            "config": canonical_json(config),
            "broken_backgrounds": canonical_json(sorted(broken_files)),
        }
        for name, text in attributes.items():
            file.attrs.create(name, encode_utf8(text), dtype=_fixed_text_type([encode_utf8(text)]))
        file.attrs["version"] = 1

        def write_column(name: str, values: NDArray[Any], **compression: Any) -> None:
            options = {"chunks": values.shape, "fletcher32": True, **compression} if values.size else {}
            file.create_dataset(name, data=values, **options)

        def write_texts(name: str, values: Sequence[str]) -> None:
            write_column(name, _to_fixed_text(values), compression="gzip", compression_opts=1)

        write_column("image_id", np.array([sample.image_id for sample in written], "<i8"))
        write_column("scene_id", np.array([_scene_id(sample) for sample in written], "<i8"))
        write_texts("condition", [sample.condition for sample in written])
        write_column("rung", np.array([sample.rung for sample in written], "<f8"))
        write_column("offsets", np.cumsum([0, *(len(sample.keypoints) for sample in written)], dtype="<i8"))
        write_column("keypoints", _join_keypoints(written))
        write_texts("degradations", [canonical_json(sample.effects) for sample in written])
        write_texts("background", [sample.background for sample in written])
    return buffer.getbuffer()


def _join_keypoints(samples: Sequence[Sample]) -> NDArray[Any]:
    """Return the keypoints of all samples as one table, with the errors of the truth if all samples have some."""
    is_labelled = all(sample.keypoints.dtype == LABELLED_KEYPOINT_DTYPE for sample in samples)
    table = np.concatenate([sample.keypoints for sample in samples])
    return table.astype(LABELLED_KEYPOINT_DTYPE if is_labelled else KEYPOINT_DTYPE)


def _write_images(file: Any, samples: Iterable[Sample], count: int) -> list[Sample]:
    """Write ``/images``, one image per chunk. Return the samples without their pixels."""
    written: list[Sample] = []
    shape: tuple[int, ...] = ()
    for sample in samples:
        if not written:
            shape = sample.image.shape
            options = {"chunks": (1, *shape), "compression": "gzip", "compression_opts": DEFLATE_LEVEL}
            images = file.create_dataset("images", (count, *shape), "u1", **options)
        elif sample.image.shape != shape:
            raise ValueError(f"a shard needs images of one shape, got {shape} and {sample.image.shape}")
        packed = _deflate(np.ascontiguousarray(sample.image))
        images.id.write_direct_chunk((len(written), *(0 for _ in shape)), packed)
        written.append(replace(sample, image=sample.image[:0]))
    if len(written) != count or not count:
        raise ValueError(f"a shard of {count} images got {len(written)}")
    return written


def _deflate(image: UInt8) -> Any:
    """Compress an image in the zlib format, or store it uncompressed if a strip of it hardly shrinks, as noise does."""
    middle = len(image) // 2
    strip = image[middle - len(image) // 100 : middle + len(image) // 100 + 1]
    is_noise = len(deflate.zlib_compress(strip, DEFLATE_LEVEL)) > LEAST_SHRINKING * strip.size
    return deflate.zlib_compress(image, 0 if is_noise else DEFLATE_LEVEL)


def _fixed_text_type(encoded: Sequence[bytes]) -> Any:
    """Return HDF5's type for UTF-8 text of a fixed length. The length is the number of bytes of the longest text."""
    return h5py.string_dtype("utf-8", max(len(text) for text in [b"-", *encoded]))


def _to_fixed_text(values: Sequence[str]) -> NDArray[Any]:
    encoded = [encode_utf8(value) for value in values]
    return np.array(encoded, _fixed_text_type(encoded))


def _scene_id(sample: Sample) -> int:
    return sample.image_id if sample.scene_id < 0 else sample.scene_id


@contextmanager
def shard_errors(path: Path) -> Iterator[None]:
    """Turn every error of h5py on a damaged file into a DataError of one line that names the file."""
    try:
        yield
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        if reason := system_reason(error):
            raise DataError(f"{path}: cannot be read, {reason}") from None
        raise DataError(f"{path}: damaged or no kpbench shard ({' '.join(str(error).split())[:160]})") from None


class Shard:
    """An open shard, made by :func:`open_shard`. ``shard[name]`` is a column as an HDF5 dataset.

    Attributes
    ----------
    texts : dict of str to str
        The attributes ``schema``, ``config`` and ``broken_backgrounds``.
    """

    def __init__(self, file: Any, texts: dict[str, str]) -> None:
        self._file, self.texts = file, texts
        self._images = file["images"]
        self._image_bytes = math.prod(self._images.shape[1:])

    def __getitem__(self, name: str) -> Any:
        return self._file[name]

    def __enter__(self) -> Shard:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def image(self, row: int) -> UInt8:
        """Return an image. HDF5 would unpack however much a chunk holds, this unpacks one image.

        Raises
        ------
        ValueError
            If the chunk is damaged or holds more or less than an image.
        """
        shape = self._images.shape[1:]
        _, packed = self._images.id.read_direct_chunk((row, *(0 for _ in shape)))
        try:
            pixels = np.frombuffer(deflate.zlib_decompress(packed, self._image_bytes), np.uint8)
        except deflate.DeflateError as error:
            raise ValueError(f"image {row} cannot be unpacked, {error}") from None
        if len(pixels) != self._image_bytes:
            raise ValueError(f"image {row} has {len(pixels)} bytes, expected {self._image_bytes}")
        return pixels.reshape(shape)


def open_shard(path: Path, following: Sequence[Path] = ()) -> Shard:
    """Open a shard. Check that all data lie in the file itself and have a plausible size.

    Parameters
    ----------
    path : Path
    following : sequence of Path
        Shards that are opened next, in this order. They are checked meanwhile, so that opening them takes less time.

    Raises
    ------
    DataError
        If the file is damaged or has another schema. If the file needs external links, external storage, virtual
        datasets, or other filters than kpbench writes.
    """
    with shard_errors(path):
        file, texts = open_hdf5(path, SHARD_LAYOUT, following)
        try:
            _check_shard(file, texts)
            return Shard(file, texts)
        except BaseException:
            file.close()
            raise


def _check_shard(file: Any, texts: Mapping[str, str]) -> None:
    """Raise ValueError if :func:`open_shard` must refuse an open shard."""
    if texts["schema"] != DATASET_SCHEMA:
        raise ValueError(f"schema is {texts['schema']!r}, expected {DATASET_SCHEMA!r}")
    if missing := [name for name in SHARD_TEXTS if name not in texts]:
        raise ValueError(f"has no attribute {missing[0]}")
    images = file["images"]
    count, *shape = images.shape
    if shape[2:] not in ([], [3]) or images.chunks != (1, *shape) or images.compression != "gzip":
        raise ValueError(f"/images has the shape {images.shape}, expected (N,H,W) or (N,H,W,3), a gzip chunk per image")
    for name in SHARD_COLUMNS:
        expected = (count + (name == "offsets"),)
        found = h5py.h5d.open(file.id, name.encode()).shape  # faster than file[name].shape
        if name not in ("images", "keypoints") and found != expected:
            raise ValueError(f"/{name} has shape {found}, which does not fit {count} images")
    offsets = file["offsets"][:]
    if offsets[0] != 0 or offsets[-1] != len(file["keypoints"]) or np.any(np.diff(offsets) < 0):
        raise ValueError("/offsets does not fit /keypoints")
