import json
import re
import shutil
import subprocess
from pathlib import Path

import pikepdf
import pytest
from helpers import kpbench

from kpbench.patches.design import shipped_patches


def done(*arguments):
    result = kpbench("render-patches", *arguments)
    return [Path(line) for line in result.stdout.splitlines()]


pytestmark = pytest.mark.usefixtures("here")


def load(path):
    return json.loads(Path(path).read_text())


def test_the_plain_call_prints_the_shipped_designs():
    assert done("--pdf") == [Path("patches-print/patches.pdf"), Path("patches-print/patches.json")]
    sidecar = load("patches-print/patches.json")
    assert sidecar["page_mm"] == [210, 297]
    assert [k["patch_id"] for k in sidecar["keypoints"]] == [p.patch_id for p in shipped_patches()]
    assert {k["diameter_mm"] for k in sidecar["keypoints"]} == {30}
    assert len(pikepdf.open("patches-print/patches.pdf").pages) == 1


def test_without_a_format_it_is_pdf():
    assert [p.suffix for p in done()] == [".pdf", ".json"]


def test_every_format_in_the_folder_asked_for():
    written = done("--out", "deep/er", "--svg", "--dxf", "--png", "--pdf", "--dpi", 72)
    assert written == [Path("deep/er/patches").with_suffix(s) for s in (".pdf", ".svg", ".png", ".dxf", ".json")]
    assert all(path.stat().st_size for path in written)
    assert load("deep/er/patches.json")["png"] == {"dpi": 72, "px_per_mm": 2.835}


def test_hexagon_is_one_board_a_design():
    written = done("--board", "hexagon", "--diameter-mm", 20)
    assert [p.name for p in written if p.suffix == ".pdf"] == [f"hexagon-{p.name}.pdf" for p in shipped_patches()]
    assert load(written[1])["side_mm"] == [125, 125]
    (pdf, _) = done("--board", "hexagon", "--patch", "0", "--out", "one")
    assert pdf.stem == f"hexagon-{shipped_patches()[0].name}"


def test_grid_and_landscape():
    _, sidecar = done("--board", "grid", "--page", "a3", "--landscape")
    assert load(sidecar)["page_mm"] == [420, 297]
    assert len(load(sidecar)["keypoints"]) == 12
    assert len(load(sidecar)["patches"]) == 4


def test_board_file_and_own_design():
    Path("mine.toml").write_text('name = "mine"\nid = 9\nsemicircles = [{ start_deg = 0, ink = "black" }]')
    Path("b.toml").write_text('[[keypoint]]\npatch = "mine"\nx_mm = 1\ny_mm = 2')
    _, sidecar = done("--design", "mine.toml", "--board", "b.toml", "--diameter-mm", 12, "--mirror")
    (k,) = load(sidecar)["keypoints"]
    assert (k["patch_id"], k["diameter_mm"], k["x_mm"], k["page_x_mm"]) == (9, 12, 1, 104)
    assert load(sidecar)["mirrored"] is True


def test_no_labels_leaves_no_text():
    done("--svg", "--no-labels")
    assert "<text" not in Path("patches-print/patches.svg").read_text()
    done("--svg")
    assert "<text" in Path("patches-print/patches.svg").read_text()


def test_copies_and_chosen_patches():
    _, sidecar = done("--patch", 1, "--patch", shipped_patches()[0].name, "--patch", "1", "--copies", 3)
    assert [k["patch_id"] for k in load(sidecar)["keypoints"]] == [1, 1, 1, 0, 0, 0]


def test_tiles():
    pdf, sidecar = done("--board", "hexagon", "--patch", 0, "--diameter-mm", 60, "--tile")
    assert len(pikepdf.open(pdf).pages) == len(load(sidecar)["tiles"]) == 4


