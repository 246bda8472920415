"""Which detection is which point of a board: simulated views, and every possible pairing tried."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from board_scenes import BENT, BOARDS, CAMERA, MILD, PATCHES, scene

from kpbench import Detections, Patch, find_board, grid_board, hexagon_board
from kpbench.boards import find_boards
from kpbench.boards.frames import fit_homography, frame_errors
from kpbench.errors import DataError
from kpbench.geometry import project

SEEN = [("mixed", 3), ("mixed", 6), ("grid", 12), ("trefoil", 4), ("trefoil", 6), ("wheel", 3), ("wheel", 5)]


def is_right(match, truth):
    return len({*truth.copy[match.index]}) == 1 and np.array_equal(match.points, truth.point[match.index])


@pytest.mark.parametrize("camera", [CAMERA, BENT], ids=["straight", "bent"])
@pytest.mark.parametrize(("name", "seen"), SEEN)
def test_points_are_right_among_false_alarms(name, seen, camera):
    rng = np.random.default_rng(1)
    for _ in range(12):
        truth = scene(rng, BOARDS[name], camera, seen)
        [match] = find_board(truth.found, BOARDS[name], camera)
        assert is_right(match, truth)
        assert len(match.points) >= seen
        assert not match.ambiguous


@pytest.mark.parametrize(("name", "seen"), SEEN)
def test_without_a_camera_a_lens_may_bend_the_board_a_little(name, seen):
    rng = np.random.default_rng(2)
    for _ in range(12):
        truth = scene(rng, BOARDS[name], MILD, seen)
        [match] = find_board(truth.found, BOARDS[name])
        assert is_right(match, truth)
        assert len(match.points) >= seen - 1
        assert not match.ambiguous


@pytest.mark.parametrize(("name", "seen"), [("mixed", 4), ("trefoil", 5), ("grid", 9)])
def test_two_copies_of_a_board_are_two_matches(name, seen):
    rng = np.random.default_rng(3)
    for _ in range(12):
        truth = scene(rng, BOARDS[name], BENT, seen, copies=2)
        matches = find_board(truth.found, BOARDS[name], BENT)
        assert {int(truth.copy[match.index[0]]) for match in matches} == {0, 1}
        assert all(is_right(match, truth) for match in matches)
        assert len(matches) == 2


def test_half_a_grid_is_right_or_ambiguous_and_lists_the_right_points():
    rng, clear = np.random.default_rng(4), 0
    for _ in range(40):
        truth = scene(rng, BOARDS["grid"], CAMERA, 6)
        [match] = find_board(truth.found, BOARDS["grid"], CAMERA)
        assert any(is_right(one, truth) for one in (match, *match.alternatives))
        clear += not match.ambiguous
    assert clear >= 36


@pytest.mark.parametrize("seen", [4, 6])
def test_a_symmetric_board_lists_both_solutions(seen):
    rng = np.random.default_rng(5)
    for _ in range(12):
        truth = scene(rng, BOARDS["checker"], CAMERA, seen)
        [match] = find_board(truth.found, BOARDS["checker"], CAMERA)
        assert match.ambiguous
        right = [one for one in (match, *match.alternatives) if is_right(one, truth)]
        assert len(right) == 1
        assert any(np.array_equal(one.points, (right[0].points + 3) % 6) for one in (match, *match.alternatives))


def test_noise_alone_is_no_board():
    rng = np.random.default_rng(6)
    found = [find_board(scene(rng, BOARDS[name], seen=2, alarms=12).found, BOARDS[name]) for name in BOARDS] * 5
    assert not any(map(len, found))


def brute_force(found, board):
    """The pairings of most detections: homographies through any four points, frames only checked by their direction.

    Returns sets of (detection, point).
    """
    best, most = set(), 0
    ids = np.array([k.patch_id for k in board.keypoints])
    for four in itertools.combinations(range(len(found)), 4):
        choices = [np.flatnonzero(ids == found.patch_id[d]).tolist() for d in four]
        for points in itertools.product(*choices):
            if len({*points}) < 4:
                continue
            X, x = board.points_mm[list(points), :2] / 100, found.xy[list(four)] / 1000
            rows = [[*p, 1, 0, 0, 0, *(-q[0] * p)] for p, q in zip(X, x, strict=True)]
            rows += [[0, 0, 0, *p, 1, *(-q[1] * p)] for p, q in zip(X, x, strict=True)]
            try:
                h = np.linalg.solve(np.array(rows), x.T.ravel())
            except np.linalg.LinAlgError:
                continue
            H = np.diag([1000, 1000, 1]) @ np.append(h, 1).reshape(3, 3) @ np.diag([0.01, 0.01, 1])
            explained = explain(H, found, board, ids)
            if explained is not None and four_in(four, points, explained):
                if len(explained) > most:
                    best, most = set(), len(explained)
                if len(explained) == most:
                    best.add(frozenset(explained))
    return best


def four_in(four, points, explained):
    return {*zip(four, points, strict=True)} <= explained


def explain(H, found, board, ids):
    """The detections within a fifth of a radius whose axes point where the homography says; None if four do not."""
    w = board.points_mm[:, :2] @ H[2, :2] + H[2, 2]
    if w.min() <= 0:
        return None
    explained = set()
    for n, k in enumerate(board.keypoints):
        centre, right, down = project(H @ k.H_patch2board, [[0, 0], [1e-3, 0], [0, 1e-3]])
        J = np.column_stack([right - centre, down - centre]) * 1e3
        if np.linalg.det(J) <= 0:
            return None
        for d in np.flatnonzero(found.patch_id == ids[n]).tolist():
            M = np.linalg.solve(J, found.A_patch2image[d])
            M = M / np.sqrt(max(np.linalg.det(M), 1e-9))
            M = M if k.patch.symmetry_order == 1 or np.trace(M) > 0 else -M
            off = np.linalg.norm(np.linalg.solve(J, found.xy[d] - centre))
            if off < 0.2 and np.abs(M - np.eye(2)).max() < 0.3:
                explained.add((d, n))
    return explained


@pytest.mark.parametrize(
    ("name", "seen", "alarms"),
    [("mixed", 4, 2), ("mixed", 5, 1), ("trefoil", 5, 0), ("trefoil", 4, 1), ("checker", 5, 0)],
)
def test_every_pairing_tried_finds_nothing_else(name, seen, alarms):
    rng = np.random.default_rng(7)
    for _ in range(3 if name == "mixed" else 1):
        truth = scene(rng, BOARDS[name], CAMERA, seen, alarms=alarms)
        oracle = brute_force(truth.found, BOARDS[name])
        [match] = find_board(truth.found, BOARDS[name], CAMERA)
        listed = [
            frozenset(zip(m.index.tolist(), m.points.tolist(), strict=True)) for m in (match, *match.alternatives)
        ]
        assert {*listed} == oracle


def test_a_detection_with_a_wrong_frame_keeps_its_point():
    truth = scene(np.random.default_rng(8), BOARDS["wheel"], CAMERA, alarms=0)
    A = truth.found.A_patch2image.copy()
    A[2] = -A[2]
    found = replace(truth.found, A_patch2image=A)
    [match] = find_board(found, BOARDS["wheel"], CAMERA)
    assert is_right(match, truth)
    assert match.agrees.tolist() == [True, True, False, True, True, True]


def test_the_orientation_of_blurred_patches_that_are_not_sure_is_not_believed():
    for name, seen, is_clear in (("wheel", 6, False), ("mixed", 6, True), ("mixed", 4, False), ("wheel", 3, False)):
        truth = scene(np.random.default_rng(8), BOARDS[name], CAMERA, seen, alarms=0)
        for score, blur_px, is_sharp in ((0.95, 90.0, True), (0.6, 0.1, True), (0.6, 90.0, False)):
            n = len(truth.found)
            blurred = replace(truth.found, score=np.full(n, score), blur_px=np.full(n, blur_px))
            [match] = find_board(blurred, BOARDS[name], CAMERA)
            assert match.ambiguous == (not is_sharp and not is_clear)


def test_boards_that_explain_the_same_detections_are_ambiguous():
    small, large = hexagon_board(PATCHES[1], 100.0), hexagon_board(PATCHES[1], 200.0)
    truth = scene(np.random.default_rng(9), small)
    assert [[m.ambiguous for m in matches] for matches in find_boards(truth.found, [small, large])] == [[True], [True]]
    other = BOARDS["mixed"]
    found = find_boards(truth.found, [other, small])
    assert [len(matches) for matches in found] == [0, 1]


def test_large_boards_are_found_in_blocks(monkeypatch):
    board = grid_board(PATCHES[2:], 6, 8, 20.0, 40.0)
    truth = scene(np.random.default_rng(10), board, seen=40)
    for most in (400_000, 1000):
        monkeypatch.setattr("kpbench.boards.matching.MOST_PAIRS", most)
        matches = find_board(truth.found, board, CAMERA)
        assert len(matches[0].points) == 40
        assert any(is_right(one, truth) for one in (matches[0], *matches[0].alternatives))


def test_what_cannot_be_matched_is_said_in_one_line():
    xy, ids = [[1.0, 2.0]], [0]
    with pytest.raises(DataError, match="no patch IDs"):
        find_board(Detections(xy, [1.0]), BOARDS["mixed"])
    with pytest.raises(DataError, match="no affine frames"):
        find_board(Detections(xy, [1.0], ids), BOARDS["mixed"])
    disc = Patch("disc", 0, "black", ())
    with pytest.raises(DataError, match="'disc' looks the same in every direction"):
        find_board(Detections(xy, [1.0], ids, [np.eye(2)]), hexagon_board(disc, 100.0))
    assert find_board(Detections.none(), BOARDS["mixed"]) == ()


def test_a_homography_is_fitted_exactly():
    H = np.array([[30.0, 4.0, 500.0], [-3.0, 25.0, 400.0], [0.01, -0.02, 1.0]])
    X = np.array([[0.0, 0.0], [5.0, 1.0], [-3.0, 6.0]])
    w = X @ H[2, :2] + 1
    xy = project(H, X)
    J = (H[:2, :2] - xy[:, :, None] * H[2, :2]) / w[:, None, None]
    for n in (2, 3):
        fitted = fit_homography(X[:n], xy[:n], J[:n], np.full(n, 0.25), np.full(n, 0.1))
        np.testing.assert_allclose(fitted / fitted[2, 2], H, atol=1e-7)


def test_what_a_design_tells_about_its_frame():
    assert [frame_errors(patch) for patch in PATCHES] == [(0.25, 0.1), (0.25, 0.03), (0.03, 0.03), (0.03, 0.03)]
