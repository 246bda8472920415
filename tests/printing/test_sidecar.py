import json

import numpy as np
import pytest

from kpbench.errors import DesignError
from kpbench.patches.board import hexagon_board
from kpbench.patches.design import shipped_patches
from kpbench.printing.page_format import PageFormat
from kpbench.printing.prints import save_sheet
from kpbench.printing.sheet import board_sheet, patch_sheet
from kpbench.printing.sidecar import correct_sidecar, correct_sidecars

BOARD = board_sheet(hexagon_board(shipped_patches()[0], 350), PageFormat(210, 297), tile=True)
SHEET = patch_sheet(shipped_patches(), 20, PageFormat(120, 80))


def test_positions_follow_each_ruler():
    after = correct_sidecar(BOARD.sidecar, (99.0, 102.0))
    assert after["print_scale"] == [0.99, 1.02]
    assert after["side_mm"] == [346.5, 357.0]
    for k, nominal in zip(after["keypoints"], BOARD.sidecar["keypoints"], strict=True):
        assert k["x_mm"] == pytest.approx(0.99 * nominal["x_mm"], abs=1e-6)
        assert k["y_mm"] == pytest.approx(1.02 * nominal["y_mm"], abs=1e-6)
        assert k["diameter_mm"] == pytest.approx(56 * np.sqrt(0.99 * 1.02), abs=1e-6)
        assert k["page_x_mm"] == nominal["page_x_mm"]
        assert k["index"] == nominal["index"]
    assert after["tiles"][0]["corners"][0]["x_mm"] == pytest.approx(-0.99 * 175)
    unchanged = set(BOARD.sidecar) - {"print_scale", "side_mm", "keypoints", "tiles"}
    assert {key: after[key] for key in unchanged} == {key: BOARD.sidecar[key] for key in unchanged}


def test_a_true_print_changes_nothing():
    assert correct_sidecar(BOARD.sidecar, (100, 100)) == BOARD.sidecar


def test_a_corrected_sidecar_is_not_corrected_again():
    after = correct_sidecar(BOARD.sidecar, (99.0, 102.0))
    with pytest.raises(DesignError, match=r"^is corrected already, print_scale is \[0\.99, 1\.02\]; expected the side"):
        correct_sidecar(after, (99.0, 102.0))


def test_short_rulers_count_as_what_they_are():
    assert SHEET.sidecar["ruler_mm"] == [90, 50]
    after = correct_sidecar(SHEET.sidecar, (90.9, 49.5))
    assert after["print_scale"] == pytest.approx([1.01, 0.99])
    assert after["keypoints"][0]["diameter_mm"] == pytest.approx(20 * np.sqrt(1.01 * 0.99))


@pytest.mark.parametrize("measured", [(1.0, 100.0), (111.0, 100.0), (float("nan"), 100.0)])
def test_a_length_that_cannot_be_is_refused(measured):
    with pytest.raises(DesignError, match=r"the x ruler is 100 mm, but .* mm was measured; expected 90 to 110"):
        correct_sidecar(BOARD.sidecar, measured)
    with pytest.raises(DesignError, match="the y ruler"):
        correct_sidecar(BOARD.sidecar, measured[::-1])


def test_a_folder_of_prints(tmp_path):
    save_sheet(BOARD, tmp_path, [])
    save_sheet(SHEET, tmp_path, [])
    (tmp_path / "other.json").write_text('{"schema": "something/1"}')
    (tmp_path / "list.json").write_text("[1]")
    with pytest.raises(DesignError, match="y ruler is 50 mm"):
        correct_sidecars(tmp_path, (99.0, 99.0))
    (tmp_path / "patches.json").unlink()
    for _ in range(2):  # the second time starts from the nominal sidecar again
        assert [p.name for p in correct_sidecars(tmp_path, (99.0, 101.0))] == [f"{BOARD.name}.measured.json"]
    assert json.loads((tmp_path / f"{BOARD.name}.measured.json").read_text()) == correct_sidecar(
        BOARD.sidecar, (99.0, 101.0)
    )


def test_what_is_no_sidecar(tmp_path):
    with pytest.raises(DesignError, match="no sidecar of a board or sheet in it; print first"):
        correct_sidecars(tmp_path, (100, 100))
    for text in ("{", '{"schema": "kpbench.board/1"}', '{"schema": "kpbench.sheet/1", "ruler_mm": 3}'):
        (tmp_path / "broken.json").write_text(text)
        with pytest.raises(DesignError, match=r"broken\.json: (no complete sidecar|ruler_mm is)"):
            correct_sidecars(tmp_path, (100, 100))
