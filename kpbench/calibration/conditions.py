"""Condition and rung of a photograph: from the names of its folders, or measured."""

from __future__ import annotations

import math
from pathlib import PurePosixPath

import numpy as np

from kpbench.calibration.bundle import PhotoPose
from kpbench.calibration.projection import project_points
from kpbench.calibration.shape import PrintShape
from kpbench.geometry.camera import Camera
from kpbench.patches.board import Board

FREE_CONDITION = "free"
"""Condition of a photograph that belongs to no rung."""
RUNGS = {"scale": (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0), "pitch": (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)}
"""Rungs of the suite ``paper-v1``: share of the image, %, and tilt, degrees."""
SCALE_TOLERANCE = 2**0.25
"""Largest ratio of a share of the image to its rung."""
PITCH_TOLERANCE_DEG = 2.5
"""Largest difference of a tilt from its rung."""


def name_condition(name: str) -> tuple[str, float]:
    """Return condition and rung of a photograph: those of ``…/blur/7/photo.png``, else ``free`` and nan.

    Parameters
    ----------
    name : str
        Path of the photograph, with ``/`` between its parts.

    Examples
    --------
    >>> from kpbench.calibration.conditions import name_condition
    >>> name_condition("blur/7/a.jpg"), name_condition("monday/a.jpg")
    (('blur', 7.0), ('free', nan))
    """
    parts = PurePosixPath(name).parts
    if len(parts) >= 3:
        try:
            rung = float(parts[-2])
        except ValueError:
            rung = math.nan
        if math.isfinite(rung):
            return parts[-3], rung
    return FREE_CONDITION, math.nan


def measure_condition(kind: str, board: Board, camera: Camera, pose: PhotoPose, shape: PrintShape) -> tuple[str, float]:
    """Return condition and the nearest rung of a photograph, measured by its pose; ``free`` and nan if none is near.

    Parameters
    ----------
    kind : {"scale", "pitch"}
        Share of the image that the board covers, or angle between the board's normal and the ray to its centre.
    board, camera, pose, shape
        As solved.
    """
    half_x, half_y = board.side_x_mm / 2, board.side_y_mm / 2
    corners = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])
    if kind == "pitch":
        ray = pose.translation_mm / np.linalg.norm(pose.translation_mm)
        value = float(np.degrees(np.arccos(np.clip(abs(pose.rotation[:, 2] @ ray), 0.0, 1.0))))
        rung = min(RUNGS["pitch"], key=lambda r: abs(r - value))
        is_near = abs(rung - value) <= PITCH_TOLERANCE_DEG
    else:
        seen = project_points(camera, pose.rotation, pose.translation_mm, shape.bend(corners)).xy
        x, y = seen.T
        area = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
        value = max(100 * area / (camera.width_px * camera.height_px), 1e-9)
        rung = min(RUNGS["scale"], key=lambda r: abs(math.log(r / value)))
        is_near = max(rung / value, value / rung) <= SCALE_TOLERANCE
    return (kind, rung) if is_near else (FREE_CONDITION, math.nan)
