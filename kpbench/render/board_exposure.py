"""Boards that a camera exposes: bent paper in motion behind a lens, in linear light, and the true keypoints.

The outlines of ink and paper follow one moving map: bow of the paper, motion of the board, lens, rolling shutter. Each
pixel is blended by the mean, over the exposure, of the exact fraction of its area that ink or paper covers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.camera.chain import SCENE_TONE
from kpbench.camera.paper import Bow
from kpbench.camera.shutter import BoardMotion, MovingMap, Shutter, rasterise_moving, true_homography
from kpbench.geometry.camera import Camera
from kpbench.geometry.coverage import Box, clip_to_image
from kpbench.geometry.homography import project, project_disc_sizes
from kpbench.geometry.outline import flatten, rectangle
from kpbench.patches.board import BoardLike
from kpbench.portable import cos_sin, matmul
from kpbench.render.board_projection import Pose, polygon_area
from kpbench.render.board_view import (
    EDGE_WIDTH,
    RIM_POINTS,
    Appearance,
    board_brightness,
    combine_covers,
    ellipse_of_moments,
    shadow_light,
)
from kpbench.render.scene import Mask
from kpbench.types import KEYPOINT_DTYPE, Float, Float32

OUTLINE_POINTS = 32
"""Number of points on each side of the board; the board's shadow and size are computed from these points."""
BOARD_TOLERANCE_PX = 4e-3
"""Largest distance between a drawn edge and the true edge of a board, px."""


STILL_BOARD, GLOBAL_SHUTTER = BoardMotion(), Shutter()


@dataclass(frozen=True)
class ExposedBoard:
    """A board while a camera exposes it.

    Attributes
    ----------
    board : Board or TagBoard
    pose : Pose
        The pose at time 0: at the middle of the exposure of the image's middle row.
    motion : BoardMotion
    shutter : Shutter
    bow : Cylinder, Saddle or None
        None: the board is flat.
    ink_gain : float
        Distance by which all edges of the black ink move outwards, in disc radii.

    Examples
    --------
    >>> from kpbench import hexagon_board, shipped_patches
    >>> from kpbench.camera.shutter import BoardMotion
    >>> from kpbench.geometry import Camera
    >>> from kpbench.render import pose_board
    >>> from kpbench.render.board_exposure import ExposedBoard
    >>> camera, board = Camera(640, 480, 350.0), hexagon_board(shipped_patches()[0], 187.5)
    >>> exposed = ExposedBoard(board, pose_board(camera, board, area_percent=16), BoardMotion((8.0, 0.0, 0.0)))
    >>> keypoints = exposed.keypoints(camera)
    >>> len(keypoints), round(float(keypoints["radius_major"][0]), 1)
    (6, 17.7)
    """

    board: BoardLike
    pose: Pose
    motion: BoardMotion = STILL_BOARD
    shutter: Shutter = GLOBAL_SHUTTER
    bow: Bow | None = None
    ink_gain: float = 0.0

    def moving_map(self, camera: Camera) -> MovingMap:
        """Return the map from points of the flat board, mm, and times to px."""
        return self.motion.of_board(camera, self.pose.R_board2camera, self.pose.t_camera, self.bow)

    def see(self, camera: Camera, points_mm: Float) -> Float:
        """Return where points of the flat board, shape (N, 2), mm, are seen at mid-exposure, shape (N, 2), px."""
        return self.shutter.expose(self.moving_map(camera), points_mm)

    def keypoints(self, camera: Camera) -> NDArray[Any]:
        """Compute the true keypoints: the poses at mid-exposure of the row that each centre falls on.

        ``H_patch2image`` agrees with the image to first order at the centre. The semi-axes are those of the ellipse
        that has the same second moments as the image of the disc. ``visible`` is 1 and ``contrast`` is nan.
        """
        keypoints = np.zeros(len(self.board.keypoints), KEYPOINT_DTYPE)
        M_board2image = matmul(camera.K, self.pose.M_board2camera)
        angles = np.arange(RIM_POINTS) * (2 * np.pi / RIM_POINTS)
        rim = np.column_stack(cos_sin(angles))
        on_board = self.moving_map(camera)
        for n, k in enumerate(self.board.keypoints):

            def on_patch(points: Float, times: Float, H_patch2board: Float = k.H_patch2board) -> Float:
                return on_board(project(H_patch2board, points), times)

            H = true_homography(on_patch, matmul(M_board2image, k.H_patch2board), self.shutter)
            ellipse = ellipse_of_moments(self.shutter.expose(on_patch, rim))
            axes = (ellipse.major, ellipse.minor, ellipse.angle_deg)
            keypoints[n] = (H[0, 2], H[1, 2], k.patch_id, *axes, H, 1.0, np.nan)
        return keypoints


