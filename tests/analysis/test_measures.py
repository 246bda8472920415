import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import kpbench
from kpbench.analysis import family as designs
from kpbench.analysis import localisation, search
from kpbench.analysis.cell_images import (
    BLUR,
    BLUR_MARGIN_PX,
    HALF_SIDE_PX,
    PolarGrid,
    attitudes,
    render_cells,
    render_polygons,
)
from kpbench.analysis.identity import correlation_and_distance, mirrored_distance, turned_distance
from kpbench.analysis.localisation import basin, design_bound, tilt_bias
from kpbench.analysis.measures import pixels_needed
from kpbench.analysis.natural_images import natural_response, sample_windows
from kpbench.geometry.camera import Camera
from kpbench.geometry.coverage import rasterise
from kpbench.patches.design import Patch, SemiCircle, unit_polygons

DESIGNS = Path(__file__).parents[2] / "benchmarks" / "designs"
ALTERNATIVES = kpbench.load_patches(sorted((DESIGNS / "alternatives").glob("*.toml")))
NAMED = {p.name: p for p in (*ALTERNATIVES, *kpbench.shipped_patches())}
ANGLES = st.sampled_from(designs.FAMILY_ANGLES_DEG)
PATCHES = st.builds(
    Patch,
    st.just("any"),
    st.just(0),
    st.sampled_from(["black", "white"]),
    st.lists(
        st.builds(
            SemiCircle, st.sampled_from(designs.FAMILY_RADII), ANGLES, st.sampled_from(["black", "white", "invert"])
        ),
        max_size=3,
    ).map(tuple),
)


def measured(names, measure, **kwargs):
    patches = [NAMED[name] for name in names]
    grid = PolarGrid.of(patches)
    return measure(grid, grid.inks(patches), **kwargs)


# --- Images as sums of cells --------------------------------------------------------------------------


@given(PATCHES, st.floats(3, 30), st.floats(0, 360), st.floats(0.3, 1), st.tuples(st.floats(-1, 1), st.floats(-1, 1)))
@settings(max_examples=25, deadline=None)
def test_cells_add_up_to_the_design(patch, radius, turn, squeeze, shift):
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    A = radius * np.array([[c, -s], [s, c]]) @ np.diag([1, squeeze])
    half = int(radius) + 3
    grid = PolarGrid.of([patch])
    parts = render_polygons(grid.cell_polygons(1e-5), np.column_stack([A, shift])[None], half)[0]
    placed = [polygon @ A.T + shift for polygon in unit_polygons(patch, 1e-5)[0]]
    exact = rasterise([placed], [(-half, -half, 2 * half + 1, 2 * half + 1)])[0]
    np.testing.assert_allclose(grid.inks([patch])[0] @ parts, exact.ravel(), atol=2e-3)
    assert parts.sum() == pytest.approx(np.pi * radius**2 * squeeze, rel=1e-4)


def test_beyond_the_disc_the_outermost_ring_goes_on():
    patch = NAMED["checker"]
    grid = PolarGrid.of([patch])
    cells = render_cells(grid, attitudes(), 1.0, blur=0.0)
    np.testing.assert_allclose(cells.sum(1), 1.0, atol=1e-5)
    inner = render_cells(grid, attitudes(), 1 / 3, blur=0.0)
    np.testing.assert_allclose(cells, inner, atol=1e-5, err_msg="sectors look the same at any scale")


@given(PATCHES)
@settings(max_examples=30, deadline=None)
def test_a_mirror_image_is_the_patch_with_v_turned_round(patch):
    grid = PolarGrid.of([patch])
    rng = np.random.default_rng(0)
    radius, turn = rng.uniform(0, 0.999, 200), rng.uniform(0, 360, 200)
    ring = np.searchsorted(grid.radii, radius, side="right")
    sector = (np.searchsorted(grid.angles_deg, turn, side="right") - 1) % grid.shape[1]
    seen = grid.mirror_inks(grid.inks([patch]))[0][ring * grid.shape[1] + sector] > 0
    points = radius[:, None] * np.column_stack([np.cos(np.radians(turn)), -np.sin(np.radians(turn))])
    np.testing.assert_array_equal(seen, patch.is_black(points))


# --- Localisation -------------------------------------------------------------------------------------


def test_bound_equals_the_inverse_of_the_whole_information_matrix():
    """Another way round: outlines instead of cells, and all eight unknowns inverted at once."""
    patch, radius, half, step = NAMED["wheel"], 6.0, 9, 0.01
    box = [(-half, -half, 2 * half + 1, 2 * half + 1)]

    def image(unknowns):
        x, y, a, b, c, d, black, white = unknowns
        A = np.array([[radius + a, b], [c, radius + d]])
        ink, disc = (rasterise([[p @ A.T + (x, y) for p in parts]], box)[0] for parts in unit_polygons(patch, 1e-5))
        return (128 * (1 - disc) + white * (disc - ink) + black * ink).ravel()

    at = np.array([0.0, 0, 0, 0, 0, 0, 128 - 90, 128 + 90])
    J = np.array([(image(at + step * e) - image(at - step * e)) / (2 * step) for e in np.eye(8)])
    variance = np.linalg.inv(J @ J.T / 10**2)[:2, :2]
    grid = PolarGrid.of([patch])
    worst, rms = design_bound(grid, grid.inks([patch]), radius)
    assert worst[0] == pytest.approx(np.sqrt(np.linalg.eigvalsh(variance).max()), rel=0.01)
    assert rms[0] == pytest.approx(np.sqrt(np.trace(variance) / 2), rel=0.01)


