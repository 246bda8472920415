import ast
import io
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pikepdf
import pytest
import readers
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import kpbench.printing.page
from kpbench.errors import DesignError
from kpbench.geometry.outline import Arc, Line, circle, move, rectangle
from kpbench.printing.dxf import to_dxf
from kpbench.printing.formats import PAGE_WRITERS
from kpbench.printing.page import CUT, INK, MARKS, Page, Shape, Text, mirror_page
from kpbench.printing.pdf import to_pdf
from kpbench.printing.png import px_per_mm, to_png
from kpbench.printing.svg import to_svg

RADIUS, AT = 15.0, (40.3, 61.7)
HALF_DISC = ((Arc(0, 0, 1, 0, 180), Line(-1, 0, 1, 0)),)
RING = (*circle(0, 0, 1), (Arc(0, 0, 0.6, 0, -360),))
PIE = ((Arc(0, 0, 1, 30, 270), Line(0.5, -np.sqrt(3) / 2, 0, 0), Line(0, 0, np.sqrt(3) / 2, 0.5)),)
# area and centroid on the unit disc, by hand
KNOWN = {
    "disc": (circle(0, 0, 1), np.pi, (0, 0)),
    "half": (HALF_DISC, np.pi / 2, (0, 4 / (3 * np.pi))),
    "ring": (RING, np.pi * 0.64, (0, 0)),
    # 2/3 r sin(h)/h for the half angle h = 135 degrees, along the bisector at 165 degrees
    "pie": (
        PIE,
        3 * np.pi / 4,
        2 / 3 * np.sin(h := 0.75 * np.pi) / h * np.array([np.cos(t := np.pi * 11 / 12), np.sin(t)]),
    ),
}


# PDF holds four decimals of a point, which moves an edge by at most 0.02 µm
AREA = {".svg": 2e-7, ".dxf": 1e-9, ".pdf": 3e-6}


def page_of(region, *texts, layer=INK, size=(100.0, 120.0)):
    return Page(*size, (Shape(move(region, *AT, RADIUS), layer),), texts, "a test")


def measured(suffix, page, tmp_path):
    """Area in mm² and centroid in mm of the first shape, by the independent readers."""
    if suffix == ".svg":
        return readers.moments(readers.svg_shapes(to_svg(page))[0][0])
    if suffix == ".pdf":
        return readers.moments(readers.pdf_shapes(to_pdf([page]))[0][0][0])
    contours, _ = readers.dxf_shapes(to_dxf(page), tmp_path / "a.dxf")
    return readers.moments([part for contour in contours for part in contour])


@pytest.mark.parametrize("suffix", [".svg", ".pdf", ".dxf"])
@pytest.mark.parametrize("name", KNOWN)
def test_vector_formats_hold_the_exact_area_and_place(suffix, name, tmp_path):
    region, area, centroid = KNOWN[name]
    got_area, got = measured(suffix, page_of(region), tmp_path)
    assert got_area == pytest.approx(area * RADIUS**2, rel=AREA[suffix])
    np.testing.assert_allclose(got, np.array(AT) + RADIUS * np.array(centroid), atol=5e-5)


@pytest.mark.parametrize("suffix", [".svg", ".pdf", ".dxf"])
@pytest.mark.parametrize("name", KNOWN)
def test_mirror_swaps_left_and_right_only(suffix, name, tmp_path):
    region, area, centroid = KNOWN[name]
    page = page_of(region)
    got_area, got = measured(suffix, mirror_page(page), tmp_path)
    x, y = np.array(AT) + RADIUS * np.array(centroid)
    assert got_area == pytest.approx(area * RADIUS**2, rel=AREA[suffix])
    np.testing.assert_allclose(got, (page.width - x, y), atol=5e-5)
    back = mirror_page(mirror_page(page)).shapes[0].region[0][0]
    assert (back.x, back.start_deg % 360, back.sweep_deg) == pytest.approx(
        (AT[0], region[0][0].start_deg, region[0][0].sweep_deg)
    )


