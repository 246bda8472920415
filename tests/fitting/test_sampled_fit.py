"""The sampled fit, beside the truth and beside the design fit."""

import numpy as np
import pytest

import kpbench
from kpbench.fitting import build_pyramid
from kpbench.fitting.sampled_fit import fit_samples
from kpbench.geometry import Camera
from kpbench.render import Appearance, Pose, render_board
from kpbench.synth.suite_boards import mixed_board

CAMERA, BOARD = Camera(406, 310, 222.2), mixed_board(kpbench.shipped_patches())
PATCHES = [k.patch for k in BOARD.keypoints]


def scene(seed, sigma):
    rng = np.random.default_rng(seed)
    a, b = 0.3 * rng.uniform(-1, 1, 2)
    tilt = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    turn = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    pose = Pose(tilt @ turn, np.array([*rng.uniform(-20, 20, 2), 220.0]))
    made = render_board(np.full((310, 406), 110, np.uint8), CAMERA, pose, BOARD, Appearance(30, 220))
    image = np.clip(np.rint(made.image + rng.normal(0, sigma, made.image.shape)), 0, 255).astype(np.float32)
    H = made.keypoints["H_patch2image"]
    xy = np.column_stack([made.keypoints["x"], made.keypoints["y"]])
    A = H[:, :2, :2] - xy[:, :, None] * H[:, 2:, :2]
    return image, xy, A, H[:, 2, :2] / H[:, 2, 2:], rng


@pytest.mark.parametrize("sigma", [0.5, 6])
def test_centres_are_as_exact_as_those_of_the_design_fit(sigma):
    errors, exact, nees = [], [], []
    for seed in range(6):
        image, xy, A, bend, rng = scene(seed, sigma)
        start = xy + rng.uniform(-0.6, 0.6, xy.shape)
        found = fit_samples(image, start, 1.03 * A, bend, PATCHES, np.full(6, 0.6), 3)
        off = found.xy - xy
        errors += [*np.linalg.norm(off, axis=1)]
        nees += [*np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance), off)]
        fit = kpbench.fit(build_pyramid(image.astype(np.uint8), 0), start, A, PATCHES)
        exact += [*np.linalg.norm(fit.xy - xy, axis=1)]
        assert found.ncc.min() > 0.9
    assert np.mean(errors) < 1.5 * np.mean(exact) + 0.02  # px; edges of these images are as sharp as pixels
    assert 0.3 < np.mean(nees) < 4  # 2 for a true covariance


def test_an_even_surface_is_no_patch_and_has_no_exact_place():
    image = np.full((100, 100), 90, np.float32)
    start = np.array([[50.0, 50.0]]), 20 * np.eye(2)[None], np.zeros((1, 2))
    found = fit_samples(image, *start, PATCHES[:1], np.array([0.6]))
    assert found.ncc[0] < 0.5
    assert found.covariance[0, 0, 0] > 1
