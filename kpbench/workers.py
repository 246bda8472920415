"""Run independent pieces of work in this process or in worker processes, with one progress count."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

import cv2

from kpbench.errors import DataError

__all__ = ["Progress", "cores", "run_pieces"]

Piece = TypeVar("Piece")
Result = TypeVar("Result")
Progress = Callable[[int], None]
"""Called with the number of images that are finished since the last call."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_pieces(
    work: Callable[[Piece, Progress], Result], pieces: Sequence[Piece], workers: int | None, progress: Progress
) -> Iterator[Result]:
    """Yield ``work(piece, progress)`` of every piece as it is finished, in any order.

    Parameters
    ----------
    work : picklable function; it calls its second argument as images are finished.
    pieces : sequence
    workers : processes; None for one a core. 1 works in this process.
    progress : called in this process.

    Raises
    ------
    DataError
        If a worker process dies.
    """
    workers = min(workers or cores(), len(pieces))
    if workers <= 1:
        cv2.setNumThreads(1)
        for piece in pieces:
            yield work(piece, progress)
        return
    spawn = multiprocessing.get_context("spawn")  # a forked OpenCV or HDF5 may hang
    counter = spawn.Value("q", 0)
    pool = ProcessPoolExecutor(workers, spawn, _start_worker, (counter,))
    try:
        waiting: set[Future[Result]] = {pool.submit(_in_worker, work, piece) for piece in pieces}
        seen = 0
        while waiting:
            done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
            now = counter.value
            progress(now - seen)
            seen = now
            for future in done:
                yield future.result()
    except BrokenProcessPool:
        raise DataError("a worker process died (out of memory?)") from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()


_counter: Any = None


def _start_worker(counter: Any) -> None:
    """Runs once in each worker: one thread, and Ctrl-C is the parent's business."""
    global _counter
    _counter = counter
    cv2.setNumThreads(1)
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _count(images: int) -> None:
    with _counter.get_lock():
        _counter.value += images


def _in_worker(work: Callable[[Piece, Progress], Result], piece: Piece) -> Result:
    return work(piece, _count)