@given(
    x=st.floats(20, 180),
    y=st.floats(20, 270),
    radius=st.floats(0.5, 60),
    turn=st.floats(-360, 360),
    sweep=st.floats(5, 355),
    sign=st.sampled_from([-1, 1]),
)
@settings(max_examples=40, deadline=None)
def test_any_sector_is_where_it_should_be_in_svg_and_pdf(x, y, radius, turn, sweep, sign):
    around = Arc(x, y, radius, turn, sign * sweep)
    sector = (around, Line(*around.point(1.0), x, y), Line(x, y, *around.point(0.0)))
    page = Page(210, 297, (Shape((sector,)),), (), "")
    half = np.radians(sweep) / 2
    out = 2 / 3 * radius * np.sin(half) / half
    middle = np.radians(turn + sign * sweep / 2)
    expected = x + out * np.cos(middle), y + out * np.sin(middle)
    for _, got in (
        readers.moments(readers.svg_shapes(to_svg(page))[0][0]),
        readers.moments(readers.pdf_shapes(to_pdf([page]))[0][0][0]),
    ):
        np.testing.assert_allclose(got, expected, atol=5e-4)  # half a µm, with sectors as small as 0.5 mm


def test_pdf_edge_is_a_circle_to_a_tenth_of_a_micrometre():
    page = page_of(circle(0, 0, 1))
    segments = readers.pdf_shapes(to_pdf([page]))[0][0][0]
    assert len(segments) >= 8
    off = np.concatenate([np.hypot(*(points - AT).T) for points, _ in segments]) - RADIUS
    assert np.abs(off).max() < 1e-4  # mm


def test_svg_circle_is_made_of_true_arcs():
    content = to_svg(page_of(circle(0, 0, 1))).decode()
    path = content.split(' d="')[1].split('"')[0]
    assert path.count("A15 15") == 4
    assert "L" not in path
    assert "C" not in path


def test_svg_numbers_keep_the_nanometre():
    page = Page(100, 100, (Shape(rectangle(1.234567, -0.0, 2.0000014, 3)),), (), "")
    assert 'd="M1.234567 0L3.234568 0L3.234568 3' in to_svg(page).decode()


def test_pdf_asks_not_to_be_scaled_and_says_what_it_is():
    document = pikepdf.open(io.BytesIO(to_pdf([page_of(HALF_DISC), page_of(RING)])))
    assert len(document.pages) == 2
    assert document.Root.ViewerPreferences.PrintScaling == "/None"
    assert document.docinfo["/Title"] == "a test"
    assert document.docinfo["/Author"] == "kpbench"


@pytest.mark.parametrize("size", [(210.0, 297.0), (215.9, 355.6), (123.4, 56.7)])
def test_page_sizes(size, tmp_path):
    page = page_of(HALF_DISC, size=size)
    assert readers.svg_shapes(to_svg(page))[1] == size
    np.testing.assert_allclose(readers.pdf_shapes(to_pdf([page]))[1][0], size, atol=1e-4)
    assert readers.dxf_shapes(to_dxf(page), tmp_path / "a.dxf")[1].header["$EXTMAX"][:2] == pytest.approx(size)
    image = Image.open(io.BytesIO(to_png(page, 300)))
    assert image.size == tuple(round(side * px_per_mm(300)) for side in size)