def paint_board(light: Float32, camera: Camera, exposed: ExposedBoard, appearance: Appearance) -> tuple[Mask, ...]:
    """Draw a board into linear light, in place, as the mean over the exposure.

    Parameters
    ----------
    light : ndarray of shape (H, W) or (H, W, 3), float32
        The scene behind the board, which neither moves nor bends.
    camera : Camera
    exposed : ExposedBoard
    appearance : Appearance
        Inks are grey levels of a linear-light scene's tone curve. All other factors are factors of the light.

    Returns
    -------
    tuple of Mask
        One mask per keypoint.
    """
    board, moving_map = exposed.board, exposed.moving_map(camera)
    outline_px = exposed.see(camera, _outline(board))
    side_px = float(np.sqrt(polygon_area(outline_px)))
    inks, discs = board.outlines(_radii(exposed, camera), exposed.ink_gain)
    regions = [[_corners(board)], [_corners(board, EDGE_WIDTH * min(board.side_x_mm, board.side_y_mm))], *inks, *discs]
    covers = rasterise_moving(regions, moving_map, exposed.shutter, tolerance_px=BOARD_TOLERANCE_PX)
    left, top = min(b[0] for b, _ in covers), min(b[1] for b, _ in covers)
    box = (left, top, max(b[0] + b[2] for b, _ in covers) - left, max(b[1] + b[3] for b, _ in covers) - top)
    parts = combine_covers(box, [(box, _enlarge(*cover, box)) for cover in covers[:2]] + covers[2:], len(inks))
    _, board_cover, face_cover, black_cover, masks = parts
    if appearance.shadow:
        in_image, fraction = shadow_light(light, outline_px, side_px, appearance)
        light[in_image] *= fraction
    black, white = SCENE_TONE.light(np.array([appearance.black, appearance.white]) / 255).tolist()
    level = white * (appearance.edge * (board_cover - face_cover) + face_cover) - (white - black) * black_cover
    level *= board_brightness(appearance, box, exposed.see(camera, np.zeros((1, 2)))[0], side_px)
    in_image, in_box = clip_to_image(box, light)
    level, uncovered = level[in_box], 1.0 - board_cover[in_box]
    if light.ndim == 3:
        level, uncovered = level[..., None], uncovered[..., None]
    light[in_image] = light[in_image] * uncovered + level
    return masks


def _corners(board: BoardLike, inset_mm: float = 0.0) -> Float:
    w, h = board.side_x_mm - 2 * inset_mm, board.side_y_mm - 2 * inset_mm
    return flatten(rectangle(-w / 2, -h / 2, w, h), 1.0)[0]


def _outline(board: BoardLike) -> Float:
    """Return points along the board's outline, ndarray of shape (4 OUTLINE_POINTS, 2), mm."""
    corners = _corners(board)
    share = np.arange(OUTLINE_POINTS)[:, None] / OUTLINE_POINTS
    sides = [corners[n] + share * (corners[(n + 1) % 4] - corners[n]) for n in range(4)]
    return np.concatenate(sides)


def _radii(exposed: ExposedBoard, camera: Camera) -> Float:
    """Return the major semi-axis of each keypoint's disc without bow and distortion, ndarray of shape (n,), px."""
    M_board2image = matmul(camera.K, exposed.pose.M_board2camera)
    return project_disc_sizes(np.stack([matmul(M_board2image, k.H_patch2board) for k in exposed.board.keypoints]))[1]


def _enlarge(box: Box, cover: Float, outer: Box) -> Float:
    """Return a cover in a larger box."""
    whole = np.zeros((outer[3], outer[2]))
    x, y = box[0] - outer[0], box[1] - outer[1]
    whole[y : y + box[3], x : x + box[2]] = cover
    return whole
