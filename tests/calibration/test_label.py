"""Labelled photographs: the truth, its stated errors, what is not labelled, and the gates."""

import dataclasses
import re
import shutil
from itertools import pairwise

import board_photos
import cv2
import numpy as np
import pytest
from helpers import kpbench as run
from PIL import Image

import kpbench
from kpbench.calibration.bundle import PhotoPose
from kpbench.calibration.camera_solution import Halves
from kpbench.calibration.conditions import measure_condition, name_condition
from kpbench.calibration.label_dataset import _judge_halves
from kpbench.calibration.projection import turn
from kpbench.calibration.shape import PrintShape
from kpbench.errors import DataError, GateFailed, KpbenchWarning
from kpbench.images import encode_png


@pytest.fixture(scope="module")
def labelled(photos, tmp_path_factory):
    out = tmp_path_factory.mktemp("labelled") / "set"
    return kpbench.label(photos[0], board_photos.BOARD, out, source="simulated photographs")


def match_truth(dataset, truth):
    """Labels and the true keypoints nearest to them."""
    table, offsets, true = dataset.truth.keypoints, dataset.truth.offsets, []
    for n, photo in enumerate(dataset.config["photos"]):
        own, all_true = table[offsets[n] : offsets[n + 1]], truth[photo["name"]]
        gap = np.hypot(own["x"][:, None] - all_true["x"], own["y"][:, None] - all_true["y"])
        true.append(all_true[gap.argmin(axis=1)])
    return table, np.concatenate(true)


def test_the_truth_is_right_within_its_stated_error(labelled, photos):
    table, true = match_truth(labelled.dataset, photos[1])
    error = np.stack([table["x"] - true["x"], table["y"] - true["y"]], axis=1)
    assert len(table) > 35
    assert np.sqrt((error**2).mean()) < 0.006
    assert (table["patch_id"] == true["patch_id"]).all()
    nees = ((error / np.stack([table["sigma_x"], table["sigma_y"]], axis=1)) ** 2).sum(axis=1).mean()
    assert 0.8 < nees < 4.0
    assert 0.5 < labelled.error_px / np.sqrt((error**2).mean()) < 2
    for name in ("radius_major", "radius_minor", "H_patch2image"):
        np.testing.assert_allclose(table[name], true[name], atol=0.02, rtol=1e-4)


def test_the_dataset_is_one_like_any_other(labelled):
    dataset = labelled.dataset
    assert dataset.truth.keypoints.dtype == kpbench.LABELLED_KEYPOINT_DTYPE
    assert list(dataset.verify())
    assert dataset.config["source"] == "simulated photographs"
    assert dataset.config["board"]["digest"] == board_photos.BOARD.digest
    assert dataset.image(0).shape == (720, 960)
    assert all(len(photo["sha256"]) == 64 for photo in dataset.config["photos"])
    assert "simulated photographs" in run("inspect", str(dataset.path)).stdout


def test_covered_patches_and_those_outside_the_marks_are_not_labelled(photos, tmp_path):
    folder, truth = tmp_path / "photos", photos[1]
    folder.mkdir()
    for name in ("02.png", "03.png", "04.png"):
        shutil.copy(photos[0] / name, folder / name)
    image, hidden = cv2.imread(str(folder / "03.png"), 0), truth["03.png"][2]
    cv2.circle(image, (int(hidden["x"]), int(hidden["y"])), int(hidden["radius_major"]), 200, -1)
    half = truth["03.png"][5]
    left, top = int(half["x"]), int(half["y"])
    image[top - 60 : top, left - 60 : left + 60] = 30  # a hand over half of a patch
    cv2.imwrite(str(folder / "03.png"), image)
    image = cv2.imread(str(folder / "04.png"), 0)
    H, _ = cv2.findHomography(board_photos.BOARD.points_mm[:, :2], np.stack([truth["04.png"][c] for c in "xy"], axis=1))
    below = np.array([[[-200.0, -40.0]], [[200.0, -40.0]], [[200.0, 300.0]], [[-200.0, 300.0]]])
    cv2.fillConvexPoly(image, np.rint(cv2.perspectiveTransform(below, H)).astype(int), 120)
    cv2.imwrite(str(folder / "04.png"), image)
    result = kpbench.label(folder, board_photos.BOARD, tmp_path / "set")
    found = {photo["name"]: photo["unlabelled"] for photo in result.dataset.config["photos"]}
    assert found["03.png"] == {"covered": 2}
    assert sum(found["04.png"].values()) >= 4
    ignored = result.dataset.ignored([*found].index("03.png"))
    np.testing.assert_allclose(ignored["x"], truth["03.png"]["x"][[2, 5]], atol=0.05)
    table, true = match_truth(result.dataset, truth)
    assert np.hypot(table["x"] - true["x"], table["y"] - true["y"]).max() < 0.05


