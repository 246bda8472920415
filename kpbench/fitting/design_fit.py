"""The design fit: centre, pose, inks and blur of a patch, estimated from the pixels.

:func:`fit` renders the design with exact coverage, blurs the rendering, and changes the unknowns until rendering and
pixels agree (Gauss-Newton with robust weights). The unknowns are the centre, the affine map, the perspective, both
inks, the blur and the tone curve. :mod:`kpbench.fitting.sector_search` and :mod:`kpbench.fitting.align` find poses to
start from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import cv2
import numpy as np

from kpbench.fitting.align import short_semi_axis
from kpbench.fitting.covariance import LEVEL_GRAIN, PIXEL_VARIANCE, centre_covariance, richer_columns, start_covariance
from kpbench.geometry.coverage import Box, rasterise
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32

COARSE_PX, COARSE_STEPS = 30.0, 2
"""The first ``COARSE_STEPS`` steps use the finest pyramid level in which the patch's long semi-axis, with rim and quiet
zone, is at most ``COARSE_PX`` px."""
FINE_PX, FINE_STEPS = 100.0, 4
"""The last ``FINE_STEPS`` steps use the finest pyramid level in which this semi-axis is at most ``FINE_PX`` px."""
SETTLED_STEP = 0.002
"""If a step changes centre and map by at most this, in short semi-axes, no further step is taken in the same level."""
LEVEL_BLUR_PX = 0.6
"""Standard deviation of the pyramid's own blur in every level but level 0, px of the level."""
MODEL_REACH = 1.3
"""The model draws the outermost ring up to this many times its outer radius. The blurred outer edge of the model then
lies outside the patch."""
EXPECTED_BEND_PER_PX = 1 / 400
"""Prior of the perspective. Each entry of ``_State.bend`` has the standard deviation ``EXPECTED_BEND_PER_PX`` times the
short semi-axis in px."""
EXPECTED_TONE = 0.25
"""Prior of the tone curve: the standard deviation of both coefficients of ``_State.tone``."""
LARGEST_TONE = np.array([1.5, 1.0])
"""Largest size of the two coefficients. With larger ones, the curve falls."""
MARGIN_BLURS = 1.6
"""Width of the rim that is left out, in standard deviations of the blur: the ground shines into the blurred rim."""
LEAST_PIXELS = 12
"""A step needs at least this many pixels inside the patch, and at least this many pixels on edges."""


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
    covariance = start_covariance(A)
    states = [_State(xy[n], A[n], A[n], np.zeros(2), 0.5, covariance=covariance[n]) for n in range(len(patches))]
    for largest_px, steps in ((COARSE_PX, COARSE_STEPS), (FINE_PX, FINE_STEPS)):
        octave = np.ceil(np.log2(np.maximum(size, 1e-6) / largest_px))
        level = np.clip(octave, 0, len(levels) - 1).astype(np.int64).tolist()
        states = [_scale_state(state, -n) for state, n in zip(states, level, strict=True)]
        for step in range(steps):
            live = [n for n, state in enumerate(states) if state.moved > SETTLED_STEP]
            boxes = [_bounding_box(states[n], patches[n].extent) for n in live]
            covers = rasterise([_black_polygons(states[n], patches[n]) for n in live], boxes)
            for n, box, cover in zip(live, boxes, covers, strict=True):
                left = steps - 1 - step if largest_px == FINE_PX else FINE_STEPS
                image, grain = levels[level[n]], LEVEL_GRAIN if level[n] else 1.0
                states[n] = _step(states[n], image, box, cover, patches[n].extent, left, grain)
        states = [_scale_state(state, n) for state, n in zip(states, level, strict=True)]
    columns = [np.array([getattr(s, name) for s in states]) for name in ("black", "white", "blur", "ncc", "noise")]
    xy, A, C = (np.array([getattr(s, name) for s in states]) for name in ("xy", "A", "covariance"))
    black, white, blur, ncc, noise = columns
    return Fit(xy.reshape(-1, 2), A.reshape(-1, 2, 2), black, white, blur, ncc, noise, C.reshape(-1, 2, 2))


