"""The covariance of a fitted centre against the errors of many draws of noise."""

import cv2
import numpy as np
import pytest
from helpers import rotation

import kpbench
from kpbench.detectors import verification
from kpbench.detectors.superpoint import SmallSuperPointDetector
from kpbench.fitting.covariance import start_covariance
from kpbench.fitting.design_fit import fit
from kpbench.fitting.pyramid import build_pyramid
from kpbench.patches.design import shipped_patches
from kpbench.render.placement import Placement
from kpbench.render.scene import render_scene

PATCHES = shipped_patches()
CHECKER, TREFOIL, WHEEL, MUSHROOM = range(4)


def render_design(patch, A, blur):
    side = int(2.5 * np.linalg.norm(A, 2)) + 24
    xy, H = np.array([side / 2 - 0.2, side / 2 - 0.7]), np.eye(3)
    H[:2, :2], H[:2, 2] = A, xy
    image = render_scene(np.full((side, side), 120, np.uint8), [Placement(patch, H, 60, 190)]).image
    return cv2.GaussianBlur(image.astype(np.float64), (0, 0), blur), xy


def draw_errors(patch, A, blur, noise, draws):
    """Return errors (draws, 2) and covariances (draws, 2, 2) of fits that start near the truth."""
    rng, (clean, xy), found = np.random.default_rng(7), render_design(patch, A, blur), []
    for _ in range(draws):
        image = np.clip(np.rint(clean + rng.normal(0, noise, clean.shape)), 0, 255).astype(np.uint8)
        start = xy + A @ rng.normal(0, 0.01, 2), A @ (np.eye(2) + rng.normal(0, 0.003, (2, 2)))
        found.append(fit(build_pyramid(image, 0), start[0][None], start[1][None], [patch]))
    return np.concatenate([f.xy for f in found]) - xy, np.concatenate([f.covariance for f in found])


def mean_nees(errors, covariances):
    return np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors).mean()


@pytest.mark.parametrize("design", [CHECKER, TREFOIL, WHEEL, MUSHROOM])
@pytest.mark.parametrize(("radius", "blur", "noise"), [(6, 0.7, 5), (12, 1.0, 5), (30, 2.0, 15), (40, 1.0, 10)])
def test_the_covariance_is_that_of_the_errors(design, radius, blur, noise):
    errors, covariances = draw_errors(PATCHES[design], radius * rotation(20), blur, noise, 50)
    predicted = np.median(np.trace(covariances, axis1=1, axis2=2))
    assert 0.6 < predicted / np.trace(np.cov(errors.T)) < 2.5
    assert 0.9 < mean_nees(errors, covariances) < 2.9


@pytest.mark.parametrize("design", [TREFOIL, WHEEL, MUSHROOM])
def test_the_directions_of_a_tilted_patch_are_right(design):
    """Measured in units of the predicted deviations, errors have the same size in every direction."""
    A = rotation(30) @ np.diag([30.0, 10.0])
    errors, covariances = draw_errors(PATCHES[design], A, 1.0, 10, 80)
    sample, predicted = np.cov(errors.T), np.median(covariances, axis=0)
    ratio = np.sort(np.linalg.eigvals(np.linalg.solve(predicted, sample)).real)
    assert 0.4 < ratio[0] < ratio[1] < 1.8
    assert sample[0, 1] * predicted[0, 1] > 0
    assert np.linalg.cond(predicted) > 3


@pytest.mark.parametrize("design", [TREFOIL, WHEEL])
def test_a_large_patch_which_is_fitted_in_a_coarser_level_has_the_covariance_of_the_image(design):
    """One octave too few or too many would be a factor of 4."""
    errors, covariances = draw_errors(PATCHES[design], 150 * rotation(20), 1.5, 20, 25)
    ratio = np.median(np.trace(covariances, axis1=1, axis2=2)) / np.trace(np.cov(errors.T))
    assert 0.6 < ratio < 2.4


def test_light_that_falls_off_does_not_move_the_centre():
    """Without the light among the unknowns, the centre moves by 0.05 px."""
    clean, xy = render_design(PATCHES[WHEEL], 25.0 * rotation(20), 1.0)
    sloped = clean * (1 + 0.1 * (np.arange(clean.shape[1]) - xy[0]) / 25)
    noisy = np.rint(sloped + np.random.default_rng(0).normal(0, 1, clean.shape)).astype(np.uint8)
    found = fit(build_pyramid(noisy, 0), xy[None], 25.0 * rotation(20)[None], [PATCHES[WHEEL]])
    assert np.hypot(*(found.xy[0] - xy)) < 0.03


