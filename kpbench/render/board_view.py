"""Views of a board in front of a camera: light, exact rendering, and the true keypoints.

The outlines of ink and paper are projected into the image. Each pixel is blended by the exact fraction of its area that
ink or paper covers. Even a board that covers 0.5 % of the image is therefore not aliased.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.filters import filter_separably, gaussian_taps
from kpbench.geometry.camera import Camera
from kpbench.geometry.coverage import Box, bounding_box, clip_to_image, rasterise
from kpbench.geometry.homography import Ellipse, ellipse_axes, project_disc
from kpbench.patches.board import BoardLike
from kpbench.portable import cos_sin, matmul
from kpbench.render.board_projection import Pose, polygon_area, project_outline, project_polygon, project_to_image
from kpbench.render.scene import Mask, Rendering, measure_contrast
from kpbench.types import KEYPOINT_DTYPE, Float, Float32, UInt8

EDGE_WIDTH = 0.008
"""Width of the band along the board's cut edge, as a fraction of the board's shorter side."""
SHADOW_SHIFT = 0.4
"""(Shift of the board's shadow, in board sides) / (slope of the light)."""
SHADOW_BLUR = 0.05
"""Standard deviation of the shadow's soft edge, in board sides."""
SHADOW_GRID = 64
"""Number of pixels per board side in the coarse grid on which the shadow is computed."""
RIM_POINTS = 720
"""Number of points on a disc's rim; the moments of the disc's distorted image are computed from these points."""


@dataclass(frozen=True)
class Appearance:
    """Inks and light of a board. The unit "board side" is the square root of the board's projected area.

    Attributes
    ----------
    black, white : float
        Grey levels of black ink and of white ink and paper, under full light.
    edge : float
        Brightness of the cut edge, as a fraction of ``white``.
    light : float
        Brightness at the board's centre, 0 to 1.
    slope : (float, float)
        Change of brightness over one board side of the image: to the right, and downwards. The brightness is clipped
        to [0, 1].
    shadow : float
        Fraction of its light that the scene behind the board loses in the board's shadow. The shadow has a soft edge,
        and falls to the darker side of the board.

    Examples
    --------
    >>> from kpbench.render import Appearance
    >>> Appearance(black=30, white=220, light=0.8, slope=(0.1, 0.0)).edge
    0.9
    """

    black: float
    white: float
    edge: float = 0.9
    light: float = 1.0
    slope: tuple[float, float] = (0.0, 0.0)
    shadow: float = 0.0


def board_keypoints(camera: Camera, pose: Pose, board: BoardLike) -> NDArray[Any]:
    """Compute the true keypoints of a board.

    Behind a distorting lens, the image of a disc is no exact ellipse. For such a lens, ``H_patch2image`` is the
    homography that agrees with the lens at the keypoint to first order. The semi-axes are those of the ellipse that has
    the same second moments as the exact image of the disc.

    Parameters
    ----------
    camera : Camera
    pose : Pose
    board : Board or TagBoard

    Returns
    -------
    ndarray of shape (n,), KEYPOINT_DTYPE
        ``visible`` is 1, as if the board lay wholly in the image. ``contrast`` is nan.

    Examples
    --------
    >>> from kpbench import hexagon_board, shipped_patches
    >>> from kpbench.geometry import Camera
    >>> from kpbench.render import board_keypoints, pose_board
    >>> camera, board = Camera(640, 480, 350.0), hexagon_board(shipped_patches()[0], 187.5)
    >>> keypoints = board_keypoints(camera, pose_board(camera, board, area_percent=16), board)
    >>> len(keypoints), round(float(keypoints["radius_major"][0]), 1)
    (6, 17.7)
    """
    keypoints = np.zeros(len(board.keypoints), KEYPOINT_DTYPE)
    for n, k in enumerate(board.keypoints):
        M_patch2camera = matmul(pose.M_board2camera, k.H_patch2board)
        ray = M_patch2camera[:2, 2] / M_patch2camera[2, 2]
        H = matmul(camera.local_K(ray), M_patch2camera)
        H /= H[2, 2]
        x, y = camera.distort(ray[None])[0]
        ellipse = ellipse_of_moments(_project_rim(camera, M_patch2camera)) if camera.is_bent else project_disc(H)
        axes = (ellipse.major, ellipse.minor, ellipse.angle_deg)
        keypoints[n] = (x, y, k.patch_id, *axes, H, 1.0, np.nan)
    return keypoints


def _project_rim(camera: Camera, M_patch2camera: Float) -> Float:
    """Return the pixel coordinates, shape (RIM_POINTS, 2), of evenly spaced points on the patch's unit circle."""
    angles = np.arange(RIM_POINTS) * (2 * np.pi / RIM_POINTS)
    rim = np.column_stack([*cos_sin(angles), np.ones(RIM_POINTS)])
    return camera.project(matmul(rim, M_patch2camera.T))


def ellipse_of_moments(points: Float) -> Ellipse:
    """Return the ellipse with the same centroid and the same central second moments as a polygon.

    Green's theorem gives the moments of the polygon from its vertices.
    """
    middle = points.mean(axis=0)
    a, b = points - middle, np.roll(points, -1, axis=0) - middle
    cross = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    area = cross.sum() / 2
    centroid = (cross[:, None] * (a + b)).sum(axis=0) / (6 * area)

    def second_moment(i: int, j: int) -> Float:
        """Return four times the central moment, which for an ellipse is the entry of the matrix of its axes."""
        corners = a[:, i] * a[:, j] + b[:, i] * b[:, j] + (a[:, i] * b[:, j] + b[:, i] * a[:, j]) / 2
        return np.asarray(4 * ((cross * corners).sum() / (12 * area) - centroid[i] * centroid[j]))

    major, minor, angle_deg = ellipse_axes(second_moment(0, 0), second_moment(1, 1), second_moment(0, 1))
    x, y = middle + centroid
    return Ellipse(float(x), float(y), float(major), float(minor), float(angle_deg))


def render_board(background: UInt8, camera: Camera, pose: Pose, board: BoardLike, appearance: Appearance) -> Rendering:
    """Draw a board in front of a background, by exact area coverage.

    Parameters
    ----------
    background : ndarray of shape (H, W) or (H, W, 3), uint8
        As large as the camera's image; not changed.
    camera : Camera
    pose : Pose
    board : Board or TagBoard
    appearance : Appearance

    Returns
    -------
    Rendering
        ``keypoints["contrast"]`` is measured in the rendered image.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import hexagon_board, shipped_patches
    >>> from kpbench.geometry import Camera
    >>> from kpbench.render import Appearance, pose_board, render_board
    >>> camera, board = Camera(640, 480, 350.0), hexagon_board(shipped_patches()[0], 187.5)
    >>> pose = pose_board(camera, board, area_percent=16)
    >>> rendering = render_board(np.full((480, 640), 90, np.uint8), camera, pose, board, Appearance(30, 220))
    >>> rendering.keypoints["contrast"].round().tolist()
    [190.0, 190.0, 190.0, 190.0, 190.0, 190.0]
    """
    keypoints = board_keypoints(camera, pose, board)
    outline = project_outline(camera, pose, board)
    face = project_outline(camera, pose, board, EDGE_WIDTH * min(board.side_x_mm, board.side_y_mm))
    inks, discs = (
        [[project_polygon(camera, pose, polygon) for polygon in region] for region in regions]
        for regions in board.outlines(keypoints["radius_major"])
    )
    box, board_cover, face_cover, black_cover, masks = _cover(outline, face, inks, discs)

    image, side_px = background.copy(), float(np.sqrt(polygon_area(outline)))
    if appearance.shadow:
        in_image, light = shadow_light(image, outline, side_px, appearance)
        image[in_image] = np.rint(image[in_image] * light).astype(np.uint8)
    black, white = appearance.black, appearance.white
    level = white * (appearance.edge * (board_cover - face_cover) + face_cover) - (white - black) * black_cover
    level *= board_brightness(appearance, box, project_to_image(camera, pose, np.zeros((1, 2)))[0], side_px)
    in_image, in_box = clip_to_image(box, image)
    level, uncovered = level[in_box], 1.0 - board_cover[in_box]
    if background.ndim == 3:
        level, uncovered = level[..., None], uncovered[..., None]
    image[in_image] = np.rint(image[in_image] * uncovered + level).astype(np.uint8)
    for n, mask in enumerate(masks):
        keypoints[n]["visible"] = mask.disc[clip_to_image(mask.box, image)[1]].sum() / mask.disc.sum()
    keypoints["contrast"] = measure_contrast(image, masks)
    return Rendering(image, keypoints, masks)


def _cover(
    outline: Float, face: Float, inks: list[list[Float]], discs: list[list[Float]]
) -> tuple[Box, Float, Float, Float, tuple[Mask, ...]]:
    """Compute which fraction of each pixel a board, its face and its black ink cover, see :func:`combine_covers`.

    Parameters
    ----------
    outline, face : ndarray of shape (n, 2)
        Outline of the whole board, and outline of its face: the board without the band along the cut edge. px.
    inks, discs : list of lists of ndarray of shape (n, 2)
        Polygons of each black area, and polygons of each patch, px.
    """
    ink_boxes, disc_boxes = [bounding_box(ink) for ink in inks], [bounding_box(disc) for disc in discs]
    box = bounding_box([polygon for region in ([outline], *inks, *discs) for polygon in region])
    boxes = [box, box, *ink_boxes, *disc_boxes]
    covers = rasterise([[outline], [face], *inks, *discs], boxes)
    return combine_covers(box, list(zip(boxes, covers, strict=True)), len(inks))


def combine_covers(
    box: Box, covers: list[tuple[Box, Float]], ink_count: int
) -> tuple[Box, Float, Float, Float, tuple[Mask, ...]]:
    """Put together the covers of the parts of a board.

    Parameters
    ----------
    box : Box
        Rectangle of pixels that holds the whole board.
    covers : list of (Box, ndarray of shape (height, width))
        Boxes and covered fractions of: the board and its face (both of the box ``box``), each ink, each patch.
    ink_count : int
        Number of inks.

    Returns
    -------
    box : Box
    board, face, black : ndarray of shape (height, width)
        Fraction of each pixel of the box that the board, the face or black ink covers.
    masks : tuple of Mask
        One mask per patch.
    """
    board_cover, face_cover = covers[0][1], covers[1][1]
    black_cover = np.zeros_like(face_cover)
    for ink_box, cover in covers[2 : 2 + ink_count]:
        black_cover[_slices_within(box, ink_box)] += cover
    masks = []
    for disc_box, cover in covers[2 + ink_count :]:
        slices = _slices_within(box, disc_box)
        masks.append(Mask(disc_box, black_cover[slices], cover * face_cover[slices]))
    return box, board_cover, face_cover, black_cover, tuple(masks)


def _slices_within(outer: Box, inner: Box) -> tuple[slice, slice]:
    """Return the rows and columns of a box within a larger box."""
    x, y = inner[0] - outer[0], inner[1] - outer[1]
    return slice(y, y + inner[3]), slice(x, x + inner[2])


def board_brightness(appearance: Appearance, box: Box, centre_px: Float, side_px: float) -> Float:
    """Compute the brightness of every pixel of a box, ndarray of shape (height, width), 0 to 1."""
    x, y, w, h = box
    across = (np.arange(x, x + w) - centre_px[0]) * (appearance.slope[0] / side_px)
    down = (np.arange(y, y + h) - centre_px[1]) * (appearance.slope[1] / side_px)
    return np.asarray(np.clip(appearance.light + across + down[:, None], 0.0, 1.0))


def shadow_light(
    image: UInt8 | Float32, outline_px: Float, side_px: float, appearance: Appearance
) -> tuple[tuple[slice, slice], Float32]:
    """Return rows and columns of the board's shadow, and the fraction of the light that is left in every pixel of it.

    The shadow is smooth. The shadow is therefore computed on a coarse grid, and enlarged. The fractions have a last
    axis of length 1 if the image has colours.
    """
    step = max(1, round(side_px / SHADOW_GRID))  # px per pixel of the coarse grid
    blur = SHADOW_BLUR * side_px / step
    outline = (outline_px - SHADOW_SHIFT * side_px * np.asarray(appearance.slope) + 0.5) / step - 0.5
    x, y, w, h = bounding_box([outline])
    margin = int(np.ceil(3 * blur))
    box = (x - margin, y - margin, w + 2 * margin, h + 2 * margin)
    # OpenCV interpolates whole numbers exactly on every processor
    cover = np.rint(255 * rasterise([[outline]], [box])[0]).astype(np.uint8)
    coarse = filter_separably(cover, gaussian_taps(blur))
    fine = cv2.resize(coarse, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR_EXACT)
    in_image, in_box = clip_to_image((box[0] * step, box[1] * step, fine.shape[1], fine.shape[0]), image)
    light = 1 - np.float32(appearance.shadow / 255) * fine[in_box]
    return in_image, light if image.ndim == 2 else light[..., None]
