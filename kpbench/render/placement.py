"""Random placements of patches in an image, within limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from kpbench.errors import DataError
from kpbench.geometry.homography import project_disc_sizes
from kpbench.patches.design import Patch
from kpbench.portable import cos_sin, exp, log
from kpbench.types import Float

GAP_PX = 2.0
"""Smallest gap between the rims of two patches of a random scene, px."""
PLACEMENT_ROUNDS = 25
"""Largest number of rounds in the search for free places in a random scene. Usually, one round suffices."""
LARGEST_DEPTH_CHANGE = 0.5
"""Largest difference in depth between a disc's centre and its rim, as a fraction of the depth of the centre."""


@dataclass(frozen=True)
class Limits:
    """Ranges from which a random scene is drawn.

    The defaults are the ranges of the paper (§3.2), where the paper gives a range.

    Attributes
    ----------
    count : (int, int)
        Smallest and largest number of patches per image.
    minor_axis_px : float
        Least minor axis of a projected disc, px. The minor axis is twice the minor semi-axis.
    axis_difference : float
        Largest (major axis − minor axis) / major axis of a projected disc.
    radius_px : (float, float)
        Smallest and largest radius of a disc before the tilt, px; the radius is drawn log-uniformly.
    tilt_deg : float
        Largest tilt, degrees. A patch is tilted about two axes in its plane; the two angles are drawn independently.
    focal : (float, float)
        Shortest and longest focal length, in image widths; the focal length is drawn log-uniformly.
    black, white : (float, float)
        Smallest and largest grey level of black ink, and of white ink.

    Raises
    ------
    DataError
        If ``radius_px`` is no range from 1 to 4096 px, or if its largest radius is too small for ``minor_axis_px``.

    Examples
    --------
    >>> from kpbench.render import Limits
    >>> Limits(count=(1, 3)).radius_px
    (5.0, 80.0)
    """

    count: tuple[int, int] = (0, 10)
    minor_axis_px: float = 10.0
    axis_difference: float = 0.8
    radius_px: tuple[float, float] = (5.0, 80.0)
    tilt_deg: float = 75.0
    focal: tuple[float, float] = (0.6, 3.0)
    black: tuple[float, float] = (0.0, 120.0)
    white: tuple[float, float] = (180.0, 255.0)

    def __post_init__(self) -> None:
        least, most = self.radius_px
        if not 1 <= least <= most <= 4096:
            raise DataError(f"`radius_px` is {least:g}:{most:g}, expected px from 1 to 4096, the smaller first")
        if 2 * most < 1.2 * self.minor_axis_px:  # with smaller radii, too few tilts keep the minor axis long enough
            expected = f"expected a largest radius of at least {0.6 * self.minor_axis_px:g}: short axes are at least"
            raise DataError(f"`radius_px` is {least:g}:{most:g}, {expected} {self.minor_axis_px:g} px")

    @classmethod
    def of_radius(cls, least_px: float, most_px: float) -> Limits:
        """Make limits for a range of radii that may start below the default.

        Parameters
        ----------
        least_px, most_px : float
            Smallest and largest radius before the tilt, px. The least short semi-axis of the limits is the smaller of
            ``least_px`` and 5 px.

        Raises
        ------
        DataError
            If the two values are no range from 1 to 4096 px, or if ``most_px`` is less than 1.2 times the least short
            semi-axis.

        Examples
        --------
        >>> from kpbench.render import Limits
        >>> Limits.of_radius(3.0, 20.0).minor_axis_px
        6.0
        """
        return cls(minor_axis_px=2 * min(max(least_px, 1.0), 5.0), radius_px=(least_px, most_px))


@dataclass(frozen=True)
class Placement:
    """One patch in an image: its design, its pose and its two inks.

    Attributes
    ----------
    patch : Patch
    H_patch2image : ndarray of shape (3, 3)
        Homography from the patch's unit disc to px.
    black, white : float
        Grey levels.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import shipped_patches
    >>> from kpbench.render import Placement
    >>> H = np.array([[20.0, 0, 50], [0, 20, 40], [0, 0, 1]])  # radius 20 px, centre at (50, 40)
    >>> Placement(shipped_patches()[0], H, black=20, white=230).patch.name
    'checker'
    """

    patch: Patch
    H_patch2image: Float
    black: float
    white: float


