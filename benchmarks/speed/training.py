"""Training throughput, samples a second, and what bounds it.

    python benchmarks/speed/training.py --config reference --backgrounds photos/ [--threads 1] [--batches 20]

generator  one process that makes batches, and nothing else: what one of ``--workers`` of ``kpbench train`` delivers
step       forward, backward and optimizer on a batch that is there already, on a GPU where there is one
train      ``kpbench train`` whole, with one worker

In turn, three rounds, medians. The step bounds the training if it is slower than the workers together.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from kpbench.patches import shipped_patches
from kpbench.training import Phase, TrainOptions, load_photos, load_recipe, make_batch, start_state, train, train_step

ROUNDS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", required=True)
    parser.add_argument("--backgrounds", type=Path, required=True)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--batches", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    recipe = load_recipe(options.config)
    samples = options.batches * recipe.batch
    recipe = replace(recipe, phases=(Phase(samples, severity=(1.0, 1.0)),), warmup=0)
    patches, photos = shipped_patches(), load_photos(options.backgrounds, "training")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    state = start_state(recipe, device)
    ready = make_batch(recipe.samples, patches, photos, 0, 0, recipe.batch, 1.0)
    images, keypoints = (torch.from_numpy(part).to(device) for part in ready)

    def generate() -> None:
        for index in range(options.batches):
            make_batch(recipe.samples, patches, photos, 0, index, recipe.batch, 1.0)

    def steps() -> None:
        for _ in range(options.batches):
            state.step = 0
            train_step(state, state.network, images, keypoints)
        if device.type == "cuda":
            torch.cuda.synchronize()

    def whole() -> None:
        with tempfile.TemporaryDirectory() as folder:
            how = TrainOptions(threads=options.threads, validation_images=1)
            train(recipe, folder, options.backgrounds, options=how)

    rivals: dict[str, Callable[[], None]] = {"generator": generate, "step": steps, "train": whole}
    rates: dict[str, list[float]] = {name: [] for name in rivals}
    steps()
    for _ in range(ROUNDS):
        for name, work in rivals.items():
            began = time.perf_counter()
            work()
            rates[name].append(samples / (time.perf_counter() - began))
    print(f"{recipe.name}, batch {recipe.batch}, {recipe.samples.size} px, {device.type}, threads {options.threads}")
    for name, rate in rates.items():
        print(f"{name:10} {np.median(rate):8.1f} samples/s  ({min(rate):.1f} to {max(rate):.1f})")


if __name__ == "__main__":
    main()