@dataclass(frozen=True)
class _State:
    """One patch during the fit, in px of the pyramid level.

    ``window`` is the map that the fit started from. A pixel counts if this map, centred at ``xy``, places the pixel in
    the patch, further from the patch's edge than a margin. ``bend`` holds the first two entries of the last row of the
    homography. ``moved`` is the size of the last step, in short semi-axes. ``tone`` holds the coefficients (a, b) of
    the tone curve, see :func:`_tone_curve`.
    """

    xy: Float
    A: Float
    window: Float
    bend: Float
    blur: float
    black: float = 0.0
    white: float = 0.0
    ncc: float = 0.0
    noise: float = np.inf
    covariance: Float = field(default_factory=lambda: np.zeros((2, 2)))
    moved: float = np.inf
    tone: tuple[float, float] = (0.0, 0.0)


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
    return replace(state, xy=xy, A=A, window=window, blur=float(blur), covariance=covariance, moved=np.inf)


def _bounding_box(state: _State, extent: float) -> Box:
    reach = np.sqrt((state.A**2).sum(axis=1)) * extent * MODEL_REACH * 1.02
    reach /= 1 - extent * MODEL_REACH * np.hypot(*state.bend)
    low, high = np.floor(state.xy - reach).astype(int) - 1, np.ceil(state.xy + reach).astype(int) + 2
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _black_polygons(state: _State, patch: Patch) -> list[Float]:
    """Return the black cells of a design as polygons in the image, px."""
    radius = max(float(np.abs(state.A).max()), 1.0)
    cells = _black_cells(patch, 2.0 ** np.floor(np.log2(0.02 / radius)))
    return [state.xy + p @ state.A.T / (1 + p @ state.bend)[:, None] for p in cells]


@lru_cache(maxsize=256)
def _black_cells(patch: Patch, tolerance: float) -> tuple[Float, ...]:
    """Return the black cells of a design as polygons in the patch frame.

    The cells may stay separate: their coverages are added, so touching cells leave no seam. ``tolerance`` is the
    largest distance between an arc and its polygon, in disc radii.
    """
    radii, angles, black = patch.cells
    radii = np.append(radii[:-1], radii[-1] * MODEL_REACH)
    width = np.diff(np.append(angles, angles[0] + 360.0))
    polygons = []
    for i, j in zip(*np.nonzero(black), strict=True):
        count = int(np.ceil(np.radians(width[j]) / np.sqrt(8 * tolerance / radii[i + 1]))) + 1
        angle = np.radians(angles[j] + width[j] * np.linspace(0, 1, count + 1))
        arc = np.column_stack([np.cos(angle), np.sin(angle)])
        polygons.append(np.concatenate([radii[i + 1] * arc, radii[i] * (arc[::-1] if radii[i] else np.zeros((1, 2)))]))
    return tuple(polygons)


