"""Run independent jobs in this process, in worker processes or on a Dask cluster."""

from __future__ import annotations

import ctypes
import importlib
import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from multiprocessing import resource_tracker
from typing import Any, TypeVar

import cv2
from threadpoolctl import ThreadpoolController, threadpool_limits

from kpbench.errors import DataError
from kpbench.signals import block_end_signals

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")
Progress = Callable[[int], None]
"""A function that is called with the number of images finished since its last call."""

PROGRESS_INTERVAL_S = 0.2
"""Longest time between two reports of progress, s, so that a progress bar moves smoothly."""
JOBS_AHEAD = 4
"""Number of jobs per worker process that :func:`run_in_order` submits ahead of the results that are asked for."""
SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable that keeps Python from putting the current folder first on ``sys.path``."""
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3
"""Settings of the GNU C library: freed memory to keep, memory to ask for ahead, size from which memory is mapped."""
WORKER_DIED = "a worker process died (out of memory?)"


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_jobs(
    work: Callable[[JobT, Progress], ResultT],
    jobs: Sequence[JobT],
    workers: int | None,
    progress: Progress,
    executor: Executor | None = None,
    share_cores: bool = False,
) -> Iterator[ResultT]:
    """Yield the result of every job as soon as the job is finished, in any order.

    Parameters
    ----------
    work : callable
        Called as ``work(job, progress)``. ``work`` must be picklable. ``work`` calls its argument ``progress`` with the
        number of images finished since the last call.
    jobs : sequence
    workers : int or None
        Number of worker processes; None for one per core. With 1, the jobs run in this process, in order.
    progress : callable
        Called in this process with the number of images finished since its last call.
    executor : concurrent.futures.Executor, optional
        Runs the jobs in place of worker processes. ``progress`` is then called once per finished job.
    share_cores : bool
        Let OpenCV, BLAS and torch use cores / workers threads in each worker process. False: one thread.

    Raises
    ------
    DataError
        If a worker process dies.
    """
    workers = min(workers or count_cores(), len(jobs))
    threads = max(1, count_cores() // max(1, workers)) if share_cores else 1
    if executor is not None:
        yield from _run_on_executor(work, jobs, executor, progress)
    elif workers > 1:
        yield from _run_in_processes(work, jobs, workers, threads, progress)
    else:
        with _limited_threads(threads):
            for job in jobs:
                yield work(job, progress)


def _run_on_executor(
    work: Callable[[JobT, Progress], ResultT], jobs: Sequence[JobT], executor: Executor, progress: Progress
) -> Iterator[ResultT]:
    futures = [executor.submit(_run_remote, work, job) for job in jobs]
    try:
        for result, images in _in_order_of_completion(futures, lambda: None):
            progress(images)
            yield result
    except BrokenExecutor:
        raise DataError(WORKER_DIED) from None
    finally:
        for future in futures:
            future.cancel()


def _run_in_processes(
    work: Callable[[JobT, Progress], ResultT], jobs: Sequence[JobT], workers: int, threads: int, progress: Progress
) -> Iterator[ResultT]:
    with _process_pool(workers, threads) as (pool, counter):
        reported = 0

        def report_progress() -> None:
            nonlocal reported
            finished = counter.value
            progress(finished - reported)
            reported = finished

        futures = [pool.submit(_run_counted, work, job) for job in jobs]
        yield from _in_order_of_completion(futures, report_progress)


def run_in_order(work: Callable[[JobT], ResultT], jobs: Iterable[JobT], workers: int) -> Iterator[ResultT]:
    """Yield the result of every job in the order of the jobs; worker processes work a few jobs ahead.

    Jobs are taken one by one as results are asked for, so ``jobs`` may be infinite.

    Parameters
    ----------
    work : callable
        Called as ``work(job)``. ``work`` must be picklable.
    jobs : iterable
    workers : int
        Number of worker processes. With 0, each job runs in this process when its result is asked for.

    Raises
    ------
    DataError
        If a worker process dies.
    """
    if workers == 0:
        yield from map(work, jobs)
        return
    with _process_pool(workers) as (pool, _):
        ahead: deque[Future[ResultT]] = deque()
        for job in jobs:
            ahead.append(pool.submit(work, job))
            if len(ahead) > JOBS_AHEAD * workers:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


@contextmanager
def _safe_path() -> Iterator[None]:
    """Let Python processes that start within a ``with`` block not search the current folder for modules."""
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        _restore_safe_path(before)


def _restore_safe_path(value: str | None) -> None:
    os.environ.pop(SAFE_PATH, None)
    if value is not None:
        os.environ[SAFE_PATH] = value


@contextmanager
def _process_pool(workers: int, threads: int = 1) -> Iterator[tuple[ProcessPoolExecutor, Any]]:
    """Start worker processes; yield their pool, and the counter of finished images that the processes share.

    ``threads`` : number of threads of each process.

    The processes are killed if the block ends early: by an error, or because no more results are asked for.
    """
    spawn = multiprocessing.get_context("spawn")  # a forked OpenCV, HDF5 or torch may hang
    with block_end_signals(), _safe_path():
        resource_tracker.ensure_running()  # else the next line starts this process of multiprocessing
    counter, others = spawn.Value("q", 0), set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, spawn, _start_worker, (counter, os.environ.get(SAFE_PATH), threads))
    with block_end_signals(), _safe_path():
        for _ in range(workers):
            pool.submit(int)  # each empty job starts a process, so that the next line finds all
    processes = set(multiprocessing.active_children()) - others
    try:
        yield pool, counter
    except BaseException as error:
        for process in processes:
            process.kill()
        if isinstance(error, BrokenExecutor):
            raise DataError(WORKER_DIED) from None
        raise
    finally:
        # the pool's own thread must end before Python exits, even if a worker died
        pool.shutdown(wait=True, cancel_futures=True)


def _in_order_of_completion(futures: Sequence[Future[ResultT]], tick: Callable[[], None]) -> Iterator[ResultT]:
    """Yield results as jobs finish; call ``tick`` at least every ``PROGRESS_INTERVAL_S``."""
    waiting = set(futures)
    while waiting:
        done, waiting = wait(waiting, timeout=PROGRESS_INTERVAL_S, return_when=FIRST_COMPLETED)
        tick()
        for future in done:
            yield future.result()


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """Yield an executor on the workers of a Dask scheduler.

    When a worker dies, Dask gives its job to another worker, up to two times per job.

    Parameters
    ----------
    address : str
        Address of the scheduler, such as ``tcp://host:8786``.

    Raises
    ------
    DataError
        If ``distributed`` is not installed, the scheduler does not answer, or its workers die.
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
            hint = "finished shards are kept, add `resume=True` to go on"
            raise DataError(f"{address}: its workers died; {hint}") from None


