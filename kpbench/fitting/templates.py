"""Compare places in an image with designs.

Each step looks at many candidates at once:

* :func:`turn` finds the rotation where the ellipse is known (:func:`surroundings` shows what tells it);
* :func:`align` moves a pose onto the image (inverse compositional Gauss-Newton, Baker and Matthews,
  *Lucas-Kanade 20 years on*, IJCV 2004), by the whole design or by its innermost sectors;
* :func:`view` shows the image in the frame of the patch.

Where not even the ellipse is known :mod:`kpbench.fitting` finds it.
Poses are affine: ``x_px = xy + A @ u``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.patches.design import Patch
from kpbench.types import Float, UInt8

Float32 = NDArray[np.float32]
Ints = NDArray[np.int64]

ANGLES = 24
TURNS = 72
"""Rotations of the whole design that are tried: to within 2.5 degrees, where a fit can start."""
AS_LIKELY, UNLIKE = 0.15, 0.5
"""How much less a second rotation may correlate with the image, and how little it must with the best one."""
SIZES = (0.8, 0.9, 1.1)
"""Other sizes of an ellipse in which its design is turned: rings, and what lies around, make it too large or small."""
WHOLE_PX = 5.6
"""The whole design is compared in the coarsest level in which its short semi-axis measures as much."""
_turn = np.arange(ANGLES) * (2 * np.pi / ANGLES)
_circle = np.column_stack([np.cos(_turn), np.sin(_turn)])


@dataclass(frozen=True)
class Poses:
    """N hypotheses: ``xy`` (N, 2) px, ``A`` (N, 2, 2) px, ``which`` (N,) index of the design, ``ncc`` (N,)."""

    xy: Float
    A: Float
    which: Ints
    ncc: Float

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, keep: Any) -> Poses:
        return Poses(self.xy[keep], self.A[keep], self.which[keep], self.ncc[keep])


@dataclass(frozen=True)
class Templates:
    """D designs sampled at M points on circles.

    Attributes
    ----------
    points : (M, 2)
    ink : (D, M) zero mean, unit norm.
    solve : (D, 6, M) from a difference of templates to a step in (x, y, a11, a12, a21, a22).
    sized : (D,) whether the pattern has a size of its own, which sectors have not.
    turned : (R, M) all rotations of all inks, without those that look alike.
    turned_which, turned_angle : (R,) the design and the rotation in radians of each.
    """

    points: Float
    ink: Float32
    solve: Float32
    sized: NDArray[np.bool_]
    turned: Float32
    turned_which: Ints
    turned_angle: Float


@dataclass(frozen=True)
class Bank:
    """What the coarse stages need of a set of designs.

    Attributes
    ----------
    patches : the designs.
    core : the innermost sectors, over the unit disc; they look the same at every size.
    whole : the whole design, over the unit disc.
    picture : (D, VIEW_PX²) the designs as :func:`view` shows them, white 1 and black -1.
    """

    patches: tuple[Patch, ...]
    core: Templates
    whole: Templates
    picture: Float32


def bank(patches: Sequence[Patch]) -> Bank:
    """Templates of some designs."""
    return _bank(tuple(patches))


@lru_cache(maxsize=8)
def _bank(patches: tuple[Patch, ...]) -> Bank:
    core = _templates(patches, (0.4, 0.7, 1.0), whole=False)
    whole = _templates(patches, (0.25, 0.45, 0.65, 0.85), whole=True)
    picture = np.array([look_up(soft_ink(patch, True), _view_points()) for patch in patches], np.float32)
    return Bank(patches, core, whole, picture)


def _templates(patches: Sequence[Patch], rings: Sequence[float], whole: bool) -> Templates:
    points = np.concatenate([r * _circle for r in rings])
    pairs = [_template(soft_ink(patch, whole), points) for patch in patches]
    ink, solve = (np.array(part, np.float32) for part in zip(*pairs, strict=True))
    turned, which, angle, turns = [], [], [], TURNS if whole else ANGLES
    for n, patch in enumerate(patches):
        image = soft_ink(patch, whole)
        seen: list[Float32] = []
        for turn in np.arange(turns) * (2 * np.pi / turns):
            c, s = np.cos(turn), np.sin(turn)
            grey = look_up(image, points @ np.array([[c, -s], [s, c]]))
            one = ((grey - grey.mean()) / np.linalg.norm(grey - grey.mean())).astype(np.float32)
            if all(one @ other < 0.998 for other in seen):
                seen.append(one)
                which.append(n)
                angle.append(turn)
        turned += seen
    sized = np.array([whole and len(patch.cells[0]) > 2 for patch in patches])
    return Templates(points, ink, solve, sized, np.array(turned), np.array(which, np.int64), np.array(angle))


def _template(image: Float32, points: Float) -> tuple[Float, Float]:
    """Normalised template and its Gauss-Newton solver."""
    step = 0.05
    ink = look_up(image, points)
    du, dv = ((look_up(image, points + s) - look_up(image, points - s)) / (2 * step) for s in np.eye(2) * step)
    u, v = points.T
    jacobian = np.column_stack([du, dv, du * u, du * v, dv * u, dv * v])
    ink = ink - ink.mean()
    jacobian /= np.linalg.norm(ink)
    ink /= np.linalg.norm(ink)
    jacobian -= jacobian.mean(axis=0)  # grey offset and contrast are free
    jacobian -= np.outer(ink, ink @ jacobian)
    normal = jacobian.T @ jacobian
    # stretch along two edges leaves sectors as they are: damping keeps it where it was
    return ink, np.linalg.solve(normal + np.eye(6) * 0.02 * np.trace(normal) / 6, jacobian.T)


LOOKUP_HALF, LOOKUP_SIZE = 1.7, 273
SOFT_CORE, SOFT_WHOLE = 0.2, 0.12
"""Blur of the templates, in radii of the circle: what remains after the pyramid's smoothing."""


