"""Whether a patch is seen in a photograph at its true place, or covered."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.geometry.homography import project
from kpbench.patches.design import Patch
from kpbench.types import Float, UInt8

DISC_GRID = 41
"""Samples along the diameter of a disc."""
EXTENT = 0.94
"""Largest coordinate of the samples, in disc radii."""
DISC_BLURS = (0.04, 0.12, 0.3)
"""Standard deviations of the blur of the ideal patch and of the image, in disc radii."""
LEAST_PATCH_LIKENESS = 0.6
"""Least correlation of the image with the ideal patch."""
WRONG = 0.4
"""Difference from the ideal patch, in parts of its contrast, from which a sample is covered."""
MOST_WRONG = 0.12
"""Largest fraction of covered samples of a patch that is seen."""


SCENE_EXTENT = 1.0
"""Largest coordinate of the samples that are compared with another photograph, in disc radii."""
SCENE_BLURS = ((0.0, 0.15), (0.0, 0.3), (0.0, 0.6), (0.0, 1.0), (0.15, 0.15), (0.3, 0.3), (0.3, 0.6))
"""Standard deviations of the blur of a hard photograph and of an easy one, in disc radii."""
LEAST_SCENE_LIKENESS = 0.7
"""Least correlation of a hard photograph with an easy one at a patch."""


class Sight(NamedTuple):
    """How a patch is seen."""

    is_seen: bool
    contrast: float
    """White minus black, grey levels."""
    inside: float
    """Fraction of the disc that lies inside the image."""


def look_at_patch(image: UInt8, H_patch2image: Float, patch: Patch) -> Sight:
    """Compare a patch with the grey image at its true place.

    Parameters
    ----------
    image : ndarray of shape (H, W)
    H_patch2image : ndarray of shape (3, 3)
    patch : Patch

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.calibration.visibility import look_at_patch
    >>> image, checker = np.full((80, 80), 128, np.uint8), kpbench.shipped_patches()[0]
    >>> look_at_patch(image, np.diag([20.0, 20.0, 1.0]), checker).is_seen
    False
    """
    uv, ideal, disc = _ideal(patch)
    height, width = image.shape
    xy = project(H_patch2image, uv.reshape(-1, 2)).astype(np.float32).reshape(DISC_GRID, DISC_GRID, 2)
    inside = np.asarray(((xy >= -0.5) & (xy < np.array([width, height]) - 0.5)).all(axis=2), np.bool_)
    seen = _sample(image, xy)
    use = disc & inside
    if use.sum() < 20:
        return Sight(False, 0.0, float(inside[disc].mean()))
    best, contrast, wrong = -1.0, 0.0, 1.0
    for blur, expected in zip(DISC_BLURS, ideal, strict=True):
        smooth = _blur(seen, blur)[use]
        centred, wanted = smooth - smooth.mean(), expected[use] - expected[use].mean()
        power = float(wanted @ wanted)
        slope = float(centred @ wanted) / power
        likeness = float(centred @ wanted) / np.sqrt(max(power * float(centred @ centred), 1e-12))
        if likeness > best:
            off = np.abs(centred - slope * wanted)
            best, contrast = likeness, max(slope, 0.0)
            wrong = float((off > WRONG * max(slope, 1e-6)).mean())
    is_seen = best >= LEAST_PATCH_LIKENESS and wrong <= MOST_WRONG
    return Sight(is_seen, contrast, float(inside[disc].mean()))


def compare_scene(image: UInt8, easy: UInt8, H_patch2image: Float) -> NDArray[np.bool_]:
    """Return at which patches a photograph looks as an easy photograph of the same scene, blurred and dimmed.

    All patches are compared under one blur: the one that makes most of them alike.

    Parameters
    ----------
    image, easy : ndarray of shape (H, W)
    H_patch2image : ndarray of shape (n, 3, 3)

    Returns
    -------
    ndarray of shape (n,), bool
    """
    axis = np.linspace(-SCENE_EXTENT, SCENE_EXTENT, DISC_GRID)
    uv = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    likeness = np.zeros((len(H_patch2image), len(SCENE_BLURS)))
    for n, H in enumerate(H_patch2image):
        xy = project(H, uv).astype(np.float32).reshape(DISC_GRID, DISC_GRID, 2)
        parts = [_sample(i, xy) for i in (image, easy)]
        for k, blurs in enumerate(SCENE_BLURS):
            scaled = (EXTENT / SCENE_EXTENT * blur for blur in blurs)
            a, b = (_blur(part, blur) if blur else part for part, blur in zip(parts, scaled, strict=True))
            a, b = a - a.mean(), b - b.mean()
            likeness[n, k] = (a * b).sum() / np.sqrt(max(float((a * a).sum() * (b * b).sum()), 1e-12))
    best = int(np.median(likeness, axis=0).argmax()) if len(likeness) else 0
    return np.asarray(likeness[:, best] >= LEAST_SCENE_LIKENESS)


def _sample(image: UInt8, xy: NDArray[np.float32]) -> Float:
    seen = cv2.remap(
        np.asarray(image, np.float32), xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(seen, np.float64)


@lru_cache(maxsize=64)
def _ideal(patch: Patch) -> tuple[Float, tuple[Float, ...], NDArray[np.bool_]]:
    """Return the samples in the patch frame, the whiteness of the blurred patch, and which samples lie in the disc."""
    axis = np.linspace(-EXTENT, EXTENT, DISC_GRID)
    uv = np.stack(np.meshgrid(axis, axis), axis=-1)
    step = axis[1] - axis[0]
    parts = [(uv + np.array([dx, dy]) * step) for dx in (-0.25, 0.25) for dy in (-0.25, 0.25)]
    white = np.mean([~patch.is_black(part) for part in parts], axis=0)
    return uv, tuple(_blur(white, blur) for blur in DISC_BLURS), np.hypot(uv[..., 0], uv[..., 1]) <= EXTENT


def _blur(values: Float, sigma: float) -> Float:
    step = 2 * EXTENT / (DISC_GRID - 1)
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma / step, borderType=cv2.BORDER_REPLICATE), np.float64)
