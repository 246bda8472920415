"""Ink gain of a print, from the arms of its reference marks in photographs."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from kpbench.calibration.bundle import Bundle
from kpbench.geometry.homography import project
from kpbench.patches.board import Board
from kpbench.patches.reference import ARM_MODULES, SQUARE_SIDE, ReferenceMark
from kpbench.types import Float, UInt8

ALONG = np.linspace(0.2, 0.8, 13)
"""Places along an arm, in parts of its length."""
ACROSS_MODULES = np.linspace(-1.0, ARM_MODULES + 0.9, 99)
"""Places across an arm, in modules from the white square outwards."""
LEVELS = (0.2, 0.5, 0.8)
"""Darkness that tells the two edges of an arm, and how wide they are blurred."""
LEAST_ARMS, LEAST_INK_PHOTOS = 20, 3
"""Least number of sharp arms, and of photographs with sharp arms."""
LEAST_INK_SIGMA_MM = 0.01
"""Added to the standard deviation: what simulated prints show, although the fit is better."""
MOST_BLUR_MODULES = 0.45
"""Largest width of a blurred edge, modules. Wider ones hide how white the paper between arm and tag is."""
MOST_UNEVEN = 0.3
"""Largest difference of the white on both sides of an arm, in parts of its contrast."""
LEAST_ARM_CONTRAST = 20.0
"""Least contrast of an arm, grey levels."""


def measure_ink_gain(images: Iterable[UInt8], bundle: Bundle, board: Board) -> tuple[float, float] | None:
    """Return the ink gain of a print, mm, and its standard deviation; None if too few arms are sharp.

    Ink that spreads by g makes an arm of a mark wider by 2 g. A tone curve makes it wider, too, in proportion to the
    blur of its edges. The widths of all arms are therefore fitted by ``width = design + 2 g + k blur``: near and far
    photographs tell the two apart. The standard deviation is that of a fit to clusters, the photographs.

    Parameters
    ----------
    images : iterable of ndarray of shape (H, W)
        The grey photographs of the bundle, in its order.
    bundle : Bundle
    board : Board
        With reference marks.
    """
    rows = [_measure_photo(image, bundle, n, board) for n, image in enumerate(images)]
    photo = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
    table = np.concatenate([np.zeros((0, 2)), *rows])
    photos = len(np.unique(photo))
    if len(table) < LEAST_ARMS or photos < LEAST_INK_PHOTOS:
        return None
    excess, blur = table.T
    keep = np.abs(excess - np.median(excess)) < 5 * max(float(np.median(np.abs(excess - np.median(excess)))), 1e-4)
    A, excess, photo = np.column_stack([np.ones(len(blur)), blur])[keep], excess[keep], photo[keep]
    inverse = np.linalg.pinv(A.T @ A)
    found = inverse @ A.T @ excess
    moments = A * (excess - A @ found)[:, None]
    clusters = np.stack([np.bincount(photo, moments[:, k]) for k in range(2)], axis=1)
    covariance = inverse @ clusters.T @ clusters @ inverse
    sigma_mm = np.sqrt(covariance[0, 0] * photos / (photos - 2)) / 2
    return float(found[0] / 2), float(np.hypot(sigma_mm, LEAST_INK_SIGMA_MM))


def _measure_photo(image: UInt8, bundle: Bundle, n: int, board: Board) -> Float:
    """Return how much wider than its design each arm is, and the blur of its edges, ndarray of shape (arms, 2), mm."""
    points = bundle.points[n][bundle.inlier[n]]
    place = dict(zip(points.index.tolist(), points.xy, strict=True))
    found = list[tuple[float, float]]()
    for number, mark in enumerate(board.references):
        corners = [place[4 * number + k] for k in range(4) if 4 * number + k in place]
        if len(corners) < 4:
            continue
        four = np.asarray(corners, np.float32)
        H = np.asarray(cv2.getPerspectiveTransform(mark.corners_mm.astype(np.float32), four), np.float64)
        for side in range(4):
            found += _measure_arm(image, H, mark, side)
    return np.array(found).reshape(-1, 2)


def _measure_arm(image: UInt8, H_board2image: Float, mark: ReferenceMark, side: int) -> list[tuple[float, float]]:
    corners = mark.corners_mm
    a, b = corners[side], corners[(side + 1) % 4]
    outwards = (corners[side] - corners[(side + 3) % 4]) / SQUARE_SIDE  # a module, away from the middle
    along = a + ALONG[:, None] * (b - a)
    xy = project(H_board2image, (along[:, None] + ACROSS_MODULES[:, None] * outwards).reshape(-1, 2))
    if (xy < 1).any() or (xy >= np.array(image.shape[::-1]) - 2).any():
        return []
    at = xy.astype(np.float32).reshape(len(ALONG), len(ACROSS_MODULES), 2)
    profile = cv2.remap(np.asarray(image, np.float32), at[..., 0], at[..., 1], cv2.INTER_CUBIC).mean(axis=0)
    white = (float(profile[:8].mean()), float(profile[-8:].mean()))
    black = float(profile[np.abs(ACROSS_MODULES - ARM_MODULES / 2) < 0.4].mean())
    contrast = sum(white) / 2 - black
    if contrast < LEAST_ARM_CONTRAST or abs(white[0] - white[1]) > MOST_UNEVEN * contrast:
        return []
    paper = np.linspace(*white, len(profile))
    dark = (paper - profile) / (paper - black)
    middle = len(dark) // 2
    edges = []
    for half, places in ((dark[middle::-1], ACROSS_MODULES[middle::-1]), (dark[middle:], ACROSS_MODULES[middle:])):
        fallen = np.minimum.accumulate(half)
        edges.append(np.interp(LEVELS, fallen[::-1], places[::-1]))
    module_mm = float(np.hypot(*outwards))
    blur = (edges[1][0] - edges[1][2] + edges[0][2] - edges[0][0]) / 2
    if blur > MOST_BLUR_MODULES:
        return []
    return [(module_mm * float(edges[1][1] - edges[0][1] - ARM_MODULES), module_mm * float(blur))]
