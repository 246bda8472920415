"""Errors of the labels of simulated photographs against the truth of the simulator.

    python benchmarks/accuracy/truth_board_photos.py OUT --photos 100 --preset industrial --seed 1 --unmodelled
    python benchmarks/accuracy/labels.py OUT
    python benchmarks/accuracy/labels.py OUT --cover 0.5     # half of the marks covered

Prints the root mean square error per coordinate, that predicted by leaving out each mark, and the mean NEES (2 for
right standard deviations). `label` never sees the truth.
"""

import argparse
import tempfile
import time
import warnings
from pathlib import Path

import cv2
import numpy as np

import kpbench
from kpbench.errors import KpbenchWarning

SEED_COVER = 77


def cover_marks(folder, truth, board, fraction, out):
    """Paint grey discs over some marks of each photograph, by the homography of the true keypoints."""
    rng = np.random.default_rng(SEED_COVER)
    out.mkdir()
    for name, keypoints in zip(truth["names"], truth["keypoints"], strict=True):
        image = cv2.imread(str(folder / "photos" / name), cv2.IMREAD_GRAYSCALE)
        seen = np.stack([keypoints["x"], keypoints["y"]], axis=1)
        H, _ = cv2.findHomography(board.points_mm[:, :2], seen)
        for n in rng.permutation(len(board.references))[: round(fraction * len(board.references))]:
            mark = board.references[n]
            x, y, w = H @ [mark.x_mm, mark.y_mm, 1]
            edge = H @ [mark.x_mm + 0.75 * mark.width_mm, mark.y_mm, 1]
            radius = np.hypot(edge[0] / edge[2] - x / w, edge[1] / edge[2] - y / w)
            cv2.circle(image, (round(x / w), round(y / w)), round(radius), int(rng.integers(40, 200)), -1)
        cv2.imwrite(str(out / name), image)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cover", type=float, default=0.0, help="fraction of the marks that is covered")
    args = parser.parse_args()
    warnings.simplefilter("ignore", KpbenchWarning)
    truth, board = np.load(args.folder / "truth.npz"), kpbench.load_board(args.folder / "board" / "truth.json")
    with tempfile.TemporaryDirectory() as scratch:
        photos = args.folder / "photos"
        if args.cover:
            photos = Path(scratch) / "covered"
            cover_marks(args.folder, truth, board, args.cover, photos)
        start = time.perf_counter()
        result = kpbench.label(photos, board, Path(scratch) / "out", source="simulated photographs", force=True)
        seconds = time.perf_counter() - start
        names, table, offsets = list(truth["names"]), result.dataset.truth.keypoints, result.dataset.truth.offsets
    errors, true_of = [], {name: truth["keypoints"][n] for n, name in enumerate(names)}
    for n, photo in enumerate(result.dataset.config["photos"]):
        own, true = table[offsets[n] : offsets[n + 1]], true_of[photo["name"]]
        gap = np.hypot(own["x"][:, None] - true["x"], own["y"][:, None] - true["y"])
        nearest = true[gap.argmin(axis=1)]
        assert (nearest["patch_id"] == own["patch_id"]).all()
        errors.append(np.stack([own["x"] - nearest["x"], own["y"] - nearest["y"]], axis=1))
    error = np.concatenate(errors)
    xx, yy = table["sigma_x"].astype(float) ** 2, table["sigma_y"].astype(float) ** 2
    xy = table["rho"] * np.sqrt(xx * yy)
    nees = (yy * error[:, 0] ** 2 - 2 * xy * error.prod(axis=1) + xx * error[:, 1] ** 2) / (xx * yy - xy**2)
    rejected = [(o.photo.name, o.reason) for o in result.observed if o.reason]
    rms = np.sqrt((error**2).mean())
    print(f"photographs          {len(result.dataset)} of {len(names)} labelled, {len(error)} keypoints; simulated")
    print(f"error                {rms:.4f} px RMS a coordinate; largest {np.abs(error).max():.4f} px")
    print(f"predicted error      {result.error_px:.4f} px, {result.error_px / rms:.2f} of the error")
    print(f"NEES                 {nees.mean():.2f} (right: 2)")
    print(f"halves               p = {result.halves.p:.3f}" if result.halves else "halves               none")
    print(f"time                 {seconds / len(names):.2f} s a photograph")
    print(f"rejected             {rejected}")


if __name__ == "__main__":
    main()
