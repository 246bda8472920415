"""Calibration files: against OpenCV's own reader, and against damage."""

import cv2
import numpy as np
import pytest

from kpbench.errors import DataError
from kpbench.geometry import Camera, read_camera, write_camera

BROWN = [(), (-0.2, 0.05, 1e-3, -2e-5), (-0.2, 0.05, 1e-3, 0.0, 0.01), (-0.2, 0.05, 0.001, 0.0, 0.01, 0.1, 0.0, 3e-7)]
CAMERAS = [Camera(640, 480, 500.25, d, principal_px=(320.5, 239.0), focal_y_px=501.0) for d in BROWN]
CAMERAS += [Camera(1280, 800, 300.0, (0.1, -0.02, 0.003, -1e-4), "fisheye", (640.0, 400.5))]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: f"{c.model}-{len(c.distortion)}")
@pytest.mark.parametrize(("form", "name"), [("opencv", "a.yaml"), ("opencv", "a.json"), ("ros", "a.yml")])
def test_a_camera_survives_and_opencv_reads_it(tmp_path, camera, form, name):
    path = tmp_path / name
    write_camera(path, camera, form)
    write_camera(path, camera, form)  # its own file may be replaced
    assert read_camera(path) == camera
    if form == "opencv":
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        assert np.array_equal(file.getNode("camera_matrix").mat(), camera.K)
        assert file.getNode("image_width").real() == camera.width_px
        if camera.distortion:
            assert np.array_equal(file.getNode("distortion_coefficients").mat().ravel(), camera.distortion)


@pytest.mark.parametrize("suffix", ["yaml", "json"])
@pytest.mark.parametrize("is_fisheye", [False, True])
def test_what_opencv_writes_is_read(tmp_path, suffix, is_fisheye):
    path = tmp_path / f"calibration.{suffix}"
    K, distortion = np.array([[512.5, 0, 310.25], [0, 513, 244], [0, 0, 1]]), np.array([[-0.2, 0.05, 1e-8, 2e-3]])
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("calibration_time", "Mon Nov 30 12:00:00 2026")
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.write("fisheye_model", int(is_fisheye))
    file.write("camera_matrix", K)
    file.write("distortion_coefficients", distortion if is_fisheye else np.append(distortion, 0.125)[:, None])
    file.write("per_view_reprojection_errors", np.ones((3, 1), np.float32))
    file.release()
    camera = read_camera(path)
    assert np.array_equal(camera.K, K)
    assert (camera.width_px, camera.height_px, camera.model) == (640, 480, "fisheye" if is_fisheye else "brown")
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + np.array([0, 0, 3])
    if is_fisheye:
        expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, distortion)
    else:
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.append(distortion, 0.125))
    assert np.abs(camera.project(points) - expected.reshape(-1, 2)).max() < 1e-9


KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.29, 0.08, 1.5e-4, 2e-05]
  distortion_model: radtan
  intrinsics: [461.6, 460.3, 362.7, 248.1]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""
ROS = """image_width: 640
image_height: 480
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [430.21, 0., 306.69, 0., 430.53, 227.22, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.337, 0.111, 1e-05, -0.000131, 0.0]
"""


