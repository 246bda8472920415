"""Detections of boards in simulated views, with errors like those of the shipped detectors."""

from dataclasses import dataclass

import numpy as np
from helpers import rotation

from kpbench import Board, Detections, grid_board, hexagon_board, shipped_patches
from kpbench.geometry import Camera
from kpbench.geometry.camera import rotation_xyz
from kpbench.patches import BoardKeypoint

PATCHES = shipped_patches()
PLACES = [(0, -70, -50, 0), (1, 0, -55, 40), (2, 70, -50, 10), (3, -65, 50, 0), (0, 5, 40, 20), (2, 70, 55, 90)]
MIXED = Board("mixed", 200, 160, tuple(BoardKeypoint(PATCHES[n], x, y, turn, 26) for n, x, y, turn in PLACES))
BOARDS = {
    "mixed": MIXED,
    "grid": grid_board(PATCHES, 4, 3, 30, 60),
    "checker": hexagon_board(PATCHES[0], 187.5),
    "trefoil": hexagon_board(PATCHES[1], 187.5),
    "wheel": hexagon_board(PATCHES[2], 187.5),
}
CAMERA = Camera(1624, 1240, 889.0)
BENT = Camera(1624, 1240, 889.0, (-0.25, 0.08, 0.001, 0.0005, 0.0))
MILD = Camera(1624, 1240, 889.0, (-0.03, 0.0, 0.0, 0.0))


@dataclass
class Scene:
    """Detections, and for each of them the copy of the board and the keypoint that it is; -1 for a false alarm."""

    found: Detections
    copy: np.ndarray
    point: np.ndarray
    poses: list


def view(rng, board, camera, most_tilt_deg=55):
    """A pose in which all keypoints are in the image: (R, t)."""
    while True:
        R = rotation_xyz(*rng.uniform(-most_tilt_deg, most_tilt_deg, 2), rng.uniform(0, 360))
        z = rng.uniform(250, 2000)
        t = np.array([rng.uniform(-0.5, 0.5) * z, rng.uniform(-0.4, 0.4) * z, z])
        points = board.points_mm @ R.T + t
        if points[:, 2].min() < 100 or R[:, 2] @ t < 0.2 * z:  # seen from behind, or almost from the side
            continue
        xy = camera.project(points)
        if (xy > 0).all() and (xy < [camera.width_px, camera.height_px]).all():
            return R, t


def frame(R, t, camera, keypoint):
    """The affine frame of a patch, without errors."""
    M = np.column_stack([R[:, :2], t]) @ keypoint.H_patch2board
    H = camera.local_K(M[:2, 2] / M[2, 2]) @ M
    return (H[:2, :2] - np.outer(H[:2, 2], H[2, :2]) / H[2, 2]) / H[2, 2]


def frame_error(rng, patch):
    """The error of a frame: of the scale where a design has lines alone, and along its lines where they are two."""
    radii, angles, _ = patch.cells
    size = np.eye(2) + rng.normal(0, 0.007, (2, 2))
    if len(radii) > 2:
        return size
    if len(angles) == 4:  # two lines, along x and y
        size = size @ np.diag(np.exp(rng.normal(0, 0.05, 2)))
    turn = rotation(360 / patch.symmetry_order * rng.integers(patch.symmetry_order))
    return size @ turn * np.exp(rng.normal(0, 0.1))


def scene(rng, board, camera=CAMERA, seen=None, copies=1, alarms=4, poses=None):
    """Detections of ``seen`` random keypoints of each copy of a board, and of false alarms of its IDs, shuffled."""
    rows, poses = [], poses or [view(rng, board, camera) for _ in range(copies)]
    for copy, (R, t) in enumerate(poses):
        xy = camera.project(board.points_mm @ R.T + t)
        for n in rng.permutation(len(xy))[:seen].tolist():
            A = frame(R, t, camera, board.keypoints[n])
            sigma = max(0.004 * np.sqrt(np.linalg.det(A)), 0.02)
            A = A @ frame_error(rng, board.keypoints[n].patch)
            rows.append((xy[n] + rng.normal(0, sigma, 2), A, sigma, board.keypoints[n].patch_id, copy, n))
    for _ in range(alarms):
        A = rotation(rng.uniform(0, 360)) @ np.diag([1, rng.uniform(0.5, 1)]) @ rotation(rng.uniform(0, 360))
        patch_id = rng.choice([k.patch_id for k in board.keypoints])
        rows.append(
            (rng.uniform(0, [camera.width_px, camera.height_px]), A * rng.uniform(8, 40), 0.1, patch_id, -1, -1)
        )
    rows = [rows[n] for n in rng.permutation(len(rows))]
    xy, A, sigma, ids, copy, point = map(np.array, zip(*rows, strict=True))
    covariance = sigma[:, None, None] ** 2 * np.eye(2)
    found = Detections(xy, rng.uniform(0.3, 1, len(xy)), ids, A, covariance, sigma)
    return Scene(found, copy, point, poses)
