"""The signals that end a command: Ctrl-C, the wish of a batch system (SIGTERM), and a closed terminal (SIGHUP)."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

received: list[int] = []
"""The numbers of the signals that :func:`handle_end_signals` has handled in this process."""
END_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@contextmanager
def block_end_signals() -> Iterator[None]:
    """Hold these signals back within a ``with`` block. Processes that the block starts never receive them.

    Ctrl-C and batch systems send their signal to every process of a run. The parent process alone must react.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, END_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def handle_end_signals(handle: Callable[[int], None]) -> Iterator[None]:
    """Call a function with the number of each of these signals that arrives within a ``with`` block.

    A signal that the process ignores stays ignored, as SIGHUP does under nohup. Python handles signals in the main
    thread only; in another thread this changes nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def receive(number: int, _: FrameType | None) -> None:
        received.append(number)
        handle(number)

    caught = [number for number in END_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, receive) for number in caught}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
