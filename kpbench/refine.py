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
RINGS = (0.4, 0.7, 1.0)
SOFT = 0.2
"""Blur of the templates, in ring radii: what remains of a ring of 3.5 px after the pyramid's smoothing."""
RING_PX = 3.0
"""Short semi-axis of the outermost ring in px of its pyramid level; the smallest patch measures 5 px."""
_turn = np.arange(ANGLES) * (2 * np.pi / ANGLES)
RING_POINTS = np.concatenate([r * np.column_stack([np.cos(_turn), np.sin(_turn)]) for r in RINGS])


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
class Bank:
    """What the coarse stages need of a set of designs: the sectors around each centre.

    Attributes
    ----------
    patches : the designs.
    ink : (D, 72) template at :data:`RING_POINTS`, zero mean and unit norm.
    solve : (D, 6, 72) from a difference of templates to a step in (x, y, a11, a12, a21, a22).
    turned : (R, 72) all rotations of all templates, without those that look alike.
    turned_which, turned_angle : (R,) the design and the rotation in radians of each.
    """

    patches: tuple[Patch, ...]
    ink: Float32
    solve: Float32
    turned: Float32
    turned_which: Ints
    turned_angle: Float


def bank(patches: Sequence[Patch]) -> Bank:
    """Templates of the innermost sectors of each design."""
    return _bank(tuple(patches))


@lru_cache(maxsize=8)
def _bank(patches: tuple[Patch, ...]) -> Bank:
    templates, solvers, turned, which, angle = [], [], [], [], []
    for n, patch in enumerate(patches):
        ink, solve = _template(patch)
        templates.append(ink)
        solvers.append(solve)
        rings = ink.reshape(len(RINGS), ANGLES)
        seen: list[Float] = []
        for k in range(ANGLES):
            rolled = np.roll(rings, k, axis=1).ravel()
            if all(rolled @ other < 0.99 for other in seen):
                seen.append(rolled)
                turned.append(rolled)
                which.append(n)
                angle.append(_turn[k])
    pack = [np.array(a, np.float32) for a in (templates, solvers, turned)]
    return Bank(patches, *pack, np.array(which, np.int64), np.array(angle))


def _template(patch: Patch) -> tuple[Float, Float]:
    """Normalised template of one design's innermost sectors, and its Gauss-Newton solver."""

    def soft_ink(points: Float) -> Float:
        return _look_up(_soft_sectors(patch), points)

    step = 0.05
    ink = soft_ink(RING_POINTS)
    du, dv = ((soft_ink(RING_POINTS + s) - soft_ink(RING_POINTS - s)) / (2 * step) for s in np.eye(2) * step)
    u, v = RING_POINTS.T
    jacobian = np.column_stack([du, dv, du * u, du * v, dv * u, dv * v])
    ink = ink - ink.mean()
    jacobian /= np.linalg.norm(ink)
    ink /= np.linalg.norm(ink)
    jacobian -= jacobian.mean(axis=0)  # grey offset and contrast are free
    jacobian -= np.outer(ink, ink @ jacobian)
    normal = jacobian.T @ jacobian
    # scale, and stretch along two edges, leave sectors as they are: damping keeps them where they were
    return ink, np.linalg.solve(normal + np.eye(6) * 0.02 * np.trace(normal) / 6, jacobian.T)


LOOKUP_HALF, LOOKUP_SIZE = 1.7, 273


@lru_cache(maxsize=64)
def _soft_sectors(patch: Patch) -> Float32:
    """Innermost sectors, white 1 and black -1, blurred by :data:`SOFT`, over [-1.7, 1.7]² ring radii."""
    _, angles, black = patch.cells
    fine = 3
    ticks = ((np.arange(LOOKUP_SIZE * fine) + 0.5) / (LOOKUP_SIZE * fine) * 2 - 1) * LOOKUP_HALF
    u, v = np.meshgrid(ticks, ticks)
    sector = (np.searchsorted(angles, np.degrees(np.arctan2(v, u)) % 360.0, side="right") - 1) % len(angles)
    ink = np.where(black[0][sector], -1.0, 1.0).reshape(LOOKUP_SIZE, fine, LOOKUP_SIZE, fine).mean(axis=(1, 3))
    return np.asarray(cv2.GaussianBlur(ink.astype(np.float32), (0, 0), SOFT * LOOKUP_SIZE / (2 * LOOKUP_HALF)))


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


def _normalise(values: Float32, floor: float = 2.0) -> Float32:
    """Zero mean and unit norm a row; a standard deviation under ``floor`` grey levels counts as nothing."""
    centred = values - values.mean(axis=1, keepdims=True)
    size = np.einsum("nm,nm->n", centred, centred) + np.float32(floor**2 * values.shape[1])
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
        points = xy[:, None] + scale[:, None, None] * (RING_POINTS @ map_.T)
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


