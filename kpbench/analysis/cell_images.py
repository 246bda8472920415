"""Images of designs as products of two matrices: their inks, and the images of the cells they consist of.

A design is a polar chequer, so its image is *linear* in its inks: the image of every cell is rendered
once for each attitude (exact area coverage), and a design's image, its derivatives and its correlations
with other designs are matrix products with its vector of inks. That is what makes it cheap to measure a
whole family of designs.

Conventions
-----------
* Inks are 1 for black and 0 for white.
* An *attitude* is a 2x2 matrix from the unit disc to px: a rotation and a foreshortening. Perspective
  within one patch is left out, a patch is small.
* What is *seen* is always a disc of :data:`SEEN_PX` radius about the keypoint. If that is a fraction
  ``seen`` of the patch, the patch is so much larger, and only its inner part is looked at. Beyond the
  disc the outermost ring goes on, so that no difference is owed to a background.
* Blur is Gaussian, its standard deviation a fraction of the seen radius.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from kpbench.geometry.coverage import bounding_box, rasterise
from kpbench.geometry.outline import arc_vertices
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32

TILTS_DEG = (0.0, 30.0, 60.0)
DIRECTIONS_DEG = (0.0, 45.0, 90.0, 135.0)  # of the tilt, in the image
TURNS = 24  # rotations in the plane that are compared, 15 degrees apart
SEEN_PX = 5.0
BLUR = 0.2
HALF = int(SEEN_PX) + 1  # of a window, px
MARGIN = int(np.ceil(4 * BLUR * SEEN_PX))  # around it, for the blur


@dataclass(frozen=True)
class Grid:
    """A polar chequer that several designs fit on.

    Attributes
    ----------
    radii : tuple of float
        Outer radii of the rings, ascending, in disc radii.
    angles_deg : tuple of float
        Borders of the sectors, ascending, in [0, 360).
    """

    radii: tuple[float, ...]
    angles_deg: tuple[float, ...]

    @classmethod
    def of(cls, patches: Sequence[Patch]) -> Grid:
        """The coarsest grid on which all the designs and their mirror images fit."""
        radii = np.unique(np.round(np.concatenate([p.cells[0][1:] for p in patches]), 9))
        angles = np.concatenate([p.cells[1] for p in patches])
        angles = np.unique(np.round(np.append(angles, -angles) % 360.0, 9) % 360.0)
        return cls(tuple(radii.tolist()), tuple(angles.tolist()))

    @property
    def shape(self) -> tuple[int, int]:
        """Rings, sectors."""
        return len(self.radii), len(self.angles_deg)

    def middles(self) -> tuple[Float, Float]:
        """Middle radii of the rings, middle angles of the sectors in degrees."""
        radii, angles = np.append(0.0, self.radii), np.array(self.angles_deg)
        return (radii[1:] + radii[:-1]) / 2, (angles + np.append(angles[1:], angles[0] + 360.0)) / 2

    def inks(self, patches: Sequence[Patch]) -> Float32:
        """Inks of the designs, shape (n, cells), ring by ring; a patch that ends early keeps its outer ring's inks."""
        radius, angle = self.middles()
        rows = []
        for patch in patches:
            at = np.minimum(radius, patch.extent - 1e-6)[:, None, None]
            turned = np.radians(angle)[None, :, None]
            rows.append(patch.is_black(np.concatenate([at * np.cos(turned), at * np.sin(turned)], -1)).ravel())
        return np.array(rows, np.float32)

    def mirrored(self, inks: Float32) -> Float32:
        """Inks of the mirror images, (n, cells); the grid's angles must be symmetric about 0."""
        middle = self.middles()[1] % 360.0
        order = [int(np.argmin(np.abs((middle + a + 180.0) % 360.0 - 180.0))) for a in middle]
        return inks.reshape(len(inks), *self.shape)[:, :, order].reshape(len(inks), -1)

    def cells(self, tolerance: float, reach: float = 0.0) -> list[Float]:
        """Every cell as a polygon of the patch frame; the outermost ring reaches to ``reach`` at least.

        Neighbours share the vertices of their common border, so that cells of one ink add up without a
        seam. ``tolerance`` is in disc radii, see :func:`kpbench.geometry.outline.flatten`.
        """
        radii = np.append(0.0, self.radii)
        radii[-1] = max(radii[-1], reach)
        polygons = []
        ends = np.append(self.angles_deg[1:], self.angles_deg[0] + 360.0)
        for inner, outer in pairwise(radii):
            for start, end in zip(self.angles_deg, ends, strict=True):
                near, far = _arc(inner, start, end, tolerance), _arc(outer, start, end, tolerance)
                polygons.append(np.concatenate([far, near[::-1]]))
        return polygons


def _arc(radius: float, start_deg: float, end_deg: float, tolerance: float) -> Float:
    if radius == 0.0:
        return np.zeros((1, 2))
    count = max(2, int(np.ceil(np.radians(end_deg - start_deg) / np.sqrt(16 * tolerance / radius))))
    angle = np.radians(np.linspace(start_deg, end_deg, count + 1))
    step = angle[1] - angle[0]
    points = arc_vertices(radius, angle, step)
    ends = angle[[0, -1]]
    points[[0, -1]] = radius * np.column_stack([np.cos(ends), np.sin(ends)])
    return points


