"""Localisation: how exactly the image of a design determines the design's centre."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kpbench.analysis.cell_images import (
    WINDOW_PX,
    PolarGrid,
    attitudes,
    mean_free_images,
    render_cells,
    render_polygons,
    window_weights,
)
from kpbench.geometry.camera import Camera, plane_to_camera, rotation_xyz
from kpbench.geometry.homography import project_disc
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32

NOISE = 10.0  # grey levels, standard deviation of the noise in a pixel
CONTRAST = 180.0  # grey levels, white minus black
PARTS_OF_BASIN = (1.0, 1 / 2, 1 / 3)  # fractions of the patch's radius that the window shows
SHIFT = 0.25  # shift of a design against its copy, as a fraction of the window's radius
SHIFT_DIRECTIONS = 8


@dataclass(frozen=True)
class Bound:
    """Cramér-Rao bound on the image position of a design's centre, for the worst direction of the tilt.

    Attributes
    ----------
    radius_px : float
        Radius of the disc.
    tilt_deg : float
        Angle between the optical axis and the normal of the patch.
    blur : float
        Standard deviation of the blur, in disc radii.
    worst_px : float
        Largest standard deviation of the centre over all directions in the image.
    rms_px : float
        Root mean square of the standard deviations along x and y.

    Examples
    --------
    >>> from kpbench.analysis import Bound
    >>> Bound(radius_px=5.0, tilt_deg=0.0, blur=0.2, worst_px=0.02, rms_px=0.018).worst_px
    0.02
    """

    radius_px: float
    tilt_deg: float
    blur: float
    worst_px: float
    rms_px: float


def point_bound(
    cells: Sequence[Float], inks: Float32, attitude: Float, blur_px: float = 0.0, rim: bool = True
) -> tuple[Float, Float]:
    """Return the Cramér-Rao bound on the image position of the origin of the cells' frame.

    The 8 unknowns are the position (2), the linear part of the affine map (4) and the grey levels of both inks (2). The
    derivatives of the image with respect to the unknowns are central differences of exact images. With Gaussian noise,
    the Fisher information is ``F = J Jᵀ``, where J holds the derivatives divided by the standard deviation of the noise
    (S. Kay, *Fundamentals of Statistical Signal Processing: Estimation Theory*, 1993, eq. 3.31). The contrast is
    :data:`CONTRAST`, the noise is :data:`NOISE`, and the surroundings of the cells are a known mid-grey.

    Parameters
    ----------
    cells : sequence of ndarray of shape (N, 2)
        Polygons that cover the pattern.
    inks : ndarray of shape (n, len(cells)), float32
        Inks of n patterns, 1 for black and 0 for white.
    attitude : ndarray of shape (2, 2)
        Matrix from the frame of the cells to px.
    blur_px : float
        Standard deviation of a Gaussian blur.
    rim : bool
        Whether to use pixels that lie partly outside the cells. False suits an unknown background.

    Returns
    -------
    worst_px, rms_px : ndarray of shape (n,)
        Standard deviation of the position in the worst direction, and root mean square of the standard deviations along
        x and y. Both are infinite if the image does not determine the position.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.analysis import point_bound
    >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    >>> cells = [square - (column, row) for row in (0, 1) for column in (0, 1)]
    >>> checker = np.array([[1, 0, 0, 1]], np.float32)
    >>> worst_px, rms_px = point_bound(cells, checker, attitude=8.0 * np.eye(2))
    >>> round(float(worst_px[0]), 3)
    0.012
    """
    step = 0.02  # px, step of the central differences
    base = np.column_stack([attitude, np.zeros(2)])
    size = max(np.linalg.norm(np.concatenate(list(cells)), axis=1).max(), 1e-9)
    poses = [base]
    for row, column, move in [(0, 2, 1.0), (1, 2, 1.0), *((r, c, 1 / size) for r in (0, 1) for c in (0, 1))]:
        for sign in (1, -1):
            pose = base.copy()
            pose[row, column] += sign * step * move
            poses.append(pose)
    half = int(np.ceil(np.abs(np.concatenate(list(cells)) @ attitude.T).max() + 3 * blur_px)) + 2
    sums = np.vstack([inks, np.ones((1, len(cells)), np.float32)])
    if len(sums) < len(cells):
        parts = render_polygons(cells, np.array(poses), half, blur_px, sums)
    else:
        parts = sums @ render_polygons(cells, np.array(poses), half, blur_px)
    if not rim:
        parts = parts[:, :, np.all(parts[:, -1] > 1 - 1e-5, axis=0)]
    exact = parts.astype(np.float64).transpose(1, 0, 2)
    black, whole = exact[:-1], exact[-1]
    image = 0.5 * whole - black  # white is 1/2, black is -1/2, the surroundings are 0
    geometric = (image[:, 1::2] - image[:, 2::2]) / (2 * step)
    J = np.concatenate([geometric, black[:, :1], whole[:1] - black[:, :1]], axis=1) * (CONTRAST / NOISE)
    F = J @ J.transpose(0, 2, 1)
    nuisance = np.linalg.pinv(F[:, 2:, 2:], rcond=1e-7, hermitian=True)
    # Schur complement: the information on the position when the other six unknowns are estimated too
    centre = F[:, :2, :2] - F[:, :2, 2:] @ nuisance @ F[:, 2:, :2]
    information = np.linalg.eigvalsh(centre)
    known = information > 1e-5 * F[:, :2, :2].trace(axis1=1, axis2=2)[:, None]
    variance = np.where(known, 1 / np.where(known, information, 1.0), np.inf)
    return np.sqrt(variance.max(1)), np.sqrt(variance.mean(1))


def design_bound(
    grid: PolarGrid, inks: Float32, radius_px: float, tilt_deg: float = 0.0, blur: float = 0.0, rim: bool = True
) -> tuple[Float, Float]:
    """Return :func:`point_bound` for the centres of designs, in the worst direction of the tilt.

    Parameters
    ----------
    grid : PolarGrid
    inks : ndarray of shape (n, cells), float32
        See :meth:`PolarGrid.inks`.
    radius_px : float
        Radius of the disc.
    tilt_deg : float
        Angle between the optical axis and the normal of the patch.
    blur : float
        Standard deviation of the blur, in disc radii.
    rim : bool
        See :func:`point_bound`.

    Returns
    -------
    worst_px, rms_px : ndarray of shape (n,)

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.analysis import PolarGrid, design_bound
    >>> patches = kpbench.shipped_patches()
    >>> grid = PolarGrid.of(patches)
    >>> worst_px, rms_px = design_bound(grid, grid.inks(patches), radius_px=8.0)
    >>> [round(float(px), 3) for px in worst_px]
    [0.012, 0.012, 0.013, 0.013]
    """
    cells = grid.cell_polygons(0.005 / radius_px)
    found = [
        point_bound(cells, inks, radius_px * view, blur * radius_px, rim)
        for view in attitudes(turns=1, tilts_deg=(tilt_deg,))
    ]
    return np.max([worst for worst, _ in found], axis=0), np.max([rms for _, rms in found], axis=0)


def basin(grid: PolarGrid, inks: Float32) -> Float:
    """Return the smallest difference between each design and a shifted copy of the design.

    The design is seen in a frontal view. The copy is shifted by :data:`SHIFT` window radii in each of eight directions,
    and is seen in every attitude. Both are blurred. A gain and an offset fit the image of the copy to the image of the
    design. The window shows each fraction of the patch's radius in :data:`PARTS_OF_BASIN` in turn. A difference is a
    root mean square, divided by the ink contrast.

    Parameters
    ----------
    grid : PolarGrid
    inks : ndarray of shape (n, cells), float32

    Returns
    -------
    ndarray of shape (n,), float64

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.analysis import PolarGrid, basin
    >>> patches = kpbench.shipped_patches()[:1]
    >>> grid = PolarGrid.of(patches)
    >>> basin(grid, grid.inks(patches)).round(3)  # doctest: +SKIP
    array([0.175])
    """
    view = attitudes()
    weight = window_weights(np.eye(2)[None])[0]
    least = np.full(len(inks), np.inf)
    for seen in PARTS_OF_BASIN:
        centred, spread = mean_free_images(weight, render_cells(grid, np.eye(2)[None], seen)[0], inks)
        for angle in 2 * np.pi * np.arange(SHIFT_DIRECTIONS) / SHIFT_DIRECTIONS:
            shift = (SHIFT * WINDOW_PX * np.cos(angle), SHIFT * WINDOW_PX * np.sin(angle))
            best = np.zeros(len(inks), np.float32)
            for cells in render_cells(grid, view, seen, shift):
                shifted, shifted_spread = mean_free_images(weight, cells, inks)
                correlation = np.einsum("np,np,p->n", centred, shifted, weight) / (spread * shifted_spread)
                best = np.maximum(best, correlation)
            least = np.minimum(least, spread * np.sqrt(np.maximum(1 - best**2, 0)))
    return least


def tilt_bias(patch: Patch, radius_px: float = 45.0, tilt_deg: float = 60.0) -> float:
    """Return the distance in px between the keypoint and the centre of the disc's ellipse, in a tilted view.

    The ellipse's centre is not the image of the disc's centre. If straight edges cross at the keypoint, they determine
    the keypoint, and 0 is returned. Otherwise arcs alone determine the keypoint in at least one direction. The view
    is from the paper's camera (1624x1240 px, focal length 889 px).
    """
    if patch.centre_is_crossing:
        return 0.0
    camera = Camera(1624, 1240, 889.0)
    pose = plane_to_camera(rotation_xyz(0.0, tilt_deg, 0.0), [0.0, 0.0, camera.focal_px / radius_px])
    H = camera.K @ pose
    keypoint = H[:2, 2] / H[2, 2]
    disc = project_disc(H)
    return float(np.hypot(disc.x - keypoint[0], disc.y - keypoint[1]))