def align(levels: Sequence[Float32], poses: Poses, known: Bank, steps: int, ring_px: float = 2.8) -> Poses:
    """Move ring poses onto the image.

    Parameters
    ----------
    levels : from :func:`pyramid`.
    poses : ``A`` maps the unit circle to the outermost ring, which must lie inside the patch.
    known : the designs.
    steps : Gauss-Newton steps.
    ring_px : the ring's short semi-axis, in px of the level that is looked at, is at least this.

    Returns
    -------
    Poses
        With the correlation after the last step.
    """
    xy, A, which = poses.xy, poses.A, poses.which
    ink, solve = known.ink[which], known.solve[which]
    for step in range(steps + 1):
        level = np.clip(np.floor(np.log2(np.maximum(short_axis(A), 1e-6) / ring_px)), 0, len(levels) - 1)
        points = xy[:, None] + RING_POINTS @ np.swapaxes(A, 1, 2)
        values = _normalise(_sample(levels, level.astype(np.int64), points))
        ncc = np.einsum("nm,nm->n", values, ink)
        if step == steps:
            break
        residual = values / np.maximum(ncc, 0.3)[:, None] - ink
        delta = np.einsum("nkm,nm->nk", solve, residual).astype(np.float64)
        delta *= np.minimum(1.0, 0.35 / np.maximum(np.abs(delta).max(axis=1), 1e-9))[:, None]
        turn = np.linalg.inv(np.eye(2) + delta[:, 2:].reshape(-1, 2, 2))
        # sectors have no size: what is left of it in the templates is their blur, which is no guide
        A = A @ turn / np.sqrt(np.abs(np.linalg.det(turn)))[:, None, None]
        xy = xy - np.einsum("nij,nj->ni", A, delta[:, :2])
    return Poses(xy, A, which, ncc.astype(np.float64))


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
        total, ring = np.zeros((2, len(rows), *index.shape[:2]))
        for s in range(SPOKES):
            total += summed[rows, s][:, index[..., s]]
            ring += (votes[rows, s] > 0)[:, index[..., s]]
        # beyond the first ring that disagrees, what agrees is chance
        total[np.logical_or.accumulate(ring < BOUND * SPOKES, axis=2)] = -np.inf
        total[:, :, 0] = np.maximum(total[:, :, 0], -1e9)
        best = total.reshape(len(rows), -1).argmax(axis=1)
        shape, size = np.unravel_index(best, total.shape[1:])
        A[rows] = A[rows] @ (shapes[shape] * GROWTH ** size[:, None, None]) / patch.cells[0][1]
    return Poses(poses.xy, A, poses.which, poses.ncc)


def _votes(levels: Sequence[Float32], poses: Poses, known: Bank, spokes: Float, radii: Float) -> Float:
    """Agreement in [-1.4, 0.6] of each spoke's pixels with the predicted ink, (N, spokes, radii)."""
    predicted = np.stack([_look_up(_soft_sectors(p), spokes) for p in known.patches])[poses.which]
    axis = short_axis(poses.A)
    values = np.empty((len(poses), len(spokes), len(radii)), np.float32)
    directions = spokes @ np.swapaxes(poses.A, 1, 2)
    height, width = levels[0].shape
    outside = np.zeros(values.shape, bool)
    for k, radius in enumerate(radii):
        level = np.clip(np.floor(np.log2(np.maximum(axis * radius, 1e-6) / RING_PX)), 0, len(levels) - 1)
        points = poses.xy[:, None] + radius * directions
        values[..., k] = _sample(levels, level.astype(np.int64), points)
        outside[..., k] = np.any((points < 0) | (points > (width - 1, height - 1)), axis=2)
    inner = values[..., radii <= 1.0]
    sign = np.where(predicted > 0, 1.0, 0.0)[..., None]
    white = (inner * sign).sum(axis=(1, 2)) / np.maximum((sign * np.ones_like(inner)).sum(axis=(1, 2)), 1)
    black = (inner * (1 - sign)).sum(axis=(1, 2)) / np.maximum(((1 - sign) * np.ones_like(inner)).sum(axis=(1, 2)), 1)
    half = np.maximum((white - black) / 2, 1.0)[:, None, None]
    agree = np.clip((values - ((white + black) / 2)[:, None, None]) / half * np.sign(predicted)[..., None], -1, 1)
    return np.where(outside, -0.2, (agree - 0.4) * np.abs(predicted)[..., None])


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
    states = [_State(xy[n] / s, A[n] / s, A[n] / s, 0.7) for n, s in enumerate(scale)]
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
    blur: float
    black: float = 0.0
    white: float = 0.0
    ncc: float = 0.0
    noise: float = np.inf


BEYOND = 1.3
"""The model goes on beyond the disc by this factor, so that blur brings no edge in from outside."""


def _box(state: _State, extent: float) -> tuple[int, int, int, int]:
    reach = np.sqrt((state.A**2).sum(axis=1)) * extent * BEYOND * 1.02
    low, high = np.floor(state.xy - reach).astype(int) - 1, np.ceil(state.xy + reach).astype(int) + 2
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _outline(state: _State, patch: Patch) -> list[Float]:
    radius = max(float(np.abs(state.A).max()), 1.0)
    return [state.xy + p @ state.A.T for p in _black_cells(patch, 2.0 ** np.floor(np.log2(0.02 / radius)))]


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
    ones = np.ones_like(m)
    moves = np.stack([ones, m, *(-slope * g for g in (gx, gy, gx * u, gx * v, gy * u, gy * v)), laplace * (slope / 2)])
    # pixels that the model cannot explain (shadow edges, rain, what hides the patch) pull less
    usual = 2.5 * 1.48 * float(np.median(np.abs(residual))) + 1.0
    weighted = moves * np.minimum(1.0, usual / np.maximum(np.abs(residual), 1e-6))
    normal = weighted @ moves.T
    normal[DIAGONAL] += 1e-3 * normal[DIAGONAL] + 1e-6
    delta = np.linalg.solve(normal, weighted @ residual)
    shift, grow = delta[2:4], delta[4:8].reshape(2, 2)
    shift = shift * min(1.0, 0.3 * minor / max(float(np.hypot(*shift)), 1e-9))
    grow = grow * min(1.0, 0.2 * minor / max(float(np.abs(grow).max()), 1e-9))
    blur = float(np.sqrt(np.clip(state.blur**2 + np.clip(delta[8], -1, 1), 0.04, (0.5 * minor) ** 2)))
    return replace(state, xy=state.xy + shift, A=state.A + grow, blur=blur)


DIAGONAL = (np.arange(4, 9), np.arange(4, 9))
"""Affine map and blur are damped, as sectors alone leave size and some stretches open."""
