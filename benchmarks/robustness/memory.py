"""Measure the memory of a detector: at one large image, and over many images.

    python benchmarks/robustness/memory.py --detector superpoint-small --images 3000 --size 4000x3000

Prints the memory of the process (resident, MiB) before and after the images, and the peak of one large image. Every
image is noise with patches' crossings, so that many places are verified. Memory is flat if the last two rows agree.
"""

from __future__ import annotations

import argparse
import resource
from pathlib import Path

import numpy as np

import kpbench
from kpbench.render.background import procedural_background


def resident_mib() -> float:
    """Return the resident memory of this process, MiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


def peak_mib() -> float:
    """Return the largest resident memory that this process has had, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def main() -> None:
    """Run the detector and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--detector", default="superpoint-small")
    parser.add_argument("--images", type=int, default=300)
    parser.add_argument("--size", default="4000x3000", help="size of the large image, WxH; 0x0 for none")
    options = parser.parse_args()
    detect, rng = kpbench.load_detector(options.detector), np.random.default_rng(0)
    width, height = map(int, options.size.split("x"))
    images = [procedural_background(rng, 640, 480) for _ in range(20)]
    for n in range(options.images):
        if n in (20, options.images // 2):
            print(f"after {n:5d} images of 640x480: {resident_mib():6.0f} MiB", flush=True)
        detect(images[n % len(images)])
    print(
        f"after {options.images:5d} images of 640x480: {resident_mib():6.0f} MiB, peak {peak_mib():.0f} MiB", flush=True
    )
    if width * height:
        tiles = [
            np.hstack([images[(3 * y + x) % 20] for x in range(-(-width // 640))]) for y in range(-(-height // 480))
        ]
        large = np.ascontiguousarray(np.vstack(tiles)[:height, :width])
        found = detect(large)
        print(f"one image of {width}x{height}: peak {peak_mib():.0f} MiB, {len(found)} detections")


if __name__ == "__main__":
    main()
