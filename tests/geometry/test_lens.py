"""The lens against OpenCV, which shares no code with it."""

import cv2
import numpy as np
import pytest

from kpbench.geometry.camera import Camera
from kpbench.geometry.lens import Lens

RAYS = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
BROWN = [
    (),
    (-0.3, 0.1, 0.001, -0.002),
    (-0.3, 0.1, 0.001, -0.002, 0.01),
    (0.5, 0.1, 0.001, -0.002, 0.01, 0.7, 0.1, 0.02),
    (0.5, 0.1, 0.001, -0.002, 0.01, 0.7, 0.1, 0.02, 0.003, -0.002, 0.001, 0.0005),
]
FISHEYE = [(0.0, 0.0, 0.0, 0.0), (0.05, -0.02, 0.01, -0.003), (-0.1, 0.02, -0.01, 0.002)]
CAMERAS = [Camera(640, 480, 500.0, d) for d in BROWN]
CAMERAS += [Camera(640, 480, 300.0, d, "fisheye", principal_px=(310.2, 250.1)) for d in FISHEYE]


def of_opencv(camera, rays):
    points, zero, distortion = np.column_stack([rays, np.ones(len(rays))]), np.zeros(3), np.array(camera.distortion)
    if camera.model == "fisheye":
        return cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.K, distortion)[0].reshape(-1, 2)
    return cv2.projectPoints(points, zero, zero, camera.K, distortion if len(distortion) else None)[0].reshape(-1, 2)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: f"{c.model}-{len(c.distortion)}")
def test_a_lens_distorts_as_opencv_does_and_undistorts(camera):
    rays = np.vstack([(2.5 if camera.model == "fisheye" else 1.0) * RAYS, [[0.0, 0.0]]])
    points = camera.distort(rays)
    assert np.abs(points - of_opencv(camera, rays)).max() < 1e-9
    assert np.abs(camera.undistort(points) - rays).max() < 1e-12
    h = 1e-6
    ends = [(camera.distort(rays + d) - camera.distort(rays - d)) / (2 * h) for d in np.eye(2) * h]
    assert np.abs(camera.focal_px * camera.lens.jacobian(rays) - np.stack(ends, axis=-1)).max() < 1e-5
    assert np.allclose(camera.local_K(rays[3]) @ [*rays[3], 1], [*points[3], 1])


def test_a_point_outside_the_valid_region_is_an_error():
    camera = Camera(640, 480, 300.0, (-0.5, 0.0, 0.0, 0.0))
    assert np.isclose(camera.lens.largest_radius, np.sqrt(1 / 1.5))
    rim = camera.distort(np.array([[0.999 * camera.lens.largest_radius, 0.0]]))
    assert np.isclose(camera.undistort(rim)[0, 0], 0.999 * camera.lens.largest_radius)
    with pytest.raises(ValueError, match="no image of an ideal ray"):
        camera.undistort([[0.0, 0.0]])
    with pytest.raises(ValueError, match="no image of an ideal ray"):
        Lens("fisheye", (0.0, 0.0, 0.0, 0.0)).undistort([[1.6, 0.0]])  # more than a right angle from the axis
    with pytest.raises(ValueError, match="expected 4"):
        Camera(640, 480, 300.0, (0.1,), "fisheye").distort(RAYS)
