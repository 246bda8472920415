import dataclasses
import io
import json
import re
import shutil
import subprocess

import numpy as np
import pypdfium2
import pytest
import readers
from PIL import Image

from kpbench.errors import DataError, DesignError
from kpbench.geometry.outline import flatten
from kpbench.patches.board import Board, BoardKeypoint, grid_board, hexagon_board
from kpbench.patches.design import parse_patch, shipped_patches
from kpbench.patches.field import field_board
from kpbench.printing.dxf import to_dxf
from kpbench.printing.formats import PAGE_WRITERS
from kpbench.printing.page import CUT, INK, MARKS
from kpbench.printing.page_format import PAGE_SIZES_MM, PageFormat, parse_page_format
from kpbench.printing.pdf import to_pdf
from kpbench.printing.png import to_png
from kpbench.printing.prints import save_sheet
from kpbench.printing.sheet import board_sheet, patch_sheet
from kpbench.printing.svg import to_svg

A4 = PageFormat(210, 297)
# A rim and a quiet zone, rings, three directions of edges, and no symmetry.
RIMMED = parse_patch(
    {
        "name": "rimmed",
        "id": 11,
        "disc": "black",
        "semicircles": [
            {"radius": 1.0, "start_deg": 20, "ink": "white"},
            {"radius": 0.7, "start_deg": 75, "ink": "invert"},
            {"radius": 0.35, "start_deg": 310, "ink": "invert"},
        ],
        "rim": {"width": 0.15, "ink": "black"},
        "quiet_zone": 0.2,
    },
    "test",
)
PATCHES = (*shipped_patches(), RIMMED)
MIXED = Board(
    "mixed",
    180.0,
    250.0,
    tuple(
        BoardKeypoint(PATCHES[n % len(PATCHES)], x, y, 17.3 * n, 12.0 + 3 * n)
        for n, (x, y) in enumerate([(-70.1, -100.3), (-20.7, -90.9), (40.4, -80.2), (-50.5, 10.1), (40.6, 60.3)])
    ),
)
SHEETS = {
    "patches": patch_sheet(PATCHES, 30, A4),
    "copies": patch_sheet(PATCHES, 33.3, PageFormat(150, 120), copies=3),
    "tiny": patch_sheet(PATCHES, 5, PageFormat(60, 60)),
    "grid": board_sheet(grid_board(PATCHES, 4, 3, 30, 60), A4),
    "mixed": board_sheet(MIXED, A4),
    "mirrored": board_sheet(MIXED, PageFormat(210, 297, mirrored=True)),
    "bare": patch_sheet(PATCHES, 30, PageFormat(210, 297, labels=False)),
    "tiled": board_sheet(hexagon_board(RIMMED, 350), A4, tile=True),
    "field": board_sheet(field_board(PATCHES[:4]), A4),
    "tiled-field": board_sheet(field_board(PATCHES[:4], 12, 9, 20.0), A4, tile=True),
    **{f"hexagon-{p.patch_id}": board_sheet(hexagon_board(p, 187.5), A4) for p in PATCHES},
}


def by_page(sheet):
    """(page index, keypoints on it, where their ink's centroid should be), in the order of the shapes."""
    known = {p.patch_id: p for p in PATCHES}
    for n in range(len(sheet.pages)):
        here = [k for k in sheet.sidecar["keypoints"] if k["page"] == n + 1]
        mirrored = sheet.sidecar["mirrored"]
        yield n, here, [readers.ink_centroid_on_page(known[k["patch_id"]], k, mirrored) for k in here]


def worst_mm(shapes, expected):
    assert len(shapes) == len(expected)
    return max((np.hypot(*(readers.moments(s)[1] - e)) for s, e in zip(shapes, expected, strict=True)), default=0.0)


