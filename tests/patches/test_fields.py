"""Patch fields: what is promised of the shipped letters, and the boards that carry them."""

import importlib.util
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpbench import field_board, field_boards, grid_board, load_board, print_boards, shipped_patches
from kpbench.errors import DesignError
from kpbench.files import shipped_folder
from kpbench.patches import field_distance, shipped_field
from kpbench.patches.field import SHIPPED_DISTANCES
from kpbench.patches.lattice import window_words

ROOT = Path(__file__).parents[2]
spec = importlib.util.spec_from_file_location("search_fields", ROOT / "benchmarks" / "designs" / "search_fields.py")
search_fields = importlib.util.module_from_spec(spec)
spec.loader.exec_module(search_fields)


def words_one_by_one(letters, rows, columns):
    """The words of all windows of a field in four rotations, by indices alone."""
    words = []
    for top, left in itertools.product(range(len(letters) - rows + 1), range(len(letters[0]) - columns + 1)):
        window = {(r, c): letters[top + r][left + c] for r in range(rows) for c in range(columns)}
        for _ in range(4):
            words.append(tuple(window[r, c] for r in range(rows) for c in range(columns)))
            window = {(c, rows - 1 - r): letter for (r, c), letter in window.items()}
    return words


@pytest.mark.parametrize("distance", SHIPPED_DISTANCES)
def test_every_window_of_a_field_differs_from_all_others_in_all_rotations(distance):
    letters = shipped_field(distance)
    assert set(np.unique(letters)) == {0, 1, 2, 3}
    words = words_one_by_one(letters.tolist(), 3, 3)
    assert len({*words}) == len(words) == 4 * (letters.shape[0] - 2) * (letters.shape[1] - 2)
    if len(words) < 1500:
        pairs = itertools.combinations(words, 2)
        assert min(sum(a != b for a, b in zip(*pair, strict=True)) for pair in pairs) == distance
    else:
        table = np.array(words, np.int8)
        least = 9
        for n in range(len(table) - 1):
            least = min(least, int((table[n + 1 :] != table[n]).sum(axis=1).min()))
        assert least == distance
    assert field_distance(letters) == distance


def test_windows_of_2_x_2_of_the_small_field_differ_in_all_rotations():
    letters = [
        list(map(int, line))
        for line in (shipped_folder("patches") / "fields" / "2x2-distance-1.txt").read_text().split()
    ]
    words = words_one_by_one(letters, 2, 2)
    assert len({*words}) == len(words) == 4 * 49
    assert field_distance(np.array(letters), (2, 2)) == 1


def test_the_distance_tells_repeated_windows_and_rotations():
    letters = shipped_field(4).copy()
    letters[:3, 5:8] = np.rot90(letters[:3, :3])
    assert field_distance(letters) == 0
    assert field_distance(np.zeros((3, 3), int)) == 0
    assert field_distance(np.array([[0, 1, 2], [3, 0, 1]]), (2, 3)) > 0


def test_a_search_keeps_its_promise_and_repeats_itself():
    fields = []
    for _ in range(2):
        search = search_fields.Search((6, 6), (3, 3), 3, seed=5)
        assert search.run(20_000) == 6
        fields.append(search.field)
    assert np.array_equal(*fields)
    assert field_distance(fields[0].astype(int)) >= 3


@pytest.mark.parametrize(
    ("rows", "columns", "least"), [(5, 6, 5), (6, 5, 5), (10, 7, 4), (8, 11, 4), (19, 16, 3), (40, 50, 2)]
)
def test_a_board_has_the_letters_of_the_best_field_that_is_large_enough(rows, columns, least):
    board = field_board(shipped_patches(), rows, columns)
    assert board.lattice.ids.shape == (rows, columns)
    assert field_distance(board.lattice.ids) >= least
    assert board.lattice.points.ravel().tolist() == list(range(rows * columns))
    assert board.lattice.pitch == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("count", "rows", "columns", "least"), [(32, 10, 7, 2), (9, 5, 5, 3), (12, 5, 4, 3), (4, 5, 4, 4)]
)
def test_no_window_of_several_fields_is_near_one_of_another(count, rows, columns, least):
    boards = field_boards(shipped_patches(), count, rows, columns)
    assert len({board.name for board in boards}) == len({board.digest for board in boards}) == count
    words = np.concatenate([window_words(board.lattice.ids) for board in boards]).astype(np.int8)
    assert len(words) == 4 * count * (rows - 2) * (columns - 2)
    assert min(int((words[n + 1 :] != words[n]).sum(axis=1).min()) for n in range(len(words) - 1)) >= least


def test_a_printed_field_comes_back_from_its_sidecar(tmp_path):
    board = field_board(shipped_patches(), 12, 9, diameter_mm=20.0)
    files = print_boards([board], tmp_path, page="a4", tile=True)
    read = load_board(files[-1])
    assert read.digest == board.digest
    assert np.array_equal(read.lattice.ids, board.lattice.ids)


def test_a_board_is_found_as_a_field_if_it_says_so(tmp_path):
    """Not for its windows alone: a grid with the letters of a field stays a grid."""
    field = field_board(shipped_patches(), 3, 4)
    assert field.lattice.ids.shape == (3, 4)
    assert replace(field, is_field=False).lattice is None
    lines = [f"{{ patch = {k.patch_id}, x_mm = {k.x_mm}, y_mm = {k.y_mm} }}" for k in field.keypoints]
    text = f"diameter_mm = 16\nkeypoint = [{', '.join(lines)}]\n"
    (tmp_path / "board.toml").write_text(text)
    assert load_board(tmp_path / "board.toml").lattice is None
    (tmp_path / "field.toml").write_text(f"field = true\n{text}")
    assert np.array_equal(load_board(tmp_path / "field.toml").lattice.ids, field.lattice.ids)
    print_boards([replace(field, is_field=False)], tmp_path, formats=[])
    assert load_board(tmp_path / "field-3x4.json").lattice is None


def test_a_regular_grid_is_no_field():
    for rows, columns in [(8, 8), (2, 9)]:
        board = grid_board(shipped_patches(), rows, columns, 20.0, 40.0)
        with pytest.raises(DesignError, match="board 'grid' is no field: expected upright patches of one size on a"):
            replace(board, is_field=True)


def test_impossible_fields_are_refused():
    with pytest.raises(DesignError, match="a field needs 4 designs, found 2"):
        field_board(shipped_patches()[:2])
    with pytest.raises(DesignError, match="2 rows and 9 columns is too small, expected at least 3"):
        field_board(shipped_patches(), 2, 9)
    with pytest.raises(DesignError, match="60 rows and 9 columns is too large, expected at most 51 x 50"):
        field_board(shipped_patches(), 60, 9)
    with pytest.raises(DesignError, match="there are 35 fields of 10 rows and 7 columns, expected at least 36"):
        field_boards(shipped_patches(), 36)
    with pytest.raises(DesignError, match="`distance` is 7, expected one of 5, 4, 3, 2"):
        shipped_field(7)
