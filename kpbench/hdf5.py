"""Open HDF5 files for reading. No other module does.

The HDF5 library trusts a file: over some files it crashes, loops for ever or takes all memory, and opening one of the
file's datasets can be enough. A child process therefore reads each file first, within limits of processor time and
memory: all structures, all texts, and every column but those that are read piece by piece later. The child process
reads a file at a URL through this process.
"""

from __future__ import annotations

import atexit
import errno
import io
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np

from kpbench.files import is_local, note_read, open_file
from kpbench.hdf5_structure import Layout, StructureError, check_file
from kpbench.memory import limit_process
from kpbench.signals import block_end_signals

CHECK_SECONDS, CHECK_BYTES_PER_SECOND = 1.0, 10e6
"""Processor time that the child process may take for a file: so many seconds, and one more per so many bytes."""
CHECK_MEMORY = 4 * 2**30
"""Bytes of memory that the child process may take."""
MOST_AHEAD = 32
"""Largest number of files that the child process checks before they are opened."""
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of a file system without locks."""
COMMAND = "import sys; sys.path += sys.argv[1:]; from kpbench.hdf5 import check_files; check_files()"
Answer = tuple[str, Any]
"""Of a file: "sound" and its texts, "structure" and why, "damaged" and why, or "system" and the number of the error."""


def open_hdf5(path: Path, layout: Layout, following: Sequence[Path] = ()) -> tuple[Any, dict[str, str]]:
    """Open a file whose columns are plain data within the file.

    Parameters
    ----------
    path : Path
    layout : Layout
    following : sequence of Path
        Files of the same layout that are opened next, in this order. The child process checks them meanwhile.

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
        If the file is damaged or no HDF5 file. If the system refuses the file, the OSError has a number.
    """
    if is_local(path):
        note_read(path)
        key = _identify(path)
        texts = _texts_of(_check_in_child(key, layout, following[: MOST_AHEAD - 1]))
        return _open_with_lock_if_possible(path), texts
    remote = _Readable(path.open("rb"))
    try:
        texts = _texts_of(_check_in_child((str(path), path.stat().st_size), layout, (), remote))
        return h5py.File(remote, "r"), texts
    except BaseException:
        remote.close()
        raise


Key = tuple[Any, ...]
"""Path, size, and for a file of this machine also what changes with its content."""


def _identify(path: Path) -> Key:
    """Return the path of a file and what changes with its content.

    h5py says of a file that the system refuses only that it cannot be opened. The file is therefore opened here first.
    """
    with open_file(path, is_noted=False) as file:
        found = os.fstat(file.fileno())
    return os.path.abspath(path), found.st_size, found.st_dev, found.st_ino, found.st_mtime_ns


def _identify_many(paths: Iterable[Path]) -> list[Key]:
    """Identify files up to the first one that cannot be read. Its fault is told when the file itself is opened."""
    keys = []
    with suppress(OSError, StructureError):
        for path in paths:
            keys.append(_identify(path))
    return keys


def _open_with_lock_if_possible(path: str | Path) -> Any:
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


def _texts_of(answer: Answer) -> dict[str, str]:
    """Return the texts of a sound file. Raise the error that the answer tells."""
    kind, content = answer
    if kind == "structure":
        raise StructureError(content)
    if kind == "damaged":
        raise OSError(content)
    if kind == "system":
        raise OSError(content, os.strerror(content))
    return {str(name): str(text) for name, text in content.items()}


class _Readable(io.RawIOBase):
    """A file at a URL. Every error of the file system is an OSError."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__()
        self._file = file

    def readinto(self, buffer: Any) -> int:
        try:
            data = self._file.read(len(buffer))
        except Exception as error:
            raise OSError(str(error)) from None
        buffer[: len(data)] = data
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def close(self) -> None:
        self._file.close()
        super().close()


# --- The child process ----------------------------------------------------------------------------------------------


