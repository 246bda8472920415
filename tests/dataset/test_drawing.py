"""Pictures for people: what marks hide, what labels say, how sheets are laid out."""

import numpy as np
import pytest
from helpers import rotation

from kpbench import Detections
from kpbench.dataset import draw_detections, draw_keypoints, draw_rungs, enlarge_for_drawing
from kpbench.dataset.drawing import PATCH_COLOURS, contact_sheet
from kpbench.types import KEYPOINT_DTYPE

GREY = 128


def keypoint(x, y, radius, patch_id=1):
    found = np.zeros(1, KEYPOINT_DTYPE)
    found["x"], found["y"], found["patch_id"], found["radius_major"], found["radius_minor"] = (
        x,
        y,
        patch_id,
        radius,
        radius,
    )
    return found


def changed(canvas):
    """Where a picture of an even grey image was drawn on."""
    return (canvas != GREY).any(axis=2)


def coloured(canvas, patch_id):
    return (np.abs(canvas.astype(int) - PATCH_COLOURS[patch_id]).max(axis=2) < 40).sum()


@pytest.mark.parametrize(("diameter", "size"), [(5, 480), (50, 480), (500, 1200)])
@pytest.mark.parametrize("squeeze", [1.0, 0.6])
def test_a_mark_surrounds_its_patch_and_hides_nothing_of_a_small_one(diameter, size, squeeze):
    image = np.full((size, size), GREY, np.uint8)
    A = diameter / 2 * rotation(30) @ np.diag([1, squeeze]) @ rotation(70)
    scale, middle = enlarge_for_drawing(image), size / 2 - 0.5
    canvas = draw_detections(image, Detections([[middle, middle]], [0.9], [1], [A]), {1: "trefoil"}, scale=scale)
    y, x = np.mgrid[: size * scale, : size * scale]
    places = np.stack([(x + 0.5) / scale - 0.5 - middle, (y + 0.5) / scale - 0.5 - middle], axis=-1)
    radius = np.hypot(*np.moveaxis(places @ np.linalg.inv(A).T, -1, 0))
    hidden = changed(canvas)[radius < 1].mean()
    assert hidden < (0.03 if diameter == 5 else 0.08)
    ring = changed(canvas) & (radius > 1) & (np.hypot(places[..., 0], places[..., 1]) < diameter / 2 + 8)
    angles = np.degrees(np.arctan2(*places[ring].T)).round(-1) % 360
    assert len(set(angles.tolist())) == 36  # all around
    assert coloured(canvas, 1) > 100


def test_labels_cover_no_other_patch_and_no_other_label():
    image = np.full((480, 640), GREY, np.uint8)
    xy = np.stack(np.meshgrid(np.arange(20, 640, 40), np.arange(20, 480, 40)), axis=-1).reshape(-1, 2).astype(float)
    frames = np.tile(8 * np.eye(2), (len(xy), 1, 1))
    found = Detections(xy, np.ones(len(xy)), np.full(len(xy), 2), frames)
    canvas = draw_detections(image, found, {2: "wheel"}, scale=2)
    for x, y in xy:  # around each centre, inside the cross and the ring, there is the image
        assert (canvas[int(2 * y) - 6 : int(2 * y) - 3, int(2 * x) - 6 : int(2 * x) - 3] == GREY).all()


def test_the_truth_shows_errors_false_alarms_and_misses():
    image, truth = np.full((200, 300), GREY, np.uint8), np.concatenate([keypoint(60, 60, 20), keypoint(220, 60, 20)])
    exact = Detections([[60.0, 60.0], [60.0, 160.0]], [1.0, 1.0], [1, 1], np.tile(20 * np.eye(2), (2, 1, 1)))
    plain, with_truth = draw_detections(image, exact), draw_detections(image, exact, None, truth)
    assert not changed(plain)[30:90, 190:250].any()
    around_missed = changed(with_truth)[30:90, 190:250]
    assert 0.1 < around_missed.mean() < 0.5
    assert not around_missed[20:40, 20:40].any()  # dashed, and without a cross
    assert changed(with_truth)[140:180].sum() > changed(plain)[140:180].sum()  # "false" makes the label longer


def test_what_has_no_frame_no_id_or_no_room_is_drawn():
    image = np.full((24, 32, 3), GREY, np.uint8)
    assert changed(draw_detections(image, Detections([[12.0, 12.0]], [0.5]))).any()
    assert not changed(draw_detections(image, Detections.none())).any()
    assert changed(draw_keypoints(image, keypoint(16, 12, 300))).sum() >= 0  # larger than the image


def test_a_sheet_of_a_suite_has_a_row_per_condition():
    class Suite:
        path = "suite"

        def __init__(self):
            pairs = [("blur", 3), ("blur", 3), ("blur", 7), ("noise", 15)]
            self.truth = type("Truth", (), {})()
            self.truth.condition = np.array([name for name, _ in pairs])
            self.truth.rung = np.array([rung for _, rung in pairs], float)
            self.truth.scene_id = np.array([0, 1, 0, 0])

        def __getitem__(self, n):
            return np.full((30, 40), 60 * n, np.uint8), np.zeros(0, KEYPOINT_DTYPE)

    sheet = draw_rungs(Suite(), 80)
    assert sheet.shape[1] == 2 * 80 + 3 * 4
    levels = {int(v) for v in np.unique(sheet.reshape(-1, 3)[:, 0]) if (sheet[..., 0] == v).sum() >= 80 * 60}
    assert levels == {0, 120, 180, 255}  # image 1 is of another scene


def test_a_sheet_without_titles_has_none():
    tiles = [np.zeros((10, 20, 3), np.uint8)] * 3
    assert contact_sheet(tiles, 2).shape == (2 * 14 + 4, 2 * 24 + 4, 3)