@pytest.mark.parametrize(("radius", "low", "high"), [(5.0, 0.015, 0.04), (8.0, 0.012, 0.03), (45.0, 0.005, 0.012)])
def test_bounds_have_the_known_magnitude(radius, low, high):
    names = ["checker", "trefoil", "wheel", "mushroom", "quarter", "half"]
    worst, rms = measured(names, design_bound, radius_px=radius)
    assert np.all((worst >= low) & (worst <= high))
    assert np.all(rms <= worst)


def test_without_its_rim_a_single_edge_does_not_tell_the_centre():
    with_rim = measured(["half", "checker"], design_bound, radius_px=8.0)[0]
    without = measured(["half", "checker"], design_bound, radius_px=8.0, rim=False)[0]
    assert np.isinf(without[0])
    assert with_rim[1] < without[1] < 0.05


def test_tilt_and_blur_cost_localisation():
    names = ["checker", "mushroom"]
    frontal = measured(names, design_bound, radius_px=8.0)[0]
    assert np.all(measured(names, design_bound, radius_px=8.0, tilt_deg=60.0)[0] > 1.4 * frontal)
    assert np.all(measured(names, design_bound, radius_px=8.0, blur=0.2)[0] > 1.4 * frontal)


def test_basin_orders_designs_as_a_trained_network_did(monkeypatch):
    """Share of centres that a throw-away network put inside 10 %: 0.73, 0.67, 0.58, 0.28, 0.03."""
    monkeypatch.setattr(localisation, "PARTS_OF_BASIN", (1.0,))  # sectors look the same at any scale
    checker, three_quarter, quarter = measured(["checker", "three-quarter", "quarter"], basin)
    monkeypatch.setattr(localisation, "PARTS_OF_BASIN", (1 / 3,))  # where the other one is worst
    flipped, half = measured(["flipped-half", "half"], basin)
    assert checker > 2 * quarter
    assert quarter == pytest.approx(three_quarter, rel=1e-3), "inks exchanged: the measure cannot tell them apart"
    assert quarter > 1.5 * flipped
    assert flipped > 0.01 > half


def test_arcs_are_biased_under_tilt_and_crossings_are_not():
    assert tilt_bias(NAMED["checker"]) == 0.0
    radius, camera = 45.0, Camera(1624, 1240, 889.0)
    distance = camera.focal_px / radius
    near, far = (camera.focal_px * sign * 0.5 / (distance - sign * np.sqrt(0.75)) for sign in (1, -1))
    assert tilt_bias(NAMED["half"], radius, 60.0) == pytest.approx(abs(near + far) / 2, rel=1e-6)


# --- Identity -----------------------------------------------------------------------------------------


def test_distance_of_designs():
    correlation, distance = measured(["checker", "three-quarter", "quarter"], correlation_and_distance)
    np.testing.assert_allclose(correlation, correlation.T)
    np.testing.assert_allclose(np.diag(correlation), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.diag(distance), 0.0, atol=2e-3)
    assert correlation[0, 1] == pytest.approx(correlation[0, 2], abs=0.01), "the checker is its own negative"
    assert distance[0, 1] == pytest.approx(distance[0, 2], abs=0.005)
    assert distance[1, 2] > 0.2


def test_the_shipped_designs_tell_their_orientation_but_for_the_checker():
    assert [p.symmetry_order for p in kpbench.shipped_patches()] == [2, 1, 1, 1]
    assert Patch("disc", 0, "black", ()).symmetry_order == 0
    turned = measured(["checker", "wheel"], turned_distance)
    assert turned[0] == pytest.approx(0.0, abs=1e-3)
    assert turned[1] > 0.1
    mirrored = measured(["checker", "trefoil", "wheel", "mushroom", "nested-halves"], mirrored_distance)
    np.testing.assert_allclose(mirrored[:4], 0.0, atol=1e-3)
    assert mirrored[4] > 0.1


# --- Nature -------------------------------------------------------------------------------------------


def painted(patch, radius=5.0):
    """An image of a design, 13 + 8 px a side, black 40 and white 220."""
    half = HALF_SIDE_PX + BLUR_MARGIN_PX
    grid = PolarGrid.of([patch])
    cells = render_polygons(grid.cell_polygons(1e-3, 9.0), np.column_stack([radius * np.eye(2), (0, 0)])[None], half)[0]
    return (220 - 180 * grid.inks([patch])[0] @ cells).reshape(2 * half + 1, -1).round().astype(np.uint8)


