"""Poses of a board, and the exact projection of a board into the image, with lens distortion.

The experiments fix the share of the image that the board covers. This share determines the board's distance.
:mod:`kpbench.geometry` describes the frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from kpbench.errors import DataError
from kpbench.geometry.camera import Camera, plane_to_camera, rotation_xyz
from kpbench.geometry.outline import flatten, rectangle
from kpbench.patches.board import BoardLike
from kpbench.portable import exp, log, matmul
from kpbench.types import Float

FREE_MARGIN = 0.01
"""Least distance between the board and the border of the image, in image widths."""
LONGEST_PIECE_PX = 8.0
"""If the lens bends lines, edges are cut into straight pieces of at most this length, px (see ``MOST_PIECES``)."""
MOST_PIECES = 400
"""Largest number of straight pieces of one edge; pieces of a very long edge are longer than ``LONGEST_PIECE_PX``."""


@dataclass(frozen=True)
class Pose:
    """Pose of a board: ``X_camera = R_board2camera @ X_board + t_camera``.

    Attributes
    ----------
    R_board2camera : ndarray of shape (3, 3)
        Rotation.
    t_camera : ndarray of shape (3,)
        The board's centre in the camera frame, mm.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.render import Pose
    >>> Pose(np.eye(3), np.array([0.0, 0.0, 400.0])).M_board2camera.tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 400.0]]
    """

    R_board2camera: Float
    t_camera: Float

    @property
    def M_board2camera(self) -> Float:
        """Matrix of shape (3, 3) that takes (x_mm, y_mm, 1) on the board to the camera frame."""
        return plane_to_camera(self.R_board2camera, self.t_camera)


def polygon_area(points: Float) -> float:
    """Compute the area of a simple polygon with vertices of shape (n, 2), clockwise or counter-clockwise."""
    x, y = (points - points[0]).T
    return float(abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2)


def project_to_image(camera: Camera, pose: Pose, points_mm: Float) -> Float:
    """Return the pixel coordinates, shape (n, 2), of points on the board, shape (n, 2), mm."""
    return camera.project(matmul(np.column_stack([points_mm, np.ones(len(points_mm))]), pose.M_board2camera.T))


def project_outline(camera: Camera, pose: Pose, board: BoardLike, inset_mm: float = 0.0) -> Float:
    """Return the pixel coordinates, shape (n, 2), of the board's outline, moved inwards by ``inset_mm``."""
    w, h = board.side_x_mm - 2 * inset_mm, board.side_y_mm - 2 * inset_mm
    corners = flatten(rectangle(-w / 2, -h / 2, w, h), 1.0)[0]
    return project_polygon(camera, pose, corners)


