"""Films of a board that moves in all six degrees of freedom before a photograph, and what passes before the board."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kpbench.camera.shutter import BoardMotion
from kpbench.degrade.effects import Effect
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera, rotation_xyz
from kpbench.patches.board import BoardLike
from kpbench.portable import cos_sin, cos_sin_of
from kpbench.render.board_projection import Pose, pose_board
from kpbench.toml import TomlTable
from kpbench.types import Float

FILM_KEYS = ("speed_px", "turn_deg_s")
"""Quantities of a condition of films: largest speed of the board's centre, px per frame, and largest angular velocity,
degrees per second."""
FILM_BOUNDS = {"speed_px": (0.0, 200.0), "turn_deg_s": (0.0, 1000.0)}
TILT_DEG, ROLL_DEG = 35.0, 120.0
"""Amplitudes of the rotations about x and y, and about z."""
DEPTH = 0.2
"""Amplitude of the distance, as a part of it."""
LONGEST_REACH = 0.95
"""Reach of a turned and tilted board that comes near, in sides of the board at its usual distance."""
PATH_PERIODS, PATH_SAMPLES = 8.0, 4001
"""The largest velocities are those of so many samples over so many periods of the path."""
BAR_WIDTH, BAR_REACH = 0.4, 1.1
"""Width of the bar that passes before the board, and distance from which it comes, in sides of the board."""


@dataclass(frozen=True)
class FilmPlan:
    """What all films of a suite share.

    Attributes
    ----------
    frames : int
        Frames of a film.
    fps : float
        Frames per second.
    exposure : float
        Part of the time of a frame during which it is exposed.
    occluded : float
        Part of the frames in which a bar passes before the board.
    """

    frames: int
    fps: float
    exposure: float
    occluded: float

    @classmethod
    def parse(cls, table: TomlTable) -> FilmPlan:
        """Read the table ``film`` of a suite."""
        return cls(
            table.whole_number("frames", 2, 100_000),
            table.number("fps", 1.0, 10_000.0),
            table.number("exposure", 0.0, 1.0),
            table.number("occluded", 0.0, 1.0),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the settings for the config of a dataset."""
        return dict(vars(self))


@dataclass(frozen=True)
class BoardPath:
    """The path of a board: each of six quantities swings about its middle.

    The quantities are x and y of the board's centre, px without the distortion of the lens; the logarithm-free relative
    distance; and the rotations about x, y and z, degrees. Each row of ``swings`` holds the middle, the amplitude, the
    frequency (1/s) and the phase (rad) of a quantity.
    """

    camera: Camera
    z_mm: float
    swings: Float

    def values(self, time_s: float | Float) -> Float:
        """Return the six quantities at some times, ndarray of shape (..., 6)."""
        middle, amplitude, frequency, phase = self.swings.T
        angle = 2 * np.pi * np.asarray(time_s)[..., None] * frequency + phase
        return np.asarray(middle + amplitude * cos_sin(angle)[1])

    def pose(self, time_s: float) -> Pose:
        """Return the pose of the board at a time, s."""
        x, y, distance, *turns = self.values(time_s).tolist()
        z = self.z_mm * distance
        (fx, _, cx), (_, fy, cy), _ = self.camera.K.tolist()
        return Pose(rotation_xyz(*turns), np.array([(x - cx) / fx * z, (y - cy) / fy * z, z]))

    def motion(self, time_s: float, exposure_s: float) -> BoardMotion:
        """Return the motion of the board during an exposure whose middle is at a time, s."""
        if not exposure_s:
            return BoardMotion()
        before, after = (self.pose(time_s + part * exposure_s) for part in (-0.5, 0.5))
        turn = after.R_board2camera @ before.R_board2camera.T
        rad = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        return BoardMotion(tuple((after.t_camera - before.t_camera).tolist()), tuple(np.degrees(rad).tolist()))


def draw_path(
    rng: np.random.Generator, camera: Camera, board: BoardLike, area_percent: float, speed_px: float, turn_deg_s: float
) -> BoardPath:
    """Draw a path on which the board stays in the image.

    Parameters
    ----------
    rng : numpy.random.Generator
    camera : Camera
    board : Board or TagBoard
    area_percent : float
        Area of the board at its usual distance, in percent of the image.
    speed_px, turn_deg_s : float
        Largest speed of the board's centre, px per second, and largest angular velocity, degrees per second.

    Raises
    ------
    DataError
        If the board is too large to move in the image.
    """
    z_mm = float(pose_board(camera, board, area_percent).t_camera[2])
    side_px = camera.focal_px * max(board.side_x_mm, board.side_y_mm) / z_mm
    middle = np.array([(camera.width_px - 1) / 2, (camera.height_px - 1) / 2])
    room = middle - LONGEST_REACH * side_px
    if room.min() <= 0:
        raise DataError(f"area_percent is {area_percent:.3g}, expected a board that can move in the image")
    swings = np.zeros((6, 4))
    swings[:, 0] = [*middle, 1.0, 0.0, 0.0, 360.0 * rng.random()]
    swings[:, 1] = [*room, DEPTH, TILT_DEG, TILT_DEG, ROLL_DEG]
    swings[:, 2] = rng.uniform(0.6, 1.0, 6) * [1.0, 1.3, 0.5, 0.7, 0.9, 1.0]
    swings[:, 3] = 2 * np.pi * rng.random(6)
    path = BoardPath(camera, z_mm, swings)
    times = np.linspace(0, PATH_PERIODS, PATH_SAMPLES)
    rates = np.abs(np.diff(path.values(times), axis=0)) / times[1]
    fastest = float(np.sqrt((rates[:, :2] ** 2).sum(axis=1)).max())
    fastest_turn = float(np.sqrt((rates[:, 3:] ** 2).sum(axis=1)).max())
    swings[:3, 2] *= speed_px / fastest
    swings[3:, 2] *= turn_deg_s / fastest_turn
    return BoardPath(camera, z_mm, swings)


def draw_bar(
    rng: np.random.Generator, film: FilmPlan, frame: int, camera: Camera, board: BoardLike, pose: Pose
) -> list[Effect]:
    """Return the record of the bar that passes before the board; an empty list in frames without it.

    ``rng`` must be the same for all frames of a film.
    """
    count = round(film.occluded * film.frames)
    first = int(rng.integers(film.frames - count + 1))
    angle, grey = float(360.0 * rng.random()), float(rng.integers(20, 236))
    if not first <= frame < first + count:
        return []
    side_px = camera.focal_px * max(board.side_x_mm, board.side_y_mm) / float(pose.t_camera[2])
    way = BAR_REACH * side_px * (2 * (frame - first + 0.5) / count - 1)
    c, s = cos_sin_of(np.radians(angle))
    x, y = camera.project(pose.t_camera[None])[0].tolist()
    strip = (x + c * way, y + s * way, BAR_WIDTH * side_px, 3 * side_px, angle, grey)
    return [{"effect": "occlusion", "strips": [[round(v, 3) for v in strip]]}]


def film_record(film: FilmPlan, frame: int, pose: Pose) -> Effect:
    """Return the record of a frame: its number, its time, s, and the true pose at the middle of the exposure."""
    return {
        "effect": "film",
        "frame_index": frame,
        "time_s": frame / film.fps,
        "rotation": pose.R_board2camera.tolist(),
        "translation_mm": pose.t_camera.tolist(),
    }
