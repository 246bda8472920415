"""Where the patches of a board must be: from a homography of its plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kpbench.fitting.align import short_semi_axis
from kpbench.geometry.camera import Camera
from kpbench.patches.board import Board
from kpbench.types import Float, Int

LEAST_RADIUS_PX = 3.0
"""Short semi-axis of the smallest patch that is looked for in a window, px."""


@dataclass(frozen=True)
class PredictedPatches:
    """N patches of a board where a homography puts them.

    Attributes
    ----------
    points : ndarray of shape (N,), int64
        Keypoint of the board of each patch.
    xy, A : ndarray of shape (N, 2) and (N, 2, 2)
        Poses, px.
    bend : ndarray of shape (N, 2)
        Perspective, see :func:`kpbench.fitting.sampled_fit.fit_samples`.
    """

    points: Int
    xy: Float
    A: Float
    bend: Float

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: Any) -> PredictedPatches:
        return PredictedPatches(self.points[rows], self.xy[rows], self.A[rows], self.bend[rows])


def predict_patches(H: Float, board: Board, camera: Camera | None, size_px: tuple[int, int]) -> PredictedPatches:
    """Return the patches that lie wholly in the image and are large enough.

    Parameters
    ----------
    H : ndarray of shape (3, 3)
        From (x, y, 1) of the board frame, mm, to rays, or without a camera to px. Its sign is that of the depth.
    board : Board
    camera : Camera or None
    size_px : (int, int)
        Width and height of the image.
    """
    to_board = board.A_patch2board
    extent = np.array([k.patch.extent for k in board.keypoints])
    seen = board.points_mm[:, :2] @ H[:, :2].T + H[:, 2]
    points = np.flatnonzero(seen[:, 2] > 1e-9)
    w = seen[points, 2:]
    xy = seen[points, :2] / w
    if camera is not None:
        valid = np.hypot(xy[:, 0], xy[:, 1]) < camera.lens.largest_radius
        points, w, xy = points[valid], w[valid], xy[valid]
    A = (H[:2, :2] - xy[:, :, None] * H[2, :2]) / w[:, :, None] @ to_board[points]
    if camera is not None:
        A = camera.K[[0, 1], [0, 1]][:, None] * camera.lens.jacobian(xy) @ A
        xy = camera.distort(xy)
    reach = np.linalg.norm(A, axis=2) * extent[points, None]
    inside = ((xy - reach > 0) & (xy + reach < np.array(size_px) - 1)).all(axis=1)
    inside &= (short_semi_axis(A) >= LEAST_RADIUS_PX) & (np.linalg.det(A) > 0)
    bend = H[2, :2] @ to_board[points] / w
    return PredictedPatches(points[inside], xy[inside], A[inside], bend[inside])
