import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kpbench.errors import DataError
from kpbench.geometry.camera import Camera, rotation_xyz
from kpbench.geometry.homography import project
from kpbench.patches.board import hexagon_board
from kpbench.patches.design import shipped_patches
from kpbench.render.board_projection import Pose, polygon_area, pose_board, project_outline, project_to_image
from kpbench.render.board_view import Appearance, board_keypoints, render_board

BOARD = hexagon_board(shipped_patches()[0], 187.5)
PAPER = Camera(1624, 1240, 4 / 0.0045)
SMALL = Camera(406, 310, 4 / 0.0045 / 4)
LENS = (-0.2, 0.05, 0.001, -0.0005, 0.01)

poses = st.fixed_dictionaries(
    {
        "area_percent": st.floats(0.5, 20),
        "pitch_deg": st.floats(-60, 60),
        "yaw_deg": st.floats(-30, 30),
        "roll_deg": st.floats(0, 360),
        "shift": st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    }
)
lenses = st.sampled_from([(0.0,) * 5, LENS, (0.1, -0.02, 0.0, 0.002, 0.0)])


def opencv(camera, pose, points_mm):
    points = np.column_stack([points_mm, np.zeros(len(points_mm))])
    turn = Rotation.from_matrix(pose.R_board2camera).as_rotvec()  # cv2.Rodrigues takes a tiny turn for none
    return cv2.projectPoints(points, turn, pose.t_camera, camera.K, np.array(camera.distortion))[0].reshape(-1, 2)


def conic_axes(points):
    """Semi-axes and major axis' angle of the least-squares conic A x² + B xy + C y² + D x + E y = 1."""
    middle = points.mean(axis=0)
    x, y = (points - middle).T
    a, b, c, d, e = np.linalg.lstsq(np.stack([x * x, x * y, y * y, x, y], 1), np.ones(len(x)), rcond=None)[0]
    shape = np.array([[a, b / 2], [b / 2, c]])
    centre = np.linalg.solve(-2 * shape, [d, e])
    values, vectors = np.linalg.eigh(shape)
    return *np.sqrt((1 + centre @ shape @ centre) / values), np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))


@settings(deadline=None, max_examples=30)
@given(poses, lenses)
@example({"area_percent": 1.0, "pitch_deg": 0.0, "yaw_deg": 0.0, "roll_deg": 1e-05, "shift": (0.0, 0.0)}, LENS)
def test_points_are_where_opencv_projects_them(pose, lens):
    camera = Camera(1624, 1240, PAPER.focal_px, lens)
    placed = pose_board(camera, BOARD, **pose)
    k = board_keypoints(camera, placed, BOARD)
    assert abs(opencv(camera, placed, BOARD.points_mm[:, :2]) - np.column_stack([k["x"], k["y"]])).max() < 1e-6
    assert abs(project(k["H_patch2image"][3], [[0, 0]]) - (k["x"][3], k["y"][3])).max() < 1e-9


@settings(deadline=None, max_examples=20)
@given(poses, lenses)
def test_axes_are_those_of_the_projected_rim(pose, lens):
    camera = Camera(1624, 1240, PAPER.focal_px, lens)
    placed = pose_board(camera, BOARD, **pose)
    angles = np.radians(np.arange(720) / 2)
    rim = np.column_stack([np.cos(angles), np.sin(angles)])
    for k, b in zip(board_keypoints(camera, placed, BOARD), BOARD.keypoints, strict=True):
        points = opencv(camera, placed, rim * b.diameter_mm / 2 + (b.x_mm, b.y_mm))
        major, minor, angle_deg = conic_axes(points)
        assert abs(k["radius_major"] - major) < 0.01
        assert abs(k["radius_minor"] - minor) < 0.01
        if major - minor > 0.5:  # a circle has no axis
            assert abs((angle_deg - k["axis_angle"] + 90) % 180 - 90) < 0.1


