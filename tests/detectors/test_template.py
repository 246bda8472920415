from pathlib import Path

import numpy as np
import pytest
from helpers import rotation

from kpbench.degrade.blurs import blur, motion_blur
from kpbench.degrade.effects import dimming, noise
from kpbench.detectors.interface import load_detector
from kpbench.detectors.template import TemplateDetector, find_crossings
from kpbench.errors import DataError
from kpbench.fitting.pyramid import build_pyramid, sample_pyramid
from kpbench.patches.design import Patch, SemiCircle, parse_patch, shipped_patches
from kpbench.render.background import procedural_background
from kpbench.render.placement import Placement
from kpbench.render.scene import render_scene

SIZE = (320, 240)
# x, y, radius, tilt (short over long semi-axis), two turns: one patch of each design
POSES = [
    (60.3, 70.8, 30.0, 1.0, 20, 0),
    (200.6, 60.2, 24.0, 0.5, 70, 200),
    (90.1, 180.7, 12.0, 0.8, 10, 130),
    (260.4, 170.5, 40.0, 0.4, 120, 300),
]


def placements(poses=POSES, black=40.0, white=215.0):
    placed = []
    for patch, (x, y, radius, tilt, first, second) in zip(shipped_patches(), poses, strict=False):
        H = np.eye(3)
        H[:2, :2] = rotation(first) @ np.diag([radius, radius * tilt]) @ rotation(second)
        H[:2, 2] = x, y
        placed.append(Placement(patch, H, black, white))
    return placed


@pytest.fixture(scope="module")
def rendered():
    return render_scene(procedural_background(np.random.default_rng(3), *SIZE), placements())


@pytest.fixture(scope="module")
def detector():
    return load_detector("template")


def pair(found, keypoints):
    """For each true keypoint the index of the nearest detection and its distance."""
    distance = np.hypot(found.xy[:, :1] - keypoints["x"], found.xy[:, 1:] - keypoints["y"])
    return distance.argmin(axis=0), distance.min(axis=0)


def test_it_finds_every_design_to_a_few_hundredths_of_a_pixel(rendered, detector):
    found = detector(rendered.image)
    nearest, distance = pair(found, rendered.keypoints)
    assert distance.max() < 0.05
    assert (found.patch_id[nearest] == rendered.keypoints["patch_id"]).all()
    assert len(found) <= len(POSES) + 1
    assert (np.diff(found.score) <= 0).all()
    assert found.score[nearest].min() > 0.9


@pytest.mark.parametrize(
    "effect",
    [
        lambda image: noise(image, np.random.default_rng(0), 30),
        lambda image: dimming(image, 40),
        lambda image: blur(image, 5),
        lambda image: motion_blur(image, 5.0, 30.0),
    ],
    ids=["noise", "dimming", "blur", "motion"],
)
def test_it_stands_what_a_camera_does(rendered, detector, effect):
    found = detector(effect(rendered.image))
    nearest, distance = pair(found, rendered.keypoints)
    right = (distance < 0.5) & (found.patch_id[nearest] == rendered.keypoints["patch_id"])
    assert right.sum() >= 3


def test_detections_turn_with_the_image(rendered, detector):
    found = detector(rendered.image)
    turned = detector(np.ascontiguousarray(np.rot90(rendered.image)))
    back = np.column_stack([SIZE[0] - 1 - turned.xy[:, 1], turned.xy[:, 0]])
    sure = found[found.score > 0.9]
    distance = np.hypot(*(sure.xy[:, None] - back).transpose(2, 0, 1))
    assert distance.min(axis=1).max() < 0.02
    assert (turned.patch_id[distance.argmin(axis=1)] == sure.patch_id).all()


def test_colour_is_read_as_grey(rendered, detector):
    grey = detector(rendered.image)
    colour = detector(np.repeat(rendered.image[..., None], 3, axis=2))
    assert np.array_equal(grey.xy, colour.xy)


