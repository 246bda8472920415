"""The sampled fit: many patches at once, from poses and blurs that are nearly right, as in a film.

The image is sampled at points of the patch frame, and the grey levels are compared with the design. What they depend on
is linear near the start, with derivatives that are computed once per design and blur (inverse compositional
Gauss-Newton: Baker and Matthews, *Lucas-Kanade 20 years on*, IJCV 2004). :func:`kpbench.fitting.fit` draws the design
anew in every step instead, and needs ten times as long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from kpbench.fitting.align import short_semi_axis
from kpbench.fitting.covariance import start_covariance
from kpbench.fitting.design_fit import EXPECTED_LIGHT, EXPECTED_TONE, EXPECTED_UNEVEN_PX2, MARGIN_BLURS
from kpbench.fitting.templates import draw_ink, look_up_ink
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32

GRID = 24
"""Sample points per diameter of a disc."""
BLURS = 0.03 * 1.2 ** np.arange(17)
"""Blurs for which derivatives are computed, in disc radii."""
STEP = 0.03
"""Distance of the points whose difference is a derivative, in disc radii."""
MARGIN_PX = 0.35
"""Width of the rim that is left out, px, besides ``MARGIN_BLURS`` standard deviations of the blur."""
EXPECTED_TURN = 0.1
"""Standard deviation of a step of the affine map, as a part of it."""
EXPECTED_BLUR_PX2 = 1.5
"""Standard deviation of a step of the blur's variance, px²."""
LEAST_NOISE = 0.4
"""Least standard deviation of the noise, grey levels: the square root of LEAST_VARIANCE of the design fit."""
GRAIN = 2.0
"""Variance of the mean of many neighbouring samples' noise, relative to independent noise. Samples share pixels."""
REJECTED_RADII = 0.02
"""Standard deviation of the centre, in short semi-axes, is this times the square of the rejected share of the
weights."""
LAST_STEP_SHARE = 0.3
"""Standard deviation of the rest of the way, in last steps of the centre."""
UNKNOWN_COUNT = 14
"""Unknowns: grey, contrast, place (2), affine map (4), blur, tone, light along x and y, uneven blur (2)."""

_ticks = (np.arange(GRID) + 0.5) / GRID * 2 - 1
POINTS = np.stack(np.meshgrid(_ticks, _ticks), axis=-1).reshape(-1, 2)
POINTS = POINTS[np.hypot(*POINTS.T) < 1]
"""Sample points in the patch frame."""
_RADIUS = np.hypot(*POINTS.T)


@dataclass(frozen=True)
class SampledFit:
    """N fitted patches; the attributes are those of :class:`kpbench.fitting.Fit` with the same names.

    ``contrast`` (N,) is white minus black, grey levels.
    """

    xy: Float
    A: Float
    contrast: Float
    blur_px: Float
    ncc: Float
    covariance: Float


