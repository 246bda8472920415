"""The best operating point of each rival: the settings of the detectors of tags that kpbench ships.

    python benchmarks/experiments/tune_rivals.py                  # all rivals; needs the extras apriltag, napa, locus
    python benchmarks/experiments/tune_rivals.py --rival napa --images 3

Rule. The scenes are those of `paper-v1` and `extended-v1` at 640x480, four of seed 1, which no published table uses.
The merit of a setting is the share of corners found with the right identity, less the false alarms per corner: a false
alarm costs as much as a corner brings. Each image counts alike. The search starts at the library's defaults, takes the
axes below in turn, keeps a value that adds more than 0.001, and ends after a round without a change. Among the starts
of a rival, the best end wins.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from kpbench import SuiteConfig, load_suite
from kpbench.detectors.tags import AprilTagDetector, ArucoDetector, CharucoDetector, LocusDetector, NapaDetector
from kpbench.types import Detections, Float, UInt8

SEED, SIZE_PX, LEAST_GAIN = 1, (640, 480), 0.001
REFINE = cv2.aruco
OPENCV_AXES: dict[str, list[Any]] = {
    "minOtsuStdDev": [2.0],
    "errorCorrectionRate": [1.0],
    "maxErroneousBitsInBorderRate": [0.5],
    "perspectiveRemoveIgnoredMarginPerCell": [0.25],
}
QUAD_AXES: dict[str, list[Any]] = {
    "aprilTagQuadDecimate": [1.0, 1.5],
    "aprilTagQuadSigma": [0.8],
    "aprilTagMinWhiteBlackDiff": [2],
    **OPENCV_AXES,
}
WINDOW_AXES: dict[str, list[Any]] = {
    "windows": [(3, 23, 4), (3, 43, 8), (5, 53, 12)],
    "adaptiveThreshConstant": [3],
    "minMarkerPerimeterRate": [0.01],
    "polygonalApproxAccuracyRate": [0.05],
    **OPENCV_AXES,
}
APRILTAG_AXES: dict[str, list[Any]] = {
    "decimate": [1.0, 1.5, 2.0],
    "blur": [0.0, 0.4, 0.8, 1.2, -0.5],
    "maxhamming": [0, 1, 2],
    "refine_edges": [True, False],
}
NAPA_AXES: dict[str, list[Any]] = {
    "min_tag_px": [8, 12, 16, 24, 32],
    "min_contrast": [5, 10, 20],
    "min_border_cells": [16, 18, 20, 22, 24],
    "max_hamming": [1, 2, 3],
    "sharpening": [0.0, 0.25, 0.5],
}
LOCUS_AXES: dict[str, list[Any]] = {
    "decimation": [1, 2],
    "threshold.mode": ["TileMidExtreme", "LocalMean"],
    "threshold.local_mean_radius": [5, 7, 15, 25],
    "threshold.noise_k": [2.0, 3.0, 4.0],
    "threshold.enable_sharpening": [True, False],
    "threshold.tile_size": [4, 8, 16],
    "decoder.min_contrast": [5.0, 10.0, 20.0],
    "decoder.max_hamming_error": [1, 2, 3],
    "decoder.max_border_error_rate": [0.04, 0.1, 0.2],
    "quad.min_area": [16, 36, 100],
    "quad.min_edge_score": [1.0, 2.0, 4.0],
    "segmentation.connectivity": ["Four", "Eight"],
}
Settings = dict[str, Any]


def opencv_settings(settings: Settings) -> Settings:
    """Replace ``windows`` by OpenCV's three fields."""
    plain = {key: value for key, value in settings.items() if key != "windows"}
    names = ("adaptiveThreshWinSizeMin", "adaptiveThreshWinSizeMax", "adaptiveThreshWinSizeStep")
    return plain | dict(zip(names, settings.get("windows", ()), strict=False))


def refined(method: int) -> Settings:
    return {"cornerRefinementMethod": method}