@pytest.mark.parametrize("lens", [(0.0,) * 5, LENS])
def test_the_local_homography_follows_the_lens_to_first_order(lens):
    camera = Camera(1624, 1240, PAPER.focal_px, lens)
    placed = pose_board(camera, BOARD, 16, pitch_deg=50, roll_deg=17, shift=(0.1, -0.1))
    k = board_keypoints(camera, placed, BOARD)[0]
    step = 1e-5 * BOARD.keypoints[0].diameter_mm / 2
    for axis in np.eye(2):
        at = np.array([BOARD.keypoints[0].x_mm, BOARD.keypoints[0].y_mm])
        moved = (
            project_to_image(camera, placed, (at + step * axis)[None])
            - project_to_image(camera, placed, (at - step * axis)[None])
        ) / 2e-5
        found = (project(k["H_patch2image"], [1e-5 * axis]) - project(k["H_patch2image"], [-1e-5 * axis])) / 2e-5
        assert abs(moved - found).max() < 1e-4


def test_local_K_of_a_pinhole_is_K():
    assert np.allclose(PAPER.local_K([0.3, -0.2]), PAPER.K, atol=1e-12)


@settings(deadline=None, max_examples=20)
@given(poses, lenses)
def test_the_board_covers_what_was_asked_for_and_lies_in_the_image(pose, lens):
    camera = Camera(1624, 1240, PAPER.focal_px, lens)
    edge = project_outline(camera, pose_board(camera, BOARD, **pose), BOARD)
    assert np.isclose(100 * polygon_area(edge) / (1624 * 1240), pose["area_percent"], rtol=1e-9)
    assert (edge > -0.5).all()
    assert (edge < (1623.5, 1239.5)).all()


@pytest.mark.parametrize(("area", "pitch"), [(0.5, 0), (8, 0), (32, 0), (16, 30), (16, 60)])
def test_the_pixels_of_the_board_are_as_many_as_asked_for(area, pitch):
    placed = pose_board(PAPER, BOARD, area, pitch_deg=pitch, roll_deg=33, shift=(0.05, 0.02))
    scene = np.zeros((1240, 1624), np.uint8)
    image = render_board(scene, PAPER, placed, BOARD, Appearance(255, 255, edge=1)).image
    assert np.isclose(100 * np.count_nonzero(image > 127) / image.size, area, rtol=0.01)


def test_a_patch_is_16_px_long_on_a_board_of_half_a_percent():
    k = board_keypoints(PAPER, pose_board(PAPER, BOARD, 0.5, roll_deg=10), BOARD)
    assert np.allclose(2 * k["radius_major"], 16, atol=0.3)


def test_which_way_the_board_leans():
    near = {}
    for name, tilt in {"pitch": {"pitch_deg": 40}, "yaw": {"yaw_deg": 40}}.items():
        edge = project_outline(PAPER, pose_board(PAPER, BOARD, 16, **tilt), BOARD)
        near[name] = edge - edge.mean(axis=0)
    y, x = near["pitch"][:, 1], near["pitch"][:, 0]
    assert np.ptp(x[y < 0]) < np.ptp(x[y > 0])  # the upper side is farther away, hence shorter
    x, y = near["yaw"].T
    assert np.ptp(y[x > 0]) < np.ptp(y[x < 0])  # so is the right one
    k = board_keypoints(PAPER, pose_board(PAPER, BOARD, 16, roll_deg=30), BOARD)
    assert np.isclose(np.degrees(np.arctan2(k["y"][0] - 619.5, k["x"][0] - 811.5)), 30)


def test_a_board_that_does_not_fit_is_told():
    with pytest.raises(DataError, match=r"a board of 80 % of the image at pitch 0 and yaw 0 degrees does not fit"):
        pose_board(PAPER, BOARD, 80, roll_deg=45)