def fit_samples(
    image: Float32, xy: Float, A: Float, bend: Float, patches: Sequence[Patch], blur_px: Float, steps: int = 2
) -> SampledFit:
    """Fit designs to the pixels of an image.

    Parameters
    ----------
    image : ndarray of shape (H, W), float32
    xy, A : ndarray of shape (N, 2) and (N, 2, 2)
        Starting poses, px, right to about a tenth of the radius.
    bend : ndarray of shape (N, 2)
        Perspective b, which stays: a point u of the patch frame is seen at ``xy + A u / (1 + b·u)``.
    patches : sequence of Patch
        N designs.
    blur_px : ndarray of shape (N,)
        Standard deviations of the blur to start from, px.
    steps : int
        Number of steps.

    Returns
    -------
    SampledFit

    Examples
    --------
    >>> import numpy as np, kpbench
    >>> from kpbench.fitting.sampled_fit import fit_samples
    >>> patch = kpbench.shipped_patches()[0]
    >>> v, u = (np.mgrid[:64, :64] - 31.5) / 20.0
    >>> black = patch.is_black(np.stack([u, v], axis=-1))
    >>> image = np.where(np.hypot(u, v) > 1, 120, np.where(black, 40, 210)).astype(np.float32)
    >>> start = np.array([[31.9, 31.0]]), np.array([np.eye(2) * 20.0]), np.zeros((1, 2))
    >>> found = fit_samples(image, *start, [patch], np.array([0.5]))
    >>> found.xy.round(1)
    array([[31.5, 31.5]])
    """
    u, v = POINTS.T.astype(np.float32)
    points: Float32 = (POINTS.T / (1 + bend[:, None] @ POINTS.T)).astype(np.float32)  # (N, 2, M)
    for _ in range(steps):
        minor = np.maximum(short_semi_axis(A), 0.5)
        inverse = np.linalg.inv(A)
        spread = inverse @ np.swapaxes(inverse, 1, 2)  # of the blur in the patch frame, per px²
        per_px2 = np.trace(spread, axis1=1, axis2=2) / 2
        level = np.abs(np.log(BLURS) - np.log(blur_px * np.sqrt(per_px2))[:, None]).argmin(axis=1)
        J = np.stack([_derivatives(patch, k) for patch, k in zip(patches, level.tolist(), strict=True)])  # (N, 14, M)
        variance = (BLURS[level] ** 2 / per_px2).astype(np.float32)  # of the blur, px²
        uneven = np.stack([(spread[:, 0, 0] - spread[:, 1, 1]) / 2, spread[:, 0, 1]], axis=1) * variance[:, None]
        model = J[:, 1] + np.einsum("nk,nkm->nm", uneven.astype(np.float32), J[:, 12:])
        grey = _sample(image, xy, A, points)
        reach = np.maximum(1 - (MARGIN_PX + MARGIN_BLURS * blur_px) / minor, 0.5)
        inside = (reach[:, None] > _RADIUS).astype(np.float32)
        black_white, ncc, count = _regress(grey, model, inside)
        contrast = np.maximum(black_white[:, 1], 1.0)[:, None]
        residual = (grey - black_white[:, :1].astype(np.float32)) / contrast.astype(np.float32) - model
        J[:, 1] = model
        light = model + (black_white[:, :1] / contrast).astype(np.float32)
        J[:, 10], J[:, 11] = light * u, light * v
        size = np.where(inside > 0, np.abs(residual), np.inf)
        middle = np.sort(size, axis=1)[np.arange(len(xy)), (count / 2).astype(np.int64)]
        usual = (2.5 * 1.48 * middle + 1 / contrast[:, 0]).astype(np.float32)
        weight = inside * np.minimum(1.0, usual[:, None] / np.maximum(np.abs(residual), 1e-6))
        weighted = J * weight[:, None]
        normal = (weighted @ np.swapaxes(J, 1, 2)).astype(np.float64)
        target = (weighted @ residual[..., None]).astype(np.float64)
        squares = np.einsum("nm,nm->n", weight, residual**2)
        noise2 = np.maximum(squares / np.maximum(count - UNKNOWN_COUNT, 8), (LEAST_NOISE / contrast[:, 0]) ** 2)
        fixed = *(np.inf,) * 4, *(EXPECTED_TURN,) * 4, 0.0, EXPECTED_TONE, EXPECTED_LIGHT, EXPECTED_LIGHT, 0.0, 0.0
        deviation = np.tile(fixed, (len(xy), 1))
        deviation[:, 8] = EXPECTED_BLUR_PX2 * per_px2
        deviation[:, 12:] = (EXPECTED_UNEVEN_PX2 * per_px2)[:, None]
        normal[:, range(UNKNOWN_COUNT), range(UNKNOWN_COUNT)] += noise2[:, None] / deviation**2 + 1e-6
        posterior = np.linalg.inv(normal)
        change = (posterior @ target)[..., 0]
        shift = change[:, 2:4] * np.minimum(1, 0.3 / np.maximum(np.abs(change[:, 2:4]).max(axis=1), 1e-9))[:, None]
        A = A @ np.linalg.inv(np.eye(2) + np.clip(change[:, 4:8], -0.2, 0.2).reshape(-1, 2, 2))
        moved = np.einsum("nij,nj->ni", A, shift)
        xy = xy - moved
        wider = np.clip(change[:, 8] / per_px2, -2.0, 2.0)
        blur_px = np.sqrt(np.clip(variance + wider, 0.3, (0.45 * minor) ** 2))
    noise = A @ (GRAIN * noise2[:, None, None] * posterior[:, 2:4, 2:4]) @ np.swapaxes(A, 1, 2)
    rejected = (1 - weight.sum(axis=1) / np.maximum(count, 1)) ** 2 * REJECTED_RADII * minor
    even = LAST_STEP_SHARE**2 * (moved**2).sum(axis=1) + rejected**2
    covariance = noise + even[:, None, None] * np.eye(2)
    covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
    unsure = black_white[:, 1] <= 1
    covariance[unsure] = start_covariance(A[unsure])
    return SampledFit(xy, A, 2 * black_white[:, 1], blur_px, ncc, covariance)


def _sample(image: Float32, xy: Float, A: Float, points: Float32) -> Float32:
    """Return the grey levels (N, M) at points (N, 2, M) of the frames of N patches, before the affine maps."""
    x, y = np.ascontiguousarray((A.astype(np.float32) @ points + xy[:, :, None].astype(np.float32)).transpose(1, 0, 2))
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _regress(grey: Float32, model: Float32, inside: Float32) -> tuple[Float, Float, Float]:
    """Return grey and contrast (N, 2) of a regression on the model, the correlation, and the number of samples."""
    count = np.maximum(inside.sum(axis=1), 1)
    weight = inside / count[:, None]
    mean_grey, mean_model = (np.einsum("nm,nm->n", weight, part) for part in (grey, model))
    centred_grey, centred_model = grey - mean_grey[:, None], (model - mean_model[:, None]) * weight
    product = np.einsum("nm,nm->n", centred_grey, centred_model)
    squares = np.einsum("nm,nm->n", model, centred_model)
    spread = np.einsum("nm,nm,nm->n", weight, centred_grey, centred_grey) + 1.0
    slope = product / np.maximum(squares, 1e-6)
    ncc = product / np.sqrt(np.maximum(squares * spread, 1e-9))
    return np.stack([mean_grey - slope * mean_model, slope], axis=1), ncc.astype(np.float64), count.astype(np.float64)


@lru_cache(maxsize=1024)
def _derivatives(patch: Patch, level: int) -> Float32:
    """Return the derivatives of a design's ink at the sample points by all unknowns, ndarray of shape (14, M)."""
    image = draw_ink(patch, True, float(BLURS[level]))

    def ink(du: float, dv: float) -> Float:
        return look_up_ink(image, POINTS + STEP * np.array([du, dv]))

    (u, v), here = POINTS.T, ink(0, 0)
    east, west, south, north = ink(1, 0), ink(-1, 0), ink(0, 1), ink(0, -1)
    du, dv = (east - west) / (2 * STEP), (south - north) / (2 * STEP)
    duu, dvv = (east - 2 * here + west) / STEP**2, (south - 2 * here + north) / STEP**2
    duv = (ink(1, 1) - ink(1, -1) - ink(-1, 1) + ink(-1, -1)) / (4 * STEP**2)
    place = du, dv, du * u, du * v, dv * u, dv * v
    light = here * u, here * v
    rows = np.ones(len(u)), here, *place, (duu + dvv) / 2, 1 - here**2, *light, (duu - dvv) / 2, duv
    return np.asarray(rows, np.float32)
