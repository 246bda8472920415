"""Images of designs as matrix products: the inks of a design times the images of its cells.

A design is a polar chequer: rings and sectors divide the design into cells, and each cell is black or white. The image
of a design is therefore *linear* in the inks of the cells. Every cell is rendered once per attitude, with exact area
coverage. The vector of a design's inks times the matrix of cell images then gives the image of the design. Such matrix
products make the measures of a whole family of designs affordable.

Conventions
-----------
* An ink is 1 for black and 0 for white.
* An *attitude* is a 2x2 matrix from the unit disc to px: a rotation and a foreshortening. A patch is small, so the
  perspective within the patch is left out.
* The *window* is a disc of :data:`WINDOW_PX` radius about the keypoint. Only the pixels of the window are compared. If
  the window shows the fraction ``seen`` of the patch's radius, the patch has a radius of ``WINDOW_PX / seen`` px.
* The outermost ring continues outside the patch. Differences between designs therefore never come from a background.
* Blur is Gaussian. Its standard deviation is given as a fraction of the window's radius.
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
TILT_DIRECTIONS_DEG = (0.0, 45.0, 90.0, 135.0)  # directions in the image along which a tilted patch is foreshortened
TURNS = 24  # number of rotations in the plane that are compared, 15 degrees apart
WINDOW_PX = 5.0  # radius of the window
BLUR = 0.2  # standard deviation, as a fraction of the window's radius
HALF_SIDE_PX = int(WINDOW_PX) + 1  # the square around the window has this many px on each side of its middle px
BLUR_MARGIN_PX = int(np.ceil(4 * BLUR * WINDOW_PX))  # margin around the square, as wide as the blur reaches


@dataclass(frozen=True)
class PolarGrid:
    """Rings and sectors of a polar chequer that several designs share.

    Attributes
    ----------
    radii : tuple of float
        Outer radii of the rings, ascending, in disc radii.
    angles_deg : tuple of float
        Borders of the sectors, ascending, in [0, 360).

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.analysis import PolarGrid
    >>> grid = PolarGrid.of(kpbench.shipped_patches())
    >>> grid.shape
    (2, 8)
    >>> grid.inks(kpbench.shipped_patches()).shape
    (4, 16)
    """

    radii: tuple[float, ...]
    angles_deg: tuple[float, ...]

    @classmethod
    def of(cls, patches: Sequence[Patch]) -> PolarGrid:
        """Return the grid with all radii and sector borders of the designs and of their mirror images."""
        radii = np.unique(np.round(np.concatenate([p.cells[0][1:] for p in patches]), 9))
        angles = np.concatenate([p.cells[1] for p in patches])
        angles = np.unique(np.round(np.append(angles, -angles) % 360.0, 9) % 360.0)
        return cls(tuple(radii.tolist()), tuple(angles.tolist()))

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rings and number of sectors."""
        return len(self.radii), len(self.angles_deg)

    def middles(self) -> tuple[Float, Float]:
        """Return the middle radii of the rings, and the middle angles of the sectors in degrees."""
        radii, angles = np.append(0.0, self.radii), np.array(self.angles_deg)
        return (radii[1:] + radii[:-1]) / 2, (angles + np.append(angles[1:], angles[0] + 360.0)) / 2

    def inks(self, patches: Sequence[Patch]) -> Float32:
        """Return the inks of designs, shape (n, cells), ring by ring.

        A patch that is smaller than the grid continues with the inks of its outermost ring.
        """
        radius, angle = self.middles()
        rows = []
        for patch in patches:
            inside = np.minimum(radius, patch.extent - 1e-6)[:, None, None]
            radians = np.radians(angle)[None, :, None]
            rows.append(
                patch.is_black(np.concatenate([inside * np.cos(radians), inside * np.sin(radians)], -1)).ravel()
            )
        return np.array(rows, np.float32)

    def mirror_inks(self, inks: Float32) -> Float32:
        """Return the inks of the mirror images, shape (n, cells). The grid's angles must be symmetric about 0."""
        middle = self.middles()[1] % 360.0
        order = [int(np.argmin(np.abs((middle + a + 180.0) % 360.0 - 180.0))) for a in middle]
        return inks.reshape(len(inks), *self.shape)[:, :, order].reshape(len(inks), -1)

    def cell_polygons(self, tolerance: float, reach: float = 0.0) -> list[Float]:
        """Return every cell as a polygon in the patch frame.

        Neighbouring cells share the vertices of their common border, so cells of one ink add up without a seam.

        Parameters
        ----------
        tolerance : float
            As for :func:`kpbench.geometry.flatten`, in disc radii.
        reach : float
            The outermost ring extends at least to this radius, in disc radii.
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
    """Return attitudes: rotations in the plane, foreshortened by every tilt.

    Parameters
    ----------
    turns : int
        Number of rotations in the plane, evenly spaced over a full turn.
    tilts_deg : sequence of float
        Angles between the optical axis and the normal of the patch. Each tilt other than 0 occurs in every direction
        of :data:`TILT_DIRECTIONS_DEG`.

    Returns
    -------
    ndarray of shape (P, 2, 2)
        Matrices from the unit disc to px, for a patch of 1 px radius. Attitudes without rotation in the plane come
        first.

    Examples
    --------
    >>> from kpbench.analysis import attitudes
    >>> attitudes(turns=1, tilts_deg=(0.0, 60.0)).shape
    (5, 2, 2)
    """

    def turn(degrees: float) -> Float:
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        return np.array([[c, -s], [s, c]])

    views = [np.eye(2)] if 0.0 in tilts_deg else []
    for tilt in tilts_deg:
        if tilt:
            squeeze = np.diag([np.cos(np.radians(tilt)), 1.0])
            views += [turn(d) @ squeeze @ turn(-d) for d in TILT_DIRECTIONS_DEG]
    return np.array([view @ turn(360.0 * n / turns) for n in range(turns) for view in views])


def render_polygons(
    polygons: Sequence[Float], poses: Float, half: int, blur_px: float = 0.0, mix: Float32 | None = None
) -> Float32:
    """Return the exact fraction of each pixel that polygons cover, in a square about the origin.

    Parameters
    ----------
    polygons : sequence of ndarray of shape (N, 2)
    poses : ndarray of shape (P, 2, 3)
        Affine maps ``[A | shift]`` from the frame of the polygons to px.
    half : int
        The side of the square is ``2 * half + 1`` px. The origin is the middle of the square.
    blur_px : float
        Standard deviation of a Gaussian blur; 0 for none.
    mix : ndarray of shape (M, len(polygons)), optional
        Weights. The result then holds M weighted sums of coverages instead of the coverage of each polygon.

    Returns
    -------
    ndarray of shape (P, len(polygons) or M, (2 * half + 1)**2), float32
    """
    wide = half + (int(np.ceil(4 * blur_px)) if blur_px else 0)
    out = []
    for pose in poses:
        in_px = [p @ pose[:, :2].T + pose[:, 2] for p in polygons]
        boxes = [bounding_box([p]) for p in in_px]
        covered = np.zeros((len(polygons), 2 * wide + 1, 2 * wide + 1), np.float32)
        for window, part, (x, y, w, h) in zip(covered, rasterise([[p] for p in in_px], boxes), boxes, strict=True):
            left, top = max(-wide, x), max(-wide, y)
            right, bottom = min(wide + 1, x + w), min(wide + 1, y + h)
            if left < right and top < bottom:
                seen = part[top - y : bottom - y, left - x : right - x]
                window[top + wide : bottom + wide, left + wide : right + wide] = seen
        if mix is not None:
            covered = np.tensordot(mix, covered, 1)
        out.append(blur_middle(covered, blur_px, half).reshape(len(covered), -1))
    return np.array(out, np.float32)


def blur_middle(stack: Float32, blur_px: float, half: int) -> Float32:
    """Return the middle ``2 * half + 1`` rows and columns of blurred square images, shape (N, side, side).

    The images must be large enough that no blur kernel of a middle pixel reaches beyond their borders.
    """
    wide = stack.shape[1] // 2
    if not blur_px:
        return stack[:, wide - half : wide + half + 1, wide - half : wide + half + 1]
    offset = np.arange(-wide, wide + 1) - np.arange(-half, half + 1)[:, None]
    kernel = np.where(np.abs(offset) <= 4 * blur_px, np.exp(-0.5 * (offset / blur_px) ** 2), 0.0)
    kernel = (kernel / kernel.sum(1, keepdims=True)).astype(np.float32)
    return np.asarray(kernel @ stack @ kernel.T)


def _poses(attitude: Float, shift_px: tuple[float, float] = (0.0, 0.0)) -> Float:
    return np.concatenate([attitude, np.broadcast_to(np.array(shift_px)[None, :, None], (len(attitude), 2, 1))], 2)


def render_cells(
    grid: PolarGrid, attitude: Float, seen: float, shift_px: tuple[float, float] = (0.0, 0.0), blur: float = BLUR
) -> Float32:
    """Return the images of all cells, shape (P, cells, pixels), in the window.

    Parameters
    ----------
    grid : PolarGrid
    attitude : ndarray of shape (P, 2, 2)
        See :func:`attitudes`.
    seen : float
        Fraction of the patch's radius that the window shows.
    shift_px : (float, float)
        Offset of the keypoint from the middle of the window, px.
    blur : float
        Standard deviation of the blur, as a fraction of the window's radius.
    """
    farthest = np.hypot(HALF_SIDE_PX + BLUR_MARGIN_PX, HALF_SIDE_PX + BLUR_MARGIN_PX) + np.hypot(*shift_px) + 2
    reach = farthest * seen / WINDOW_PX / np.linalg.svd(attitude, compute_uv=False).min()
    cells = grid.cell_polygons(0.01 * seen / WINDOW_PX, float(reach))
    return render_polygons(cells, _poses(WINDOW_PX / seen * attitude, shift_px), HALF_SIDE_PX, blur * WINDOW_PX)


def window_weights(attitude: Float) -> Float32:
    """Return the weights of pixels for each attitude, shape (P, pixels).

    A weight is proportional to the share of the pixel that the foreshortened window covers. The weights of an attitude
    sum to 1.
    """
    disc = _arc(1.0, 0.0, 360.0, 1e-3)[:-1]
    weight = render_polygons([disc], _poses(WINDOW_PX * attitude), HALF_SIDE_PX)[:, 0]
    return np.asarray(weight / weight.sum(1, keepdims=True))


def mean_free_images(weight: Float32, cells: Float32, inks: Float32) -> tuple[Float32, Float32]:
    """Return the images (n, pixels) of designs, and the weighted standard deviations (n,) of these images.

    The weighted mean of each image is subtracted.
    """
    image = inks @ cells
    image -= (image @ weight)[:, None]
    spread: Float32 = np.sqrt(np.maximum((image * image) @ weight, np.float32(1e-9)))
    return image, spread
