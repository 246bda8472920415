"""Fit the weights of :mod:`kpbench.verify` to a synthetic set, and show what they give on its other half.

    python benchmarks/verification.py DATASET [--model FILE.onnx]

The set must come from photographs that are free for fitting: `kpbench synth --n 400 --backgrounds training/`.
A place is right if its fitted centre lies within a tenth of the radius of a keypoint and its design is right.
Prints the two constants, and the detection score at several rates of false alarms for the images of odd index,
on which they were not fitted: with and without verification.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

import kpbench
from kpbench import verify
from kpbench.detectors.superpoint import CANDIDATE, SmallSuperPointDetector, SuperPointDetector
from kpbench.workers import one_thread


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset")
    parser.add_argument("--model")
    parser.add_argument("--images", type=int, help="only the first so many")
    options = parser.parse_args()
    one_thread()
    dataset = kpbench.open_dataset(options.dataset)
    detector = SuperPointDetector(options.model) if options.model else SmallSuperPointDetector()
    plain = type(detector)(detector.path, CANDIDATE, verified=False)
    evidence, right, alone, alone_right, odd, truths = [], [], [], [], [], [0, 0]
    looked = verify.examine

    def examine(*arguments: object) -> verify.Examined:
        found = looked(*arguments)
        evidence.append(found.evidence)
        ids = np.array([patch.patch_id for patch in detector.patches])[found.which]
        right.append(_right(found.xy, ids, keypoints))
        odd.append(np.full(len(ids), n % 2))
        return found

    verify.examine = examine
    count = min(options.images or len(dataset), len(dataset))
    for n in range(count):
        image, keypoints = dataset[n]
        truths[n % 2] += len(keypoints)
        detector(image)
        found = plain(image)
        if n % 2:
            alone.append(found.score)
            alone_right.append(_right(found.xy, found.patch_id, keypoints))
        if sys.stderr.isatty():
            print(f"\r{n + 1}/{count}", end="", file=sys.stderr)
    X, y, test = np.concatenate(evidence), np.concatenate(right), np.concatenate(odd) == 1
    weights, bias = _fitted(X[~test], y[~test])
    print("WEIGHTS = np.array([" + ", ".join(f"{w:.3g}" for w in weights) + f"])\nBIAS = {bias:.3g}")
    images = count // 2
    print("false alarms an image      " + "".join(f"{rate:8}" for rate in RATES))
    for name, score, good in (
        ("verified", X[test] @ weights + bias, y[test]),
        ("network alone", np.concatenate(alone), np.concatenate(alone_right)),
    ):
        print(f"{name:27}" + "".join(f"{d:8.3f}" for d in _detection(score, good, images, truths[1])))
    kept = X[test] @ weights + bias > 0
    print(f"at 0.5: detection {(y[test] & kept).sum() / truths[1]:.3f}, alarms {(kept & ~y[test]).sum() / images:.3f}")


RATES = (0.03, 0.05, 0.1, 0.25, 0.5, 1.0)


def _right(xy: np.ndarray, ids: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Whether each place explains a keypoint: within a tenth of its radius, and of its design."""
    if not len(keypoints):
        return np.zeros(len(xy), bool)
    distance = np.hypot(xy[:, :1] - keypoints["x"], xy[:, 1:] - keypoints["y"])
    nearest = distance.argmin(axis=1)
    close = distance.min(axis=1) <= 0.1 * keypoints["radius_major"][nearest]
    return close & (keypoints["patch_id"][nearest] == ids)


def _fitted(X: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, float]:
    """Logistic regression by Newton's method, with a light ridge on the scaled columns."""
    mean, scale = X.mean(axis=0), X.std(axis=0) + 1e-9
    Z = np.column_stack([(X - mean) / scale, np.ones(len(X))])
    b = np.zeros(Z.shape[1])
    for _ in range(50):
        p = 1 / (1 + np.exp(-Z @ b))
        b -= np.linalg.solve((Z * (p * (1 - p))[:, None]).T @ Z + 0.1 * np.eye(len(b)), Z.T @ (p - y) + 0.1 * b)
    weights = b[:-1] / scale
    return weights, float(b[-1] - weights @ mean)


def _detection(score: np.ndarray, good: np.ndarray, images: int, truths: int) -> list[float]:
    order = np.argsort(-score, kind="stable")
    alarms, found = np.cumsum(~good[order]) / images, np.cumsum(good[order]) / truths
    return [float(found[max(np.searchsorted(alarms, rate, side="right") - 1, 0)]) for rate in RATES]


if __name__ == "__main__":
    main()
