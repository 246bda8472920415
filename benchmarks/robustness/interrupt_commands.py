"""``bench``, ``train``, ``detect`` and ``export`` interrupted at random moments: nothing is lost or half-written.

A moment sends SIGINT, SIGTERM or SIGHUP in turn to all processes of a command. Then

1. no process is left, no hidden file is left, and the command has printed one line;
2. every file that is there is whole: equal to the undisturbed run's, or, for a checkpoint, readable;
3. the same command (``train``: with --resume) finishes, and its files equal the undisturbed run's. The checkpoint of a
   training holds times, so its tensors are compared.

    python benchmarks/robustness/interrupt_commands.py [--moments 50] [--commands bench,train,detect,export]
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from kpbench import SynthConfig, generate, read_predictions

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
RECIPE = """name = "tiny"
batch = 4
seed = 1

[network]
widths = [4, 4, 8, 8]
depths = [1, 1, 1, 1]
down = "stride"
head_width = 8
descriptor_width = 8
ids = 4

[[phases]]
samples = 120
"""
TIMES = re.compile(rb'"(?:seconds|command|date|ms)": *[^,}]*')


@dataclass(frozen=True)
class Job:
    """A command, the words that continue it, the folder or file that it writes, and how its content is compared."""

    words: str
    out: str
    more: str = ""
    content: Callable[[Path], object] = lambda path: TIMES.sub(b"", path.read_bytes())


def tensors(path: Path) -> object:
    """The tensors of a checkpoint as bytes; the text of any other file does not count, as it holds times."""
    from safetensors.numpy import load_file

    return {k: v.tobytes() for k, v in load_file(path).items()} if path.suffix == ".safetensors" else None


JOBS = {
    "bench": Job("bench --images 1 --size 203x155 --only blur --detector orb --detector sift --workers 2", "out"),
    "train": Job("train --config tiny.toml --workers 1 --threads 1", "out", "--resume", tensors),
    "detect": Job("detect photos --detector template", "out.json"),
    "export": Job("export set --format coco", "out"),
}


def start(job: Job, folder: Path, more: str = "") -> subprocess.Popen[str]:
    # a shell's background jobs ignore Ctrl-C, and those of nohup SIGHUP; the command must not inherit that
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "signal.signal(signal.SIGHUP, signal.SIG_DFL); import kpbench.cli; kpbench.cli.main()"
    )
    words = [sys.executable, "-c", code, *job.words.split(), "--out", job.out, *more.split()]
    return subprocess.Popen(words, cwd=folder, stderr=subprocess.PIPE, text=True, stdout=-3, start_new_session=True)


def contents(job: Job, folder: Path) -> dict[str, object]:
    out = folder / job.out
    files = [out] if out.is_file() else [path for path in out.rglob("*") if path.is_file()]
    files = [path for path in files if not path.name.startswith(".") and path.parent.suffix != ".parts"]
    for part in out.rglob("*.parts/*.json"):  # finished work of a bench, which it keeps
        read_predictions(part)
    return {str(path.relative_to(folder)): job.content(path) for path in files}


def hidden(job: Job, folder: Path) -> list[str]:
    """Hidden files that a run left; the mark of an unfinished export belongs there."""
    names = [path.name for path in folder.rglob(".*")]
    return [name for name in names if name != ".kpbench-unfinished"]


def running(group: int) -> list[int]:
    found = []
    for entry in filter(str.isdigit, os.listdir("/proc")):
        try:
            fields = Path(f"/proc/{entry}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        found += [int(entry)] if int(fields[2]) == group and fields[0] != "Z" else []
    return found


def prepare(folder: Path, inputs: Path) -> None:
    folder.mkdir()
    for path in inputs.iterdir():
        (folder / path.name).symlink_to(path)


def moment(job: Job, folder: Path, number: signal.Signals, delay_s: float, expected: dict[str, object]) -> str:
    run = start(job, folder)
    time.sleep(delay_s)
    if run.poll() is None:
        os.killpg(run.pid, number)
    _, said = run.communicate(timeout=120)
    until = time.monotonic() + 5
    while running(run.pid) and time.monotonic() < until:
        time.sleep(0.02)
    assert not running(run.pid), "a process is left"
    if run.returncode == 0 or contents(job, folder) == expected:  # or all was done when the signal came
        kind = "finished"
    elif not said.startswith("kpbench: interrupted"):  # before Python had loaded the command
        kind = "early"
        assert run.returncode in (-number, 1, 128 + number), (run.returncode, said)
    else:
        kind = "struck"
        assert run.returncode == 128 + number, (run.returncode, said)
        assert len(said.splitlines()) == 1, said
    assert not hidden(job, folder), hidden(job, folder)
    left = contents(job, folder)
    if job.content is not tensors:
        assert left.items() <= expected.items(), f"half-written: {sorted(left.keys() - expected.keys())}"
    more = job.more if any(name.endswith(".safetensors") for name in left) else ""
    done = start(job, folder, more if kind != "finished" else "--help")
    _, said = done.communicate(timeout=300)
    assert done.returncode == 0, said
    after = contents(job, folder)
    if job.content is tensors:
        name = f"{job.out}/checkpoint.safetensors"
        assert after[name] == expected[name], "the resumed training differs"
    else:
        differing = sorted(k for k in after.keys() | expected.keys() if after.get(k) != expected.get(k))
        assert after == expected, f"the resumed run differs in {differing[:3]}"
    return kind


def strike_often(names: Sequence[str], moments: int, seed: int = 0) -> dict[str, dict[str, int]]:
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        inputs = base / "inputs"
        (inputs / "photos").mkdir(parents=True)
        for n in range(20):
            cv2.imwrite(str(inputs / "photos" / f"{n:02d}.png"), rng.integers(0, 255, (480, 640), np.uint8))
        generate(SynthConfig(150, size_px=(320, 240), shard_size=50), inputs / "set", workers=1)
        (inputs / "tiny.toml").write_text(RECIPE)
        tally = {}
        for name in names:
            job = JOBS[name]
            prepare(base / name, inputs)
            began = time.monotonic()
            run = start(job, base / name)
            assert run.wait() == 0, run.stderr and run.stderr.read()
            whole_s = time.monotonic() - began
            expected = contents(job, base / name)
            counts = {"early": 0, "struck": 0, "finished": 0}
            for n in range(moments):
                folder = base / f"{name}-{n}"
                prepare(folder, inputs)
                delay_s = float(rng.uniform(0.1, whole_s))
                try:
                    counts[moment(job, folder, SIGNALS[n % 3], delay_s, expected)] += 1
                except AssertionError as error:
                    raise AssertionError(f"{name}, {SIGNALS[n % 3].name} after {delay_s:.2f} s: {error}") from None
            tally[name] = counts
            print(f"{name}: {whole_s:.1f} s undisturbed; moments: {counts}", flush=True)
        return tally


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=50)
    parser.add_argument("--commands", default=",".join(JOBS))
    given = parser.parse_args()
    strike_often(given.commands.split(","), given.moments)
    print("no process, no hidden file, nothing half-written was left; every command continued to the same files")