@lru_cache(maxsize=64)
def soft_ink(patch: Patch, whole: bool) -> Float32:
    """Ink, white 1 and black -1, over [-1.7, 1.7]²: the design, or its innermost sectors without end; blurred."""
    fine = 3
    ticks = ((np.arange(LOOKUP_SIZE * fine) + 0.5) / (LOOKUP_SIZE * fine) * 2 - 1) * LOOKUP_HALF
    points = np.stack(np.meshgrid(ticks, ticks), axis=-1)
    # a point at radius r is seen at min(r, 0.999) of the design, or always near the centre
    reach = np.hypot(*np.moveaxis(points, -1, 0)) + 1e-9
    end = np.minimum(reach, 0.999) if whole else 0.5 * patch.cells[0][1]
    black = patch.is_black(points * (end / reach)[..., None])
    ink = np.where(black, -1.0, 1.0).reshape(LOOKUP_SIZE, fine, LOOKUP_SIZE, fine).mean(axis=(1, 3))
    blur = (SOFT_WHOLE if whole else SOFT_CORE) * LOOKUP_SIZE / (2 * LOOKUP_HALF)
    return np.asarray(cv2.GaussianBlur(ink.astype(np.float32), (0, 0), blur))


def look_up(image: Float32, points: Float) -> Float:
    """Ink (N,) of :func:`soft_ink` at points (N, 2)."""
    at = ((points + LOOKUP_HALF) / (2 * LOOKUP_HALF) * LOOKUP_SIZE - 0.5).astype(np.float32)
    return np.asarray(cv2.remap(image, at[:, :1], at[:, 1:], cv2.INTER_LINEAR), np.float64).ravel()


def pyramid(image: UInt8, smooth_px: float = 0.7) -> list[Float32]:
    """Octaves of a grey image; pixel (x, y) of level l lies at (x, y)·2^l of the image.

    Each level is smoothed by about ``smooth_px`` of its own px.
    """
    levels = [image.astype(np.float32)]
    if smooth_px:
        levels[0] = np.asarray(cv2.GaussianBlur(levels[0], (0, 0), smooth_px))
    while min(levels[-1].shape) >= 16 and len(levels) < 7:
        levels.append(np.asarray(cv2.pyrDown(levels[-1])))
    return levels


class Picture:
    """A grey image and what is needed of it again and again.

    Attributes
    ----------
    raw, smooth : its :func:`pyramid`, as it is and smoothed.
    noise : standard deviation, grey levels, from the median of second differences, which edges hardly move.
    range : grey levels between its dark and its bright parts.
    """

    def __init__(self, grey: UInt8) -> None:
        self.raw, self.smooth = pyramid(grey, 0), pyramid(grey)
        kernel = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
        differences = cv2.filter2D(grey, cv2.CV_16S, kernel)[::2, ::2]  # of whole numbers the median takes less time
        self.noise = 1.4826 / 6 * float(np.median(np.abs(differences)))
        dark, bright = np.percentile(grey[::4, ::4], (2, 98))
        self.range = float(bright - dark)


