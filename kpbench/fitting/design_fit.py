"""The design fit: centre, pose, inks and blur of a patch, estimated from the pixels.

:func:`fit` renders the design with exact coverage, blurs the rendering, and changes the unknowns until rendering and
pixels agree (Gauss-Newton with robust weights). The unknowns are the centre, the affine map, the perspective, both
inks, the blur and its unevenness, the tone curve, the ink gain, the lens and the slope of the light.
:mod:`kpbench.fitting.sector_search` and :mod:`kpbench.fitting.align` find poses to start from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from kpbench.fitting.align import short_semi_axis
from kpbench.fitting.covariance import PIXEL_VARIANCE, centre_covariance, noise_grain, start_covariance
from kpbench.fitting.drawing import (
    MODEL_REACH,
    blur_derivatives,
    draw_black_cells,
    move_cells,
    tone_curve,
    tone_slopes,
)
from kpbench.geometry.coverage import Box
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32

COARSE_PX, COARSE_STEPS = 30.0, 3
"""The first ``COARSE_STEPS`` steps use the finest pyramid level in which the patch's long semi-axis, with rim and quiet
zone, is at most ``COARSE_PX`` px."""
FINE_PX, FINE_STEPS = 100.0, 4
"""The last ``FINE_STEPS`` steps use the finest pyramid level in which this semi-axis is at most ``FINE_PX`` px."""
SETTLED_PX, SETTLED_SHARE = 0.1, 0.0025
"""If a step changes centre and map by at most this, px of the image and short semi-axes, it is the level's last."""
LEVEL_BLUR_PX = 0.6
"""Standard deviation of the pyramid's own blur in every level but level 0, px of the level."""
EXPECTED_BEND_PER_PX = 1 / 400
"""Prior of the perspective: standard deviation of the bend, per px of the short semi-axis."""
EXPECTED_STRETCH = 0.03
"""Prior of the map: standard deviation of each row's change from the start, as a share of the patch's reach along x or
y. The pixels of a design of sectors alone do not tell its size."""
EXPECTED_TONE = 0.25
"""Prior of the tone curve: standard deviation of both coefficients."""
EXPECTED_GAIN = 0.004
"""Prior of the ink gain: standard deviation, in disc radii."""
EXPECTED_LENS = 0.1
"""Prior of the lens: standard deviation of Brown's k1, if the longer side of the image is the focal length."""
EXPECTED_LIGHT = 0.015
"""Prior of the light: standard deviation of its change over a short semi-axis, as a share."""
EXPECTED_UNEVEN_PX2 = 0.6
"""Prior of the unevenness of the blur: standard deviation of both coefficients, px² of the image."""
LARGEST_EXTRAS = np.array([0.3, 0.3, 1.5, 1.0, 0.03, 0.5, 0.3, 0.3, 0.7, 0.7])
"""Largest size of the extras: of k1 for the lens, per short semi-axis for the light, per blur variance for the
unevenness. Steeper tone curves fall."""
EXTRA_POWERS = np.array([0, 0, 0, 0, 0, -2, -1, -1, 2, 2])  # powers of px in the units of the extras
EXTRAS, UNKNOWNS = 10, 19
"""Numbers of unknowns that are extras, and of all unknowns."""
PRIOR_AT = np.array([4, 5, 6, 7, *range(UNKNOWNS - EXTRAS, UNKNOWNS)])
"""Places of the unknowns with a prior: the map and the extras."""
FINE_PRIORS = [7, 12, 13]  # of extras that the coarse steps leave, because they would follow errors of the pose
LEAST_SHRINK, LARGEST_GROWTH = 0.1, 1.5
"""A step changes the blur's variance v to ``LEAST_SHRINK`` v at least, ``LARGEST_GROWTH`` (v + 1 px²) at most."""
MARGIN_BLURS = 1.6
"""Width of the rim that is left out, in standard deviations of the blur: the ground shines into the blurred rim."""
LEAST_PIXELS = 12
"""A step needs at least this many pixels inside the patch, and on edges."""


