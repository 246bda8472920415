import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kpbench.errors import DesignError
from kpbench.geometry.homography import project
from kpbench.patches.board import Board, BoardKeypoint, grid_board, hexagon_board
from kpbench.patches.board_file import find_patch, load_board
from kpbench.patches.design import parse_patch, shipped_patches

PATCHES = shipped_patches()


def write(folder, text, name="mine.toml"):
    (folder / name).write_text(text, "utf-8")
    return folder / name


def keypoint(x, y, diameter=10.0, patch=PATCHES[0], rotate=0.0):
    return BoardKeypoint(patch, x, y, rotate, diameter)


@given(side=st.floats(10, 1000))
def test_hexagon_is_the_papers_board(side):
    board = hexagon_board(PATCHES[0], side)
    xy = board.points_mm[:, :2]
    assert len(board.keypoints) == 6
    assert (board.side_x_mm, board.side_y_mm) == (side, side)
    assert {k.diameter_mm for k in board.keypoints} == {0.16 * side}
    np.testing.assert_allclose(np.hypot(*xy.T), 0.36 * side)
    np.testing.assert_allclose(np.hypot(*(xy - np.roll(xy, 1, axis=0)).T), 0.36 * side)
    np.testing.assert_allclose(xy.mean(axis=0), 0, atol=1e-12 * side)
    turned = np.cross(np.c_[xy, np.zeros(6)], np.c_[np.roll(xy, -1, axis=0), np.zeros(6)])[:, 2]
    assert (turned > 0).all(), "clockwise to the eye, y down"
    assert (board.points_mm[:, 2] == 0).all()


def test_thirty_mm_discs_make_the_board_of_the_documentation():
    board = hexagon_board(PATCHES[0], 30 / 0.16)
    assert board.side_x_mm == 187.5
    assert board.keypoints[0].diameter_mm == pytest.approx(30)
    assert (board.keypoints[0].x_mm, board.keypoints[0].y_mm) == (67.5, 0)


def test_homography_of_a_keypoint():
    k = keypoint(3, 4, 20, rotate=90)
    np.testing.assert_allclose(project(k.H_patch2board, [[0, 0], [1, 0], [0, 1]]), [[3, 4], [3, 14], [-7, 4]])


def test_grid_mixes_designs_row_by_row():
    board = grid_board(PATCHES, 2, 3, 10, 25)
    assert (board.side_x_mm, board.side_y_mm) == (75, 50)
    np.testing.assert_allclose(board.points_mm[:4, :2], [[-25, -12.5], [0, -12.5], [25, -12.5], [-25, 12.5]])
    ids = [k.patch.patch_id for k in board.keypoints]
    assert ids == [PATCHES[n].patch_id for n in (0, 1, 2, 1, 2, 3)]
    assert board.patches == PATCHES


def test_digest_knows_every_printed_thing_and_nothing_else():
    board = grid_board(PATCHES, 2, 2, 10, 25)
    first = board.keypoints[0]

    def changed(**what):
        return dataclasses.replace(board, keypoints=(dataclasses.replace(first, **what), *board.keypoints[1:]))

    assert dataclasses.replace(board, name="other").digest == board.digest
    others = [
        changed(x_mm=first.x_mm + 1e-5),
        changed(y_mm=first.y_mm + 1e-5),
        changed(rotate_deg=1.0),
        changed(diameter_mm=9.0),
        changed(patch=PATCHES[2]),
        dataclasses.replace(board, side_x_mm=51.0),
        dataclasses.replace(board, side_y_mm=51.0),
        dataclasses.replace(board, keypoints=board.keypoints[::-1]),
    ]
    assert len({b.digest for b in [board, *others]}) == 9
    zero = Board("z", 50, 50, (keypoint(0.0, 0.0),))
    assert zero.digest == Board("z", 50, 50, (keypoint(-0.0, -1e-12),)).digest


def test_boards_that_cannot_be():
    rimmed = dataclasses.replace(PATCHES[0], rim=0.3)
    for keypoints, message in [
        ((), "board 'b' has no keypoints"),
        ((keypoint(0, 0), keypoint(9, 0)), "keypoints 0 and 1 overlap by 1 mm"),
        ((keypoint(20, 20), keypoint(-20, 0), keypoint(20, 11)), "keypoints 0 and 2 overlap by 1 mm"),
        ((keypoint(0, 0), keypoint(11, 0, patch=rimmed)), "keypoints 0 and 1 overlap by 0.5 mm, rims"),
        ((keypoint(0, 46),), r"keypoint 0 at \(0, 46\) mm reaches 1 mm over the edge of the 100 x 100 mm board"),
        ((keypoint(0, 0), keypoint(20, 0, patch=rimmed)), "two designs share the id 0"),
    ]:
        with pytest.raises(DesignError, match=message):
            Board("b", 100, 100, keypoints)
    Board("b", 100, 100, (keypoint(45, 45), keypoint(35, 45)))  # touching is fine


def test_find_patch_by_name_and_by_id():
    for patch in PATCHES:
        assert find_patch(PATCHES, patch.name) == patch
        assert find_patch(PATCHES, patch.patch_id) == find_patch(PATCHES, str(patch.patch_id)) == patch
    for key in ("nobody", 99, None, True, 0.5, ["x"]):
        with pytest.raises(DesignError, match="is not known; known are: "):
            find_patch(PATCHES, key)
    twins = (PATCHES[0], dataclasses.replace(PATCHES[1], name=PATCHES[0].name))
    with pytest.raises(DesignError, match="the name or ID of several designs"):
        find_patch(twins, PATCHES[0].name)