def test_a_patch_that_is_cut_by_the_image_is_found(detector):
    cut = render_scene(
        procedural_background(np.random.default_rng(4), *SIZE), placements([(8.0, 120.4, 22.0, 1.0, 20, 0)])
    )
    assert cut.keypoints["visible"][0] < 0.75
    found = detector(cut.image)
    nearest, distance = pair(found, cut.keypoints)
    assert distance[0] < 0.1
    assert found.patch_id[nearest[0]] == cut.keypoints["patch_id"][0]


def test_the_threshold_only_drops_the_worse(rendered):
    noisy = noise(rendered.image, np.random.default_rng(1), 45)
    every, some = TemplateDetector(threshold=0.0)(noisy), TemplateDetector(threshold=0.6)(noisy)
    assert len(every) > len(some) > 0
    assert (some.score >= 0.6).all()
    assert {tuple(p) for p in some.xy} <= {tuple(p) for p in every.xy}


@pytest.mark.parametrize("shape", [(1, 1), (0, 40), (2, 40), (17, 16), (64, 64, 3)])
def test_an_image_with_nothing_in_it_has_no_detections(detector, shape):
    found = detector(np.full(shape, 90, np.uint8))
    assert len(found) == 0
    assert found.patch_id is not None


def test_noise_alone_raises_hardly_an_alarm(detector):
    noise = np.random.default_rng(0).integers(0, 256, (4, 120, 160), dtype=np.uint8)
    assert sum(len(detector(image)) for image in noise) <= 4


def test_a_design_of_one_edge_is_refused():
    half = parse_patch({"name": "half", "id": 0, "semicircles": [{"start_deg": 0, "ink": "black"}]}, "half.toml")
    with pytest.raises(DataError, match="'half': template needs edges of two directions"):
        TemplateDetector((half,))


@pytest.mark.parametrize("patch", shipped_patches(), ids=lambda patch: patch.name)
def test_edges_cross_where_the_centre_is(patch):
    H = np.array([[9.0, 2.0, 30.2], [-2.0, 8.0, 29.9], [0, 0, 1]])
    image = render_scene(np.full((60, 60), 120, np.uint8), [Placement(patch, H, 30, 220)]).image
    xy, strength = find_crossings(image.astype(np.float32))
    assert np.hypot(*(xy - H[:2, 2]).T).min() < 1.5
    assert (np.diff(strength) <= 0).all()


def test_the_designs_are_not_written_into_the_code():
    code = Path(load_detector.__code__.co_filename).with_name("template.py")
    assert not any(patch.name in code.read_text() for patch in shipped_patches())


def test_more_poses_than_remap_takes_at_once_are_sampled():
    levels = build_pyramid(procedural_background(np.random.default_rng(0), 64, 48), 0)
    xy, A = np.tile([[20.0, 15.0]], (40_000, 1)), np.tile(np.eye(2), (40_000, 1, 1))
    values = sample_pyramid(levels, np.zeros(40_000, int), xy, A, np.array([[0.0, 0.0], [1.0, 2.0]]))
    assert (values == [levels[0][15, 20], levels[0][17, 21]]).all()


def test_a_design_whose_centre_looks_the_same_after_half_a_turn_is_found_in_every_rotation():
    outer, inner = SemiCircle(1.0, 0.0, "black"), SemiCircle(0.5, 90.0, "invert")
    patch = Patch("half-turn", 7, "white", (outer, inner))
    find = TemplateDetector((patch,))
    for angle in range(10, 370, 30):
        H = np.eye(3)
        H[:2, :2], H[:2, 2] = 25 * rotation(angle), (60.2, 58.7)
        background = procedural_background(np.random.default_rng(1), 120, 120)
        found = find(render_scene(background, [Placement(patch, H, 40.0, 215.0)]).image)
        assert np.hypot(*(found.xy - (60.2, 58.7)).T).min(initial=9) < 0.05, angle


def test_a_design_that_it_does_not_see_is_refused():
    turns = (0.0, 36.0, 72.0, 108.0, 144.0)
    five = Patch("five", 5, "white", tuple(SemiCircle(1.0, turn, "invert") for turn in turns))
    with pytest.raises(DataError, match=r"design 'five': template does not find it in its own drawing"):
        TemplateDetector((five,))
