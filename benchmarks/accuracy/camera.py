"""Is the camera true? Area, patch size, projection and axes of paper-v1, each measured by other means.

area    pixels of the board counted in a render (white board, black scene, grey > 127), percent of the image
size    full length of a patch's long axis, px, mean over the patches
points  largest distance to cv2.projectPoints, px, without and with lens distortion
axes    largest difference to the axes of a least-squares conic through 720 rim points that cv2.projectPoints
        projected, px, without and with lens distortion

    python benchmarks/accuracy/camera.py --scenes 8
"""

from __future__ import annotations

import argparse

import cv2
import numpy as np

from kpbench import SuiteConfig, load_suite
from kpbench.render import Appearance, render_board
from kpbench.synth import View
from kpbench.types import Float

LENS = (-0.2, 0.05, 0.001, -0.0005, 0.01)


def conic_axes(points: Float) -> Float:
    """Semi-axes (major, minor) of the conic A x² + B xy + C y² + D x + E y = 1 nearest to the points."""
    middle = points.mean(axis=0)
    scale = np.abs(points - middle).max()
    x, y = ((points - middle) / scale).T
    a, b, c, d, e = np.linalg.lstsq(np.stack([x * x, x * y, y * y, x, y], axis=1), np.ones(len(x)), rcond=None)[0]
    shape = np.array([[a, b / 2], [b / 2, c]])
    centre = np.linalg.solve(-2 * shape, [d, e])
    return np.asarray(scale * np.sqrt((1 + centre @ shape @ centre) / np.linalg.eigvalsh(shape)))


def by_opencv(config: SuiteConfig, view: View, points_mm: Float) -> Float:
    points = np.column_stack([points_mm, np.zeros(len(points_mm))])
    turn, _ = cv2.Rodrigues(view.pose.R_board2camera)
    distortion = np.array(config.camera.distortion)
    return cv2.projectPoints(points, turn, view.pose.t_camera, config.camera.K, distortion)[0].reshape(-1, 2)


def differences(config: SuiteConfig, view: View) -> tuple[float, float]:
    """Largest differences of points and of axes, px."""
    k = view.keypoints
    points = by_opencv(config, view, view.board.points_mm[:, :2]) - np.column_stack([k["x"], k["y"]])
    angles = np.radians(np.arange(720) / 2)
    unit = np.column_stack([np.cos(angles), np.sin(angles)])
    axes = [
        conic_axes(by_opencv(config, view, unit * b.diameter_mm / 2 + (b.x_mm, b.y_mm))) for b in view.board.keypoints
    ]
    off = np.array(axes) - np.column_stack([k["radius_major"], k["radius_minor"]])
    return float(np.hypot(*points.T).max()), float(abs(off).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=8)
    scenes = parser.parse_args().scenes
    cv2.setNumThreads(1)
    suite = load_suite("paper-v1")
    plain, bent = (SuiteConfig(suite, scenes, only=("scale", "pitch"), distortion=d) for d in ((), LENS))
    black = np.zeros((plain.camera.height_px, plain.camera.width_px), np.uint8)
    print("| condition | rung | area counted % | worst % | size px | points px | axes px | bent: points | axes |")
    print("|---|---|---|---|---|---|---|---|---|")
    for rung, (condition, step) in enumerate(plain.rungs):
        areas, sizes, worst = [], [], np.zeros(4)
        for scene in range(scenes):
            index = rung * len(suite.patches) * scenes + scene
            view, bent_view = plain.view(index), bent.view(index)
            image = render_board(black, plain.camera, view.pose, view.board, Appearance(255, 255, edge=1.0)).image
            areas.append(100 * np.count_nonzero(image > 127) / image.size)
            sizes.append(2 * view.keypoints["radius_major"].mean())
            worst = np.maximum(worst, [*differences(plain, view), *differences(bent, bent_view)])
        nominal = dict(condition.pose).get("area_percent", (16.0,) * 10)[step]
        off = 100 * max(abs(np.array(areas) / nominal - 1))
        cells = [
            condition.name,
            f"{condition.rungs[step]:g}",
            f"{np.mean(areas):.4f}",
            f"{off:.3f}",
            f"{np.mean(sizes):.2f}",
        ]
        print("| " + " | ".join(cells + [f"{v:.1e}" for v in worst]) + " |")


if __name__ == "__main__":
    main()