@dataclass(frozen=True)
class Fit:
    """N fitted patches.

    Attributes
    ----------
    xy : ndarray of shape (N, 2)
        Centres, px.
    A : ndarray of shape (N, 2, 2)
        Map from the patch frame to px.
    black, white : ndarray of shape (N,)
        Inks, grey levels.
    blur_px : ndarray of shape (N,)
        Standard deviation of the Gaussian blur, px.
    ncc : ndarray of shape (N,)
        Correlation of model and pixels over the patch without a margin at its edge, in [-1, 1].
    noise : ndarray of shape (N,)
        Standard deviation of the residuals, grey levels.
    covariance : ndarray of shape (N, 2, 2)
        Covariance of the error of ``xy``, px², see :mod:`kpbench.fitting.covariance`. If the pixels allow no step, it
        is the covariance of the starting pose.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.fitting import build_pyramid
    >>> levels = build_pyramid(np.full((48, 64), 120, np.uint8), 0)
    >>> xy, A, patches = np.array([[30.0, 20.0]]), np.array([np.eye(2) * 12.0]), kpbench.shipped_patches()[:1]
    >>> found = kpbench.fit(levels, xy, A, patches)
    >>> found.ncc < 0.1
    array([ True])
    """

    xy: Float
    A: Float
    black: Float
    white: Float
    blur_px: Float
    ncc: Float
    noise: Float
    covariance: Float


def fit(levels: Sequence[Float32], xy: Float, A: Float, patches: Sequence[Patch]) -> Fit:
    """Fit designs to the pixels of an image.

    Parameters
    ----------
    levels : list of ndarray
        ``kpbench.fitting.build_pyramid(image, 0)``. The first steps are taken in the level in which the patch's long
        semi-axis measures 15 to 30 px. The last steps are taken in the level in which the semi-axis measures 50 to 100
        px. A smaller patch is fitted in the image itself.
    xy, A : ndarray of shape (N, 2) and (N, 2, 2)
        Starting poses, px. The poses must be right to about a tenth of the radius.
    patches : sequence of Patch
        N designs.

    Returns
    -------
    Fit

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.fitting import build_pyramid
    >>> patch = kpbench.shipped_patches()[0]
    >>> v, u = (np.mgrid[:64, :64] - 31.5) / 20.0
    >>> black = patch.is_black(np.stack([u, v], axis=-1))
    >>> image = np.where(np.hypot(u, v) > 1, 120, np.where(black, 40, 210)).astype(np.uint8)
    >>> found = kpbench.fit(build_pyramid(image, 0), np.array([[32.0, 31.0]]), np.array([np.eye(2) * 19.0]), [patch])
    >>> found.xy.round(1)
    array([[31.5, 31.5]])
    """
    size = np.linalg.norm(A, 2, axis=(1, 2)) * [p.extent for p in patches] if len(patches) else np.zeros(0)
    covariance, middle = start_covariance(A), (np.array(levels[0].shape[::-1]) - 1) / 2
    states = [_State(xy[n], A[n], A[n], middle, covariance=covariance[n]) for n in range(len(patches))]
    for largest_px, steps in ((COARSE_PX, COARSE_STEPS), (FINE_PX, FINE_STEPS)):
        octave = np.ceil(np.log2(np.maximum(size, 1e-6) / largest_px))
        level = np.clip(octave, 0, len(levels) - 1).astype(np.int64).tolist()
        states = [_scale_state(state, -n) for state, n in zip(states, level, strict=True)]
        for step in range(steps):
            live = [n for n, state in enumerate(states) if state.moved > 1]
            boxes = [_bounding_box(states[n], patches[n].extent) for n in live]
            cells = [move_cells(states[n].xy, states[n].A, *_shape(states[n]), patches[n]) for n in live]
            drawings = draw_black_cells(cells, boxes)
            for n, box, drawing in zip(live, boxes, drawings, strict=True):
                left = steps - 1 - step if largest_px == FINE_PX else FINE_STEPS
                states[n] = _step(states[n], levels[level[n]], box, drawing, patches[n].extent, left, level[n])
        states = [_scale_state(state, n) for state, n in zip(states, level, strict=True)]
    columns = [np.array([getattr(s, name) for s in states]) for name in ("black", "white", "blur", "ncc", "noise")]
    xy, A, C = (np.array([getattr(s, name) for s in states]) for name in ("xy", "A", "covariance"))
    black, white, blur, ncc, noise = columns
    return Fit(xy.reshape(-1, 2), A.reshape(-1, 2, 2), black, white, blur, ncc, noise, C.reshape(-1, 2, 2))


