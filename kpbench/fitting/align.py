"""Affine poses of designs, rotated and moved until templates and image agree.

:func:`rotate_within_ellipse` finds the rotation of a design whose ellipse in the image is known. :func:`align_poses`
moves poses onto the image by inverse compositional Gauss-Newton steps (Baker and Matthews, *Lucas-Kanade 20 years on*,
IJCV 2004).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.fitting.pyramid import (
    LEAST_DEVIATION,
    choose_level,
    find_samples_outside,
    normalise_rows,
    sample_pyramid,
)
from kpbench.fitting.templates import DesignTemplates, Templates
from kpbench.types import Float, Float32, Int

DISTINCT_NCC = 0.5
"""Two rotations of a design are distinct if their templates correlate by less than this."""
SIZE_FACTORS = (1.0, 0.8, 0.9, 1.1)
"""Factors by which the given size of an ellipse is multiplied. Rings or the ground may have biased the given size."""
WHOLE_RADIUS_PX = 5.6
"""A whole design is compared in the coarsest pyramid level in which its short semi-axis is at least this many px."""
LARGEST_STEP = 0.35
"""Largest change of a parameter in one Gauss-Newton step; a longer step is shortened."""


@dataclass(frozen=True)
class Poses:
    """N poses of designs.

    Attributes
    ----------
    xy : ndarray of shape (N, 2)
        Centres, px.
    A : ndarray of shape (N, 2, 2)
        Map from the frame of the template to px.
    design : ndarray of shape (N,), int64
        Index of the design.
    ncc : ndarray of shape (N,)
        Correlation of template and image, in [-1, 1].
    """

    xy: Float
    A: Float
    design: Int
    ncc: Float

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, keep: Any) -> Poses:
        return Poses(self.xy[keep], self.A[keep], self.design[keep], self.ncc[keep])


def short_semi_axis(A: Float) -> Float:
    """Return the short semi-axes (N,) of the ellipses to which maps (N, 2, 2) take the unit circle.

    The short semi-axis is the smaller singular value of A: √((s − √(s² − 4d²)) / 2), with the trace s of AᵀA and the
    determinant d of A.
    """
    a, b, c, d = A.reshape(-1, 4).T
    square, det = a * a + b * b + c * c + d * d, a * d - b * c
    return np.asarray(np.sqrt(np.maximum(square - np.sqrt(np.maximum(square**2 - 4 * det**2, 0)), 0) / 2))


def rotate_within_ellipse(
    levels: Sequence[Float32], xy: Float, A: Float, templates: DesignTemplates
) -> tuple[Int, Poses]:
    """Find the two designs and rotations within an ellipse that agree best with the image.

    The second pose has another design or a distinct rotation, see ``DISTINCT_NCC``.

    Parameters
    ----------
    levels : list of ndarray
        From :func:`kpbench.fitting.pyramid.build_pyramid`.
    xy, A : ndarray of shape (N, 2) and (N, 2, 2)
        Ellipses, px: the images of the unit circle.
    templates : DesignTemplates

    Returns
    -------
    row : ndarray of shape (M,), int64
        Index of each pose's ellipse, ascending. Each ellipse occurs once or twice.
    poses : Poses
        M poses.
    """
    whole = templates.whole
    by_size = np.stack([_correlate_rotations(levels, xy, factor * A, whole) for factor in SIZE_FACTORS])
    ncc, size = by_size.max(axis=0), np.array(SIZE_FACTORS)[by_size.argmax(axis=0)]
    first, every = ncc.argmax(axis=1), np.arange(len(xy))
    other = (whole.rotated @ whole.rotated.T < DISTINCT_NCC) | (whole.rotated_design[:, None] != whole.rotated_design)
    second = np.where(other[first], ncc, -np.inf).argmax(axis=1)
    is_other = other[first, second]
    row = np.concatenate([every, every[is_other]])
    order = np.argsort(row, kind="stable")
    row, rotation = row[order], np.concatenate([first, second[is_other]])[order]
    sized = size[row, rotation][:, None, None] * A[row]
    return row, rotate_poses(xy[row], sized, whole.rotated_design[rotation], rotation, ncc[row], whole)


def _correlate_rotations(levels: Sequence[Float32], xy: Float, A: Float, whole: Templates) -> Float32:
    """Return the correlations (N, R) of N ellipses with all R rotations of all designs."""
    values = sample_pyramid(levels, choose_level(short_semi_axis(A), WHOLE_RADIUS_PX, levels), xy, A, whole.points)
    ncc = normalise_rows(values) @ whole.rotated.T
    cut, outside = find_samples_outside(levels[0], xy, A, whole.points)
    ncc[cut] = _correlate_inside(values[cut], ~outside, whole.rotated)
    return np.asarray(ncc, np.float32)


def rotate_poses(xy: Float, A: Float, design: Int, rotation: Int, ncc: Float32, templates: Templates) -> Poses:
    """Return poses rotated within their ellipses, each with its correlation.

    Parameters
    ----------
    xy, A, design : ndarray
        N poses before the rotation, see :class:`Poses`.
    rotation : ndarray of shape (N,), int64
        Index of the rotation among ``templates.rotated``.
    ncc : ndarray of shape (N, R)
        Correlations with all rotations.
    templates : Templates
    """
    angle = templates.rotated_angle[rotation]
    c, s = np.cos(angle), np.sin(angle)
    rotated_A = A @ np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
    return Poses(xy, rotated_A, design, ncc[np.arange(len(rotation)), rotation].astype(np.float64))


def _correlate_inside(values: Float32, inside: NDArray[np.bool_], inks: Float32) -> Float32:
    """Return the correlations (N, R) of grey values (N, M) with inks (R, M), over the samples inside the image."""
    count = np.maximum(inside.sum(axis=1, keepdims=True), 1)
    grey = np.where(inside, values - (values * inside).sum(axis=1, keepdims=True) / count, 0)
    mask = inside.astype(np.float32)
    size = np.einsum("nm,nm->n", grey, grey)[:, None] + LEAST_DEVIATION**2 * count
    spread = mask @ (inks**2).T - (mask @ inks.T) ** 2 / count
    return np.asarray(grey @ inks.T / np.sqrt(size * np.maximum(spread, 1e-3)), np.float32)


def align_poses(levels: Sequence[Float32], poses: Poses, templates: Templates, steps: int, radius_px: float) -> Poses:
    """Move poses onto the image by Gauss-Newton steps.

    Parameters
    ----------
    levels : list of ndarray
        From :func:`kpbench.fitting.pyramid.build_pyramid`.
    poses : Poses
        ``A`` maps the unit circle of the templates to the image.
    templates : Templates
        ``DesignTemplates.core`` or ``DesignTemplates.whole``.
    steps : int
        Number of steps. With 0 steps, only the correlation is measured.
    radius_px : float
        A pose is compared in the coarsest level in which its short semi-axis is at least this many px.

    Returns
    -------
    Poses
        The moved poses, with the correlations after the last step.
    """
    xy, A, design = poses.xy, poses.A, poses.design
    ink, solve, has_size = templates.ink[design], templates.solve[design], templates.has_size[design]
    for step in range(steps + 1):
        values = sample_pyramid(levels, choose_level(short_semi_axis(A), radius_px, levels), xy, A, templates.points)
        ncc, residual = _compare(values, ink, *find_samples_outside(levels[0], xy, A, templates.points))
        if step == steps:
            break
        delta = np.matmul(solve, residual[..., None])[..., 0].astype(np.float64)
        delta *= np.minimum(1.0, LARGEST_STEP / np.maximum(np.abs(delta).max(axis=1), 1e-9))[:, None]
        stepped = A @ np.linalg.inv(np.eye(2) + delta[:, 2:].reshape(-1, 2, 2))
        # sectors look the same at every size, so a step in size would only fit the blur; the size is kept instead
        kept_size = short_semi_axis(A) / np.maximum(short_semi_axis(stepped), 1e-9)
        A = stepped * np.where(has_size, 1.0, kept_size)[:, None, None]
        xy = xy - np.einsum("nij,nj->ni", A, delta[:, :2])
    return Poses(xy, A, design, ncc.astype(np.float64))


def _compare(values: Float32, ink: Float32, cut: Int, outside: NDArray[np.bool_]) -> tuple[Float32, Float32]:
    """Return the correlations (N,) of grey values with templates, and the residuals (N, M).

    A residual is the grey value minus the template, after the grey values have been shifted and scaled to the template.
    The rows ``cut`` have samples outside the image. These samples do not count in the correlation, and their residual
    is 0.
    """
    scaled = normalise_rows(values)
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
        spread += LEAST_DEVIATION**2 * count[:, 0]
        # if less than half of a pattern's samples lie in the image, a high correlation proves little, so it is lowered
        ncc[cut] = slope * np.sqrt(size / spread) * np.minimum(1, 2 * count[:, 0] / inside.shape[1])
        residual[cut] = np.where(inside, grey / np.maximum(slope, 0.3 * np.sqrt(spread))[:, None] - model, 0)
    return ncc, residual
