"""A print is measured in photographs."""

import dataclasses
import json

import board_photos
from helpers import kpbench as run

import kpbench


def stretched(sx):
    board = board_photos.BOARD
    marks = [dataclasses.replace(m, x_mm=m.x_mm * sx, width_mm=m.width_mm * sx) for m in board.references]
    points = [dataclasses.replace(k, x_mm=k.x_mm * sx) for k in board.keypoints]
    return dataclasses.replace(board, references=tuple(marks), keypoints=tuple(points))


def test_a_print_that_is_too_narrow_is_measured_and_its_sidecar_corrected(here):
    kpbench.print_boards([board_photos.BOARD], "print", formats=["svg"])
    board_photos.write_photos("photos", 5, board=stretched(0.985))
    done = run("print-check", "photos", "--board", "print/truth.json", "--ruler-mm", "98.5,100.0")
    assert "x to y: 0.98" in done.stdout
    assert "say" not in done.stderr
    content = json.loads((here / "print" / "truth.measured.json").read_text())
    assert abs(content["print_scale"][0] - 0.985) < 5e-4
    assert abs(content["print_scale"][1] - 1.0) < 5e-4
    corrected = kpbench.load_board("print/truth.measured.json")
    assert abs(corrected.references[0].x_mm / board_photos.BOARD.references[0].x_mm - 0.985) < 5e-4
    swapped = run("print-check", "photos", "--board", "print/truth.json", "--ruler-mm", "100.0,98.5")
    assert "were the rulers swapped?" in swapped.stderr
