"""The parts of the solver on points: derivatives, lenses, outliers, uncertainty, the field of residuals."""

import itertools

import numpy as np
import pytest
from scipy.special import erf

import kpbench
from kpbench.calibration import BoardPoints, MarkFinder, Photo, PrintShape
from kpbench.calibration.bundle import Bundle
from kpbench.calibration.camera_solution import solve_calibration
from kpbench.calibration.field import fit_field
from kpbench.calibration.observe import Observed
from kpbench.calibration.projection import camera_values, project_points, turn, with_values
from kpbench.calibration.start import solve_photos, start_camera
from kpbench.calibration.xcorners import refine_x_corners
from kpbench.errors import DataError
from kpbench.geometry import Camera

BOARD = kpbench.truth_board(kpbench.shipped_patches())
BOARD_MM = MarkFinder(BOARD).corners_mm
OTHER = Camera(1624, 1240, 900.0, (0.05, 0.0, 0.0, 0.0, 0.0))
BENT = PrintShape(0.01, 0.02, 1e-3, -5e-4, 7e-4)
LENSES = {
    "brown 5": ("brown", (-0.15, 0.05, 0.001, -0.001, 0.01)),
    "brown 8": ("brown", (-0.15, 0.05, 0.001, -0.001, 0.01, 0.02, -0.01, 0.0)),
    "brown 12": ("brown", (-0.15, 0.05, 0.001, -0.001, 0.01, 0.02, -0.01, 0.0, 1e-3, 2e-3, -1e-3, 1e-3)),
    "fisheye": ("fisheye", (0.02, -0.01, 0.004, 0.001)),
}


def lens_camera(name):
    model, coefficients = LENSES[name]
    return Camera(1624, 1240, 800.0, coefficients, model, (820.0, 610.0), 803.0)


@pytest.mark.parametrize("name", LENSES)
def test_derivatives_are_those_of_small_steps(name):
    camera, rotation, shift = lens_camera(name), turn(np.array([0.2, 0.5, -0.3])), np.array([10.0, -20.0, 400.0])
    points = np.random.default_rng(0).uniform(-100, 100, (7, 2))

    def at(camera=camera, rotation=rotation, shift=shift, shape=BENT, points=points):
        return project_points(camera, rotation, shift, shape.bend(points))

    def check(found, plus, minus, step):
        np.testing.assert_allclose((plus.xy - minus.xy) / (2 * step), found, rtol=2e-4, atol=2e-3)

    exact, values = at(), camera_values(camera)
    for j, unit in enumerate(np.eye(len(values))):
        step = 1e-6 * max(1.0, abs(values[j]))
        plus, minus = (at(camera=with_values(camera, values + s * step * unit)) for s in (1, -1))
        check(exact.by_camera[:, :, j], plus, minus, step)
    for j, unit in enumerate(np.eye(5)):
        step = 1e-6 if j < 2 else 1e-8
        plus, minus = (at(shape=PrintShape(*(BENT.values + s * step * unit))) for s in (1, -1))
        check(exact.by_shape[:, :, j], plus, minus, step)
    for j, unit in enumerate(1e-6 * np.eye(3)):
        check(exact.by_pose[:, :, j], at(rotation=turn(unit) @ rotation), at(rotation=turn(-unit) @ rotation), 1e-6)
        check(exact.by_pose[:, :, 3 + j], at(shift=shift + unit), at(shift=shift - unit), 1e-6)
    for j, unit in enumerate(1e-6 * np.eye(2)):
        check(exact.by_point[:, :, j], at(points=points + unit), at(points=points - unit), 1e-6)


def simulate(seed, camera, photos=10, outliers=0.0):
    """Seen points with known errors, and the shape of the print."""
    rng = np.random.default_rng(seed)
    shape = PrintShape(*(rng.normal(size=2) * 2e-3), *(rng.normal(size=3) * 1e-4))
    found = []
    while len(found) < photos:
        rotation = turn(np.array([0.0, 0.0, rng.uniform(-3, 3)])) @ turn(np.append(rng.uniform(-0.7, 0.7, 2), 0.0))
        depth = rng.uniform(250, 500)
        shift = np.append((rng.uniform([400, 300], [1200, 900]) - camera.K[:2, 2]) / camera.focal_px * depth, depth)
        xy = project_points(camera, rotation, shift, shape.bend(BOARD_MM)).xy
        rows = np.flatnonzero(((xy > 5) & (xy < [1619, 1235])).all(axis=1))[::3]
        if len(rows) < 40:
            continue
        sigma = rng.uniform(0.015, 0.03, len(rows))
        seen = xy[rows] + rng.normal(size=(len(rows), 2)) * sigma[:, None]
        wrong = rng.random(len(rows)) < outliers
        seen[wrong] += rng.normal(0, 3, (int(wrong.sum()), 2))
        found.append(BoardPoints(rows, seen, sigma[:, None, None] ** 2 * np.eye(2)))
    return found, shape


def solve(points, camera) -> Bundle:
    size = (camera.width_px, camera.height_px)
    start = start_camera(points, BOARD_MM, size, camera.model, len(camera.distortion))
    return solve_photos(points, BOARD_MM, start)


