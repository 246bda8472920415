"""Run independent pieces of work in this process or in worker processes, with one progress count."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any, TypeVar

import cv2
from threadpoolctl import ThreadpoolController, threadpool_limits

from kpbench.errors import DataError

Piece = TypeVar("Piece")
Result = TypeVar("Result")
Progress = Callable[[int], None]
"""Called with the number of images that are finished since the last call."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_pieces(
    work: Callable[[Piece, Progress], Result],
    pieces: Sequence[Piece],
    workers: int | None,
    progress: Progress,
    executor: Executor | None = None,
) -> Iterator[Result]:
    """Yield ``work(piece, progress)`` of every piece as it is finished, in any order.

    Parameters
    ----------
    work : picklable function; it calls its second argument as images are finished.
    pieces : sequence
    workers : processes; None for one a core. 1 works in this process.
    progress : called in this process.
    executor : any executor to work in instead; ``progress`` is then called piece by piece.

    Raises
    ------
    DataError
        If a worker process dies.
    """
    workers = min(workers or cores(), len(pieces))
    if executor is not None:
        futures = [executor.submit(_alone, work, piece) for piece in pieces]
        try:
            for result, images in _finished(futures, lambda: None):
                progress(images)
                yield result
        finally:
            for future in futures:
                future.cancel()
    elif workers <= 1:
        with _in_one_thread():
            for piece in pieces:
                yield work(piece, progress)
    else:
        yield from _in_processes(work, pieces, workers, progress)


def _in_processes(
    work: Callable[[Piece, Progress], Result], pieces: Sequence[Piece], workers: int, progress: Progress
) -> Iterator[Result]:
    spawn = multiprocessing.get_context("spawn")  # a forked OpenCV or HDF5 may hang
    counter, others = spawn.Value("q", 0), set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, spawn, _start_worker, (counter,))
    seen = 0

    def tell() -> None:
        nonlocal seen
        now = counter.value
        progress(now - seen)
        seen = now

    try:
        yield from _finished([pool.submit(_in_worker, work, piece) for piece in pieces], tell)
    except BaseException:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        raise
    finally:
        # waits for the pool's own thread, which else, after a worker's death, may be half closed when Python exits
        pool.shutdown(wait=True, cancel_futures=True)


def _finished(futures: Sequence[Future[Result]], tick: Callable[[], None]) -> Iterator[Result]:
    """Results as they come; ``tick`` is called at least every fifth of a second."""
    waiting = set(futures)
    try:
        while waiting:
            done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
            tick()
            for future in done:
                yield future.result()
    except BrokenExecutor:
        raise DataError("a worker process died (out of memory?)") from None


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """An executor on the workers of a Dask scheduler; a piece whose worker dies is given to another one.

    Raises
    ------
    DataError
        If ``distributed`` is not installed or the scheduler does not answer.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise DataError("Dask is not installed: pip install 'kpbench[dask]'") from None
    try:
        client = distributed.Client(address, timeout=10)
    except (OSError, ValueError) as error:
        raise DataError(f"{address}: no Dask scheduler answers ({type(error).__name__})") from None
    with client:
        try:
            yield client.get_executor(pure=False, retries=2)
        except (distributed.KilledWorker, CancelledError):
            raise DataError(f"{address}: its workers died; finished shards are kept, add --resume to go on") from None


def one_thread() -> None:
    """One thread a process: BLAS's own cost more than they bring on matrices as small as ours."""
    cv2.setNumThreads(1)
    threadpool_limits(1)


def one_blas_thread() -> AbstractContextManager[Any]:
    """For as long as it lasts; BLAS's threads wait busily, which takes the cores from all others."""
    limit: AbstractContextManager[Any] = _controller().limit(limits=1, user_api="blas")
    return limit


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def _in_one_thread() -> Iterator[None]:
    threads = cv2.getNumThreads()
    with threadpool_limits(1):
        cv2.setNumThreads(1)
        try:
            yield
        finally:
            cv2.setNumThreads(threads)


_counter: Any = None


def _start_worker(counter: Any) -> None:
    """Runs once in each worker: one thread, Ctrl-C is the parent's business, and an orphan ends."""
    global _counter
    _counter = counter
    one_thread()
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def end_with_parent() -> None:
    """Let this worker process end when its parent has, however that came."""
    parent = multiprocessing.parent_process()

    def wait_for_it() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait_for_it, daemon=True).start()


def _count(images: int) -> None:
    with _counter.get_lock():
        _counter.value += images


def _in_worker(work: Callable[[Piece, Progress], Result], piece: Piece) -> Result:
    return work(piece, _count)


def _alone(work: Callable[[Piece, Progress], Result], piece: Piece) -> tuple[Result, int]:
    """A piece's result and its number of images, where no counter is shared."""
    images = 0

    def count(more: int) -> None:
        nonlocal images
        images += more

    with _in_one_thread():
        return work(piece, count), images
