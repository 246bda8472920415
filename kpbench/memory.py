"""Memory: refuse work that this machine cannot hold before it begins, and limit what a child process takes."""

from __future__ import annotations

import signal
import sys
from contextlib import suppress
from pathlib import Path

from kpbench.errors import DataError

LEAST_BYTES = 2**28
"""Work that needs less memory than this is not checked."""
_CGROUP = Path("/sys/fs/cgroup")


def free_bytes() -> int | None:
    """Return the memory that is free on this machine, or in this container; None if the system does not tell."""
    found = []
    with suppress(OSError, ValueError, IndexError):
        text = Path("/proc/meminfo").read_text()
        found.append(int(text.split("MemAvailable:")[1].split()[0]) * 1024)
    with suppress(OSError, ValueError, IndexError):  # the limit is "max" where there is none
        limit = int((_CGROUP / "memory.max").read_text())
        cache = (_CGROUP / "memory.stat").read_text().split("inactive_file ")[1].split()[0]
        found.append(limit - int((_CGROUP / "memory.current").read_text()) + int(cache))
    return min(found, default=None)


def peak_mib() -> int | None:
    """Return the largest resident memory that this process, or one that it waited for, has had, MiB.

    None if the system does not tell.
    """
    with suppress(ImportError, OSError, ValueError):  # not on every system
        import resource

        unit = 1 if sys.platform == "darwin" else 1024  # bytes there, KiB elsewhere
        whose = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        return max(resource.getrusage(who).ru_maxrss for who in whose) * unit // 2**20
    return None


def require_memory(needed_bytes: int, what: str) -> None:
    """Raise an error if the free memory is less than needed.

    Raises
    ------
    DataError
        The message begins with ``what``.
    """
    free = free_bytes() if needed_bytes > LEAST_BYTES else None
    if free is not None and free < needed_bytes:
        raise DataError(
            f"{what} needs about {needed_bytes / 2**30:.1f} GiB of memory, {max(free, 0) / 2**30:.1f} GiB are free"
        )


def limit_process(more_bytes: int, seconds: float) -> None:
    """Limit the memory that this process may take from now on, and its processor time (0: no limit).

    A child process calls this.
    """
    with suppress(ImportError, OSError, ValueError):  # not on every system
        import resource

        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        _, hard = resource.getrlimit(resource.RLIMIT_AS)  # a user's own limit stays
        wanted = taken + more_bytes
        resource.setrlimit(resource.RLIMIT_AS, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if seconds and hasattr(signal, "setitimer"):  # not on Windows
        signal.setitimer(signal.ITIMER_PROF, seconds)