Rival = tuple[Callable[[Settings], Any], list[Settings], dict[str, list[Any]]]
RIVALS: dict[str, Rival] = {
    "napa": (NapaDetector, [{}], NAPA_AXES),
    "apriltag": (AprilTagDetector, [{}], APRILTAG_AXES),
    "locus": (LocusDetector, [{"profile": "standard"}, {"profile": "grid"}, {"profile": "high_accuracy"}], LOCUS_AXES),
    "aruco": (
        lambda s: ArucoDetector(opencv_settings(s)),
        [refined(m) for m in (REFINE.CORNER_REFINE_SUBPIX, REFINE.CORNER_REFINE_CONTOUR)],
        WINDOW_AXES,
    ),
    "aruco-quads": (
        lambda s: ArucoDetector(opencv_settings(s)), [refined(REFINE.CORNER_REFINE_APRILTAG)], QUAD_AXES,
    ),
    "charuco": (
        lambda s: CharucoDetector(opencv_settings(s)), [{}],
        {"tryRefineMarkers": [True], "checkMarkers": [False], "minMarkers": [1], **WINDOW_AXES},
    ),
}  # fmt: skip
"""Detector, starts and axes of each rival. OpenCV searches quads in two ways, so ArUco has two rows."""


def scenes(board: str, images: int) -> list[tuple[UInt8, Float, Float, float]]:
    """Image, corners, identities and ε (px) of every scene and rung."""
    found = []
    for suite in ("paper-v1", "extended-v1"):
        config = replace(SuiteConfig(load_suite(suite), images=images, size_px=SIZE_PX), seed=SEED, board=board)
        for index in range(config.n):
            sample, _ = config.make(index)
            k = sample.keypoints
            found.append((sample.image, np.column_stack([k["x"], k["y"]]), k["patch_id"], 0.1 * k["radius_minor"]))
    return found


def count(found: Detections, xy: Float, ids: Float, eps_px: Float) -> tuple[int, int]:
    """Corners found with the right identity, and false alarms."""
    if not len(found):
        return 0, 0
    near = np.linalg.norm(found.xy[:, None] - xy[None], axis=2) <= eps_px[None]
    same = found.patch_id[:, None] == ids[None]
    right = int((near & same).any(axis=0).sum())
    return right, len(found) - right


def merit(detector: Any, shown: list[Any]) -> tuple[float, float]:
    """The merit of a detector, and its time, ms an image."""
    total, started = 0.0, time.perf_counter()
    for image, xy, ids, eps_px in shown:
        right, alarms = count(detector.detect(image), xy, ids, eps_px)
        total += (right - alarms) / len(xy)
    return total / len(shown), 1e3 * (time.perf_counter() - started) / len(shown)


def climb(make: Callable[[Settings], Any], start: Settings, axes: dict[str, list[Any]], shown: list[Any]) -> Settings:
    """The settings at which no axis brings more; every step is printed."""
    settings, known = dict(start), dict[str, float]()

    def value(trial: Settings) -> float:
        key = repr(sorted(trial.items()))
        if key not in known:
            known[key], ms = merit(make(trial), shown)
            print(f"    {known[key]:.4f} {ms:6.2f} ms  {trial}", flush=True)
        return known[key]

    best = value(settings)
    for _ in range(3):
        before = best
        for axis, options in axes.items():
            for option in options:
                if settings.get(axis) == option:
                    continue
                try:
                    reached = value(settings | {axis: option})
                except Exception as error:  # a combination that a library refuses
                    print(f"    refused {axis}={option}: {' '.join(str(error).split())[:80]}")
                    continue
                if reached > best + LEAST_GAIN:
                    settings, best = settings | {axis: option}, reached
        if best == before:
            break
    print(f"  {best:.4f} at {settings}, from {start or 'the defaults'} {value(dict(start)):.4f}", flush=True)
    return settings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rival", action="append", choices=list(RIVALS), help="default: all")
    parser.add_argument("--images", type=int, default=4, help="scenes a rung")
    options = parser.parse_args()
    shown: dict[str, list[Any]] = {}
    for name in options.rival or RIVALS:
        make, starts, axes = RIVALS[name]
        board = make(starts[0]).board
        if board not in shown:
            shown[board] = scenes(board, options.images)
        print(f"{name}: {len(shown[board])} images")
        for start in starts:
            climb(make, start, axes, shown[board])


if __name__ == "__main__":
    main()
