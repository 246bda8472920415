"""A classical detector: no training, any design with straight edges that cross at its centre.

Edges that meet at a point point at it, under any perspective. So the first stage (:func:`crossings`)
asks of every pixel whether the gradients around it are square to the direction to it, and are of more than
one direction (a form of the operator of Förstner and Gülch, *A fast operator for detection and precise
location of distinct points*, 1987). That needs no templates. The few hundred places that remain are
compared with the designs (:mod:`kpbench.fitting`, :mod:`kpbench.fitting`), coarse to fine, each stage on
what the one before kept, and what is left is fitted (:mod:`kpbench.fitting`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from kpbench.errors import DataError
from kpbench.fitting import design_fit as refine
from kpbench.fitting import sector_search as sectors
from kpbench.fitting.align import WHOLE_PX, Poses, align, short_axis
from kpbench.fitting.pyramid import Picture
from kpbench.fitting.templates import bank
from kpbench.images import to_grey
from kpbench.patches.design import Patch, shipped_patches
from kpbench.types import Detections, Float, Float32, Int, UInt8
from kpbench.workers import one_blas_thread

VERSION = "1"
"""Version of the method. Raise it by one when detections change."""
WINDOW_PX = 1.1
"""Standard deviation of the window, in px of a level: it sees 1 to 3 px around a place."""
RADIAL = 0.7
"""How much a gradient along the direction to the place counts against one across it."""
EVERY_PX, AT_LEAST = 770, 100
"""Places kept: one for so many pixels of the level, and some for small ones."""


def crossings(level: Float32) -> tuple[Float, Float]:
    """Places where edges of several directions meet.

    Parameters
    ----------
    level : ndarray of shape (H, W), float32, grey levels.

    Returns
    -------
    xy : ndarray of shape (n, 2), whole px; the best places, at most one for every 770 px, and 100.
    strength : ndarray of shape (n,), in falling order.
    """
    gx = cv2.Scharr(level, cv2.CV_32F, 1, 0, scale=1 / 32)
    gy = cv2.Scharr(level, cv2.CV_32F, 0, 1, scale=1 / 32)
    q = np.arange(-4.0, 5.0)
    weight = np.exp(-(q**2) / (2 * WINDOW_PX**2))
    moments = [weight / weight.sum() * q**n for n in range(3)]

    def around(image: Float32, nx: int, ny: int) -> Float32:
        """Sum over q of w(q) qx^nx qy^ny image(p + q)."""
        return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, moments[nx], moments[ny]))

    xx, xy, yy = gx * gx, gx * gy, gy * gy
    xx_x, yy_y, xy_xy = around(xx, 2, 0), around(yy, 0, 2), around(xy, 1, 1)
    radial = xx_x + 2 * xy_xy + yy_y  # sum of w (g·q)²
    a, c = xx_x + around(xx, 0, 2), yy_y + around(yy, 2, 0)
    b = around(xy, 2, 0) + around(xy, 0, 2)
    # the square root of the determinant of the sum of w |q|² g gᵀ: under tilt it falls as the area does, whereas
    # the smaller eigenvalue of Harris-like measures falls faster
    spread = np.sqrt(np.maximum(a * c - b * b, 0))
    strength = (spread - RADIAL * radial) / np.sqrt(a + c + 50.0)
    strength[[0, -1]], strength[:, [0, -1]] = 0, 0
    peak = (strength >= cv2.dilate(strength, np.ones((3, 3), np.uint8))) & (strength > 0)
    rows, columns = np.nonzero(peak)
    found = strength[rows, columns]
    best = np.argsort(-found, kind="stable")[: level.size // EVERY_PX + AT_LEAST]
    return np.column_stack([columns, rows])[best].astype(np.float64), found[best].astype(np.float64)


CORE, LIKENESS, MOST = 0.89, 11.7, 80
"""Least correlation of a candidate near its centre, least likeness, most candidates of 640x480 px."""


@dataclass(frozen=True)
class Candidates:
    """What was fitted in one image, with overlaps and whatever its score.

    Attributes
    ----------
    which : (n,) index of the design.
    core, whole : (n,) correlations near the centre and over the disc, before the fit.
    fit : the fits.
    noise : standard deviation of the image's noise, grey levels.
    range : from the darkest to the brightest of the image, grey levels.
    """

    which: Int
    core: Float
    whole: Float
    fit: refine.Fit
    noise: float
    range: float

    @property
    def score(self) -> Float:
        """Probability (n,) that a candidate is a patch.

        A logistic regression on candidates of synthetic images (every deterioration of the paper, training
        photographs only) that were within a tenth of the radius and of the right design, or on no patch.
        """
        contrast = np.maximum(self.fit.white - self.fit.black, 1.0)
        unexplained = np.sqrt(np.maximum(self.fit.noise**2 - self.noise**2, 0)) / contrast
        relative_blur = np.minimum(self.fit.blur_px / np.maximum(short_axis(self.fit.A), 0.5), 1)
        evidence = (
            -12.55
            + sectors.likeness(self.core, self.whole)
            - 0.78 * np.log(np.minimum(unexplained, 3) + 0.02)
            - 16.64 * relative_blur
            + 2.46 * np.log(contrast / (self.range + 5))
        )
        sane = (self.fit.white > self.fit.black) & np.isfinite(evidence)
        return np.where(sane, 1 / (1 + np.exp(-np.clip(evidence, -30, 30))), 0.0)


@dataclass
class TemplateDetector:
    """Finds patches by comparing the image with their designs; call it with an image.

    Attributes
    ----------
    patches : the designs to look for.
    threshold : least score of a detection, in [0, 1].

    Raises
    ------
    DataError
        If a design has no edges of two directions at its centre: a whole edge looks like that.
    """

    patches: tuple[Patch, ...] = field(default_factory=shipped_patches)
    threshold: float = 0.3
    name: str = "template"
    version: str = VERSION

    def __post_init__(self) -> None:
        for patch in self.patches:
            if not patch.centre_is_crossing:
                raise DataError(
                    f"design {patch.name!r}: template needs edges of two directions that meet at the centre"
                )

    def __call__(self, image: UInt8) -> Detections:
        """Detections of one image, uint8 (H, W) or RGB (H, W, 3), best first."""
        grey = to_grey(image)
        if not grey.size:
            return Detections.none()
        with one_blas_thread():
            found = self.candidates(grey)
        score = found.score
        order = np.argsort(-score, kind="stable")
        order = order[score[order] >= self.threshold]
        kept = order[_uncovered(found.fit.xy[order], found.fit.A[order], 0.9)]
        ids = np.array([patch.patch_id for patch in self.patches], np.int64)
        return Detections(found.fit.xy[kept], score[kept], ids[found.which[kept]])

    detect = __call__

    def candidates(self, grey: UInt8) -> Candidates:
        """Everything in a grey image that is enough like a design to be fitted."""
        known = bank(self.patches)
        picture = Picture(grey)
        raw, smooth = picture.raw, picture.smooth
        poses = sectors.search(smooth, *_places(raw[0], smooth), known, margin=0.2)
        poses = poses[poses.ncc > 0.62]
        for steps, least in ((1, 0.72), (1, 0.8), (3, CORE)):
            poses = align(smooth, poses, known.core, steps, 0.9 * sectors.RING_PX)
            poses = poses[poses.ncc > least]
        poses = poses[np.argsort(-poses.ncc, kind="stable")]
        core = poses[_distinct(poses)[: max(MOST, MOST * grey.size // (640 * 480))]]
        row, turned = sectors.alike(sectors.extend(smooth, core, known), known)
        whole = align(smooth, turned, known.whole, 4, WHOLE_PX)
        best = np.lexsort((-whole.ncc, row))[np.unique(row, return_index=True)[1]]  # of the rotations of each
        whole = whole[best]
        sure = sectors.likeness(core.ncc, whole.ncc) > LIKENESS
        core, whole = core[sure], whole[sure]
        fit = refine.fit(raw, whole.xy, whole.A, [self.patches[n] for n in whole.which])
        return Candidates(whole.which, core.ncc, whole.ncc, fit, picture.noise, picture.range)


def _places(image: Float32, smooth: list[Float32]) -> tuple[Float, Int]:
    """Crossings of four octaves: (n, 2) px of the image, and the octave of each."""
    levels = [np.asarray(cv2.GaussianBlur(image, (0, 0), 0.5), np.float32), *smooth[1:4]]
    xy = [crossings(level)[0] for level in levels]
    return np.concatenate([points * 2**n for n, points in enumerate(xy)]), np.repeat(
        np.arange(len(xy)), [len(points) for points in xy]
    )


def _distinct(poses: Poses) -> Int:
    """Indices of poses, best first, without those that repeat a better one of the same or of a much better design."""
    n = len(poses)
    offset = poses.xy[:, None] - poses.xy
    near = np.linalg.norm(np.einsum("nij,nmj->nmi", np.linalg.inv(poses.A), offset), axis=2) < 0.7
    near |= near.T
    rival = near & ((poses.which[:, None] == poses.which) | (poses.ncc[:, None] > poses.ncc + 0.05))
    kept = np.zeros(n, bool)
    for k in range(n):
        kept[k] = not np.any(rival[kept, k])
    return np.flatnonzero(kept)


def _uncovered(xy: Float, A: Float, reach: float) -> Int:
    """Indices of points, best first, that lie in no better one's disc, scaled by ``reach``."""
    inside = np.linalg.norm(np.einsum("nij,nmj->nmi", np.linalg.inv(A), xy - xy[:, None]), axis=2) < reach
    kept = np.zeros(len(xy), bool)
    for k in range(len(xy)):
        kept[k] = not np.any(inside[kept, k])
    return np.flatnonzero(kept)
