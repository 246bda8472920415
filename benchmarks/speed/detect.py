"""How long the whole detect step takes, against PyTorch eager float32 of the plain SuperPoint.

    python benchmarks/speed/detect.py DATASET [--images 20]

For each detector, one image at a time, medians over the images: the network at all scales that it looks at; that with
its decoding, which gives places; the whole step, with verification by the designs; and the step without it, at one
scale. The rival is SuperPoint's network of the paper's size (64-64-128-128, 256) with random weights in PyTorch, the
network alone: its decoding is not counted. Runs are interleaved, so that a machine that slows down slows all.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch

import kpbench
from kpbench.detectors import SmallSuperPointDetector, SuperPointDetector
from kpbench.images import resize, to_grey
from kpbench.training import NetworkConfig, SuperPoint


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset")
    parser.add_argument("--images", type=int, default=20)
    options = parser.parse_args()
    dataset = kpbench.open_dataset(options.dataset)
    images = [to_grey(dataset.image(n)) for n in range(min(options.images, len(dataset)))]
    detectors: dict[str, tuple[SuperPointDetector, SuperPointDetector]] = {
        "superpoint-small": (SmallSuperPointDetector(), SmallSuperPointDetector(verified=False)),
        "superpoint": (SuperPointDetector(), SuperPointDetector(verified=False)),
    }
    torch.set_num_threads(kpbench.workers.count_cores())
    rival = SuperPoint(NetworkConfig()).eval()
    steps: dict[str, Callable[[np.ndarray], object]] = {"PyTorch eager": lambda image: _torch(rival, image)}
    for name, (detector, alone) in detectors.items():
        steps[f"{name}: network"] = lambda image, d=detector: [d.heads([view]) for view in _views(image, d)]
        steps[f"{name}: places"] = lambda image, d=detector: d.candidates([image])
        steps[f"{name}: whole"] = detector
        steps[f"{name}: not verified"] = alone
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for step in steps.values():
        step(images[0])
    for image in images:
        for name, step in steps.items():
            began = time.perf_counter()
            step(image)
            seconds[name].append(time.perf_counter() - began)
    floor = np.median(seconds["PyTorch eager"])
    height, width = images[0].shape[:2]
    print(f"{width}x{height}, {len(images)} images, medians")
    for name, times in seconds.items():
        median = np.median(times)
        print(f"{name:32} {1e3 * median:8.1f} ms {1 / median:7.1f} images/s {floor / median:6.1f} x")
    for name in detectors:
        network, places, whole = (np.median(seconds[f"{name}: {step}"]) for step in ("network", "places", "whole"))
        decoding, verification = places / network - 1, (whole - places) / network
        print(f"{name}: decoding {decoding:.0%} of the network's time, verification {verification:.0%}")


def _views(image: np.ndarray, detector) -> list[np.ndarray]:
    height, width = image.shape
    return [resize(image, round(scale * width), round(scale * height)) for scale in detector.view_scales(height, width)]


@torch.inference_mode()
def _torch(network: SuperPoint, image: np.ndarray) -> object:
    height, width = (side // 8 * 8 for side in image.shape)
    return network(torch.from_numpy(image[:height, :width].astype(np.float32) / 255)[None, None])


if __name__ == "__main__":
    main()
