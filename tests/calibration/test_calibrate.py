"""Calibration from photographs: the camera, rejected photographs, the page, the command."""

import shutil

import board_photos
import cv2
import numpy as np
import pytest
from helpers import kpbench as run

import kpbench
from kpbench.calibration.page import to_page
from kpbench.errors import DataError


@pytest.fixture(scope="module")
def calibration(photos):
    return kpbench.calibrate(photos[0], board_photos.BOARD)


def test_the_camera_is_found_within_its_uncertainty(calibration):
    true, found = board_photos.CAMERA.K, calibration.camera.K
    names = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    for name, place in names.items():
        assert abs(found[place] - true[place]) < 5 * calibration.sigma[name]
        assert calibration.sigma[name] < 0.1
    assert np.median(calibration.bundle.rms_px()) < 0.05
    assert len(calibration.used) == 6
    assert calibration.coverage().sum() > 1200


def test_the_page_holds_all_photographs_and_loads_nothing(calibration):
    page = to_page(calibration)
    assert all(o.photo.name in page for o in calibration.observed)
    assert "http" not in page
    assert "<script" not in page


def test_every_photograph_that_is_left_out_has_a_reason(photos, tmp_path):
    folder = tmp_path / "photos"
    shutil.copytree(photos[0], folder)
    image = cv2.imread(str(folder / "00.png"))
    cv2.imwrite(str(folder / "small.png"), cv2.resize(image, None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA))
    cv2.imwrite(str(folder / "turned.png"), cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE))
    cv2.imwrite(str(folder / "mirrored.png"), image[:, ::-1])
    cv2.imwrite(str(folder / "twice.png"), np.hstack([image[:, ::2], image[:, ::2]]))
    cv2.imwrite(str(folder / "noise.png"), np.random.default_rng(0).integers(0, 256, image.shape, np.uint8))
    other = kpbench.truth_board(kpbench.shipped_patches()[::-1], 20.0)
    cv2.imwrite(str(folder / "zoomed.png"), cv2.warpAffine(image, np.array([[1.3, 0, -150], [0, 1.0, 0]]), (960, 720)))
    (folder / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    assert other.references
    result = kpbench.calibrate(folder, board_photos.BOARD)
    reasons = {o.photo.name: o.reason for o in result.observed if o.reason}
    twice = reasons.pop("twice.png")
    assert twice in ("two-boards", "no-marks", "wrong-board", "few-points")
    zoomed = reasons.pop("zoomed.png")
    assert zoomed in ("does-not-fit", "outliers")
    assert reasons == {
        "small.png": "other-size",
        "turned.png": "other-size",
        "mirrored.png": "no-marks",
        "noise.png": "no-marks",
        "broken.png": "broken",
    }


def test_a_board_without_marks_is_found_by_its_patches(tmp_path):
    board = kpbench.grid_board(kpbench.shipped_patches(), rows=4, columns=5, diameter_mm=30.0, pitch_mm=45.0)
    board_photos.write_photos(tmp_path / "photos", 5, board=board, area=60.0)
    result = kpbench.calibrate(tmp_path / "photos", board, coefficients=0)
    assert len(result.used) >= 4
    assert abs(result.camera.focal_px / board_photos.CAMERA.focal_px - 1) < 0.05


def test_too_few_photographs_are_refused_with_the_reasons(tmp_path):
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos" / "a.png"), np.zeros((100, 100), np.uint8))
    with pytest.raises(
        DataError, match=r"0 of 1 photographs show the board, expected at least 3 \(rejected: no-marks 1"
    ):
        kpbench.calibrate(tmp_path / "photos", board_photos.BOARD)


def test_the_command_writes_a_camera_that_is_read_back(photos, here):
    run("render-patches", "--board", "truth", "--svg")
    command = ("calibrate", photos[0], "--board", "patches-print/truth.json", "--format", "kalibr")
    done = run(*command, "--coefficients", "4", "--report", "page.html")
    assert "6 of 6 photographs" in done.stdout
    assert abs(kpbench.read_camera("camera.yaml").focal_px - board_photos.CAMERA.focal_px) < 0.3
    assert (here / "page.html").read_text().startswith("<!doctype html>")
