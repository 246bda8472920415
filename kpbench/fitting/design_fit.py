"""Design fit: centre, pose, inks and blur of a patch, solved for on the pixels themselves.

:func:`fit` renders the design with exact coverage under the pose, blurs it, and moves everything that it
does not know until model and pixels agree (Gauss-Newton with robust weights). What it does not know:
centre, affine map, perspective, both inks, and the blur. :mod:`kpbench.fitting` finds the pose that it starts from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from kpbench.geometry.coverage import Box, rasterise
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32


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


def fit(levels: Sequence[Float32], xy: Float, A: Float, patches: Sequence[Patch]) -> Fit:
    """Fit designs to pixels.

    Parameters
    ----------
    levels : from ``pyramid(image, 0)``. The first steps are taken where the patch's long semi-axis is 15 to
        30 px, the last ones where it is at most 100 px, in the image itself if it is no larger there.
    xy, A : (N, 2), (N, 2, 2) px, where to start: right to about a tenth of the radius.
    patches : N designs.
    """
    size = np.linalg.norm(A, 2, axis=(1, 2)) * [p.extent for p in patches] if len(patches) else np.zeros(0)
    states = [_State(xy[n], A[n], A[n], np.zeros(2), 0.5) for n in range(len(patches))]
    for largest_px, steps in ((30.0, 2), (100.0, 3)):
        octave = np.ceil(np.log2(np.maximum(size, 1e-6) / largest_px))
        level = np.clip(octave, 0, len(levels) - 1).astype(np.int64).tolist()
        states = [_scaled(state, -n) for state, n in zip(states, level, strict=True)]
        for step in range(steps):
            live = [n for n, state in enumerate(states) if state.moved > SETTLED]
            boxes = [_box(states[n], patches[n].extent) for n in live]
            covers = rasterise([_outline(states[n], patches[n]) for n in live], boxes)
            for n, box, cover in zip(live, boxes, covers, strict=True):
                last = largest_px > 30 and step == steps - 1
                states[n] = _step(states[n], levels[level[n]], box, cover, patches[n].extent, last)
        states = [_scaled(state, n) for state, n in zip(states, level, strict=True)]
    columns = [np.array([getattr(s, name) for s in states]) for name in ("black", "white", "blur", "ncc", "noise")]
    xy, A = (np.array([getattr(s, name) for s in states]) for name in ("xy", "A"))
    return Fit(xy.reshape(-1, 2), A.reshape(-1, 2, 2), *columns)


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
    moved: float = np.inf  # by the last step, in short semi-axes


SETTLED = 0.002
"""Short semi-axes: after a step that moved a patch by less it is left, as the next one would hardly move it at all."""


def _scaled(state: _State, octaves: int) -> _State:
    """From px of the image to px of a level (``octaves`` < 0), or back; a level adds 0.6 of its px of blur."""
    if not octaves:
        return state
    factor, added = 2.0**octaves, 0.6
    blur = state.blur * factor
    blur = np.hypot(blur, added) if octaves < 0 else np.sqrt(max(blur**2 - (added * factor) ** 2, 0.04))
    return replace(
        state, xy=state.xy * factor, A=state.A * factor, window=state.window * factor, blur=float(blur), moved=np.inf
    )


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
    minor = _short_axis(state.window)
    reach = max(extent - (0.35 + 0.8 * state.blur) / minor, 0.5)
    a, b, c, d = _inverse(state.window)
    inside = (a * dx + b * dy) ** 2 + (c * dx + d * dy) ** 2 < reach**2
    grey, m = image[y0:y1, x0:x1][inside], ink[inside]
    if len(m) < 12:
        return state
    middle, level = float(m.mean()), float(grey.mean())
    centred, about = m - np.float32(middle), grey - np.float32(level)
    slope = float(centred @ about) / max(float(centred @ centred), 1e-6)
    residual = about - np.float32(slope) * centred
    unexplained, spread = float(residual @ residual) / len(m), float(about @ about) / len(m)
    white = level - slope * middle
    ncc = np.sqrt(max(0.0, 1 - unexplained / max(spread, 1e-9))) * (1 if slope < 0 else -1)
    noise = float(np.sqrt(unexplained * len(m) / max(len(m) - 9, 1)))
    state = replace(state, black=white + slope, white=white, ncc=float(ncc), noise=noise)
    if last or slope > -1:
        return state
    gx, gy = (cv2.Sobel(ink, cv2.CV_32F, *axis, ksize=1, scale=0.5) for axis in ((1, 0), (0, 1)))
    gx, gy, laplace = gx[inside], gy[inside], cv2.Laplacian(ink, cv2.CV_32F)[inside]
    edge = np.flatnonzero(gx * gx + gy * gy > 1e-4)  # only these say where the patch is
    if len(edge) < 12:
        return state
    at_y, at_x = np.divmod(np.flatnonzero(inside)[edge], inside.shape[1])
    gx, gy, dx, dy, m, residual = gx[edge], gy[edge], dx[at_x], dy[at_y, 0], m[edge], residual[edge]
    a, b, c, d = _inverse(state.A)
    u, v, outward = a * dx + b * dy, c * dx + d * dy, gx * dx + gy * dy
    shifts = (-gx, -gy, -gx * u, -gx * v, -gy * u, -gy * v, outward * u, outward * v, laplace[edge] / 2)
    moves = np.stack([np.ones_like(m), m, *(slope * g for g in shifts)])
    # pixels that the model cannot explain (shadow edges, rain, what hides the patch) pull less
    size, half = np.abs(residual), len(residual) // 2
    usual = 2.5 * 1.48 * float(np.partition(size, half)[half]) + 1.0
    weighted = moves * np.minimum(1.0, usual / np.maximum(size, 1e-6))
    return _moved(state, weighted @ moves.T, weighted @ residual, minor, extent)


def _inverse(m: Float) -> tuple[float, float, float, float]:
    """Row by row; for one 2x2 matrix many times faster than the general one."""
    (a, b), (c, d) = m.tolist()
    det = a * d - b * c or 1e-12
    return d / det, -b / det, -c / det, a / det


def _short_axis(m: Float) -> float:
    """:func:`kpbench.fitting.short_axis` of one map."""
    (a, b), (c, d) = m.tolist()
    square, det = a * a + b * b + c * c + d * d, a * d - b * c
    return float(np.sqrt(max(square - np.sqrt(max(square**2 - 4 * det**2, 0.0)), 1e-12) / 2))


def _moved(state: _State, normal: Float, target: Float, minor: float, extent: float) -> _State:
    """Solve the normal equations of (white, ink, x, y, 4 of A, 2 of bend, blur²) and take the step, within reason."""
    damped = np.arange(4, 11)  # sectors alone leave size and some stretches open
    normal[damped, damped] += 1e-3 * normal[damped, damped] + 1e-3
    normal[[0, 1, 2, 3], [0, 1, 2, 3]] += 1e-3
    prior = (state.noise**2 + 1) / (BEND * minor) ** 2
    normal[[8, 9], [8, 9]] += prior
    target[8:10] -= prior * state.bend
    delta = np.linalg.solve(normal, target)
    shift, grow = delta[2:4], delta[4:8].reshape(2, 2)
    shift = shift * min(1.0, 0.3 * minor / max(float(np.hypot(*shift)), 1e-9))
    grow = grow * min(1.0, 0.2 * minor / max(float(np.abs(grow).max()), 1e-9))
    blur = float(np.sqrt(np.clip(state.blur**2 + np.clip(delta[10], -1, 1), 0.04, (0.5 * minor) ** 2)))
    bend = np.clip(state.bend + delta[8:10], -0.3, 0.3)
    bend *= min(1.0, 0.56 / (BEYOND * extent * max(float(np.hypot(*bend)), 1e-9)))  # the model stays before the camera
    moved = max(float(np.abs(shift).max()), float(np.abs(grow).max())) / minor
    return replace(state, xy=state.xy + shift, A=state.A + grow, bend=bend, blur=blur, moved=moved)


BEND = 1 / 400
"""Expected change of distance over a patch, in distances a px of its radius: tilt over focal length."""