class _Child:
    """A child process, the files that it has been asked for, and the answers that nobody has taken.

    It answers in the order of the questions, also while this process works.
    """

    def __init__(self) -> None:
        folders = [str(Path(module.__file__ or "").parents[1]) for module in (sys.modules["kpbench"], h5py, np)]
        # -I and -S: imports come from the standard library and from the folders of these three packages
        words = [sys.executable, "-I", "-S", "-c", COMMAND, *folders]
        pipe, environment = subprocess.PIPE, {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        with block_end_signals():  # the child process ends with this process
            self.process = subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, env=environment)
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.questions, self.replies = self.process.stdin, self.process.stdout
        self.started_by = os.getpid()
        self.layout: Layout | None = None
        self.asked = deque[Key]()
        self.answers = dict[Key, Answer]()

    def is_usable(self) -> bool:
        return self.started_by == os.getpid() and self.process.poll() is None

    def ask(self, keys: Sequence[Key], layout: Layout, is_remote: bool) -> None:
        self.asked, self.answers, self.layout = deque(keys), {}, layout
        with suppress(BrokenPipeError):  # read_answer finds the end
            pickle.dump(([key[:2] for key in keys], layout, is_remote), self.questions)
            self.questions.flush()

    def read_answer(self, remote: _Readable | None = None) -> tuple[Key, Answer] | None:
        """Return the next answer; None if the process has ended. Meanwhile, read the remote file for the process."""
        while line := self.replies.readline():
            kind, content = json.loads(line)
            if kind != "read":
                return self.asked.popleft(), (kind, content)
            assert remote is not None
            remote.seek(content[0])
            data = remote.read(content[1]) or b""
            with suppress(BrokenPipeError):
                self.questions.write(struct.pack("<q", len(data)) + data)
                self.questions.flush()
        return None

    def stop(self) -> None:
        """End the process, if this process started it. Close this process's ends of the pipes."""
        is_own = self.started_by == os.getpid()
        if is_own:
            self.process.kill()
        for pipe in (self.questions, self.replies):
            with suppress(OSError):
                pipe.close()
        if is_own:
            self.process.wait()
        else:
            self.process.returncode = 0  # only the process that started it can wait for it


_lock = threading.Lock()
_child: _Child | None = None


def _check_in_child(key: Key, layout: Layout, following: Sequence[Path], remote: _Readable | None = None) -> Answer:
    """Return the child process's answer about a file, and let it go on with the files that follow."""
    global _child
    with _lock:
        try:
            while True:
                if _child is None or not _child.is_usable():
                    _stop_child()
                    _child = _Child()
                if not _child.asked:
                    if key in _child.answers and _child.layout == layout:
                        return _child.answers.pop(key)
                    _child.ask([key, *_identify_many(following)], layout, remote is not None)
                elif _child.layout == layout and key in _child.answers:
                    return _child.answers.pop(key)
                found = _child.read_answer(remote)
                if found is not None:
                    _child.answers[found[0]] = found[1]
                    continue
                crashed, layout_asked = _child.asked[0], _child.layout
                _stop_child()
                if crashed == key and layout_asked == layout:
                    return "structure", "the HDF5 library crashes over it, or takes too much time or memory"
        except BaseException:  # such as Ctrl-C: an answer may still come, and be taken for that of the next file
            _stop_child()
            raise


def _stop_child() -> None:
    global _child
    stopped, _child = _child, None
    if stopped is not None:
        stopped.stop()


atexit.register(_stop_child)


class _AtParent(io.RawIOBase):
    """A file that the parent process reads for the child process."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self._size, self._at = size, 0

    def readinto(self, buffer: Any) -> int:
        _say("read", [self._at, len(buffer)])
        (length,) = struct.unpack("<q", sys.stdin.buffer.read(8))
        buffer[:length] = sys.stdin.buffer.read(length)
        self._at += length
        return int(length)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._size}[whence]
        return self._at

    def tell(self) -> int:
        return self._at


def _say(kind: str, content: Any) -> None:
    sys.stdout.buffer.write(json.dumps((kind, content)).encode() + b"\n")
    sys.stdout.buffer.flush()


def check_files() -> None:
    """Check the files that the parent process names, until the parent process ends. This is the child process."""
    limit_process(CHECK_MEMORY, 0)
    while True:
        try:
            questions, layout, is_remote = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        for path, size in questions:
            _limit_time(CHECK_SECONDS + size / CHECK_BYTES_PER_SECOND)
            answer = _check(path, size, layout, is_remote)
            _limit_time(0)
            _say(*answer)


def _check(path: str, size: int, layout: Layout, is_remote: bool) -> Answer:
    try:
        with h5py.File(_AtParent(size), "r") if is_remote else _open_with_lock_if_possible(path) as file:
            return "sound", check_file(file, layout, size)
    except StructureError as error:
        return "structure", str(error)
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            return "system", error.errno
        return "damaged", " ".join(str(error).split())


def _limit_time(seconds: float) -> None:
    """Let the system end this process after so much processor time; 0 lifts the limit."""
    if hasattr(signal, "setitimer"):  # not on Windows
        signal.setitimer(signal.ITIMER_PROF, seconds)
