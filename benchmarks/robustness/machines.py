"""One dataset made in four ways, which must all give the same bytes.

    python benchmarks/robustness/machines.py [--n 400] [--backgrounds photos/]

By one process, by two, by a real Dask scheduler with two worker processes of which one is killed when the first shards
are there, and by two halves of the shards (`--shard-range`) in folders of their own that are merged.
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import threading
import time
from pathlib import Path

import distributed

from kpbench import SynthConfig, generate, merge
from kpbench.dataset import generate_part


def by_dask(config: SynthConfig, out: Path) -> str:
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        doomed = cluster.workers[0].pid
        struck = []

        def strike() -> None:
            while len(list(out.glob("*.h5"))) < 3:
                time.sleep(0.01)
            os.kill(doomed, signal.SIGKILL)
            struck.append(len(list(out.glob("*.h5"))))

        threading.Thread(target=strike, daemon=True).start()
        fingerprint = generate(config, out, scheduler=cluster.scheduler_address).dataset.fingerprint
        assert struck, "the run ended before the worker was killed"
        print(f"worker {doomed} was killed when {struck[0]} shards were there")
        return fingerprint


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=400)
    parser.add_argument("--backgrounds", type=Path)
    options = parser.parse_args()
    config = SynthConfig(options.n, seed=5, shard_size=20, backgrounds=options.backgrounds)
    shards = -(-config.n // config.shard_size)
    with tempfile.TemporaryDirectory() as scratch:
        base = Path(scratch)
        for part, some in (("a", range(0, shards // 2)), ("b", range(shards // 2, shards))):
            generate_part(config, base / part, some, workers=1)
        found = {
            "one process": generate(config, base / "one", workers=1).dataset.fingerprint,
            "two processes": generate(config, base / "two", workers=2).dataset.fingerprint,
            "Dask, a worker killed": by_dask(config, base / "dask"),
            "two halves, merged": merge(base / "whole", [base / "a", base / "b"]).fingerprint,
        }
    for name, fingerprint in found.items():
        print(f"{name:22} {fingerprint}")
    assert len(set(found.values())) == 1, "they differ"


if __name__ == "__main__":
    main()
