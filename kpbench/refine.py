"""Design fit: from a coarse centre to a sub-pixel one, by comparing pixels with the design.

Three tools, coarse to fine, all of them over many candidates at once:

* :func:`search` finds the pose when only a rough place and scale are known: it samples the image on
  rings around the place, under a bank of tilts, and correlates with every design in every rotation;
* :func:`align` moves a pose onto the image (inverse compositional Gauss-Newton, Baker and Matthews,
  *Lucas-Kanade 20 years on*, IJCV 2004), seeing only the sectors near the centre, which look the same
  at every scale; :func:`extend` then measures how far these sectors reach, which is the patch's size;
* :func:`fit` renders the design with exact coverage under the pose, blurs it, and solves for centre,
  affine map, both inks and blur on the pixels themselves.

Poses are affine: ``x_px = xy + A @ u`` with ``u`` in the patch frame (unit disc).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.design import Patch
from kpbench.keypoints import Float, UInt8
from kpbench.raster import coverage

__all__ = ["Bank", "Fit", "Poses", "align", "bank", "extend", "fit", "pyramid", "search"]

Float32 = NDArray[np.float32]
Ints = NDArray[np.int64]

ANGLES = 24
RING_PX = 3.0
"""Short semi-axis of the core's outermost ring, in px of the level: well inside the smallest patch's (5 px)."""
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
    """

    points: Float
    ink: Float32
    solve: Float32
    sized: NDArray[np.bool_]


@dataclass(frozen=True)
class Bank:
    """What the coarse stages need of a set of designs.

    Attributes
    ----------
    patches : the designs.
    core : the innermost sectors, over the unit disc; they look the same at every size.
    whole : the whole design, over the unit disc.
    turned : (R, M) all rotations of all cores, without those that look alike.
    turned_which, turned_angle : (R,) the design and the rotation in radians of each.
    """

    patches: tuple[Patch, ...]
    core: Templates
    whole: Templates
    turned: Float32
    turned_which: Ints
    turned_angle: Float


def bank(patches: Sequence[Patch]) -> Bank:
    """Templates of some designs."""
    return _bank(tuple(patches))


@lru_cache(maxsize=8)
def _bank(patches: tuple[Patch, ...]) -> Bank:
    core = _templates(patches, (0.4, 0.7, 1.0), whole=False)
    turned, which, angle = [], [], []
    for n, ink in enumerate(core.ink):
        seen: list[Float32] = []
        for k in range(ANGLES):
            rolled = np.roll(ink.reshape(-1, ANGLES), k, axis=1).ravel()
            if all(rolled @ other < 0.99 for other in seen):
                seen.append(rolled)
                which.append(n)
                angle.append(_turn[k])
        turned += seen
    whole = _templates(patches, (0.25, 0.45, 0.65, 0.85), whole=True)
    return Bank(patches, core, whole, np.array(turned), np.array(which, np.int64), np.array(angle))


def _templates(patches: Sequence[Patch], rings: Sequence[float], whole: bool) -> Templates:
    points = np.concatenate([r * _circle for r in rings])
    pairs = [_template(_soft_ink(patch, whole), points) for patch in patches]
    ink, solve = (np.array(part, np.float32) for part in zip(*pairs, strict=True))
    return Templates(points, ink, solve, np.array([whole and len(p.cells[0]) > 2 for p in patches]))


def _template(image: Float32, points: Float) -> tuple[Float, Float]:
    """Normalised template and its Gauss-Newton solver."""
    step = 0.05
    ink = _look_up(image, points)
    du, dv = ((_look_up(image, points + s) - _look_up(image, points - s)) / (2 * step) for s in np.eye(2) * step)
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
def _soft_ink(patch: Patch, whole: bool) -> Float32:
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


def _look_up(image: Float32, points: Float) -> Float:
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


