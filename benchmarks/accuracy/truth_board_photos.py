"""Simulated photographs of the truth board, with their truth: for checks of `calibrate` and `label`.

    python benchmarks/accuracy/truth_board_photos.py OUT --photos 100 --preset industrial --seed 1

Writes `OUT/photos/*.png`, `OUT/board/truth.json`, and `OUT/truth.npz`: the camera, and for each
photograph the true keypoints. With `--unmodelled`, the lens has a thin prism, the sheet is a saddle, and a third of
the photographs has a rolling shutter in motion: effects that the solver does not model.
"""

import argparse
from pathlib import Path

import numpy as np

import kpbench
from kpbench.camera.paper import Cylinder, Saddle
from kpbench.camera.preset import load_camera_preset
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.images import encode_png
from kpbench.render.background import procedural_background
from kpbench.render.board_exposure import ExposedBoard
from kpbench.render.board_projection import pose_board
from kpbench.render.board_view import Appearance
from kpbench.synth.camera_view import expose_board, needs_colour, photograph_board

SIZES = {"industrial": (1624, 1240), "phone": (4000, 3000), "webcam": (1280, 720)}


def draw_camera(rng, size, unmodelled):
    """A camera of a lens with Brown's five coefficients, and a thin prism if asked for."""
    width, height = size
    focal = width * rng.uniform(0.55, 0.8)
    coefficients = [rng.uniform(-0.12, 0.02), rng.uniform(-0.02, 0.04), *rng.uniform(-6e-4, 6e-4, 2), 0.0]
    if unmodelled:
        coefficients += [0.0, 0.0, 0.0, *rng.uniform(-5e-4, 5e-4, 4)]
    middle = (width - 1) / 2 + rng.normal() * 0.01 * width, (height - 1) / 2 + rng.normal() * 0.01 * width
    return Camera(width, height, focal, tuple(coefficients), "brown", middle, focal * (1 + rng.normal() * 3e-4))


def draw_bow(rng, width_mm, unmodelled):
    """The bow of the sheet, the same for all photographs: sagittas up to 1 % of the width."""
    if unmodelled:
        return Saddle(4 * rng.uniform(-0.004, 0.004) / width_mm, rng.uniform(0, 180))
    return Cylinder.of_sagitta(rng.choice([-1, 1]) * rng.uniform(0.001, 0.01) * width_mm, width_mm, rng.uniform(0, 180))


def draw_pose(rng, camera, board, area):
    while True:
        turns = {"pitch_deg": rng.uniform(-40, 40), "yaw_deg": rng.uniform(-40, 40), "roll_deg": rng.uniform(-180, 180)}
        shift = tuple(rng.uniform(-0.25, 0.25, 2))
        try:
            return pose_board(camera.without_distortion(), board, rng.uniform(*area), shift=shift, **turns)
        except DataError:
            continue


def photograph_one(board, camera, bow, preset, seed, area=(12, 45), unmodelled=False):
    """One photograph: image, and true keypoints."""
    rng = np.random.default_rng(seed)
    values = {} if unmodelled and rng.random() < 1 / 3 else {"row_time": 0.0}
    record = preset.with_values({"bow": 0.0, "twist": 0.0, "detail": 0, "k1": 0.0, **values}).draw(rng)
    pose = draw_pose(rng, camera, board, area)
    exposed = expose_board(board, pose, camera, record)
    exposed = ExposedBoard(board, pose, exposed.motion, exposed.shutter, bow, record["ink_gain"])
    channels = 3 if needs_colour(record) else 1
    background = procedural_background(rng, camera.width_px, camera.height_px, channels)
    look = Appearance(
        rng.uniform(20, 60), rng.uniform(190, 245), light=rng.uniform(0.7, 1), slope=tuple(rng.uniform(-0.15, 0.15, 2))
    )
    return photograph_board(background, camera, exposed, look, rng, record)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--photos", type=int, default=100)
    parser.add_argument("--preset", default="industrial")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--unmodelled", action="store_true")
    parser.add_argument(
        "--area", type=float, nargs=2, default=(12, 45), help="least and largest share of the image, %%"
    )
    parser.add_argument("--size", type=int, nargs=2)
    args = parser.parse_args()
    rng = np.random.default_rng([args.seed, 99])
    board = kpbench.truth_board(kpbench.shipped_patches())
    camera = draw_camera(rng, args.size or SIZES[args.preset], args.unmodelled)
    bow = draw_bow(rng, board.side_x_mm, args.unmodelled)
    preset = load_camera_preset(args.preset)
    kpbench.print_boards([board], args.out / "board", formats=["svg"])
    (args.out / "photos").mkdir(parents=True, exist_ok=True)
    keypoints = []
    for n in range(args.photos):
        made = photograph_one(board, camera, bow, preset, [args.seed, n], args.area, args.unmodelled)
        (args.out / "photos" / f"{n:04d}.png").write_bytes(encode_png(made.image, "simulated"))
        keypoints.append(made.keypoints)
    names = [f"{n:04d}.png" for n in range(args.photos)]
    np.savez(
        args.out / "truth.npz", keypoints=np.stack(keypoints), names=names, K=camera.K, distortion=camera.distortion
    )
    print(f"{args.out}: {args.photos} photographs")


if __name__ == "__main__":
    main()