def _step(
    state: _State, image: Float32, box: Box, cover: Float, extent: float, left: int, grain: float = 1.0
) -> _State:
    """Measure the residuals of a state. If ``left`` > 0 calls are left after this one, also take a Gauss-Newton step.

    The last step of a patch also measures the covariance, with noise of this ``grain``, see
    :func:`kpbench.fitting.covariance.centre_covariance`.
    """
    x, y, w, h = box
    rows, columns = image.shape
    x0, y0, x1, y1 = max(x, 0), max(y, 0), min(x + w, columns), min(y + h, rows)
    if x1 - x0 < 3 or y1 - y0 < 3:
        return state
    blur = max(state.blur, 0.2)
    ink: Float32 = np.asarray(cv2.GaussianBlur(cover.astype(np.float32), (0, 0), blur, borderType=cv2.BORDER_REPLICATE))
    ink = ink[y0 - y : y1 - y, x0 - x : x1 - x]
    dx, dy = np.arange(x0, x1) - state.xy[0], np.arange(y0, y1)[:, None] - state.xy[1]
    minor = max(float(short_semi_axis(state.window[None])[0]), 1e-6)
    reach = max(extent - (0.35 + MARGIN_BLURS * state.blur) / minor, 0.5)
    a, b, c, d = _inverse(state.window)
    inside = np.flatnonzero((a * dx + b * dy) ** 2 + (c * dx + d * dy) ** 2 < reach**2)
    grey, m = image[y0:y1, x0:x1].ravel()[inside], ink.ravel()[inside]
    if len(m) < LEAST_PIXELS:
        return state
    toned, steep, even, odd = _tone_curve(m, *state.tone)
    mean_ink, mean_grey = float(toned.mean()), float(grey.mean())
    centred_ink, centred_grey = toned - np.float32(mean_ink), grey - np.float32(mean_grey)
    slope = float(centred_ink @ centred_grey) / max(float(centred_ink @ centred_ink), 1e-6)
    residual = centred_grey - np.float32(slope) * centred_ink
    unexplained, spread = float(residual @ residual) / len(m), float(centred_grey @ centred_grey) / len(m)
    white = mean_grey - slope * mean_ink
    ncc = np.sqrt(max(0.0, 1 - unexplained / max(spread, 1e-9))) * (1 if slope < 0 else -1)
    noise = float(np.sqrt(unexplained * len(m) / max(len(m) - 9, 1)))
    state = replace(state, black=white + slope, white=white, ncc=float(ncc), noise=noise)
    if not left or slope > -1:
        return state
    gx, gy = (cv2.Sobel(ink, cv2.CV_32F, *axis, ksize=1, scale=0.5).ravel()[inside] for axis in ((1, 0), (0, 1)))
    edge = np.flatnonzero(gx * gx + gy * gy > 1e-4)  # only pixels on edges depend on the pose
    if len(edge) < LEAST_PIXELS:
        return state
    at = inside[edge]
    at_y = at // (x1 - x0)
    laplace, steep = cv2.Laplacian(ink, cv2.CV_32F).ravel()[at], steep[edge]
    gx, gy, laplace = steep * gx[edge], steep * gy[edge], steep * laplace
    dx, dy = dx[at - at_y * (x1 - x0)], dy[at_y, 0]
    m, residual, even, odd = toned[edge], residual[edge], even[edge], odd[edge]
    a, b, c, d = _inverse(state.A)
    u, v, outward = a * dx + b * dy, c * dx + d * dy, gx * dx + gy * dy
    left_x, left_y = -gx, -gy
    shifts = (left_x, left_y, left_x * u, left_x * v, left_y * u, left_y * v, outward * u, outward * v)
    moves = np.empty((13, len(m)))
    moves[0], moves[1] = 1.0, m
    for row, derivative in enumerate((*shifts, laplace / 2, even, odd), start=2):
        np.multiply(derivative, slope, out=moves[row])
    # pixels that the model cannot explain, such as shadow edges, rain and occluders, get a smaller weight
    size, half = np.abs(residual), len(residual) // 2
    usual = 2.5 * 1.48 * float(np.partition(size, half)[half]) + 1.0
    weighted = moves * np.minimum(1.0, usual / np.maximum(size, 1e-6))
    normal = weighted @ moves.T
    stepped, change = _solve_step(state, normal, weighted @ residual, minor, extent)
    if left > 1 and stepped.moved > SETTLED_STEP:
        return stepped
    richer = richer_columns(ink, at, white + slope * m, slope * steep, u, v)
    covariance = centre_covariance(moves, weighted, residual, normal, change, richer, grain)
    return replace(stepped, covariance=covariance * max(1.0, _edge_width(stepped.blur) / _edge_width(state.blur)))


