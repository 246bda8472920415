"""A board before a camera: pose, exact projection with lens distortion, light, and the truth of it.

A pose is found from what the experiments fix: the board's share of the image. Ink and paper are
projected as outlines and painted by exact area coverage, so that a board of 0.5 % of the image is not
aliased. See :mod:`kpbench.geometry.homography` for the frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from kpbench.errors import DataError
from kpbench.geometry.camera import NO_DISTORTION, Camera, plane_to_camera, rotation_xyz
from kpbench.geometry.coverage import Box, bounding_box, clip_to_image, rasterise
from kpbench.geometry.homography import Ellipse, project_disc
from kpbench.geometry.outline import flatten, rectangle
from kpbench.patches.board import BoardLike
from kpbench.render.scene import Mask, Rendered, measure_contrast
from kpbench.types import KEYPOINT_DTYPE, Float, UInt8

EDGE = 0.008  # of the board's shorter side: the band along its cut edge
MARGIN = 0.01  # of the image's width, kept free around the board
SHADOW_REACH = 0.4  # board sides that the shadow is moved for a slope of 1
SHADOW_SOFT = 0.05  # standard deviation of its edge, board sides
SHADOW_GRID = 64  # a board side in pixels of the grid on which the shadow is made, before it is enlarged
MOST_PIECES = 400  # of one straight edge
PIECE_PX = 8.0  # longest straight piece of a projected outline where the lens bends lines


@dataclass(frozen=True)
class Pose:
    """Board frame (mm) to camera frame (mm): ``X_camera = R @ X_board + t``."""

    R_board2camera: Float
    t_camera: Float

    @property
    def M_board2camera(self) -> Float:
        """(x_mm, y_mm, 1) on the board to the camera frame, ndarray of shape (3, 3)."""
        return plane_to_camera(self.R_board2camera, self.t_camera)


@dataclass(frozen=True)
class Look:
    """How the board looks.

    Attributes
    ----------
    black, white : the two inks under full light, grey levels; paper is white.
    edge : brightness of the cut edge relative to white.
    light : brightness at the board's centre, 0 to 1.
    slope : change of brightness over one board side (the root of its projected area), to the right and
        downwards in the image; light is clipped to [0, 1].
    shadow : share of the light that the board takes from the scene right behind it, soft-edged; it falls
        away from the lamp, against the slope.
    """

    black: float
    white: float
    edge: float = 0.9
    light: float = 1.0
    slope: tuple[float, float] = (0.0, 0.0)
    shadow: float = 0.0


def polygon_area(points: Float) -> float:
    """Area of a simple polygon with vertices of shape (N, 2), whichever way it runs."""
    x, y = (points - points[0]).T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)


def to_px(camera: Camera, pose: Pose, points_mm: Float) -> Float:
    """Points on the board, (N, 2) in mm, to px, (N, 2)."""
    return camera.project(np.column_stack([points_mm, np.ones(len(points_mm))]) @ pose.M_board2camera.T)


def outline_px(camera: Camera, pose: Pose, board: BoardLike, inset: float = 0.0) -> Float:
    """The board's edge in the image, shape (N, 2); ``inset`` in mm moves it inwards."""
    w, h = board.side_x_mm - 2 * inset, board.side_y_mm - 2 * inset
    corners = flatten(rectangle(-w / 2, -h / 2, w, h), 1.0)[0]
    return _bent(camera, pose, corners)


