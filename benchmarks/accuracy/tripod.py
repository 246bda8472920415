"""Tripod series of simulated photographs: is the truth of the hard photographs right, and are covered patches noticed?

    python benchmarks/accuracy/tripod.py --series 10

Each series shows one scene of 960 x 720 px by a simple camera: an easy photograph, the hard ones of `HARD`, an easy
photograph. The marks of most hard photographs cannot be found. `cover` hides two patches and half of a third. Printed
for each condition: the share of the hard photographs that is labelled, the share of the patches that is judged, the
error of the truth (px RMS a coordinate), NEES (2 for right standard deviations), and covered patches that were judged.
Then the camera moves before the last easy photograph: the smallest motion that is caught.
"""

import argparse
import sys
import tempfile
import warnings
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np

import kpbench

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
import board_photos

HARD = (
    *(("blur", k) for k in (9, 15, 25, 41)),
    *(("motion", k) for k in (25, 41)),
    *(("dark", k) for k in (0.3, 0.1, 0.04, 0.02)),
    *(("noise", k) for k in (30, 60)),
    ("cover", 1),
    ("cover-blur", 15),
)
MOTIONS_PX = (0.1, 0.3, 0.5, 1.0, 3.0)


def cover(image, keypoints, rng):
    """Paint a grey bar over two patches, and over half of a third; return which patches are covered."""
    image, covered = image.copy(), rng.permutation(len(keypoints))[:3]
    for n, k in enumerate(keypoints[covered]):
        shift = 1.0 if n == 2 else 0.0
        x, y, r = k["x"] + shift * k["radius_major"], k["y"], 1.15 * k["radius_major"]
        cv2.rectangle(image, (round(x - r), round(y - r)), (round(x + r), round(y + r)), int(rng.integers(30, 220)), -1)
    return image, covered


def take(base, keypoints, condition, rung, rng):
    """Return a photograph of the scene, and which patches are covered."""
    image, covered = base, np.zeros(0, int)
    if condition.startswith("cover"):
        image, covered = cover(image, keypoints, rng)
    light = image.astype(float)
    if condition in ("blur", "cover-blur"):
        light = cv2.blur(light, (int(rung), int(rung)))
    elif condition == "motion":
        light = cv2.blur(light, (int(rung), 1))
    elif condition == "dark":
        light = light * rung
    light += rng.normal(0, rung if condition == "noise" else 1.5, light.shape)
    return np.clip(np.rint(light), 0, 255).astype(np.uint8), covered


def write_series(folder, n, hard=HARD, moved_px=0.0):
    """Write a series; return the true keypoints, and the covered patches of each file."""
    rng = np.random.default_rng([n, 77])
    base, keypoints = board_photos.photograph(n)
    shots = [("easy", 0), *hard, ("easy", 1)]
    covered = {}
    for k, (condition, rung) in enumerate(shots):
        image, hidden = take(base, keypoints, condition, rung, rng)
        if moved_px and k == len(shots) - 1:
            shift = np.array([[1.0, 0, moved_px], [0, 1, 0]])
            image = cv2.warpAffine(
                image, shift, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
            )
        place = folder if condition == "easy" else folder / condition / f"{rung:g}"
        place.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(place / f"IMG_{k:04d}.png"), image)
        covered[f"IMG_{k:04d}.png"] = hidden
    return keypoints, covered


def label(folder, out, names):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return kpbench.label(folder, board_photos.BOARD, out, camera=board_photos.CAMERA, tripod=names, overwrite=True)


def judge(dataset, truth, tables):
    """Add the errors of the labels of each hard photograph to its condition."""
    for n, photo in enumerate(dataset.config["photos"]):
        name = Path(photo["name"])
        if len(name.parts) < 3:
            continue
        keypoints, covered = truth[name.parts[0]]
        own = dataset.keypoints(n)
        gap = np.hypot(own["x"][:, None] - keypoints["x"], own["y"][:, None] - keypoints["y"])
        nearest = gap.argmin(axis=1)
        row = tables[name.parts[1], float(name.parts[2])]
        row["photos"] += 1
        row["of series"] += "truth_of" in photo
        hidden = covered[name.name]
        row["wrong"] += np.isin(nearest, hidden).sum()
        row["judged"] += len(own) - np.isin(nearest, hidden).sum()
        row["visible"] += len(keypoints) - len(hidden)
        error = np.stack([own["x"] - keypoints["x"][nearest], own["y"] - keypoints["y"][nearest]], axis=1)
        row["square"] += (error**2).sum()
        row["nees"] += ((error / np.stack([own["sigma_x"], own["sigma_y"]], axis=1)) ** 2).sum()
        row["n"] += len(own)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--series", type=int, default=10)
    parser.add_argument("--seed", type=int, default=500)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder, truth, tables = Path(place) / "photos", {}, defaultdict(lambda: defaultdict(float))
        for n in range(args.series):
            truth[f"s{n}"] = write_series(folder / f"s{n}", args.seed + n)
        result = label(folder, Path(place) / "out", list(truth))
        judge(result.dataset, truth, tables)
        print("| condition | labelled | by an easy photograph | judged | error, px RMS | NEES | covered but judged |")
        print("|---|---|---|---|---|---|---|")
        for condition, rung in HARD:
            r = tables[condition, rung]
            cells = [f"{r['photos']:.0f} of {args.series}", f"{r['of series']:.0f}"]
            if r["n"]:
                cells += [f"{r['judged'] / r['visible']:.0%}", f"{np.sqrt(r['square'] / r['n'] / 2):.4f}"]
                cells += [f"{r['nees'] / r['n']:.2f}", f"{r['wrong']:.0f}"]
            print(f"| {condition} {rung:g} | {' | '.join(cells)} |")
        for moved_px in MOTIONS_PX:
            caught = 0
            for n in range(args.series):
                write_series(Path(place) / f"moved-{n}" / "s", args.seed + n, (("dark", 0.02),), moved_px)
                try:
                    label(Path(place) / f"moved-{n}", Path(place) / "out", ["s"])
                except kpbench.KpbenchError:
                    caught += 1
            print(f"moved by {moved_px:g} px: caught {caught} of {args.series}")


if __name__ == "__main__":
    main()
