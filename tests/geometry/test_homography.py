import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kpbench.geometry.camera import Camera, plane_to_camera, rotation_xyz
from kpbench.geometry.homography import project, project_disc

angles = st.floats(-70, 70)


def homography(x_deg, y_deg, z_deg, depth):
    camera = Camera(640, 480, 700.0)
    return camera.K @ plane_to_camera(rotation_xyz(x_deg, y_deg, z_deg), [0.3, -0.2, depth])


@given(angles, angles, st.floats(0, 360), st.floats(3, 50))
def test_projected_disc_agrees_with_projected_rim_points(x_deg, y_deg, z_deg, depth):
    H = homography(x_deg, y_deg, z_deg, depth)
    ellipse = project_disc(H)
    t = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    rim = project(H, np.column_stack([np.cos(t), np.sin(t)]))
    c, s = np.cos(np.radians(ellipse.angle_deg)), np.sin(np.radians(ellipse.angle_deg))
    local = (rim - [ellipse.x, ellipse.y]) @ np.array([[c, -s], [s, c]])
    assert np.allclose((local[:, 0] / ellipse.major) ** 2 + (local[:, 1] / ellipse.minor) ** 2, 1, atol=1e-6)
    assert ellipse.major >= ellipse.minor > 0
    assert 0 <= ellipse.angle_deg < 180


def test_a_disc_that_reaches_the_horizon_is_refused():
    with pytest.raises(ValueError, match="horizon"):
        project_disc(homography(80, 0, 0, 0.5))


def test_the_principal_point_is_the_middle_of_the_pixel_grid():
    # 4 pixels have their centres at 0, 1, 2, 3: the middle is 1.5, not 2
    assert Camera(4, 2, 1.0).K[:2, 2].tolist() == [1.5, 0.5]


def test_rotation_turns_x_towards_y():
    assert np.allclose(rotation_xyz(0, 0, 90) @ [1, 0, 0], [0, 1, 0])