def _bent(camera: Camera, pose: Pose, polygon_mm: Float) -> Float:
    """Project a polygon; a lens that bends straight lines needs them in short pieces."""
    if not any(camera.distortion):
        return to_px(camera, pose, polygon_mm)
    following = np.roll(polygon_mm, -1, axis=0)
    length_px = np.linalg.norm(to_px(camera, pose, following) - to_px(camera, pose, polygon_mm), axis=1)
    pieces = np.clip(np.ceil(length_px / PIECE_PX), 1, MOST_PIECES).astype(int)
    which = np.repeat(np.arange(len(pieces)), pieces)
    part = (np.arange(len(which)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[which]
    return to_px(camera, pose, polygon_mm[which] + part[:, None] * (following - polygon_mm)[which])


def pose_board(
    camera: Camera,
    board: BoardLike,
    area_percent: float,
    *,
    pitch_deg: float = 0.0,
    yaw_deg: float = 0.0,
    roll_deg: float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
) -> Pose:
    """Place a board so that it covers a given share of the image, whatever its tilt.

    Parameters
    ----------
    camera, board
    area_percent : projected area of the board, percent of the image's pixels.
    pitch_deg : tilt about the camera's x axis; positive leans the upper side away from the camera, as a
        board that lies on a table in front of it.
    yaw_deg : tilt about the camera's y axis, after the pitch; positive leans the right side away.
    roll_deg : turn of the board in its own plane, before any tilt, from +x towards +y.
    shift : where the board's centre is seen, in image widths and heights from the image's centre (before
        lens distortion). If the board would leave the image it is drawn towards the centre: to 0.8, 0.6,
        ... of the shift.

    Raises
    ------
    DataError
        If the board does not fit into the image at this area and tilt.
    """
    # rotation_xyz turns +y (down) away from the camera for positive x and +x towards it for positive y
    R = rotation_xyz(0, -yaw_deg, 0) @ rotation_xyz(-pitch_deg, 0, 0) @ rotation_xyz(0, 0, roll_deg)
    size = np.array([camera.width_px, camera.height_px])
    margin = MARGIN * camera.width_px
    for kept in (1.0, 0.8, 0.6, 0.4, 0.2, 0.0):
        ray = np.append(kept * np.asarray(shift) * size / camera.focal_px, 1.0)
        pose = Pose(R, _depth(camera, board, R, ray, area_percent / 100 * size.prod()) * ray)
        edge = outline_px(camera, pose, board)
        if (edge >= margin - 0.5).all() and (edge <= size - 0.5 - margin).all():
            return pose
    raise DataError(
        f"a board of {area_percent:g} % of the image at pitch {pitch_deg:g} and yaw {yaw_deg:g} degrees does not fit "
        f"into {camera.width_px}x{camera.height_px} px"
    )


def _depth(camera: Camera, board: BoardLike, R: Float, ray: Float, area_px: float) -> float:
    """Distance along the optical axis, mm, at which the board's image has an area."""

    def solve(lens: Camera, near: float, far: float) -> float:
        def excess(log_depth: float) -> float:
            edge = outline_px(lens, Pose(R, np.exp(log_depth) * ray), board)
            return float(np.log(polygon_area(edge) / area_px))

        return float(np.exp(brentq(excess, np.log(near), np.log(far), xtol=1e-13)))

    corners = np.array([(x, y, 0.0) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * (board.side_x_mm, board.side_y_mm, 0)
    frontal = camera.focal_px * np.sqrt(board.side_x_mm * board.side_y_mm / area_px)
    nearest = max(-(corners @ R.T)[:, 2].min() * 1.001, 0.05 * frontal)
    try:
        depth = solve(replace(camera, distortion=NO_DISTORTION), nearest, 4 * frontal)
        # a lens polynomial means something in and near the image only, so the search stays near the pinhole's answer
        return solve(camera, max(nearest, 0.7 * depth), 1.5 * depth) if any(camera.distortion) else depth
    except ValueError:
        raise DataError(f"no distance gives a board an image of {area_px:.0f} px at this tilt and lens") from None


def board_keypoints(camera: Camera, pose: Pose, board: BoardLike) -> NDArray[Any]:
    """Truth of every keypoint of a board that lies wholly in the image, a :data:`KEYPOINT_DTYPE` table.

    With a distorting lens ``H_patch2image`` is the homography that agrees with the lens at the keypoint to
    first order, and the axes are those of the ellipse with the second moments of the disc's exact image.
    ``visible`` is 1 and ``contrast`` is nan until something is painted.
    """
    keypoints = np.zeros(len(board.keypoints), KEYPOINT_DTYPE)
    for n, k in enumerate(board.keypoints):
        M = pose.M_board2camera @ k.H_patch2board
        ray = M[:2, 2] / M[2, 2]
        H = camera.local_K(ray) @ M
        H /= H[2, 2]
        x, y = camera.distort(ray[None])[0]
        e = _moments_ellipse(_rim(camera, M)) if any(camera.distortion) else project_disc(H)
        keypoints[n] = (x, y, k.patch_id, e.major, e.minor, e.angle_deg, H, 1.0, np.nan)
    return keypoints


def _rim(camera: Camera, M_patch2camera: Float, count: int = 720) -> Float:
    """Points of the unit circle, evenly spaced on the patch, in px."""
    angles = np.arange(count) * (2 * np.pi / count)
    return camera.project(np.column_stack([np.cos(angles), np.sin(angles), np.ones(count)]) @ M_patch2camera.T)


def _moments_ellipse(points: Float) -> Ellipse:
    """The ellipse with a polygon's area, centroid and second moments' shape (Green's theorem)."""
    middle = points.mean(axis=0)
    a, b = points - middle, np.roll(points, -1, axis=0) - middle
    cross = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    area = cross.sum() / 2
    centroid = cross @ (a + b) / (6 * area)
    second = (np.einsum("n,ni,nj->ij", cross, a, a) + np.einsum("n,ni,nj->ij", cross, b, b)) / 12
    mixed = np.einsum("n,ni,nj->ij", cross, a, b) / 24
    values, vectors = np.linalg.eigh((second + mixed + mixed.T) / area - np.outer(centroid, centroid))
    minor, major = 2 * np.sqrt(values)
    angle_deg = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])) % 180)
    x, y = middle + centroid
    return Ellipse(float(x), float(y), float(major), float(minor), angle_deg)


