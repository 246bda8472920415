"""Small simulated photographs of the truth board, with their truth."""

from pathlib import Path

import cv2
import numpy as np

import kpbench
from kpbench.geometry import Camera
from kpbench.render import Appearance, pose_board, render_board

BOARD = kpbench.truth_board(kpbench.shipped_patches())
CAMERA = Camera(960, 720, 830.0, (-0.08, 0.02, 0.0004, -0.0003, 0.0), "brown", (486.0, 352.0), 831.0)


def photograph(n, camera=CAMERA, board=BOARD, area=45.0):
    """Photograph n: grey image, and true keypoints."""
    rng = np.random.default_rng([n, 30])
    tilt, turn = rng.uniform(-32, 32, 2), rng.uniform(-180, 180)
    area *= rng.uniform(0.6, 1.0)
    background = np.full((camera.height_px, camera.width_px), 120, np.uint8)
    pose = None
    while pose is None:
        try:
            shift = tuple(rng.uniform(-0.08, 0.08, 2))
            pose = pose_board(
                camera.without_distortion(), board, area, pitch_deg=tilt[0], yaw_deg=tilt[1], roll_deg=turn, shift=shift
            )
        except kpbench.KpbenchError:
            area *= 0.8
    slope = tuple(rng.uniform(-0.2, 0.2, 2))
    made = render_board(background, camera, pose, board, Appearance(40, 225, light=0.85, slope=slope))
    light = cv2.GaussianBlur(made.image.astype(float), (0, 0), 0.7) + rng.normal(0, 1.5, made.image.shape)
    return np.clip(np.rint(255 * (np.clip(light, 0, 255) / 255) ** 0.8), 0, 255).astype(np.uint8), made.keypoints


def write_photos(folder, count, **settings):
    """Write photographs; return the true keypoints by name."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    truth = {}
    for n in range(count):
        image, truth[f"{n:02d}.png"] = photograph(n, **settings)
        cv2.imwrite(str(folder / f"{n:02d}.png"), image)
    return truth
