import zipfile
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import pytest
from helpers import kpbench

from kpbench.errors import DesignError
from kpbench.patches import SemiCircle, load_patches, shipped_patches
from kpbench.ui.designer import (
    PREVIEW_VIEWS,
    PrintChoice,
    add_semicircle,
    design_toml,
    distances_to,
    download_of,
    draw_preview,
    edit_design,
    edit_semicircle,
    measure_quickly,
    move_semicircle,
    other_designs,
)

CHECKER, TREFOIL, *_ = shipped_patches()
OWN = edit_design(TREFOIL, name="mine-ä", patch_id=7, rim=0.1, rim_ink="black", quiet_zone=0.3)


def test_edits_change_what_they_name():
    more = edit_semicircle(add_semicircle(TREFOIL), 3, radius=0.5, start_deg=22.5, ink="white")
    assert more.semicircles[3] == SemiCircle(0.5, 22.5, "white")
    assert move_semicircle(more, 3, 0).semicircles == (more.semicircles[3], *TREFOIL.semicircles)
    assert move_semicircle(more, 3, None) == TREFOIL


@pytest.mark.parametrize("change", [{"name": "../x"}, {"patch_id": -1}, {"disc": "red"}, {"rim": 3.0}])
def test_an_impossible_value_is_refused(change):
    with pytest.raises(DesignError, match="design"):
        edit_design(TREFOIL, **change)


@pytest.mark.parametrize("design", [*shipped_patches(), OWN, edit_design(OWN, semicircles=())], ids=str)
def test_the_toml_of_a_design_is_read_as_the_same_design(design, here):
    Path("mine.toml").write_bytes(design_toml(design))
    assert load_patches(["mine.toml"]) == (design,)


def test_the_views_of_a_preview_differ_and_are_the_same_each_time():
    views = [draw_preview(OWN, 8.0, view) for view in PREVIEW_VIEWS]
    assert len({view.tobytes() for view in views}) == 4
    assert all((draw_preview(OWN, 8.0, view) == image).all() for view, image in zip(PREVIEW_VIEWS, views, strict=True))


def test_measures_are_those_of_the_analysis():
    checker, wheel = measure_quickly(CHECKER), measure_quickly(shipped_patches()[2])
    assert checker.bounds_px[5.0][0] == pytest.approx(0.0162, abs=1e-4)  # docs/explanation/designs.md
    assert wheel.bounds_px[8.0][0] == pytest.approx(0.013, abs=1e-3)
    assert wheel.bias_px["sRGB"][0] == pytest.approx(0.13, abs=0.005)
    assert distances_to(TREFOIL, [CHECKER]) == {"checker": pytest.approx(0.215, abs=1e-3)}
    assert TREFOIL not in other_designs(TREFOIL)
    assert distances_to(TREFOIL, []) == {}
    assert set(measure_quickly(edit_design(TREFOIL, semicircles=())).bias_px["sRGB"]) == {float("inf")}
    assert max(measure_quickly(OWN).bias_px["sRGB"]) < 1


CHOICES = {
    "patches": (PrintChoice(diameter_mm=25, copies=2, page="letter"), "--diameter-mm 25 --copies 2 --page letter"),
    "mirrored": (PrintChoice("hexagon", diameter_mm=12, labels=False, landscape=True, mirror=True, invert=True,
                             reference=True),
                 "--board hexagon --no-labels --landscape --mirror --invert --reference --diameter-mm 12"),
    "tiles": (PrintChoice("grid", diameter_mm=40, tile=True), "--board grid --diameter-mm 40 --tile"),
    "field": (PrintChoice("field", "shipped", rows=5, columns=4), "--board field --rows 5 --columns 4"),
}  # fmt: skip


@pytest.mark.parametrize("name", CHOICES)
def test_a_download_is_what_the_command_line_writes(name, here):
    choice, options = CHOICES[name]
    toml = download_of(OWN, choice, "toml")
    Path(toml[0]).write_bytes(toml[1])
    given = f"{options} --dpi 36".split() + ([] if choice.designs == "shipped" else ["--design", toml[0]])
    kpbench("render-patches", "--pdf", "--svg", "--png", "--dxf", "--out", "printed", *given)
    for form in ("pdf", "svg", "png", "dxf"):
        file, content = download_of(OWN, replace(choice, dpi=36), form)
        written = {path.name: path.read_bytes() for path in Path("printed").glob(f"*.{form}")}
        if file.endswith(".zip"):
            with zipfile.ZipFile(BytesIO(content)) as archive:
                found = {entry: archive.read(entry) for entry in archive.namelist()}
        else:
            found = {file: content}
        assert found == written
        assert (len(found) > 1) == (name == "tiles" and form != "pdf")


def test_the_edited_design_takes_the_place_of_its_id(here):
    _, content = download_of(edit_design(OWN, patch_id=2), PrintChoice("field", "mixed", page="a2"), "json")
    assert b'"mine-' in content
    assert b'"wheel"' not in content
    with pytest.raises(DesignError, match="4 designs, found 5"):
        download_of(OWN, PrintChoice("field", "mixed", page="a2"), "pdf")
