"""A classical detector, which needs no training, for any design with straight edges that cross at its centre.

1. Crossings (:func:`find_crossings`). A straight edge through a point stays straight under any perspective. Gradients
   on this edge are perpendicular to the edge. A pixel is a crossing if two conditions hold. First, each gradient around
   the pixel is perpendicular to the line from the gradient's place to the pixel. Second, the gradients have more than
   one direction. This is a form of the operator of Förstner and Gülch, *A fast operator for detection and precise
   location of distinct points, corners and centres of circular features*, 1987. The operator needs no templates. In an
   image, a few hundred places remain.
2. Poses (:mod:`kpbench.fitting.sector_search`, :mod:`kpbench.fitting.align`). The designs are compared with the image
   at each place: first their cores, which are the innermost sectors, then the whole designs. Each stage keeps fewer
   poses than the stage before.
3. Fit (:mod:`kpbench.fitting.design_fit`). The designs are fitted to the pixels, from the remaining poses.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.fitting.align import WHOLE_RADIUS_PX, Poses, align_poses, short_semi_axis
from kpbench.fitting.design_fit import Fit, fit
from kpbench.fitting.pyramid import Pyramids, choose_level
from kpbench.fitting.sector_search import CORE_RADIUS_PX, core_symmetries, estimate_size, search_sectors
from kpbench.fitting.templates import build_templates
from kpbench.images import to_grey
from kpbench.memory import require_memory
from kpbench.patches.design import Patch, shipped_patches
from kpbench.types import Detections, Float, Float32, Int, UInt8
from kpbench.workers import one_blas_thread

TEMPLATE_BYTES_PER_PIXEL = 80
"""Memory that the detector needs per pixel of the image, bytes. Measured on images of 8 megapixels."""
DRAWN_RADIUS_PX = 20
"""Radius of the drawing in which the detector has to find each design, px."""
SURROUNDED_PX = 24.0
"""Noise and grey range are measured in the coarsest level in which the short semi-axis is at least this many px."""
VERSION = "4"
"""Version of the method. Raise the version by one when detections change."""


@dataclass(frozen=True)
class Thresholds:
    """All limits of the detector. The source of their values is not recorded.

    Attributes
    ----------
    window_px : float
        Standard deviation of the window of :func:`find_crossings`, px of a pyramid level. Gradients 1 to 3 px from a
        pixel have the most weight.
    radial : float
        Weight of the gradients that point towards a pixel or away from the pixel. These gradients lower the pixel's
        strength as a crossing.
    octaves : int
        Number of levels of the pyramid in which crossings are searched.
    px_per_place, places : int
        A level of n pixels keeps ``n // px_per_place + places`` crossings.
    margin : float
        A design is dropped at a place if its correlation is lower than the best design's correlation by more than this.
    search_ncc : float
        Least correlation of the core with the image after the search.
    align_steps, align_ncc : tuple
        The core is aligned in three rounds. ``align_steps`` holds the number of Gauss-Newton steps of each round.
        ``align_ncc`` holds the least correlation after each round.
    align_radius : float
        The core is aligned in the coarsest level in which its short semi-axis measures at least this many times
        ``CORE_RADIUS_PX``.
    near : float
        Two poses are near if the distance of their centres is less than this, in radii of the core's circle.
    much_better_ncc : float
        Of two near poses of different designs, the worse is dropped if its correlation is lower by more than this.
    most_candidates : int
        Largest number of candidates per 640x480 px that are aligned as whole designs. A smaller image may have as many
        candidates as an image of 640x480 px.
    whole_steps : int
        Number of Gauss-Newton steps in the alignment of whole designs.
    likeness : float
        Least :meth:`ScoreWeights.likeness` of a candidate that is fitted.
    disc_share : float
        A detection is dropped if the centre of a better detection is nearer than this, in radii of the better disc.
    """

    window_px: float = 1.1
    radial: float = 0.7
    octaves: int = 4
    px_per_place: int = 770
    places: int = 100
    margin: float = 0.2
    search_ncc: float = 0.62
    align_steps: tuple[int, int, int] = (1, 1, 3)
    align_ncc: tuple[float, float, float] = (0.72, 0.8, 0.89)
    align_radius: float = 0.9
    near: float = 0.7
    much_better_ncc: float = 0.05
    most_candidates: int = 80
    whole_steps: int = 4
    likeness: float = 11.7
    disc_share: float = 0.9


@dataclass(frozen=True)
class ScoreWeights:
    """Weights of the score: a logistic regression on five measures of a candidate.

    The weights were fitted to candidates in synthetic images, under every deterioration of the paper. The backgrounds
    were training photographs. A candidate with the right design, within a tenth of the radius from a true centre, was
    labelled right. A candidate on no patch was labelled wrong. All other candidates were left out.

    Attributes
    ----------
    offset : float
        Log odds where all measures are 0.
    core, whole : float
        Weights of log(1.01 − correlation), for the correlations of the core and of the whole design.
    unexplained : float
        Weight of log(√(residual² − noise²) / contrast + 0.02), with the standard deviations of the fit's residuals and
        of the noise around the candidate.
    blur : float
        Weight of the blur, in short semi-axes.
    contrast : float
        Weight of log(contrast / (range + 5)), with the range of the grey levels around the candidate.
    """

    offset: float = -12.55
    core: float = -2.13
    whole: float = -2.59
    unexplained: float = -0.78
    blur: float = -16.64
    contrast: float = 2.46

    def likeness(self, core_ncc: Float, whole_ncc: Float) -> Float:
        """Return the part (n,) of the log odds that the two correlations (n,) contribute."""
        return np.asarray(self.core * np.log(1.01 - core_ncc) + self.whole * np.log(1.01 - whole_ncc))


TEMPLATE_THRESHOLDS, SCORE_WEIGHTS = Thresholds(), ScoreWeights()


def find_crossings(level: Float32) -> tuple[Float, Float]:
    """Find places where edges of several directions meet.

    Parameters
    ----------
    level : ndarray of shape (H, W), float32
        Grey levels.

    Returns
    -------
    xy : ndarray of shape (n, 2)
        The strongest places, whole px. Their number grows with the size of the level, see :class:`Thresholds`.
    strength : ndarray of shape (n,)
        Strengths of the places, in descending order.
    """
    gx = cv2.Scharr(level, cv2.CV_32F, 1, 0, scale=1 / 32)
    gy = cv2.Scharr(level, cv2.CV_32F, 0, 1, scale=1 / 32)
    q = np.arange(-4.0, 5.0)
    weight = np.exp(-(q**2) / (2 * TEMPLATE_THRESHOLDS.window_px**2))
    moments = [weight / weight.sum() * q**n for n in range(3)]

    def moment(image: Float32, nx: int, ny: int) -> Float32:
        """Return at each pixel p the sum over q of w(q) qx^nx qy^ny image(p + q)."""
        return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, moments[nx], moments[ny]))

    xx, xy, yy = gx * gx, gx * gy, gy * gy
    xx_x, yy_y, xy_xy = moment(xx, 2, 0), moment(yy, 0, 2), moment(xy, 1, 1)
    radial = xx_x + 2 * xy_xy + yy_y  # sum of w (g·q)²
    a, c = xx_x + moment(xx, 0, 2), yy_y + moment(yy, 2, 0)
    b = moment(xy, 2, 0) + moment(xy, 0, 2)
    # square root of the determinant of the sum of w |q|² g gᵀ. Under tilt, the root falls in proportion to the area of
    # the patch. The smaller eigenvalue, a usual measure of corners, falls faster
    spread = np.sqrt(np.maximum(a * c - b * b, 0))
    strength = (spread - TEMPLATE_THRESHOLDS.radial * radial) / np.sqrt(a + c + 50.0)
    strength[[0, -1]], strength[:, [0, -1]] = 0, 0
    peak = (strength >= cv2.dilate(strength, np.ones((3, 3), np.uint8))) & (strength > 0)
    rows, columns = np.nonzero(peak)
    found = strength[rows, columns]
    best = np.argsort(-found, kind="stable")[
        : level.size // TEMPLATE_THRESHOLDS.px_per_place + TEMPLATE_THRESHOLDS.places
    ]
    return np.column_stack([columns, rows])[best].astype(np.float64), found[best].astype(np.float64)


@dataclass(frozen=True)
class Candidates:
    """The n fits of one image, including fits with low scores and fits that overlap better fits.

    Attributes
    ----------
    design : ndarray of shape (n,), int64
        Index of the design.
    core_ncc, whole_ncc : ndarray of shape (n,)
        Correlations of the core and of the whole design with the image, before the fit.
    fit : Fit
    noise, grey_range : ndarray of shape (n,)
        Of the surroundings, from :meth:`kpbench.fitting.pyramid.Pyramids.measure_surroundings`.
    """

    design: Int
    core_ncc: Float
    whole_ncc: Float
    fit: Fit
    noise: Float
    grey_range: Float

    @property
    def score(self) -> Float:
        """Probability (n,) that each candidate is right, by :class:`ScoreWeights`."""
        contrast = np.maximum(self.fit.white - self.fit.black, 1.0)
        unexplained = np.sqrt(np.maximum(self.fit.noise**2 - self.noise**2, 0)) / contrast
        relative_blur = np.minimum(self.fit.blur_px / np.maximum(short_semi_axis(self.fit.A), 0.5), 1)
        log_odds = (
            SCORE_WEIGHTS.offset
            + SCORE_WEIGHTS.likeness(self.core_ncc, self.whole_ncc)
            + SCORE_WEIGHTS.unexplained * np.log(np.minimum(unexplained, 3) + 0.02)
            + SCORE_WEIGHTS.blur * relative_blur
            + SCORE_WEIGHTS.contrast * np.log(contrast / (self.grey_range + 5))
        )
        possible = (self.fit.white > self.fit.black) & np.isfinite(log_odds)
        return np.where(possible, 1 / (1 + np.exp(-np.clip(log_odds, -30, 30))), 0.0)


@dataclass
class TemplateDetector:
    """Find patches by comparing the image with their designs; call the detector with an image.

    Attributes
    ----------
    patches : tuple of Patch
        The designs to look for.
    threshold : float
        Least score of a detection, in [0, 1].
    name, version : str

    Raises
    ------
    DataError
        If a design has no edges of two directions that meet at its centre, or the detector does not find a design in a
        clean drawing of it.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.detectors import TemplateDetector
    >>> patch = kpbench.shipped_patches()[1]
    >>> v, u = (np.mgrid[:256, :256] - 127.5) / 80.0  # 4 x 4 samples a pixel
    >>> black = patch.is_black(np.stack([u, v], axis=-1))
    >>> grey = np.where(np.hypot(u, v) > 1, 120, np.where(black, 40, 210))
    >>> image = grey.reshape(64, 4, 64, 4).mean(axis=(1, 3)).astype(np.uint8)
    >>> found = TemplateDetector((patch,))(image)
    >>> found.xy.round(1), found.patch_id
    (array([[31.5, 31.5]]), array([1]))
    """

    patches: tuple[Patch, ...] = field(default_factory=shipped_patches)
    threshold: float = 0.3
    name: str = "template"
    version: str = VERSION

    def __post_init__(self) -> None:
        for n, patch in enumerate(self.patches):
            if not patch.centre_is_crossing:
                raise DataError(
                    f"design {patch.name!r}: template needs edges of two directions that meet at the centre"
                )
            if patch not in shipped_patches() and not self._sees(n):
                raise DataError(
                    f"design {patch.name!r}: template does not find it in its own drawing with a radius of "
                    f"{DRAWN_RADIUS_PX} px, expected a design with wider sectors"
                )

    def _sees(self, n: int) -> bool:
        """Return whether the detector finds a design in a clean drawing; ``n`` is the index of the design."""
        patch = self.patches[n]
        side = int(2.6 * patch.extent * DRAWN_RADIUS_PX)
        v, u = (np.mgrid[:side, :side] - (side - 1) / 2) / DRAWN_RADIUS_PX
        black = patch.is_black(np.stack([u, v], axis=-1))
        with one_blas_thread():
            found = self.candidates(
                np.where(np.hypot(u, v) > patch.extent, 128, np.where(black, 0, 255)).astype(np.uint8)
            )
        return bool(np.any((found.design == n) & (found.score >= TemplateDetector.threshold)))

    def __call__(self, image: UInt8) -> Detections:
        """Return the detections in one image, uint8 (H, W) or RGB (H, W, 3), best first."""
        grey = to_grey(image)
        if not grey.size:
            return Detections.none()
        what = f"template: an image of {grey.shape[1]} x {grey.shape[0]} pixels"
        require_memory(TEMPLATE_BYTES_PER_PIXEL * grey.size, what)
        with one_blas_thread():
            found = self.candidates(grey)
        score = found.score
        order = np.argsort(-score, kind="stable")
        order = order[score[order] >= self.threshold]
        kept = order[_select_uncovered(found.fit.xy[order], found.fit.A[order])]
        ids = np.array([patch.patch_id for patch in self.patches], np.int64)
        pose = found.fit.A[kept], found.fit.covariance[kept], found.fit.blur_px[kept]
        return Detections(found.fit.xy[kept], score[kept], ids[found.design[kept]], *pose)

    detect = __call__

    def candidates(self, grey: UInt8) -> Candidates:
        """Return the fits of all places in a grey image that resemble a design."""
        templates, pyramids = build_templates(self.patches), Pyramids(grey)
        raw, smooth = pyramids.raw, pyramids.smooth
        poses = search_sectors(smooth, *_find_places(raw[0], smooth), templates, TEMPLATE_THRESHOLDS.margin)
        poses = poses[poses.ncc > TEMPLATE_THRESHOLDS.search_ncc]
        for steps, least_ncc in zip(TEMPLATE_THRESHOLDS.align_steps, TEMPLATE_THRESHOLDS.align_ncc, strict=True):
            poses = align_poses(smooth, poses, templates.core, steps, TEMPLATE_THRESHOLDS.align_radius * CORE_RADIUS_PX)
            poses = poses[poses.ncc > least_ncc]
        poses = poses[np.argsort(-poses.ncc, kind="stable")]
        most = TEMPLATE_THRESHOLDS.most_candidates
        core = poses[_select_distinct(poses)[: max(most, most * grey.size // (640 * 480))]]
        row, rotated = core_symmetries(estimate_size(smooth, core, templates), templates)
        whole = align_poses(smooth, rotated, templates.whole, TEMPLATE_THRESHOLDS.whole_steps, WHOLE_RADIUS_PX)
        whole = whole[np.lexsort((-whole.ncc, row))[np.unique(row, return_index=True)[1]]]  # best rotation of each core
        alike = SCORE_WEIGHTS.likeness(core.ncc, whole.ncc) > TEMPLATE_THRESHOLDS.likeness
        core, whole = core[alike], whole[alike]
        fits = fit(raw, whole.xy, whole.A, [self.patches[n] for n in whole.design])
        level = choose_level(short_semi_axis(whole.A), SURROUNDED_PX, raw)
        noise, grey_range = pyramids.measure_surroundings(whole.xy, level)
        return Candidates(whole.design, core.ncc, whole.ncc, fits, noise, grey_range)


def _find_places(image: Float32, smooth: list[Float32]) -> tuple[Float, Int]:
    """Return crossings of several octaves: places (n, 2), px of the image, and octaves (n,)."""
    levels = [np.asarray(cv2.GaussianBlur(image, (0, 0), 0.5), np.float32), *smooth[1 : TEMPLATE_THRESHOLDS.octaves]]
    xy = [find_crossings(level)[0] for level in levels]
    octave = np.repeat(np.arange(len(xy)), [len(points) for points in xy])
    return np.concatenate([points * 2**n for n, points in enumerate(xy)]), octave


def _select_distinct(poses: Poses) -> Int:
    """Return the indices of the kept poses; the given poses are sorted, best first.

    A pose near a better pose is kept only if it has another design and a correlation that is nearly as high.
    """
    inverse, kept = np.linalg.inv(poses.A), np.empty(0, np.int64)
    for k in range(len(poses)):  # against the kept poses alone: a table of all pairs takes much memory
        offset = poses.xy[k] - poses.xy[kept]
        distance = [_lengths(inverse[k : k + 1], offset), _lengths(inverse[kept], offset)]
        near = np.minimum(*distance) < TEMPLATE_THRESHOLDS.near
        much_better = poses.ncc[kept] > poses.ncc[k] + TEMPLATE_THRESHOLDS.much_better_ncc
        if not np.any(near & ((poses.design[kept] == poses.design[k]) | much_better)):
            kept = np.append(kept, k)
    return kept


def _select_uncovered(xy: Float, A: Float) -> Int:
    """Return the indices of the kept points; the given points are sorted, best first.

    A point is dropped if it lies in the disc of a better point that is kept.
    """
    inverse, kept = np.linalg.inv(A), np.empty(0, np.int64)
    for k in range(len(xy)):
        if not np.any(_lengths(inverse[kept], xy[k] - xy[kept]) < TEMPLATE_THRESHOLDS.disc_share):
            kept = np.append(kept, k)
    return kept


def _lengths(matrices: NDArray[np.floating[Any]], vectors: Float) -> Float:
    """Return the lengths (n,) of vectors (n, 2) after multiplication by matrices (n, 2, 2), or by one (1, 2, 2)."""
    return np.asarray(np.linalg.norm(np.einsum("nij,nj->ni", matrices, vectors), axis=1))