@given(st.floats(0, 1), st.floats(0, 1))
@settings(deadline=None, max_examples=20)
def test_a_tiny_board_is_not_aliased(dx, dy):
    """The light of its ink is the same wherever it falls on the pixel grid."""
    placed = pose_board(SMALL, BOARD, 0.5, roll_deg=20)
    moved = Pose(placed.R_board2camera, placed.t_camera + np.array([dx, dy, 0]) * placed.t_camera[2] / SMALL.focal_px)
    scene = np.zeros((310, 406), np.uint8)
    image = render_board(scene, SMALL, moved, BOARD, Appearance(0, 240, edge=1)).image
    board_px = 0.005 * image.size
    black = 6 * np.pi * (0.08**2) / 2  # half of six discs, in board areas
    assert np.isclose(image.sum(), 240 * board_px * (1 - black), rtol=0.005)


def test_light_falls_along_its_slope_and_ink_with_it():
    placed = pose_board(SMALL, BOARD, 16)
    scene = np.full((310, 406), 90, np.uint8)
    image = render_board(scene, SMALL, placed, BOARD, Appearance(40, 200, light=0.8, slope=(0.2, 0))).image.astype(int)
    middle = image[155]
    inside = np.flatnonzero(middle != 90)
    left, right = inside[5], inside[-6]
    side = np.sqrt(0.16 * image.size)
    assert np.isclose(middle[right] - middle[left], 200 * 0.2 * (right - left) / side, atol=1)
    assert middle[202] == round(200 * (0.8 - 0.2 * 0.5 / side))
    assert (image[:, :80] == 90).all()


def test_the_shadow_falls_on_the_scene_and_not_on_the_board():
    placed = pose_board(SMALL, BOARD, 16)
    scene = np.full((310, 406), 90, np.uint8)
    appearance = Appearance(40, 200, light=0.8, slope=(0.2, 0))
    plain = render_board(scene, SMALL, placed, BOARD, appearance)
    shaded = render_board(scene, SMALL, placed, BOARD, Appearance(40, 200, light=0.8, slope=(0.2, 0), shadow=0.5))
    board = project_outline(SMALL, placed, BOARD)
    (x0, y0), (x1, y1) = np.ceil(board.min(axis=0)).astype(int) + 1, board.max(axis=0).astype(int) - 1
    assert (plain.image[y0:y1, x0:x1] == shaded.image[y0:y1, x0:x1]).all()
    taken = plain.image.astype(int) - shaded.image
    assert taken.min() == 0
    assert taken[155, x0 - 4] > 25 > taken[155, x1 + 5]  # away from the lamp, which is on the right
    assert scene.min() == 90  # not changed


def test_colour_is_the_same_in_all_channels():
    placed = pose_board(SMALL, BOARD, 16, pitch_deg=30)
    scene = np.random.default_rng(0).integers(0, 255, (310, 406), dtype=np.uint8)
    appearance = Appearance(40, 200, light=0.9, slope=(0.1, 0.1), shadow=0.3)
    grey = render_board(scene, SMALL, placed, BOARD, appearance).image
    colour = render_board(np.dstack([scene] * 3), SMALL, placed, BOARD, appearance).image
    assert (colour == grey[..., None]).all()


def test_what_leaves_the_image_is_not_visible():
    frontal = rotation_xyz(0, 0, 0)
    depth = 400.0
    out = Pose(frontal, np.array([-depth * SMALL.K[0, 2] / SMALL.focal_px - 0.36 * 187.5, 0, depth]))
    scene = render_board(np.full((310, 406), 90, np.uint8), SMALL, out, BOARD, Appearance(40, 200))
    k = scene.keypoints
    assert np.isclose(k["x"][0], 0)
    assert np.isclose(k["visible"][0], 0.5 + 0.5 * 2 / np.pi / k["radius_major"][0], atol=0.01)  # half a pixel more
    assert k["visible"][3] == 0
    assert np.isclose(k["contrast"][0], 160, atol=1)
