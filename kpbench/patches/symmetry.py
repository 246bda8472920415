"""Rotations that leave a board unchanged, and boards whose pose is not unique."""

from __future__ import annotations

import numpy as np

from kpbench.patches.board import Board

SAME_MM, SAME_DEG = 1e-3, 1e-3
"""Points and rotations that differ by less are the same."""


def board_turns_deg(board: Board, by_place: bool = False) -> tuple[float, ...]:
    """Return the rotations about the middle of its keypoints that leave a board unchanged, degrees in (0, 360).

    Places, designs, diameters and the rotations of the patches are compared, the edge of the board is not.

    Parameters
    ----------
    board : Board
    by_place : bool
        Leave out the rotations of the patches.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.patches import board_turns_deg
    >>> checker, trefoil, *_ = kpbench.shipped_patches()
    >>> board_turns_deg(kpbench.hexagon_board(checker, 200.0)), board_turns_deg(kpbench.hexagon_board(trefoil, 200.0))
    ((180.0,), ())
    """
    xy = board.points_mm[:, :2] - board.points_mm[:, :2].mean(axis=0)
    size = np.array([k.diameter_mm for k in board.keypoints])
    order = np.array([k.patch.symmetry_order for k in board.keypoints])
    patch_id = np.array([k.patch_id for k in board.keypoints])
    rotate_deg = np.array([k.rotate_deg for k in board.keypoints])
    distance, angle = np.hypot(*xy.T), np.degrees(np.arctan2(xy[:, 1], xy[:, 0]))
    first = int(np.argmax(distance))
    if distance[first] < SAME_MM:  # one keypoint
        return tuple(360.0 * k / order[0] for k in range(1, int(order[0])))

    def is_unchanged(turn_deg: float) -> bool:
        c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        gap = np.linalg.norm((xy @ np.array([[c, s], [-s, c]]))[:, None] - xy, axis=2)
        to = gap.argmin(axis=1)
        turned = (rotate_deg + turn_deg - rotate_deg[to]) * np.maximum(order, 1) / 360.0
        off_deg = np.where(order > 0, np.abs(turned - np.rint(turned)) * 360.0, 0.0)
        same = (patch_id[to] == patch_id) & (np.abs(size[to] - size) < SAME_MM) & (by_place | (off_deg < SAME_DEG))
        return bool((same & (gap.min(axis=1) < SAME_MM)).all())

    turns = (angle[np.abs(distance - distance[first]) < SAME_MM] - angle[first]) % 360.0
    wanted = sorted({round(float(turn), 6) for turn in turns} - {0.0, 360.0})
    return tuple(turn for turn in wanted if is_unchanged(turn))


def pose_problem(board: Board) -> str:
    """Return why the pose of a board is not unique, in words; "" if it is unique.

    A pose needs four keypoints that are not on one line, and a board that no rotation leaves unchanged.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.patches import pose_problem
    >>> pose_problem(kpbench.hexagon_board(kpbench.shipped_patches()[0], 200.0))
    'it looks the same after a turn of 180 degrees'
    """
    if turns := board_turns_deg(board):
        return f"it looks the same after a turn of {turns[0]:.6g} degrees"
    xy = board.points_mm[:, :2] - board.points_mm[:, :2].mean(axis=0)
    if len(xy) < 4:
        return f"it has {len(xy)} keypoints, expected at least 4"
    if np.linalg.svd(xy, compute_uv=False)[1] < SAME_MM:
        return "its keypoints are on one line"
    return ""
