"""How well a design tells its centre: bounds of its error, and from how far a fit finds it.

Distances are root mean squares in units of the ink contrast. See :mod:`kpbench.analysis` for how designs are
rendered, blurred and seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kpbench.analysis.cell_images import (
    SEEN_PX,
    Grid,
    attitudes,
    images,
    moments,
    seen_cells,
    window_weights,
)
from kpbench.geometry.camera import Camera, plane_to_camera, rotation_xyz
from kpbench.geometry.homography import project_disc
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32

NOISE, CONTRAST = 10.0, 180.0  # grey levels


SEEN_BASIN = (1.0, 1 / 2, 1 / 3)


SHIFT = 0.25  # of the seen radius


@dataclass(frozen=True)
class Bound:
    """Cramér-Rao bound of the centre in px: worst direction and root mean square over both axes.

    The worst over the directions of the tilt. ``blur`` is the blur's standard deviation in disc radii.
    """

    radius_px: float
    tilt_deg: float
    blur: float
    worst_px: float
    rms_px: float


def bound(
    cells: Sequence[Float], inks: Float32, attitude: Float, blur_px: float = 0.0, rim: bool = True
) -> tuple[Float, Float]:
    """Cramér-Rao bound of the point at the cells' origin, in px, at NOISE and CONTRAST.

    Unknown are the point, the 2x2 affine deformation and both inks (8 unknowns); derivatives are central
    differences of exact renders. Fisher information of a Gaussian: S. Kay, *Fundamentals of Statistical
    Signal Processing: Estimation Theory*, 1993, eq. 3.31. Around the cells lies a known mid-grey.

    Parameters
    ----------
    cells : sequence of ndarray of shape (N, 2)
    inks : ndarray of shape (n, len(cells))
    attitude : ndarray of shape (2, 2)
        From the cells' frame to px.
    blur_px : float
    rim : bool
        False to use only pixels that the cells cover altogether, as on an unknown background.

    Returns
    -------
    worst_px, rms_px : ndarrays of shape (n,)
        Standard deviation in the worst direction, and the root mean square over the two axes; infinite
        where the image does not determine the point.
    """
    step = 0.02
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
        parts = images(cells, np.array(poses), half, blur_px, sums)
    else:
        parts = sums @ images(cells, np.array(poses), half, blur_px)
    if not rim:
        parts = parts[:, :, np.all(parts[:, -1] > 1 - 1e-5, axis=0)]
    exact = parts.astype(np.float64).transpose(1, 0, 2)
    black, whole = exact[:-1], exact[-1]
    image = 0.5 * whole - black  # white is 1/2, black is -1/2, what surrounds them is 0
    geometric = (image[:, 1::2] - image[:, 2::2]) / (2 * step)
    J = np.concatenate([geometric, black[:, :1], whole[:1] - black[:, :1]], axis=1) * (CONTRAST / NOISE)
    F = J @ J.transpose(0, 2, 1)
    nuisance = np.linalg.pinv(F[:, 2:, 2:], rcond=1e-7, hermitian=True)
    centre = F[:, :2, :2] - F[:, :2, 2:] @ nuisance @ F[:, 2:, :2]
    information = np.linalg.eigvalsh(centre)
    known = information > 1e-5 * F[:, :2, :2].trace(axis1=1, axis2=2)[:, None]
    variance = np.where(known, 1 / np.where(known, information, 1.0), np.inf)
    return np.sqrt(variance.max(1)), np.sqrt(variance.mean(1))


def disc_bound(
    grid: Grid, inks: Float32, radius_px: float, tilt_deg: float = 0.0, blur: float = 0.0, rim: bool = True
) -> tuple[Float, Float]:
    """:func:`bound` of designs of a radius and tilt; the worst over the directions of the tilt."""
    cells = grid.cells(0.005 / radius_px)
    found = [
        bound(cells, inks, radius_px * view, blur * radius_px, rim)
        for view in attitudes(turns=1, tilts_deg=(tilt_deg,))
    ]
    return np.max([worst for worst, _ in found], axis=0), np.max([rms for _, rms in found], axis=0)


def basin(grid: Grid, inks: Float32) -> Float:
    """How unlike a design is to itself a little off the centre, in any direction and whatever part is seen.

    A blurred patch is compared with itself shifted by SHIFT of the seen radius, in any attitude. What is
    left after the best gain and offset, as a root mean square in ink contrasts, is taken in the worst of
    eight directions, the best attitude, and the worst of the seen parts SEEN_BASIN.

    Returns
    -------
    ndarray of shape (n,)
    """
    view = attitudes()
    weight = window_weights(np.eye(2)[None])[0]
    least = np.full(len(inks), np.inf)
    for seen in SEEN_BASIN:
        still, spread = moments(weight, seen_cells(grid, np.eye(2)[None], seen)[0], inks)
        for angle in 2 * np.pi * np.arange(8) / 8:
            shift = (SHIFT * SEEN_PX * np.cos(angle), SHIFT * SEEN_PX * np.sin(angle))
            best = np.zeros(len(inks), np.float32)
            for cells in seen_cells(grid, view, seen, shift):
                moved, moved_spread = moments(weight, cells, inks)
                best = np.maximum(best, np.einsum("np,np,p->n", still, moved, weight) / (spread * moved_spread))
            least = np.minimum(least, spread * np.sqrt(np.maximum(1 - best**2, 0)))
    return least


def tilt_bias(patch: Patch, radius_px: float = 45.0, tilt_deg: float = 60.0) -> float:
    """How far the centre of the patch's arcs lies from its keypoint in a tilted view, px.

    0 where straight edges cross at the keypoint. Else all that tells the centre (at least along an edge) are
    arcs, whose images' centres are not the image of their centre. Camera of the paper (1624x1240, f = 889 px).
    """
    if patch.centre_is_crossing:
        return 0.0
    camera = Camera(1624, 1240, 889.0)
    pose = plane_to_camera(rotation_xyz(0.0, tilt_deg, 0.0), [0.0, 0.0, camera.focal_px / radius_px])
    H = camera.K @ pose
    keypoint = H[:2, 2] / H[2, 2]
    disc = project_disc(H)
    return float(np.hypot(disc.x - keypoint[0], disc.y - keypoint[1]))
