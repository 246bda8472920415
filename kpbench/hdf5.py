"""Open HDF5 files for reading. No other module does.

The HDF5 library trusts a file: over some files it crashes, loops for ever or takes all memory, and opening one of the
file's datasets can be enough. A child process therefore reads each file first, within limits of processor time and
memory: all structures, all texts, and every column but those that are read piece by piece later.
"""

from __future__ import annotations

import atexit
import errno
import json
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from kpbench.files import is_local, note_read
from kpbench.signals import block_end_signals

MOST_OBJECTS = 64
"""Largest number of objects in a file."""
LARGEST_CHUNK = 2**30
"""Largest accepted number of bytes of one chunk, unpacked."""
LARGEST_ATTRIBUTE = 2**24
"""Largest accepted number of bytes of an attribute."""
MOST_INFLATION = 1100
"""Largest accepted ratio of unpacked to packed bytes. Deflate reaches at most 1032."""
CHECK_SECONDS, CHECK_BYTES_PER_SECOND = 1.0, 10e6
"""Processor time that the child process may take for a file: so many seconds, and one more per so many bytes."""
CHECK_MEMORY = 4 * 2**30
"""Bytes of memory that the child process may take."""
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of a file system without locks."""
FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32"}
"""The filters that every HDF5 has built in and that kpbench accepts, by their numbers."""
COMMAND = "import sys; sys.path += sys.argv[1:]; from kpbench.hdf5 import check_files; check_files()"


class StructureError(ValueError):
    """A file holds something that :func:`open_hdf5` does not accept. The message does not name the file."""


@dataclass(frozen=True)
class Column:
    """What kpbench expects of an HDF5 dataset.

    Attributes
    ----------
    dtype : str or dtype
        The exact type; or the accepted kinds of NumPy, such as "iu".
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


def open_hdf5(path: Path, layout: Layout) -> tuple[Any, dict[str, str]]:
    """Open a file whose columns are plain data within the file.

    Returns
    -------
    file : h5py.File
    texts : dict of str to str
        The attributes that ``layout.texts`` names and the file has.

    Raises
    ------
    StructureError
        If the file is not as ``layout`` says, reaches outside itself, declares more data than its bytes can hold, or
        if the HDF5 library fails over the file.
    OSError, KeyError, ValueError, RuntimeError, TypeError
        If the file is damaged or no HDF5 file.
    """
    if is_local(path):
        note_read(path)
        texts = _check_in_child(path, layout)
        return _open_with_lock_if_possible(path), texts
    file = h5py.File(path.open("rb"), "r")  # at a URL, which a child process may not reach
    try:
        return file, _check_file(file, layout, path.stat().st_size, in_child=False)
    except BaseException:
        file.close()
        raise


def _open_with_lock_if_possible(path: Path) -> Any:
    """Open an HDF5 file for reading, without a lock on a file system that has none.

    A file that this process has open with a lock can only be opened with a lock, and one without only without.
    """
    try:
        return h5py.File(path, "r", locking="best-effort")
    except OSError as error:
        is_open_without = "file locking flag values don't match" in str(error)
        if error.errno not in NO_LOCKS and not is_open_without:
            raise
        return h5py.File(path, "r", locking=False)


