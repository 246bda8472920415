"""Blurs: box, Gaussian, motion and defocus, each with its kernel.

As :mod:`kpbench.degrade.effects` requires, no kernel moves the image.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from kpbench.filters import box_filter, filter_image, filter_separably, gaussian_taps
from kpbench.geometry.coverage import rasterise
from kpbench.geometry.outline import arc_vertices
from kpbench.portable import cos_sin_of, matmul
from kpbench.types import Float, UInt8


def blur(image: UInt8, kernel_px: float) -> UInt8:
    """Blur with a box mean: each pixel spreads over a square (paper §3.3).

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    kernel_px : float
        Side of the square, px. The side may be even or fractional.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import blur
    >>> blur(np.array([[0, 0, 90, 0, 0]], np.uint8), kernel_px=3)
    array([[ 0, 30, 30, 30,  0]], dtype=uint8)
    """
    if kernel_px % 2 == 1:
        return box_filter(image, int(kernel_px))
    return filter_separably(image, box_taps(kernel_px))


def box_taps(kernel_px: float) -> Float:
    """Return the weights of a box mean of any width, even or fractional, centred on the middle tap."""
    reach = int(np.ceil((kernel_px - 1) / 2))
    taps = np.ones(2 * reach + 1)
    taps[[0, -1]] -= (2 * reach + 1 - kernel_px) / 2 if reach else 0.0
    return np.asarray(taps / taps.sum())


def gaussian_blur(image: UInt8, sigma_px: float) -> UInt8:
    """Blur with a Gaussian.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    sigma_px : float
        Standard deviation, px.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import gaussian_blur
    >>> gaussian_blur(np.array([[0, 0, 0, 100, 0, 0, 0]], np.uint8), sigma_px=1)
    array([[ 1,  5, 24, 40, 24,  5,  1]], dtype=uint8)
    """
    return filter_separably(image, gaussian_taps(sigma_px))


def motion_blur(image: UInt8, length_px: float, angle_deg: float) -> UInt8:
    """Blur along a line through each pixel, like a camera that moves during the exposure.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    length_px : float
        Length of the line, px.
    angle_deg : float
        Direction of the line, from +x towards +y, degrees.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import motion_blur
    >>> motion_blur(np.array([[0, 0, 90, 0, 0]], np.uint8), length_px=3, angle_deg=0)
    array([[ 0, 30, 30, 30,  0]], dtype=uint8)
    """
    return filter_image(image, line_kernel(length_px, angle_deg))


@lru_cache(maxsize=2048)  # holds all kernels of the paper's mix; the ladder's kernels rarely repeat
def line_kernel(length_px: float, angle_deg: float) -> Float:
    """Return the exact area coverage of a line, one pixel wide, through the kernel's centre, scaled to the sum 1."""
    c, s = cos_sin_of(np.radians(angle_deg))
    half_length, half_width = length_px / 2, 0.5
    corners = np.array([
        [half_length, half_width], [-half_length, half_width], [-half_length, -half_width], [half_length, -half_width],
    ])  # fmt: skip
    reach = int(np.ceil(half_length + 1)) + 1
    box = (-reach, -reach, 2 * reach + 1, 2 * reach + 1)
    kernel = rasterise([[matmul(corners, np.array([[c, s], [-s, c]]))]], [box])[0]
    kernel = kernel + kernel[::-1, ::-1]  # makes the kernel point-symmetric to the last bit
    kernel[kernel < 1e-9] = 0.0  # removes rounding errors; OpenCV is quicker where a weight is 0
    border = int((kernel.any(axis=0) | kernel.any(axis=1)).argmax())
    return np.asarray(kernel[border : len(kernel) - border, border : len(kernel) - border] / kernel.sum())


def defocus(image: UInt8, radius_px: float) -> UInt8:
    """Blur like a lens out of focus: each point spreads over a disc, the circle of confusion.

    Parameters
    ----------
    image : ndarray of shape (H, W) or (H, W, 3), uint8
    radius_px : float
        Radius of the disc, px.

    Returns
    -------
    ndarray of the same shape, uint8

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.degrade import defocus
    >>> spot = np.zeros((9, 9), np.uint8)
    >>> spot[4, 4] = 255
    >>> int(defocus(spot, radius_px=2)[4, 4])  # 255 / (4 pi)
    20
    """
    return filter_image(image, disc_kernel(radius_px))


@lru_cache(maxsize=64)
def disc_kernel(radius_px: float) -> Float:
    """Return the exact area coverage of a disc about the kernel's centre, scaled to the sum 1."""
    step = 2 * np.pi / 256
    rim = arc_vertices(radius_px, np.arange(256) * step, step)
    reach = int(np.ceil(radius_px)) + 1
    kernel = rasterise([[rim]], [(-reach, -reach, 2 * reach + 1, 2 * reach + 1)])[0]
    kernel = kernel + kernel[::-1, ::-1]
    return np.asarray(kernel / kernel.sum())