@pytest.mark.parametrize("name", SHEETS)
def test_svg_and_pdf_put_every_keypoint_where_the_sidecar_says(name):
    sheet = SHEETS[name]
    pages, sizes = readers.pdf_shapes(to_pdf(sheet.pages))
    for n, _, expected in by_page(sheet):
        shapes, size = readers.svg_shapes(to_svg(sheet.pages[n]))
        assert list(size) == sheet.sidecar["page_mm"]
        assert worst_mm(shapes, expected) < 1e-5
        printed = [s for s in sheet.pages[n].shapes if s.layer != CUT]
        assert len(pages[n]) == len(printed)
        inked = [drawn for drawn, s in zip(pages[n], printed, strict=True) if s.layer == INK]
        assert worst_mm(inked, expected) < 1e-4
        np.testing.assert_allclose(sizes[n], size, atol=1e-4)


@pytest.mark.parametrize("name", ["patches", "mixed", "mirrored", "tiled"])
def test_dxf_puts_every_keypoint_where_the_sidecar_says(name, tmp_path):
    sheet = SHEETS[name]
    for n, here, expected in by_page(sheet):
        contours, _ = readers.dxf_shapes(to_dxf(sheet.pages[n]), tmp_path / "a.dxf")
        counts = [len(s.region) for s in sheet.pages[n].shapes if s.layer == INK]
        parts = iter(contours)
        shapes = [[seg for _ in range(count) for seg in next(parts)] for count in counts]
        assert worst_mm(shapes, expected) < 1e-6
        assert len(here) == len(shapes)


@pytest.mark.parametrize(("name", "dpi"), [("patches", 600), ("mixed", 300), ("mirrored", 300), ("tiny", 1200)])
def test_png_puts_every_keypoint_where_the_sidecar_says(name, dpi, tmp_path):
    sheet = SHEETS[name]
    save_sheet(sheet, tmp_path, [".png"], dpi)
    saved = json.loads(next(tmp_path.glob("*.json")).read_text())
    scale = saved["png"]["px_per_mm"]
    for n, here, expected in by_page(sheet):
        grey = np.asarray(Image.open(io.BytesIO(to_png(sheet.pages[n], dpi))))
        for k, mm in zip(here, expected, strict=True):
            patch = next(p for p in PATCHES if p.patch_id == k["patch_id"])
            reach = (patch.extent * k["diameter_mm"] / 2 + 0.5) * scale  # cut marks begin 1 mm off
            x, y = np.array([k["page_x_mm"], k["page_y_mm"]]) * scale - 0.5
            off = readers.dark_centroid(grey, x, y, reach) - (mm * scale - 0.5)
            assert np.hypot(*off) < 0.005, "px"


def test_marks_keep_clear_of_the_ink():
    """Nothing but the patch itself within the disc, its rim and its quiet zone."""
    for sheet in SHEETS.values():
        for n, here, _ in by_page(sheet):
            marks = [s for s in sheet.pages[n].shapes if s.layer == MARKS]
            corners = np.concatenate([polygon for s in marks for polygon in flatten(s.region, 0.01)])
            for k in here:
                patch = next(p for p in PATCHES if p.patch_id == k["patch_id"])
                near = np.hypot(*(corners - [k["page_x_mm"], k["page_y_mm"]]).T).min()
                assert near > patch.extent * k["diameter_mm"] / 2 + 0.9
            for shape in sheet.pages[n].shapes:
                points = np.concatenate(flatten(shape.region, 0.01))
                assert points.min() >= 5 - 0.06, "printers leave 5 mm blank"
                assert (sheet.sidecar["page_mm"] - points.max(axis=0)).min() >= 5 - 0.06


def test_rulers_measure_what_they_say():
    for paper, lengths in ((A4, (100, 100)), (PageFormat(70, 120), (40, 90)), (PageFormat(40, 40), (10, 10))):
        assert paper.rulers_mm == lengths
        page = patch_sheet(PATCHES[:1], 3, paper).pages[0]
        for axis, (shape, length) in enumerate(zip(page.shapes[:2], lengths, strict=True)):
            ends = sorted({part.x0 if axis == 0 else part.y0 for part in shape.region[0]})
            np.testing.assert_allclose(ends[-1] - ends[0], length + 0.1)  # ticks are 0.1 mm wide
            centres = (np.array(ends[::2]) + ends[1::2]) / 2
            np.testing.assert_allclose(np.diff(centres), 1.0, atol=1e-9)
            assert len(centres) == length + 1
        assert {f"{lengths[0]} mm", f"{lengths[1]}"} <= {t.text for t in page.texts}


