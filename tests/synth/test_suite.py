import hashlib
import json
import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers import digests

import kpbench.synth.suite
from kpbench.dataset.generation import generate
from kpbench.degrade.blurs import blur
from kpbench.errors import DataError
from kpbench.render.background import procedural_background
from kpbench.render.board_projection import polygon_area, project_outline
from kpbench.synth.suite import SuiteConfig
from kpbench.synth.suite_boards import printed_share
from kpbench.synth.suite_file import load_suite, shipped_suites

SMALL = (203, 155)


def config(name="paper-v1", **changes):
    return SuiteConfig(load_suite(name), **{"images": 2, "size_px": SMALL, **changes})


def truth_digest(suite, scenes=2):
    """SHA-256 of all that the images of a suite are a function of, at its own size, places to 1e-4 px."""
    made = SuiteConfig(load_suite(suite), images=scenes)
    said = hashlib.sha256()
    for index in range(made.n):
        view = made.view(index)
        places = [np.round(view.keypoints[name], 4).tolist() for name in ("x", "y", "radius_major", "radius_minor")]
        appearance = [
            round(v, 6)
            for v in (view.appearance.black, view.appearance.white, view.appearance.light, *view.appearance.slope)
        ]
        row = [
            view.condition,
            view.rung,
            view.scene_id,
            view.keypoints["patch_id"].tolist(),
            places,
            appearance,
            view.effects,
            *([] if view.taken is None else [view.taken]),
        ]
        said.update(json.dumps(row).encode())
    said.update("".join(patch.digest for patch in made.suite.patches).encode())
    return said.hexdigest()[:16]


@pytest.mark.parametrize(
    ("name", "digest"),
    [
        ("paper-v1", "ada17e3c064af31d"),
        ("extended-v1", "8044ad33e95e77b6"),
        ("extended-v2", "394421757a0cf7dc"),
        ("camera-v1", "ea5e0c3b21008ef0"),
    ],
)
def test_a_published_suite_never_changes(name, digest):
    """If this fails, the change makes a new suite, such as paper-v2; a frozen one keeps its truth."""
    assert truth_digest(name, 1 if name == "camera-v1" else 2) == digest


def test_a_published_suite_keeps_its_pixels():
    """To a tenth of a grey level in the mean, so that another OpenCV may round differently."""
    means = [
        SuiteConfig(load_suite("paper-v1"), images=1, size_px=(812, 620)).make(n)[0].image.mean() for n in (0, 27, 80)
    ]
    assert np.allclose(means, (134.819, 151.479, 31.179), atol=0.1)


def test_the_papers_conditions_are_the_papers():
    conditions = {c.name: c.rungs for c in load_suite("paper-v1").conditions}
    assert conditions == {
        "scale": (0.5, 1, 2, 4, 8, 16, 32),
        "pitch": (0, 10, 20, 30, 40, 50, 60),
        "blur": (3, 7, 11, 15),
        "dimming": (10, 20, 30, 40),
        "noise": (15, 30, 45, 60),
    }
    assert SuiteConfig(load_suite("paper-v1")).n == 26 * 4 * 500
    assert sorted(shipped_suites()) == ["camera-v1", "extended-v1", "extended-v2", "paper-v1", "video-v1"]


def test_one_scene_is_the_same_under_every_rung_and_patch():
    made = config()
    blurred = [n for n in range(made.n) if made.view(n).condition == "blur"]
    pitch0 = next(n for n in range(made.n) if made.view(n).condition == "pitch")
    for step, patch in [(0, 0), (3, 2)]:
        worn, _ = made.make(blurred[0] + (step * 4 + patch) * 2 + 1)
        clean, _ = made.make(pitch0 + patch * 2 + 1)
        assert worn.scene_id == clean.scene_id == 1
        assert (blur(clean.image, (3, 7, 11, 15)[step]) == worn.image).all()
        for name in ("x", "y", "patch_id", "H_patch2image", "visible"):
            assert (worn.keypoints[name] == clean.keypoints[name]).all()
        assert (worn.keypoints["contrast"] < clean.keypoints["contrast"]).all()