@dataclass(frozen=True)
class _State:
    """One patch during the fit, in px of the pyramid level.

    ``window`` is the map that the fit started from. A pixel counts if this map, centred at ``xy``, places the pixel in
    the patch, further from the patch's edge than a margin. ``middle`` is the middle of the image. ``moved`` is the size
    of the last step, relative to that of a settled one.

    ``extras`` are the unknowns with a prior: the first two entries of the last row of the homography (the bend), the
    two coefficients of the tone curve (see :func:`tone_curve`), the ink gain in disc radii, the lens in 1/px² (Brown's
    k1 over the square of the focal length), the change of the light along x and y, a share per px, and the unevenness
    of the blur: half the difference of its variances along x and y, and their covariance, px².
    """

    xy: Float
    A: Float
    window: Float
    middle: Float
    extras: Float = field(default_factory=lambda: np.zeros(EXTRAS))
    blur: float = 0.5
    black: float = 0.0
    white: float = 0.0
    ncc: float = 0.0
    noise: float = np.inf
    covariance: Float = field(default_factory=lambda: np.zeros((2, 2)))
    moved: float = np.inf


def _scale_state(state: _State, octaves: int) -> _State:
    """Convert a state from px of the image to px of a level (``octaves`` < 0), or back (``octaves`` > 0)."""
    if not octaves:
        return state
    factor = 2.0**octaves
    blur = state.blur * factor
    if octaves < 0:
        blur = np.hypot(blur, LEVEL_BLUR_PX)
    else:
        blur = np.sqrt(max(blur**2 - (LEVEL_BLUR_PX * factor) ** 2, 0.04))
    xy, A, window, covariance = state.xy * factor, state.A * factor, state.window * factor, state.covariance * factor**2
    extras = state.extras * factor**EXTRA_POWERS
    return replace(
        state,
        xy=xy,
        A=A,
        window=window,
        middle=state.middle * factor,
        extras=extras,
        blur=float(blur),
        covariance=covariance,
        moved=np.inf,
    )


def _bounding_box(state: _State, extent: float) -> Box:
    reach = np.sqrt((state.A**2).sum(axis=1)) * extent * MODEL_REACH * 1.02
    reach /= 1 - extent * MODEL_REACH * np.hypot(*state.extras[:2])
    reach += np.abs(state.extras[5] * (state.xy - state.middle)) * float(reach @ reach)
    low, high = np.floor(state.xy - reach).astype(int) - 1, np.ceil(state.xy + reach).astype(int) + 2
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _shape(state: _State) -> tuple[Float, float, Float]:
    """Return the bend, the ink gain, and by how much the lens moves points per square of their distance."""
    return state.extras[:2], float(state.extras[4]), state.extras[5] * (state.xy - state.middle)


