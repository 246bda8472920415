"""Motion and rolling shutter against a brute-force render that knows only where a sample lies on the patch."""

import cv2
import numpy as np
import pytest

from kpbench.camera.paper import Cylinder
from kpbench.camera.shutter import BoardMotion, PatchMotion, Shutter, rasterise_moving, sub_exposures, true_homography
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera, rotation_xyz
from kpbench.geometry.homography import project
from kpbench.geometry.outline import circle, flatten
from kpbench.patches.design import shipped_patches
from kpbench.render.exposure import expose_patches, true_placement
from kpbench.render.placement import Placement
from kpbench.render.scene import rasterise_patches

SIDE, FINE, INSTANTS = 40, 8, 64
H = np.array([[9.0, -2.0, 19.3], [1.0, 8.0, 20.6], [0.002, -0.003, 1.0]])
WHEEL = shipped_patches()[2]


def patch_point(x, y, t, motion):
    """Point of the patch frame, shape (..., 2), that lies at (x, y) at time t."""
    angle, scale = np.radians(motion.turn_deg) * t, np.exp(motion.growth * t)
    dx, dy = x - H[0, 2] - motion.velocity_px[0] * t, y - H[1, 2] - motion.velocity_px[1] * t
    c, s = np.cos(angle) / scale, np.sin(angle) / scale
    ideal = np.stack([c * dx + s * dy + H[0, 2], c * dy - s * dx + H[1, 2], np.ones_like(x)], axis=-1)
    u = ideal @ np.linalg.inv(H).T
    return u[..., :2] / u[..., 2:]


def brute_force(motion, shutter):
    """Mean of some instants; each row of pixels has its own pose, and each pixel 8 x 8 samples."""
    k = (np.arange(SIDE * FINE) + 0.5) / FINE - 0.5
    x, y = np.meshgrid(k, k)
    row = np.rint(y)
    black, disc = np.zeros((SIDE, SIDE)), np.zeros((SIDE, SIDE))
    for instant in (np.arange(INSTANTS) + 0.5) / INSTANTS - 0.5:
        uv = patch_point(x, y, shutter.start + shutter.row_time * row + instant, motion)
        black += WHEEL.is_black(uv).reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3)) / INSTANTS
        disc += (np.hypot(*np.moveaxis(uv, -1, 0)) < 1).reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3)) / INSTANTS
    return black, disc


def on_image(mask):
    black, disc = np.zeros((SIDE, SIDE)), np.zeros((SIDE, SIDE))
    x, y, w, h = mask.box
    black[y : y + h, x : x + w], disc[y : y + h, x : x + w] = mask.black, mask.disc
    return black, disc


def centroid(cover):
    y, x = np.indices(cover.shape)
    return np.array([(x * cover).sum(), (y * cover).sum()]) / cover.sum()


def of_pose(H_patch2image):
    return on_image(rasterise_patches([Placement(WHEEL, H_patch2image, 0, 255)])[0])


@pytest.mark.parametrize(
    ("motion", "shutter"),
    [
        (PatchMotion((5.0, -3.0), 10.0, 0.05), Shutter()),
        (PatchMotion((6.0, 4.0), -15.0, 0.0), Shutter.rolling(0.02, SIDE)),
    ],
    ids=["global", "rolling"],
)
def test_a_moving_patch_is_what_brute_force_renders(motion, shutter):
    placement = Placement(WHEEL, H, 0, 255)
    (mask,) = expose_patches([placement], [motion], shutter)
    for found, expected in zip(on_image(mask), brute_force(motion, shutter), strict=True):
        assert np.abs(found - expected).max() < 0.01
        assert np.abs(centroid(found) - centroid(expected)).max() < 0.001


def test_the_true_pose_is_that_of_the_row_of_the_centre():
    # without a turn, the skew of the shutter is affine: the still render of the true pose has the true centroids
    shift, shutter = PatchMotion((1.2, 0.8)), Shutter(0.05, -0.9)
    true = true_placement(Placement(WHEEL, H, 0, 255), shift, shutter).H_patch2image
    for found, expected in zip(of_pose(true), brute_force(shift, shutter), strict=True):
        assert np.abs(centroid(found) - centroid(expected)).max() < 0.005
    for motion, rolling in (
        (PatchMotion((6.0, 4.0), -15.0, 0.1), Shutter(0.02, -0.1)),
        (PatchMotion((6.0, 4.0), 15.0), Shutter()),
    ):
        true = true_homography(motion.of_patch(H), H, rolling)
        x, y = (true[:2, 2] + 1e-4 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])).T
        uv = patch_point(x, y, rolling.start + rolling.row_time * y, motion)
        assert np.abs(uv[0]).max() < 1e-9
        inverse = np.stack([uv[1] - uv[2], uv[3] - uv[4]], axis=-1) / 2e-4
        H_affine = true[:2, :2] - np.outer(true[:2, 2], true[2, :2])
        assert np.abs(H_affine @ inverse - np.eye(2)).max() < 1e-6


