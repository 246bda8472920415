"""Is the stated uncertainty of `calibrate` right? Many sets of simulated points of the truth board.

    python benchmarks/accuracy/calibration.py --sets 100 --photos 40

Each set has a lens, a print and a bow of its own. The corners have Gaussian errors of 0.015 to 0.03 px, and 1 % of
them are outliers. Prints how often each parameter lies within its stated 95 % interval, and the mean normalised squared
error of (fx, fy, cx, cy); 4 is right.
"""

import argparse

import numpy as np

import kpbench
from kpbench.calibration.marks import BoardPoints, MarkFinder
from kpbench.calibration.projection import camera_values, project_points
from kpbench.calibration.shape import PrintShape
from kpbench.calibration.start import solve_photos, start_camera
from kpbench.geometry.camera import Camera, rotation_xyz

SIZE = (1624, 1240)


def draw_set(rng, photos, board_mm, model):
    middle = (811 + 10 * rng.normal(), 620 + 10 * rng.normal())
    if model == "fisheye":
        camera = Camera(*SIZE, 700 * rng.uniform(1, 1.3), tuple(rng.normal(0, 0.02, 4)), model, middle)
    else:
        lens = (rng.uniform(-0.2, 0.02), rng.uniform(-0.03, 0.06), *rng.normal(0, 5e-4, 2), 0.0)
        camera = Camera(*SIZE, 1200 * rng.uniform(1, 1.3), lens, "brown", middle)
    shape = PrintShape(*(rng.normal(size=2) * 2e-3), *(rng.normal(size=3) * 2e-4))
    found = []
    while len(found) < photos:
        rotation = rotation_xyz(rng.uniform(-45, 45), rng.uniform(-45, 45), rng.uniform(-180, 180))
        depth = rng.uniform(250, 700)
        ray = (rng.uniform([300, 250], [1300, 1000]) - middle) / camera.focal_px
        shift = np.append(ray, 1.0) * depth
        bent = shape.bend(board_mm)
        if (bent.xyz @ rotation.T + shift)[:, 2].min() < 30:
            continue
        xy = project_points(camera, rotation, shift, bent).xy
        rows = np.flatnonzero(((xy > 5) & (xy < np.array(SIZE) - 5)).all(axis=1))
        if len(rows) < 60:
            continue
        sigma = rng.uniform(0.015, 0.03, len(rows))
        seen = xy[rows] + rng.normal(size=(len(rows), 2)) * sigma[:, None]
        wrong = rng.random(len(rows)) < 0.01
        seen[wrong] += rng.normal(0, 2, (int(wrong.sum()), 2))
        found.append(BoardPoints(rows, seen, sigma[:, None, None] ** 2 * np.eye(2)))
    return camera, found


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--photos", type=int, default=40)
    parser.add_argument("--model", choices=["brown", "fisheye"], default="brown")
    args = parser.parse_args()
    board_mm = MarkFinder(kpbench.truth_board(kpbench.shipped_patches())).corners_mm
    inside, nees = [], []
    for seed in range(args.sets):
        camera, points = draw_set(np.random.default_rng([seed, 2026]), args.photos, board_mm, args.model)
        start = start_camera(points, board_mm, SIZE, args.model, 4 if args.model == "fisheye" else 5)
        bundle = solve_photos(points, board_mm, start)
        error = (camera_values(bundle.camera) - camera_values(camera))[:4]
        covariance = bundle.covariance[:4, :4]
        inside.append(np.abs(error) < 1.96 * np.sqrt(np.diag(covariance)))
        nees.append(error @ np.linalg.solve(covariance, error))
    shares = dict(zip(("fx", "fy", "cx", "cy"), np.mean(inside, axis=0).round(3).tolist(), strict=True))
    print(f"{args.sets} sets of {args.photos} photographs, {args.model}; simulated points")
    print(f"within the stated 95 % interval: {shares}; all: {np.mean(inside):.3f}")
    print(f"mean normalised squared error: {np.mean(nees):.2f} (right: 4)")


if __name__ == "__main__":
    main()