def test_board_file(tmp_path):
    path = write(
        tmp_path,
        f"""
        size_mm = [200, 100.5]
        diameter_mm = 20
        [[keypoint]]
        patch = "{PATCHES[1].name}"
        x_mm = -50
        y_mm = 12.5
        rotate_deg = 30
        [[keypoint]]
        patch = 0
        x_mm = 40
        y_mm = 0
        diameter_mm = 8
        """,
    )
    board = load_board(path)
    assert board == Board(
        "mine", 200.0, 100.5, (keypoint(-50, 12.5, 20, PATCHES[1], 30), keypoint(40, 0, 8, PATCHES[0]))
    )


def test_board_file_without_sizes_is_as_large_as_its_patches(tmp_path):
    path = write(tmp_path, 'name = "n"\n[[keypoint]]\npatch = 0\nx_mm = 10\ny_mm = -20')
    assert load_board(path) == Board("n", 50, 70, (keypoint(10, -20, 30),))
    assert load_board(path, diameter_mm=8) == Board("n", 28, 48, (keypoint(10, -20, 8),))


def test_board_file_with_grid_and_own_designs(tmp_path):
    write(
        tmp_path,
        'name = "mine"\nid = 7\nsemicircles = [{ start_deg = 0, ink = "black" }]\nquiet_zone = 0.2',
        "patch.toml",
    )
    path = write(tmp_path, 'designs = ["patch.toml"]\n[grid]\nrows = 2\ncolumns = 3\npitch_mm = 40\npatches = ["mine"]')
    board = load_board(path)
    assert [p.patch_id for p in board.patches] == [7]
    assert (board.side_x_mm, board.side_y_mm, len(board.keypoints)) == (120, 80, 6)
    with pytest.raises(DesignError, match="the file sets the key designs, and other designs are given"):
        load_board(path, PATCHES)


GRID = "[grid]\nrows = 2\ncolumns = 2\n"
POINT = "[[keypoint]]\npatch = 0\nx_mm = 0\ny_mm = 0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"expected one \[grid\], or at least one \[\[keypoint\]\], and not both"),
        (GRID + POINT, "expected one"),
        ("x = ", "not valid TOML"),
        ('schema = "kpbench.board-design/9"\n' + GRID, "schema is 'kpbench.board-design/9', expected"),
        ("colour = 1\n" + GRID, "unknown key 'colour'; known are: schema, name"),
        ('name = ""\n' + GRID, "name is '', expected a name of at most 100 letters"),
        ("diameter_mm = 0\n" + GRID, "diameter_mm is 0, expected a number from 0.1 to 5000"),
        ("diameter_mm = nan\n" + GRID, "diameter_mm is nan, expected a number"),
        ("size_mm = 3\n" + GRID, "size_mm is 3, expected a list of 2 numbers"),
        ("size_mm = [3, 'a']\n" + GRID, r"size_mm\[1\] is 'a', expected a number"),
        ("size_mm = [50, 500]\n" + GRID, "reaches 20 mm over the edge of the 50 x 500 mm board"),
        ("designs = 'a.toml'\n" + GRID, "designs is 'a.toml', expected a list of file names"),
        ("[grid]\nrows = 2", "grid.columns is missing, expected a whole number from 1 to 100"),
        ("[grid]\nrows = 2.5\ncolumns = 1", "grid.rows is 2.5, expected a whole number"),
        (GRID + "pitch_mm = 20", "keypoints 0 and 1 overlap by 10 mm"),
        (GRID + "patches = []", r"grid.patches is \[\], expected a list of names or ids"),
        (GRID + "patches = ['nobody']", "patch 'nobody' is not known; known are: "),
        ("grid = 3", "grid is 3, expected a table with: rows"),
        ("keypoint = 3", "keypoint is 3, expected a list of tables with: patch"),
        ("keypoint = [3]", r"keypoint\[0\] is 3, expected a table with: patch"),
        ("keypoint = []", "has no keypoints"),
        (POINT + "[[keypoint]]\nx_mm = 0", r"keypoint\[1\]: patch None is not known"),
        ("[[keypoint]]\npatch = 0\nx_mm = 0", r"keypoint\[0\].y_mm is missing, expected a number"),
        (POINT + "x = 3", r"unknown key 'x' in keypoint\[0\]"),
        (POINT + "rotate_deg = 400", r"keypoint\[0\].rotate_deg is 400, expected a number from -360 to 360"),
        (POINT + "diameter_mm = '3'", r"keypoint\[0\].diameter_mm is '3', expected a number"),
    ],
)
def test_bad_board_file_says_where_and_what(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(DesignError, match=message) as caught:
        load_board(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(DesignError, match=r"none.toml: cannot be read"):
        load_board(tmp_path / "none.toml")
    path = write(tmp_path, 'designs = ["gone.toml"]\n' + GRID)
    with pytest.raises(DesignError, match=r"gone.toml: cannot be read"):
        load_board(path)


def test_diameter_from_two_sides_is_refused(tmp_path):
    path = write(tmp_path, "diameter_mm = 20\n" + GRID)
    assert load_board(path).keypoints[0].diameter_mm == 20
    with pytest.raises(DesignError, match="the file sets the key diameter_mm, and `diameter_mm` is 30"):
        load_board(path, diameter_mm=30)


def test_hexagon_of_a_patch_with_a_wide_quiet_zone():
    table = {"name": "wide", "id": 9, "semicircles": [], "quiet_zone": 1.0}
    with pytest.raises(DesignError, match=r"'hexagon-wide': keypoint 0 .* reaches"):
        hexagon_board(parse_patch(table, "t"), 100)
