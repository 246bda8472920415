"""How a synthetic set is distributed, beside the limits that the paper sets (§3.2).

    kpbench synth --n 20000 --out train
    python benchmarks/accuracy/distribution.py train

Everything is measured on the truth in the shards. The inks are not in there: the scenes are drawn again from the seed,
their poses compared with the shards' bit by bit, and their inks taken.
"""

from __future__ import annotations

import argparse

import numpy as np

import kpbench
from kpbench import shipped_patches
from kpbench.geometry import project_discs
from kpbench.render import Limits, random_placements
from kpbench.seeds import SYNTH_SCENE, stage_rng


def tilts_deg(H: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """Tilts (n, 2) about the patch's two axes, from its homography; the focal length drops out.

    With the principal point moved to the origin, H is radius · (rotation, perspective) of
    :func:`kpbench.render.random_poses`; rotating the turn away leaves ρ cos y, ρ cos x and ρ sin x sin y.
    """
    A = H[:, :2, :2] - np.array([(width_px - 1) / 2, (height_px - 1) / 2])[:, None] * H[:, 2:, :2]
    a = np.hypot(A[:, 0, 0], A[:, 0, 1])
    cz, sz = A[:, 0, 0] / a, -A[:, 0, 1] / a
    b, c = A[:, 1, 0] * sz + A[:, 1, 1] * cz, A[:, 1, 0] * cz - A[:, 1, 1] * sz
    half = (a**2 + b**2 + c**2) / 2
    rho = np.sqrt(half + np.sqrt(np.maximum(half**2 - (a * b) ** 2, 0)))
    about_x = np.arccos(np.clip(b / rho, -1, 1)) * np.sign(H[:, 2, 0] * sz + H[:, 2, 1] * cz)
    about_y = np.arccos(np.clip(a / rho, -1, 1)) * np.sign(H[:, 2, 1] * sz - H[:, 2, 0] * cz)
    return np.degrees(np.column_stack([about_x, about_y]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset")
    dataset = kpbench.open_dataset(parser.parse_args().dataset)
    truth, (width, height) = dataset.truth, dataset.config["size_px"]
    keypoints, counts = truth.keypoints, np.diff(truth.offsets)
    major, minor = keypoints["radius_major"].astype(float), keypoints["radius_minor"].astype(float)
    print(f"images {len(dataset)}, keypoints {len(keypoints)}")
    print(f"count an image {counts.min()} to {counts.max()}, shares", np.round(np.bincount(counts) / len(counts), 3))
    print(f"short axis, full length, px: least {2 * minor.min():.4f}, median {np.median(2 * minor):.1f}")
    print(f"(major - minor) / major: most {((major - minor) / major).max():.4f}")
    print("shares of the IDs", np.round(np.bincount(keypoints["patch_id"]) / len(keypoints), 3))
    tilts = tilts_deg(keypoints["H_patch2image"], width, height)
    r = np.corrcoef(tilts.T)[0, 1]
    print(f"tilts: {np.abs(tilts).max():.1f} degrees at most, correlation of the two {r:+.4f} "
          f"(chance alone: {1 / np.sqrt(len(tilts)):.4f})")  # fmt: skip
    centre, reach, _, _ = project_discs(keypoints["H_patch2image"])
    gaps = []
    for low, high in zip(truth.offsets[:-1], truth.offsets[1:], strict=True):
        apart = np.linalg.norm(centre[low:high, None] - centre[low:high], axis=2) - reach[low:high, None]
        apart -= reach[low:high]
        gaps.append((apart + np.diag(np.full(high - low, np.inf))).min(initial=np.inf))
    print(f"nearest two discs (as circles of their long axes): {min(gaps):.3f} px apart")
    inks, patches = [], shipped_patches()
    for n in range(len(dataset)):
        placements = random_placements(
            stage_rng(dataset.config["seed"], n, SYNTH_SCENE), width, height, patches, Limits()
        )
        rows = keypoints["H_patch2image"][truth.offsets[n] : truth.offsets[n + 1]]
        assert np.array_equal(
            rows.reshape(-1, 9), np.array([p.H_patch2image.ravel() for p in placements]).reshape(-1, 9)
        )
        inks += [(p.black, p.white) for p in placements]
    (b0, w0), (b1, w1) = np.min(inks, axis=0), np.max(inks, axis=0)
    print(f"inks, grey levels: black {b0:.2f} to {b1:.2f}, white {w0:.2f} to {w1:.2f}")


if __name__ == "__main__":
    main()
