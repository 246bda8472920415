"""Move poses of designs onto the image.

Inverse compositional Gauss-Newton: Baker and Matthews, *Lucas-Kanade 20 years on*, IJCV 2004.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.fitting.pyramid import FLOOR, coarsest_level, normalise, outside_image, sample
from kpbench.fitting.templates import Bank, Templates
from kpbench.types import Float, Float32, Int

AS_LIKELY, UNLIKE = 0.15, 0.5
"""How much less a second rotation may correlate with the image, and how little it must with the best one."""


SIZES = (0.8, 0.9, 1.1)
"""Other sizes of an ellipse in which its design is turned: rings, and what lies around, make it too large or small."""


WHOLE_PX = 5.6
"""The whole design is compared in the coarsest level in which its short semi-axis measures as much."""


@dataclass(frozen=True)
class Poses:
    """N hypotheses: ``xy`` (N, 2) px, ``A`` (N, 2, 2) px, ``which`` (N,) index of the design, ``ncc`` (N,)."""

    xy: Float
    A: Float
    which: Int
    ncc: Float

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, keep: Any) -> Poses:
        return Poses(self.xy[keep], self.A[keep], self.which[keep], self.ncc[keep])


def short_axis(A: Float) -> Float:
    """Short semi-axis of the image of the unit circle: the smaller singular value of (N, 2, 2)."""
    square = np.einsum("nij,nij->n", A, A)
    det = np.abs(A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0])
    return np.asarray(np.sqrt(np.maximum(square - np.sqrt(np.maximum(square**2 - 4 * det**2, 0)), 0) / 2))


def rotate_within_ellipse(
    levels: Sequence[Float32], xy: Float, A: Float, which: Int, known: Bank, twice: NDArray[np.bool_] | None = None
) -> tuple[Int, Poses]:
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


def _turns(levels: Sequence[Float32], xy: Float, A: Float, which: Int, whole: Templates) -> Float32:
    """Correlations (N, R) of ellipses with all rotations; -inf for those of other designs than ``which``."""
    values = sample(levels, coarsest_level(short_axis(A), WHOLE_PX, levels), xy, A, whole.points)
    ncc = normalise(values) @ whole.turned.T
    cut, outside = outside_image(levels[0], xy, A, whole.points)
    ncc[cut] = _partial_ncc(values[cut], ~outside, whole.turned)
    ncc[whole.turned_which != which[:, None]] = -np.inf
    return ncc


def rotated(xy: Float, A: Float, which: Int, turned: Int, ncc: Float32, templates: Templates) -> Poses:
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


def _compare(values: Float32, ink: Float32, cut: Int, outside: NDArray[np.bool_]) -> tuple[Float32, Float32]:
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
