"""Detail on patches: it repeats, stays within its reach, follows the pose, and leaves most of the patch."""

import numpy as np
import pytest

from kpbench.camera import scene_light
from kpbench.render import paint_detail
from kpbench.render.detail import DETAILS, MOST_ON_CENTRE, REACH

H = np.array([[50.0, 6, 80], [-4, 44, 70], [0.001, -0.0015, 1]])


def patch_points(H_patch2image, shape):
    y, x = np.indices(shape)
    u, v, w = np.moveaxis(np.stack([x, y, np.ones(shape)], axis=-1) @ np.linalg.inv(H_patch2image).T, -1, 0)
    return u / w, v / w


@pytest.mark.parametrize("kind", DETAILS)
@pytest.mark.parametrize("shape", [(150, 170), (150, 170, 3)])
def test_detail_repeats_and_stays_near_the_patch(kind, shape):
    u, v = patch_points(H, shape[:2])
    outside = np.hypot(u, v) > REACH + 0.03
    for seed in range(4):
        light, again = np.full(shape, 0.3, np.float32), np.full(shape, 0.3, np.float32)
        assert paint_detail(light, H, np.random.default_rng(seed), 1, [kind]) == [kind]
        paint_detail(again, H, np.random.default_rng(seed), 1, [kind])
        assert light.tobytes() == again.tobytes()
        assert (light[outside] == np.float32(0.3)).all()
        assert (light != np.float32(0.3)).any()
        assert (light >= 0).all()
        assert np.isfinite(light).all()


def test_a_hub_covers_at_most_a_sixth_of_the_radius_at_the_centre():
    u, v = patch_points(H, (150, 170))
    for seed in range(20):
        light = np.full((150, 170), 0.3, np.float32)
        paint_detail(light, H, np.random.default_rng(seed), 1, ["hub"])
        changed = np.abs(light - 0.3) > 1e-6
        assert changed[70, 80]
        # the hub, and its shadow around it
        assert np.hypot(u, v)[changed].max() < 2 * MOST_ON_CENTRE + 0.1


def test_detail_follows_the_pose():
    """A detail of a turned patch is the turned detail, but for the light, whose direction is drawn in the patch."""
    still, turned = np.full((121, 121), 0.4, np.float32), np.full((121, 121), 0.4, np.float32)
    scale = np.array([[40.0, 0, 60], [0, 40, 60], [0, 0, 1]])
    quarter = np.array([[0.0, -40, 60], [40, 0, 60], [0, 0, 1]])
    paint_detail(still, scale, np.random.default_rng(5), 4)
    paint_detail(turned, quarter, np.random.default_rng(5), 4)
    assert np.abs(np.rot90(still, -1) - turned).max() < 1e-4


def test_levels_are_painted_as_light_is():
    levels = np.full((150, 170), 120, np.uint8)
    light = scene_light(levels)
    drawn = paint_detail(levels, H, np.random.default_rng(3), 3)
    assert paint_detail(light, H, np.random.default_rng(3), 3) == drawn
    assert np.abs(scene_light(levels) - np.minimum(light, 1)).max() < 0.01


def test_a_patch_outside_the_image_is_left_out():
    image = np.full((40, 40), 9, np.uint8)
    paint_detail(image, H + np.array([[0, 0, 500], [0, 0, 0], [0, 0, 0]]), np.random.default_rng(0), 2)
    assert (image == 9).all()
