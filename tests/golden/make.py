"""Make the golden images and detections anew: only where detections are meant to change.

    python tests/golden/make.py             # detections of the images that are there
    python tests/golden/make.py --images    # the images too

An image is taken only if every detector gives the same detections on processors with and without wide vector
instructions (``PROCESSORS``), and if no score lies near the threshold of a detector.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

import kpbench
from kpbench.detectors.interface import DETECTORS as SHIPPED
from kpbench.synth.suite import SuiteConfig
from kpbench.synth.suite_file import load_suite
from kpbench.synth.synthetic import SynthConfig

HERE = Path(__file__).parent
DETECTORS = [name for name in SHIPPED if name not in ("napa", "locus")]  # packages that may be missing
SIZE, TAGS_SIZE = (320, 240), (640, 480)
SCORE_BAND = {"template": (0.295, 0.305), "superpoint": (0.47, 0.53), "superpoint-small": (0.47, 0.53)}
"""Range of scores around the threshold of a detector in which no detection may lie."""
PROCESSORS = (
    {},
    {"OPENCV_CPU_DISABLE": "AVX2"},
    {"NPY_DISABLE_CPU_FEATURES": "X86_V3,X86_V4,AVX512_ICL,AVX512_SPR"},
)
"""Environments in which OpenCV or NumPy does without instructions of newer processors."""
STABLE = 2e-4
"""Largest difference of a place, px, or of a score between two processors."""
STRONGEST = 20
"""Number of points of ``orb`` and ``sift`` that are kept per image, of several hundred."""


def candidates():
    """Yield how many images of a kind are wanted, and the kind: scenes with and without effects, boards, tags."""
    paper, extended = load_suite("paper-v1"), load_suite("extended-v1")
    yield 13, SynthConfig(60, seed=24, size_px=SIZE)
    yield 6, SynthConfig(60, seed=25, size_px=SIZE, deteriorate="none")
    yield 5, SuiteConfig(extended, 1, 26, SIZE)
    for n, board in enumerate(("aruco", "apriltag", "charuco")):
        yield 2, SuiteConfig(paper, 1, 27 + n, TAGS_SIZE, ("pitch", "noise", "scale"), board=board)


def detections(image):
    """Return the detections of every shipped detector on one image: rows of x, y, score and ID."""
    found = {}
    for name in DETECTORS:
        seen = DETECT[name](image)
        order = np.argsort(-seen.score, kind="stable")[: STRONGEST if name in ("orb", "sift") else None]
        ids = seen.patch_id if seen.patch_id is not None else np.full(len(seen), -1)
        rows = np.column_stack([seen.xy, seen.score, ids])[order]
        found[name] = [[round(value, 6) for value in row] for row in rows.tolist()]
    return found


def detections_in(folder):
    """Return the detections of every image of a folder, by file name."""
    paths = sorted(folder.glob("*.png"))
    return {path.name: detections(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths}


DETECT = {name: kpbench.load_detector(name) for name in DETECTORS}
WITHIN = {name: [kpbench.load_detector(name, least) for least in band] for name, band in SCORE_BAND.items()}


def is_decided(image):
    """Return whether the number of detections is the same at both ends of the band."""
    return all(len(low(image)) == len(high(image)) for low, high in WITHIN.values())


def is_stable(found):
    """Return whether the detections on several processors are the same."""
    for name in DETECTORS:
        one, *others = (np.array(each[name]).reshape(-1, 4) for each in found)
        for other in others:
            if one.shape != other.shape or (len(one) and not np.allclose(one, other, rtol=0, atol=STABLE)):
                return False
    return True


def make_images():
    """Write the images."""
    with tempfile.TemporaryDirectory() as folder:
        kinds = []
        for kind, (count, config) in enumerate(candidates()):
            step = max(1, config.n // 60)
            made = (np.asarray(config.make(n)[0].image) for n in range(0, config.n, step))
            for n, image in enumerate(islice(filter(is_decided, made), 4 * count)):
                cv2.imwrite(f"{folder}/{kind}-{n:02d}.png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
            kinds.append(count)
        command = [sys.executable, "-W", "ignore", __file__, "--print", folder]
        found = [
            json.loads(subprocess.run(command, env=os.environ | each, stdout=subprocess.PIPE, check=True).stdout)
            for each in PROCESSORS
        ]
        chosen = []
        for kind, count in enumerate(kinds):
            stable = [
                name for name in sorted(found[0]) if name.startswith(f"{kind}-") and is_stable([f[name] for f in found])
            ]
            print(f"kind {kind}: {len(stable)} stable, {count} wanted", file=sys.stderr)
            chosen += stable[:count]
        for old in (HERE / "images").glob("*.png"):
            old.unlink()
        for number, name in enumerate(chosen):
            (HERE / "images" / f"{number:02d}.png").write_bytes(Path(folder, name).read_bytes())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", action="store_true", help="make the images too")
    parser.add_argument("--print", type=Path, metavar="FOLDER", help="print the detections of a folder instead")
    arguments = parser.parse_args()
    if arguments.print:
        print(json.dumps(detections_in(arguments.print)))
        sys.exit()
    if arguments.images:
        make_images()
    text = ",\n".join(
        f"{json.dumps(name)}: {json.dumps(found)}" for name, found in detections_in(HERE / "images").items()
    )
    (HERE / "detections.json").write_text("{\n" + text + "\n}\n")
