"""Fields in simulated detections: every part of a field that can be told gets its places, and no other place."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kpbench import Detections, Predictions, estimate_pose, field_board, field_boards, find_board, shipped_patches
from kpbench.boards import find_boards, locate_boards
from kpbench.geometry import Camera

path = Path(__file__).parents[2] / "benchmarks" / "accuracy" / "fields.py"
spec = importlib.util.spec_from_file_location("fields_benchmark", path)
fields = sys.modules["fields_benchmark"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(fields)
BOARD = field_board(shipped_patches(), 10, 7)
LARGE = field_board(shipped_patches(), 19, 16)


def flat(board, turn_deg=20.0, px_per_mm=3.0, seed=0):
    """Detections of all patches of a board, seen from the front."""
    rng = np.random.default_rng(seed)
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    R = px_per_mm * np.array([[c, -s], [s, c]])
    radius_mm = board.keypoints[0].diameter_mm / 2
    xy = board.points_mm[:, :2] @ R.T + [900, 800] + rng.normal(0, 0.2, (len(board.keypoints), 2))
    A = np.tile(R * radius_mm, (len(xy), 1, 1))
    return Detections(xy, np.ones(len(xy)), [k.patch_id for k in board.keypoints], A)


def rows_of(board, top, left, rows, columns):
    return board.lattice.points[top : top + rows, left : left + columns].ravel()


@pytest.mark.parametrize("name", fields.CONDITIONS)
def test_places_are_found_and_none_is_wrong(name):
    shown = LARGE if name == "another field" else BOARD
    row = fields.measure(name, BOARD, shown, 1500, seed=7)
    _, _, views, _, share, _, wrong, *_ = (cell.strip() for cell in row.split("|"))
    assert wrong == "0"
    assert int(views) >= 5
    if share != "-":
        assert float(share) >= {"two thirds missing": 0.7, "all": 0.95}.get(name, 0.98)


@pytest.mark.parametrize("turn_deg", [0, 45, 90, 180, 290])
def test_any_window_tells_its_place_and_the_board_its_rotation(turn_deg):
    found = flat(BOARD, turn_deg)
    for top in range(8):
        for left in range(5):
            rows = rows_of(BOARD, top, left, 3, 3)
            [match] = find_board(found[rows], BOARD)
            assert not match.ambiguous
            assert match.probability > 0.999
            assert match.points.tolist() == rows.tolist()
            assert match.agrees.all()


def test_a_wrong_letter_is_corrected():
    rows = rows_of(BOARD, 4, 2, 3, 3)
    found = flat(BOARD)[rows]
    for n in range(9):
        ids = found.patch_id.copy()
        ids[n] = (ids[n] + 1) % 4
        [match] = find_board(replace(found, patch_id=ids), BOARD)
        if not match.ambiguous:
            assert match.points.tolist() == rows.tolist()
            assert match.agrees.tolist() == [k != n for k in range(9)]
    ids = flat(BOARD).patch_id.copy()
    ids[::8] = (ids[::8] + 1) % 4
    [match] = find_board(replace(flat(BOARD), patch_id=ids), BOARD)
    assert match.points.tolist() == list(range(70))
    assert not match.ambiguous


def test_letters_of_no_field_get_no_place():
    for seed in range(20):
        ids = np.random.default_rng(seed).integers(0, 4, 36)
        found = flat(BOARD)[rows_of(BOARD, 0, 0, 6, 6)]
        assert all(match.ambiguous for match in find_board(replace(found, patch_id=ids), BOARD))


def test_few_patches_are_not_sure():
    for rows in (rows_of(BOARD, 0, 0, 2, 2), rows_of(BOARD, 3, 3, 1, 5)):
        assert all(match.ambiguous for match in find_board(flat(BOARD)[rows], BOARD))
    assert find_board(Detections.none(), BOARD) == ()


def test_patches_on_a_diagonal_make_a_lattice():
    """Points on a line do not tell a homography: the frames must."""
    rows = np.array([LARGE.lattice.points[k, k] for k in range(12)])
    [match] = find_board(flat(LARGE)[rows], LARGE)
    assert match.points.tolist() == rows.tolist()


def test_half_turned_checkers_are_brought_into_the_orientation_of_the_board():
    found = flat(BOARD)
    A = np.where((found.patch_id == 0)[:, None, None], -found.A_patch2image, found.A_patch2image)
    [match] = find_board(replace(found, A_patch2image=A), BOARD)
    assert match.agrees.all()
    assert np.allclose(match.detections.A_patch2image, found.A_patch2image)


def test_a_bent_sheet_is_found_as_one():
    found = flat(LARGE)
    middle, radius = found.xy.mean(axis=0), 700.0
    xy = found.xy.copy()
    xy[:, 0] = middle[0] + radius * np.sin((xy[:, 0] - middle[0]) / radius)  # around a cylinder
    A = found.A_patch2image.copy()
    A[:, 0] *= np.cos(np.arcsin((xy[:, 0] - middle[0]) / radius))[:, None]
    matches = find_board(replace(found, xy=xy, A_patch2image=A), LARGE)
    points = np.full(len(xy), -1)
    for match in matches:
        if not match.ambiguous:
            points[match.index] = match.points
    assert (points == np.arange(len(xy)))[points >= 0].all()
    assert (points >= 0).mean() > 0.9


def test_two_copies_are_two_matches():
    one, other = flat(BOARD, 10, 2.0), flat(BOARD, 200, 2.0)
    both = Detections(
        np.concatenate([one.xy, other.xy + np.array([900, 100])]),
        np.ones(140),
        np.concatenate([one.patch_id, other.patch_id]),
        np.concatenate([one.A_patch2image, other.A_patch2image]),
    )
    matches = find_board(both, BOARD)
    assert [match.points.tolist() for match in matches] == [list(range(70))] * 2
    located, _ = locate_boards(Predictions.from_detections([both]), [BOARD])
    assert located.points.tolist() == [*range(70), *range(70)]
    assert (located.probability > 0.999).all()
    few = flat(BOARD)[rows_of(BOARD, 0, 0, 2, 2)]
    unsure = Detections([*few.xy, [5000, 5000]], np.ones(5), [*few.patch_id, 0], [*few.A_patch2image, np.eye(2)])
    located, _ = locate_boards(Predictions.from_detections([unsure]), [BOARD])
    assert located.points.tolist() == [-1] * 5
    assert located.probability[4] == 0 < located.probability[0] < 0.999


def test_any_window_tells_which_of_many_fields_it_is():
    boards = field_boards(shipped_patches(), 32)
    for n, top, left in ((0, 0, 0), (11, 4, 2), (31, 6, 3)):
        rows = rows_of(boards[n], top, left, 4, 4)
        found = flat(boards[n])[rows]
        matches = find_boards(found, boards)
        assert [len(match) for match in matches] == [int(k == n) for k in range(32)]
        assert matches[n][0].points.tolist() == rows.tolist()
        assert not matches[n][0].ambiguous
        small = [
            match
            for matches in find_boards(flat(boards[n])[rows_of(boards[n], top, left, 3, 3)], boards)
            for match in matches
        ]
        assert [match.board for match in small] == [boards[n]]
        assert 0.9 < small[0].probability < 0.999, "nine letters leave some doubt among 32 boards"


def test_a_field_takes_the_place_of_one_that_explains_the_letters_less_well():
    """The letters of one board, but for two, on another board: alone it is sure, beside the right one it is not."""
    right = field_board(shipped_patches(), 6, 6)
    keypoints = [
        replace(k, patch=shipped_patches()[(k.patch_id + (n in (7, 28))) % 4]) for n, k in enumerate(right.keypoints)
    ]
    near = replace(right, name="near", keypoints=tuple(keypoints))
    found = flat(right)
    [[alone], [match]] = find_board(found, near), find_board(found, right)
    assert not alone.ambiguous
    for boards in ([near, right], [right, near]):
        [both] = [match for matches in find_boards(found, boards) for match in matches]
        assert both.board is right
        assert match.probability > both.probability > 0.99


def test_the_pose_follows():
    camera = Camera(1624, 1240, 889.0, (-0.25, 0.08, 0.001, 0.0005, 0.0))
    angle = np.radians(35)
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t = np.array([20.0, -10.0, 260.0])
    X = BOARD.points_mm @ R.T + t
    xy, step = camera.project(X), 1e-3
    A = np.stack([camera.project(X + step * R[:, k]) - xy for k in (0, 1)], axis=2) / step * 8.0
    seen = (xy > 0).all(axis=1) & (xy < [1624, 1240]).all(axis=1)
    found = Detections(xy, np.ones(70), [k.patch_id for k in BOARD.keypoints], A)[seen]
    [match] = find_board(found, BOARD, camera)
    pose = estimate_pose(match, camera)
    assert not pose.ambiguous
    assert np.abs(pose.rotation - R).max() < 1e-6
    assert np.abs(pose.translation_mm - t).max() < 1e-4
