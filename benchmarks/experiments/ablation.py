"""What each part of the recipe is worth: short trainings from nothing that differ in one thing each.

    python benchmarks/experiments/ablation.py --backgrounds photos/ [--samples 48000] [--only reference ...]

All are `configs/reference.toml` in bfloat16 with a warm-up over a tenth of the samples and one phase of severity 0 to
0.5, one thread each, as many at once as there are cores. Prints the share of keypoints found within 3 px and 1 px,
right IDs among the former, and false alarms an image, of the network alone on its validation scenes (200 images of
640x480, from photographs that the training does not see, without and with deteriorations). The reference is trained
twice: what its two seeds differ by is chance.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest import mock

from torch import nn
from tqdm import tqdm

from kpbench import load_patches, shipped_patches
from kpbench.training import Phase, Recipe, TrainOptions, load_recipe, train
from kpbench.workers import count_cores, use_threads

RUNNER_UP = Path(__file__).parents[1] / "designs" / "runner-up"


def _as_it_is(recipe: Recipe) -> Recipe:
    return recipe


def _another_seed(recipe: Recipe) -> Recipe:
    """Other first weights, other crops, other validation scenes."""
    return replace(recipe, seed=4)


def _no_deterioration(recipe: Recipe) -> Recipe:
    return replace(recipe, phases=(Phase(recipe.phases[0].samples, severity=(0.0, 0.0)),))


def _no_lookalikes(recipe: Recipe) -> Recipe:
    mock.patch("kpbench.training.crops.draw_lookalikes").start()
    return recipe


def _one_scale(recipe: Recipe) -> Recipe:
    mock.patch.dict("kpbench.training.crops.VIEW_SCALES", {1.0: 1.0}, clear=True).start()
    return recipe


def _no_batch_norm(recipe: Recipe) -> Recipe:
    nn.BatchNorm2d = lambda *_, **__: nn.Identity()
    return recipe


def _papers(recipe: Recipe) -> Recipe:
    """Its network takes ten times as long a crop, so that it sees a tenth of the crops in about the same time."""
    paper = load_recipe("paper")
    phase = replace(recipe.phases[0], samples=recipe.phases[0].samples // 10)
    return replace(recipe, network=paper.network, loss=paper.loss, phases=(phase,), warmup=recipe.warmup // 10)


VARIANTS: dict[str, Callable[[Recipe], Recipe]] = {
    "reference": _as_it_is,
    "reference, another seed": _another_seed,
    "runner-up designs": _as_it_is,
    "no deterioration": _no_deterioration,
    "no look-alikes": _no_lookalikes,
    "one scale": _one_scale,
    "no BatchNorm": _no_batch_norm,
    "the paper's network and losses, a tenth of the crops": _papers,
}


def run(name: str, backgrounds: Path, samples: int) -> dict[str, float]:
    """The last validation of one variant."""
    use_threads(1)
    recipe = load_recipe("reference")
    phase = Phase(samples, severity=(0.0, 0.5))
    recipe = replace(recipe, precision="bf16", seed=3, warmup=samples // 10, phases=(phase,))
    recipe = VARIANTS[name](recipe)
    patches = load_patches((RUNNER_UP,)) if name.startswith("runner-up") else shipped_patches()
    with tempfile.TemporaryDirectory() as folder:
        train(
            recipe,
            folder,
            backgrounds,
            patches=patches,
            options=TrainOptions(workers=0, threads=1, validate_every=1e9, validation_images=200),
        )
        return json.loads((Path(folder) / "log.jsonl").read_text().splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backgrounds", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=48_000)
    parser.add_argument("--only", action="append", choices=list(VARIANTS))
    options = parser.parse_args()
    names = options.only or list(VARIANTS)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count_cores(), spawn, max_tasks_per_child=1) as pool:
        work = partial(run, backgrounds=options.backgrounds, samples=options.samples)
        print("| variant | samples | minutes | clean: found 3 px / 1 px, id, alarms | paper: the same |")
        print("|---|---|---|---|---|")
        for name, last in zip(names, tqdm(pool.map(work, names), "ablation", len(names)), strict=True):
            cells = (
                "{found_3px:.3f} / {found_1px:.3f}, {id:.3f}, {alarms:.2f}".format(
                    **{key.removeprefix(f"{kind}_"): value for key, value in last.items() if key.startswith(f"{kind}_")}
                )
                for kind in ("clean", "paper")
            )
            print(f"| {name} | {last['samples']} | {last['minutes']:.1f} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