def render_board(background: UInt8, camera: Camera, pose: Pose, board: BoardLike, look: Look) -> Rendered:
    """Paint a board before a background with exact area coverage.

    Parameters
    ----------
    background : ndarray of shape (H, W) or (H, W, 3), uint8, of the camera's size; not changed.
    camera, pose, board, look

    Returns
    -------
    Rendered
        ``keypoints["contrast"]`` is that of the clean image.
    """
    keypoints = board_keypoints(camera, pose, board)
    inset = EDGE * min(board.side_x_mm, board.side_y_mm)
    edge, face = outline_px(camera, pose, board), outline_px(camera, pose, board, inset)
    parts, discs = (
        [[_bent(camera, pose, polygon) for polygon in region] for region in regions]
        for regions in board.outlines(keypoints["radius_major"])
    )
    part_boxes, disc_boxes = [bounding_box(part) for part in parts], [bounding_box(disc) for disc in discs]
    whole = bounding_box([polygon for region in ([edge], *parts, *discs) for polygon in region])
    covers = rasterise([[edge], [face], *parts, *discs], [whole, whole, *part_boxes, *disc_boxes])
    board_cover, face_cover = covers[:2]
    black = np.zeros_like(face_cover)
    for box, cover in zip(part_boxes, covers[2:], strict=False):
        black[_within(whole, box)] += cover
    masks = tuple(
        Mask(box, black[_within(whole, box)], cover * face_cover[_within(whole, box)])
        for box, cover in zip(disc_boxes, covers[2 + len(parts) :], strict=True)
    )

    image, side_px = background.copy(), float(np.sqrt(polygon_area(edge)))
    if look.shadow:
        _cast_shadow(image, edge, side_px, look)
    there, here = clip_to_image(whole, image)
    below = 1.0 - board_cover
    ink = look.white * (look.edge * (board_cover - face_cover) + face_cover) - (look.white - look.black) * black
    ink *= _light(look, whole, to_px(camera, pose, np.zeros((1, 2)))[0], side_px)
    ink, below = ink[here], below[here]
    if background.ndim == 3:
        ink, below = ink[..., None], below[..., None]
    image[there] = np.rint(image[there] * below + ink).astype(np.uint8)
    for n, mask in enumerate(masks):
        keypoints[n]["visible"] = mask.disc[clip_to_image(mask.box, image)[1]].sum() / mask.disc.sum()
    keypoints["contrast"] = measure_contrast(image, masks)
    return Rendered(image, keypoints, masks)


def _within(whole: Box, part: Box) -> tuple[slice, slice]:
    """Rows and columns of a box in a larger one."""
    x, y = part[0] - whole[0], part[1] - whole[1]
    return slice(y, y + part[3]), slice(x, x + part[2])


def _light(look: Look, box: Box, centre_px: Float, side_px: float) -> Float:
    """Brightness of every pixel of a box, ndarray of shape (height, width)."""
    x, y, w, h = box
    across = (np.arange(x, x + w) - centre_px[0]) * (look.slope[0] / side_px)
    down = (np.arange(y, y + h) - centre_px[1]) * (look.slope[1] / side_px)
    return np.asarray(np.clip(look.light + across + down[:, None], 0.0, 1.0))


def _cast_shadow(image: UInt8, edge_px: Float, side_px: float, look: Look) -> None:
    """Darken the scene behind the board, in place; smooth, and hence made on a coarse grid and enlarged."""
    step = max(1, round(side_px / SHADOW_GRID))
    soft = SHADOW_SOFT * side_px / step
    moved = (edge_px - SHADOW_REACH * side_px * np.asarray(look.slope) + 0.5) / step - 0.5
    x, y, w, h = bounding_box([moved])
    grow = int(np.ceil(3 * soft))
    box = (x - grow, y - grow, w + 2 * grow, h + 2 * grow)
    taken = cv2.GaussianBlur(rasterise([[moved]], [box])[0].astype(np.float32), (0, 0), soft)
    fine = cv2.resize(taken, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
    there, here = clip_to_image((box[0] * step, box[1] * step, fine.shape[1], fine.shape[0]), image)
    kept = 1 - np.float32(look.shadow) * fine[here]
    image[there] = np.rint(image[there] * (kept if image.ndim == 2 else kept[..., None])).astype(np.uint8)
