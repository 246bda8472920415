"""Real quadrant targets: which of them the detectors find in real photographs. No photograph is part of kpbench.

``targets.json`` beside this file has the place and size of each target, as COCO annotations. The photographs lie in
a folder of yours, under the names there; those that are missing are left out and named. The labels are good to about
1 px, so a detection counts within half a radius.

    python benchmarks/photographs/targets.py photographs/
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

import kpbench
from kpbench.images import read_rgb
from kpbench.predictions import open_coco
from kpbench.types import UInt8

EPS = 0.5
"""Largest distance between detection and target, in major semi-axes of the target."""
CHECKER = 0
"""Patch ID of the design that the targets show."""


def describe(image: UInt8, target: kpbench.Detections, radius_px: float, detector: str) -> str:
    """Return what a detector finds at a target: distance and score, or a dash; and how much it finds elsewhere."""
    found = kpbench.load_detector(detector)(image)
    distance = np.hypot(*(found.xy - target.xy[0]).T)
    near = distance <= EPS * radius_px
    elsewhere = f", {int((~near).sum())} elsewhere" if (~near).any() else ""
    if not near.any():
        return f"-{elsewhere}"
    best = int(np.argmin(np.where(near, distance, np.inf)))
    has_id = found.patch_id is None or found.patch_id[best] == CHECKER
    return f"{distance[best]:.1f} px, score {found.score[best]:.2f}{'' if has_id else ', wrong ID'}{elsewhere}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--detector", action="append", help="repeatable; default: all three that find patches")
    options = parser.parse_args()
    detectors = options.detector or ["superpoint-small", "superpoint", "template"]
    labels = open_coco(Path(__file__).with_name("targets.json"))
    print("real quadrant targets, photographs:\n")
    print(f"| photograph | size | semi-axes | {' | '.join(detectors)} |\n|{'---|' * (3 + len(detectors))}")
    found = dict.fromkeys(detectors, 0)
    shown = 0
    for n, name in enumerate(labels.files):
        image = read_rgb(options.folder / name)
        if image is None:
            print(f"{name} is not there", file=sys.stderr)
            continue
        [k] = labels.keypoints(n)
        target = kpbench.Detections([[k["x"], k["y"]]], [1.0])
        cells = [describe(image, target, float(k["radius_major"]), detector) for detector in detectors]
        for detector, cell in zip(detectors, cells, strict=True):
            found[detector] += not cell.startswith("-") and "wrong" not in cell
        shown += 1
        axes = f"{k['radius_major']:g} x {k['radius_minor']:g} px"
        print(f"| {name} | {image.shape[1]}x{image.shape[0]} | {axes} | {' | '.join(cells)} |")
    print(f"| **found** | | | {' | '.join(f'**{found[d]} of {shown}**' for d in detectors)} |")


if __name__ == "__main__":
    main()
