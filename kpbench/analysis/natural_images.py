"""Natural images: how often places in images look like a design."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from kpbench.analysis.cell_images import (
    BLUR_MARGIN_PX,
    HALF_SIDE_PX,
    WINDOW_PX,
    PolarGrid,
    attitudes,
    blur_middle,
    mean_free_images,
    render_cells,
    window_weights,
)
from kpbench.render.background import PhotoFolder, procedural_background
from kpbench.types import Float, Float32, UInt8

LOOKS_ALIKE = (0.8, 0.9)  # two thresholds of the correlation above which a place looks like a design
LEAST_SPREAD = 8.0  # grey levels; a window with a smaller standard deviation looks like no design
WINDOWS = 20_000
WINDOWS_PER_IMAGE = 200
BACKGROUND_PX = (640, 480)
"""Width and height of procedural backgrounds."""


def background_windows(backgrounds: str | Path | None = None) -> UInt8:
    """Return windows at random places of photographs or procedural backgrounds. Every call gives the same windows.

    Parameters
    ----------
    backgrounds : str or Path, optional
        Folder of photographs. Procedural backgrounds if left out.

    Returns
    -------
    ndarray of shape (20000, side, side), uint8

    Raises
    ------
    DataError
        If the folder holds no photograph that can be decoded.

    Examples
    --------
    >>> import cv2
    >>> import numpy as np
    >>> from kpbench.analysis import background_windows
    >>> cv2.imwrite("wall.png", np.random.default_rng(0).integers(0, 255, (200, 300), np.uint8))
    True
    >>> background_windows(".").shape
    (20000, 21, 21)
    """
    rng = np.random.default_rng(0)
    images = _procedural(rng) if backgrounds is None else _photographs(PhotoFolder.open(backgrounds), rng)
    return sample_windows(images, rng)


def _procedural(rng: np.random.Generator) -> Iterator[UInt8]:
    while True:
        yield procedural_background(rng, *BACKGROUND_PX)


def _photographs(folder: PhotoFolder, rng: np.random.Generator) -> Iterator[UInt8]:
    """Yield the photographs of a folder without end, in a random order that is the same in every pass."""
    order = rng.permutation(len(folder.files))
    while True:
        for n in order:
            image = folder.decode(folder.files[n], 1)
            if image is not None:
                yield image


def sample_windows(photographs: Iterable[UInt8], rng: np.random.Generator, count: int = WINDOWS) -> UInt8:
    """Return windows at random places of images. Each image has full, half or quarter size, chosen at random.

    Parameters
    ----------
    photographs : iterable of ndarray of shape (H, W), uint8
        Grey images. Each image gives :data:`WINDOWS_PER_IMAGE` windows. Images are read until there are enough windows.
    rng : numpy.random.Generator
    count : int
        Number of windows.

    Returns
    -------
    ndarray of shape (count, side, side), uint8
        Squares around the windows, with a margin for a blur. If the images run out, fewer squares are returned.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.analysis import sample_windows
    >>> photograph = np.random.default_rng(0).integers(0, 255, (200, 300), np.uint8)
    >>> sample_windows([photograph], np.random.default_rng(1)).shape
    (200, 21, 21)
    """
    side, found, total = 2 * (HALF_SIDE_PX + BLUR_MARGIN_PX) + 1, [], 0
    for photograph in photographs:
        scale = 2.0 ** -rng.integers(0, 3)
        size = [max(side, round(scale * n)) for n in photograph.shape[::-1]]
        view = np.lib.stride_tricks.sliding_window_view(
            cv2.resize(photograph, size, interpolation=cv2.INTER_AREA), (side, side)
        )
        rows, columns = rng.integers(0, view.shape[:2], (WINDOWS_PER_IMAGE, 2)).T
        found.append(view[rows, columns])
        total += WINDOWS_PER_IMAGE
        if total >= count:
            break
    return np.concatenate(found)[:count]


def natural_response(grid: PolarGrid, inks: Float32, windows: UInt8, blur: float = 0.0) -> Float:
    """Return, for each design, the share of image windows that look like the design in some attitude.

    Parameters
    ----------
    grid : PolarGrid
    inks : ndarray of shape (n, cells), float32
    windows : ndarray of shape (N, side, side), uint8
        From :func:`sample_windows`.
    blur : float
        Standard deviation of the blur of designs and windows, as a fraction of the window's radius.

    Returns
    -------
    ndarray of shape (n, 2), float64
        Share of the windows whose correlation with the design is above 0.8, and share above 0.9. A window with a
        standard deviation under 8 grey levels never looks like a design.

    Examples
    --------
    >>> import kpbench
    >>> import numpy as np
    >>> from kpbench.analysis import PolarGrid, natural_response, sample_windows
    >>> photograph = np.random.default_rng(0).integers(0, 255, (200, 300), np.uint8)
    >>> windows = sample_windows([photograph], np.random.default_rng(1))
    >>> patches = kpbench.shipped_patches()
    >>> grid = PolarGrid.of(patches)
    >>> natural_response(grid, grid.inks(patches), windows).shape
    (4, 2)
    """
    weight = window_weights(np.eye(2)[None])[0]
    nature = blur_middle(windows.astype(np.float32), blur * WINDOW_PX, HALF_SIDE_PX).reshape(len(windows), -1)
    nature = nature - (nature @ weight)[:, None]
    spread = np.sqrt((nature * nature) @ weight)
    textured = spread >= LEAST_SPREAD
    nature = (nature[textured] * weight / spread[textured, None]).T
    best = np.zeros((len(inks), nature.shape[1]), np.float32)
    for cells in render_cells(grid, attitudes(), 1.0, blur=blur):
        image, own_spread = mean_free_images(weight, cells, inks)
        np.maximum(best, (-image / own_spread[:, None]) @ nature, out=best)  # minus, because ink 1 is dark
    return np.array([(best > limit).sum(1) / len(windows) for limit in LOOKS_ALIKE]).T
