"""How many images per second a training gets from ``kpbench.stream``, and from a dataset folder.

Both give batches of the same images through a ``DataLoader`` with one and two workers. The folder is written first, and
its pages are in the system's cache. The four ways take turns in every round, each in passes of the same images; the
first pass starts the workers and is not timed.

    python benchmarks/speed/stream.py --backgrounds photos/ [--n 600] [--rounds 5] [--batch 16]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import DataLoader

import kpbench


def count_per_second(loader: DataLoader[Any], n: int) -> float:
    """Return images per second of one pass."""
    start = time.perf_counter()
    count = sum(len(batch["image"]) for batch in loader)
    assert count == n
    return n / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backgrounds", type=Path, required=True)
    parser.add_argument("--n", type=int, default=600)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--batch", type=int, default=16)
    given = parser.parse_args()
    config = kpbench.SynthConfig(given.n, backgrounds=given.backgrounds)
    with tempfile.TemporaryDirectory() as folder:
        shards = kpbench.generate(config, Path(folder) / "set").dataset
        loaders = {}
        for workers in (1, 2):
            more: dict[str, Any] = {"num_workers": workers, "persistent_workers": True}
            images = kpbench.stream(config, batch_size=given.batch)
            loaders["stream", workers] = DataLoader(images, batch_size=None, **more)
            loaders["shards", workers] = DataLoader(shards, batch_size=given.batch, **more)  # type: ignore[arg-type]
        for loader in loaders.values():
            count_per_second(loader, given.n)
        rates: dict[tuple[str, int], list[float]] = {key: [] for key in loaders}
        for _ in range(given.rounds):
            for key, loader in loaders.items():
                rates[key].append(count_per_second(loader, given.n))
            print("  ".join(f"{name} {workers}: {r[-1]:.0f}/s" for (name, workers), r in rates.items()), flush=True)
    for (name, workers), found in rates.items():
        print(f"{name}, {workers} workers: {np.median(found):.0f} images/s ({min(found):.0f} to {max(found):.0f})")
    for workers in (1, 2):
        ratios = np.array(rates["stream", workers]) / np.array(rates["shards", workers])
        print(f"stream / shards, {workers} workers: {np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f})")


if __name__ == "__main__":
    main()