def test_measured_corrects_what_was_printed_and_renders_nothing():
    done("--svg")
    before = Path("patches-print/patches.svg").stat().st_mtime_ns
    (path,) = done("--measured", "99.8,100.1")
    assert path == Path("patches-print/patches.measured.json")
    assert load(path)["print_scale"] == pytest.approx([0.998, 1.001])
    assert Path("patches-print/patches.svg").stat().st_mtime_ns == before
    assert load("patches-print/patches.json")["print_scale"] == [1, 1]


def test_several_fields_are_printed_and_told_from_each_other(here):
    kpbench("render-patches", "--board", "field", "--fields", 2, "--rows", 5, "--columns", 5, "--svg")
    assert [path.name for path in sorted(Path("patches-print").glob("*.json"))] == [
        "field-5x5-1.json",
        "field-5x5-2.json",
    ]
    refused = kpbench("render-patches", "--board", "grid", "--fields", 2, code=2).stderr
    assert "--rows, --columns and --fields are for --board field" in refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("--fields", 101, "--board", "field", "--rows", 5, "--columns", 5),
            "there are 100 fields of 5 rows and 5 col",
        ),
        (("--diameter-mm", 300), r"the largest diameter that fits is 180 mm"),
        (("--page", "b5"), "--page is 'b5', expected a4"),
        (("--patch", "nobody"), "patch 'nobody' is not known; known are: "),
        (("--board", "hexagon", "--diameter-mm", 40), "the largest diameter that fits"),
        (("--board", "octagon"), "octagon: no such file, expected hexagon, grid, truth, field or"),
        (("--design", "none.toml"), r"none\.toml: cannot be read"),
        (("--measured", "100,100"), "patches-print: no sidecar"),
        (("--png", "--page", "5000x5000mm", "--dpi", 4800), "too large for a PNG"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_1(arguments, message):
    result = kpbench("render-patches", *arguments, code=1)
    assert result.stdout == ""
    assert re.search(message, result.stderr), result.stderr
    assert result.stderr.startswith("kpbench: ")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--measured", "100"), "is not X_MM,Y_MM, expected two numbers"),
        (("--measured", "100,100", "--pdf"), "takes no other option"),
        (("--tile",), "give --board"),
        (("--board", "grid", "--copies", 2), "not for a --board"),
        (("--board", "b.toml", "--patch", 0), "names its patches itself"),
        (("--diameter-mm", "0"), "is not in the range"),
        (("--dpi", "1"), "is not in the range"),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments, message):
    result = kpbench("render-patches", *arguments, code=2)
    assert message in result.stderr


def test_two_designs_of_one_name_do_not_overwrite_each_other():
    for n in (1, 2):
        Path(f"{n}.toml").write_text(f'name = "same"\nid = {n}\nsemicircles = [{{ start_deg = 0, ink = "black" }}]')
    result = kpbench("render-patches", "--board", "hexagon", "--design", "1.toml", "--design", "2.toml", code=1)
    assert "two boards would be written to hexagon-same" in result.stderr
    assert not Path("patches-print").exists()


@pytest.mark.skipif(not shutil.which("pdfinfo"), reason="needs poppler")
def test_pdfinfo_sees_an_a4_page():
    (pdf, _) = done()
    told = subprocess.run(["pdfinfo", "-box", pdf], capture_output=True, text=True, check=True).stdout
    width, height = map(float, re.search(r"Page size: +([\d.]+) x ([\d.]+) pts \(A4\)", told).groups())
    assert (width * 25.4 / 72, height * 25.4 / 72) == pytest.approx((210, 297), abs=0.01)


def test_a_board_without_a_unique_pose_is_warned_of_and_says_so():
    result = kpbench("render-patches", "--board", "hexagon", "--svg")
    assert "the pose of board hexagon-checker is not unique: it looks the same after a turn of 180" in result.stderr
    assert result.stderr.count("not unique") == 1
    sidecars = sorted(Path("patches-print").glob("*.json"))
    unique = {path.stem: load(path)["unique_pose"] for path in sidecars}
    assert unique.pop("hexagon-checker") is False
    assert {*unique.values()} == {True}
