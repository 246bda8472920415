"""What becomes of a damaged shard: bytes flipped, files cut off. Each must be refused with one line.

    python benchmarks/robustness/damage.py [--flips 500] [--cuts 100]

A small dataset is made; at evenly spaced positions of its shard one byte is inverted, and it is read. Counted
is what `kpbench verify` says and what reading all images and columns says without it: "refused" with a one-line
DataError, or "same", all values as they were (the byte is padding, or in `/background`, which is for people).
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

import kpbench
from kpbench import SynthConfig, generate
from kpbench.errors import DataError


def read(folder: Path) -> bytes:
    """All values of a dataset."""
    dataset = kpbench.open_dataset(folder)
    parts = [dataset.image(n).tobytes() + dataset.keypoints(n).tobytes() for n in range(len(dataset))]
    texts = [str(dataset.effects(n)) for n in range(len(dataset))]
    truth = dataset.truth
    columns = [np.asarray(v).tobytes() for v in (truth.image_id, truth.condition, truth.rung, truth.scene_id)]
    return b"".join([*parts, "".join(texts).encode(), *columns])


def outcome(folder: Path, before: bytes) -> str:
    try:
        return "same" if read(folder) == before else "OTHER VALUES"
    except DataError as error:
        return "TWO LINES" if "\n" in str(error) else "refused"
    except Exception as error:
        return f"TRACEBACK {type(error).__name__}"


def verified(folder: Path) -> str:
    try:
        list(kpbench.open_dataset(folder).verify())
    except DataError as error:
        return "TWO LINES" if "\n" in str(error) else "refused"
    return "NOT SEEN"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flips", type=int, default=500)
    parser.add_argument("--cuts", type=int, default=100)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "set"
        generate(SynthConfig(6, size_px=(96, 64)), folder, workers=1)
        before, shard = read(folder), folder / "shard-00000.h5"
        whole = shard.read_bytes()
        for what, count in (("flipped", options.flips), ("cut off", options.cuts)):
            reading, verifying = Counter[str](), Counter[str]()
            for at in np.linspace(0, len(whole) - 1, count).astype(int).tolist():
                damaged = whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :] if what == "flipped" else whole[:at]
                shard.write_bytes(damaged)
                reading[outcome(folder, before)] += 1
                verifying[verified(folder)] += 1
            print(f"{what} at {count} of {len(whole)} bytes: reading {dict(reading)}, verify {dict(verifying)}")
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