def _edge_width(blur: float) -> float:
    """Return the standard deviation of an edge's profile, px. The variance of a centre is proportional to it."""
    return float(np.sqrt(blur**2 + PIXEL_VARIANCE))


def _tone_curve(ink: Float32, a: float, b: float) -> tuple[Float32, Float32, Float32, Float32]:
    """Return how black pixels look behind a tone curve, and the slope of the curve.

    Light is blurred before a camera's tone curve. So a pixel that black ink covers by half is darker or brighter than
    the mean of the inks. Between the inks, the curve is ``ink + a ink (1 - ink) + b ink (1 - ink) (1 - 2 ink)``: any
    smooth curve that keeps both inks, to third order. Ink that spreads has nearly the same effect as ``a``.

    Returns
    -------
    toned, slope, even, odd : ndarray of the shape of ``ink``
        The curve, its slope, and its derivatives with respect to ``a`` and ``b``.
    """
    even = ink * (1 - ink)
    bent = 1 - 2 * ink
    odd = even * bent
    toned = ink + np.float32(a) * even + np.float32(b) * odd
    slope = 1 + np.float32(a) * bent + np.float32(b) * (1 - 6 * even)
    return toned, slope, even, odd


def _inverse(m: Float) -> tuple[float, float, float, float]:
    """Return the inverse of a 2x2 matrix, row by row, many times faster than NumPy's general inverse."""
    (a, b), (c, d) = m.tolist()
    det = a * d - b * c or 1e-12
    return d / det, -b / det, -c / det, a / det


def _solve_step(state: _State, normal: Float, target: Float, minor: float, extent: float) -> tuple[_State, Float]:
    """Solve the normal equations and take the step, within limits. Return the new state and the change of the unknowns.

    The priors are added to ``normal``.

    The unknowns are white, black minus white, x, y, four entries of A, two entries of the bend, the square of the blur,
    and the two coefficients of the tone curve.
    """
    # the pixels of a design of sectors alone do not determine its size and some stretches, so damping holds them
    diagonal = normal.reshape(-1)[:: len(normal) + 1]
    diagonal[4:11] += 1e-3 * diagonal[4:11] + 1e-3
    diagonal[:4] += 1e-3
    tone = np.array(state.tone)
    prior = (state.noise**2 + 1) / (EXPECTED_BEND_PER_PX * minor) ** 2
    diagonal[8:10] += prior
    target[8:10] -= prior * state.bend
    prior = (state.noise**2 + 1) / EXPECTED_TONE**2
    diagonal[11:13] += prior
    target[11:13] -= prior * tone
    delta = np.linalg.solve(normal, target)
    shift = delta[2:4] * min(1.0, 0.3 * minor / max(float(np.hypot(*delta[2:4].tolist())), 1e-9))
    grow = delta[4:8] * min(1.0, 0.2 * minor / max(float(np.abs(delta[4:8]).max()), 1e-9))
    widened = state.blur**2 + min(max(float(delta[10]), -1.0), 1.0)
    blur = float(np.sqrt(min(max(widened, 0.04), (0.5 * minor) ** 2)))
    bend = np.minimum(np.maximum(state.bend + delta[8:10], -0.3), 0.3)
    # a stronger bend would put part of the model behind the camera
    bend *= min(1.0, 0.56 / (MODEL_REACH * extent * max(float(np.hypot(*bend.tolist())), 1e-9)))
    tone = np.minimum(np.maximum(tone + delta[11:13], -LARGEST_TONE), LARGEST_TONE)
    moved = max(float(np.abs(shift).max()), float(np.abs(grow).max())) / minor
    turned = grow.reshape(2, 2)
    a, b = tone.tolist()
    change = np.array([*delta[:2], *shift, *grow, *(bend - state.bend), blur**2 - state.blur**2, *(tone - state.tone)])
    stepped = replace(state, xy=state.xy + shift, A=state.A + turned, bend=bend, blur=blur, moved=moved, tone=(a, b))
    return stepped, change
