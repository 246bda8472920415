"""Fit the weights of :mod:`kpbench.verify` to synthetic sets, and show what they give on images that did not fit them.

    python benchmarks/verification.py DATASET ... [--model FILE.onnx] [--write]

The sets must come from photographs that are free for fitting: `kpbench synth --n 400 --backgrounds training/`.
A place is right if its fitted centre lies within a tenth of the radius of a keypoint and its design is right.
Prints, for each set, the detection score at several rates of false alarms, each quarter of the images under weights
that were fitted to the other three: with and without verification (a keypoint that two places explain counts
twice here, as nothing is suppressed: hence figures over 1). `--write` replaces
`kpbench/weights/verification.npz` by weights that were fitted to all.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import kpbench
from kpbench import verify
from kpbench.detectors.superpoint import CANDIDATE, SmallSuperPointDetector, SuperPointDetector
from kpbench.workers import one_thread


@dataclass
class Places:
    """Places of one set that were examined, and those that the network alone would report."""

    evidence: np.ndarray
    right: np.ndarray
    image: np.ndarray
    score: np.ndarray
    score_right: np.ndarray
    images: int
    truths: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+")
    parser.add_argument("--model")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    one_thread()
    detector = SuperPointDetector(options.model) if options.model else SmallSuperPointDetector()
    sets = [look(detector, path) for path in options.datasets]
    logits = [np.zeros(len(places.right)) for places in sets]
    for part in range(FOLDS):
        weights = fitted([(p.evidence[p.image % FOLDS != part], p.right[p.image % FOLDS != part]) for p in sets])
        for places, logit in zip(sets, logits, strict=True):
            rows = places.image % FOLDS == part
            logit[rows] = (
                verify.terms(places.evidence[rows], weights["mean"], weights["deviation"]) @ weights["weights"]
            )
    for path, places, logit in zip(options.datasets, sets, logits, strict=True):
        print(f"{path}: {places.images} images\nfalse alarms an image      " + "".join(f"{rate:8}" for rate in RATES))
        for name, score, good in (
            ("verified", logit, places.right),
            ("network alone", places.score, places.score_right),
        ):
            found = _detection(score, good, places.images, places.truths)
            print(f"{name:27}" + "".join(f"{value:8.3f}" for value in found))
        right, wrong = (places.right & (logit > 0)).sum(), (~places.right & (logit > 0)).sum()
        print(f"at 0.5: detection {right / places.truths:.3f}, alarms {wrong / places.images:.3f}")
    if options.write:
        target = Path(verify.__file__).parent / "weights" / "verification.npz"
        np.savez(target, **fitted([(places.evidence, places.right) for places in sets]))
        print(f"{target.name} written")


def look(detector: SuperPointDetector, path: str) -> Places:
    """Examine all images of a dataset."""
    dataset = kpbench.open_dataset(path)
    plain = type(detector)(detector.path, CANDIDATE, verified=False)
    evidence, right, image, alone, alone_right, truths = [], [], [], [], [], 0
    looked = verify.examine

    def examine(*arguments: object) -> verify.Examined:
        found = looked(*arguments)
        evidence.append(found.evidence)
        ids = np.array([patch.patch_id for patch in detector.patches])[found.which]
        right.append(_right(found.xy, ids, keypoints))
        image.append(np.full(len(ids), n))
        return found

    verify.examine = examine
    for n in range(len(dataset)):
        pixels, keypoints = dataset[n]
        truths += len(keypoints)
        detector(pixels)
        found = plain(pixels)
        alone.append(found.score)
        alone_right.append(_right(found.xy, found.patch_id, keypoints))
        if sys.stderr.isatty():
            print(f"\r{n + 1}/{len(dataset)}", end="", file=sys.stderr)
    verify.examine = looked
    columns = (np.concatenate(parts) for parts in (evidence, right, image, alone, alone_right))
    return Places(*columns, len(dataset), truths)


FOLDS, RIDGE = 4, 3.0
RATES = (0.03, 0.05, 0.1, 0.25, 0.5, 1.0)


def _right(xy: np.ndarray, ids: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Whether each place explains a keypoint: within a tenth of its radius, and of its design."""
    if not len(keypoints):
        return np.zeros(len(xy), bool)
    distance = np.hypot(xy[:, :1] - keypoints["x"], xy[:, 1:] - keypoints["y"])
    nearest = distance.argmin(axis=1)
    close = distance.min(axis=1) <= 0.1 * keypoints["radius_major"][nearest]
    return close & (keypoints["patch_id"][nearest] == ids)


def fitted(sets: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    """What ``verification.npz`` holds: logistic regression by Newton's method, with a light ridge."""
    X, y = (np.concatenate(parts) for parts in zip(*sets, strict=True))
    mean, deviation = X.mean(axis=0), X.std(axis=0) + 1e-9
    Z = verify.terms(X, mean, deviation)
    b = np.zeros(Z.shape[1])
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(Z @ b, -30, 30)))
        b -= np.linalg.solve((Z * (p * (1 - p))[:, None]).T @ Z + RIDGE * np.eye(len(b)), Z.T @ (p - y) + RIDGE * b)
    return {"mean": mean, "deviation": deviation, "weights": b}


def _detection(score: np.ndarray, good: np.ndarray, images: int, truths: int) -> list[float]:
    order = np.argsort(-score, kind="stable")
    alarms, found = np.cumsum(~good[order]) / images, np.cumsum(good[order]) / truths
    return [float(found[max(np.searchsorted(alarms, rate, side="right") - 1, 0)]) for rate in RATES]


if __name__ == "__main__":
    main()
