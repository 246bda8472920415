"""The errors that kpbench raises on purpose.

::

    KpbenchError            base class; the message is one line with file, place and expectation
    ├── DesignError         a patch, a board or a page is impossible (TOML file, geometry, page size)
    ├── DataError           a dataset, an image, a folder or a weights file cannot be used
    ├── PredictionsError    a predictions file cannot be read, or does not fit its dataset
    └── GateFailed          a score misses a limit that the caller set

A user of the library catches ``KpbenchError``. The command line prints the message and exits with 1.
"""

from __future__ import annotations

import errno
import os

REASONS = {
    errno.EMFILE: "too many files are open; raise the limit with `ulimit -n`",
    errno.ENFILE: "too many files are open on this machine",
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk is full (quota)",
    errno.ELOOP: "it is a symbolic link in a circle",
}
"""Errors of the system that are named in words of our own."""
LONGEST_MESSAGE = 800
"""Characters. Of a longer message, the middle is left out."""


def one_line(text: str) -> str:
    """Return a text as one line of moderate length that a terminal and a log can show.

    Names and values of files go into messages. They may hold line breaks, escape sequences, or halves of characters.
    """
    text = " ".join(text.splitlines()) if len(text.splitlines()) > 1 else text
    if not text.isprintable():
        text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    half = LONGEST_MESSAGE // 2
    return text if len(text) <= LONGEST_MESSAGE else f"{text[:half]} … {text[-half:]}"


class KpbenchError(Exception):
    """Base class of all errors that kpbench raises on purpose.

    The message is one line. It names the file, the place within the file and what was expected.

    Examples
    --------
    >>> import kpbench
    >>> try:
    ...     kpbench.load_patches(["mine.toml"])
    ... except kpbench.KpbenchError as error:
    ...     print(error)
    mine.toml: cannot be read, No such file or directory
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(str(message)))


class KpbenchWarning(UserWarning):
    """A problem that does not stop the work. The command line prints the warning in one line."""


class DesignError(KpbenchError):
    """A patch, a board or a page is impossible."""


class DataError(KpbenchError):
    """A dataset, an image, a folder or a weights file cannot be used."""


class PredictionsError(KpbenchError):
    """A predictions file cannot be read, or does not fit its dataset."""


class GateFailed(KpbenchError):
    """A score misses a limit that the caller set."""


class UnreadableFile(OSError):
    """A path names no regular file, or a file that is too large. The message tells which, without the path."""


def system_reason(error: BaseException) -> str | None:
    """Return why the system refused a file, such as "Permission denied"; None if the error is not the system's.

    h5py raises OSError both for a damaged file and for a file that the system refuses. Only the latter has a number.
    """
    if isinstance(error, UnreadableFile):
        return str(error)
    if not isinstance(error, OSError) or not error.errno:
        return None
    return REASONS.get(error.errno) or os.strerror(error.errno)