def _sample(levels: Sequence[Float32], level: Ints, points: Float) -> Float32:
    """Bilinear grey values at points (N, M, 2) px of the image, each row from a level of its own: (N, M)."""
    values = np.empty(points.shape[:2], np.float32)
    for n in np.unique(level):
        rows = level == n
        x, y = np.moveaxis((points[rows] * 0.5**n).astype(np.float32), -1, 0)
        source = levels[n]
        values[rows] = cv2.remap(source, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values


FLOOR = 1.0
"""Grey levels; a standard deviation around a place that is under it counts as nothing."""


def _normalise(values: Float32) -> Float32:
    """Zero mean and unit norm a row."""
    centred = values - values.mean(axis=1, keepdims=True)
    size = np.einsum("nm,nm->n", centred, centred) + np.float32(FLOOR**2 * values.shape[1])
    return centred / np.sqrt(size)[:, None]


def short_axis(A: Float) -> Float:
    """Short semi-axis of the image of the unit circle: the smaller singular value of (N, 2, 2)."""
    square = np.einsum("nij,nij->n", A, A)
    det = np.abs(A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0])
    return np.asarray(np.sqrt(np.maximum(square - np.sqrt(np.maximum(square**2 - 4 * det**2, 0)), 0) / 2))


@lru_cache(maxsize=1)
def _tilts() -> Float:
    """Affine maps (K, 2, 2) whose circle has a short semi-axis of 1: long ones of 1 to 4.5 in all directions."""
    maps = []
    for ratio, directions in ((1.0, 1), (0.6, 4), (0.36, 6), (0.22, 9)):
        for direction in np.arange(directions) * np.pi / directions:
            c, s = np.cos(direction), np.sin(direction)
            axes = np.array([[c, -s], [s, c]])
            maps.append(axes @ np.diag([1 / ratio, 1.0]) @ axes.T)
    return np.array(maps)


def search(levels: Sequence[Float32], xy: Float, level: Ints, known: Bank, margin: float = 0.25) -> Poses:
    """Best tilt and rotation of each design at each place.

    Parameters
    ----------
    levels : from :func:`pyramid`.
    xy : (N, 2) px.
    level : (N,) pyramid level to look at: the ring has a short semi-axis of ``3.5 · 2^level`` px.
    known : the designs.
    margin : designs whose correlation is worse by more than this than the best one's are left out.

    Returns
    -------
    Poses
        One to D a place.
    """
    tilts = _tilts()
    designs = len(known.patches)
    scale = RING_PX * 2.0**level
    best = np.full((len(xy), designs), -1.0, np.float32)
    tilt, turn = np.zeros((2, len(xy), designs), np.int64)
    starts = np.searchsorted(known.turned_which, np.arange(designs + 1))
    for k, map_ in enumerate(tilts):
        points = xy[:, None] + scale[:, None, None] * (known.core.points @ map_.T)
        ncc = _normalise(_sample(levels, level, points)) @ known.turned.T
        for d in range(designs):
            part = ncc[:, starts[d] : starts[d + 1]]
            at = part.argmax(axis=1)
            value = part[np.arange(len(xy)), at]
            better = value > best[:, d]
            best[better, d], tilt[better, d], turn[better, d] = value[better], k, at[better] + starts[d]
    place, which = np.nonzero(best >= best.max(axis=1, keepdims=True) - margin)
    angle = known.turned_angle[turn[place, which]]
    c, s = np.cos(angle), np.sin(angle)
    A = scale[place, None, None] * tilts[tilt[place, which]] @ np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
    return Poses(xy[place], A, which, best[place, which].astype(np.float64))


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
        points = xy[:, None] + templates.points @ np.swapaxes(A, 1, 2)
        values = _sample(levels, _level(short_axis(A), radius_px, levels), points)
        ncc, residual = _compare(values, ink, _outside(points, levels[0]))
        if step == steps:
            break
        delta = np.matmul(solve, residual[..., None])[..., 0].astype(np.float64)
        delta *= np.minimum(1.0, 0.35 / np.maximum(np.abs(delta).max(axis=1), 1e-9))[:, None]
        turn = np.linalg.inv(np.eye(2) + delta[:, 2:].reshape(-1, 2, 2))
        # sectors have no size: what the templates show of one is their blur, which is no guide
        turn /= np.where(sized, 1.0, np.sqrt(np.abs(np.linalg.det(turn))))[:, None, None]
        A = A @ turn
        xy = xy - np.einsum("nij,nj->ni", A, delta[:, :2])
    return Poses(xy, A, which, ncc.astype(np.float64))


