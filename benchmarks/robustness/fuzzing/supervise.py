"""A supervisor of workers, which ends those that hang.

The supervisor loads all modules and runs none of their code; each worker is a fork of it. A worker writes what became
of an input into a pipe, and which input it is at into shared memory. If it dies or hangs, the supervisor notes that
input and forks another worker for the next one. An input that may have died of an earlier one is read again, alone.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import pickle
import re
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .readers import Reader
from .worker import CHECKING, LIMIT_S, MAKING, PACKAGE, READING, STATE, Outcome, work


@dataclass
class Worker:
    """A worker and the inputs that it is given."""

    reader: Reader
    valid: list[bytes]
    seed: int
    indexes: range
    scratch: Path
    state: mmap.mmap
    pid: int = 0
    pipe: int = -1
    rest: bytes = b""
    last: Outcome | None = None
    stuck: tuple[int, int] | None = None
    again: list[int] = field(default_factory=list)

    def start(self) -> None:
        """Fork."""
        STATE.pack_into(self.state, 0, -1, MAKING, time.monotonic(), 0.0)
        (self.scratch / "frames").write_text("")
        self.rest, self.last = b"", None
        self.pipe, writing = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            try:
                os.close(self.pipe)
                work(self.reader, self.valid, self.seed, self.indexes, self.state, writing, self.scratch)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(97)
        os.close(writing)

    def receive(self) -> Iterator[Outcome]:
        """Outcomes that are final: those that a plain parser has looked at."""
        data = os.read(self.pipe, 2**20)
        *lines, self.rest = (self.rest + data).split(b"\n")
        for line in lines:
            outcome = Outcome(**json.loads(line))
            if self.last is not None and self.last.index == outcome.index:
                self.last = None
                yield outcome
            else:
                self.last = outcome
        if not data:
            self.rest = b"\0"  # the end of the pipe

    @property
    def ended(self) -> bool:
        """Whether the worker has closed its end of the pipe."""
        return self.rest == b"\0"

    def hangs(self) -> bool:
        """Whether the input in hand has taken too long; then the worker is killed after it told where it is."""
        index, phase, began, processor = STATE.unpack_from(self.state)
        waited, limit = time.monotonic() - began, LIMIT_S if phase == READING else 6 * LIMIT_S
        if waited < limit or (waited < 10 * limit and self._processor_time() - processor < limit):
            return False
        self.stuck = (index, phase) if self._processor_time() - processor >= limit else None
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGUSR1)
            time.sleep(0.3)
            os.kill(self.pid, signal.SIGKILL)
        return True

    def _processor_time(self) -> float:
        try:
            fields = Path(f"/proc/{self.pid}/stat").read_text().rsplit(")", 1)[1].split()
        except OSError:
            return 0.0
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def bury(self, killed: bool) -> tuple[list[Outcome], bool]:
        """After the end of a worker: what its last input came to, and whether inputs are left."""
        os.close(self.pipe)
        _, status = os.waitpid(self.pid, 0)
        if not killed and os.waitstatus_to_exitcode(status) == 0:
            return [], False
        index, phase, _, _ = STATE.unpack_from(self.state)
        if index < 0:
            raise RuntimeError(
                f"{self.reader.name}: a valid file is not read ({status}, killed {killed}, {self._frames()})"
            )
        busy = killed and self.stuck == (index, READING)
        if phase != CHECKING and index > self.indexes.start and not busy:
            # what was read before may be the cause: once more, alone
            self.again.append(index)
            self.indexes = range(index + 1, self.indexes.stop)
            return [], bool(self.indexes)
        if phase == MAKING:  # the change of the valid file takes too long: the input is left out, and does not count
            print(f"{self.reader.name} {index}: not made ({self._frames()})", file=sys.stderr)
            self.indexes = range(index + 1, self.indexes.stop)
            return [], bool(self.indexes)
        self.indexes = range(index + 1, self.indexes.stop)
        if phase == CHECKING:  # a plain parser died, which says nothing of kpbench
            return [self.last] if self.last is not None else [], bool(self.indexes)
        code = os.waitstatus_to_exitcode(status)
        kind = "hang" if killed else "crash"
        told = "" if killed else f"{signal.Signals(-code).name} " if code < 0 else f"exit code {code} "
        data = self.scratch / "input" / self.reader.file
        size = data.stat().st_size if data.exists() else 0
        return [Outcome(index, kind, f"{told}at {self._frames()}", size=size)], bool(self.indexes)

    def _frames(self) -> str:
        """The frame of kpbench that a worker was in, from what faulthandler wrote; and the innermost of all."""
        text = (self.scratch / "frames").read_text(errors="replace")
        text = text[max(text.rfind("Current thread"), text.rfind("most recent call first")) :]
        frames = re.findall(r'File "(.*?)", line (\d+) in (\S+)', text)
        own = [f for f in frames if f[0].startswith(PACKAGE)]
        told = [f"{Path(own[0][0]).relative_to(PACKAGE)}:{own[0][1]} {own[0][2]}"] if own else []
        if frames and frames[0] not in own[:1]:
            told.append(f"{Path(frames[0][0]).name} {frames[0][2]}")
        return ", in ".join(told) or "an unknown place"


def in_child(function: Callable[[], Any]) -> Any:
    """What a function returns in a fork of this process, so that it starts no threads here."""
    with tempfile.TemporaryFile() as file:
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                pickle.dump(function(), file)
                file.flush()
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        if os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]):
            raise RuntimeError("the valid files could not be made")
        file.seek(0)
        return pickle.load(file)


@contextlib.contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder in memory, where there is one."""
    memory = Path("/dev/shm")
    name = tempfile.mkdtemp(prefix="kpbench-fuzz-", dir=memory if os.access(memory, os.W_OK) else None)
    try:
        yield Path(name)
    finally:
        shutil.rmtree(name, ignore_errors=True)


def run(
    jobs: list[tuple[Reader, list[bytes], range]],
    seed: int,
    workers: int,
    scratch: Path,
    note: Callable[[Reader, Outcome], None],
) -> None:
    """Have workers read all inputs of all jobs."""
    waiting, running = list(reversed(jobs)), list[Worker]()
    free = [(scratch / str(n), mmap.mmap(-1, STATE.size)) for n in range(workers)]
    try:
        while waiting or running:
            while waiting and free:
                folder, state = free.pop()
                folder.mkdir(exist_ok=True)
                reader, valid, indexes = waiting.pop()
                running.append(Worker(reader, valid, seed, indexes, folder, state))
                running[-1].start()
            ready = select.select([worker.pipe for worker in running], [], [], 0.1)[0]
            for worker in list(running):
                if worker.pipe in ready:
                    for outcome in worker.receive():
                        note(worker.reader, outcome)
                killed = not worker.ended and worker.hangs()
                if killed:
                    while not worker.ended:
                        for outcome in worker.receive():
                            note(worker.reader, outcome)
                if killed or worker.ended:
                    outcomes, more = worker.bury(killed)
                    waiting += [(worker.reader, worker.valid, range(index, index + 1)) for index in worker.again]
                    worker.again.clear()
                    for outcome in outcomes:
                        note(worker.reader, outcome)
                    if more:
                        worker.start()
                    else:
                        running.remove(worker)
                        free.append((worker.scratch, worker.state))
    finally:
        for worker in running:
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.pid, signal.SIGKILL)