def test_noise_of_one_scene_is_one_field_scaled():
    made = config(only=("noise",), images=1)
    base = config(only=("pitch",), images=1).make(0)[0].image.astype(int)
    weak, strong = (made.make(n)[0].image.astype(int) - base for n in (0, 4))
    middle = (base > 100) & (base < 150) & (abs(strong) < 100)  # none of it clipped
    assert abs(2 * weak - strong)[middle].max() <= 2  # rounding


def test_the_order_of_the_images():
    made = config(only=("scale", "noise"))
    seen = [(s.condition, s.rung, int(s.keypoints["patch_id"][0]), s.scene_id) for s in map(made.view, range(made.n))]
    rungs = [("scale", r) for r in (0.5, 1, 2, 4, 8, 16, 32)] + [("noise", r) for r in (15, 30, 45, 60)]
    assert seen == [(c, r, patch, scene) for c, r in rungs for patch in range(4) for scene in range(2)]


def test_fewer_images_and_fewer_conditions_are_a_part_of_more():
    many, few = config(images=3), config(images=2, only=("dimming",))
    view = few.view(7)
    assert (view.condition, view.rung, view.scene_id) == ("dimming", 10, 1)
    same = [n for n in range(many.n) if many.view(n).condition == "dimming"][3 * 3 + 1]
    assert (few.make(7)[0].image == many.make(same)[0].image).all()


def test_a_smaller_camera_sees_the_same():
    large, small = config(size_px=(1624, 1240)), config(size_px=(812, 620))
    for n in (0, 50, 100):
        a, b = large.view(n).keypoints, small.view(n).keypoints
        assert np.allclose((a["x"] + 0.5) / 2 - 0.5, b["x"])
        assert np.allclose((a["y"] + 0.5) / 2 - 0.5, b["y"])
        assert np.allclose(a["radius_major"] / 2, b["radius_major"])
    assert np.isclose(small.camera.focal_px / 812, 4 / 0.0045 / 1624)


def test_a_lens_bends_the_board():
    straight, bent = config(only=("scale",)), config(only=("scale",), distortion=(-0.3,))
    a, b = (c.view(40).keypoints for c in (straight, bent))
    assert abs(a["x"] - b["x"]).max() > 0.3
    assert bent.to_dict()["distortion"] == [-0.3, 0, 0, 0, 0]


def test_occluded_patches_are_visible_as_far_as_they_are():
    made = config("extended-v1", only=("occlusion",), size_px=(812, 620), images=1)
    for n, level in ((0, 10), (12, 40)):
        visible = made.make(n)[0].keypoints["visible"]
        assert np.allclose(visible, 1 - level / 100, atol=0.01)


def test_every_extended_condition_changes_the_image():
    made = config("extended-v1", images=1)
    base = config(only=("pitch",), images=1).make(0)[0].image
    firsts = {}
    for n in range(0, made.n, 4):
        firsts.setdefault(made.view(n).condition, n)
    for n in firsts.values():
        sample, _ = made.make(n)
        assert (sample.image != base).any()
        assert sample.image.shape == base.shape


def test_interrupted_and_resumed_is_the_same(tmp_path):
    made = config(only=("blur",), shard_size=10)
    generate(made, tmp_path / "one", workers=1)

    class Stop(Exception):
        pass

    done = 0

    def interrupt(images):
        nonlocal done
        done += images
        if done > 15:
            raise Stop

    with pytest.raises(Stop):
        generate(made, tmp_path / "two", workers=1, progress=interrupt)
    run = generate(pickle.loads(pickle.dumps(made)), tmp_path / "two", workers=1, resume=True)
    assert run.kept == 10
    assert digests(tmp_path / "one") == digests(tmp_path / "two")
    truth = run.dataset.truth
    assert set(truth.condition) == {"blur"}
    assert np.unique(truth.rung).tolist() == [3, 7, 11, 15]
    assert np.bincount(truth.scene_id).tolist() == [16, 16]
    assert run.dataset.effects(0) == [{"effect": "blur", "kernel_px": 3}]


def test_photographs_are_shared_by_a_scenes_images_too(tmp_path):
    for n in range(3):
        cv2.imwrite(str(tmp_path / f"{n}.png"), np.full((90, 120), 40 + 60 * n, np.uint8))
    made = config(backgrounds=tmp_path)
    assert made.make(0)[0].background == made.make(2)[0].background == made.make(200)[0].background
    assert made.to_dict()["backgrounds"]["files"] == 3