def _compare(values: Float32, ink: Float32, outside: NDArray[np.bool_]) -> tuple[Float32, Float32]:
    """Correlation of grey values with templates (N,), and the residuals in the templates' unit (N, M).

    Samples outside the image are left out of the one and are zero in the other.
    """
    scaled = _normalise(values)
    ncc = np.einsum("nm,nm->n", scaled, ink)
    residual = scaled / np.maximum(ncc, 0.3)[:, None] - ink
    cut = np.flatnonzero(outside.any(axis=1))
    if len(cut):
        inside = ~outside[cut]
        share = np.maximum(inside.sum(axis=1, keepdims=True), 1)
        grey, model = (np.where(inside, a - (a * inside).sum(1, keepdims=True) / share, 0) for a in (values[cut], ink[cut]))
        size = np.einsum("nm,nm->n", model, model)
        slope = np.einsum("nm,nm->n", grey, model) / np.maximum(size, 1e-6)
        spread = np.einsum("nm,nm->n", grey, grey) + FLOOR**2 * share[:, 0]
        # a patch of which less than half is in the image proves little
        ncc[cut] = slope * np.sqrt(size / spread) * np.minimum(1, 2 * share[:, 0] / inside.shape[1])
        residual[cut] = np.where(inside, grey / np.maximum(slope, 0.3 * np.sqrt(spread))[:, None] - model, 0)
    return ncc, residual


def _outside(points: Float, image: Float32) -> NDArray[np.bool_]:
    height, width = image.shape
    return np.asarray(np.any((points < 0) | (points > (width - 1, height - 1)), axis=-1))


def _level(radius_px: Float, least_px: float, levels: Sequence[Float32]) -> Ints:
    """The coarsest pyramid level in which a radius still measures ``least_px``."""
    octave = np.floor(np.log2(np.maximum(radius_px, 1e-6) / least_px))
    return np.clip(octave, 0, len(levels) - 1).astype(np.int64)


BOUND = 0.7
SPOKES, FIRST, GROWTH, STEPS = 48, 0.7, 1.12, 44


def extend(levels: Sequence[Float32], poses: Poses, known: Bank) -> Poses:
    """How far the sectors reach: turn ring poses into poses of the unit disc.

    Along spokes, each pixel votes for or against the ink that the sectors predict; the ellipse with the
    largest sum of votes is the patch. Two edges leave the stretch along each of them open, so ellipses
    are tried that differ in it; three or more edges leave the size alone.
    """
    turn = np.arange(SPOKES) * (2 * np.pi / SPOKES)
    spokes = np.column_stack([np.cos(turn), np.sin(turn)])
    radii = FIRST * GROWTH ** np.arange(STEPS)
    votes = _votes(levels, poses, known, spokes, radii)
    summed = np.cumsum(votes * (radii * np.gradient(radii)), axis=2)
    A = poses.A.copy()
    for d, patch in enumerate(known.patches):
        rows = np.flatnonzero(poses.which == d)
        if not len(rows):
            continue
        shapes = _stretches(patch)
        reach = 1 / np.linalg.norm(np.einsum("gij,sj->gsi", np.linalg.inv(shapes), spokes), axis=2)
        index = np.log(reach / FIRST) / np.log(GROWTH)
        index = np.rint(index[:, None] + np.arange(STEPS)[:, None]).astype(np.int64)  # (G, sizes, spokes)
        index = np.clip(index, 0, STEPS - 1)
        total, good, bad = np.zeros((3, len(rows), *index.shape[:2]))
        for s in range(SPOKES):
            total += summed[rows, s][:, index[..., s]]
            good += (votes[rows, s] > 0)[:, index[..., s]]
            bad += (votes[rows, s] < 0)[:, index[..., s]]
        # beyond the first ring that disagrees, what agrees is chance
        total[np.logical_or.accumulate((bad > (1 - BOUND) * (good + bad)) | (good < 0.3 * SPOKES), axis=2)] = -np.inf
        total[:, :, 0] = np.maximum(total[:, :, 0], -1e9)
        best = total.reshape(len(rows), -1).argmax(axis=1)
        shape, size = np.unravel_index(best, total.shape[1:])
        A[rows] = A[rows] @ (shapes[shape] * GROWTH ** size[:, None, None]) / patch.cells[0][1]
    return Poses(poses.xy, A, poses.which, poses.ncc)