def test_labels_name_the_design_and_its_digest_or_nothing_at_all():
    texts = " ".join(t.text for t in SHEETS["patches"].pages[0].texts)
    for patch in PATCHES:
        assert f"{patch.name}, id {patch.patch_id}, {patch.digest[:8]}" in texts
    assert "disc diameter 30 mm without rim" in texts
    assert "print at 100 %" in texts
    board = hexagon_board(RIMMED, 187.5)
    assert f"{board.name}, {board.digest[:12]}" in [t.text for t in board_sheet(board, A4).pages[0].texts]
    assert not SHEETS["bare"].pages[0].texts
    assert SHEETS["bare"].pages[0].shapes == SHEETS["patches"].pages[0].shapes


def test_every_patch_is_cut_out_by_its_own_circle():
    for n, here, _ in by_page(SHEETS["copies"]):
        cuts = [s.region[0][0] for s in SHEETS["copies"].pages[n].shapes if s.layer == CUT]
        np.testing.assert_allclose(
            [(c.x, c.y) for c in cuts], [(k["page_x_mm"], k["page_y_mm"]) for k in here], atol=1e-6
        )


def test_copies_run_over_pages():
    sheet = SHEETS["copies"]
    assert len(sheet.pages) > 1
    ids = [k["patch_id"] for k in sheet.sidecar["keypoints"]]
    assert ids == [p.patch_id for p in PATCHES for _ in range(3)]
    assert [k["page"] for k in sheet.sidecar["keypoints"]] == sorted(k["page"] for k in sheet.sidecar["keypoints"])


@pytest.mark.parametrize("paper", [A4, PageFormat(297, 210), PageFormat(60, 400), PageFormat(40, 40)])
def test_what_does_not_fit_names_the_largest_that_does(paper):
    def largest(draw):
        with pytest.raises(DesignError, match="the largest diameter that") as caught:
            draw(500.0)
        return float(re.findall(r"is ([\d.]+) mm", str(caught.value))[-1])

    def sheet(diameter):
        return patch_sheet(PATCHES, diameter, paper)

    def board(diameter):
        return board_sheet(hexagon_board(PATCHES[0], diameter / 0.16), paper)

    for draw in (sheet, board):
        fits = largest(draw)
        draw(fits)
        with pytest.raises(DesignError):
            draw(fits + 0.02)


def test_a4_holds_the_thirty_mm_hexagon():
    with pytest.raises(DesignError, match=r"is 30\.08 mm; `tile=True` spreads"):
        board_sheet(hexagon_board(PATCHES[0], 200), A4)


@pytest.mark.parametrize("name", PAGE_SIZES_MM)
def test_papers(name):
    width, height = PAGE_SIZES_MM[name]
    assert parse_page_format(name.upper()) == PageFormat(width, height)
    assert parse_page_format(name, landscape=True) == PageFormat(height, width)
    if name[0] == "a":  # ISO 216: each is half of the one before, in whole mm
        long = round(1000 * 2 ** (0.25 - int(name[1]) / 2))
        assert abs(height - long) <= 1
        assert abs(width - round(1000 * 2 ** (-0.25 - int(name[1]) / 2))) <= 1


def test_custom_papers():
    assert parse_page_format("600x400mm") == parse_page_format("600X400") == PageFormat(600, 400)
    assert parse_page_format("100.5x99.25mm", labels=False, mirrored=True) == PageFormat(100.5, 99.25, False, True)
    for bad in ("a9", "", "10x", "x10", "-50x50mm", "100x100in", "1e3x100", "nanx100"):
        with pytest.raises(DesignError, match="expected a4, a3"):
            parse_page_format(bad)
    for bad in ("39x100mm", "100x5001mm"):
        with pytest.raises(DesignError, match="expected 40 to 5000 mm a side"):
            parse_page_format(bad)


