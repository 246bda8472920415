"""Changes to the objects of an HDF5 file: datasets, attributes, links, types, shapes, filters; and to its bytes."""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from typing import Any

import h5py
import numpy as np

from .texts import json_text
from .trees import NUMBERS, TEXTS, damage, mutate_tree

VLEN = h5py.string_dtype()
TYPES: tuple[Any, ...] = (
    *("i1", "<i2", ">i4", "<i8", ">i8", "u1", "<u4", "<u8", "<f2", "<f4", "<f8", ">f8"),
    *("?", "c8", "S3", "S40", "V5", np.dtype(("<i8", (2,))), np.dtype([("a", "<f8"), ("b", "S4")])),
    *(VLEN, h5py.string_dtype("utf-8", 9), h5py.vlen_dtype(np.int32), h5py.ref_dtype, h5py.regionref_dtype),
    *(h5py.enum_dtype({"A": 0, "B": 1}), h5py.opaque_dtype("M8[s]")),
)  # fmt: skip
SHAPES: tuple[tuple[int, ...], ...] = (*((), (0,), (1,), (2,), (5,), (6,), (0, 2), (5, 2), (2, 5), (1, 1, 1), (3, 0)),)
FILTERS: tuple[dict[str, Any], ...] = (
    *({}, {"compression": "gzip"}, {"compression": "lzf"}, {"shuffle": True}, {"fletcher32": True}),
    *({"scaleoffset": 0}, {"compression": "gzip", "shuffle": True, "fletcher32": True}),
)


SIGNATURES = (b"OHDR", b"GCOL", b"OCHK", b"TREE", b"SNOD", b"HEAP", b"FRHP", b"BTHD", b"FADB", b"EAHD")


REFUSALS = (OSError, LookupError, ValueError, TypeError, RuntimeError, AttributeError, ArithmeticError)


def mutate_hdf5(rng: random.Random, data: bytes) -> bytes:
    """Change objects of a file in five of six cases, then at times bytes, mending checksums over them."""
    if rng.random() < 0.83:
        with h5py.File.in_memory(data, rdcc_nbytes=0) as file:
            for _ in range(rng.choice((1, 1, 1, 2, 3))):
                change = rng.choice(CHANGES)
                with suppress(*REFUSALS):  # HDF5 itself may refuse this change
                    change(rng, file)
                if change in LAST:
                    break
            file.flush()
            data = bytes(file.id.get_file_image())
    kind = rng.random()
    if kind < 0.12:
        return damage(rng, data)
    if kind < 0.3:
        return _damage_block(rng, data)
    return data