def use_threads(count: int) -> None:
    """Make OpenCV and BLAS use ``count`` threads in this process, and torch too if it is imported later.

    On small matrices, more threads take more time.
    """
    os.environ.setdefault("OMP_NUM_THREADS", str(count))  # torch reads it; a user's own value stays
    cv2.setNumThreads(count)
    threadpool_limits(count)
    keep_freed_memory()


@cache
def survive_forks() -> None:
    """Let OpenCV work in processes that are forked from this one from now on.

    A forked process has none of the threads of OpenCV's pool, but waits for them. So the pool is emptied before a fork.
    """
    if not hasattr(os, "register_at_fork"):
        return
    before = list[int]()

    def empty_pool() -> None:
        before.append(cv2.getNumThreads())
        cv2.setNumThreads(1)

    os.register_at_fork(before=empty_pool, after_in_parent=lambda: cv2.setNumThreads(before.pop()))


@cache
def keep_freed_memory() -> None:
    """Make the C library keep up to 128 MiB of freed memory for this process.

    Otherwise arrays of an image's size go back to the system when they are freed. The system hands them out again page
    by page, and clears each page. For a pipeline of small images, this takes a sixth of the time. Other C
    libraries than GNU's have no such setting.
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        for setting, size in ((M_MMAP_THRESHOLD, 2**25), (M_TRIM_THRESHOLD, 2**27), (M_TOP_PAD, 2**22)):
            mallopt(setting, size)


def one_blas_thread() -> AbstractContextManager[Any]:
    """Make BLAS use one thread within a ``with`` block; idle BLAS threads spin and slow other work down."""
    limit: AbstractContextManager[Any] = _threadpool_controller().limit(limits=1, user_api="blas")
    return limit


@cache
def _threadpool_controller() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def _limited_threads(count: int) -> Iterator[None]:
    """Make OpenCV and BLAS use ``count`` threads within a ``with`` block."""
    threads = cv2.getNumThreads()
    with threadpool_limits(count):
        cv2.setNumThreads(count)
        keep_freed_memory()
        try:
            yield
        finally:
            cv2.setNumThreads(threads)


_counter: Any = None
"""The counter of finished images that a worker process shares with its parent."""


def _start_worker(counter: Any, safe_path: str | None, threads: int) -> None:
    """Prepare a new worker process: limit its threads, and let it end with the parent process."""
    global _counter
    _counter = counter
    _restore_safe_path(safe_path)  # for programs that the worker starts
    use_threads(threads)
    _end_with_parent()


def _end_with_parent() -> None:
    """End this worker process as soon as its parent has ended, even if the parent was killed."""
    parent = multiprocessing.parent_process()

    def wait_for_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()


def _add_to_counter(images: int) -> None:
    with _counter.get_lock():
        _counter.value += images


def _run_counted(work: Callable[[JobT, Progress], ResultT], job: JobT) -> ResultT:
    """Run a job in a worker process of :func:`_process_pool`."""
    return work(job, _add_to_counter)


def _run_remote(work: Callable[[JobT, Progress], ResultT], job: JobT) -> tuple[ResultT, int]:
    """Run a job in a worker that shares no counter; return the result and the number of finished images."""
    total = 0

    def add_to_total(images: int) -> None:
        nonlocal total
        total += images

    with _limited_threads(1):
        return work(job, add_to_total), total