def _check_file(file: Any, layout: Layout, file_bytes: int, in_child: bool) -> dict[str, str]:
    """Check an open file and return its texts. In the child process, also read the columns that are not large."""
    if file.id.get_num_objs() > MOST_OBJECTS:
        raise StructureError(f"holds {file.id.get_num_objs()} objects, expected at most {MOST_OBJECTS}")
    names = set(file)
    if not layout.has_others:
        for name in sorted(names - layout.columns.keys()):
            raise StructureError(f"unknown dataset /{name}, expected {', '.join(layout.columns)}")
    for name, column in layout.columns.items():
        if column.optional and name not in names:
            continue
        if name not in names or file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
            raise StructureError(f"/{name} is missing or a link to elsewhere")
        data = file[name]
        _check_column(name, data, column, file_bytes)
        if in_child and data.chunks and not column.is_large:
            rows = data.chunks[0] * max(1, 2**24 // max(1, _bytes_of(data, data.chunks)))
            for start in range(0, len(data), rows):
                data[start : start + rows]
            _check_chunks(name, data)
    may_be_variable = layout.has_variable_texts and in_child
    return {name: _read_text(file, name, may_be_variable) for name in layout.texts if name in file.attrs}


def _check_chunks(name: str, data: Any) -> None:
    """Raise StructureError unless each chunk unpacks to its size. HDF5 leaves the rest of a short chunk undefined."""
    size, places = _bytes_of(data, data.chunks), list[tuple[int, ...]]()
    data.id.chunk_iter(lambda chunk: places.append(chunk.chunk_offset))
    for place in places:
        content = data.id.read_direct_chunk(place)[1]
        if data.fletcher32:  # a checksum at the end
            content = content[:-4]
        if data.compression:
            content = zlib.decompressobj().decompress(content, size + 1)
        if len(content) != size:
            raise StructureError(f"/{name} has a chunk of {len(content)} bytes, expected {size}")


def _check_column(name: str, data: Any, column: Column, file_bytes: int) -> None:
    """Raise StructureError unless a column is plain data of the expected type, all within the file."""
    if not isinstance(data, h5py.Dataset) or data.is_virtual or data.external or data.shape is None:
        raise StructureError(f"/{name} is not plain data stored in this file")
    kind, dtype = data.id.get_type(), data.dtype
    is_plain = not dtype.hasobject and (
        not kind.is_variable_str() if kind.get_class() == h5py.h5t.STRING else h5py.h5t.py_create(dtype).equal(kind)
    )
    is_expected = dtype.kind in column.dtype if isinstance(column.dtype, str) else dtype == column.dtype
    if not is_plain or not is_expected or data.ndim not in column.ndim:
        expected = "numbers or text of fixed length" if isinstance(column.dtype, str) else column.dtype
        ndim = " or ".join(map(str, column.ndim))
        raise StructureError(f"/{name} is {dtype} of shape {data.shape}, expected {expected} of {ndim} dimensions")
    creation = data.id.get_create_plist()
    numbers = [creation.get_filter(n)[0] for n in range(creation.get_nfilters())]
    used = [FILTERS.get(number, f"number {number}") for number in numbers]
    if used != [kind for kind in column.filters if kind in used]:
        raise StructureError(
            f"/{name} uses the filters {', '.join(used)}, expected at most {', '.join(column.filters)}, each once"
        )
    stored = _stored_bytes(name, data, column, file_bytes)
    declared = _bytes_of(data, data.shape)
    if declared > stored * (MOST_INFLATION if "gzip" in used else 1):
        raise StructureError(f"/{name} declares {declared} bytes, the file holds {stored} for it")


def _bytes_of(data: Any, shape: tuple[int, ...]) -> int:
    return math.prod(shape) * int(data.dtype.itemsize)


def _stored_bytes(name: str, data: Any, column: Column, file_bytes: int) -> int:
    """Return the number of bytes that hold a column. Raise StructureError unless they all lie within the file."""
    if data.chunks is None:
        stored, start = data.id.get_storage_size(), data.id.get_offset() or 0
        if start + stored > file_bytes:
            raise StructureError(f"/{name} lies beyond the end of the file")
        return int(stored)
    size = _bytes_of(data, data.chunks)
    if size > LARGEST_CHUNK:
        raise StructureError(f"/{name} has chunks of {size} bytes, expected at most {LARGEST_CHUNK}")
    stored, places = 0, set[tuple[int, ...]]()

    def check_chunk(chunk: Any) -> None:
        nonlocal stored
        # Deflate makes data that cannot be packed a little larger
        if chunk.filter_mask or chunk.size > 1.01 * size + 100 or chunk.byte_offset + chunk.size > file_bytes:
            raise StructureError(f"/{name} has a chunk that is not packed as the others, or not in the file")
        if any(at >= end for at, end in zip(chunk.chunk_offset, data.shape, strict=True)):
            raise StructureError(f"/{name} has a chunk at {chunk.chunk_offset}, beyond its shape {data.shape}")
        stored += chunk.size
        places.add(chunk.chunk_offset)

    data.id.chunk_iter(check_chunk)
    expected = math.prod(-(-size // step) for size, step in zip(data.shape, data.chunks, strict=True))
    if column.is_large and len(places) != expected:  # the library crashes when it is asked for a chunk that is missing
        raise StructureError(f"/{name} has {len(places)} chunks, expected {expected}")
    return stored


def _read_text(file: Any, name: str, may_be_variable: bool) -> str:
    """Return a text attribute."""
    attribute = h5py.h5a.open(file.id, name.encode())
    kind = attribute.get_type()
    if kind.get_class() != h5py.h5t.STRING or attribute.shape != ():
        raise StructureError(f"the attribute {name} is no text")
    if kind.is_variable_str() and not may_be_variable:
        raise StructureError(f"the attribute {name} is a text of variable length, expected a fixed length")
    if kind.get_size() > LARGEST_ATTRIBUTE:
        raise StructureError(f"the attribute {name} has {kind.get_size()} bytes, expected at most {LARGEST_ATTRIBUTE}")
    value = file.attrs[name]
    try:
        text = (value if isinstance(value, bytes) else str(value).encode()).decode()
    except UnicodeError:
        raise StructureError(f"the attribute {name} is not UTF-8 text") from None
    if len(text) > LARGEST_ATTRIBUTE:
        raise StructureError(f"the attribute {name} is longer than {LARGEST_ATTRIBUTE} bytes")
    return text


# --- The child process ----------------------------------------------------------------------------------------------


_lock = threading.Lock()
_child: tuple[int, subprocess.Popen[bytes]] | None = None
"""The process that started the child process, and the child process."""


def _check_in_child(path: Path, layout: Layout) -> dict[str, str]:
    """Let the child process check a file, and return the file's texts."""
    with _lock:
        child = _running_child()
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            pickle.dump((os.path.abspath(path), layout), child.stdin)
            child.stdin.flush()
            reply = child.stdout.readline()
        except BrokenPipeError:
            reply = b""
        except BaseException:  # such as Ctrl-C: a reply may still come, and be taken for that of the next file
            _stop_child()
            raise
        if not reply:
            _stop_child()
            raise StructureError("the HDF5 library crashes over it, or takes too much time or memory")
    kind, content = json.loads(reply)
    if kind == "structure":
        raise StructureError(content)
    if kind == "damaged":
        raise OSError(content)
    return {str(name): str(text) for name, text in content.items()}


def _running_child() -> subprocess.Popen[bytes]:
    """Return the child process of this process; start the child process if there is none."""
    global _child
    if _child is not None and _child[0] == os.getpid() and _child[1].poll() is None:
        return _child[1]
    _stop_child()
    folders = [str(Path(module.__file__ or "").parents[1]) for module in (sys.modules["kpbench"], h5py, np)]
    # -I and -S: imports come from the standard library and from the folders of these three packages
    words = [sys.executable, "-I", "-S", "-c", COMMAND, *folders]
    pipe = subprocess.PIPE
    with block_end_signals():  # the child process ends with this process
        child = subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, env=_child_environment())
    _child = (os.getpid(), child)
    return child


def _child_environment() -> dict[str, str]:
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def _stop_child() -> None:
    """End the child process, if this process started it."""
    global _child
    started, _child = _child, None
    if started is None or started[0] != os.getpid():
        return
    child = started[1]
    child.kill()
    for pipe in (child.stdin, child.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
    child.wait()


atexit.register(_stop_child)


def check_files() -> None:
    """Check the files that the parent process names, until the parent process ends. This is the child process."""
    _limit_memory()
    while True:
        try:
            path, layout = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        reply: tuple[str, Any]
        try:
            size = os.stat(path).st_size
            _limit_time(CHECK_SECONDS + size / CHECK_BYTES_PER_SECOND)
            with _open_with_lock_if_possible(path) as file:
                reply = "sound", _check_file(file, layout, size, in_child=True)
        except StructureError as error:
            reply = "structure", str(error)
        except Exception as error:
            reply = "damaged", " ".join(str(error).split())
        _limit_time(0)
        sys.stdout.buffer.write(json.dumps(reply).encode() + b"\n")
        sys.stdout.buffer.flush()


def _limit_time(seconds: float) -> None:
    """Let the system end this process after so much processor time; 0 lifts the limit."""
    if hasattr(signal, "setitimer"):  # not on Windows
        signal.setitimer(signal.ITIMER_PROF, seconds)


def _limit_memory() -> None:
    with suppress(ImportError, OSError, ValueError):  # not on every system
        import resource

        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + CHECK_MEMORY, resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