TEXT = shipped_suites()["paper-v1"].read_text()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('schema = "kpbench.suite/1"', 'schema = "kpbench.suite/2"', "schema is 'kpbench.suite/2', expected"),
        ("lens_mm = 4.0", "lens_mm = -4", "camera.lens_mm is -4, expected a number from 0.01"),
        ("size_px = [1624, 1240]", "size_px = [1624]", r"camera.size_px is \[1624\], expected a list of 2 numbers"),
        ("pitch_deg = 0\n", "pitch = 0\n", "unknown key 'pitch' in scene"),
        ("yaw_deg = 0\n", "", r"scene.yaw_deg is missing, expected a number"),
        ("white = [190, 245]", "white = [245, 190]", r"scene.white is \[245, 190\], expected \[least, most\]"),
        (
            "{ blur = [3, 7, 11, 15] }",
            "{ blur = [3, 7, 11] }",
            r"condition\[2\].effects.blur is \[3, 7, 11\], expected a",
        ),
        ("{ blur = [3, 7, 11, 15] }", "{ fog = [3, 7, 11, 15] }", r"unknown key 'fog' in condition\[2\].effects"),
        (
            "{ blur = [3, 7, 11, 15] }",
            "{ blur = [0, 7, 11, 15] }",
            r"condition\[2\].effects.blur\[0\] is 0, expected a number",
        ),
        ('name = "pitch"', 'name = "scale"', "two conditions share a name"),
        ('"checker"', '"square"', "patch 'square' is not known"),
        ("images = 500", "images = true", "images is True, expected a whole number from 1 to 1000000"),
        ("[camera]", "[camera", "not valid TOML"),
    ],
)
def test_a_wrong_suite_is_one_line(tmp_path, old, new, says):
    assert old in TEXT
    path = tmp_path / "mine.toml"
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(DataError, match=rf"mine\.toml: .*{says}"):
        load_suite(str(path))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"images": 0}, "`images` is 0"),
        ({"seed": -1}, "`seed` is -1"),
        ({"size_px": (30, 30)}, "`size_px` is 30x30"),
        ({"only": ("scale", "fog")}, "paper-v1 has no condition 'fog', only: scale, pitch, blur, dimming, noise"),
    ],
)
def test_a_value_out_of_range_is_one_line(changes, says):
    with pytest.raises(DataError, match=says):
        config(**changes)


def test_a_background_is_made_once_though_every_rung_shows_it(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        kpbench.synth.suite, "procedural_background", lambda *a: made.append(a) or procedural_background(*a)
    )
    config = SuiteConfig(load_suite("paper-v1"), images=6, size_px=(64, 64), only=("blur",), shard_size=3)
    assert len(generate(config, tmp_path / "a", workers=1).dataset) == 6 * 4 * 4
    assert len(made) == 6


def test_patches_and_tags_cost_the_same_paper():
    """Under `paper`, the printed area per keypoint is the rung's: of a disc, or of a tag that has four corners."""
    for board in (None, "apriltag", "charuco"):
        made = config("extended-v2", only=("paper",), images=1, board=board, size_px=(640, 480))
        for n in range(len(made.rungs)):
            view = made.view(n * len(made.boards))
            area_px2 = polygon_area(project_outline(view.camera, view.pose, view.board))
            assert np.isclose(area_px2 * printed_share(view.board), view.rung, rtol=0.01)


def test_clutter_lies_behind_the_board_and_grows():
    made = config("extended-v2", only=("clutter+defocus",), images=1, board="apriltag", size_px=(640, 480))
    cluttered = replace(made.rungs[0][0], effects=())
    assert cluttered.clutter == (500, 1500, 4000)
    shown, clean = (
        replace(made, suite=replace(made.suite, conditions=(condition,)))
        for condition in (cluttered, replace(cluttered, clutter=()))
    )
    changed = [clean.make(n)[0].image != shown.make(n)[0].image for n in range(3)]
    shares = [c.mean() for c in changed]
    assert 0.02 < shares[0] < shares[1] < shares[2] < 0.97
    x, y = clean.make(0)[0].keypoints[["x", "y"]][0]
    assert not changed[2][round(y) - 3 : round(y) + 4, round(x) - 3 : round(x) + 4].any()
