"""The boards that the images of a suite show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kpbench.geometry.camera import Camera
from kpbench.geometry.homography import project
from kpbench.patches.board import Board, BoardLike, hexagon_board, single_board
from kpbench.patches.design import Patch, parse_patch, shipped_patches
from kpbench.patches.tag_boards import TAGS_PER_BOARD, TagBoard, tag_board
from kpbench.portable import cos_sin
from kpbench.types import Float

BOARD_SIDE_MM = 187.5
"""Side of every board, mm; a patch of a hexagon board of this size has a diameter of 30 mm."""


def suite_boards(patches: Sequence[Patch], tags: str | None, kind: str = "hexagon") -> tuple[BoardLike, ...]:
    """Return the boards of a suite.

    Parameters
    ----------
    patches : sequence of Patch
    tags : str or None
        Name of a board of tags, which replaces the boards of patches.
    kind : {"hexagon", "single", "mixed"}
        Boards of six patches, or of a single patch; or one board of six patches of all designs in turn.
    """
    if tags is not None:
        return (tag_board(tags, BOARD_SIDE_MM),)
    if kind == "mixed":
        return (mixed_board(patches),)
    make = single_board if kind == "single" else hexagon_board
    return tuple(make(patch, BOARD_SIDE_MM) for patch in patches)


def mixed_board(patches: Sequence[Patch]) -> Board:
    """Return the hexagon board with all designs in turn, which is the board of films.

    Examples
    --------
    >>> from kpbench import shipped_patches
    >>> from kpbench.synth.suite_boards import mixed_board
    >>> [keypoint.patch_id for keypoint in mixed_board(shipped_patches()).keypoints]
    [0, 1, 2, 3, 0, 1]
    """
    hexagon = hexagon_board(patches[0], BOARD_SIDE_MM)
    keypoints = tuple(replace(k, patch=patches[n % len(patches)]) for n, k in enumerate(hexagon.keypoints))
    return replace(hexagon, name="mixed", keypoints=keypoints)


def printed_share(board: BoardLike) -> float:
    """Return the printed area per keypoint, as a share of the board: what a keypoint costs on paper.

    A patch counts with its disc. A tag counts with its black square, without the white margin that it needs. A ChArUco
    pattern counts with its rectangle of squares.

    Examples
    --------
    >>> from kpbench.patches import tag_board
    >>> from kpbench.synth.suite_boards import printed_share
    >>> round(printed_share(tag_board("apriltag", 187.5)), 4)
    0.0443
    """
    if isinstance(board, TagBoard):
        rows, columns = np.flatnonzero(board.black.any(axis=1)), np.flatnonzero(board.black.any(axis=0))
        modules = float((np.ptp(rows) + 1) * (np.ptp(columns) + 1))
        if board.name != "charuco":
            modules = TAGS_PER_BOARD * ((len(board.black) - 1) / TAGS_PER_BOARD - 1) ** 2
        return modules / len(board.black) ** 2 / len(board.keypoints)
    area_mm2 = sum(np.pi * k.H_patch2board[0, 0] ** 2 for k in board.keypoints)
    return float(area_mm2 / (board.side_x_mm * board.side_y_mm) / len(board.keypoints))


def disc_outline(board: BoardLike) -> Float:
    """Return points on the rim of the disc of a board with one keypoint, ndarray of shape (64, 2), mm."""
    angles = np.arange(64) * (2 * np.pi / 64)
    return project(board.keypoints[0].H_patch2board, np.column_stack(cos_sin(angles)))


def board_in_view(config: Mapping[str, Any]) -> tuple[Float, Camera] | None:
    """Return the keypoints of the board that the images of a suite show, and the camera of the images.

    Parameters
    ----------
    config : mapping
        The ``config`` of the dataset.

    Returns
    -------
    points_mm : ndarray of shape (n, 3)
        The board's keypoints with z = 0, in the order of the truth.
    camera : Camera

    The function returns None, not a tuple, if the dataset was not made from a suite, or if its images differ in lens,
    board or bow of the paper because a camera took them.

    Examples
    --------
    >>> from kpbench import SuiteConfig, load_suite
    >>> from kpbench.synth.suite_boards import board_in_view
    >>> points_mm, camera = board_in_view(SuiteConfig(load_suite("paper-v1")).to_dict())
    >>> points_mm.shape, camera.width_px
    ((6, 3), 1624)
    """
    if config.get("kind") != "suite" or "preset" in config:
        return None
    width, height = config["size_px"]
    k1, k2, p1, p2, k3 = config["distortion"]
    camera = Camera(width, height, config["focal_px"], (k1, k2, p1, p2, k3))
    if "board" in config:
        return np.array([[x, y, 0.0] for _, x, y, _ in config["board"]["keypoints"]]), camera
    # the keypoints of hexagon boards have the same positions, whatever the patch
    return hexagon_board(shipped_patches()[0], BOARD_SIDE_MM).points_mm, camera


def film_board(config: Mapping[str, Any]) -> tuple[Board, Camera] | None:
    """Return the board and the camera of the films of a dataset; None if the dataset does not tell both.

    A camera whose lens differs from film to film is not told, nor a board of tags.

    Parameters
    ----------
    config : mapping
        The ``config`` of the dataset.

    Examples
    --------
    >>> from kpbench import SuiteConfig, load_suite
    >>> from kpbench.synth.suite_boards import film_board
    >>> board, camera = film_board(SuiteConfig(load_suite("video-v1")).to_dict())
    >>> board.name, camera.width_px
    ('mixed', 1624)
    """
    if "film" not in config or "patches" not in config or config["preset"]["k1"] or "calibration" in config["preset"]:
        return None
    width, height = config["size_px"]
    camera = Camera(width, height, config["focal_px"], tuple(config["distortion"]))
    return mixed_board([parse_patch(table, "the dataset") for table in config["patches"]]), camera
