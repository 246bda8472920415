"""Tripod series: easy photographs give truth to hard ones, covered patches are ignored, a moved tripod is caught."""

import board_photos
import cv2
import numpy as np
import pytest
from helpers import kpbench as run

import kpbench
from kpbench.errors import DataError

SCENE, HIDDEN = 501, 2
"""Photograph of the scene, and the patch that an occluder hides."""


def write_series(folder, names, moved_px=0.0):
    """Photographs of one scene by name; the folder of each tells how it is degraded. Return the true keypoints."""
    rng = np.random.default_rng(7)
    base, keypoints = board_photos.photograph(SCENE)
    for name in names:
        light = base.astype(float)
        if "covered" in name:
            k = keypoints[HIDDEN]
            light[
                int(k["y"] - 1.2 * k["radius_major"]) : int(k["y"] + 1.2 * k["radius_major"]),
                int(k["x"] - 1.2 * k["radius_major"]) : int(k["x"] + 1.2 * k["radius_major"]),
            ] = 90
        if "blur" in name:
            light = cv2.blur(light, (15, 15))
        if "dark" in name:
            light *= 0.2
        if moved_px and name == names[-1]:
            light = cv2.warpAffine(light, np.array([[1, 0, moved_px], [0, 1, 0]]), base.shape[::-1])
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = np.clip(np.rint(light + rng.normal(0, 1.5, light.shape)), 0, 255)
        cv2.imwrite(str(folder / name), pixels.astype(np.uint8))
    return keypoints


def label(folder, **options):
    return kpbench.label(folder, board_photos.BOARD, folder / "set", camera=board_photos.CAMERA, **options)


def test_hard_photographs_get_the_truth_of_easy_ones(tmp_path):
    names = ["desk/1.png", "desk/dark-blur/15/2.png", "desk/blur/15/3.png", "desk/covered-blur/15/4.png", "desk/5.png"]
    true = write_series(tmp_path, names)
    dataset = label(tmp_path, tripod=["desk"]).dataset
    photos = [photo["name"] for photo in dataset.config["photos"]]
    assert sorted(photos) == sorted(names)
    assert {*dataset.truth.scene_id.tolist()} == {0}, "one scene for the bootstrap"
    for n, photo in enumerate(dataset.config["photos"]):
        own = dataset.keypoints(n)
        nearest = np.hypot(own["x"][:, None] - true["x"], own["y"][:, None] - true["y"]).argmin(axis=1)
        assert np.abs(own["x"] - true["x"][nearest]).max() < 0.05
        assert len(own) + len(dataset.ignored(n)) == len(true)
        assert (HIDDEN in nearest) == ("covered" not in photo["name"])
        assert len(own) >= len(true) - 2
        assert photo.get("truth_of", "desk/1.png") in ("desk/1.png", "desk/5.png")
        assert ("truth_of" in photo) == (len(photo["name"].split("/")) == 4)
    groups = {*zip(dataset.truth.condition.tolist(), dataset.truth.rung.tolist(), strict=True)}
    assert {("dark-blur", 15.0), ("blur", 15.0), ("covered-blur", 15.0)} <= groups


def test_a_moved_tripod_stops_the_labels(tmp_path, here):
    write_series(tmp_path / "photos", ["1.png", "blur/15/2.png", "3.png"], moved_px=1.0)
    kpbench.print_boards([board_photos.BOARD], "print", formats=["svg"])
    kpbench.write_camera("camera.yaml", board_photos.CAMERA)
    done = run(
        "label", str(tmp_path / "photos"), "--board", "print/truth.json", "--camera", "camera.yaml", "--tripod", ".",
        "--out", "set", code=1,
    )  # fmt: skip
    assert "series '.': camera or board moved by 1.0" in done.stderr
    assert "between 1.png and 3.png, expected a fixed scene" in done.stderr


def test_a_hard_photograph_needs_an_easy_one_before_and_after(tmp_path):
    write_series(tmp_path, ["a/1.png", "a/2.png", "a/blur/15/3.png"])
    result = label(tmp_path, tripod=["a"])
    assert [o.reason for o in result.observed if o.photo.name.endswith("3.png")] == ["not-between"]
    with pytest.raises(DataError, match="series 'b' has no photographs"):
        label(tmp_path, tripod=["b"], overwrite=True)
    (tmp_path / "a" / "2.png").unlink()
    with pytest.raises(DataError, match="1 photographs show enough marks, expected one before and one after"):
        label(tmp_path, tripod=["a"], overwrite=True)
