import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kpbench.geometry.coverage import bounding_box, rasterise
from kpbench.geometry.outline import circle, flatten, rectangle

coordinate = st.floats(-30, 30)


def area(polygon):
    following = np.roll(polygon, -1, axis=0)
    return abs((polygon[:, 0] * following[:, 1] - polygon[:, 1] * following[:, 0]).sum()) / 2


def rasterised(polygons):
    box = bounding_box(polygons)
    return rasterise([polygons], [box])[0], box


@given(st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=3, unique=True))
def test_a_triangle_keeps_its_area_and_its_centroid(corners):
    triangle = np.array(corners)
    cover, (x, y, w, h) = rasterised([triangle])
    assert np.isclose(cover.sum(), area(triangle), atol=1e-9)
    if area(triangle) > 50:  # the centroid of the exact coverage is that of the area to a pixel's moment
        centroid = (cover.sum(axis=0) @ (x + np.arange(w)), cover.sum(axis=1) @ (y + np.arange(h))) / cover.sum()
        assert np.abs(centroid - triangle.mean(axis=0)).max() < 0.2


@given(st.floats(3, 40), coordinate, coordinate)
def test_a_disc_lies_where_it_was_put(radius, x, y):
    cover, (x0, y0, w, h) = rasterised(flatten(circle(x, y, radius), 1e-4))
    assert np.isclose(cover.sum(), np.pi * radius**2, rtol=1e-6)
    assert abs(cover.sum(axis=0) @ (x0 + np.arange(w)) / cover.sum() - x) < 0.03 / radius
    assert abs(cover.sum(axis=1) @ (y0 + np.arange(h)) / cover.sum() - y) < 0.03 / radius


def test_pixel_centres_are_at_integers():
    cover, (x, y, _, _) = rasterised(flatten(rectangle(1.5, 2.5, 1, 1), 0.1))
    assert cover[3 - y, 2 - x] == 1
    assert cover.sum() == 1


def test_half_a_pixel_is_half_grey_whichever_way_the_outline_runs():
    square = flatten(rectangle(0, 0, 1, 1), 0.1)[0]
    for polygon in (square, square[::-1]):
        cover, (x, y, _, _) = rasterised([polygon])
        assert np.allclose(cover[0 - y : 2 - y, 0 - x : 2 - x], 0.25)


@given(st.integers(0, 2**32 - 1))
def test_coverage_agrees_with_counting_subsamples(seed):
    rng = np.random.default_rng(seed)
    angles = (np.arange(7) + rng.uniform(0, 0.9, 7)) * 2 * np.pi / 7  # no gap of half a turn: winding number 1
    star = np.column_stack([np.cos(angles), np.sin(angles)]) * rng.uniform(2, 6, (7, 1)) + rng.uniform(-3, 3, 2)
    cover, (x, y, w, h) = rasterised([star])
    n = 16
    px, py = np.meshgrid(x - 0.5 + (np.arange(w * n) + 0.5) / n, y - 0.5 + (np.arange(h * n) + 0.5) / n)
    winding = np.zeros(px.shape, int)
    for (x0, y0), (x1, y1) in zip(star, np.roll(star, -1, axis=0), strict=True):
        side = (x1 - x0) * (py - y0) - (px - x0) * (y1 - y0)
        winding += np.where((y0 <= py) & (y1 > py) & (side > 0), 1, 0) - np.where(
            (y1 <= py) & (y0 > py) & (side < 0), 1, 0
        )
    counted = np.clip(np.abs(winding), 0, 1).reshape(h, n, w, n).mean(axis=(1, 3))
    assert np.abs(np.abs(counted) - cover).max() < 0.13


def test_many_regions_in_one_call_are_the_same_as_one_by_one():
    regions = [flatten(circle(3.3 * k, -2.1 * k, 1.5 + k), 1e-3) for k in range(5)]
    boxes = [bounding_box(polygons) for polygons in regions]
    together = rasterise(regions, boxes)
    for polygons, box, cover in zip(regions, boxes, together, strict=True):
        assert np.allclose(rasterise([polygons], [box])[0], cover, atol=1e-12)


def test_a_region_without_polygons_is_empty():
    assert not rasterise([[]], [(0, 0, 3, 2)])[0].any()
