"""Are the covariances of the detectors true? NEES of every rung of paper-v1, or of the cameras. Simulated.

A detection is matched if it lies within a tenth of the radius of a true centre and has its identity. With the error e
and the covariance C of a matched detection, NEES is the mean of eᵀ C⁻¹ e (Y. Bar-Shalom, X. Li, T. Kirubarajan,
*Estimation with Applications to Tracking and Navigation*, 2001, section 5.4). It is 2 for a true covariance, above 2
where errors are larger than predicted. Brackets hold 95 % intervals: the bootstrap draws whole scenes. Quintiles are
those of the predicted sigma, √(trace C / 2). "sigma / bound" is the median of sigma, relative to the Cramér-Rao bound,
which is only known where nothing but Gaussian noise and rounding to whole grey levels (1/12) deteriorates the image.

    python benchmarks/accuracy/nees.py --backgrounds photos/ [--scenes 9] [--seed 0] [--detectors superpoint-small]
    python benchmarks/accuracy/nees.py --backgrounds photos/ --cameras 300
    python benchmarks/accuracy/nees.py --backgrounds photos/ --detectors fit

"fit" is the fit alone, a tenth of the time: it starts from the true poses, with errors like those of superpoint-small.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

import kpbench
from kpbench import Detections, SuiteConfig, SynthConfig, load_suite, shipped_patches
from kpbench.analysis import PolarGrid, point_bound
from kpbench.analysis.localisation import CONTRAST, NOISE
from kpbench.camera import load_camera_preset
from kpbench.dataset.shard import Sample
from kpbench.fitting import build_pyramid
from kpbench.types import Float, UInt8
from kpbench.workers import use_threads

NEAR = 0.1
"""Largest distance of a matched detection from its centre, in radii."""
START_DEVIATION = 0.007
"""Standard deviation of the errors of centres, in radii, and of the entries of maps; measured on superpoint-small."""
CAMERAS = ("linear", "industrial", "phone", "webcam", "action-cam")
WITH_BOUND = ("scale", "pitch", "noise")
"""Conditions of paper-v1 without deteriorations, or with Gaussian noise alone."""


@dataclass(frozen=True)
class Match:
    """A matched detection."""

    scene: int
    nees: float
    sigma_px: float
    error: Float
    bound_px: float = np.nan


def linear_map(H: Float) -> Float:
    """Linear part (2, 2) of a homography at the origin of the patch frame."""
    H = H / H[2, 2]
    return np.asarray(H[:2, :2] - np.outer(H[:2, 2], H[2, :2]))


def fit_truth(sample: Sample) -> Detections:
    """Fit the true patches from poses with random errors: normal, as large as those of superpoint-small."""
    rng, k, starts = np.random.default_rng(sample.scene_id), sample.keypoints, []
    for point in k:
        A = linear_map(point["H_patch2image"])
        turned = A @ (np.eye(2) + rng.normal(0, START_DEVIATION, (2, 2)))
        starts.append(((point["x"], point["y"]) + A @ rng.normal(0, START_DEVIATION, 2), turned))
    xy, A = (np.array(column) for column in zip(*starts, strict=True))
    patches = [shipped_patches()[n] for n in k["patch_id"]]
    found = kpbench.fit(build_pyramid(sample.image, 0), xy, A, patches)
    return Detections(found.xy, found.ncc, k["patch_id"], found.A, found.covariance, found.blur_px)


class Bounds:
    """Cramér-Rao bounds; those of scenes that differ in their noise alone are computed once."""

    def __init__(self) -> None:
        self.grid, self.known = PolarGrid.of(shipped_patches()), dict[bytes, float]()
        self.inks = self.grid.inks(shipped_patches())

    def sigma_px(self, keypoint: np.void, noise: float) -> float:
        """Return the root mean square of the bounds on x and y, px. Position, affine map and inks are unknown."""
        key = np.round(keypoint["H_patch2image"], 6).tobytes() + bytes([int(keypoint["patch_id"])])
        if key not in self.known:
            ink, A = self.inks[int(keypoint["patch_id"])][None], linear_map(keypoint["H_patch2image"])
            cells = self.grid.cell_polygons(0.01 / float(keypoint["radius_major"]))
            self.known[key] = float(point_bound(cells, ink, A, rim=False)[1][0])
        contrast = float(keypoint["contrast"]) / CONTRAST
        return self.known[key] * np.hypot(noise, 12**-0.5) / NOISE / contrast


def of_image(detect: Callable[[UInt8], Detections]) -> Callable[[Sample], Detections]:
    return lambda sample: detect(sample.image)


def matches(sample: Sample, scene: int, found: Detections, bounds: Bounds | None) -> Iterator[Match]:
    if not len(found):
        return
    assert found.covariance is not None
    assert found.patch_id is not None
    noise = sum(float(e.get("sigma", 0)) for e in sample.effects if e["effect"] == "noise")
    for k in sample.keypoints:
        errors = found.xy - [k["x"], k["y"]]
        n = int(np.argmin(np.hypot(*errors.T)))
        if np.hypot(*errors[n]) > NEAR * k["radius_major"] or found.patch_id[n] != k["patch_id"]:
            continue
        C, e = found.covariance[n], errors[n]
        bound = np.nan if bounds is None else bounds.sigma_px(k, noise)
        yield Match(scene, float(e @ np.linalg.solve(C, e)), float(np.sqrt(np.trace(C) / 2)), e, bound)


def interval(nees: Float, scene: Float) -> tuple[float, float]:
    """95 % interval of the mean, by 1,000 bootstrap samples of whole scenes."""
    rng, (_, group) = np.random.default_rng(0), np.unique(scene, return_inverse=True)
    sums, counts = np.bincount(group, nees), np.bincount(group)
    drawn = rng.integers(len(sums), size=(1000, len(sums)))
    low, high = np.percentile(sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1), (2.5, 97.5))
    return float(low), float(high)


def row(name: str, found: list[Match]) -> str:
    nees, sigma = np.array([m.nees for m in found]), np.array([m.sigma_px for m in found])
    low, high = interval(nees, np.array([m.scene for m in found]))
    quintiles = " ".join(f"{part.mean():.1f}" for part in np.array_split(nees[np.argsort(sigma)], 5))
    rms = np.sqrt(np.mean([m.error @ m.error / 2 for m in found]))
    ratios = np.array([m.sigma_px / m.bound_px for m in found if np.isfinite(m.bound_px)])
    cells = [f"{nees.mean():.2f} [{low:.2f}, {high:.2f}]", f"{np.median(nees):.2f}", quintiles, f"{rms:.4f}"]
    cells += [f"{np.median(sigma):.4f}", f"{np.median(ratios):.2f}" if len(ratios) else ""]
    return f"| {name} | {len(found)} | " + " | ".join(cells) + " |"


def images(options: argparse.Namespace) -> Iterator[tuple[str, int, Sample]]:
    """Yield the name of a rung or of a camera, the number of the scene, and an image."""
    if not options.cameras:
        suite = SuiteConfig(load_suite("paper-v1"), options.scenes, options.seed, backgrounds=options.backgrounds)
        for n in range(suite.n):
            sample = suite.make(n)[0]
            yield f"{sample.condition} {sample.rung:g}", sample.scene_id, sample
        return
    for name in CAMERAS:
        camera = None if name == "linear" else load_camera_preset(name)
        synth = SynthConfig(
            options.cameras, options.seed, deteriorate="none", backgrounds=options.backgrounds, camera=camera
        )
        for n in range(synth.n):
            yield name, n, synth.make(n)[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backgrounds", type=Path)
    parser.add_argument("--scenes", type=int, default=9)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cameras", type=int, default=0)
    parser.add_argument("--detectors", default="superpoint-small,superpoint,template")
    options = parser.parse_args()
    use_threads(1)
    cv2.setNumThreads(1)
    names = options.detectors.split(",")
    detectors = {name: fit_truth if name == "fit" else of_image(kpbench.load_detector(name)) for name in names}
    tables: dict[str, dict[str, list[Match]]] = {name: defaultdict(list) for name in detectors}
    bounds = Bounds()
    for rung, scene, sample in images(options):
        with_bound = rung.split()[0] in WITH_BOUND and scene < 2
        for name, detect in detectors.items():
            tables[name][rung] += matches(sample, scene, detect(sample), bounds if with_bound else None)
    for name, table in tables.items():
        print(f"\n{name}\n")
        print("| | matched | NEES | median | by quintile of sigma | RMS error, px | sigma, px | sigma / bound |")
        print("|---|---|---|---|---|---|---|---|")
        for rung, found in table.items():
            print(row(rung, found))
        print(row("all", [replace(m, bound_px=np.nan) for found in table.values() for m in found]), flush=True)


if __name__ == "__main__":
    main()
