import cv2
import numpy as np
import pytest
from helpers import rotation
from hypothesis import given, settings
from hypothesis import strategies as st

from kpbench.fitting.align import align_poses, rotate_within_ellipse, short_semi_axis
from kpbench.fitting.pyramid import build_pyramid
from kpbench.fitting.sector_search import CORE_RADIUS_PX, estimate_size, search_sectors
from kpbench.fitting.templates import VIEW_PX, VIEW_REACH, build_templates
from kpbench.fitting.views import blur_views, rectify
from kpbench.patches.design import shipped_patches
from kpbench.render.placement import Placement
from kpbench.render.scene import render_scene

PATCHES = shipped_patches()
TEMPLATES = build_templates(PATCHES)


def render_design(number, A, xy, size=120):
    H = np.eye(3)
    H[:2, :2], H[:2, 2] = A, xy
    background = np.random.default_rng(number).integers(60, 180, (size, size), dtype=np.uint8)
    return render_scene(background, [Placement(PATCHES[number], H, 40, 210)]).image


@settings(deadline=None, max_examples=25)
@given(
    number=st.integers(0, len(PATCHES) - 1),
    radius=st.floats(12, 30),
    tilt=st.floats(0.5, 1.0),
    first=st.floats(0, 360),
    second=st.floats(0, 360),
    off=st.tuples(st.floats(-0.12, 0.12), st.floats(-0.12, 0.12)),
)
def test_any_pose_of_any_design_is_found_from_a_rough_place(number, radius, tilt, first, second, off):
    xy, A = np.array([60.3, 59.6]), rotation(first) @ np.diag([radius, radius * tilt]) @ rotation(second)
    levels = build_pyramid(render_design(number, A, xy))
    short = radius * tilt * PATCHES[number].cells[0][1]
    coarse = int(np.clip(np.floor(np.log2(short / CORE_RADIUS_PX)), 0, 3))
    level = np.array([coarse, max(coarse - 1, 0)])  # at the coarser one the circle may touch the sectors' edge
    place = xy + A @ np.array(off) * PATCHES[number].cells[0][1]
    poses = search_sectors(levels, np.tile(place, (2, 1)), level, TEMPLATES, margin=0.2)
    poses = align_poses(levels, poses, TEMPLATES.core, 5, 0.9 * CORE_RADIUS_PX)
    best = poses[np.array([poses.ncc.argmax()])]
    assert best.design[0] == number
    assert best.ncc[0] > 0.9
    assert np.linalg.norm(np.linalg.solve(A, best.xy[0] - xy)) < 0.1
    whole = align_poses(levels, estimate_size(levels, best, TEMPLATES), TEMPLATES.whole, 4, 5.6)
    size = np.sqrt(np.abs(np.linalg.det(whole.A[0])) / np.abs(np.linalg.det(A)))
    assert 0.5 < size < 1.3  # the size is rough: the sectors' edge is seen through a shape off by a few per cent
    assert whole.ncc[0] > 0.85


def test_templates_are_normalised_and_rotations_are_the_symmetries_less():
    for templates in (TEMPLATES.core, TEMPLATES.whole):
        assert np.abs(templates.ink.mean(axis=1)).max() < 1e-6
        assert np.linalg.norm(templates.ink, axis=1) == pytest.approx(1)
    checker = next(n for n, p in enumerate(PATCHES) if p.name == "checker")
    assert (TEMPLATES.core.rotated_design == checker).sum() == 12  # 24 rotations, half of them alike


def test_pyramid_levels_share_their_origin():
    row = np.zeros((64, 64), np.uint8)
    row[32, 40] = 255
    for n, level in enumerate(build_pyramid(row, 0)[:3]):
        total = level.sum()
        x, y = (level.sum(axis=0) @ np.arange(level.shape[1]), level.sum(axis=1) @ np.arange(level.shape[0])) / total
        assert (x * 2**n, y * 2**n) == pytest.approx((40, 32), abs=1e-4)


def test_short_axis_is_the_smaller_singular_value():
    A = np.random.default_rng(0).normal(size=(50, 2, 2))
    assert short_semi_axis(A) == pytest.approx(np.linalg.svd(A, compute_uv=False)[:, 1])


def ellipse(A):
    """The symmetric map of a pose's ellipse: what is known before its rotation."""
    square, axes = np.linalg.eigh(A @ A.T)
    return axes @ np.diag(np.sqrt(square)) @ axes.T


