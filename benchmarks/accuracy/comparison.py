"""How often paired intervals hold the true difference, and how often tests err, in simulated experiments.

    python benchmarks/accuracy/comparison.py [--experiments 1000] [--scenes 20 50 100 500]

A scene has a difficulty of its own, shared by both detectors. Keypoints are found and false alarms raised at random
with chances that depend on it. The true differences follow from the distribution. The intervals and p-values are those
of ``kpbench compare``.

Columns: coverage of the 95 % intervals of two metrics; share of p-values of at most 0.05 between equal detectors;
share of experiments of 20 rungs with a false difference, by plain and by Holm's p-values; share of experiments in which
a detector that is worse by exactly the margin is called no worse (nominal: 0.025). The last lines: for several margins,
the number of scenes that ``kpbench plan`` gives for two equal detectors, and the share of experiments with this number
that call the first no worse (nominal: 0.9). The standard deviation between scenes comes from 5,000 scenes.
"""

from __future__ import annotations

import argparse

import numpy as np

from kpbench.scoring import adjust_holm, bootstrap_intervals, exchange_test
from kpbench.scoring.planning import count_scenes

KEYPOINTS, RUNGS = 24, 20
LOSS = 0.05
"""True difference of the detection scores of two unequal detectors, and the margin."""


def experiment(rng: np.random.Generator, scenes: int, loss: float) -> np.ndarray:
    """(scenes, 6) matches, true keypoints and false alarms of the first detector, then of the second detector."""
    quality = 0.3 + 0.6 * rng.beta(3, 2, scenes)
    truths = rng.binomial(KEYPOINTS, 0.5 + 0.5 * rng.random(scenes))
    runs = []
    for less in (loss, 0):
        runs += [rng.binomial(truths, quality - less), truths, rng.poisson(3 * (1 - quality + less))]
    return np.stack(runs, axis=1)


def difference(sums: np.ndarray) -> dict[str, np.ndarray]:
    score = sums[..., 0] / sums[..., 1] - sums[..., 3] / sums[..., 4]
    return {"score": score, "alarms": (sums[..., 2] - sums[..., 5]) / (sums[..., 1] + sums[..., 4]) * 2}


def measure(scenes: int, experiments: int, seed: int) -> list[float]:
    rng = np.random.default_rng(seed)
    truth = {"score": -LOSS, "alarms": 3 * LOSS / (0.75 * KEYPOINTS)}
    held, no_worse = dict.fromkeys(truth, 0), 0
    for n in range(experiments):
        found = bootstrap_intervals(experiment(rng, scenes, LOSS), difference, 1000, seed=n)
        for name, true in truth.items():
            held[name] += found[name][0] <= true <= found[name][1]
        no_worse += found["score"][0] >= -LOSS
    p = np.array([exchange_test(experiment(rng, scenes, 0), difference, n)["score"] for n in range(experiments)])
    families = p[: len(p) // RUNGS * RUNGS].reshape(-1, RUNGS)
    holm = np.array([adjust_holm(family) for family in families])
    any_false = [np.mean((values <= 0.05).any(axis=1)) for values in (families, holm)]
    return [*(count / experiments for count in held.values()), np.mean(p <= 0.05), *any_false, no_worse / experiments]


def measure_power(margin: float, experiments: int, seed: int) -> tuple[int, float]:
    """Planned number of scenes, and share of experiments that call equal detectors no worse."""
    rng = np.random.default_rng(seed)
    many = experiment(rng, 5000, 0)
    without_one = difference(many.sum(axis=0) - many)["score"]
    scenes = count_scenes(float((len(many) - 1) * np.std(without_one, ddof=1)), margin, paired=True)
    lows = [
        bootstrap_intervals(experiment(rng, scenes, 0), difference, 1000, n)["score"][0] for n in range(experiments)
    ]
    return scenes, float(np.mean(np.array(lows) >= -margin))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--experiments", type=int, default=1000)
    parser.add_argument("--scenes", type=int, nargs="*", default=[20, 50, 100, 500])
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    columns = ("score", "alarms", "p<=0.05", "any plain", "any Holm", "no worse")
    print(f"{'scenes':>6}" + "".join(f"{name:>11}" for name in columns))
    for scenes in args.scenes:
        print(f"{scenes:>6}" + "".join(f"{x:>11.3f}" for x in measure(scenes, args.experiments, args.seed)), flush=True)
    for margin in (0.1, 0.05, 0.02):
        scenes, power = measure_power(margin, args.experiments, args.seed)
        print(f"margin {margin:g}: {scenes} scenes planned, power {power:.3f}", flush=True)


if __name__ == "__main__":
    main()
