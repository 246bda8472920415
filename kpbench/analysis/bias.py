"""Bias of a design's centre: how far a real camera moves what a fit finds, if the fit assumes a linear camera.

Light is blurred before the tone curve of a camera. A fit that blurs grey levels then explains the image best with a
centre beside the true centre, unless the design is symmetrical enough. Ink that spreads, sharpening and paper that is
not flat act alike.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from kpbench.camera.tone import ToneCurve
from kpbench.geometry.warp import PointMap
from kpbench.patches.design import Patch
from kpbench.render.placement import Placement
from kpbench.render.scene import rasterise_patches
from kpbench.types import Float

BIAS_RADIUS_PX, BIAS_BLUR_PX = 20.0, 1.0
"""Radius of the disc and standard deviation of the blur for which biases are computed, px. A patch and a blur twice as
large have twice the bias."""
BLACK_LEVEL, WHITE_LEVEL = 40.0, 220.0
"""Grey levels of the inks."""
INK_GAIN = 0.1 / 15
"""Ink that spreads by 0.1 mm on a disc of 30 mm, disc radii."""
SHARPENING, SHARPENING_PX = 1.0, 1.0
"""Amount of the unsharp mask, and standard deviation of its Gaussian, px."""
SAGITTA, BOW_TILT_DEG = 0.02, 45.0
"""A patch on a cylinder: depth of the rim below the centre, disc radii, and tilt of the view, degrees."""
BIAS_EFFECTS = ("sRGB", "S-curve", "ink gain", "sharpening", "bow")
"""Names of the effects whose bias is computed."""
DIFFERENCE_PX = 0.05
"""Step of the numerical derivatives, px."""


def camera_bias(
    patch: Patch, radius_px: float = BIAS_RADIUS_PX, blur_px: float = BIAS_BLUR_PX, knows_tone: bool = False
) -> dict[str, float]:
    """Return the bias of a least-squares fit under each of :data:`BIAS_EFFECTS`.

    The fit knows neither pose (8 numbers), inks nor blur, and takes the camera for linear, the paper for flat and the
    ink for exact. To first order, residuals r of the true parameters move the parameters by ``(JᵀJ)⁻¹ Jᵀ r``
    (H. White, *Maximum likelihood estimation of misspecified models*, Econometrica 50, 1982). The view is frontal. Only
    pixels count whose neighbourhood of two standard deviations of the blur lies in the disc.

    Parameters
    ----------
    patch : Patch
    radius_px : float
        Radius of the disc, px.
    blur_px : float
        Standard deviation of the blur, px.
    knows_tone : bool
        Whether the fit has a tone curve with two unknown coefficients, as :func:`kpbench.fitting.fit` has.

    Returns
    -------
    dict
        Effect → length of the bias, px. The bow has the worst of eight directions. Infinite, if the disc is too small
        for the blur or does not determine its centre.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.analysis import camera_bias
    >>> checker, _, wheel, _ = kpbench.shipped_patches()
    >>> round(camera_bias(checker)["sRGB"], 2), round(camera_bias(wheel)["sRGB"], 2)
    (0.0, 0.13)
    """
    half = int(np.ceil(radius_px * max(1.1, patch.extent + 0.05) + 4 * blur_px)) + 2
    axis = np.arange(-half, half + 1)
    inside = np.hypot(axis[:, None], axis) < radius_px - 2 * blur_px - 1
    if inside.sum() < 30:
        return dict.fromkeys(BIAS_EFFECTS, float("inf"))

    def black(H: Float, warp: PointMap | None = None, ink_gain: float = 0.0) -> Float:
        """Blurred cover of black ink, shape of ``inside``, for a homography from the disc to px about the middle."""
        H = np.array([[1, 0, half], [0, 1, half], [0, 0, 1.0]]) @ H
        [mask] = rasterise_patches([Placement(patch, H, 0.0, 1.0)], warp=warp, ink_gain=ink_gain)
        x, y, w, h = mask.box
        cover = np.zeros(inside.shape)
        cover[y : y + h, x : x + w] = mask.black
        return np.asarray(cv2.GaussianBlur(cover, (0, 0), blur_px) if blur_px else cover)

    still = np.diag([radius_px, radius_px, 1.0])
    ink = black(still)
    columns = [cv2.Laplacian(ink, cv2.CV_64F), np.ones_like(ink), ink]
    for row, column in ((0, 2), (1, 2), (0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1)):
        step = np.zeros((3, 3))
        step[row, column] = DIFFERENCE_PX / (radius_px if row == 2 else 1.0)
        columns.insert(-3, (black(still + step) - black(still - step)) / (2 * DIFFERENCE_PX))
    if knows_tone:
        columns += [ink * (1 - ink), ink * (1 - ink) * (1 - 2 * ink)]
    J = np.column_stack([column[inside] for column in columns])
    lengths = np.maximum(np.linalg.norm(J, axis=0), 1e-12)  # a disc of one ink has derivatives of 0
    J = J / lengths

    def bias(seen: Float) -> float:
        """Bias for black ink that seems to cover ``seen``."""
        if np.linalg.matrix_rank(J[:, :2], tol=1e-3) < 2:
            return float("inf")
        moves, *_ = np.linalg.lstsq(J, (seen - ink)[inside], rcond=1e-6)
        return float(np.hypot(*(moves / lengths)[:2]))

    def toned(curve: ToneCurve) -> float:
        dark, bright = curve.light(np.array([BLACK_LEVEL, WHITE_LEVEL]) / 255).tolist()
        grey = 255 * curve.value(bright + (dark - bright) * ink)
        return bias((grey - WHITE_LEVEL) / (BLACK_LEVEL - WHITE_LEVEL))

    sharpened = ink + SHARPENING * (ink - cv2.GaussianBlur(ink, (0, 0), SHARPENING_PX))
    bows = [bias(black(still, _bow(angle, radius_px, half))) for angle in np.arange(8) * np.pi / 4]
    return {
        "sRGB": toned(ToneCurve("srgb")),
        "S-curve": toned(ToneCurve("s-curve", (3.0,))),
        "ink gain": bias(black(still, ink_gain=INK_GAIN)),
        "sharpening": bias(sharpened),
        "bow": max(bows),
    }


def _bow(angle_rad: float, radius_px: float, centre_px: int) -> Callable[[Float], Float]:
    """Return the map of image points of a flat patch to those of a patch on a cylinder, in an orthographic view.

    The axis of the cylinder has the angle ``angle_rad``. The view is tilted about it by ``BOW_TILT_DEG``; the depth z
    of a point moves its image by z times the sine of the tilt.
    """
    across = np.array([-np.sin(angle_rad), np.cos(angle_rad)])
    shift = SAGITTA * np.sin(np.radians(BOW_TILT_DEG)) / radius_px
    return lambda points: points + (shift * ((points - centre_px) @ across) ** 2)[:, None] * across