def test_motion_blur_widens_the_covariance_by_what_it_moves_the_centre():
    clean, xy = render_design(PATCHES[WHEEL], 25.0 * rotation(20), 1.0)
    moved = cv2.filter2D(clean, -1, np.full((1, 7), 1 / 7))
    image = np.rint(moved + np.random.default_rng(0).normal(0, 1, clean.shape)).astype(np.uint8)
    found = fit(build_pyramid(image, 0), xy[None], 25.0 * rotation(20)[None], [PATCHES[WHEEL]])
    error = found.xy[0] - xy
    assert error @ np.linalg.solve(found.covariance[0], error) < 9


@pytest.mark.parametrize("patch", PATCHES[:2], ids=lambda patch: patch.name)
def test_a_lens_that_bends_does_not_move_the_centre(patch):
    """Brown's k1 = -0.2 in an image 400 px wide, 150 px from its middle: the rim moves by up to 0.3 px."""
    A, xy, factor = 30.0 * rotation(20), np.array([350.0, 200.0]), 4
    middle, focal = np.array([199.5, 199.5]), 400.0
    y, x = (np.mgrid[: 80 * factor, : 80 * factor] + 0.5) / factor - 0.5
    seen = np.stack([x + 310, y + 160], axis=-1)
    from_centre = seen - xy
    bent = -0.2 / focal**2 * (from_centre**2).sum(axis=-1)[..., None] * (xy - middle)
    uv = (from_centre - bent) @ np.linalg.inv(A).T
    ink = np.where(np.hypot(*np.moveaxis(uv, -1, 0)) > 1, 0.5, patch.is_black(uv))
    grey = cv2.GaussianBlur(190 - 130 * cv2.resize(ink, (80, 80), interpolation=cv2.INTER_AREA), (0, 0), 0.8)
    image = np.full((400, 400), 125.0)
    image[160:240, 310:390] = grey
    found = fit(build_pyramid(np.rint(image).astype(np.uint8), 0), xy[None] + 0.1, A[None], [patch])
    assert np.hypot(*(found.xy[0] - xy)) < 0.025


def test_without_a_step_the_covariance_is_that_of_the_start():
    A = np.array([[12.0, 3.0], [0.0, 7.0]])
    found = fit(build_pyramid(np.full((60, 60), 90, np.uint8), 0), np.array([[30.0, 30.0]]), A[None], PATCHES[:1])
    np.testing.assert_allclose(found.covariance[0], start_covariance(A))


def test_a_patch_keeps_its_relative_covariance_when_the_image_is_enlarged():
    variance = np.zeros((2, 8))
    for scale in (1, 2):
        A = 20.0 * scale * np.eye(2)
        clean, xy = render_design(PATCHES[TREFOIL], A, 1.0 * scale)
        for seed in range(8):
            noise = np.random.default_rng(seed).normal(0, 8, clean.shape)
            noisy = np.clip(np.rint(clean + noise), 0, 255).astype(np.uint8)
            found = fit(build_pyramid(noisy, 0), xy[None], A[None], [PATCHES[TREFOIL]])
            variance[scale - 1, seed] = np.trace(found.covariance[0])
    # twice the edge length has twice the pixels across and along the edges, and half the slope: 2² / (2 · 2) = 1
    assert 0.6 < variance[1].mean() / variance[0].mean() < 1.7


@pytest.fixture(scope="module")
def image():
    clean, _ = render_design(PATCHES[TREFOIL], 20.0 * rotation(20), 1.0)
    noise = np.random.default_rng(1).normal(0, 4, clean.shape)
    return np.clip(np.rint(clean + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", ["superpoint-small", "superpoint", "template"])
def test_the_shipped_detectors_fill_frame_covariance_and_blur(name, image):
    found = kpbench.load_detector(name)(image)
    assert len(found) == 1
    assert np.linalg.norm(found.A_patch2image[0], 2) == pytest.approx(20, rel=0.1)
    assert 0.002 < np.sqrt(np.trace(found.covariance[0]) / 2) < 0.05
    assert found.blur_px[0] == pytest.approx(1.0, abs=0.2)


def test_without_verification_there_is_no_covariance(image):
    found = SmallSuperPointDetector(verified=False)(image)
    assert found.A_patch2image is found.covariance is found.blur_px is None


def test_a_centre_that_keeps_its_pose_before_the_fit_has_the_wide_covariance_of_that_pose(image, monkeypatch):
    fitted = SmallSuperPointDetector()(image)
    monkeypatch.setattr(verification, "LARGEST_FIT_MOVE", -1.0)
    kept = SmallSuperPointDetector(threshold=0.0)(image)[:1]
    np.testing.assert_allclose(kept.covariance, start_covariance(kept.A_patch2image))
    assert np.trace(kept.covariance[0]) > 100 * np.trace(fitted.covariance[0])
