"""The sheet and its ink against brute force: distances of many points, and lengths of curves."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kpbench.camera.paper import Cylinder, Saddle, spread_ink
from kpbench.geometry.coverage import rasterise
from kpbench.geometry.outline import circle, flatten, rectangle
from kpbench.patches.design import Patch, SemiCircle, shipped_patches

S = 50.0  # px per disc radius
SIDE, FINE = 161, 8


def by_distance_transform(patch, gain, within):
    """Coverage of grown ink: the exact distance of fine samples from the ink, by OpenCV."""
    k = ((np.arange(SIDE * FINE) + 0.5) / FINE - 0.5 - SIDE // 2) / S
    points = np.stack(np.meshgrid(k, k), axis=-1)
    black = patch.is_black(points)
    if gain < 0:
        black = ~black
    # half a sample, because the distance runs to the middle of the nearest sample of ink
    distance = cv2.distanceTransform((~black).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5
    grown = distance <= abs(gain) * S * FINE
    grown = (grown if gain > 0 else ~grown) & (np.hypot(*points.transpose(2, 0, 1)) <= within)
    return grown.reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3))


def coverage(region):
    polygons = [polygon * S + SIDE // 2 for polygon in flatten(region, 1e-6)]
    return rasterise([polygons], [(0, 0, SIDE, SIDE)])[0]


@pytest.mark.parametrize("patch", shipped_patches(), ids=lambda patch: patch.name)
@pytest.mark.parametrize(("gain", "within"), [(0.02, np.inf), (0.11, 1.0), (-0.06, np.inf)])
def test_spread_ink_is_the_parallel_body(patch, gain, within):
    cover, expected = coverage(spread_ink(patch.black_region, gain, within)), by_distance_transform(patch, gain, within)
    assert np.abs(cover - expected).max() < 0.15  # of 64 samples per pixel, 8 lie along an edge
    assert abs(cover.sum() / expected.sum() - 1) < 6e-3  # the transform counts slanted edges from samples of ink
    middle = slice(SIDE // 2 - 4, SIDE // 2 + 5)
    assert abs(cover[middle, middle].mean() - expected[middle, middle].mean()) < 8e-3


semicircles = st.builds(
    SemiCircle, st.sampled_from([0.3, 0.5, 0.8, 1.0]), st.integers(0, 71).map(lambda n: 5.0 * n), st.just("invert")
)


@given(st.lists(semicircles, min_size=1, max_size=5), st.sampled_from([-0.031, 0.0067, 0.043]), st.booleans())
@settings(max_examples=25)
def test_ink_of_any_design_spreads(parts, gain, is_cut):
    patch = Patch("any", 1, "white", tuple(parts))
    region = spread_ink(patch.black_region, gain, 1.0 if is_cut else np.inf)
    before, after = coverage(patch.black_region), coverage(region)
    if not is_cut or gain < 0:
        assert ((after - before) * np.sign(gain) > -1e-6).all()
    assert after.min() >= 0
    if not is_cut and gain > 0:  # a disc of this radius about every black pixel is black
        reach = int(gain * S)
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        kernel = (np.hypot(np.abs(x) + 0.5, np.abs(y) + 0.5) <= gain * S).astype(np.uint8)
        grown = cv2.dilate((before > 0.999).astype(np.uint8), kernel) if kernel.any() else before > 0.999
        assert after[grown == 1].min(initial=1) > 0.99


@pytest.mark.parametrize("angle_deg", [10.0, 45.0, 80.0, 190.0])
def test_ink_that_touches_the_rim_beside_the_axes_is_cut(angle_deg):
    """A narrow sector has no point with a coordinate of 1, yet its spread ink leaves the disc."""
    patch = Patch("sector", 1, "white", tuple(SemiCircle(1.0, angle_deg + turn, "invert") for turn in (0.0, 5.0)))
    points = np.concatenate(flatten(spread_ink(patch.black_region, 0.0067, 1.0), 1e-6))
    assert np.hypot(*points.T).max() == pytest.approx(1.0, abs=1e-5)


def test_the_corner_between_black_sectors_moves_along_its_bisector():
    (contour,) = spread_ink(shipped_patches()[0].black_region, 0.1)
    points = flatten((contour,), 1e-6)[0]
    corners = points[np.isclose(np.abs(points), 0.1).all(axis=1)]
    assert np.allclose(np.sort(corners, axis=0), [[-0.1, -0.1], [0.1, 0.1]])
    assert spread_ink(circle(0, 0, 1.0), -1.5) == ()
    area = coverage(spread_ink(rectangle(-0.5, -0.5, 1, 1), 0.2)).sum() / S**2
    assert np.isclose(area, 1 + 4 * 0.2 + np.pi * 0.04, rtol=1e-5)


def test_a_cylinder_keeps_lengths_and_a_saddle_is_its_formula():
    t = np.linspace(-1, 1, 20001)[:, None]
    line = t * [90.0, 40.0]
    for radius_mm in (150.0, -80.0):
        bent = Cylinder(radius_mm, 30.0).bend(line)
        assert np.isclose(np.linalg.norm(np.diff(bent, axis=0), axis=1).sum(), 2 * np.hypot(90, 40), rtol=1e-7)
        axis = np.array([np.cos(np.radians(30)), np.sin(np.radians(30)), 0])
        middle = bent - [0, 0, radius_mm]
        assert np.allclose(np.linalg.norm(middle - np.outer(middle @ axis, axis), axis=1), abs(radius_mm))
    for sagitta_mm in (3.0, -12.0):
        bent = Cylinder.of_sagitta(sagitta_mm, 200.0, 90.0).bend([[100.0, 7.0], [-100.0, 0.0]])
        assert np.allclose(bent[:, 2], sagitta_mm)
    with pytest.raises(ValueError, match="expected up to 63"):
        Cylinder.of_sagitta(70.0, 200.0)
    x, y = line.T
    c, s = np.cos(0.3), np.sin(0.3)
    assert np.allclose(Saddle(1e-3, np.degrees(0.3)).bend(line)[:, 2], 1e-3 * (c * x + s * y) * (c * y - s * x))
