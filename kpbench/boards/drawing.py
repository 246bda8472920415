"""Boards in pictures for people: the outline and the axes of a board whose pose is known."""

from __future__ import annotations

import cv2
import numpy as np

from kpbench.boards.pose import BoardPose
from kpbench.geometry.camera import Camera
from kpbench.patches.board import Board
from kpbench.types import Float, UInt8

AXES = (((1, 0, 0), (255, 64, 64)), ((0, 1, 0), (64, 220, 64)), ((0, 0, -1), (80, 120, 255)))
"""Directions of the drawn axes in the board frame, and their RGB colours. z is drawn towards the viewer."""
OUTLINE_COLOUR = (0, 158, 115)


def draw_board(
    canvas: UInt8,
    board: Board,
    pose: BoardPose,
    camera: Camera,
    colour: tuple[int, int, int] = OUTLINE_COLOUR,
) -> None:
    """Draw the outline and the axes of a board into an image.

    The axes begin at the board's origin. They are red (x), green (y) and blue (towards the viewer).

    Parameters
    ----------
    canvas : ndarray of shape (H, W, 3), uint8
        RGB; changed.
    board : Board
    pose : BoardPose
    camera : Camera
        The canvas is an image of this camera, or a whole-number multiple or fraction of one.
    colour : (r, g, b)
        Of the outline.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.boards import BoardPose, draw_board
    >>> from kpbench.geometry import Camera
    >>> board = kpbench.hexagon_board(kpbench.shipped_patches()[1], side_mm=100.0)
    >>> pose = BoardPose(np.eye(3), np.array([0.0, 0.0, 350.0]), np.eye(6), 0.1, 6)
    >>> canvas = np.zeros((480, 640, 3), np.uint8)
    >>> draw_board(canvas, board, pose, Camera(640, 480, 700.0))
    >>> bool(canvas.any())
    True
    """
    camera = camera.at_size(canvas.shape[1], canvas.shape[0])
    unit, length_mm = max(1, round(max(canvas.shape) / 1000)), min(board.side_x_mm, board.side_y_mm) / 4
    lines = [(_outline(board), colour)]
    lines += [(np.array([np.zeros(3), length_mm * np.array(axis)]), shade) for axis, shade in AXES]
    for line_mm, shade in lines:
        line = _project(camera, pose, line_mm)
        if line is None:
            continue
        for ink, width in (((0, 0, 0), 4 * unit), (shade, 2 * unit)):  # first a dark outline
            cv2.polylines(canvas, [np.rint(16 * line).astype(np.int32)], False, ink, width, cv2.LINE_AA, 4)


def _outline(board: Board) -> Float:
    x, y = board.side_x_mm / 2, board.side_y_mm / 2
    return np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0], [-x, -y, 0]])


def _project(camera: Camera, pose: BoardPose, line_mm: Float) -> Float | None:
    """Return a line of the board in the image, px; None if the lens does not show it."""
    ends = np.linspace(line_mm[:-1], line_mm[1:], 16, axis=1).reshape(-1, 3)
    points = ends @ pose.rotation.T + pose.translation_mm
    if points[:, 2].min() <= 0:
        return None
    rays = points[:, :2] / points[:, 2:]
    return camera.distort(rays) if np.hypot(*rays.T).max() < camera.lens.largest_radius else None