def test_the_command_labels_with_a_camera_file(photos, here):
    kpbench.write_camera("camera.yaml", board_photos.CAMERA)
    kpbench.print_boards([board_photos.BOARD], "print", formats=["svg"])
    (here / "few").mkdir()
    for name in ("00.png", "01.png"):
        shutil.copy(photos[0] / name, here / "few" / name)
    done = run("label", "few", "--board", "print/truth.json", "--camera", "camera.yaml", "--out", "set", "--simulated")
    assert re.search(r"set: 1\d keypoints in 2 of 2 simulated photographs", done.stdout)
    assert kpbench.open_dataset("set").config["camera"]["K"] == board_photos.CAMERA.K.tolist()


def test_halves_that_do_not_agree_stop_the_labels_unless_forced():
    halves = Halves(np.ones(4), np.ones(4), 90.0, 1e-9)
    with pytest.raises(GateFailed, match="two halves of the photographs, solved apart, do not agree"):
        _judge_halves(halves, 30, "photos", force=False)
    with pytest.warns(KpbenchWarning, match="do not agree"):
        _judge_halves(halves, 30, "photos", force=True)


def test_a_board_without_marks_cannot_label(tmp_path):
    board = kpbench.hexagon_board(kpbench.shipped_patches()[0], 200.0)
    with pytest.raises(DataError, match="has no reference marks"):
        kpbench.label(tmp_path, board, tmp_path / "set")


def test_folders_tell_condition_and_rung():
    assert name_condition("a/blur/7/x.png") == ("blur", 7.0)
    assert name_condition("7/x.png")[0] == "free"


def test_score_knows_the_error_of_the_truth(labelled):
    truth = labelled.dataset.truth
    table = truth.keypoints.copy()
    table["sigma_x"] = table["sigma_y"] = 0.4
    table["sigma_x"][0] = 30.0  # as if a keypoint were known to 30 px only
    rng = np.random.default_rng(0)
    found, off = [], rng.normal(0, 0.5, (len(table), 2))
    off[0] = 40.0, 0.0
    for a, b in pairwise(truth.offsets):
        xy = np.stack([table["x"][a:b], table["y"][a:b]], axis=1) + off[a:b]
        own = np.tile(0.3**2 * np.eye(2), (b - a, 1, 1))
        found.append(kpbench.Detections(xy, np.ones(b - a), table["patch_id"][a:b], covariance=own))
    predictions = kpbench.Predictions.from_detections(found, truth.image_id)
    scores = kpbench.score(dataclasses.replace(truth, keypoints=table), predictions)
    assert scores.outcomes.matched.all()
    assert scores.outcomes.truth_limited.tolist() == [True] + [False] * (len(table) - 1)
    assert scores.to_dict()["dataset"]["truth"]["limited"] == 1
    assert 1.4 < scores["nees"] < 2.7, "0.4 and 0.3 px make 0.5 px"
    exact = kpbench.score(
        dataclasses.replace(truth, keypoints=table[list(kpbench.KEYPOINT_DTYPE.names)].astype(kpbench.KEYPOINT_DTYPE)),
        predictions,
    )
    assert not exact.outcomes.matched[0]
    assert "truth" not in exact.to_dict()["dataset"]


