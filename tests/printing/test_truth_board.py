"""The truth board: marks lie where the sidecar says in every format, and are read from each."""

import dataclasses
import io
import json

import cv2
import numpy as np
import pytest
import readers
from PIL import Image

import kpbench
from kpbench.calibration.marks import MarkFinder
from kpbench.errors import DesignError
from kpbench.patches.reference import ReferenceMark, reference_dictionary
from kpbench.printing import PageFormat, board_sheet, correct_sidecars, save_sheet, to_dxf, to_pdf, to_png, to_svg

A4 = PageFormat(210.0, 297.0)
TRUTH = kpbench.truth_board(kpbench.shipped_patches())
RING = kpbench.with_reference(kpbench.hexagon_board(kpbench.shipped_patches()[1], side_mm=150.0))
SHEETS = {
    "truth": board_sheet(TRUTH, A4),
    "mirrored": board_sheet(TRUTH, dataclasses.replace(A4, mirrored=True)),
    "tiled": board_sheet(RING, A4, tile=True),
}


def vertices(shapes):
    """First points of all segments of shapes, mm of the page."""
    return np.array([points[0] - readers.NODES[0] * slopes[0] for shape in shapes for points, slopes in shape])


def corners(sheet, page):
    return np.concatenate([m["page_corners_mm"] for m in sheet.sidecar["references"] if m["page"] == page])


@pytest.mark.parametrize("name", SHEETS)
def test_vector_formats_hold_every_corner_to_a_micrometre(name, tmp_path):
    sheet = SHEETS[name]
    pages, _ = readers.pdf_shapes(to_pdf(sheet.pages))
    for n, page in enumerate(sheet.pages):
        drawn = [readers.svg_shapes(to_svg(page))[0], pages[n], readers.dxf_shapes(to_dxf(page), tmp_path / "a.dxf")[0]]
        for shapes in drawn:
            found = vertices(shapes)
            for corner in corners(sheet, n + 1):
                assert (np.hypot(*(found - corner).T) < 1e-3).sum() >= 2, "two arms meet at each corner"


def test_every_mark_is_on_a_page_and_no_mark_is_near_a_patch():
    assert sum(len(corners(SHEETS["tiled"], n + 1)) for n in range(len(SHEETS["tiled"].pages))) == 4 * len(
        RING.references
    )
    for mark in TRUTH.references:
        for k in TRUTH.keypoints:
            beside = np.maximum(np.abs([k.x_mm - mark.x_mm, k.y_mm - mark.y_mm]) - mark.width_mm / 2, 0)
            assert np.hypot(*beside) > k.extent_mm * 1.4


def test_opencv_reads_the_marks_of_a_png_and_their_corners_lie_in_place(tmp_path):
    save_sheet(SHEETS["truth"], tmp_path, [".png"], 200)
    sidecar = json.loads((tmp_path / "truth.json").read_text())
    grey = np.asarray(Image.open(tmp_path / "truth.png"))
    _, ids, _ = cv2.aruco.ArucoDetector(reference_dictionary(sidecar["references"][0]["dictionary"])).detectMarkers(
        grey
    )
    assert sorted(ids.ravel().tolist()) == [m["id"] for m in sidecar["references"]]
    points = MarkFinder(kpbench.load_board(tmp_path / "truth.json")).find(cv2.GaussianBlur(grey, (0, 0), 1.0))
    expected = corners(SHEETS["truth"], 1) * sidecar["png"]["px_per_mm"] - 0.5
    assert points.index.tolist() == list(range(len(expected)))
    assert np.hypot(*(points.xy - expected).T).max() < 0.02


def test_patches_lie_in_place_beside_marks():
    sheet = SHEETS["truth"]
    known = {p.patch_id: p for p in kpbench.shipped_patches()}
    shapes = readers.svg_shapes(to_svg(sheet.pages[0]))[0]
    for k, shape in zip(sheet.sidecar["keypoints"], shapes, strict=False):
        expected = readers.ink_centroid_on_page(known[k["patch_id"]], k)
        assert np.hypot(*(readers.moments(shape)[1] - expected)) < 1e-3


def test_an_inverted_print_that_is_inverted_is_the_board():
    upright = np.asarray(Image.open(io.BytesIO(to_png(SHEETS["truth"].pages[0], 100))))
    inverted = board_sheet(TRUTH, dataclasses.replace(A4, inverted=True)).pages[0]
    turned = 255 - np.asarray(Image.open(io.BytesIO(to_png(inverted, 100))))
    mark = SHEETS["truth"].sidecar["references"][30]
    (left, top), (right, bottom) = (np.array(mark["page_corners_mm"])[[0, 2]] + [[-4], [4]]) / 0.254
    window = slice(int(top), int(bottom)), slice(int(left), int(right))
    assert np.abs(upright[window].astype(int) - turned[window]).max() <= 1


def test_a_sidecar_gives_the_board_back_also_after_a_print_check(tmp_path):
    save_sheet(SHEETS["truth"], tmp_path, [".svg"])
    assert kpbench.load_board(tmp_path / "truth.json").digest == TRUTH.digest
    correct_sidecars(tmp_path, (101.0, 99.0))
    measured = kpbench.load_board(tmp_path / "truth.measured.json")
    np.testing.assert_allclose(
        measured.references[0].corners_mm, TRUTH.references[0].corners_mm * [1.01, 0.99], atol=1e-5
    )


@pytest.mark.parametrize("key", ["kind", "dictionary", "id", "corners_mm"])
def test_a_wrong_mark_is_refused_in_one_line(key, tmp_path):
    save_sheet(SHEETS["truth"], tmp_path, [".svg"])
    content = json.loads((tmp_path / "truth.json").read_text())
    content["references"][2][key] = [[0, 0], [1, 0], [1, 1], [0.5, 1]] if key == "corners_mm" else "other"
    (tmp_path / "wrong.json").write_text(json.dumps(content))
    with pytest.raises(DesignError, match=rf"wrong\.json: .*references.*{key}"):
        kpbench.load_board(tmp_path / "wrong.json")


def test_marks_that_overlap_are_refused():
    near = ReferenceMark("DICT_4X4_100", 99, TRUTH.keypoints[0].x_mm, TRUTH.keypoints[0].y_mm, 5.0, 5.0)
    with pytest.raises(DesignError, match="reference mark 99"):
        dataclasses.replace(TRUTH, references=(*TRUTH.references, near))