def _votes(levels: Sequence[Float32], poses: Poses, known: Bank, spokes: Float, radii: Float) -> Float:
    """Agreement in [-1.4, 0.6] of each spoke's pixels with the predicted ink, (N, spokes, radii)."""
    predicted = np.stack([_look_up(_soft_ink(p, False), spokes) for p in known.patches])[poses.which]
    axis = short_axis(poses.A)
    values = np.empty((len(poses), len(spokes), len(radii)), np.float32)
    directions = spokes @ np.swapaxes(poses.A, 1, 2)
    outside = np.zeros(values.shape, bool)
    for k, radius in enumerate(radii):
        points = poses.xy[:, None] + radius * directions
        values[..., k] = _sample(levels, _level(axis * radius, RING_PX, levels), points)
        outside[..., k] = _outside(points, levels[0])
    inner = values[..., radii <= 1.0]
    sign = np.where(predicted > 0, 1.0, 0.0)[..., None]
    white = (inner * sign).sum(axis=(1, 2)) / np.maximum((sign * np.ones_like(inner)).sum(axis=(1, 2)), 1)
    black = (inner * (1 - sign)).sum(axis=(1, 2)) / np.maximum(((1 - sign) * np.ones_like(inner)).sum(axis=(1, 2)), 1)
    half = np.maximum((white - black) / 2, 1.0)[:, None, None]
    agree = np.clip((values - ((white + black) / 2)[:, None, None]) / half * np.sign(predicted)[..., None], -1, 1)
    return np.where(outside, 0.0, (agree - 0.4) * np.abs(predicted)[..., None])


@lru_cache(maxsize=64)
def _stretches(patch: Patch) -> Float:
    """Maps (G, 2, 2) of the patch frame that leave the innermost edges where they are, of determinant 1."""
    _, angles, black = patch.cells
    edges = np.unique(np.round(angles[black[0] != np.roll(black[0], 1)] % 180.0, 6))
    if len(edges) > 2:
        return np.eye(2)[None]
    first = edges[0] if len(edges) else 0.0
    second = edges[1] if len(edges) == 2 else first + 90.0
    basis = np.array([[np.cos(np.radians(a)), np.sin(np.radians(a))] for a in (first, second)]).T
    growth = 1.2 ** (np.arange(-5, 6) / 1.0)
    return np.array([basis @ np.diag([g, 1 / g]) @ np.linalg.inv(basis) for g in growth])


@dataclass(frozen=True)
class Fit:
    """N fitted patches.

    Attributes
    ----------
    xy : (N, 2) px.
    A : (N, 2, 2) patch frame to px.
    black, white : (N,) inks, grey levels.
    blur_px : (N,) standard deviation of a Gaussian, px.
    ncc : (N,) correlation of model and pixels over the disc, in [-1, 1].
    noise : (N,) standard deviation of what the model leaves, grey levels.
    """

    xy: Float
    A: Float
    black: Float
    white: Float
    blur_px: Float
    ncc: Float
    noise: Float


