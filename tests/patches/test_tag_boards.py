from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from kpbench.detectors.interface import load_detector
from kpbench.geometry.camera import Camera
from kpbench.patches.board import hexagon_board
from kpbench.patches.design import shipped_patches
from kpbench.patches.tag_boards import TAG_BOARDS, tag_board
from kpbench.render.board_projection import pose_board
from kpbench.render.board_view import Appearance, board_keypoints, render_board
from kpbench.synth.suite import SuiteConfig
from kpbench.synth.suite_file import load_suite

OPTIONAL = {"napa": "napa_vision", "locus": "locus"}


def needs(module):
    return pytest.mark.skipif(find_spec(module) is None, reason=f"{module} is not installed")


CAMERA = Camera(640, 480, 350.3)
BOARDS = [tag_board(name, 187.5) for name in TAG_BOARDS]
DETECTORS = [*TAG_BOARDS, *(pytest.param(name, marks=needs(module)) for name, module in OPTIONAL.items())]
BOARD_OF = {"napa": "apriltag", "locus": "apriltag"}
SCENE = np.full((480, 640), 90, np.uint8)


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.name)
def test_a_board_of_tags_is_like_a_board_of_patches(board):
    """The same side, as many keypoints, and the same epsilon in mm."""
    patches = hexagon_board(shipped_patches()[0], 187.5)
    assert (board.side_x_mm, board.side_y_mm) == (patches.side_x_mm, patches.side_y_mm)
    assert 6 <= len(board.keypoints) <= 8
    assert {k.diameter_mm for k in board.keypoints} == {k.diameter_mm for k in patches.keypoints}
    assert len({k.patch_id for k in board.keypoints}) == len(board.keypoints)
    edge = board.black.copy()
    edge[1:-1, 1:-1] = False
    assert not edge.any()  # a white module all round


@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("lens", [(0.0,) * 5, (-0.2, 0.05, 0.0, 0.0, 0.0)])
def test_its_detector_finds_every_corner_where_the_truth_is(name, lens):
    """Convention of pixels, order of corners and identities of three libraries, in any pose."""
    camera, board = Camera(640, 480, 350.3, lens), tag_board(BOARD_OF.get(name, name), 187.5)
    off = []
    for n, pitch_deg in enumerate((0, 40, -30)):
        pose = pose_board(camera, board, 20, pitch_deg=pitch_deg, roll_deg=25 + 80 * n, shift=(0.05, -0.05))
        image = render_board(SCENE, camera, pose, board, Appearance(30, 220, light=0.9, slope=(0.1, 0))).image
        found = load_detector(name)(cv2.GaussianBlur(image, (0, 0), 0.7))
        truth = board_keypoints(camera, pose, board)
        order = [int(np.flatnonzero(found.patch_id == k["patch_id"])[0]) for k in truth]
        assert len(order) == len(found)
        off.append(found.xy[order] - np.column_stack([truth["x"], truth["y"]]))
    assert abs(np.concatenate(off)).max() < 1.0
    assert abs(np.concatenate(off).mean(axis=0)).max() < 0.15  # a library that counts from pixel corners: 0.5


@pytest.mark.parametrize("name", DETECTORS)
def test_nothing_is_found_where_nothing_is(name):
    found = load_detector(name)(SCENE)
    assert (len(found), found.patch_id is None) == (0, False)
    assert len(load_detector(name)(np.dstack([SCENE] * 3))) == 0


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.name)
def test_its_light_is_that_of_its_modules(board):
    pose = pose_board(CAMERA, board, 15, pitch_deg=30, roll_deg=12)
    image = render_board(np.zeros((480, 640), np.uint8), CAMERA, pose, board, Appearance(0, 200, edge=1)).image
    white = pose_board(CAMERA, board, 15, pitch_deg=30, roll_deg=12)
    paper = render_board(np.zeros((480, 640), np.uint8), CAMERA, white, board, Appearance(200, 200, edge=1)).image
    tilted = 1 - image.sum() / paper.sum()
    assert np.isclose(tilted, board.black.mean(), rtol=0.15)  # what is nearer is larger
    flat = pose_board(CAMERA, board, 15, roll_deg=12)
    image, paper = (
        render_board(np.zeros((480, 640), np.uint8), CAMERA, flat, board, Appearance(ink, 200, edge=1)).image
        for ink in (0, 200)
    )
    assert np.isclose(1 - image.sum() / paper.sum(), board.black.mean(), rtol=0.003)


def test_a_suite_with_tags_shows_the_same_scenes():
    suite = load_suite("paper-v1")
    patches, tags = (SuiteConfig(suite, images=2, size_px=(203, 155), board=board) for board in (None, "aruco"))
    assert (patches.n, tags.n, tags.name) == (26 * 4 * 2, 26 * 2, "paper-v1-aruco")
    for rung, scene in ((3, 0), (9, 1), (20, 0)):
        a, b = patches.view((rung * 4 + 1) * 2 + scene), tags.view(rung * 2 + scene)
        assert (a.condition, a.rung, a.scene_id, a.appearance) == (b.condition, b.rung, b.scene_id, b.appearance)
        assert (a.pose.t_camera == b.pose.t_camera).all()
        assert (a.pose.R_board2camera == b.pose.R_board2camera).all()
        assert a.effects == b.effects
    sample, _ = tags.make(0)
    assert len(sample.keypoints) == 8
    assert "patches" not in tags.to_dict()
    assert tags.to_dict()["board"]["name"] == "aruco"


@pytest.mark.parametrize("name", TAG_BOARDS)
@pytest.mark.parametrize("size", [(1, 1), (2, 3), (1, 50), (9, 9)])
def test_an_image_of_a_few_px_holds_none(name, size):
    assert len(load_detector(name)(np.zeros(size, np.uint8))) == 0
