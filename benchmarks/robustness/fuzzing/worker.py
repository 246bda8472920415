"""What a worker does: make inputs, read them under a memory limit, hold the result against plain parsers."""

from __future__ import annotations

import contextlib
import faulthandler
import json
import mmap
import os
import re
import resource
import shutil
import signal
import struct
import time
import traceback
import unicodedata
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import kpbench

from .readers import Reader
from .references import Refusal

LIMIT_S = 3.0
"""Processor time that reading an input may take; ten times as much on the clock, on a machine that others use too."""
LIMIT_BYTES = 2 * 2**30
"""Address space that a worker may take on top of what it has when it starts."""
MUCH_BYTES = 512 * 2**20
"""Memory that reading one small file may really use."""
LONG_LINE = 1000
"""Characters of a message that nobody reads as one line."""
MAKING, READING, CHECKING = range(3)
PACKAGE = str(Path(kpbench.__file__).parent)
STATE = struct.Struct("<qqdd")  # index, phase, start by the clock, start in processor time


@dataclass(frozen=True)
class Outcome:
    """What became of one input.

    Attributes
    ----------
    index : int
    kind : str
        One of ``KINDS``.
    cause : str
        What inputs of one cause have in common: exception and last frame, or the kind of difference.
    message : str
        What was said of this input.
    size : int
        Length of the file, bytes.
    ms : float
        Time of the reader.
    header : bool or None
        Whether a plain parser reads the container; None if that itself failed.
    noise : str
        What libraries wrote to standard error or output.
    """

    index: int
    kind: str
    cause: str = ""
    message: str = ""
    size: int = 0
    ms: float = 0.0
    header: bool | None = None
    noise: str = ""


KINDS = ("accepted", "refused", "traceback", "bad line", "hang", "crash", "memory", "wrong")
BAD = KINDS[2:]


def clean(folder: Path) -> None:
    """Remove what an input left in its folder."""
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def classify(error: BaseException, path: Path) -> tuple[str, str, str]:
    """Kind, cause and message of what a reader raised."""
    message = str(error)
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if frame.filename.startswith(PACKAGE)]
    where = f"{Path(own[-1].filename).relative_to(PACKAGE)}:{own[-1].lineno} {own[-1].name}" if own else ""
    if isinstance(error, kpbench.KpbenchError):
        problem = problem_of_line(message, path)
        return ("bad line", f"{problem}, raised in {where}", message) if problem else ("refused", "", message)
    deep = not frames or frames[-1] in own or isinstance(error, RecursionError)  # which may end in any frame
    last = "" if deep else f", in {Path(frames[-1].filename).name} {frames[-1].name}"
    cause = f"{type(error).__name__} at {where}{last}"
    return ("memory" if isinstance(error, MemoryError) else "traceback", cause, message)


def problem_of_line(message: str, path: Path) -> str:
    """Why a message is not one line that names the file, or ""."""
    if path.name not in message and str(path.parent) not in message:
        return "no file name"
    rest = message.replace(str(path), "")
    if len(message.splitlines()) > 1:
        return "line break"
    if any(unicodedata.category(character) == "Cc" for character in rest.replace("\t", " ")):
        return "control character"
    if re.search("[\ud800-\udfff]", rest):
        return "surrogate"
    return "longer than 1000 characters" if len(rest) > LONG_LINE else ""


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE


def _peak() -> int:
    text = Path("/proc/self/status").read_text()
    return int(text.split("VmHWM:")[1].split()[0]) * 1024


def _reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def read_one(reader: Reader, path: Path) -> tuple[Outcome, Any]:
    """Read an input; the outcome without its index, and what was read."""
    _reset_peak()
    before, began, found = _resident(), time.perf_counter(), None
    try:
        found = reader.read(path)
        kind, cause, message = "accepted", "", ""
    except BaseException as error:  # whatever a reader raises is what is looked for
        kind, cause, message = classify(error, path)
        error.__traceback__ = None
    ms = 1000 * (time.perf_counter() - began)
    used = _peak() - before
    if used > MUCH_BYTES and kind != "memory":
        kind, cause, message = "memory", f"{kind}, used much memory", f"{used >> 20} MiB; {message}"
    return Outcome(0, kind, cause, message.replace(f"{path.parent}/", "")[:2000], ms=ms), found


def check(reader: Reader, data: bytes, outcome: Outcome, found: Any) -> Outcome:
    """Hold what was read against plain parsers."""
    told = asdict(outcome)
    header, told["header"] = outcome.kind == "accepted", True
    if not header:
        try:
            reader.container(data)
        except Exception:  # whatever a parser raises
            told["header"] = False
    if outcome.kind == "accepted" and reader.reference is not None:
        try:
            difference = reader.reference(data, found)
        except Refusal as error:
            difference = f"accepted {error}"
        except Exception as error:
            difference = f"a plain parser refuses it: {type(error).__name__}: {error}"
        if difference:
            told |= {"kind": "wrong", "cause": difference.split(":")[0], "message": difference[:2000]}
            if difference.startswith("a plain parser"):
                told["cause"] = " ".join(difference.split(":")[:2])
    return Outcome(**told)


def work(
    reader: Reader, valid: list[bytes], seed: int, indexes: range, state: mmap.mmap, pipe: int, scratch: Path
) -> None:
    """Read inputs one after the other; never returns."""
    where = scratch / "input"
    where.mkdir(exist_ok=True)
    path, noise = where / reader.file, os.open(scratch / "noise", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    os.dup2(noise, 1)
    os.dup2(noise, 2)
    log = (scratch / "frames").open("w")
    faulthandler.enable(log)
    faulthandler.register(signal.SIGUSR1, log)
    os.fsync = lambda fd: None  # type: ignore[assignment]
    STATE.pack_into(state, 0, -1, MAKING, time.monotonic(), time.process_time())
    path.write_bytes(reader.as_seed(valid[0]))
    with contextlib.suppress(Exception):
        reader.read(path)  # loads what is loaded at first use
    size = int(Path("/proc/self/statm").read_text().split()[0]) * mmap.PAGESIZE
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def enter(index: int, phase: int) -> None:
        most = size + LIMIT_BYTES if phase == READING else resource.RLIM_INFINITY
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
        STATE.pack_into(state, 0, index, phase, time.monotonic(), time.process_time())

    def send(outcome: Outcome) -> None:
        os.write(pipe, json.dumps(asdict(outcome)).encode() + b"\n")

    for index in indexes:
        enter(index, MAKING)
        data = reader.make(seed, index, valid)
        clean(where)
        path.write_bytes(data)
        os.ftruncate(noise, 0)
        os.lseek(noise, 0, os.SEEK_SET)
        enter(index, READING)
        outcome, found = read_one(reader, path)
        said = os.pread(noise, 500, 0).decode(errors="replace")
        outcome = Outcome(**asdict(outcome) | {"index": index, "size": len(data), "noise": said})
        send(outcome)
        enter(index, CHECKING)
        send(check(reader, data, outcome, found))
        found = None
    os._exit(0)
