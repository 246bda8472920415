"""Places of X-corners in an image, as centres of point symmetry.

Around an X-corner, two black and two white sectors meet. The print looks the same after half a turn about the corner.
Blur, a tone curve, ink gain and perspective keep this symmetry. The corner c is therefore found as the point about
which the image is most symmetric: ``I(c + u) = I(c - u)``. A gradient of the light breaks the symmetry and is fitted
along with the place (least squares by Gauss and Newton).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.types import Float, Float32, UInt8

SMOOTHING_PX = 1.0
"""Standard deviation of the smoothing before the image is interpolated."""
COARSE_SMOOTHING_PX = 2.0
"""Standard deviation of the smoothing of the first steps, which start up to some px beside the corner."""
COARSE_CORNER_STEPS, FINE_CORNER_STEPS = 3, 5
LONGEST_STEP_PX = 1.5
"""Longest step in each coordinate."""
LEAST_WINDOW_PX, LARGEST_WINDOW_PX = 3, 12
"""Radius of the window about a corner."""
LEAST_X_LIKENESS = 0.75
"""Least correlation between the image about a corner and the ideal X."""
LARGEST_ASYMMETRY = 0.25
"""Largest standard deviation of what is not symmetric, in standard deviations of the image about the corner."""
NOISE_AREA_PX = 20.0
"""Area over which smoothing and interpolation correlate the noise of pixels, about 4 pi sigma² of both."""
LEAST_CORNER_SIGMA_PX = 0.006
"""Added to the standard deviation of a corner: interpolation and rounding of grey levels."""


class XCorners(NamedTuple):
    """Places of n X-corners."""

    xy: Float
    """Of shape (n, 2), px."""
    covariance: Float
    """Of shape (n, 2, 2), px²."""
    is_found: NDArray[np.bool_]
    """Whether there is an X-corner, of shape (n,). The rows of others have no meaning."""


def refine_x_corners(image: UInt8 | Float32, start_px: Float, A_board2image: Float, reach_mm: float) -> XCorners:
    """Find X-corners near given places.

    Parameters
    ----------
    image : ndarray of shape (H, W)
    start_px : ndarray of shape (n, 2)
        Places up to about 2 px beside the corners.
    A_board2image : ndarray of shape (n, 2, 2)
        Derivative of the image point by the point on the board at each corner, px per mm. The edges of the corners are
        columns of this matrix, and the sectors of (+, +) and (-, -) are white.
    reach_mm : float
        Radius about a corner on the board within which there is nothing but the corner.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.calibration.xcorners import refine_x_corners
    >>> across, down = np.meshgrid(np.arange(60) - 30.25, np.arange(60) - 29.5)
    >>> edge = lambda v: np.clip(v, -1, 1)
    >>> image = (128 + 80 * edge(across) * edge(down)).astype(np.uint8)
    >>> refine_x_corners(image, np.array([[31.0, 29.0]]), np.eye(2)[None], reach_mm=12.0).xy.round(2)
    array([[30.25, 29.5 ]])
    """
    n = len(start_px)
    xy, covariance, is_found = start_px.astype(np.float64), np.tile(np.eye(2), (n, 1, 1)), np.zeros(n, bool)
    if not n:
        return XCorners(xy, covariance, is_found)
    least_scale = np.linalg.svd(A_board2image, compute_uv=False)[:, 1]
    radius = np.floor(np.clip(reach_mm * least_scale - 1.0, 0, LARGEST_WINDOW_PX)).astype(int)
    height, width = image.shape
    margin = radius + 2
    inside = (xy >= margin[:, None]).all(axis=1) & (xy < np.array([width, height]) - 1 - margin[:, None]).all(axis=1)
    coarse, fine = (_Smoothed.of(image, sigma) for sigma in (COARSE_SMOOTHING_PX, SMOOTHING_PX))
    for r in range(LEAST_WINDOW_PX, LARGEST_WINDOW_PX + 1):
        rows = np.flatnonzero((radius == r) & inside)
        if len(rows):
            xy[rows], covariance[rows], is_found[rows] = _refine(coarse, fine, xy[rows], A_board2image[rows], r)
    return XCorners(xy, covariance, is_found)


class _Smoothed(NamedTuple):
    """A smoothed image and its derivatives."""

    image: Float32
    along_x: Float32
    along_y: Float32

    @classmethod
    def of(cls, image: UInt8 | Float32, sigma_px: float) -> _Smoothed:
        smooth = cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
        along_x = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1, scale=0.5), np.float32)
        along_y = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1, scale=0.5), np.float32)
        return cls(np.asarray(smooth, np.float32), along_x, along_y)

    def sample(self, points: Float) -> list[Float]:
        """Return image and derivatives at points of shape (..., 2), by bilinear interpolation."""
        limit = np.array(self.image.shape[::-1]) - 2
        below = np.clip(np.floor(points), 0, limit).astype(np.int64)
        (fx, fy), (x, y) = np.moveaxis(points - below, -1, 0), np.moveaxis(below, -1, 0)
        first = y * self.image.shape[1] + x
        found = []
        for plane in self:
            flat = plane.ravel()
            top = flat[first] * (1 - fx) + flat[first + 1] * fx
            bottom = flat[first + self.image.shape[1]] * (1 - fx) + flat[first + self.image.shape[1] + 1] * fx
            found.append(np.asarray(top * (1 - fy) + bottom * fy, np.float64))
        return found


def _refine(
    coarse: _Smoothed, fine: _Smoothed, start: Float, A_board2image: Float, radius: int
) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Refine corners whose windows have one radius."""
    grid = np.stack(np.meshgrid(*[np.arange(-radius, radius + 1)] * 2), axis=-1).reshape(-1, 2)
    half = (grid[:, 1] > 0) | ((grid[:, 1] == 0) & (grid[:, 0] > 0))  # each pair of opposite points once
    distance = np.hypot(*grid.T)
    offsets = grid[half & (distance <= radius)].astype(np.float64)
    weight = np.clip(radius + 1 - distance[half & (distance <= radius)], 0, 1.5) / 1.5
    xy = start.copy()
    for step in range(COARSE_CORNER_STEPS + FINE_CORNER_STEPS):
        delta, normal, residual, even = _solve(coarse if step < COARSE_CORNER_STEPS else fine, xy, offsets, weight)
        xy += np.clip(delta, -LONGEST_STEP_PX, LONGEST_STEP_PX)
    spread = np.sqrt(
        np.average((even - np.average(even, axis=1, weights=weight)[:, None]) ** 2, axis=1, weights=weight)
    )
    noise = np.sqrt(np.average(residual**2, axis=1, weights=weight) * len(weight) / max(len(weight) - 4, 1))
    covariance = noise[:, None, None] ** 2 * NOISE_AREA_PX * np.linalg.inv(normal)[:, :2, :2]
    covariance = covariance / 2 + LEAST_CORNER_SIGMA_PX**2 * np.eye(2)  # half of it: both points of a pair have noise
    on_board = np.einsum("nij,kj->nki", np.linalg.inv(A_board2image), offsets)
    soft = np.tanh(on_board * np.linalg.svd(A_board2image, compute_uv=False)[:, None, 1:] / 1.5).prod(axis=2)
    soft -= np.average(soft, axis=1, weights=weight)[:, None]
    centred = even - np.average(even, axis=1, weights=weight)[:, None]
    scale = np.sqrt((weight * soft**2).sum(axis=1) * (weight * centred**2).sum(axis=1))
    likeness = np.divide((weight * soft * centred).sum(axis=1), scale, out=np.zeros(len(xy)), where=scale > 0)
    is_found = (likeness > LEAST_X_LIKENESS) & (noise < LARGEST_ASYMMETRY * spread)
    is_found &= (np.abs(delta).max(axis=1) < 0.05) & (np.hypot(*(xy - start).T) < max(4.0, radius))
    return xy, covariance, is_found


def _solve(image: _Smoothed, xy: Float, offsets: Float, weight: Float) -> tuple[Float, Float, Float, Float]:
    """Return a step to the centre of symmetry, the normal matrix, the residuals, and the even part of the image."""
    (one, one_x, one_y), (other, other_x, other_y) = (image.sample(xy[:, None] + s * offsets) for s in (1, -1))
    even = (one + other) / 2
    level = even / np.maximum(np.abs(even).max(axis=1), 1.0)[:, None]
    J = np.stack([other_x - one_x, other_y - one_y, level * offsets[:, 0], level * offsets[:, 1]], axis=-1)
    difference = one - other
    normal = np.einsum("nki,nkj,k->nij", J, J, weight) + 1e-9 * np.eye(4)
    solution = np.linalg.solve(normal, np.einsum("nki,nk,k->ni", J, difference, weight)[..., None])[..., 0]
    residual = difference - np.einsum("nki,ni->nk", J, solution)
    return solution[:, :2], normal, residual, even
