import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kpbench.errors import DesignError
from kpbench.geometry.coverage import bounding_box, rasterise
from kpbench.patches.design import Patch, SemiCircle, load_patches, parse_patch, shipped_patches, unit_polygons

semicircles = st.builds(
    SemiCircle,
    st.sampled_from([1.0, 2 / 3, 0.5, 1 / 3]),
    st.sampled_from([45.0 * k for k in range(8)] + [10.0, 123.4]),
    st.sampled_from(["black", "white", "invert"]),
)
patches = st.builds(
    lambda disc, halves, rim, quiet: Patch("any", 0, disc, halves, *rim, quiet),
    st.sampled_from(["black", "white"]),
    st.lists(semicircles, max_size=4).map(tuple),
    st.sampled_from([(0.0, "white"), (0.125, "white"), (0.125, "black")]),
    st.sampled_from([0.0, 0.25]),
)


def painted(patch, points):
    """Ink by painting one semi-circle after the other: another way than the cells."""
    u, v = points[..., 0], points[..., 1]
    radius, angle = np.hypot(u, v), np.degrees(np.arctan2(v, u))
    black = np.full(u.shape, patch.disc == "black")
    for s in patch.semicircles:
        inside = (radius < s.radius) & ((angle - s.start_deg) % 360 < 180)
        black = np.where(inside, ~black if s.ink == "invert" else s.ink == "black", black)
    black = np.where(radius >= 1, patch.rim_ink == "black", black)
    return np.where(radius >= 1 + patch.rim, False, black)


@given(patches, st.integers(0, 2**32 - 1))
def test_cells_are_what_painting_gives(patch, seed):
    points = np.random.default_rng(seed).uniform(-1.5, 1.5, (500, 2))
    assert (patch.is_black(points) == painted(patch, points)).all()


@given(patches)
def test_the_outline_covers_the_black_cells_exactly(patch):
    radii, angles, black = patch.cells
    width = np.radians(np.diff(np.append(angles, angles[0] + 360)))
    expected = (np.diff(radii**2)[:, None] * width / 2 * black).sum()
    polygons = [30 * polygon for polygon in unit_polygons(patch, 1e-6)[0]]
    if not polygons:
        assert expected < 1e-12
        return
    x, y, w, h = box = bounding_box(polygons)
    cover = rasterise([polygons], [box])[0]
    assert np.isclose(cover.sum(), 900 * expected, rtol=1e-5)
    middle = np.stack(np.meshgrid(x + np.arange(w), y + np.arange(h)), axis=-1) / 30
    clear = (cover < 1e-9) | (cover > 1 - 1e-9)  # pixels that no edge crosses
    assert ((cover > 0.5) == patch.is_black(middle))[clear].all()


@given(patches)
def test_a_design_survives_its_toml_table(patch):
    assert parse_patch(patch.to_dict(), "here") == patch


def test_the_shipped_four_are_four_different_inks():
    four = shipped_patches()
    assert [patch.patch_id for patch in four] == [0, 1, 2, 3]
    assert len({patch.digest for patch in four}) == 4
    assert len({patch.name for patch in four}) == 4


def test_edges_of_two_directions_make_a_crossing():
    half = Patch("half", 0, "white", (SemiCircle(1.0, 0.0, "black"),))
    checker = Patch("checker", 0, "white", (SemiCircle(1.0, 0.0, "black"), SemiCircle(1.0, 90.0, "invert")))
    assert checker.centre_is_crossing
    assert not half.centre_is_crossing


GOOD = 'name = "a"\nid = 1\nsemicircles = [{ radius = 1.0, start_deg = 0, ink = "black" }]\n'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (GOOD.replace("ink", "colour"), "unknown key 'colour' in semicircles[0]; known are: radius, start_deg, ink"),
        (GOOD.replace('"black"', '"red"'), "semicircles[0].ink is 'red', expected one of: black, white, invert"),
        (
            GOOD.replace("radius = 1.0", "radius = 1.5"),
            "semicircles[0].radius is 1.5, expected a number from 0.01 to 1",
        ),
        (GOOD.replace("id = 1", "id = -1"), "id is -1, expected a whole number"),
        (GOOD.replace("id = 1", "id = true"), "id is True, expected a whole number"),
        (GOOD + "shape = 3\n", "unknown key 'shape'; known are: schema, name"),
        (GOOD + 'disc = "grey"\n', "disc is 'grey', expected one of: black, white"),
        (GOOD + "rim = 0.1\n", "rim is 0.1, expected a table with: width, ink"),
        (GOOD + 'schema = "kpbench.patch/9"\n', "schema is 'kpbench.patch/9', expected 'kpbench.patch/1'"),
        ('id = 1\nname = "a"\n', "semicircles is missing"),
        ("name = ", "not valid TOML"),
    ],
)
def test_a_bad_design_is_one_line_that_names_file_and_place(tmp_path, text, says):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(DesignError) as caught:
        load_patches([path])
    assert str(caught.value).startswith(str(path))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_two_designs_of_one_id_are_refused(tmp_path):
    for name in "ab":
        (tmp_path / f"{name}.toml").write_text(GOOD)
    with pytest.raises(DesignError, match=r"b\.toml: id 1 is taken by .*a\.toml"):
        load_patches([tmp_path / "a.toml", tmp_path / "b.toml"])


def test_equal_designs_are_equal_keys():
    for patch in shipped_patches():
        assert hash(patch) == hash(parse_patch(patch.to_dict(), "here"))
