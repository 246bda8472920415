"""Runs of ``kpbench synth`` that are killed, interrupted or starved at random moments, and what is left of them.

Kinds: ``parent`` (kill -9 of the command), ``worker`` (kill -9 of one of its processes), ``interrupt`` (Ctrl-C),
``terminate`` (SIGTERM) and ``hangup`` (SIGHUP) to all processes, ``disk`` (all free space of a tmpfs is taken; needs
the right to mount one). After each, every shard that is there must equal that of an undisturbed run and the folder must
not open as a dataset unless it is whole; then ``--resume`` must give the undisturbed run's bytes in every file.
``interrupt_commands.py`` does the like for other commands.

    python benchmarks/robustness/interrupt.py [--moments 50] [--kinds parent,worker,interrupt,terminate,hangup,disk]
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

import numpy as np

from kpbench import SynthConfig, generate, open_dataset
from kpbench.errors import DataError
from kpbench.files import sha256_of

CONFIG = SynthConfig(n=48, size_px=(320, 240), shard_size=4)
WORDS = ["synth", "--n", "48", "--size", "320x240", "--shard-size", "4", "--workers", "2"]
KINDS = ("parent", "worker", "interrupt", "terminate", "hangup", "disk")
SIGNALS = {"interrupt": signal.SIGINT, "terminate": signal.SIGTERM, "hangup": signal.SIGHUP}


def start(out: Path, *more: str) -> subprocess.Popen[str]:
    # a shell's background jobs ignore Ctrl-C, and those of nohup SIGHUP; the command must not inherit that
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "signal.signal(signal.SIGHUP, signal.SIG_DFL); import kpbench.cli; kpbench.cli.run()"
    )
    words = [sys.executable, "-c", code, *WORDS, "--out", str(out), *more]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def digests(folder: Path) -> dict[str, str]:
    return {path.name: sha256_of(path) for path in sorted(folder.iterdir()) if not path.name.startswith(".")}


def children(pid: int) -> list[int]:
    """Worker processes of a command: those of its children that are started by multiprocessing's spawn."""
    found = []
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        line = Path(f"/proc/{child}/cmdline").read_bytes()
        found += [int(child)] if b"spawn_main" in line else []
    return found


@contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[None]:
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", folder], check=True)


def strike(kind: str, run: subprocess.Popen[str], out: Path) -> None:
    if kind == "parent":
        run.kill()
    elif kind in SIGNALS:
        os.killpg(run.pid, SIGNALS[kind])
    elif kind == "worker":
        for child in children(run.pid)[:1]:
            os.kill(child, signal.SIGKILL)
    else:
        with (out.parent / "filler").open("wb", buffering=0) as file:
            for block in (2**20, 4096):
                try:
                    while True:
                        file.write(b"x" * block)
                except OSError:
                    pass


def moment(kind: str, shards: int, delay_s: float, folder: Path, expected: dict[str, str]) -> str:
    """One run, disturbed a while after so many shards are there, and resumed; "struck" if that was before the end."""
    out = folder / "set"
    run = start(out)
    while run.poll() is None and not ((out / ".kpbench.lock").exists() and len(list(out.glob("*.h5"))) >= shards):
        time.sleep(0.002)
    time.sleep(delay_s)
    strike(kind, run, out)
    _, said = run.communicate(timeout=120)
    (folder / "filler").unlink(missing_ok=True)
    left = digests(out) if out.exists() else {}
    assert left.items() <= expected.items(), f"{kind}: something half-written is listed: {sorted(left)}"
    if run.returncode != 0:
        assert "Traceback" not in said, said
        assert kind not in SIGNALS or not list(out.glob(".*")), "a hidden file is left"
        assert kind == "parent" or "--resume" in said, said
        with suppress(DataError):
            assert "dataset.json" in left, open_dataset(out)
    generate(CONFIG, out, workers=1, resume=True)
    assert digests(out) == expected, f"{kind}: the resumed run differs"
    assert not list(out.glob(".*.part")), "a temporary file is left"
    return "finished" if run.returncode == 0 else "struck"


def strike_often(kinds: Sequence[str], moments: int, seed: int = 0) -> dict[str, dict[str, int]]:
    """How many moments of each kind came before and after the end of the run; raises at the first that does harm."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        generate(CONFIG, base / "undisturbed", workers=1)
        expected = digests(base / "undisturbed")
        tally = {kind: {"struck": 0, "finished": 0} for kind in kinds}
        for kind, n in itertools.product(kinds, range(moments)):
            folder = base / f"{kind}-{n}"
            folder.mkdir()
            with small_disk(folder, 64) if kind == "disk" else nullcontext():
                when = int(rng.integers(12)), float(rng.uniform(0, 0.2))
                tally[kind][moment(kind, *when, folder, expected)] += 1
        return tally


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=50)
    parser.add_argument("--kinds", default=",".join(KINDS))
    given = parser.parse_args()
    for kind, found in strike_often(given.kinds.split(","), given.moments).items():
        print(f"{kind}: {found['struck']} moments before the end, {found['finished']} after it")
    print("every shard left was as undisturbed, every resumed run equal in every file")
