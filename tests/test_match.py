import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kpbench import match
from kpbench.design import shipped_patches
from kpbench.scene import Placement, render_scene

PATCHES = shipped_patches()
KNOWN = match.bank(PATCHES)


def turn(deg):
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return np.array([[c, -s], [s, c]])


def picture(number, A, xy, size=120):
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
    xy, A = np.array([60.3, 59.6]), turn(first) @ np.diag([radius, radius * tilt]) @ turn(second)
    levels = match.pyramid(picture(number, A, xy))
    short = radius * tilt * PATCHES[number].cells[0][1]
    coarse = int(np.clip(np.floor(np.log2(short / match.RING_PX)), 0, 3))
    level = np.array([coarse, max(coarse - 1, 0)])  # at the coarser one the circle may touch the sectors' edge
    place = xy + A @ np.array(off) * PATCHES[number].cells[0][1]
    poses = match.search(levels, np.tile(place, (2, 1)), level, KNOWN, margin=0.2)
    poses = match.align(levels, poses, KNOWN.core, 5, 0.9 * match.RING_PX)
    best = poses[np.array([poses.ncc.argmax()])]
    assert best.which[0] == number
    assert best.ncc[0] > 0.9
    assert np.linalg.norm(np.linalg.solve(A, best.xy[0] - xy)) < 0.1
    whole = match.align(levels, match.extend(levels, best, KNOWN), KNOWN.whole, 4, 5.6)
    size = np.sqrt(np.abs(np.linalg.det(whole.A[0])) / np.abs(np.linalg.det(A)))
    assert 0.5 < size < 1.3  # the size is rough: the sectors' edge is seen through a shape off by a few per cent
    assert whole.ncc[0] > 0.85


def test_templates_are_normalised_and_rotations_are_the_symmetries_less():
    for templates in (KNOWN.core, KNOWN.whole):
        assert np.abs(templates.ink.mean(axis=1)).max() < 1e-6
        assert np.linalg.norm(templates.ink, axis=1) == pytest.approx(1)
    checker = next(n for n, p in enumerate(PATCHES) if p.name == "checker")
    assert (KNOWN.core.turned_which == checker).sum() == 12  # 24 rotations, half of them alike


def test_pyramid_levels_share_their_origin():
    row = np.zeros((64, 64), np.uint8)
    row[32, 40] = 255
    for n, level in enumerate(match.pyramid(row, 0)[:3]):
        total = level.sum()
        x, y = (level.sum(axis=0) @ np.arange(level.shape[1]), level.sum(axis=1) @ np.arange(level.shape[0])) / total
        assert (x * 2**n, y * 2**n) == pytest.approx((40, 32), abs=1e-4)


def test_short_axis_is_the_smaller_singular_value():
    A = np.random.default_rng(0).normal(size=(50, 2, 2))
    assert match.short_axis(A) == pytest.approx(np.linalg.svd(A, compute_uv=False)[:, 1])
