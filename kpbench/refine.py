"""Design fit: centre, pose, inks and blur of a patch, solved for on the pixels themselves.

:func:`fit` renders the design with exact coverage under the pose, blurs it, and moves everything that it
does not know until model and pixels agree (Gauss-Newton with robust weights). What it does not know:
centre, affine map, perspective, both inks, and the blur. :func:`refine` does that for the detections of any
detector, finding the pose first with :mod:`kpbench.match`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.design import Patch
from kpbench.keypoints import Float
from kpbench.match import short_axis
from kpbench.raster import Box, coverage

__all__ = ["Fit", "fit"]

Float32 = NDArray[np.float32]


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


def _box(state: _State, extent: float) -> Box:
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


def _step(state: _State, image: Float32, box: Box, cover: Float, extent: float, last: bool) -> _State:
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
