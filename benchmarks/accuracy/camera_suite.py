"""What detectors lose under a camera: detection score and bias of each rung of a suite. Simulated.

The bias of an image is the length of the mean error vector of its matched keypoints in the patch's frame, px of the
mean radius. All six patches of an image have the same design, turn and nearly the same pose. The square of the mean's
own standard error is subtracted from its square. The bias of a rung is the root mean square over its images.

    python benchmarks/accuracy/camera_suite.py --backgrounds PHOTOS --images 8 --seed 1 2 --out FOLDER
        [--suite camera-v1] [--only CONDITION,…] [--detector NAME]… [--size WxH]

Two seeds show whether the detectors rank alike. Finished work in the folder is kept.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import kpbench
from kpbench.scoring.outcomes import Outcomes
from kpbench.types import Float

DETECTORS = ["superpoint-small", "superpoint", "template"]
LEAST_MATCHES = 4
"""An image with fewer matches has no bias."""


def biases(outcomes: Outcomes, keypoints: np.ndarray, image: np.ndarray, rows: np.ndarray) -> dict[int, float]:
    """Bias of each design, px, over the matched keypoints among ``rows``."""
    rows = rows[outcomes.matched[rows]]
    found = outcomes.detections.xy[outcomes.matches.detection[rows]]
    H = keypoints["H_patch2image"][rows]
    centre = H[:, :2, 2] / H[:, 2:, 2]
    A = (H[:, :2, :2] - centre[:, :, None] * H[:, 2:, :2]) / H[:, 2:, 2:]
    radius = np.sqrt(np.abs(np.linalg.det(A)))
    error = np.linalg.solve(A, (found - centre)[:, :, None])[:, :, 0] * radius[:, None]
    squares: dict[int, list[float]] = {}
    for n in np.unique(image[rows]):
        e: Float = error[image[rows] == n]
        if len(e) >= LEAST_MATCHES:
            patch_id = int(keypoints["patch_id"][rows][image[rows] == n][0])
            square = (e.mean(axis=0) ** 2).sum() - e.var(axis=0, ddof=1).sum() / len(e)
            squares.setdefault(patch_id, []).append(square)
    return {patch_id: float(np.sqrt(max(np.mean(values), 0.0))) for patch_id, values in squares.items()}


def table(run: kpbench.BenchRun) -> dict[tuple[str, float], tuple[float, float, float]]:
    """Detection score, bias (root mean square over designs, and largest) of each rung."""
    outcomes = run.scores.outcomes
    truth = outcomes.truth
    keypoints = np.concatenate([run.dataset.keypoints(n) for n in range(len(run.dataset))])
    image = np.repeat(np.arange(len(run.dataset)), [len(run.dataset.keypoints(n)) for n in range(len(run.dataset))])
    cells = {}
    for condition, rungs in run.scores.conditions.items():
        for rung in rungs:
            rows = np.flatnonzero((truth.condition[image] == condition) & (truth.rung[image] == rung))
            found = biases(outcomes, keypoints, image, rows)
            values = np.array(list(found.values())) if found else np.array([np.nan])
            score = float(outcomes.matched[rows].mean())
            cells[condition, rung] = (score, float(np.sqrt((values**2).mean())), float(values.max()))
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", default="camera-v1")
    parser.add_argument("--backgrounds", type=Path)
    parser.add_argument("--images", type=int, default=8, help="scenes; each is seen with four patches")
    parser.add_argument("--seed", type=int, nargs="+", default=[1])
    parser.add_argument("--only", default="")
    parser.add_argument("--size", default="")
    parser.add_argument("--detector", action="append")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    detectors = options.detector or DETECTORS
    size = tuple(map(int, options.size.split("x"))) if options.size else None
    orders = []
    for seed in options.seed:
        only = tuple(filter(None, options.only.split(",")))
        suite = kpbench.load_suite(options.suite)
        config = kpbench.SuiteConfig(suite, options.images, seed, size, only, options.backgrounds)
        runs = kpbench.bench([config], detectors, options.out / f"seed-{seed}", workers=1)
        tables = [table(run) for run in runs]
        print(f"\nseed {seed}, {options.images} scenes: detection score, bias px (largest design)\n")
        print("| condition | rung | " + " | ".join(detectors) + " | separates |")
        print("|---" * (len(detectors) + 3) + "|")
        separated = 0
        for key in tables[0]:
            cells = [t[key] for t in tables]
            best = max(cells)
            separates = 0.2 <= best[0] <= 0.95 or best[1] > 0.05
            separated += separates
            shown = " | ".join(f"{s:.3f}, {b:.3f} ({m:.2f})" for s, b, m in cells)
            print(f"| {key[0]} | {key[1]:g} | {shown} | {'yes' if separates else 'no'} |")
        print(f"\n{separated} of {len(tables[0])} rungs separate")
        mean = {name: np.mean([s for s, _, _ in t.values()]) for name, t in zip(detectors, tables, strict=True)}
        order = sorted(mean, key=lambda name: -mean[name])
        orders.append(order)
        print("mean over the rungs: " + ", ".join(f"{name} {mean[name]:.3f}" for name in order))
    if len(orders) > 1:
        print("the seeds rank the detectors " + ("alike" if all(o == orders[0] for o in orders) else "differently"))


if __name__ == "__main__":
    main()