@pytest.mark.parametrize("dpi", [72, 150, 300, 600, 1200])
def test_png_says_its_resolution_and_is_drawn_at_it(dpi):
    page = Page(30, 30, (Shape(move(HALF_DISC, 12.3, 14.5, 10)),), (), "")
    content = to_png(page, dpi)
    image = Image.open(io.BytesIO(content))
    assert image.mode == "L"
    assert round(image.info["dpi"][0]) == round(image.info["dpi"][1]) == dpi
    at = content.index(b"pHYs") + 4
    per_metre = int.from_bytes(content[at : at + 4], "big")
    assert per_metre == round(dpi / 0.0254)
    scale = per_metre / 1000
    expected = np.array([12.3, 14.5 + 40 / (3 * np.pi)]) * scale - 0.5
    grey = np.asarray(image)
    np.testing.assert_allclose(readers.dark_centroid(grey, *expected, 11 * scale), expected, atol=0.005)
    assert (255.0 - grey).sum() / 255 == pytest.approx(np.pi * 50 * scale**2, rel=1e-3)


def test_png_that_would_not_fit_in_memory_is_refused():
    with pytest.raises(DesignError, match="use a lower `dpi`"):
        to_png(page_of(HALF_DISC, size=(3000.0, 3000.0)), 4800)


def test_png_clips_what_hangs_over_the_page():
    page = Page(10, 10, (Shape(circle(0, 0, 4)), Shape(circle(10, 10, 4))), (), "")
    ink = 255.0 - np.asarray(Image.open(io.BytesIO(to_png(page, 254))))
    assert ink.sum() / 255 == pytest.approx(2 * np.pi * 40**2 / 4, rel=1e-3)
    np.testing.assert_allclose(ink, ink[::-1, ::-1], atol=1)
    assert (ink[0, 0], ink[0, -1]) == (255, 0)


def test_dxf_is_y_up_with_its_layers(tmp_path):
    page = Page(
        100,
        120,
        (Shape(circle(10, 20, 5)), Shape(rectangle(50, 100, 3, 2), MARKS), Shape(circle(10, 20, 7), CUT)),
        (Text("ab", 30, 110, 4, "end"),),
        "",
    )
    _, drawing = readers.dxf_shapes(to_dxf(page), tmp_path / "a.dxf")
    assert drawing.dxfversion == "AC1015"
    disc = drawing.modelspace().query('LWPOLYLINE[layer=="INK"]')[0]
    assert [(x, y, abs(b)) for x, y, b in disc.get_points("xyb")] == [(15, 100, 1), (5, 100, 1)]
    assert {e.dxf.layer for e in drawing.modelspace()} == {"INK", "MARKS", "CUT", "TEXT"}
    text = drawing.modelspace().query("TEXT")[0]
    assert tuple(text.dxf.align_point)[:2] == (30, 10)


def test_cut_lines_are_in_dxf_only(tmp_path):
    page = page_of(circle(0, 0, 1), layer=CUT)
    assert "<path" not in to_svg(page).decode()
    assert readers.pdf_shapes(to_pdf([page]))[0] == [[]]
    assert np.asarray(Image.open(io.BytesIO(to_png(page, 100)))).min() == 255
    assert len(readers.dxf_shapes(to_dxf(page), tmp_path / "a.dxf", CUT)[0]) == 1


AWKWARD = 'a<b & "c" %%d \\P é 中 \U0001f600 \x00\n'


@pytest.mark.parametrize("anchor", ["start", "middle", "end"])
def test_any_text_can_be_written(anchor, tmp_path):
    page = page_of(HALF_DISC, Text(AWKWARD, 50, 20, 3, anchor), Text(AWKWARD, 50, 30, 3, anchor, mirrored=True))
    assert 'a<b & "c" %%d \\P é 中 \U0001f600 ??' in "".join(readers.ET.fromstring(to_svg(page)).itertext())
    assert len(readers.pdf_shapes(to_pdf([page]))[0][0]) == 1
    drawing = readers.dxf_shapes(to_dxf(page), tmp_path / "a.dxf")[1]
    assert drawing.modelspace().query("TEXT")[0].dxf.text.startswith('a<b & "c" ')
    assert Image.open(io.BytesIO(to_png(page, 100))).size == (394, 472)


