"""How much windows of photographs look like a design."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from kpbench.analysis.cell_images import (
    HALF,
    MARGIN,
    SEEN_PX,
    Grid,
    attitudes,
    blurred,
    moments,
    seen_cells,
    window_weights,
)
from kpbench.types import Float, Float32, UInt8

WINDOWS = 20_000


def sample_windows(photographs: Iterable[UInt8], rng: np.random.Generator, count: int = WINDOWS) -> UInt8:
    """Windows at random places of images at full, half and quarter size.

    Parameters
    ----------
    photographs : iterable of ndarray of shape (H, W), uint8
        Read until there are enough windows, 200 from each.
    rng : numpy.random.Generator
    count : int

    Returns
    -------
    ndarray of shape (count or fewer, side, side), uint8
        With room around the seen disc for a blur.
    """
    import cv2

    side, found, total = 2 * (HALF + MARGIN) + 1, [], 0
    for photograph in photographs:
        scale = 2.0 ** -rng.integers(0, 3)
        size = [max(side, round(scale * n)) for n in photograph.shape[::-1]]
        view = np.lib.stride_tricks.sliding_window_view(
            cv2.resize(photograph, size, interpolation=cv2.INTER_AREA), (side, side)
        )
        rows, columns = rng.integers(0, view.shape[:2], (200, 2)).T
        found.append(view[rows, columns])
        total += 200
        if total >= count:
            break
    return np.concatenate(found)[:count]


def natural_response(grid: Grid, inks: Float32, windows: UInt8, blur: float = 0.0) -> Float:
    """Share of places in images that look like a design in some attitude.

    Parameters
    ----------
    windows : ndarray of shape (N, side, side), uint8
        From :func:`sample_windows`. Those with a standard deviation under 8 grey levels count as unlike.
    blur : float
        Of designs and windows alike.

    Returns
    -------
    ndarray of shape (n, 2)
        Share of the windows whose correlation exceeds each of LOOKS_ALIKE.
    """
    weight = window_weights(np.eye(2)[None])[0]
    seen = blurred(windows.astype(np.float32), blur * SEEN_PX, HALF).reshape(len(windows), -1)
    seen = seen - (seen @ weight)[:, None]
    spread = np.sqrt((seen * seen) @ weight)
    textured = spread >= 8
    nature = (seen[textured] * weight / spread[textured, None]).T
    best = np.zeros((len(inks), nature.shape[1]), np.float32)
    for cells in seen_cells(grid, attitudes(), 1.0, blur=blur):
        image, own_spread = moments(weight, cells, inks)
        np.maximum(best, (-image / own_spread[:, None]) @ nature, out=best)  # ink is dark
    return np.array([(best > limit).sum(1) / len(windows) for limit in LOOKS_ALIKE]).T


LOOKS_ALIKE = (0.8, 0.9)  # correlations
