"""Where inside its pixel: four read-outs of the network, on the same keypoints.

    python benchmarks/accuracy/subpixel.py DATASET --backgrounds photos/ [--minutes 10] [--images 200]

pixel      the most probable pixel around the maximum
mean       the centre of mass of the probability, across the borders of cells (``kpbench.detectors.decode``)
refiner    the mean, moved by a small network that sees 24x24 px around it; it is trained first, for --minutes, on
           the crops that ``kpbench train`` makes, from --backgrounds
fit        the design, fitted to the pixels from the mean on (``kpbench.detectors.verify_candidates``)

Recall is the same for all: every keypoint counts that has a candidate of the network within half its short
semi-axis, with the nearest candidate. Prints the error (px), the share within ε = 0.1 of the radius, and the time per
candidate on one thread. DATASET must come from other photographs than --backgrounds.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import nn

import kpbench
from kpbench.detectors import SmallSuperPointDetector, keypoint_probability, verify_candidates
from kpbench.training import SampleConfig, load_photos, make_batch
from kpbench.types import Float, UInt8
from kpbench.workers import use_threads

SIDE = 24
FARTHEST_PX = 2.0
"""Distance of a start in the training of the refiner, each coordinate."""


def refiner() -> nn.Sequential:
    """100 k parameters; standardised windows (B, 1, 24, 24) to the keypoint's offset (B, 2) from their middle, px."""
    return nn.Sequential(
        nn.Conv2d(1, 24, 3, padding=1), nn.ReLU(), nn.Conv2d(24, 32, 3, 2, 1), nn.ReLU(),
        nn.Conv2d(32, 64, 3, 2, 1), nn.ReLU(), nn.Conv2d(64, 64, 3, padding=1), nn.ReLU(),
        nn.Flatten(), nn.Linear(64 * (SIDE // 4) ** 2, 16), nn.ReLU(), nn.Linear(16, 2),
    )  # fmt: skip


def windows(grey: UInt8, corner: NDArray[np.int64]) -> torch.Tensor:
    """Windows (n, 1, 24, 24) whose first pixels are at ``corner`` (n, 2), each with mean 0 and deviation 1."""
    padded = np.pad(grey, SIDE, mode="edge").astype(np.float32)
    x, y = np.clip(corner, -SIDE, (grey.shape[1], grey.shape[0])).T + SIDE
    cut = np.lib.stride_tricks.sliding_window_view(padded, (SIDE, SIDE))[y, x]
    cut = cut - cut.mean(axis=(1, 2), keepdims=True)
    return torch.from_numpy(cut / (cut.std(axis=(1, 2), keepdims=True) + 2.0))[:, None]


def corners(xy: Float) -> NDArray[np.int64]:
    """First pixels of the windows that have a place (n, 2) nearest to their middle."""
    return np.rint(xy - (SIDE - 1) / 2).astype(np.int64)


def trained(folder: Path, minutes: float, seed: int = 0) -> nn.Sequential:
    """A refiner after so many minutes of training crops."""
    patches, photos, config = kpbench.shipped_patches(), load_photos(folder, "training"), SampleConfig()
    torch.manual_seed(seed)
    rng, network = np.random.default_rng(seed), refiner()
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3)
    began, step, seen = time.monotonic(), 0, 0
    while (spent := (time.monotonic() - began) / 60 / minutes) < 1:
        optimizer.param_groups[0]["lr"] = 1e-3 * 0.5 * (1 + np.cos(np.pi * spent)) + 1e-5
        batch = make_batch(config, patches, photos, seed, step, 32, 1.0)
        cut, offset = list[torch.Tensor](), list[Float]()
        for image, keypoints in zip(batch.images, batch.keypoints, strict=True):
            truth = keypoints[(keypoints[:, 2] >= 0) & (keypoints[:, 3] == 0), :2].astype(np.float64)
            truth = np.repeat(truth, 4, axis=0)
            corner = corners(truth + rng.uniform(-FARTHEST_PX, FARTHEST_PX, truth.shape))
            cut.append(windows(image, corner))
            offset.append(truth - corner - (SIDE - 1) / 2)
        given, wanted = torch.cat(cut), torch.from_numpy(np.concatenate(offset).astype(np.float32))
        loss = F.smooth_l1_loss(network(given), wanted, beta=0.1)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        step, seen = step + 1, seen + len(given)
    count = sum(p.numel() for p in network.parameters())
    print(f"refiner: {count} parameters, {seen} windows in {minutes:.0f} minutes, last loss {loss.item():.4f}")
    return network.eval()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset")
    parser.add_argument("--backgrounds", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--images", type=int, default=200)
    options = parser.parse_args()
    use_threads(1)
    torch.set_num_threads(1)
    network = trained(options.backgrounds, options.minutes)
    dataset, detector = kpbench.open_dataset(options.dataset), SmallSuperPointDetector(threads=1, scales=(1.0,))
    errors: dict[str, list[Float]] = {name: [] for name in ("pixel", "mean", "refiner", "fit")}
    seconds, candidates = dict.fromkeys(errors, 0.0), 0
    radii, total = list[Float](), 0
    for n in range(min(options.images, len(dataset))):
        grey, keypoints = dataset[n]
        total += len(keypoints)
        xy, score, log_id, _ = detector.candidates([grey])[0]
        if not len(xy) or not len(keypoints):
            continue
        found = {"mean": xy}
        clock = time.perf_counter()
        found["pixel"] = highest(keypoint_probability(detector.heads([grey])[0][0]), xy)
        seconds["pixel"] += time.perf_counter() - clock
        clock = time.perf_counter()
        corner = corners(xy)
        with torch.inference_mode():
            found["refiner"] = corner + (SIDE - 1) / 2 + network(windows(grey, corner)).numpy().astype(np.float64)
        seconds["refiner"] += time.perf_counter() - clock
        clock = time.perf_counter()
        verified = verify_candidates(grey, xy, score, log_id, detector.patches)
        found["fit"] = xy.copy()
        found["fit"][verified.place] = verified.xy
        seconds["fit"] += time.perf_counter() - clock
        candidates += len(xy)
        truth = np.column_stack([keypoints["x"], keypoints["y"]])
        distance = np.linalg.norm(truth[:, None] - xy, axis=2)
        nearest, rows = distance.argmin(axis=1), np.arange(len(truth))
        near = distance[rows, nearest] <= 0.5 * keypoints["radius_minor"]
        radii.append(keypoints["radius_major"][near])
        for name, places in found.items():
            errors[name].append(np.linalg.norm(places[nearest] - truth, axis=1)[near])
    radius = np.concatenate(radii)
    print(f"{len(radius)} of {total} keypoints have a candidate; {candidates} candidates")
    print("| read-out | median, px | 95 %, px | within ε | within ε, radius 5 to 10 px | ms a candidate |")
    print("|---|---|---|---|---|---|")
    for name, parts in errors.items():
        error = np.concatenate(parts)
        good = error <= 0.1 * radius
        print(
            f"| {name} | {np.median(error):.3f} | {np.percentile(error, 95):.2f} | {good.mean():.3f} "
            f"| {good[radius < 10].mean():.3f} | {1e3 * seconds[name] / candidates:.2f} |"
        )


def highest(probability: NDArray[np.float32], xy: Float, reach: int = 3) -> Float:
    """The most probable pixel within ``reach`` of each place (n, 2)."""
    padded = np.pad(probability, reach, constant_values=-1.0)
    side = 2 * reach + 1
    x, y = np.clip(np.rint(xy).astype(np.int64), 0, np.array(probability.shape[::-1]) - 1).T
    cut = np.lib.stride_tricks.sliding_window_view(padded, (side, side))[y, x].reshape(len(xy), -1)
    row, column = np.unravel_index(cut.argmax(axis=1), (side, side))
    return np.column_stack([x + column - reach, y + row - reach]).astype(np.float64)


if __name__ == "__main__":
    main()