@settings(deadline=None, max_examples=20)
@given(number=st.integers(0, len(PATCHES) - 1), first=st.floats(0, 360), second=st.floats(0, 360))
def test_a_design_is_turned_within_its_ellipse(number, first, second):
    xy, A = np.array([60.3, 59.6]), rotation(first) @ np.diag([24.0, 17.0]) @ rotation(second)
    levels = build_pyramid(render_design(number, A, xy))
    rows, poses = rotate_within_ellipse(levels, xy[None], ellipse(A)[None], TEMPLATES)
    assert rows.tolist() == [0, 0]
    best = poses.ncc.argmax()
    assert poses.design[best] == number
    assert poses.ncc[best] > 0.9
    relative = np.linalg.inv(A) @ poses.A[best]
    angle = np.degrees(np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1]))
    half = 180 if PATCHES[number].name == "checker" else 360
    assert abs((angle + half / 2) % half - half / 2) < 6


@pytest.mark.parametrize("number", range(len(PATCHES)))
def test_an_ellipse_that_is_a_fifth_too_large_still_gives_the_design(number):
    xy, A = np.array([[60.0, 60.0]]), np.diag([24.0, 17.0])
    levels = build_pyramid(render_design(number, A, xy[0]))
    for size in (1.0, 1.2):
        rows, poses = rotate_within_ellipse(levels, xy, size * A[None], TEMPLATES)
        best = poses.ncc.argmax()
        assert rows.tolist() == [0, 0]
        assert poses.design[best] == number
        assert poses.ncc[best] > 0.85


def test_where_nothing_tells_two_rotations_apart_both_are_given():
    whole, number, where = TEMPLATES.whole, 1, np.array([60.0, 60.0])
    own = np.flatnonzero(whole.rotated_design == number)
    least = own[(whole.rotated[own] @ whole.rotated[own[0]]).argmin()]  # the most different one
    one, other = (
        render_design(number, 18.0 * rotation(np.degrees(whole.rotated_angle[n])), where).astype(float)
        for n in (own[0], least)
    )
    xy, A = where[None], np.diag([18.0, 18.0])[None]
    rows, poses = rotate_within_ellipse(build_pyramid((0.6 * one + 0.4 * other).astype(np.uint8)), xy, A, TEMPLATES)
    assert rows.tolist() == [0, 0]
    assert poses.ncc[1] <= poses.ncc[0]
    assert np.any(poses.design[1] != poses.design[0]) or np.linalg.norm(poses.A[1] - poses.A[0]) > 5


def test_a_view_knows_what_lies_outside_and_takes_its_inks_from_what_does_not():
    A, design = np.diag([20.0, 16.0])[None], np.array([2])
    image = render_design(2, A[0], np.array([60.0, 60.0]))
    whole, contrast = rectify(build_pyramid(image), np.array([[60.0, 60.0]]), A, design, TEMPLATES)
    part, less = rectify(build_pyramid(image[:, 60:]), np.array([[0.0, 60.0]]), A, design, TEMPLATES)
    assert not np.isnan(whole).any()
    side = VIEW_PX
    assert np.isnan(part.reshape(side, side)[:, : side // 2]).all()
    assert not np.isnan(part.reshape(side, side)[:, side // 2 + 1 :]).any()
    assert less[0] == pytest.approx(contrast[0], rel=0.1)
    away, least = rectify(build_pyramid(image), np.array([[400.0, 60.0]]), A, design, TEMPLATES)
    assert np.isnan(away).all()
    assert least[0] == 2.0


def test_blur_of_the_image_is_seen_in_the_frame_of_a_patch():
    side = VIEW_PX
    px = side / (2 * VIEW_REACH)  # of the view, in a radius
    axes = np.array([8.0, 20.0])
    soft = blur_views(TEMPLATES.view, np.tile(rotation(90) @ np.diag(axes), (len(PATCHES), 1, 1)), np.full(4, 2.0))
    inner = slice(8, -8)  # the border of the view is not the same
    for before, after in zip(TEMPLATES.view.reshape(-1, side, side), soft.reshape(-1, side, side), strict=True):
        expected = cv2.GaussianBlur(before, (0, 0), 2.0 * px / axes[0], sigmaY=2.0 * px / axes[1])
        np.testing.assert_allclose(after[inner, inner], expected[inner, inner], atol=0.03)
    assert blur_views(TEMPLATES.view[:0], np.zeros((0, 2, 2)), np.zeros(0)).shape == (0, side**2)