def random_placements(
    rng: np.random.Generator, width_px: int, height_px: int, patches: Sequence[Patch], limits: Limits
) -> list[Placement]:
    """Draw placements of patches. The patches keep the limits, do not overlap, and have their keypoints in the image.

    Each patch has its own camera, with its own focal length.

    Parameters
    ----------
    rng : numpy.random.Generator
    width_px, height_px : int
    patches : sequence of Patch
        The designs to draw from.
    limits : Limits

    Returns
    -------
    list of Placement
        One placement per patch. If an image has too little room, it gets fewer patches than ``limits.count`` asks for.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench import shipped_patches
    >>> from kpbench.render import Limits, random_placements
    >>> len(random_placements(np.random.default_rng(0), 640, 480, shipped_patches(), Limits(count=(3, 3))))
    3
    """
    placements: list[Placement] = []
    circles: list[tuple[float, float, float]] = []
    count = int(rng.integers(limits.count[0], limits.count[1] + 1))
    for _ in range(PLACEMENT_ROUNDS):
        if len(placements) == count:
            break
        candidates = 2 * (count - len(placements)) + 2
        poses = random_poses(rng, candidates, width_px, height_px, limits)
        chosen = rng.integers(len(patches), size=candidates)
        black, white = rng.uniform(*limits.black, candidates), rng.uniform(*limits.white, candidates)
        extent = np.array([patch.extent for patch in patches])[chosen]
        H_extent2image = poses * np.stack([extent, extent, np.ones(candidates)], axis=1)[:, None]
        centre, reach, _ = project_disc_sizes(H_extent2image)
        for n, (x, y, r) in enumerate(np.column_stack([centre, reach]).tolist()):
            # the image of a steeply tilted patch is no ellipse if its rim reaches the horizon
            has_ellipse = math.isfinite(r) and math.isfinite(x) and math.isfinite(y)
            is_free = all((x - x0) ** 2 + (y - y0) ** 2 > (r + r0 + GAP_PX) ** 2 for x0, y0, r0 in circles)
            if len(placements) < count and has_ellipse and is_free:
                circles.append((x, y, r))
                placements.append(Placement(patches[chosen[n]], poses[n], float(black[n]), float(white[n])))
    return placements


def random_poses(rng: np.random.Generator, count: int, width_px: int, height_px: int, limits: Limits) -> Float:
    """Draw poses of single patches. The poses keep the limits; the keypoints lie anywhere in the image.

    Parameters
    ----------
    rng : numpy.random.Generator
    count : int
    width_px, height_px : int
    limits : Limits

    Returns
    -------
    ndarray of shape (count, 3, 3)
        Homographies H_patch2image with H[:, 2, 2] = 1. The keypoints are therefore at (H[:, 0, 2], H[:, 1, 2]).

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.render import Limits, random_poses
    >>> random_poses(np.random.default_rng(0), 5, 640, 480, Limits()).shape
    (5, 3, 3)
    """
    accepted = [np.zeros((0, 3, 3))]
    missing = count
    while missing > 0:
        n = 2 * missing + 4
        focal, radius_px = exp(np.stack([rng.uniform(*_log(span), n) for span in (limits.focal, limits.radius_px)]))
        tilt = np.radians(rng.uniform(-limits.tilt_deg, limits.tilt_deg, (2, n)))
        turn = rng.uniform(0, 2 * np.pi, n)
        x, y = rng.uniform(0, 1, (2, n)) * np.array([[width_px - 1], [height_px - 1]])
        H = _pose_matrices(width_px * focal, radius_px, tilt, turn, (width_px - 1) / 2, (height_px - 1) / 2)
        H[:, 0, 2], H[:, 1, 2], H[:, 2, 2] = x, y, 1.0
        _, major, minor = project_disc_sizes(H)
        keeps_limits = (2 * minor >= limits.minor_axis_px) & (major - minor <= limits.axis_difference * major)
        depth_change = np.sqrt(H[:, 2, 0] ** 2 + H[:, 2, 1] ** 2)
        accepted.append(H[keeps_limits & (depth_change <= LARGEST_DEPTH_CHANGE)][:missing])
        missing -= len(accepted[-1])
    return np.concatenate(accepted)


def _pose_matrices(focal_px: Float, radius_px: Float, tilt: Float, turn: Float, cx_px: float, cy_px: float) -> Float:
    """Compute the first two columns of ``K [r1 r2 t] / depth``, shape (n, 3, 3); the third column is not set.

    Lengths in space are measured in disc radii. The depth of the disc is therefore ``focal_px / radius_px``. r1 and r2
    are columns of a rotation matrix as in :func:`kpbench.geometry.camera.rotation_xyz`: by ``turn`` about z, then by
    ``tilt[1]`` about y, then by ``tilt[0]`` about x. The angles are in rad. (cx_px, cy_px) is the principal point.
    """
    (cx, cy, cz), (sx, sy, sz) = cos_sin(np.vstack([tilt, turn]))
    H = np.empty((len(turn), 3, 3))
    H[:, 0, 0], H[:, 0, 1] = radius_px * cy * cz, -radius_px * cy * sz
    H[:, 1, 0], H[:, 1, 1] = radius_px * (cx * sz + sx * sy * cz), radius_px * (cx * cz - sx * sy * sz)
    H[:, 2, 0] = radius_px / focal_px * (sx * sz - cx * sy * cz)
    H[:, 2, 1] = radius_px / focal_px * (sx * cz + cx * sy * sz)
    H[:, 0, :2] += cx_px * H[:, 2, :2]
    H[:, 1, :2] += cy_px * H[:, 2, :2]
    return H


@cache
def _log(bounds: tuple[float, float]) -> tuple[float, float]:
    return float(log(bounds[0])), float(log(bounds[1]))
