"""Frames of a small film of a board, for the tests of tracking."""

from functools import cache

import numpy as np

import kpbench
from kpbench.geometry import Camera
from kpbench.render import Appearance, Pose, render_board
from kpbench.synth.suite_boards import mixed_board

CAMERA = Camera(406, 310, 222.2)
BOARD = mixed_board(kpbench.shipped_patches())
FPS = 30.0


@cache
def detector():
    return kpbench.load_detector("superpoint-small")


def pose_at(frame, speed_mm=8.0, turn_deg=2.0):
    c, s = np.cos(np.radians(turn_deg * frame)), np.sin(np.radians(turn_deg * frame))
    tilt = np.array([[1, 0, 0], [0, np.cos(0.4), -np.sin(0.4)], [0, np.sin(0.4), np.cos(0.4)]])
    R = tilt @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return Pose(R, np.array([speed_mm * (frame - 6), 3.0 * frame - 18, 280.0]))


def shot(pose, board=BOARD, seed=0, camera=CAMERA):
    rng = np.random.default_rng(seed)
    ground = rng.integers(60, 120, (camera.height_px, camera.width_px)).astype(np.uint8)
    image = render_board(ground, camera, pose, board, Appearance(30, 220)).image
    return np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