def test_sidecar_of_a_board_goes_into_solvepnp():
    sidecar = SHEETS["mixed"].sidecar
    assert sidecar["schema"] == "kpbench.board/1"
    assert sidecar["digest"] == MIXED.digest
    points = [[k["x_mm"], k["y_mm"], k["z_mm"]] for k in sidecar["keypoints"]]
    np.testing.assert_allclose(points, MIXED.points_mm, atol=1e-6)
    assert [k["rotate_deg"] for k in sidecar["keypoints"]] == [k.rotate_deg for k in MIXED.keypoints]
    digests = {p["id"]: p["digest"] for p in sidecar["patches"]}
    assert digests == {k.patch.patch_id: k.patch.digest for k in MIXED.keypoints}
    page = np.array([[k["page_x_mm"], k["page_y_mm"]] for k in sidecar["keypoints"]])
    np.testing.assert_allclose(page - MIXED.points_mm[:, :2], [[105, 148.5]] * 5, atol=2e-6)
    mirrored = SHEETS["mirrored"].sidecar
    assert mirrored["mirrored"] is True
    assert [k["x_mm"] for k in mirrored["keypoints"]] == [k["x_mm"] for k in sidecar["keypoints"]]
    assert [k["page_x_mm"] for k in mirrored["keypoints"]] == pytest.approx(210 - page[:, 0])


@pytest.mark.parametrize("suffix", PAGE_WRITERS)
def test_two_runs_write_the_same_bytes(suffix, tmp_path):
    for folder in ("a", "b"):
        save_sheet(board_sheet(dataclasses.replace(MIXED), A4), tmp_path / folder, [suffix], 100)
    names = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert names == sorted([f"mixed{suffix}", "mixed.json"])
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_file_names(tmp_path):
    written = save_sheet(SHEETS["tiled"], tmp_path, [".pdf", ".svg"])
    count = len(SHEETS["tiled"].pages)
    assert count > 1
    names = ["hexagon-rimmed.pdf", *(f"hexagon-rimmed-{n + 1}.svg" for n in range(count)), "hexagon-rimmed.json"]
    assert [p.name for p in written] == names
    odd = dataclasses.replace(SHEETS["mixed"], name="../a b/ç\x00..")
    assert [p.name for p in save_sheet(odd, tmp_path, [])] == ["a-b-ç.json"]


