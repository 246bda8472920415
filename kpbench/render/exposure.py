"""Patches that move during the exposure: their masks and their true poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kpbench.camera.shutter import PatchMotion, Shutter, rasterise_moving, true_homography
from kpbench.geometry.homography import project_disc_sizes
from kpbench.geometry.warp import PointMap
from kpbench.patches.design import unit_polygons
from kpbench.render.placement import Placement
from kpbench.render.scene import Mask, inked_polygons, rasterise_patches

STILL = PatchMotion()
"""No motion."""
BLURRED_TOLERANCE_PX = 4e-3
"""Largest distance between a drawn edge and the true edge of a patch that moves, px."""


def expose_patches(
    placements: Sequence[Placement],
    motions: Sequence[PatchMotion],
    shutter: Shutter | None = None,
    warp: PointMap | None = None,
    ink_gain: float = 0.0,
    tolerance_px: float = BLURRED_TOLERANCE_PX,
) -> list[Mask]:
    """Compute which fraction of each pixel each patch covers, as a mean over the exposure.

    Parameters
    ----------
    placements : sequence of Placement
        The poses at time 0.
    motions : sequence of PatchMotion
        One motion per placement.
    shutter : Shutter, optional
        None: a global shutter.
    warp, ink_gain, tolerance_px
        As in :func:`kpbench.render.scene.rasterise_patches`. The warp follows the motion.

    Returns
    -------
    list of Mask
        One mask per placement.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import shipped_patches
    >>> from kpbench.camera.shutter import PatchMotion
    >>> from kpbench.render import Placement
    >>> from kpbench.render.exposure import expose_patches
    >>> H = np.array([[20.0, 0, 50], [0, 20, 40], [0, 0, 1]])
    >>> placement = Placement(shipped_patches()[0], H, 20, 230)
    >>> [mask] = expose_patches([placement], [PatchMotion(velocity_px=(6.0, 0.0))])
    >>> mask.box
    (26, 19, 49, 43)
    """
    masks = []
    for placement, motion in zip(placements, motions, strict=True):
        if motion == STILL:
            masks += rasterise_patches([placement], min(tolerance_px, 1e-3), warp, ink_gain)
            continue
        H, patch = placement.H_patch2image, placement.patch
        _, major, _ = project_disc_sizes(H[None])
        tolerance = float(np.ldexp(0.5, np.frexp(tolerance_px / major[0])[1]))
        polygons = inked_polygons(patch, tolerance, ink_gain) if ink_gain else unit_polygons(patch, tolerance)
        moving_map = motion.of_patch(H, warp)
        (box, black), (_, disc) = rasterise_moving(
            polygons, moving_map, shutter, same_box=True, tolerance_px=tolerance_px
        )
        masks.append(Mask(box, black, disc))
    return masks


def true_placement(
    placement: Placement,
    motion: PatchMotion = STILL,
    shutter: Shutter | None = None,
    warp: PointMap | None = None,
) -> Placement:
    """Return a placement with its true pose, see :func:`kpbench.camera.shutter.true_homography`.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import shipped_patches
    >>> from kpbench.render import Placement
    >>> from kpbench.render.exposure import true_placement
    >>> placement = Placement(shipped_patches()[0], np.diag([20.0, 20.0, 1.0]), 20, 230)
    >>> true_placement(placement, warp=lambda points: points + 5.0).H_patch2image[:2, 2].tolist()
    [5.0, 5.0]
    """
    H = placement.H_patch2image
    return replace(placement, H_patch2image=true_homography(motion.of_patch(H, warp), H, shutter))
