"""Read hundreds of thousands of broken files with every reader of kpbench, and tell how it took them.

    python benchmarks/robustness/fuzz.py [--inputs 200000] [--only READER]... [--seed 0] [--workers 2] [--json FILE]
    python benchmarks/robustness/fuzz.py --only READER --index N --keep FILE    # one input alone, and the file itself

Each input is a valid file with changes in what it holds (values, keys, cells, HDF5 objects, PNG chunks, fields of ONNX)
and in its bytes. Input number N of a reader is a function of (seed, reader, N) alone. Counted is:

accepted    read without an error
refused     a KpbenchError whose message is one line that names the file
traceback   any other exception
bad line    a KpbenchError without the file name, with a line break or control character, or over 1000 characters
hang        more than 3 s of processor time; the worker is killed
crash       the process ended
memory      more than 512 MiB of memory for a file of a few kilobytes
wrong       accepted, and different from what a plain parser reads (json, csv, tomllib, h5py, Pillow, ...)

"past header" is the share of inputs whose container a plain parser reads, "lines" the number of inputs at which a
library wrote to standard error by itself, "ms" the mean time of the reader. The exit code is 1 if anything but accepted
and refused was counted. Readers, valid files and changes are in the folder ``fuzzing``; a new reader is one more entry
of the table in ``fuzzing/readers.py``.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shlex
import signal
import sys
import time
import warnings
from collections import Counter, defaultdict
from dataclasses import asdict
from pathlib import Path
from typing import Any

os.environ |= {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "ORT_DISABLE_TELEMETRY": "1",
    "NO_ALBUMENTATIONS_UPDATE": "1",
}
sys.path.insert(0, str(Path(__file__).parent))

from fuzzing.readers import READERS, Reader
from fuzzing.supervise import in_child, run, scratch_folder
from fuzzing.worker import BAD, KINDS, Outcome, check, clean, read_one

CHUNK = 500  # inputs that a worker reads before another one is forked
LEAST = 5000  # inputs of each reader, in a run of 200,000


def counts(readers: list[Reader], inputs: int) -> dict[str, int]:
    """Inputs of each reader, by its share, but no fewer than a fortieth of all."""
    total = sum(reader.share for reader in readers)
    return {reader.name: max(round(inputs * reader.share / total), min(LEAST, inputs // 40)) for reader in readers}


def check_seeds(reader: Reader, valid: list[bytes], scratch: Path) -> list[str]:
    """Valid files that kpbench does not read, or reads as something else: the harness is wrong then, not kpbench."""
    where = scratch / f"valid-{reader.name}"
    where.mkdir()
    faults = []
    for n, seed in enumerate(valid):
        data, found = reader.as_seed(seed), None
        clean(where)
        (where / reader.file).write_bytes(data)
        outcome, found = read_one(reader, where / reader.file)
        outcome = check(reader, data, outcome, found)
        if outcome.kind != "accepted":
            faults.append(f"{reader.name}: valid file {n} is {outcome.kind}: {outcome.cause} {outcome.message}")
    return faults


def prepare(readers: list[Reader], scratch: Path) -> dict[str, list[bytes]]:
    """Load what the readers need and make their valid files."""
    warnings.simplefilter("ignore")
    for reader in readers:
        for module in reader.imports:
            importlib.import_module(module)
    valid = {reader.name: in_child(reader.seeds) for reader in readers}
    for reader in readers:
        if faults := in_child(lambda reader=reader: check_seeds(reader, valid[reader.name], scratch)):
            sys.exit("\n".join(faults))
    return valid


def fuzz(readers: list[Reader], inputs: int, seed: int, workers: int) -> dict[str, list[Outcome]]:
    """Read all inputs; outcomes of each reader."""
    found: dict[str, list[Outcome]] = defaultdict(list)
    with scratch_folder() as scratch:
        valid = prepare(readers, scratch)
        jobs = [
            (reader, valid[reader.name], range(first, min(first + CHUNK, count)))
            for reader in readers
            for count in [counts(readers, inputs)[reader.name]]
            for first in range(0, count, CHUNK)
        ]
        run(jobs, seed, workers, scratch, lambda reader, outcome: found[reader.name].append(outcome))
    return found


def replay(reader: Reader, seed: int, index: int, keep: Path | None) -> Outcome:
    """Make and read one input."""
    outcomes: list[Outcome] = []
    with scratch_folder() as scratch:
        valid = prepare([reader], scratch)
        if keep is not None:
            keep.write_bytes(in_child(lambda: reader.make(seed, index, valid[reader.name])))
        job = (reader, valid[reader.name], range(index, index + 1))
        run([job], seed, 1, scratch, lambda _, outcome: outcomes.append(outcome))
    return outcomes[0]


def table(found: dict[str, list[Outcome]]) -> str:
    """How many inputs of each reader came to what."""
    rows = [["reader", "inputs", "past header", *KINDS, "lines", "ms"]]
    every = [outcome for outcomes in found.values() for outcome in outcomes]
    for name, outcomes in [*found.items(), ("all", every)]:
        kinds, noisy = Counter(outcome.kind for outcome in outcomes), sum(bool(outcome.noise) for outcome in outcomes)
        ms = sum(outcome.ms for outcome in outcomes) / max(len(outcomes), 1)
        told = [f"{len(outcomes)}", f"{100 * share_past_header(outcomes):.0f} %", *(f"{kinds[k]}" for k in KINDS)]
        rows.append([name, *told, f"{noisy}", f"{ms:.1f}"])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [[cell.rjust(width) for cell, width in zip(row, widths, strict=True)] for row in rows]
    return "\n".join("  ".join([row[0].ljust(widths[0]), *line[1:]]) for row, line in zip(rows, lines, strict=True))


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """What a program wants to know of the inputs of a reader."""
    return {
        "inputs": len(outcomes),
        "past_header": share_past_header(outcomes),
        "kinds": dict(Counter(outcome.kind for outcome in outcomes)),
        "bad": [asdict(outcome) for outcome in outcomes if outcome.kind in BAD],
        "raw_lines": [asdict(outcome) for outcome in outcomes if outcome.noise],
    }


def share_past_header(outcomes: list[Outcome]) -> float:
    """The share of inputs whose container a plain parser reads."""
    known = [outcome.header for outcome in outcomes if outcome.header is not None]
    return sum(known) / max(len(known), 1)


def causes(found: dict[str, list[Outcome]], seed: int) -> list[str]:
    """A line a cause: how often, what, and how to see the smallest input of it again."""
    groups: dict[tuple[str, str, str], list[Outcome]] = defaultdict(list)
    for name, outcomes in found.items():
        for outcome in outcomes:
            if outcome.kind in BAD:
                groups[name, outcome.kind, outcome.cause].append(outcome)
    lines = []
    for (name, kind, cause), outcomes in sorted(groups.items(), key=lambda item: (item[0][0], -len(item[1]))):
        smallest = min(outcomes, key=lambda outcome: (outcome.size, outcome.index))
        again = f"fuzz.py --seed {seed} --only {name} --index {smallest.index} --keep FILE"
        lines.append(f"{len(outcomes):6} {name}: {kind}: {cause}\n       {again}  # {smallest.message[:160]!r}")
    return lines


def main() -> None:
    """Parse the command line, read, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=200_000)
    parser.add_argument("--only", action="append", choices=list(READERS), metavar="READER")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--json", type=Path, help="Write a summary of each reader, and all outcomes but accepted and refused."
    )
    parser.add_argument("--index", type=int)
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    readers = [READERS[name] for name in given.only or READERS]
    if given.index is not None:
        if len(readers) != 1:
            parser.error("--index needs one --only READER")
        for key, value in asdict(replay(readers[0], given.seed, given.index, given.keep)).items():
            print(f"{key}: {value}")
        return
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the folder of inputs is removed
    began = time.monotonic()
    found = fuzz(readers, given.inputs, given.seed, given.workers)
    bad = causes(found, given.seed)
    print(table(found))
    print(f"{time.monotonic() - began:.0f} s with {given.workers} workers; {shlex.join(['python', *sys.argv])}")
    if bad:
        print(f"\n{len(bad)} causes:\n" + "\n".join(bad))
    if given.json:
        given.json.write_text(json.dumps({name: summary(outcomes) for name, outcomes in found.items()}, indent=1))
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