def test_a_folder_that_cannot_be(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file: cannot be made"):
        save_sheet(SHEETS["mixed"], tmp_path / "file", [".svg"])


def test_tile_pages_tell_their_place_and_share_their_corners():
    sheet = SHEETS["tiled"]
    corners = {}
    for tile, page in zip(sheet.sidecar["tiles"], sheet.pages, strict=True):
        texts = [t.text for t in page.texts]
        assert any(f"tile row {tile['row']} of 2, column {tile['column']} of 2" in t for t in texts)
        for c in tile["corners"]:
            assert f"({c['x_mm']:.3f}, {c['y_mm']:.3f})" in texts
            corners.setdefault((c["x_mm"], c["y_mm"]), []).append(tile["page"])
    assert sorted(len(pages) for pages in corners.values()) == [1, 1, 1, 1, 2, 2, 2, 2, 4]


def poppler(content, folder, dpi):
    """All pages of a PDF as grey arrays."""
    (folder / "a.pdf").write_bytes(content)
    subprocess.run(["pdftoppm", "-gray", "-r", str(dpi), "a.pdf", "p"], cwd=folder, check=True)
    return [np.asarray(Image.open(path)).astype(float) for path in sorted(folder.glob("p-*.pgm"))]


def arm_centre(grey, x, y, along, across):
    """Middle, across the arm, of one arm of a cross; ``along`` is the arm's direction, in px."""
    centres = []
    for step in np.linspace(0.4, 0.9, 9):
        at = np.round([x + step * along[0], y + step * along[1]]).astype(int)
        reach = np.arange(-across, across + 1)
        ink = 255 - (grey[at[1], at[0] + reach] if along[0] == 0 else grey[at[1] + reach, at[0]])
        centres.append((at[0] if along[0] == 0 else at[1]) + np.sum(ink * reach) / ink.sum())
    return np.median(centres)


@pytest.mark.skipif(not shutil.which("pdftoppm"), reason="needs poppler")
def test_tiles_put_together_by_their_marks_are_the_board(tmp_path):
    dpi, known = 200, RIMMED
    px = dpi / 25.4
    sheet = SHEETS["tiled"]
    images = poppler(to_pdf(sheet.pages), tmp_path, dpi)
    assert len(images) == 4
    errors = []
    for image, tile in zip(images, sheet.sidecar["tiles"], strict=True):
        # pages come out of a scanner anyhow: nothing below may know where the tile is on its page
        grey = np.roll(image, (3 * tile["page"], -5 * tile["page"]), axis=(0, 1))
        offset = np.array([-5 * tile["page"], 3 * tile["page"]])
        seen, board = [], []
        xs = sorted({c["x_mm"] for c in tile["corners"]})
        for c in tile["corners"]:
            x, y = np.array([c["page_x_mm"], c["page_y_mm"]]) * px - 0.5 + offset
            out_x = -2.5 * px if c["x_mm"] == xs[0] else 2.5 * px
            out_y = -2.5 * px if c["y_mm"] == min(o["y_mm"] for o in tile["corners"]) else 2.5 * px
            across = round(0.6 * px)
            seen.append([arm_centre(grey, x, y, (0, out_y), across), arm_centre(grey, x, y, (out_x, 0), across)])
            board.append([c["x_mm"], c["y_mm"]])
        A = np.column_stack([seen, np.ones(4)])
        page2board = np.linalg.lstsq(A, np.array(board), rcond=None)[0]
        for k in sheet.sidecar["keypoints"]:
            if k["page"] == tile["page"]:
                x, y = np.array([k["page_x_mm"], k["page_y_mm"]]) * px - 0.5 + offset
                reach = (known.extent * k["diameter_mm"] / 2 + 0.5) * px
                got = np.append(readers.dark_centroid(grey, x, y, reach), 1) @ page2board
                got = got - k["diameter_mm"] / 2 * readers.ink_centroid(known)[1]
                errors.append(np.hypot(*(got - [k["x_mm"], k["y_mm"]])))
    assert len(errors) == 6
    assert max(errors) < 0.05, "mm"


@pytest.mark.skipif(not shutil.which("pdftoppm"), reason="needs poppler")
def test_poppler_sees_the_keypoints_too(tmp_path):
    sheet = SHEETS["mixed"]
    (grey,) = poppler(to_pdf(sheet.pages), tmp_path, 300)
    check_raster(sheet, grey, 300 / 25.4, 0.2)  # it samples each pixel 4 x 4 times


def test_pdfium_sees_the_keypoints_too():
    """It places an edge anywhere in a pixel, but stretches a page to whole pixels, as this one is."""
    sheet, dpi = board_sheet(MIXED, PageFormat(254, 381)), 300
    drawn = pypdfium2.PdfDocument(to_pdf(sheet.pages))[0].render(scale=dpi / 72, grayscale=True).to_numpy()
    assert drawn.shape[:2] == (4500, 3000)
    check_raster(sheet, drawn.reshape(4500, 3000).astype(float), dpi / 25.4, 0.05)


@pytest.mark.skipif(not shutil.which("rsvg-convert"), reason="needs librsvg")
def test_librsvg_sees_the_keypoints_too(tmp_path):
    sheet = SHEETS["mixed"]
    (tmp_path / "a.svg").write_bytes(to_svg(sheet.pages[0]))
    command = ["rsvg-convert", "-d", "300", "-p", "300", "-b", "white", "-o", "a.png", "a.svg"]
    subprocess.run(command, cwd=tmp_path, check=True)
    check_raster(sheet, np.asarray(Image.open(tmp_path / "a.png").convert("L")).astype(float), 300 / 25.4, 0.05)


def check_raster(sheet, grey, px, limit):
    for _, here, expected in by_page(sheet):
        for k, mm in zip(here, expected, strict=True):
            patch = next(p for p in PATCHES if p.patch_id == k["patch_id"])
            x, y = np.array([k["page_x_mm"], k["page_y_mm"]]) * px - 0.5
            off = readers.dark_centroid(grey, x, y, (patch.extent * k["diameter_mm"] / 2 + 0.5) * px) - (mm * px - 0.5)
            assert np.hypot(*off) < limit, "px"