@pytest.mark.parametrize("name", ["brown 5", "brown 8", "fisheye"])
def test_lens_and_print_are_found_within_their_uncertainty_beside_outliers(name):
    camera = lens_camera(name)
    points, shape = simulate(1, camera, outliers=0.03)
    bundle = solve(points, camera)
    error = np.concatenate([camera_values(bundle.camera) - camera_values(camera), bundle.shape.values - shape.values])
    sigma = np.sqrt(np.diag(bundle.covariance))
    told = np.r_[0:4, -5:0] if name == "brown 8" else slice(None)  # k1 and k4 mean nearly the same
    assert (np.abs(error[told]) < 4.5 * sigma[told]).all()
    assert np.sqrt(np.diag(bundle.covariance))[0] < 0.2
    left_out = 1 - np.mean([inlier.mean() for inlier in bundle.inlier])
    assert 0.02 < left_out < 0.05


def test_the_stated_uncertainty_is_right():
    camera = lens_camera("brown 5")
    nees = []
    for seed in range(12):
        points, _ = simulate(seed, camera, photos=8)
        bundle = solve_photos(points, BOARD_MM, camera)
        error = (camera_values(bundle.camera) - camera_values(camera))[:4]
        nees.append(error @ np.linalg.solve(bundle.covariance[:4, :4], error))
    assert 2.0 < np.mean(nees) < 6.5, "4 is right; the mean of twelve scatters by 0.8"


def test_photographs_of_two_cameras_are_noticed():
    parts = [simulate(seed, camera, photos=8)[0] for seed, camera in ((1, lens_camera("brown 5")), (2, OTHER))]
    observed = [Observed(Photo(f"{n}", (1624, 1240), 1, None, ""), p) for n, p in enumerate(itertools.chain(*parts))]
    try:
        found = solve_calibration(observed, BOARD, "brown", 5, "photos")
    except DataError:
        return
    assert found.halves.p < 1e-3 or len(found.used) <= 10


def test_a_known_camera_stays_as_it_is():
    camera = lens_camera("brown 5")
    points, shape = simulate(3, camera, photos=4)
    bundle = solve_photos(points, BOARD_MM, camera, solve_camera=False)
    assert bundle.camera == camera
    assert not bundle.covariance[:9].any()
    assert abs(bundle.shape.ratio - shape.ratio) < 5 * np.sqrt(bundle.covariance[9, 9])


@pytest.mark.parametrize("gamma", [1.0, 2.4])
@pytest.mark.parametrize("blur_px", [0.8, 2.0])
def test_no_tone_curve_blur_or_light_moves_a_corner(gamma, blur_px):
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:60, :60]
    for _ in range(5):
        corner, angle = 29.5 + rng.uniform(-0.5, 0.5, 2), rng.uniform(0, np.pi)
        A = 3 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        u, v = np.einsum("ij,jhw->ihw", A.T / 3, np.stack([x - corner[0], y - corner[1]]))
        light = 0.5 + 0.45 * erf(u / blur_px / np.sqrt(2)) * erf(v / blur_px / np.sqrt(2))
        image = 255 * (light * (0.7 + 0.005 * x)) ** (1 / gamma)
        found = refine_x_corners(np.rint(image).astype(np.uint8), corner[None] + rng.uniform(-1, 1, 2), A[None], 3.5)
        assert found.is_found.all()
        assert np.hypot(*(found.xy[0] - corner)) < 0.02


def test_a_straight_edge_and_noise_are_no_corners():
    x = np.arange(60) - 29.3
    edge = np.tile(128 + 100 * erf(x), (60, 1)).astype(np.uint8)
    noise = np.random.default_rng(1).integers(0, 256, (60, 60)).astype(np.uint8)
    for image in (edge, noise):
        assert not refine_x_corners(image, np.array([[30.0, 30.0]]), 3 * np.eye(2)[None], 3.5).is_found.any()


def field_of_marks(seed, amplitude=0.1):
    rng = np.random.default_rng(seed)
    at = rng.uniform(-100, 100, (120, 2))
    smooth = lambda p: amplitude * np.stack([np.sin(p[:, 0] / 40) * p[:, 1] / 80, np.cos(p[:, 1] / 50)], axis=1)  # noqa: E731
    by_pose = rng.normal(size=(120, 2, 1)) * 0 + np.concatenate(
        [np.tile(np.eye(2), (120, 1, 1)), np.zeros((120, 2, 4))], 2
    )
    by_pose[:, :, 2:4], by_pose[:, :, 4:6] = at[:, :1, None] * np.eye(2), at[:, 1:, None] * np.eye(2)
    return rng, at, smooth, by_pose


def test_the_field_of_residuals_is_predicted_with_its_uncertainty():
    nees = []
    for seed in range(6):
        rng, at, smooth, by_pose = field_of_marks(seed)
        residual = smooth(at) + rng.normal(0, 0.01, at.shape)
        field = fit_field(at[:100], residual[:100], np.full(100, 1e-4), by_pose[:100])
        found = field.predict(at[100:], by_pose[100:])
        error = found.mean - smooth(at[100:])
        assert np.sqrt((error**2).mean()) < 0.02
        nees.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error).mean())
    assert 0.8 < np.mean(nees) < 4.0


def test_leaving_out_is_what_a_fit_without_the_mark_predicts():
    rng, at, smooth, by_pose = field_of_marks(2)
    residual = smooth(at) + rng.normal(0, 0.01, at.shape)
    field = fit_field(at, residual, np.full(120, 1e-4), by_pose)
    group = np.arange(120) // 4
    left = field.leave_one_out(residual, group)
    one = fit_field(at[4:], residual[4:], np.full(116, 1e-4), by_pose[4:]).predict(at[:4], by_pose[:4])
    np.testing.assert_allclose(left.error[:4], residual[:4] - one.mean, atol=4e-3)
