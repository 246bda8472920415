"""Boards that bend, move and are read row by row: against a brute-force render, and truth against a symmetric fit."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter
from scipy.optimize import minimize

from kpbench.camera.paper import Cylinder, Saddle
from kpbench.camera.shutter import BoardMotion, Shutter
from kpbench.geometry.camera import Camera, rotation_xyz
from kpbench.patches.board import hexagon_board, single_board
from kpbench.patches.design import shipped_patches
from kpbench.patches.tag_boards import TAG_BOARDS, tag_board
from kpbench.render.board_exposure import ExposedBoard, paint_board
from kpbench.render.board_projection import Pose, pose_board
from kpbench.render.board_view import Appearance, board_keypoints, render_board

CHECKER = hexagon_board(shipped_patches()[0], 187.5)
PLAIN = Appearance(black=0, white=255, edge=1.0)
LENS = (-0.15, 0.03, 0.002, -0.001, 0.0)
SIDE = 240


def camera(lens=()):
    return Camera(SIDE, SIDE, 260.0, (*lens, *(0.0,) * (5 - len(lens))))


def pose(tilt=(15, -12, 25)):
    return Pose(rotation_xyz(*tilt), np.array([4.0, -3.0, 300.0]))


def paint(exposed, lens=(), background=0.0):
    light = np.full((SIDE, SIDE), background, np.float32)
    return light, paint_board(light, camera(lens), exposed, PLAIN)


def bend(points, bow):
    """The bent sheet by its formulas, apart from the code under test."""
    if bow is None:
        return np.column_stack([points, np.zeros(len(points))])
    e = np.array([np.cos(np.radians(bow.axis_deg)), np.sin(np.radians(bow.axis_deg))])
    n = np.array([-e[1], e[0]])
    a, s = points @ e, points @ n
    if isinstance(bow, Saddle):
        return np.column_stack([points, bow.c_per_mm * a * s])
    flat = a[:, None] * e + (bow.radius_mm * np.sin(s / bow.radius_mm))[:, None] * n
    return np.column_stack([flat, bow.radius_mm * (1 - np.cos(s / bow.radius_mm))])


def seen_by_opencv(points, instant, exposed, lens):
    """Image points by OpenCV. A point is on the row where its image lies at the time of this row."""
    shape, K = bend(points, exposed.bow), camera(lens).K
    y = np.full(len(points), SIDE / 2)
    for _ in range(30):
        image = []
        for point, t in zip(shape, exposed.shutter.start + exposed.shutter.row_time * y + instant, strict=True):
            turn = cv2.Rodrigues(np.radians(exposed.motion.turn_deg) * t)[0] @ exposed.pose.R_board2camera
            place = exposed.pose.t_camera + t * np.array(exposed.motion.velocity_mm)
            inside = turn @ point + place
            image.append(inside)
        image = cv2.projectPoints(np.array(image), np.zeros(3), np.zeros(3), K, np.array([*lens, *(0.0,) * 5])[:5])
        image = image[0].reshape(-1, 2)
        if exposed.shutter.row_time == 0 or np.abs(image[:, 1] - y).max() < 1e-6:
            break
        y = image[:, 1]
    return image


MOVES = BoardMotion((9.0, -6.0, 4.0), (3.0, -4.0, 6.0))
ROLLING = Shutter.rolling(0.01, SIDE)
CASES = {
    "lens": (ExposedBoard(CHECKER, pose()), LENS),
    "cylinder": (ExposedBoard(CHECKER, pose(), bow=Cylinder.of_sagitta(8.0, 187.5, 35.0)), ()),
    "saddle": (ExposedBoard(CHECKER, pose(), bow=Saddle(0.0008, 20.0)), ()),
    "motion": (ExposedBoard(CHECKER, pose(), BoardMotion((9.0, -6.0, 0.0))), ()),
    "turn": (ExposedBoard(single_board(shipped_patches()[0], 60.0), pose(), BoardMotion(turn_deg=(3, -4, 9))), ()),
    "rolling": (ExposedBoard(CHECKER, pose(), BoardMotion((6.0, 5.0, 0.0), (0.5, 0.0, 1.0)), ROLLING), ()),
    "ink gain": (ExposedBoard(CHECKER, pose(), ink_gain=0.03), ()),
}
ALL = (ExposedBoard(CHECKER, pose(), MOVES, ROLLING, Cylinder.of_sagitta(-9.0, 187.5, 60.0)), LENS)


def test_a_moving_bent_board_behind_a_rolling_shutter_is_what_brute_force_renders():
    exposed, lens = ALL
    instants, fine, n = 64, 8, 1
    _, masks = paint(exposed, lens)
    x, y, w, h = masks[n].box
    keypoint = CHECKER.keypoints[n]
    angles = np.radians(np.arange(0, 90.5, 3.0))
    quarter = np.vstack([[0.0, 0.0], np.column_stack([np.cos(angles), np.sin(angles)])])
    straight = [np.linspace(quarter[-1], [0, 0], 6)[1:-1], np.linspace([0, 0], quarter[1], 6)[1:-1]]
    quarter = np.vstack([quarter[:1], straight[1], quarter[1:], straight[0]])
    quarters = []
    for start in np.flatnonzero(shipped_patches()[0].is_black(0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]))):
        c, s = np.cos(np.pi / 2 * start), np.sin(np.pi / 2 * start)
        turned = quarter @ np.array([[c, s], [-s, c]])
        quarters.append(turned * keypoint.diameter_mm / 2 + (keypoint.x_mm, keypoint.y_mm))
    expected = np.zeros((h, w))
    for instant in (np.arange(instants) + 0.5) / instants - 0.5:
        canvas = np.zeros((h * fine, w * fine), np.uint8)
        for polygon in quarters:
            image = seen_by_opencv(polygon, instant, exposed, lens)
            corners = (image - (x, y) + 0.5) * fine - 0.5
            cv2.fillPoly(canvas, [np.rint(corners * 256).astype(np.int32)], 255, cv2.LINE_8, 8)
        expected += cv2.resize(canvas, (w, h), interpolation=cv2.INTER_AREA) / 255 / instants
    # fillPoly also fills the pixels on the outline, half a fine pixel too many all around
    assert np.abs(masks[n].black - expected).mean() < 0.01
    places = np.indices((h, w))[::-1]
    centroids = [np.array([(p * cover).sum() for p in places]) / cover.sum() for cover in (masks[n].black, expected)]
    assert np.abs(centroids[0] - centroids[1]).max() < 0.01


def symmetric_centre(light, start, A):
    """The point about which the image of a checker is its own half turn, near a start. No code of the library."""
    u = np.linspace(-0.35, 0.35, 13)
    offsets = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2) @ A.T
    left, top = np.floor(start - 1.1 * np.abs(A).sum(axis=1)).astype(int)
    width, height = np.ceil(2.2 * np.abs(A).sum(axis=1)).astype(int) + 1
    smooth = spline_filter(light[top : top + height, left : left + width].astype(float))

    def asymmetry(c):
        value = map_coordinates(smooth, (c + offsets - (left, top))[:, ::-1].T, order=3, prefilter=False)
        return ((value - value[::-1]) ** 2).sum()

    simplex = start + np.array([[0.0, 0.0], [0.2, 0.0], [0.0, 0.2]])
    options = {"xatol": 3e-4, "fatol": 1e-12, "initial_simplex": simplex}
    return minimize(asymmetry, start, method="Nelder-Mead", options=options).x


@pytest.mark.parametrize("name", CASES)
def test_truth_is_the_centre_of_symmetry(name):
    exposed, lens = CASES[name]
    light, _ = paint(exposed, lens)
    light = cv2.GaussianBlur(light, (0, 0), 0.7)  # for the interpolation
    for keypoint in exposed.keypoints(camera(lens))[::2]:
        xy, H = np.array([keypoint["x"], keypoint["y"]]), keypoint["H_patch2image"]
        A = H[:2, :2] - np.outer(H[:2, 2], H[2, :2])
        assert np.abs(symmetric_centre(light, xy + 0.3, A) - xy).max() < 0.01


def test_a_still_flat_board_is_that_of_the_linear_world():
    exposed, view = ExposedBoard(CHECKER, pose()), camera(LENS)
    light, masks = paint(exposed, LENS)
    rendering = render_board(np.zeros((SIDE, SIDE), np.uint8), view, exposed.pose, CHECKER, PLAIN)
    assert np.abs(255 * light - rendering.image).max() < 1.5
    for mask, expected in zip(masks, rendering.masks, strict=True):
        assert np.isclose(mask.disc.sum(), expected.disc.sum(), rtol=1e-4)
    found, expected = exposed.keypoints(view), board_keypoints(view, exposed.pose, CHECKER)
    for name in ("x", "y", "radius_major", "radius_minor", "H_patch2image"):
        assert np.allclose(found[name], expected[name], atol=1e-6)


@pytest.mark.parametrize("name", TAG_BOARDS)
def test_ink_of_tags_spreads(name):
    board = tag_board(name, 187.5)
    radius_px = np.full(len(board.keypoints), 12.0)
    (still,), _ = board.outlines(radius_px)
    (spread,), _ = board.outlines(radius_px, 0.02)

    def area(polygons):
        following = [np.roll(p, -1, axis=0) for p in polygons]
        return sum((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum() / 2 for p, q in zip(polygons, following, strict=True))

    gain_mm = 0.02 * board.keypoints[0].diameter_mm / 2
    edge = 0.0  # length of all edges between black and white
    padded = np.pad(board.black, 1)
    edge += (padded[1:] != padded[:-1]).sum() + (padded[:, 1:] != padded[:, :-1]).sum()
    edge *= board.side_x_mm / len(board.black)
    assert np.isclose(abs(area(spread)) - abs(area(still)), gain_mm * edge, rtol=0.03)


def test_a_single_patch_may_fill_the_image():
    board, view = single_board(shipped_patches()[2], 187.5), Camera(1624, 1240, 889.0)
    rim = np.column_stack([np.cos(np.arange(64)), np.sin(np.arange(64))]) * board.keypoints[0].diameter_mm / 2
    placed = pose_board(view, board, 84.5, inside_mm=rim)
    assert np.isclose(board_keypoints(view, placed, board)["radius_major"][0], 600, rtol=0.01)