def _step(state: _State, image: Float32, box: Box, drawing: Float32, extent: float, left: int, level: int) -> _State:
    """Measure the residuals of a state. If ``left`` > 0 calls are left after this one, also take a Gauss-Newton step.

    The last step of a patch also measures the covariance, see :func:`kpbench.fitting.covariance.centre_covariance`.
    """
    x, y, w, h = box
    rows, columns = image.shape
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + w, columns), min(y + h, rows)
    if x1 - x0 < 3 or y1 - y0 < 3:
        return state
    blur, crop = max(state.blur, 0.2), (slice(y0 - y, y1 - y), slice(x0 - x, x1 - x))
    ink, *moved = (
        cv2.GaussianBlur(plane, (0, 0), blur, borderType=cv2.BORDER_REPLICATE)[crop]
        for plane in (drawing if left else drawing[:1])
    )
    dx = np.arange(x0 - state.xy[0], x1 - state.xy[0] - 0.5).astype(np.float32)
    dy = np.arange(y0 - state.xy[1], y1 - state.xy[1] - 0.5).astype(np.float32)
    minor = max(float(short_semi_axis(state.window[None])[0]), 1e-6)
    reach = max(extent - (0.35 + MARGIN_BLURS * state.blur) / minor, 0.5)
    a, b, c, d = _inverse(state.window)
    inside = np.flatnonzero((a * dx + b * dy[:, None]) ** 2 + (c * dx + d * dy[:, None]) ** 2 < reach**2)
    if len(inside) < LEAST_PIXELS:
        return state
    row = inside // (x1 - x0)
    dx, dy = dx.take(inside - row * (x1 - x0)), dy.take(row)
    light_x, light_y, *uneven = state.extras[6:].astype(np.float32)
    by_blur = blur_derivatives(ink)
    grey = image[y0:y1, x0:x1].ravel().take(inside) / (1 + light_x * dx + light_y * dy)
    covered = (ink + uneven[0] * by_blur[1] + uneven[1] * by_blur[2]).ravel().take(inside)
    tone = float(state.extras[2]), float(state.extras[3])
    toned = tone_curve(covered, *tone)
    state, slope, residual = _measure(state, grey, toned)
    if not left or slope > -1:
        return state
    gradient = tuple(plane.ravel().take(inside) for plane in moved)
    edge = np.flatnonzero(gradient[0] ** 2 + gradient[1] ** 2 > 1e-4)  # only pixels on edges depend on the pose
    if len(edge) < LEAST_PIXELS:
        return state
    at = inside[edge]
    steep, *bends = tone_slopes(covered.take(edge), *tone)
    steep *= np.float32(slope)
    sloped = [steep * values.take(edge) for values in gradient]
    blurs = [steep * plane.ravel().take(at) for plane in by_blur]
    moves = _derivatives(state, slope, toned.take(edge), bends, sloped, blurs, dx.take(edge), dy.take(edge))
    # pixels that the model cannot explain, such as shadow edges, rain and occluders, get a smaller weight
    of_edges = residual.take(edge)
    size, half = np.abs(of_edges), len(edge) // 2
    usual = np.float32(2.5 * 1.48 * float(np.partition(size, half)[half]) + 1.0)
    weighted = moves * np.minimum(np.float32(1), usual / np.maximum(size, np.float32(1e-6)))
    normal, target = (weighted @ moves.T).astype(np.float64), (weighted @ of_edges).astype(np.float64)
    stepped, change, prior = _solve_step(state, normal, target, minor, extent, level, is_coarse=left >= FINE_STEPS)
    if left > 1 and stepped.moved > 1:
        return stepped
    grain = noise_grain(np.clip(residual, -usual, usual))
    covariance = centre_covariance(moves, weighted, of_edges, normal, change, prior, grain)
    return replace(stepped, covariance=covariance * max(1.0, _edge_width(stepped.blur) / _edge_width(state.blur)))


def _measure(state: _State, grey: Float32, toned: Float32) -> tuple[_State, float, Float32]:
    """Estimate the inks. Return the state with inks, correlation and noise, black minus white, and the residuals."""
    mean_ink, mean_grey = float(toned.mean()), float(grey.mean())
    centred_ink, centred_grey = toned - np.float32(mean_ink), grey - np.float32(mean_grey)
    slope = float(centred_ink @ centred_grey) / max(float(centred_ink @ centred_ink), 1e-6)
    residual = centred_grey - np.float32(slope) * centred_ink
    unexplained, spread = float(residual @ residual) / len(grey), float(centred_grey @ centred_grey) / len(grey)
    white = mean_grey - slope * mean_ink
    ncc = np.sqrt(max(0.0, 1 - unexplained / max(spread, 1e-9))) * (1 if slope < 0 else -1)
    noise = float(np.sqrt(unexplained * len(grey) / max(len(grey) - 9, 1)))
    return replace(state, black=white + slope, white=white, ncc=float(ncc), noise=noise), slope, residual


def _derivatives(
    state: _State,
    slope: float,
    toned: Float32,
    bends: list[Float32],
    sloped: list[Float32],
    blurs: list[Float32],
    dx: Float32,
    dy: Float32,
) -> Float32:
    """Return the derivatives (19, n) of n grey values with respect to the unknowns, as :func:`_solve_step` orders them.

    ``bends`` holds the derivatives of the ink with respect to the coefficients of the tone curve. ``sloped`` holds
    those of the grey values with respect to x, y and ink gain, ``blurs`` those with respect to the blur.
    ``dx``, ``dy`` are places relative to the centre, px.
    """
    a, b, c, d = _inverse(state.A)
    (u, v), (gx, gy, gain) = (a * dx + b * dy, c * dx + d * dy), sloped
    outward, (x, y) = gx * dx + gy * dy, (state.xy - state.middle).astype(np.float32)
    shade, k = np.float32(state.white) + np.float32(slope) * toned, np.float32(slope)
    moves = np.empty((UNKNOWNS, len(dx)), np.float32)
    moves[0], moves[1], moves[2], moves[3], moves[13] = 1.0, toned, gx, gy, gain
    products: tuple[tuple[Float32, Float32 | np.float32], ...] = (
        (gx, u),
        (gx, v),
        (gy, u),
        (gy, v),
        (outward, -u),
        (outward, -v),
        (bends[0], k),
        (bends[1], k),
    )
    lens = x * gx + y * gy, dx * dx + dy * dy
    moves[8], moves[17], moves[18] = blurs
    rows = (4, 5, 6, 7, 9, 10, 11, 12, 14, 15, 16)
    for row, (first, second) in zip(rows, (*products, lens, (shade, dx), (shade, dy)), strict=True):
        np.multiply(first, second, out=moves[row])
    return moves


