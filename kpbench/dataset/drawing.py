"""Pictures for people: images with true keypoints or detections drawn on them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.types import Detections, UInt8

PATCH_COLOURS = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (213, 94, 0), (204, 121, 167))
"""RGB colours of the patch IDs, distinct to colour-blind eyes (Okabe and Ito, *Color universal design*, 2008)."""
OUTERMOST_PX = 1e6
"""Largest coordinate that is drawn, px. Larger values can overflow: OpenCV has 32 bits for a coordinate in 1/16 px."""


def _to_sixteenths(*lengths_px: float) -> tuple[int, ...]:
    """Convert px to 1/16 px, the unit of OpenCV's drawing functions."""
    return tuple(round(length * 16) for length in lengths_px)


def draw_keypoints(image: UInt8, keypoints: NDArray[Any], scale: float = 1.0) -> UInt8:
    """Draw a ring, a cross and the ID of every true keypoint on a scaled copy of an image.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
        Grey or RGB; not changed.
    keypoints : ndarray of shape (n,), KEYPOINT_DTYPE
    scale : float
        Pixels of the result per pixel of the image.

    Returns
    -------
    ndarray of shape (H * scale, W * scale, 3), uint8
        RGB.

    Examples
    --------
    >>> from kpbench import open_dataset
    >>> from kpbench.dataset import draw_keypoints
    >>> draw_keypoints(*open_dataset("kpbench-data")[0], scale=0.5).shape
    (240, 320, 3)
    """
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    canvas = cv2.resize(image, None, fx=scale, fy=scale, interpolation=interpolation)
    if canvas.ndim == 2:
        canvas = cv2.cvtColor(canvas, cv2.COLOR_GRAY2RGB)
    for k in keypoints:
        # scaling keeps the corner of the image in place, half a pixel left of and above the centre of pixel (0, 0)
        x, y = (float(k["x"]) + 0.5) * scale - 0.5, (float(k["y"]) + 0.5) * scale - 0.5
        major, minor = (float(k["radius_major"]) + 2) * scale, (float(k["radius_minor"]) + 2) * scale
        colour, angle_deg = PATCH_COLOURS[int(k["patch_id"]) % len(PATCH_COLOURS)], float(k["axis_angle"])
        centre, axes = _to_sixteenths(x, y), _to_sixteenths(major, minor)
        cv2.ellipse(canvas, centre, axes, angle_deg, 0, 360, colour, 1, cv2.LINE_AA, 4)
        for dx, dy in ((3, 0), (0, 3)):
            cv2.line(canvas, (round(x - dx), round(y - dy)), (round(x + dx), round(y + dy)), (255, 0, 0), 1)
        text_place = (round(x + major + 2), round(y - 2))
        cv2.putText(canvas, str(k["patch_id"]), text_place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
    return np.asarray(canvas, np.uint8)


def draw_detections(image: UInt8, detections: Detections) -> UInt8:
    """Draw a cross, a ring and the ID of every detection on a copy of an image. Larger images get larger marks.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
        Grey or RGB; not changed.
    detections : Detections

    Returns
    -------
    ndarray of shape (H, W, 3), uint8
        RGB.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import Detections
    >>> from kpbench.dataset import draw_detections
    >>> draw_detections(np.zeros((48, 64), np.uint8), Detections([[20, 30]], [0.9], [2])).shape
    (48, 64, 3)
    """
    canvas = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 else image.copy(), np.uint8)
    unit = max(1, round(max(canvas.shape) / 800))
    for n, (x, y) in enumerate(detections.xy.tolist()):
        if abs(x) > OUTERMOST_PX or abs(y) > OUTERMOST_PX:
            continue
        patch_id = None if detections.patch_id is None else int(detections.patch_id[n])
        patch_colour = (255, 0, 0) if patch_id is None else PATCH_COLOURS[patch_id % len(PATCH_COLOURS)]
        for colour, width in (((0, 0, 0), 3 * unit), (patch_colour, unit)):  # first a wide black line, as an outline
            cv2.circle(canvas, _to_sixteenths(x, y), 9 * 16 * unit, colour, width, cv2.LINE_AA, 4)
            for dx, dy in ((4 * unit, 0), (0, 4 * unit)):
                cv2.line(canvas, (round(x - dx), round(y - dy)), (round(x + dx), round(y + dy)), colour, width)
            if patch_id is not None:
                text_place, font = (round(x + 11 * unit), round(y - 4 * unit)), cv2.FONT_HERSHEY_SIMPLEX
                cv2.putText(canvas, str(patch_id), text_place, font, 0.55 * unit, colour, width, cv2.LINE_AA)
    return canvas


def contact_sheet(tiles: Sequence[UInt8], columns: int, gap_px: int = 4) -> UInt8:
    """Arrange tiles in rows on a white sheet. Each cell of the sheet has the size of the largest tile.

    Parameters
    ----------
    tiles : sequence of ndarray of shape (H, W, 3), uint8
        RGB.
    columns : int
        Tiles per row.
    gap_px : int
        Width of the white gaps.

    Returns
    -------
    ndarray of shape (H_sheet, W_sheet, 3), uint8
        RGB.
    """
    height, width = (max(tile.shape[axis] for tile in tiles) for axis in (0, 1))
    rows = -(-len(tiles) // columns)
    sheet = np.full((rows * (height + gap_px) + gap_px, columns * (width + gap_px) + gap_px, 3), 255, np.uint8)
    for n, tile in enumerate(tiles):
        y, x = gap_px + n // columns * (height + gap_px), gap_px + n % columns * (width + gap_px)
        sheet[y : y + tile.shape[0], x : x + tile.shape[1]] = tile
    return sheet