MOST_ROWS = 2**14
"""Rows that are sampled at once: OpenCV's remap takes fewer than 2**15."""


def sample(levels: Sequence[Float32], level: Ints, xy: Float, A: Float, points: Float) -> Float32:
    """Bilinear grey values (N, M) at ``xy + A @ points`` px of the image, each row from a level of its own."""
    values = np.empty((len(xy), len(points)), np.float32)
    fan = points.T.astype(np.float32)
    for n in np.unique(level):
        whole = np.flatnonzero(level == n)
        for rows in np.split(whole, range(MOST_ROWS, len(whole), MOST_ROWS)):
            at, map_ = (xy[rows] * 0.5**n).astype(np.float32), (A[rows] * 0.5**n).astype(np.float32)
            x, y = (map_[:, axis] @ fan + at[:, axis : axis + 1] for axis in (0, 1))
            values[rows] = cv2.remap(levels[n], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values


def outside_image(image: Float32, xy: Float, A: Float, points: Float) -> tuple[Ints, NDArray[np.bool_]]:
    """Rows that have samples outside the image, and which ones: (K,) and (K, M)."""
    last = np.array(image.shape[::-1]) - 1.0
    reach = np.linalg.norm(A, axis=2) * np.linalg.norm(points, axis=1).max()
    rows = np.flatnonzero(np.any((xy - reach < 0) | (xy + reach > last), axis=1))
    x, y = (A[rows, axis] @ points.T + xy[rows, axis, None] for axis in (0, 1))
    return rows, (x < 0) | (y < 0) | (x > last[0]) | (y > last[1])


FLOOR = 1.0
"""Grey levels; a standard deviation around a place that is under it counts as nothing."""


def normalise(values: Float32) -> Float32:
    """Zero mean and unit norm a row."""
    centred = values - values.mean(axis=1, keepdims=True)
    size = np.einsum("nm,nm->n", centred, centred) + np.float32(FLOOR**2 * values.shape[1])
    return np.asarray(centred / np.sqrt(size)[:, None])


def short_axis(A: Float) -> Float:
    """Short semi-axis of the image of the unit circle: the smaller singular value of (N, 2, 2)."""
    square = np.einsum("nij,nij->n", A, A)
    det = np.abs(A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0])
    return np.asarray(np.sqrt(np.maximum(square - np.sqrt(np.maximum(square**2 - 4 * det**2, 0)), 0) / 2))


def turn(
    levels: Sequence[Float32], xy: Float, A: Float, which: Ints, known: Bank, twice: NDArray[np.bool_] | None = None
) -> tuple[Ints, Poses]:
    """The best rotation of a design within an ellipse, or one of another size, and a second one that looks as likely.

    Parameters
    ----------
    levels : from :func:`pyramid`.
    xy, A : (N, 2), (N, 2, 2) px; the ellipse is the image of the unit circle.
    which : (N,) index of the design.
    known : the designs.
    twice : (N,) where other sizes and a second rotation are tried; None: everywhere.

    Returns
    -------
    Rows (M,) from 0 to N - 1, in order and each once or twice, and their poses.
    """
    whole, again = known.whole, np.arange(len(xy)) if twice is None else np.flatnonzero(twice)
    ncc, found = _turns(levels, xy, A, which, whole), A.copy()
    for size in SIZES:
        other = _turns(levels, xy[again], size * A[again], which[again], whole)
        better = other.max(axis=1) > ncc[again].max(axis=1)
        ncc[again[better]], found[again[better]] = other[better], size * A[again[better]]
    first, every = ncc.argmax(axis=1), np.arange(len(xy))
    unlike = whole.turned @ whole.turned.T < UNLIKE
    second = np.where(unlike[first], ncc, -np.inf).argmax(axis=1)
    as_likely = unlike[first, second] & (ncc[every, second] > ncc[every, first] - AS_LIKELY)
    again = again[as_likely[again]]
    row = np.concatenate([every, again])
    order = np.argsort(row, kind="stable")
    row, turned = row[order], np.concatenate([first, second[again]])[order]
    return row, rotated(xy[row], found[row], which[row], turned, ncc[row], whole)