def _edge_width(blur: float) -> float:
    """Return the standard deviation of an edge's profile, px. The variance of a centre is proportional to it."""
    return float(np.sqrt(blur**2 + PIXEL_VARIANCE))


def _inverse(m: Float) -> tuple[float, float, float, float]:
    """Return the inverse of a 2x2 matrix, row by row, many times faster than NumPy's general inverse."""
    (a, b), (c, d) = m.tolist()
    det = a * d - b * c or 1e-12
    return d / det, -b / det, -c / det, a / det


def _solve_step(
    state: _State, normal: Float, target: Float, minor: float, extent: float, level: int, *, is_coarse: bool
) -> tuple[_State, Float, Float]:
    """Solve the normal equations and take the step, within limits.

    The unknowns are white, black minus white, x, y, four entries of A, the square of the blur, and the extras. The
    priors are added to ``normal``.

    Returns
    -------
    stepped : _State
    change : ndarray of shape (19,)
        Change of the unknowns.
    prior : ndarray of shape (19,)
        What the priors add to the diagonal of ``normal``.
    """
    diagonal = normal.reshape(-1)[:: len(normal) + 1]
    diagonal[8] *= 1 + 1e-2
    diagonal[:9] += 1e-3
    bend, side, light = EXPECTED_BEND_PER_PX * minor, 2 * float(state.middle.max()) + 1, EXPECTED_LIGHT / minor
    expected = [bend, bend, EXPECTED_TONE, EXPECTED_TONE, EXPECTED_GAIN, EXPECTED_LENS / side**2, light, light]
    expected += [EXPECTED_UNEVEN_PX2 / 4.0**level] * 2
    reach = np.sqrt((state.window**2).sum(axis=1)).repeat(2)
    prior = (state.noise**2 + 1) / np.square([*EXPECTED_STRETCH * reach, *expected])
    if is_coarse:
        prior[FINE_PRIORS] *= 1e6
    diagonal[PRIOR_AT] += prior
    target[PRIOR_AT] -= prior * [*(state.A - state.window).ravel(), *state.extras]
    delta = np.linalg.solve(normal, target)
    shift = delta[2:4] * min(1.0, 0.3 * minor / max(float(np.hypot(*delta[2:4].tolist())), 1e-9))
    grow = delta[4:8] * min(1.0, 0.2 * minor / max(float(np.abs(delta[4:8]).max()), 1e-9))
    variance = state.blur**2
    widened = min(max(variance + float(delta[8]), LEAST_SHRINK * variance), LARGEST_GROWTH * (variance + 1))
    blur = float(np.sqrt(min(max(widened, 0.04), (0.5 * minor) ** 2)))
    limit = LARGEST_EXTRAS * [1, 1, 1, 1, 1, 1 / side**2, 1 / minor, 1 / minor, blur**2, blur**2]
    extras = np.minimum(np.maximum(state.extras + delta[-EXTRAS:], -limit), limit)
    # a stronger bend would put part of the model behind the camera
    extras[:2] *= min(1.0, 0.56 / (MODEL_REACH * extent * max(float(np.hypot(*extras[:2].tolist())), 1e-9)))
    moved = max(float(np.abs(shift).max()), float(np.abs(grow).max()))
    moved /= min(SETTLED_PX / 2.0**level, SETTLED_SHARE * minor)
    change = np.array([*delta[:2], *shift, *grow, blur**2 - variance, *(extras - state.extras)])
    stepped = replace(state, xy=state.xy + shift, A=state.A + grow.reshape(2, 2), extras=extras, blur=blur, moved=moved)
    return stepped, change, np.bincount(PRIOR_AT, prior).astype(np.float64)
