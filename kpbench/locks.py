"""The lock of a folder against a second run."""

from __future__ import annotations

import errno
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kpbench.errors import DataError, KpbenchWarning, system_reason
from kpbench.files import is_local

LOCK_FILE = ".kpbench.lock"


@contextmanager
def lock_folder(folder: Path, shared: bool = False) -> Iterator[None]:
    """Lock a folder against other runs. The lock ends with the process, even if the process is killed.

    Parameters
    ----------
    folder : Path
        A folder at a URL is not locked: object stores have no locks.
    shared : bool
        Allow other runs with a shared lock at the same time. Each run must write other shards.

    Raises
    ------
    DataError
        If another run holds the lock, or the lock's file cannot be written.
    """
    try:
        import fcntl
    except ImportError:  # Windows has no flock, so the folder is not locked
        yield
        return
    if not is_local(folder):
        yield
        return
    path = folder / LOCK_FILE
    try:
        file = open(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666), "r+b")  # noqa: SIM115
    except OSError as error:
        reason = "it is a symbolic link" if error.errno == errno.ELOOP else system_reason(error) or error
        raise DataError(f"{path}: cannot be written, {reason}") from None
    with file:
        try:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            if not os.path.samestat(os.fstat(file.fileno()), path.stat()):  # deleted between open and flock
                raise BlockingIOError
        except (BlockingIOError, FileNotFoundError):
            raise DataError(f"{folder}: another kpbench run is writing to it") from None
        except OSError:  # a file system without locks, such as some of the network
            warnings.warn(f"{folder}: cannot be locked; let no other run write to it", KpbenchWarning, stacklevel=2)
        try:
            yield
        finally:
            if not shared and not os.fstat(file.fileno()).st_size:  # a file with content is the user's
                path.unlink(missing_ok=True)
