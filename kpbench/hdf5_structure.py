"""Check that an HDF5 file is plain data, all within the file. The child process of :mod:`kpbench.hdf5` runs this.

The functions use the low-level interface of h5py, which is about three times as fast as the other one.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import h5py
import numpy as np

MOST_OBJECTS = 64
"""Largest number of objects in a file."""
LARGEST_CHUNK = 2**30
"""Largest accepted number of bytes of one chunk, unpacked."""
LARGEST_ATTRIBUTE = 2**24
"""Largest accepted number of bytes of an attribute."""
MOST_INFLATION = 1100
"""Largest accepted ratio of unpacked to packed bytes. Deflate reaches at most 1032."""
BLOCK_BYTES = 2**24
"""Bytes that are read at a time."""
FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32"}
"""The filters that every HDF5 has built in and that kpbench accepts, by their numbers."""


class StructureError(ValueError):
    """A file holds something that :func:`kpbench.hdf5.open_hdf5` does not accept. The message names no file."""


@dataclass(frozen=True)
class Column:
    """What kpbench expects of an HDF5 dataset.

    Attributes
    ----------
    dtype : str or tuple of dtype
        The exact types; or the accepted kinds of NumPy, such as "iu".
    filters : tuple of str
        Filters that may be in use, each at most once and in this order.
    ndim : tuple of int
        Accepted numbers of dimensions.
    optional : bool
        Whether the file may lack the column.
    is_large : bool
        Whether the column is read piece by piece later, and not by the child process.
    """

    dtype: Any
    filters: tuple[str, ...]
    ndim: tuple[int, ...] = (1,)
    optional: bool = False
    is_large: bool = False


@dataclass(frozen=True)
class Layout:
    """What kpbench expects of an HDF5 file.

    Attributes
    ----------
    columns : mapping of str to Column
    texts : tuple of str
        Names of attributes of the file that hold a text; each may be missing.
    has_others : bool
        Whether the file may hold other objects. They are never opened.
    has_variable_texts : bool
        Whether texts may be of variable length. Only the child process reads them.
    """

    columns: Mapping[str, Column]
    texts: tuple[str, ...]
    has_others: bool = False
    has_variable_texts: bool = False


def check_file(file: Any, layout: Layout, file_bytes: int) -> dict[str, str]:
    """Check an open file, and read the columns that are not large. Return the file's texts.

    Raises
    ------
    StructureError
        At the first thing that ``layout`` does not allow.
    """
    count = file.id.get_num_objs()
    if count > MOST_OBJECTS:
        raise StructureError(f"holds {count} objects, expected at most {MOST_OBJECTS}")
    names = {name.decode(errors="surrogateescape") for name in file.id}
    if not layout.has_others:
        for name in sorted(names - layout.columns.keys()):
            raise StructureError(f"unknown dataset /{name}, expected {', '.join(layout.columns)}")
    for name, column in layout.columns.items():
        if column.optional and name not in names:
            continue
        if name not in names or file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
            raise StructureError(f"/{name} is missing or a link to elsewhere")
        _check_column(f"/{name}", h5py.h5o.open(file.id, name.encode()), column, file_bytes)
    present = [name for name in layout.texts if h5py.h5a.exists(file.id, name.encode())]
    return {name: _read_text(file, name, layout.has_variable_texts) for name in present}


def _check_column(name: str, data: Any, column: Column, file_bytes: int) -> None:
    """Raise StructureError unless a column is plain data of the expected type, all within the file."""
    plan = data.get_create_plist() if isinstance(data, h5py.h5d.DatasetID) else None
    if plan is None or plan.get_layout() == h5py.h5d.VIRTUAL or plan.get_external_count():
        raise StructureError(f"{name} is not plain data stored in this file")
    kind, dtype, shape = data.get_type(), data.dtype, data.shape
    if not isinstance(column.dtype, str):
        is_expected = any(_hdf5_type(accepted).equal(kind) for accepted in column.dtype)
    elif kind.get_class() == h5py.h5t.STRING:
        is_expected = "S" in column.dtype and not kind.is_variable_str()
    else:
        is_expected = dtype.kind in column.dtype and h5py.h5t.py_create(dtype).equal(kind)
    if not is_expected or len(shape) not in column.ndim:
        expected = "numbers or text of fixed length" if isinstance(column.dtype, str) else column.dtype[0]
        ndim = " or ".join(map(str, column.ndim))
        raise StructureError(f"{name} is {dtype} of shape {shape}, expected {expected} of {ndim} dimensions")
    numbers = [plan.get_filter(n)[0] for n in range(plan.get_nfilters())]
    used = [FILTERS.get(number, f"number {number}") for number in numbers]
    if used != [kind for kind in column.filters if kind in used]:
        raise StructureError(
            f"{name} uses the filters {', '.join(used)}, expected at most {', '.join(column.filters)}, each once"
        )
    chunk_shape = plan.get_chunk() if plan.get_layout() == h5py.h5d.CHUNKED else None
    if chunk_shape is None:
        stored, start = int(data.get_storage_size()), data.get_offset() or 0
        if start + stored > file_bytes:
            raise StructureError(f"{name} lies beyond the end of the file")
    else:
        size = math.prod(chunk_shape) * dtype.itemsize
        chunks = _check_chunks(name, data, shape, chunk_shape, size, file_bytes, column.is_large)
        stored = sum(chunks.values())
    declared = math.prod(shape) * dtype.itemsize
    if declared > stored * (MOST_INFLATION if "gzip" in used else 1):
        raise StructureError(f"{name} declares {declared} bytes, the file holds {stored} for it")
    if chunk_shape is not None and not column.is_large:
        _read_column(data, kind, shape, chunk_shape[0] * max(1, BLOCK_BYTES // max(1, size)))
        for place, stored in chunks.items():
            _check_chunk_size(name, data, place, stored, used, size)


def _check_chunks(
    name: str,
    data: Any,
    shape: tuple[int, ...],
    chunk_shape: tuple[int, ...],
    size: int,
    file_bytes: int,
    needs_all: bool,
) -> dict[tuple[int, ...], int]:
    """Return the bytes that the file holds for each chunk. Raise StructureError unless they lie within the file."""
    if size > LARGEST_CHUNK:
        raise StructureError(f"{name} has chunks of {size} bytes, expected at most {LARGEST_CHUNK}")
    found = dict[tuple[int, ...], int]()

    def check_chunk(chunk: Any) -> None:
        # Deflate makes data that cannot be packed a little larger
        if chunk.filter_mask or chunk.size > 1.01 * size + 100 or chunk.byte_offset + chunk.size > file_bytes:
            raise StructureError(f"{name} has a chunk that is not packed as the others, or not in the file")
        if any(at >= end for at, end in zip(chunk.chunk_offset, shape, strict=True)):
            raise StructureError(f"{name} has a chunk at {chunk.chunk_offset}, beyond its shape {shape}")
        found[chunk.chunk_offset] = found.get(chunk.chunk_offset, 0) + chunk.size

    data.chunk_iter(check_chunk)
    expected = math.prod(-(-length // step) for length, step in zip(shape, chunk_shape, strict=True))
    if needs_all and len(found) != expected:  # the library crashes when it is asked for a chunk that is missing
        raise StructureError(f"{name} has {len(found)} chunks, expected {expected}")
    return found


@cache
def _hdf5_type(dtype: np.dtype[Any]) -> Any:
    """Return the type in which h5py stores a type of NumPy. h5py takes long to make it."""
    return h5py.h5t.py_create(dtype)


def _read_column(data: Any, kind: Any, shape: tuple[int, ...], rows: int) -> None:
    """Read a whole column of an HDF5 type, some rows at a time."""
    dtype = data.dtype
    for start in range(0, shape[0], rows):
        block = np.empty((min(rows, shape[0] - start), *shape[1:]), dtype)
        if len(block) == shape[0]:
            data.read(h5py.h5s.ALL, h5py.h5s.ALL, block, kind)
            continue
        place = data.get_space()
        place.select_hyperslab((start, *(0 for _ in shape[1:])), block.shape)
        data.read(h5py.h5s.create_simple(block.shape), place, block, kind)


def _check_chunk_size(name: str, data: Any, place: tuple[int, ...], stored: int, filters: list[str], size: int) -> None:
    """Raise StructureError unless a chunk unpacks to its size. HDF5 leaves the rest of a short chunk undefined."""
    found = stored - (4 if "fletcher32" in filters else 0)  # a checksum at the end
    if "gzip" in filters:
        found = len(zlib.decompressobj().decompress(data.read_direct_chunk(place)[1][:found], size + 1))
    if found != size:
        raise StructureError(f"{name} has a chunk of {found} bytes, expected {size}")


def _read_text(file: Any, name: str, may_be_variable: bool) -> str:
    """Return a text attribute."""
    attribute = h5py.h5a.open(file.id, name.encode())
    kind = attribute.get_type()
    if kind.get_class() != h5py.h5t.STRING or attribute.shape != ():
        raise StructureError(f"the attribute {name} is no text")
    is_variable = kind.is_variable_str()
    if is_variable and not may_be_variable:
        raise StructureError(f"the attribute {name} is a text of variable length, expected a fixed length")
    if kind.get_size() > LARGEST_ATTRIBUTE:
        raise StructureError(f"the attribute {name} has {kind.get_size()} bytes, expected at most {LARGEST_ATTRIBUTE}")
    if is_variable:
        value = file.attrs[name]
    else:
        holder = np.empty((), attribute.dtype)
        attribute.read(holder, kind)
        value = holder[()]
    try:
        text = (value if isinstance(value, bytes) else str(value).encode()).decode()
    except UnicodeError:
        raise StructureError(f"the attribute {name} is not UTF-8 text") from None
    if len(text) > LARGEST_ATTRIBUTE:
        raise StructureError(f"the attribute {name} is longer than {LARGEST_ATTRIBUTE} bytes")
    return text
