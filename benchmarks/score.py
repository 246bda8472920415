"""Time and peak memory of the evaluator on synthetic tables: 5 true keypoints and 6 detections an image.

    python benchmarks/score.py [IMAGES ...]           # default 10000 100000 1000000
    python benchmarks/score.py 100000 --files         # and write and read every file format

Each size runs in a process of its own, so that its peak memory is its own.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from kpbench.keypoints import KEYPOINT_DTYPE, Truth
from kpbench.predictions import Predictions, read_predictions, write_predictions
from kpbench.scoring import evaluate
from kpbench.tally import Settings

KEYPOINTS, CONDITIONS, RUNGS = 5, 5, 4


def tables(n: int, rng: np.random.Generator) -> tuple[Truth, Predictions]:
    """One patch type an image as in the suites; 5 % of keypoints missed, 3 % doubled, 15 % outside reach."""
    t = n * KEYPOINTS
    keypoints = np.zeros(t, KEYPOINT_DTYPE)
    xy = rng.uniform([0, 0], [640, 480], (t, 2))
    keypoints["x"], keypoints["y"] = xy.T
    keypoints["patch_id"] = np.repeat(rng.integers(0, 4, n), KEYPOINTS)
    keypoints["radius_major"] = rng.uniform(8, 40, t)
    keypoints["radius_minor"] = 0.8 * keypoints["radius_major"]
    image = np.arange(n)
    truth = Truth(
        image_id=image,
        offsets=np.arange(n + 1) * KEYPOINTS,
        keypoints=keypoints,
        condition=np.array(["blur", "dimming", "noise", "pitch", "scale"])[image % CONDITIONS],
        rung=(image // CONDITIONS % RUNGS).astype(float),
        scene_id=image // (CONDITIONS * RUNGS),
    )
    found = xy + rng.normal(0, 0.05, (t, 2)) * keypoints["radius_major"][:, None]
    lost = rng.random(t) < 0.05
    found[lost] = rng.uniform([0, 0], [640, 480], (int(lost.sum()), 2))
    extra = rng.uniform([0, 0], [640, 480], (n, 2))
    double = rng.random(n) < 0.15
    extra[double] = found[::KEYPOINTS][double] + 0.1
    xy = np.concatenate([found.reshape(n, KEYPOINTS, 2), extra[:, None]], axis=1).reshape(-1, 2)
    ids = np.concatenate([keypoints["patch_id"].reshape(n, KEYPOINTS), rng.integers(0, 4, (n, 1))], axis=1).ravel()
    offsets = np.arange(n + 1) * (KEYPOINTS + 1)
    return truth, Predictions(image, offsets, xy, rng.random(len(xy)), ids)


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(n: int, files: bool) -> None:
    truth, predictions = tables(n, np.random.default_rng(0))
    before = peak_mb()
    start = time.perf_counter()
    point = evaluate(truth, predictions, Settings(resamples=0))
    metrics_s = time.perf_counter() - start
    start = time.perf_counter()
    evaluate(truth, predictions)
    total_s = time.perf_counter() - start
    print(
        f"{n:>8} images: matching and metrics {metrics_s:6.2f} s, with intervals {total_s:6.2f} s, "
        f"peak {peak_mb():6.0f} MB, {before:.0f} MB of it the tables; "
        f"{len(point.by)} groups, detection score {point['detection_score']:.4f}"
    )
    with tempfile.TemporaryDirectory() as folder:
        for suffix in ("json", "jsonl", "csv", "parquet", "h5") if files else ():
            path = Path(folder) / f"preds.{suffix}"
            start = time.perf_counter()
            write_predictions(path, predictions)
            write_s = time.perf_counter() - start
            start = time.perf_counter()
            read_predictions(path)
            read_s = time.perf_counter() - start
            size = path.stat().st_size / 1e6
            print(f"{'':>8}   .{suffix:<8} {size:7.1f} MB, write {write_s:6.2f} s, read {read_s:6.2f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", nargs="*", type=int, default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--files", action="store_true")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        measure(args.images[0], args.files)
        return
    for n in args.images:
        command = [sys.executable, __file__, str(n), "--child", *(["--files"] if args.files else [])]
        subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