def test_share_of_the_image_and_tilt_are_measured():
    def measured(kind, depth_mm, tilt_deg=0.0):
        pose = PhotoPose(turn(np.radians([tilt_deg, 0.0, 0.0])), np.array([0.0, 0.0, depth_mm]))
        plain = dataclasses.replace(board_photos.CAMERA, distortion=(), principal_px=None)
        return measure_condition(kind, board_photos.BOARD, plain, pose, PrintShape())

    whole = board_photos.BOARD.side_x_mm * board_photos.BOARD.side_y_mm * 830 * 831 / (960 * 720)
    assert measured("scale", np.sqrt(whole / 0.16)) == ("scale", 16.0)
    assert measured("scale", np.sqrt(whole / 0.225))[0] == "free"
    assert measured("pitch", 900.0, 31.0) == ("pitch", 30.0)
    assert measured("pitch", 900.0, 35.0)[0] == "free"


def test_exif_turn_and_jpeg_quality_are_recorded_and_the_pixels_stay(photos, tmp_path):
    (tmp_path / "photos").mkdir()
    for n, (orientation, quality) in enumerate(((6, 92), (1, 80))):
        image = Image.open(photos[0] / f"0{n}.png")
        exif = Image.Exif()
        exif[0x0112] = orientation
        image.save(tmp_path / "photos" / f"{n}.jpg", quality=quality, exif=exif)
    kpbench.print_boards([board_photos.BOARD], tmp_path / "print", formats=["svg"])
    kpbench.write_camera(tmp_path / "camera.yaml", board_photos.CAMERA)
    done = run(
        "label", tmp_path / "photos", "--board", tmp_path / "print" / "truth.json",
        "--camera", tmp_path / "camera.yaml", "--out", tmp_path / "set",
    )  # fmt: skip
    assert "1 photographs are turned by their EXIF data; the dataset holds them as the sensor saw them" in done.stderr
    dataset = kpbench.open_dataset(tmp_path / "set")
    assert [(p["exif_turn"], p["jpeg_quality"]) for p in dataset.config["photos"]] == [(6, 92), (1, 80)]
    assert dataset.config["pixels_turned"] is False
    assert dataset.image(0).shape == (720, 960)
    table, true = match_truth(dataset, {f"{n}.jpg": photos[1][f"0{n}.png"] for n in range(2)})
    assert np.abs(table["x"] - true["x"]).max() < 0.1


def test_a_rolling_shutter_in_motion_is_flagged(photos, tmp_path):
    shutil.copytree(photos[0], tmp_path / "photos")
    image = cv2.imread(str(photos[0] / "01.png"), 0)
    y, x = np.mgrid[:720, :960].astype(np.float32)
    sheared = cv2.remap(image, x - 0.6 * (y / 720 - 0.5), y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    cv2.imwrite(str(tmp_path / "photos" / "01.png"), sheared)
    with pytest.warns(KpbenchWarning, match="two halves"):
        result = kpbench.label(tmp_path / "photos", board_photos.BOARD, tmp_path / "set", camera=board_photos.CAMERA)
    dataset = result.dataset
    rolling_px = {photo["name"]: photo["rolling_px"] for photo in dataset.config["photos"]}
    assert max(rolling_px, key=rolling_px.get) == "01.png"
    assert 0.3 < rolling_px["01.png"] < 0.9
    assert sorted(rolling_px.values())[2] == 0, "most are still"


def test_images_that_kpbench_wrote_never_become_photographs(photos, tmp_path):
    (tmp_path / "photos").mkdir()
    for name in ("01.png", "02.png"):
        image = cv2.imread(str(photos[0] / name), cv2.IMREAD_GRAYSCALE)
        (tmp_path / "photos" / name).write_bytes(encode_png(image, "simulated"))
    result = kpbench.label(tmp_path / "photos", board_photos.BOARD, tmp_path / "set", camera=board_photos.CAMERA)
    assert result.dataset.config["source"] == "simulated photographs"