def fit(
    levels: Sequence[Float32], xy: Float, A: Float, patches: Sequence[Patch], steps: int = 4, largest_px: float = 40.0
) -> Fit:
    """Fit designs to pixels.

    Parameters
    ----------
    levels : from ``pyramid(image, 0)``; a patch is fitted in the finest level in which its long
        semi-axis is at most ``largest_px``.
    xy, A : (N, 2), (N, 2, 2) px, where to start: right to about a tenth of the radius.
    patches : N designs.
    steps : Gauss-Newton steps.
    """
    size = np.linalg.norm(A, 2, axis=(1, 2)) * [p.extent for p in patches] if len(patches) else np.zeros(0)
    level = np.clip(np.ceil(np.log2(np.maximum(size, 1e-6) / largest_px)), 0, len(levels) - 1).astype(int)
    scale = 2.0**level
    states = [_State(xy[n] / s, A[n] / s, A[n] / s, np.zeros(2), 0.7) for n, s in enumerate(scale)]
    for step in range(steps + 1):
        boxes = [_box(state, patch.extent) for state, patch in zip(states, patches, strict=True)]
        covers = coverage([_outline(s, p) for s, p in zip(states, patches, strict=True)], boxes)
        for n, (box, cover, patch) in enumerate(zip(boxes, covers, patches, strict=True)):
            states[n] = _step(states[n], levels[level[n]], box, cover, patch.extent, step == steps)
    rows = np.array([[*s.xy, *s.A.ravel(), s.black, s.white, s.blur, s.ncc, s.noise] for s in states]).reshape(-1, 11)
    xy, A = rows[:, :2] * scale[:, None], rows[:, 2:6].reshape(-1, 2, 2) * scale[:, None, None]
    return Fit(xy, A, rows[:, 6], rows[:, 7], rows[:, 8] * scale, rows[:, 9], rows[:, 10])


@dataclass(frozen=True)
class _State:
    """One patch being fitted, in px of its level; ``window`` is where pixels count: ``|window⁻¹ (x − xy)| < 1``."""

    xy: Float
    A: Float
    window: Float
    bend: Float
    blur: float
    black: float = 0.0
    white: float = 0.0
    ncc: float = 0.0
    noise: float = np.inf


BEYOND = 1.3
"""The model goes on beyond the disc by this factor, so that blur brings no edge in from outside."""


def _box(state: _State, extent: float) -> tuple[int, int, int, int]:
    reach = np.sqrt((state.A**2).sum(axis=1)) * extent * BEYOND * 1.02
    reach /= 1 - extent * BEYOND * np.hypot(*state.bend)
    low, high = np.floor(state.xy - reach).astype(int) - 1, np.ceil(state.xy + reach).astype(int) + 2
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _outline(state: _State, patch: Patch) -> list[Float]:
    radius = max(float(np.abs(state.A).max()), 1.0)
    cells = _black_cells(patch, 2.0 ** np.floor(np.log2(0.02 / radius)))
    return [state.xy + p @ state.A.T / (1 + p @ state.bend)[:, None] for p in cells]


@lru_cache(maxsize=256)
def _black_cells(patch: Patch, tolerance: float) -> tuple[Float, ...]:
    """Polygons of the black cells in the patch frame; coverage adds up, so cells that touch leave no seam."""
    radii, angles, black = patch.cells
    radii = np.append(radii[:-1], radii[-1] * BEYOND)
    width = np.diff(np.append(angles, angles[0] + 360.0))
    polygons = []
    for i, j in zip(*np.nonzero(black), strict=True):
        count = int(np.ceil(np.radians(width[j]) / np.sqrt(8 * tolerance / radii[i + 1]))) + 1
        turn = np.radians(angles[j] + width[j] * np.linspace(0, 1, count + 1))
        arc = np.column_stack([np.cos(turn), np.sin(turn)])
        polygons.append(np.concatenate([radii[i + 1] * arc, radii[i] * (arc[::-1] if radii[i] else np.zeros((1, 2)))]))
    return tuple(polygons)