def test_text_stands_where_its_anchor_says():
    for anchor, low, high in (("start", 50, 75), ("middle", 37, 63), ("end", 25, 50)):
        for mirrored in (False, True):
            page = Page(100, 40, (), (Text("HHHHHHHH", 50, 20, 4, anchor, mirrored),), "")
            dark = np.argwhere(np.asarray(Image.open(io.BytesIO(to_png(page, 254)))) < 128) / px_per_mm(254)
            limits = (100 - high, 100 - low) if mirrored else (low, high)
            assert limits[0] - 0.2 <= dark[:, 1].min() <= dark[:, 1].max() <= limits[1] + 0.2
            assert 16 <= dark[:, 0].min() <= dark[:, 0].max() <= 20.1


@pytest.mark.parametrize("suffix", PAGE_WRITERS)
def test_same_page_same_bytes(suffix):
    page = page_of(PIE, Text("twice", 10, 10, 3))
    assert PAGE_WRITERS[suffix]([page, page], 100) == PAGE_WRITERS[suffix]([page, page], 100)


def test_draw_knows_no_patch():
    tree = ast.parse(Path(kpbench.printing.page.__file__).read_text())
    used = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not {
        module
        for module in used
        if module in ("kpbench.patches.design", "kpbench.patches.board", "kpbench.printing.sheet")
    }


@pytest.mark.skipif(not shutil.which("qpdf"), reason="needs qpdf")
def test_qpdf_finds_no_fault(tmp_path):
    (tmp_path / "a.pdf").write_bytes(to_pdf([page_of(PIE, Text("x", 1, 1, 3)), page_of(RING)]))
    done = subprocess.run(["qpdf", "--check", tmp_path / "a.pdf"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "No syntax or stream encoding errors found" in done.stdout


@pytest.mark.skipif(not shutil.which("pdfimages"), reason="needs poppler")
def test_pdf_holds_no_image(tmp_path):
    (tmp_path / "a.pdf").write_bytes(to_pdf([page_of(PIE)]))
    done = subprocess.run(["pdfimages", "-list", tmp_path / "a.pdf"], capture_output=True, text=True, check=True)
    assert len(done.stdout.splitlines()) == 2, "a header and nothing below"


@pytest.mark.skipif(not shutil.which("pdftoppm"), reason="needs poppler")
def test_mirrored_pages_are_mirror_images_text_and_all(tmp_path):
    page = Page(100, 50, (), (Text("RE", 10, 40, 24), Text("FL", 95, 40, 24, "end")), "")
    for name, drawn in (("a", page), ("b", mirror_page(page))):
        (tmp_path / f"{name}.pdf").write_bytes(to_pdf([drawn]))
        subprocess.run(["pdftoppm", "-r", "127", "-gray", "-singlefile", f"{name}.pdf", name], cwd=tmp_path, check=True)
    for straight, mirrored in (
        [np.asarray(Image.open(tmp_path / f"{name}.pgm")) for name in ("a", "b")],
        [np.asarray(Image.open(io.BytesIO(to_png(drawn, 127)))) for drawn in (page, mirror_page(page))],
    ):
        ink, seen = (255.0 - grey[:250, :500] for grey in (straight, mirrored))  # poppler adds a row and a column
        assert np.abs(ink - seen[:, ::-1]).sum() < 0.15 * ink.sum()
        assert np.abs(ink - seen).sum() > ink.sum()
    assert to_svg(mirror_page(page)).count(b"matrix(-1 0 0 1 ") == 2


def test_the_pdf_embeds_its_font():
    """Print shops refuse a PDF that leaves the font to them."""
    page = Page(60.0, 40.0, (), (Text("30 mm, \u4e2d", 5, 10, 3),), "t")
    document = pikepdf.open(io.BytesIO(to_pdf([page])))
    fonts = document.pages[0].Resources.Font
    assert len(fonts) == 1
    assert all("/FontFile2" in font.FontDescriptor for font in fonts.values())
