import pytest
from hypothesis import given
from hypothesis import strategies as st

from kpbench.errors import DesignError
from kpbench.patches.board import Board, BoardKeypoint, grid_board, hexagon_board
from kpbench.patches.design import shipped_patches
from kpbench.printing.tiling import cut_into_tiles

PATCH = shipped_patches()[0]


def board_of(points, size, diameter=10.0):
    return Board("b", *size, tuple(BoardKeypoint(PATCH, x, y, 0.0, diameter) for x, y in points))


def check(board, tiles, room_x, room_y):
    assert all(t.x1 - t.x0 <= room_x + 1e-5 and t.y1 - t.y0 <= room_y + 1e-5 for t in tiles)
    assert sum((t.x1 - t.x0) * (t.y1 - t.y0) for t in tiles) == pytest.approx(board.side_x_mm * board.side_y_mm)
    for k in board.keypoints:
        (home,) = [t for t in tiles if t.contains(k.x_mm, k.y_mm)]
        for t in [home]:
            inner_x = [v for v in (t.x0, t.x1) if abs(v) < board.side_x_mm / 2 - 1e-9]
            inner_y = [v for v in (t.y0, t.y1) if abs(v) < board.side_y_mm / 2 - 1e-9]
            assert all(abs(k.x_mm - v) >= k.extent_mm + 1 - 1e-6 for v in inner_x), "1 mm between seam and patch"
            assert all(abs(k.y_mm - v) >= k.extent_mm + 1 - 1e-6 for v in inner_y)


def test_a_board_that_fits_is_one_tile():
    (tile,) = cut_into_tiles(hexagon_board(PATCH, 187.5), 188, 275)
    assert (tile.x0, tile.x1, tile.y0, tile.y1) == (-93.75, 93.75, -93.75, 93.75)
    assert (tile.row, tile.column) == (0, 0)


@given(side=st.floats(20, 700))
def test_hexagons_of_any_size_are_cut_between_patches(side):
    board = hexagon_board(PATCH, side)
    tiles = cut_into_tiles(board, 188, 275)
    check(board, tiles, 188, 275)
    assert [(t.row, t.column) for t in tiles] == sorted((t.row, t.column) for t in tiles)


@given(rows=st.integers(1, 9), columns=st.integers(1, 9), pitch=st.floats(15, 150), room=st.floats(160, 400))
def test_grids_of_any_size_are_cut_between_patches(rows, columns, pitch, room):
    board = grid_board([PATCH], rows, columns, 12, pitch)
    check(board, cut_into_tiles(board, room, room), room, room)


def test_seams_lie_amid_the_gaps():
    board = board_of([(-40, 0), (30, 0)], (100, 20))
    first, second = cut_into_tiles(board, 80, 20)
    assert first.x1 == second.x0 == pytest.approx((-35 + 25) / 2)


def test_seams_step_back_no_further_than_the_page_allows():
    board = board_of([(70, 0)], (150, 20))  # the gap reaches from -75 to 64
    assert cut_into_tiles(board, 100, 20)[0].x1 == pytest.approx(-5.5)
    assert cut_into_tiles(board, 76, 20)[0].x1 == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("points", "size"),
    [
        ([(x, 0) for x in range(-45, 50, 10)], (100, 20)),  # they touch: no gap anywhere
        ([(x, 20 * (n % 2)) for n, x in enumerate(range(-44, 50, 8))], (100, 60)),  # staggered
    ],
)
def test_no_seam_through_a_patch(points, size):
    with pytest.raises(DesignError, match=r"'b' cannot be tiled: no straight seam .* within the 50 mm"):
        cut_into_tiles(board_of(points, size), 50, 60)
