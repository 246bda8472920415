"""How often the 95 % intervals hold the truth, in simulated experiments whose truth is known.

    python benchmarks/accuracy/coverage.py [--experiments 1000]

A scene has a quality of its own, shared by all its images; keypoints are found and named and false alarms raised at
random with chances that depend on it. The metrics' true values follow from the distribution. The intervals are those
of ``kpbench score``.
"""

from __future__ import annotations

import argparse

import numpy as np

from kpbench.scoring import SUMS, bootstrap_intervals, compute_ratios

IMAGES, KEYPOINTS = 8, 6  # of a scene; of an image
REGIMES = {"good": (18.0, 2.0), "middling": (3.0, 2.0), "poor": (1.0, 4.0)}  # Beta distribution of the quality
CHECKED_METRICS = ("detection_score", "id_matching_score", "average_false_alarm", "precision", "f1")


def experiment(rng: np.random.Generator, scenes: int, quality: tuple[float, float]) -> np.ndarray:
    """(scenes, 9) sums of one experiment."""
    q = rng.beta(*quality, scenes)
    truths = rng.binomial(IMAGES * KEYPOINTS, 0.5 + 0.5 * rng.random(scenes))
    matched = rng.binomial(truths, q)
    correct = rng.binomial(matched, 0.7 + 0.3 * q)
    alarms = rng.poisson(IMAGES * (1.0 - q))
    n = dict.fromkeys(SUMS, np.zeros(scenes, np.int64))
    n |= {"images": np.full(scenes, IMAGES), "truths": truths, "detections": matched + alarms, "matched": matched}
    n |= {"id_correct": correct, "matched_literal": matched, "id_correct_literal": correct}
    return np.stack([n[name] for name in SUMS], axis=1)


def true_values(quality: tuple[float, float]) -> dict[str, float]:
    """Ratios of expectations, which is what a ratio of sums tends to."""
    a, b = quality
    q = a / (a + b)
    q2 = a * (a + 1) / ((a + b) * (a + b + 1))
    truths = 0.75 * IMAGES * KEYPOINTS
    alarms = IMAGES * (1 - q)
    found = truths * q
    return {
        "detection_score": q,
        "id_matching_score": (0.7 * q + 0.3 * q2) / q,
        "average_false_alarm": alarms / IMAGES,
        "precision": found / (found + alarms),
        "f1": 2 * found / (truths + found + alarms),
    }


def coverage(scenes: int, regime: str, experiments: int, resamples: int = 1000, seed: int = 0) -> dict[str, float]:
    """Share of experiments whose interval holds the true value, for each metric."""
    rng = np.random.default_rng(seed)
    truth = true_values(REGIMES[regime])
    held = dict.fromkeys(CHECKED_METRICS, 0)
    for n in range(experiments):
        sums = experiment(rng, scenes, REGIMES[regime])
        found = bootstrap_intervals(sums, lambda s: compute_ratios(s, "one-to-one"), resamples, seed=n)
        for name in CHECKED_METRICS:
            both = found[name]
            held[name] += both is not None and both[0] <= truth[name] <= both[1]
    return {name: count / experiments for name, count in held.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--experiments", type=int, default=1000)
    parser.add_argument("--scenes", type=int, nargs="*", default=[20, 50, 100, 500])
    args = parser.parse_args()
    print(f"{'scenes':>6} {'regime':<10}" + "".join(f"{name:>22}" for name in CHECKED_METRICS))
    for scenes in args.scenes:
        for regime in REGIMES:
            shares = coverage(scenes, regime, args.experiments)
            print(f"{scenes:>6} {regime:<10}" + "".join(f"{share:>22.3f}" for share in shares.values()))


if __name__ == "__main__":
    main()