def _damage_block(rng: random.Random, data: bytes) -> bytes:
    """Change bytes within one structure, found by its signature, and mend the checksum of an object header."""
    present = [signature for signature in SIGNATURES if signature in data]
    if not present:
        return damage(rng, data)
    signature = rng.choice(present)
    at = data.find(signature)
    places = []
    while at >= 0:
        places.append(at)
        at = data.find(signature, at + 1)
    at = rng.choice(places)
    if signature != b"OHDR":
        changed = damage(rng, data, at + 4, at + rng.choice((24, 64, 256)))
        return changed if rng.random() < 0.3 else changed[: len(data)].ljust(len(data), b"\0")
    flags = data[at + 5]
    start = at + 6 + (16 if flags & 32 else 0) + (4 if flags & 16 else 0)
    width = 1 << (flags & 3)
    stop = start + width + int.from_bytes(data[start : start + width], "little")
    block = bytearray(data[at:stop])
    for _ in range(rng.choice((1, 1, 2, 4))):
        block[rng.randrange(5, len(block))] = rng.choice((0, 1, 2, 4, 8, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    return data[:at] + bytes(block) + struct.pack("<I", lookup3(bytes(block))) + data[stop + 4 :]


def lookup3(data: bytes) -> int:
    """Bob Jenkins' hash (lookup3.c, hashlittle), with which HDF5 checks its structures."""
    mask = 0xFFFFFFFF
    a = b = c = (0xDEADBEEF + len(data)) & mask
    padded = data + bytes(-len(data) % 12)
    words = struct.unpack(f"<{len(padded) // 4}I", padded)

    def rotate(x: int, k: int) -> int:
        return ((x << k) | (x >> (32 - k))) & mask

    last = len(words) - 3
    for n in range(0, last, 3):
        a, b, c = (a + words[n]) & mask, (b + words[n + 1]) & mask, (c + words[n + 2]) & mask
        a = ((a - c) & mask) ^ rotate(c, 4)
        c = (c + b) & mask
        b = ((b - a) & mask) ^ rotate(a, 6)
        a = (a + c) & mask
        c = ((c - b) & mask) ^ rotate(b, 8)
        b = (b + a) & mask
        a = ((a - c) & mask) ^ rotate(c, 16)
        c = (c + b) & mask
        b = ((b - a) & mask) ^ rotate(a, 19)
        a = (a + c) & mask
        c = ((c - b) & mask) ^ rotate(b, 4)
        b = (b + a) & mask
    if last >= 0:
        a, b, c = (a + words[last]) & mask, (b + words[last + 1]) & mask, (c + words[last + 2]) & mask
        for x, y, k in (
            ("c", "b", 14),
            ("a", "c", 11),
            ("b", "a", 25),
            ("c", "b", 16),
            ("a", "c", 4),
            ("b", "a", 14),
            ("c", "b", 24),
        ):
            v = {"a": a, "b": b, "c": c}
            v[x] = ((v[x] ^ v[y]) - rotate(v[y], k)) & mask
            a, b, c = v["a"], v["b"], v["c"]
    return c


# --- Objects -------------------------------------------------------------------------------------------------------


def _name(rng: random.Random, file: Any) -> str:
    """A dataset that can be read here, or another object; HDF5 crashes over a virtual one that is made of itself."""
    name = rng.choice(sorted(file))
    data = file.get(name)
    if isinstance(data, h5py.Dataset) and (data.nbytes > 2**20 or data.is_virtual or data.external):
        raise ValueError("an earlier change made it large, or made of other data")
    return name


def _values(rng: random.Random, dtype: Any, shape: tuple[int, ...]) -> Any:
    """Odd values of a type and shape, where NumPy can make them."""
    if isinstance(dtype, np.dtype) and dtype.metadata and "vlen" in dtype.metadata:
        kind = dtype.metadata["vlen"]
        values = np.empty(shape, object)
        for index in np.ndindex(shape):
            values[index] = rng.choice(TEXTS[:20]) if kind is str else np.arange(rng.randrange(5), dtype=kind)
        return values
    kind = np.dtype(dtype)
    if kind.kind in "iufb":
        with np.errstate(all="ignore"):
            odd = np.array([float(rng.choice(NUMBERS)) for _ in range(int(np.prod(shape)))]).reshape(shape)
            small = np.arange(odd.size, dtype="f8").reshape(shape)
            return (odd if rng.random() < 0.4 else small).astype(kind)
    return np.zeros(shape, kind)


def _retype(rng: random.Random, file: Any) -> None:
    """A dataset of the same values in another type, shape or with other filters."""
    name = _name(rng, file)
    old, attributes = file[name], dict(file[name].attrs)
    values, options = old[()], dict(rng.choice(FILTERS))
    if rng.random() < 0.4:
        dtype = rng.choice(TYPES)
        values = values.astype(dtype) if values.dtype.kind in "iuf" and np.dtype(dtype).kind in "iufb" else None
        values = _values(rng, dtype, old.shape) if values is None else values
    elif rng.random() < 0.5:
        values = _values(rng, old.dtype if rng.random() < 0.7 else rng.choice(TYPES), rng.choice(SHAPES))
    if rng.random() < 0.2 and values.ndim:
        values = np.concatenate([values] * rng.choice((0, 2, 3)) or [values[:0]])
    if options and values.ndim:
        options["chunks"] = (rng.choice((1, max(1, len(values)))), *(max(1, n) for n in values.shape[1:]))
    if rng.random() < 0.15:
        options["maxshape"] = tuple(None for _ in values.shape)
    del file[name]
    made = file.create_dataset(name, data=values, dtype=values.dtype, **options)
    for key, value in attributes.items():
        made.attrs[key] = value


def _change_values(rng: random.Random, file: Any) -> None:
    data = file[_name(rng, file)]
    if data.dtype.kind in "iuf" and data.size:
        index = tuple(rng.randrange(n) for n in data.shape)
        number = rng.choice(NUMBERS)
        old = data[index].item()
        number = rng.choice((number, number, old + 1, -old, old * 2))
        data[index] = (
            np.clip(number, np.iinfo(data.dtype).min, np.iinfo(data.dtype).max) if data.dtype.kind in "iu" else number
        )
    elif data.dtype.names:
        field = rng.choice(data.dtype.names)
        table = data[()]
        if len(table):
            with np.errstate(all="ignore"):
                row = table[field][rng.randrange(len(table))]
                table[field][rng.randrange(len(table))] = np.float64(rng.choice(NUMBERS)).astype(row.dtype)
            data[...] = table
    elif data.dtype.kind == "S" and data.size:
        at = rng.randrange(len(data))
        data[at] = rng.choice((*TEXTS, "[]", "{}", "[1]", '[{"effect": "blur"}]', "[" * 60)).encode(
            errors="surrogatepass"
        )


def _declare(rng: random.Random, file: Any) -> None:
    """A dataset that declares much and holds little."""
    name = _name(rng, file)
    old = file[name]
    dtype = old.dtype
    count = rng.choice((10**3, 10**6, 10**8, 2**31, 2**40))
    shape = (count, *old.shape[1:]) if old.shape else (count,)
    del file[name]
    chunks: dict[str, Any] = {"chunks": tuple(max(1, min(n, 1024)) for n in shape)}
    options = rng.choice((chunks, chunks | {"compression": "gzip"}, {} if count <= 10**6 else chunks))
    made = file.create_dataset(name, shape, dtype, fillvalue=rng.choice((None, 0)), **options)
    if made.chunks and rng.random() < 0.7:
        made[0] = np.zeros(shape[1:], dtype)


def _bomb(rng: random.Random, file: Any) -> None:
    """A chunk that grows on reading: deflate in deflate, or much more than the dataset needs."""
    name = _name(rng, file)
    old = file[name]
    size = rng.choice((2**16, 2**22, 600 * 2**20 if rng.random() < 0.05 else 2**20))
    row = max(1, old.dtype.itemsize * int(np.prod(old.shape[1:])))
    shape = (max(1, size // row), *old.shape[1:])
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_obj_track_times(False)
    plan.set_chunk(shape)
    times = rng.choice((1, 2, 2, 3))
    for _ in range(times):
        plan.set_deflate(9)
    dtype = h5py.h5t.py_create(old.dtype, logical=True)
    del file[name]
    made = h5py.h5d.create(file.id, name.encode(), dtype, h5py.h5s.create_simple(shape), plan)
    packed = _packed_zeros(shape[0] * row)
    for _ in range(times - 1):
        packed = zlib.compress(packed, 9)
    made.write_direct_chunk((0,) * len(shape), packed)


@lru_cache(maxsize=4)
def _packed_zeros(size: int) -> bytes:
    packer = zlib.compressobj(1)
    parts = [packer.compress(bytes(min(2**20, size - at))) for at in range(0, size, 2**20)]
    return b"".join([*parts, packer.flush()])


def _junk_chunk(rng: random.Random, file: Any) -> None:
    """Other bytes in a chunk: no deflate, or deflate of too few or too many bytes; or a filter mask."""
    chunked = [file[name] for name in file if isinstance(file[name], h5py.Dataset) and file[name].chunks]
    if not chunked:
        _retype(rng, file)
        return
    data = rng.choice(chunked)
    where = tuple(0 for _ in data.shape)
    packed = rng.choice((b"", rng.randbytes(50), zlib.compress(b"x" * rng.choice((1, 100, 10**5)))))
    if rng.random() < 0.4:
        packed = damage(rng, bytes(data.id.read_direct_chunk(where)[1]))
    data.id.write_direct_chunk(where, packed, filter_mask=rng.choice((0, 0, 1, 2, 3, 0xFFFFFFFF)))


def _link(rng: random.Random, file: Any) -> None:
    """A link of another kind, a group, a named type or nothing in place of a dataset; or one name more."""
    name, other = _name(rng, file), _name(rng, file)
    kind = rng.randrange(11)
    if kind == 0:
        file[f"{name}{rng.choice(('2', ' ', chr(0xE9), '.'))}"] = file[name]
        return
    if kind == 1:
        _group(file, rng.choice(("g", "h", name + "x")))
        return
    kept = file[other]
    del file[name]
    if kind == 2 and other != name:
        file[name] = kept
    elif kind == 3:
        file[name] = h5py.SoftLink(rng.choice((f"/{other}", f"/{name}", "/nowhere", "/", ".")))
    elif kind == 4:
        file[name] = h5py.ExternalLink(rng.choice(("/etc/passwd", "other.h5", "input.h5")), f"/{other}")
    elif kind == 5:
        _group(file, name)
    elif kind <= 7:
        plan, space = h5py.h5p.create(h5py.h5p.DATASET_CREATE), h5py.h5s.create_simple((5,))
        plan.set_obj_track_times(False)
        plan.set_virtual(space, rng.choice((b".", b"other.h5", b"input.h5")), other.encode(), space)
        h5py.h5d.create(file.id, name.encode(), h5py.h5t.NATIVE_INT64, space, plan)
    elif kind == 8:
        places = [(rng.choice(("/etc/passwd", "input.h5", "/dev/zero")), 0, 2**20)]
        file.create_dataset(name, (5,), "<i8", external=places)
    elif kind == 9:
        file.create_dataset(name, data=h5py.Empty(rng.choice(("<i8", "<f8", "S4"))))


def _group(file: Any, name: str) -> None:
    """Create a group without the time at which it was created, which would make an input another one tomorrow."""
    plan = h5py.h5p.create(h5py.h5p.GROUP_CREATE)
    plan.set_obj_track_times(False)
    h5py.h5g.create(file.id, name.encode(), gcpl=plan)


def _attribute(rng: random.Random, file: Any) -> None:
    """Another value or type of an attribute, of the file or of a dataset."""
    home = file if rng.random() < 0.85 or not len(file) else file[_name(rng, file)]
    names = sorted(home.attrs) or ["header"]
    name = rng.choice(names) if rng.random() < 0.9 else rng.choice(("header", "config", "x", "version"))
    old = home.attrs.get(name)
    text = old.decode(errors="replace") if isinstance(old, bytes) else str(old)
    if rng.random() < 0.65 and text[:1] in "{[":
        text = json_text(rng, mutate_tree(rng, json.loads(text)))
    elif rng.random() < 0.5:
        text = rng.choice(TEXTS)
    raw = text.encode(errors="surrogatepass")
    kind = rng.randrange(14)
    if kind < 5:
        home.attrs.create(name, raw, dtype=h5py.string_dtype("utf-8", max(1, len(raw))))
    elif kind < 9:
        home.attrs.create(name, text, dtype=VLEN)
    elif kind == 9:
        home.attrs.create(name, np.array([text, text], object), dtype=VLEN)
    elif kind == 10:
        dtype = rng.choice(TYPES)
        home.attrs.create(name, _values(rng, dtype, rng.choice(((), (1,), (3,), (0,)))), dtype=dtype)
    elif kind == 11:
        home.attrs[name] = h5py.Empty(rng.choice(("S10", "<f8")))
    elif kind == 12:
        del home.attrs[name]
    else:
        home.attrs[name] = rng.choice((0, 1, 2, -1, 1.5, True, np.zeros(1000), file.ref))


CHANGES: tuple[Callable[[random.Random, Any], None], ...] = (
    *(_retype, _retype, _retype, _change_values, _change_values, _change_values, _declare, _bomb, _junk_chunk),
    *(_link, _link, _attribute, _attribute, _attribute),
)
LAST = (_declare, _bomb, _junk_chunk)
"""Changes after which HDF5 may not be able to read the file any more, which a further change would have to."""
