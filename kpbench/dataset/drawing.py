"""Pictures of a dataset for people: images with their true keypoints drawn on them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.types import Detections, UInt8

# one colour an id, distinct to colour-blind eyes (Okabe and Ito 2008), RGB
COLOURS = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (213, 94, 0), (204, 121, 167))


def draw_keypoints(image: UInt8, keypoints: NDArray[Any], scale: float = 1.0) -> UInt8:
    """An RGB copy of an image, scaled, with a ring, cross and ID on every true keypoint.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    keypoints : ndarray of :data:`kpbench.types.KEYPOINT_DTYPE`
    scale : output px per image px
    """
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    canvas = cv2.resize(image, None, fx=scale, fy=scale, interpolation=how)
    if canvas.ndim == 2:
        canvas = cv2.cvtColor(canvas, cv2.COLOR_GRAY2RGB)
    for k in keypoints:
        # the centre of pixel 0 lies half a pixel inside, so scaling acts on x + 0.5
        x, y = (float(k["x"]) + 0.5) * scale - 0.5, (float(k["y"]) + 0.5) * scale - 0.5
        axes = ((float(k["radius_major"]) + 2) * scale, (float(k["radius_minor"]) + 2) * scale)
        colour = COLOURS[int(k["patch_id"]) % len(COLOURS)]
        at = (round(x * 16), round(y * 16))
        size = (round(axes[0] * 16), round(axes[1] * 16))
        cv2.ellipse(canvas, at, size, float(k["axis_angle"]), 0, 360, colour, 1, cv2.LINE_AA, 4)
        for dx, dy in ((3, 0), (0, 3)):
            ends = (round(x - dx), round(y - dy)), (round(x + dx), round(y + dy))
            cv2.line(canvas, *ends, (255, 0, 0), 1)
        text_at = (round(x + axes[0] + 2), round(y - 2))
        cv2.putText(canvas, str(k["patch_id"]), text_at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
    return np.asarray(canvas, np.uint8)


OUTERMOST_PX = 1e6


def draw_detections(image: UInt8, detections: Detections) -> UInt8:
    """An RGB copy of an image with a cross, a ring and the ID on every detection, larger in larger images."""
    canvas = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 else image.copy(), np.uint8)
    unit = max(1, round(max(canvas.shape) / 800))
    for n, (x, y) in enumerate(detections.xy.tolist()):
        if abs(x) > OUTERMOST_PX or abs(y) > OUTERMOST_PX:  # OpenCV counts sixteenths of px in 32 bits
            continue
        patch_id = None if detections.patch_id is None else int(detections.patch_id[n])
        own = (255, 0, 0) if patch_id is None else COLOURS[patch_id % len(COLOURS)]
        for colour, width in (((0, 0, 0), 3 * unit), (own, unit)):  # a dark seam, to be seen on any ground
            at = (round(x * 16), round(y * 16))
            cv2.circle(canvas, at, 9 * 16 * unit, colour, width, cv2.LINE_AA, 4)
            for dx, dy in ((4 * unit, 0), (0, 4 * unit)):
                cv2.line(canvas, (round(x - dx), round(y - dy)), (round(x + dx), round(y + dy)), colour, width)
            if patch_id is not None:
                text_at, font = (round(x + 11 * unit), round(y - 4 * unit)), cv2.FONT_HERSHEY_SIMPLEX
                cv2.putText(canvas, str(patch_id), text_at, font, 0.55 * unit, colour, width, cv2.LINE_AA)
    return canvas


def contact_sheet(tiles: Sequence[UInt8], columns: int, gap_px: int = 4) -> UInt8:
    """Tiles of one size side by side in rows, RGB, on white."""
    height, width = tiles[0].shape[:2]
    rows = -(-len(tiles) // columns)
    sheet = np.full((rows * (height + gap_px) + gap_px, columns * (width + gap_px) + gap_px, 3), 255, np.uint8)
    for n, tile in enumerate(tiles):
        y, x = gap_px + n // columns * (height + gap_px), gap_px + n % columns * (width + gap_px)
        sheet[y : y + height, x : x + width] = tile
    return sheet