def test_a_moving_board_is_what_opencv_projects():
    camera = Camera(640, 480, 500.0, (-0.2, 0.05, 0.001, 0.002, 0.0, 0.0, 0.0, 0.0), principal_px=(315.0, 244.0))
    R, place = rotation_xyz(20, -15, 40), np.array([20.0, -10.0, 400.0])
    motion, bow = BoardMotion((8.0, -3.0, 5.0), (1.0, -2.0, 3.0)), Cylinder(300.0, 25.0)
    points = np.random.default_rng(1).uniform(-80, 80, (30, 2))
    move, shutter = motion.of_board(camera, R, place, bow), Shutter(0.004, -0.3)
    seen = shutter.expose(move, points, 0.25)
    for point, image in zip(bow.bend(points), seen, strict=True):
        t = -0.3 + 0.004 * image[1] + 0.25
        turn = cv2.Rodrigues(np.radians(motion.turn_deg) * t)[0] @ R
        shift = place + t * np.array(motion.velocity_mm)
        expected = cv2.projectPoints(point[None], cv2.Rodrigues(turn)[0], shift, camera.K, np.array(camera.distortion))
        assert np.abs(expected[0].ravel() - image).max() < 1e-9
    # the truth of a disc on the board: its centre, and its derivative
    H_patch2board = np.array([[15.0, 0, 30], [0, 15, -20], [0, 0, 1.0]])
    disc = lambda p, t: move(project(H_patch2board, p), t)  # noqa: E731
    still = camera.K @ np.column_stack([R[:, :2], place]) @ H_patch2board
    true = true_homography(disc, still, shutter)
    h = 1e-4
    near = np.array([[0, 0], [h, 0], [0, h], [-h, 0], [0, -h]])
    exact, first_order = shutter.expose(disc, project(np.eye(3), near)), project(true, near)
    assert np.abs(exact[0] - first_order[0]).max() < 1e-9
    assert np.abs((exact[1:3] - exact[3:]) - (first_order[1:3] - first_order[3:])).max() < 1e-8


def test_instants_follow_the_path_and_chords_follow_bent_edges():
    moved = PatchMotion((0.0, 0.0), 60.0).of_patch(np.diag([20.0, 20.0, 1.0]))
    rim = flatten(circle(0, 0, 1.0), 1e-3)[0]
    assert len(sub_exposures(moved, rim, Shutter())) == int(np.ceil(2 * 20 * np.pi / 3))
    still = PatchMotion().of_patch(H)
    assert sub_exposures(still, rim, Shutter()).tolist() == [0.0]
    ((_, disc),) = rasterise_moving([[rim]], moved)
    assert np.isclose(disc.sum(), np.pi * 400, rtol=1e-5)
    with pytest.raises(DataError, match="as fast as"):
        Shutter(1.0).expose(PatchMotion((0.0, 1.0)).of_patch(H), rim)


def test_a_warped_patch_has_its_warped_area_and_ink_gain_grows_it():
    camera = Camera(SIDE, SIDE, 30.0, (-0.1, 0.0, 0.0, 0.0))
    warp = lambda points: camera.distort((points - camera.K[:2, 2]) / camera.focal_px)  # noqa: E731
    placement = Placement(shipped_patches()[0], H, 0, 255)
    k = (np.arange(SIDE * FINE) + 0.5) / FINE - 0.5
    samples = np.stack(np.meshgrid(k, k), axis=-1).reshape(-1, 2)
    ideal = camera.focal_px * camera.undistort(samples) + camera.K[:2, 2]
    u = np.column_stack([ideal, np.ones(len(ideal))]) @ np.linalg.inv(H).T
    ink = placement.patch.is_black(u[:, :2] / u[:, 2:]).reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3))
    (mask,) = rasterise_patches([placement], warp=warp)
    found = on_image(mask)[0]
    assert np.abs(found - ink).max() < 0.15
    assert np.abs(centroid(found) - centroid(ink)).max() < 0.005
    (plain,), (grown,) = rasterise_patches([placement]), rasterise_patches([placement], ink_gain=0.05)
    (black, disc), (black0, disc0) = on_image(grown), on_image(plain)
    assert (disc - black > -1e-3).all()
    assert (disc - disc0 > -1e-3).all()
    assert black.sum() > 1.05 * black0.sum()