def _step(state: _State, image: Float32, box: tuple[int, int, int, int], cover: Float, extent: float, last: bool) -> _State:
    """One Gauss-Newton step, or only the residuals if it is the last."""
    x, y, w, h = box
    rows, columns = image.shape
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + w, columns), min(y + h, rows)
    if x1 - x0 < 3 or y1 - y0 < 3:
        return state
    ink = cv2.GaussianBlur(cover.astype(np.float32), (0, 0), max(state.blur, 0.2), borderType=cv2.BORDER_REPLICATE)
    ink = ink[y0 - y : y1 - y, x0 - x : x1 - x]
    dx, dy = np.arange(x0, x1) - state.xy[0], np.arange(y0, y1)[:, None] - state.xy[1]
    minor = float(short_axis(state.window[None])[0])
    limit = max(extent - (0.35 + 0.8 * state.blur) / minor, 0.5)
    (a, b), (c, d) = np.linalg.inv(state.window) / limit
    inside = (a * dx + b * dy) ** 2 + (c * dx + d * dy) ** 2 < 1
    grey, m = image[y0:y1, x0:x1][inside].astype(np.float64), ink[inside].astype(np.float64)
    if len(m) < 12:
        return state
    centred = m - m.mean()
    slope = float(centred @ grey / max(centred @ centred, 1e-9))
    residual = (grey - grey.mean()) - slope * centred
    spread = float(np.var(grey))
    ncc = np.sqrt(max(0.0, 1 - float(np.var(residual)) / max(spread, 1e-9))) * (1 if slope < 0 else -1)
    white = float(grey.mean() - slope * m.mean())
    noise = float(np.sqrt(residual @ residual / max(len(m) - 9, 1)))
    state = replace(state, black=white + slope, white=white, ncc=float(ncc), noise=noise)
    if last or slope > -1:
        return state
    gy, gx = np.gradient(ink)
    laplace = cv2.Laplacian(ink, cv2.CV_32F)[inside]
    gx, gy = gx[inside], gy[inside]
    (a, b), (c, d) = np.linalg.inv(state.A)
    u, v = (a * dx + b * dy)[inside], (c * dx + d * dy)[inside]
    stretch = 1 / np.maximum(1 - state.bend[0] * u - state.bend[1] * v, 0.3)  # 1 + bend·u of the true patch point
    u, v = u * stretch, v * stretch
    away = gx * (state.A[0, 0] * u + state.A[0, 1] * v) + gy * (state.A[1, 0] * u + state.A[1, 1] * v)
    ones = np.ones_like(m)
    shifts = (-gx, -gy, -gx * u, -gx * v, -gy * u, -gy * v, away * u, away * v)
    moves = np.stack([ones, m, *(slope * g for g in shifts), laplace * (slope / 2)])
    # pixels that the model cannot explain (shadow edges, rain, what hides the patch) pull less
    usual = 2.5 * 1.48 * float(np.median(np.abs(residual))) + 1.0
    weighted = moves * np.minimum(1.0, usual / np.maximum(np.abs(residual), 1e-6))
    normal = weighted @ moves.T
    target = weighted @ residual
    diagonal = np.arange(4, 11)
    # affine map and blur are damped, as sectors alone leave size and some stretches open
    normal[diagonal, diagonal] += 1e-3 * normal[diagonal, diagonal] + 1e-3
    normal[[2, 3], [2, 3]] += 1e-6 * normal[0, 0]
    prior = (noise**2 + 1) / (BEND * minor) ** 2
    normal[[8, 9], [8, 9]] += prior
    target[8:10] -= prior * state.bend
    delta = np.linalg.solve(normal, target)
    shift, grow = delta[2:4], delta[4:8].reshape(2, 2)
    shift = shift * min(1.0, 0.3 * minor / max(float(np.hypot(*shift)), 1e-9))
    grow = grow * min(1.0, 0.2 * minor / max(float(np.abs(grow).max()), 1e-9))
    blur = float(np.sqrt(np.clip(state.blur**2 + np.clip(delta[10], -1, 1), 0.04, (0.5 * minor) ** 2)))
    bend = np.clip(state.bend + delta[8:10], -0.3, 0.3)
    return replace(state, xy=state.xy + shift, A=state.A + grow, bend=bend, blur=blur)


BEND = 1 / 400
"""Expected change of distance over a patch, in distances a px of its radius: tilt over focal length."""