def test_natural_response_finds_the_design_itself_and_no_flat_place():
    names = ["checker", "wheel"]
    windows = np.stack([painted(NAMED["checker"]), painted(NAMED["wheel"]), np.full((21, 21), 99, np.uint8)])
    for blur in (0.0, BLUR):
        response = measured(names, natural_response, windows=windows, blur=blur)
        np.testing.assert_allclose(response[:, 1], 1 / 3)
    response = measured(names, natural_response, windows=windows[1:2])
    np.testing.assert_array_equal(response[:, 1], [0, 1])


def test_windows_come_from_the_images_and_are_repeatable():
    photographs = [np.full((60, 80), n, np.uint8) for n in (10, 20, 30)] + [np.full((5, 5), 40, np.uint8)]
    windows = sample_windows(photographs, np.random.default_rng(1), 800)
    assert windows.shape == (800, 21, 21)
    np.testing.assert_array_equal(windows[:, 3, 4], np.repeat([10, 20, 30, 40], 200))
    assert len(sample_windows(photographs, np.random.default_rng(1), 300)) == 300


def test_pixels_needed_of_a_quarter_and_a_half():
    needed = measured(["half", "quarter"], pixels_needed)
    corner = np.sin(np.pi / 4) / (1 + np.sin(np.pi / 4))  # inscribed circle of a quarter of the unit disc
    np.testing.assert_allclose(needed, [2.0, 1 / corner], rtol=0.03)


# --- Search -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def family():
    return designs.enumerate_family()


def test_the_family_is_closed_under_rotation_and_mirror(family):
    assert (len(family.codes), len(family.classes)) == (45364, 3064)
    assert len(np.unique(family.codes)) == len(family.codes)
    assert np.isin(family.classes, family.codes).all()
    assert (designs.canonical_codes(family.classes) == family.classes).all()


@given(st.integers(0, 3063))
@settings(max_examples=40, deadline=None)
def test_a_code_is_painted_by_its_semicircles(family, n):
    code = int(family.classes[n])
    patch = family.patch(code, "any", 0)
    assert len(patch.semicircles) <= 3
    assert designs.code_of(patch) == code
    np.testing.assert_array_equal(designs.FAMILY_GRID.inks([patch]), designs.inks_of(np.array([code], np.uint32)))


@given(PATCHES, st.integers(0, 7), st.booleans())
@settings(max_examples=40, deadline=None)
def test_turned_and_mirrored_designs_share_a_code(patch, turn, mirror):
    semicircles = []
    for s in patch.semicircles:
        start = -(s.start_deg + 180) if mirror else s.start_deg
        semicircles.append(SemiCircle(s.radius, start + 45 * turn, s.ink))
    other = dataclasses.replace(patch, semicircles=tuple(semicircles))
    assert designs.code_of(patch) == designs.code_of(other)


@given(arrays(np.float32, (7, 7), elements=st.sampled_from(np.linspace(0, 1, 9).tolist())), st.integers(1, 3))
@settings(deadline=None)
def test_best_sets_are_those_of_brute_force(matrix, count):
    distance = np.maximum(matrix, matrix.T)
    keys = {s: tuple(search.pair_distances(distance, s)) for s in itertools.combinations(range(7), 4)}
    found = search.best_sets(distance, 4, count)
    assert [keys[s] for s in found] == sorted(keys.values(), reverse=True)[:count]


def test_best_sets_of_too_few_designs():
    assert search.best_sets(np.ones((3, 3), np.float32), 4, 2) == []


def test_the_search_prefers_the_shipped_designs(family, monkeypatch):
    """A family of twelve; the basins of the whole one take longer than a test may."""
    names = ["checker", "trefoil", "wheel", "mushroom", "quarter", "half", "flipped-half", "nested-halves"]
    codes = np.array([designs.code_of(NAMED[name]) for name in names], np.uint32)
    codes = np.append(codes, [designs.code_of(kpbench.load_patches([f])[0]) for f in DESIGNS.glob("runner-up/[0-9]*")])
    small = designs.Family(codes.astype(np.uint32), np.zeros(len(codes), np.int64) - 1, np.zeros(len(codes), np.int64))
    loose = [designs.code_of(NAMED[name]) for name in ("quarter", "nested-halves")]
    monkeypatch.setattr(search, "enumerate_family", lambda: small)
    monkeypatch.setattr(
        search,
        "basin",
        lambda grid, inks: np.array(
            [0.0 if (designs.inks_of(np.uint32(loose)) == i).all(1).any() else 0.2 for i in inks]
        ),
    )
    windows = np.zeros((5, 21, 21), np.uint8)
    found = search.search_designs(windows, kpbench.shipped_patches(), count=1)
    assert found.sets[0] == kpbench.shipped_patches()
    assert list(found.counts.values()) == [9, 9, 7, 6, 5, 5, 5]
    assert found.distances[0][0] > 0.16