def _turns(levels: Sequence[Float32], xy: Float, A: Float, which: Ints, whole: Templates) -> Float32:
    """Correlations (N, R) of ellipses with all rotations; -inf for those of other designs than ``which``."""
    values = sample(levels, coarsest_level(short_axis(A), WHOLE_PX, levels), xy, A, whole.points)
    ncc = normalise(values) @ whole.turned.T
    cut, outside = outside_image(levels[0], xy, A, whole.points)
    ncc[cut] = _partial_ncc(values[cut], ~outside, whole.turned)
    ncc[whole.turned_which != which[:, None]] = -np.inf
    return ncc


def rotated(xy: Float, A: Float, which: Ints, turned: Ints, ncc: Float32, templates: Templates) -> Poses:
    """Poses in rotations (N,) of their design, with their correlations out of ``ncc`` (N, R)."""
    angle = templates.turned_angle[turned]
    c, s = np.cos(angle), np.sin(angle)
    turned_A = A @ np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
    return Poses(xy, turned_A, which, ncc[np.arange(len(turned)), turned].astype(np.float64))


def _partial_ncc(values: Float32, inside: NDArray[np.bool_], inks: Float32) -> Float32:
    """Correlations (N, R) of grey values (N, M) with inks (R, M), over those samples of each row that are inside."""
    count = np.maximum(inside.sum(axis=1, keepdims=True), 1)
    grey = np.where(inside, values - (values * inside).sum(axis=1, keepdims=True) / count, 0)
    mask = inside.astype(np.float32)
    size = np.einsum("nm,nm->n", grey, grey)[:, None] + FLOOR**2 * count
    spread = mask @ (inks**2).T - (mask @ inks.T) ** 2 / count
    return np.asarray(grey @ inks.T / np.sqrt(size * np.maximum(spread, 1e-3)), np.float32)


def align(levels: Sequence[Float32], poses: Poses, templates: Templates, steps: int, radius_px: float) -> Poses:
    """Move poses onto the image.

    Parameters
    ----------
    levels : from :func:`pyramid`.
    poses : ``A`` maps the templates' unit circle to the image.
    templates : ``Bank.core`` or ``Bank.whole``.
    steps : Gauss-Newton steps.
    radius_px : the circle's short semi-axis, in px of the level that is looked at, is at least this.

    Returns
    -------
    Poses
        With the correlation after the last step.
    """
    xy, A, which = poses.xy, poses.A, poses.which
    ink, solve, sized = templates.ink[which], templates.solve[which], templates.sized[which]
    for step in range(steps + 1):
        values = sample(levels, coarsest_level(short_axis(A), radius_px, levels), xy, A, templates.points)
        ncc, residual = _compare(values, ink, *outside_image(levels[0], xy, A, templates.points))
        if step == steps:
            break
        delta = np.matmul(solve, residual[..., None])[..., 0].astype(np.float64)
        delta *= np.minimum(1.0, 0.35 / np.maximum(np.abs(delta).max(axis=1), 1e-9))[:, None]
        turn = np.linalg.inv(np.eye(2) + delta[:, 2:].reshape(-1, 2, 2))
        turned = A @ turn
        # sectors have no size: what the templates show of one is their blur, which is no guide
        A = turned * np.where(sized, 1.0, short_axis(A) / np.maximum(short_axis(turned), 1e-9))[:, None, None]
        xy = xy - np.einsum("nij,nj->ni", A, delta[:, :2])
    return Poses(xy, A, which, ncc.astype(np.float64))


def _compare(values: Float32, ink: Float32, cut: Ints, outside: NDArray[np.bool_]) -> tuple[Float32, Float32]:
    """Correlation of grey values with templates (N,), and the residuals in the templates' unit (N, M).

    Samples outside the image (of the rows ``cut``) are left out of the one and are zero in the other.
    """
    scaled = normalise(values)
    ncc = np.einsum("nm,nm->n", scaled, ink)
    residual = scaled / np.maximum(ncc, 0.3)[:, None] - ink
    if len(cut):
        inside = ~outside
        count = np.maximum(inside.sum(axis=1, keepdims=True), 1)
        grey, model = (
            np.where(inside, part - (part * inside).sum(axis=1, keepdims=True) / count, 0)
            for part in (values[cut], ink[cut])
        )
        size, spread = (np.einsum("nm,nm->n", part, part) + 1e-6 for part in (model, grey))
        slope = np.einsum("nm,nm->n", grey, model) / size
        spread += FLOOR**2 * count[:, 0]
        # a pattern of which less than half is in the image proves little
        ncc[cut] = slope * np.sqrt(size / spread) * np.minimum(1, 2 * count[:, 0] / inside.shape[1])
        residual[cut] = np.where(inside, grey / np.maximum(slope, 0.3 * np.sqrt(spread))[:, None] - model, 0)
    return ncc, residual