def test_kalibr_and_ros_files_are_read(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(KALIBR)
    camera = read_camera(path)
    assert camera == Camera(752, 480, 461.6, (-0.29, 0.08, 1.5e-4, 2e-5), "brown", (362.7, 248.1), 460.3)
    out = tmp_path / "out.yaml"
    write_camera(out, camera, "kalibr")
    assert read_camera(out) == camera
    path.write_text(ROS)
    assert read_camera(path).distortion == (-0.337, 0.111, 1e-5, -0.000131, 0.0)


@pytest.mark.parametrize(
    ("text", "old", "new", "says"),
    [
        (ROS, "image_width: 640", "image_width: 0", "image_width is 0, expected a whole number from 1"),
        (ROS, "image_height: 480", "", "image_height is missing"),
        (ROS, "430.21,", "430.21, 4.5,", "camera_matrix has 10 numbers, expected 9"),
        (ROS, "[430.21, 0.,", "[430.21, 0.5,", "camera_matrix is no"),
        (ROS, "430.21,", "-430.21,", "the focal lengths are -430.21 and 430.53 px"),
        (ROS, "430.21,", ".nan,", r"camera_matrix.data\[0\] is nan"),
        (ROS, "[-0.337, ", "[-0.337, 0, ", "distortion_coefficients has 6 numbers, expected 0 or 4 or 5 or 8"),
        (ROS, "plumb_bob", "thin_prism", "distortion_model is 'thin_prism', expected one of: plumb_bob"),
        (ROS, "camera_matrix:", "matrix:", "camera_matrix is missing, expected the keys of OpenCV, ROS or Kalibr"),
        (KALIBR, "pinhole", "omni", "cam0.camera_model is 'omni', expected 'pinhole'"),
        (KALIBR, "[752, 480]", "[752]", r"cam0.resolution is \[752\], expected \[width, height\]"),
        (KALIBR, "461.6, ", "", "cam0.intrinsics has 3 numbers, expected 4"),
        (KALIBR, "cam0:", "cam0: &a", None),
        (KALIBR, "rostopic:", "other: *a\n  rostopic:", "no calibration file of OpenCV, ROS or Kalibr"),
        (KALIBR, KALIBR, KALIBR + KALIBR.replace("cam0", "cam1"), r"holds 2 cameras \(cam0, cam1\), expected one"),
        (KALIBR, KALIBR, "[" * 2000, "no calibration file"),
        (KALIBR, KALIBR, "a: !!python/object/apply:os.system [ls]", "no calibration file"),
        (KALIBR, KALIBR, "", "no calibration file"),
        (ROS, "camera_matrix:\n  rows: 3", "camera_matrix: !!opencv-matrix 3\nx:\n  rows: 3", "no calibration file"),
    ],
)
def test_a_wrong_calibration_is_one_line(tmp_path, text, old, new, says):
    assert old in text
    path = tmp_path / "bad.yaml"
    path.write_text(text.replace(old, new, 1))
    if says is None:
        assert read_camera(path).width_px == 752
        return
    with pytest.raises(DataError, match=says) as error:
        read_camera(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_damaged_calibrations_raise_one_line_or_are_read(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "damaged.yaml"
    whole = [ROS.encode(), KALIBR.encode()]
    write_camera(tmp_path / "cv.yaml", CAMERAS[2])
    whole.append((tmp_path / "cv.yaml").read_bytes())
    for n in range(300):
        data = bytearray(whole[n % 3])
        for _ in range(int(rng.integers(1, 4))):
            place, end = sorted(rng.integers(0, len(data), 2).tolist())
            change = int(rng.integers(3))
            if change == 0:
                data[place] = int(rng.integers(256))
            elif change == 1:
                del data[place : min(end, place + 40)]
            else:
                data[place:place] = data[place : min(end, place + 40)]
        path.write_bytes(bytes(data))
        problem = ""
        try:
            read_camera(path)
        except DataError as error:
            problem = str(error)
        assert "\n" not in problem


def test_only_whole_number_scales_are_other_sizes():
    camera = CAMERAS[1]
    double = camera.at_size(1280, 960)
    points = np.array([[0.1, -0.2, 1.0], [-0.4, 0.3, 1.2]])
    # the corner of the image is at (-0.5, -0.5) px in every size
    assert np.allclose(double.project(points) + 0.5, 2 * (camera.project(points) + 0.5))
    back = double.at_size(640, 480)
    assert np.allclose(back.K, camera.K)
    assert camera.at_size(640, 480) is camera
    for size in [(960, 720), (1280, 480), (480, 640)]:
        with pytest.raises(DataError, match="expected the camera's 640x480 or a whole-number scale of it"):
            camera.at_size(*size)


def test_kalibr_has_no_fifth_coefficient(tmp_path):
    with pytest.raises(DataError, match="radtan has 4 coefficients"):
        write_camera(tmp_path / "a.yaml", CAMERAS[2], "kalibr")
