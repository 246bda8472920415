"""The process of a command: the signals that end it, and its standard streams."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from kpbench.signals import handle_end_signals, received


@contextmanager
def end_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end a command as Ctrl-C does."""
    received.clear()

    def interrupt(number: int) -> None:
        if len(received) == 1:  # a second signal must not disturb the end
            raise KeyboardInterrupt

    with handle_end_signals(interrupt):
        yield


def exit_code() -> int:
    """Return the exit code of an interrupted command, as shells define it: 128 and the number of the signal."""
    return 128 + (received[0] if received else signal.SIGINT)


def open_standard_streams() -> None:
    """Open what is closed of the standard streams, and keep messages of C libraries away from standard error.

    A file that is opened while stream 2 is closed becomes stream 2, and receives what OpenCV, libpng, FFmpeg and HDF5
    print there. They print raw lines about damaged files, which kpbench reports by itself. So stream 2
    becomes the null device, and Python's ``sys.stderr`` becomes a copy of the stream as it was.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.dup(number), "w"))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files may be no text
    with suppress(OSError, ValueError):
        sys.stderr.flush()
        sys.stderr = os.fdopen(os.dup(2), "w", buffering=1, errors="backslashreplace")
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