def attitudes(turns: int = TURNS, tilts_deg: Sequence[float] = TILTS_DEG) -> Float:
    """Foreshortened turns of the unit disc, shape (P, 2, 2); those without a turn come first."""

    def turn(degrees: float) -> Float:
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        return np.array([[c, -s], [s, c]])

    views = [np.eye(2)] if 0.0 in tilts_deg else []
    for tilt in tilts_deg:
        if tilt:
            squeeze = np.diag([np.cos(np.radians(tilt)), 1.0])
            views += [turn(d) @ squeeze @ turn(-d) for d in DIRECTIONS_DEG]
    return np.array([view @ turn(360.0 * n / turns) for n in range(turns) for view in views])


def images(
    polygons: Sequence[Float], poses: Float, half: int, blur_px: float = 0.0, mix: Float32 | None = None
) -> Float32:
    """Exact coverage of polygons in a square window about the origin.

    Parameters
    ----------
    polygons : sequence of ndarray of shape (N, 2)
    poses : ndarray of shape (P, 2, 3)
        ``[A | shift]`` from the polygons' frame to px.
    half : int
        The window has ``2 * half + 1`` pixels a side, the origin in its middle.
    blur_px : float
        Standard deviation of a Gaussian.
    mix : ndarray of shape (M, len(polygons)), optional
        Weighted sums of the polygons to give instead of the polygons themselves.

    Returns
    -------
    ndarray of shape (P, len(polygons) or M, (2 * half + 1)**2), float32
    """
    wide = half + (int(np.ceil(4 * blur_px)) if blur_px else 0)
    out = []
    for pose in poses:
        placed = [p @ pose[:, :2].T + pose[:, 2] for p in polygons]
        boxes = [bounding_box([p]) for p in placed]
        covered = np.zeros((len(polygons), 2 * wide + 1, 2 * wide + 1), np.float32)
        for window, part, (x, y, w, h) in zip(covered, rasterise([[p] for p in placed], boxes), boxes, strict=True):
            left, top = max(-wide, x), max(-wide, y)
            right, bottom = min(wide + 1, x + w), min(wide + 1, y + h)
            if left < right and top < bottom:
                seen = part[top - y : bottom - y, left - x : right - x]
                window[top + wide : bottom + wide, left + wide : right + wide] = seen
        if mix is not None:
            covered = np.tensordot(mix, covered, 1)
        out.append(blurred(covered, blur_px, half).reshape(len(covered), -1))
    return np.array(out, np.float32)


def blurred(stack: Float32, blur_px: float, half: int) -> Float32:
    """The middle ``2 * half + 1`` pixels of blurred square images, (N, side, side), free of border effects."""
    wide = stack.shape[1] // 2
    if not blur_px:
        return stack[:, wide - half : wide + half + 1, wide - half : wide + half + 1]
    away = np.arange(-wide, wide + 1) - np.arange(-half, half + 1)[:, None]
    kernel = np.where(np.abs(away) <= 4 * blur_px, np.exp(-0.5 * (away / blur_px) ** 2), 0.0)
    kernel = (kernel / kernel.sum(1, keepdims=True)).astype(np.float32)
    return np.asarray(kernel @ stack @ kernel.T)


def _poses(attitude: Float, shift_px: tuple[float, float] = (0.0, 0.0)) -> Float:
    return np.concatenate([attitude, np.broadcast_to(np.array(shift_px)[None, :, None], (len(attitude), 2, 1))], 2)


def seen_cells(
    grid: Grid, attitude: Float, seen: float, shift_px: tuple[float, float] = (0.0, 0.0), blur: float = BLUR
) -> Float32:
    """Cells, (P, cells, pixels), of patches so large that ``seen`` of their radius is SEEN_PX."""
    farthest = np.hypot(HALF + MARGIN, HALF + MARGIN) + np.hypot(*shift_px) + 2
    reach = farthest * seen / SEEN_PX / np.linalg.svd(attitude, compute_uv=False).min()
    cells = grid.cells(0.01 * seen / SEEN_PX, float(reach))
    return images(cells, _poses(SEEN_PX / seen * attitude, shift_px), HALF, blur * SEEN_PX)


def window_weights(attitude: Float) -> Float32:
    """Weights of the pixels of the seen disc under each attitude, (P, pixels), summing to 1."""
    disc = _arc(1.0, 0.0, 360.0, 1e-3)[:-1]
    weight = images([disc], _poses(SEEN_PX * attitude), HALF)[:, 0]
    return np.asarray(weight / weight.sum(1, keepdims=True))


def moments(weight: Float32, cells: Float32, inks: Float32) -> tuple[Float32, Float32]:
    """Images of designs without their weighted mean, (n, pixels), and their standard deviations, (n,)."""
    image = inks @ cells
    image -= (image @ weight)[:, None]
    spread: Float32 = np.sqrt(np.maximum((image * image) @ weight, np.float32(1e-9)))
    return image, spread