def project_polygon(camera: Camera, pose: Pose, polygon_mm: Float) -> Float:
    """Project a polygon on the board into the image. If the lens bends lines, cut the edges into short pieces."""
    if not camera.is_bent:
        return project_to_image(camera, pose, polygon_mm)
    edge_mm = np.roll(polygon_mm, -1, axis=0) - polygon_mm
    end_px = project_to_image(camera, pose, np.roll(polygon_mm, -1, axis=0))
    length_px = np.sqrt(((end_px - project_to_image(camera, pose, polygon_mm)) ** 2).sum(axis=1))
    pieces = np.clip(np.ceil(length_px / LONGEST_PIECE_PX), 1, MOST_PIECES).astype(int)
    edge = np.repeat(np.arange(len(pieces)), pieces)
    fraction = (np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[edge]
    return project_to_image(camera, pose, polygon_mm[edge] + fraction[:, None] * edge_mm[edge])


def pose_board(
    camera: Camera,
    board: BoardLike,
    area_percent: float,
    *,
    pitch_deg: float = 0.0,
    yaw_deg: float = 0.0,
    roll_deg: float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
    inside_mm: Float | None = None,
) -> Pose:
    """Place a board at a given tilt, at the distance where the board covers a given share of the image.

    Parameters
    ----------
    camera : Camera
    board : Board or TagBoard
    area_percent : float
        Projected area of the board, in percent of the image's area.
    pitch_deg : float
        Tilt about the camera's x axis. A positive pitch moves the board's upper side away from the camera, as if the
        board lay on a table.
    yaw_deg : float
        Tilt about the camera's y axis, after the pitch. A positive yaw moves the board's right side away from the
        camera.
    roll_deg : float
        Turn of the board in its own plane, before any tilt, from +x towards +y.
    shift : (float, float)
        Offset of the board's centre from the image's centre, in image widths and heights, before lens distortion. If
        the board would not fit into the image, the largest of 0.8, 0.6, 0.4, 0.2 and 0 times the shift is used at
        which the board fits.
    inside_mm : ndarray of shape (n, 2), optional
        Outline on the board, mm, that must lie in the image. None: the outline of the board.

    Returns
    -------
    Pose

    Raises
    ------
    DataError
        If the board does not fit into the image at this area and tilt.

    Examples
    --------
    >>> from kpbench import hexagon_board, shipped_patches
    >>> from kpbench.geometry import Camera
    >>> from kpbench.render import pose_board
    >>> board = hexagon_board(shipped_patches()[0], 187.5)
    >>> pose = pose_board(Camera(640, 480, 350.0), board, area_percent=16, pitch_deg=30)
    >>> pose.t_camera.round().tolist()
    [0.0, 0.0, 283.0]
    """
    # in rotation_xyz, a positive x angle turns +y (down) away from the camera, and a positive y angle turns +x towards
    # the camera; pitch and yaw have the opposite signs
    R = matmul(matmul(rotation_xyz(0, -yaw_deg, 0), rotation_xyz(-pitch_deg, 0, 0)), rotation_xyz(0, 0, roll_deg))
    size = np.array([camera.width_px, camera.height_px])
    margin_px = FREE_MARGIN * camera.width_px
    for fraction in (1.0, 0.8, 0.6, 0.4, 0.2, 0.0):
        ray = np.append(fraction * np.asarray(shift) * size / camera.focal_px, 1.0)
        pose = Pose(R, _find_depth(camera, board, R, ray, area_percent / 100 * size.prod()) * ray)
        outline = (
            project_outline(camera, pose, board) if inside_mm is None else project_polygon(camera, pose, inside_mm)
        )
        if (outline >= margin_px - 0.5).all() and (outline <= size - 0.5 - margin_px).all():
            return pose
    view = f"{area_percent:g} % of the image at pitch {pitch_deg:g} and yaw {yaw_deg:g} degrees"
    raise DataError(f"a board of {view} does not fit into {camera.width_px}x{camera.height_px} px")


def _find_depth(camera: Camera, board: BoardLike, R: Float, ray: Float, area_px: float) -> float:
    """Find the depth (distance along the optical axis), mm, at which the board covers ``area_px`` square pixels."""

    def solve(lens: Camera, nearest_mm: float, farthest_mm: float) -> float:
        def log_area_ratio(log_depth: float) -> float:
            outline = project_outline(lens, Pose(R, exp(log_depth) * ray), board)
            return float(log(polygon_area(outline) / area_px))

        return float(exp(brentq(log_area_ratio, float(log(nearest_mm)), float(log(farthest_mm)), xtol=1e-13)))

    corners = np.array([(x, y, 0.0) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * (board.side_x_mm, board.side_y_mm, 0)
    frontal_mm = camera.focal_px * np.sqrt(board.side_x_mm * board.side_y_mm / area_px)
    nearest_mm = max(-matmul(corners, R.T)[:, 2].min() * 1.001, 0.05 * frontal_mm)
    try:
        depth_mm = solve(camera.without_distortion(), nearest_mm, 4 * frontal_mm)
        if not camera.is_bent:
            return depth_mm
        # the lens polynomial is valid only in and near the image; the search therefore stays near ``depth_mm``, which
        # holds without distortion
        return solve(camera, max(nearest_mm, 0.7 * depth_mm), 1.5 * depth_mm)
    except ValueError:
        raise DataError(f"no distance gives a board an image of {area_px:.0f} px at this tilt and lens") from None