def coarsest_level(radius_px: Float, least_px: float, levels: Sequence[Float32]) -> Ints:
    """The coarsest pyramid level in which a radius still measures ``least_px``."""
    octave = np.floor(np.log2(np.maximum(radius_px, 1e-6) / least_px))
    return np.clip(octave, 0, len(levels) - 1).astype(np.int64)


VIEW_PX = 32
"""Side of a view, which reaches from -1.7 to 1.7 in the patch frame: the disc and what surrounds it."""


@lru_cache(maxsize=1)
def _view_points() -> Float:
    ticks = ((np.arange(VIEW_PX) + 0.5) / VIEW_PX * 2 - 1) * LOOKUP_HALF
    return np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)


def view(levels: Sequence[Float32], xy: Float, A: Float, which: Ints, known: Bank) -> tuple[Float32, Float]:
    """What the image shows in the frame of a patch: upright, undistorted, and free of its inks.

    Returns
    -------
    (N, VIEW_PX²) ink, white 1 and black -1 by the least-squares line over the disc, clipped to ±2.5, nan outside the
    image; (N,) half of the contrast, grey levels, from 2 to 128, 2 also where the inks are the other way round.
    """
    points = _view_points()
    px = short_axis(A) * 2 * LOOKUP_HALF / VIEW_PX
    level = np.clip(np.rint(np.log2(np.maximum(px, 1e-6))), 0, len(levels) - 1).astype(np.int64)
    grey = sample(levels, level, xy, A, points)
    cut, outside = outside_image(levels[0], xy, A, points)
    grey[cut] = np.where(outside, np.nan, grey[cut])
    disc = np.hypot(*points.T) < 1
    part, model = grey[:, disc], known.picture[which][:, disc]
    inside = ~np.isnan(part)
    weight = inside / np.maximum(inside.sum(axis=1, keepdims=True), 1, dtype=np.float32)
    part = np.where(inside, part, 0)
    middle, mean = (np.einsum("nm,nm->n", weight, column) for column in (part, model))
    centred = weight * (model - mean[:, None])
    slope = np.einsum("nm,nm->n", part, centred) / (np.einsum("nm,nm->n", model, centred) + 0.01)
    slope = np.clip(slope, 2.0, 128.0)
    level_grey = middle - slope * mean
    return np.clip((grey - level_grey[:, None]) / slope[:, None], -2.5, 2.5), slope.astype(np.float64)


def blurred(pictures: Float32, A: Float, blur_px: Float) -> Float32:
    """Pictures (N, VIEW_PX²) in the frame of a patch, under a Gaussian blur of so many px (N,) of the image."""
    side = VIEW_PX
    waves = 2 * np.pi * np.fft.fftfreq(side, 2 * LOOKUP_HALF / side)
    wave = np.stack(np.meshgrid(waves, waves[: side // 2 + 1], indexing="ij")[::-1], axis=-1)
    in_image = np.einsum("yxi,nij->nyxj", wave, np.linalg.inv(A))
    passed = np.exp(-0.5 * np.einsum("nyxj,nyxj,n->nyx", in_image, in_image, blur_px**2))
    spectrum = np.fft.rfft2(pictures.reshape(-1, side, side))
    return np.fft.irfft2(spectrum * passed, s=(side, side)).reshape(pictures.shape).astype(np.float32)


OCTAVES = 4
"""Octaves of :func:`surroundings`: 32 to 256 px of the image."""


def surroundings(levels: Sequence[Float32], xy: Float, A: Float | None = None) -> Float32:
    """Grey values (N, OCTAVES, VIEW_PX, VIEW_PX) around places (N, 2) px: as many px of each octave.

    ``A`` (N, 2, 2) turns and scales what is shown.
    """
    ticks = np.arange(VIEW_PX) - (VIEW_PX - 1) / 2
    points = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    A = np.tile(np.eye(2), (len(xy), 1, 1)) if A is None else A
    grey = np.empty((len(xy), OCTAVES, len(points)), np.float32)
    for octave in range(OCTAVES):
        level = np.full(len(xy), min(octave, len(levels) - 1))
        grey[:, octave] = sample(levels, level, xy, A * 2.0**octave, points)
    return grey.reshape(-1, OCTAVES, VIEW_PX, VIEW_PX)
