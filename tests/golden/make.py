"""Make the golden images and detections anew: only where detections are meant to change.

    python tests/golden/make.py             # detections of the images that are there
    python tests/golden/make.py --images    # the images too

An image is taken only if no detector is undecided about it: no score lies near a threshold, so that the number of
detections does not hang on the last digit of a processor.
"""

from __future__ import annotations

import argparse
import json
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

import kpbench
from kpbench.detectors.interface import DETECTORS
from kpbench.synth.suite import SuiteConfig
from kpbench.synth.suite_file import load_suite
from kpbench.synth.synthetic import SynthConfig

HERE = Path(__file__).parent
SIZE, TAGS_SIZE = (320, 240), (640, 480)
BAND = {"template": (0.295, 0.305), "superpoint": (0.27, 0.33), "superpoint-small": (0.27, 0.33)}
"""Scores around the threshold of a detector, 0.3, that no detection may have."""
STRONGEST = 20
"""Of the hundreds of points of ``orb`` and ``sift`` on an image the strongest are kept."""


def candidates():
    """Images a kind: deteriorated and clean scenes, boards of patches, boards of tags."""
    paper, extended = load_suite("paper-v1"), load_suite("extended-v1")
    yield 12, SynthConfig(60, seed=24, size_px=SIZE)
    yield 8, SynthConfig(60, seed=25, size_px=SIZE, deteriorate="none")
    yield 4, SuiteConfig(extended, 1, 26, SIZE)
    for n, board in enumerate(("aruco", "apriltag", "charuco")):
        yield 2, SuiteConfig(paper, 1, 27 + n, TAGS_SIZE, ("pitch", "noise"), board=board)


def detections(image):
    """Detections of every shipped detector on one image: rows of x, y, score and ID."""
    found = {}
    for name in DETECTORS:
        seen = DETECT[name](image)
        order = np.argsort(-seen.score, kind="stable")[: STRONGEST if name in ("orb", "sift") else None]
        ids = seen.patch_id if seen.patch_id is not None else np.full(len(seen), -1)
        rows = np.column_stack([seen.xy, seen.score, ids])[order]
        found[name] = [[round(value, 6) for value in row] for row in rows.tolist()]
    return found


DETECT = {name: kpbench.load_detector(name) for name in DETECTORS}
WITHIN = {name: [kpbench.load_detector(name, least) for least in band] for name, band in BAND.items()}


def decided(image):
    """Whether the number of detections is the same at both ends of the band."""
    return all(len(low(image)) == len(high(image)) for low, high in WITHIN.values())


def make_images():
    """Write the images."""
    number = 0
    for count, config in candidates():
        step = max(1, config.n // 60)
        made = (np.asarray(config.make(n)[0].image) for n in range(0, config.n, step))
        for image in islice((image for image in made if decided(image)), count):
            cv2.imwrite(str(HERE / "images" / f"{number:02d}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
            number += 1
    assert number == 30, number


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", action="store_true", help="make the images too")
    (HERE / "images").mkdir(exist_ok=True)
    if parser.parse_args().images:
        make_images()
    golden = {
        path.name: detections(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        for path in sorted((HERE / "images").glob("*.png"))
    }
    text = ",\n".join(f"{json.dumps(name)}: {json.dumps(found)}" for name, found in golden.items())
    (HERE / "detections.json").write_text("{\n" + text + "\n}\n")
