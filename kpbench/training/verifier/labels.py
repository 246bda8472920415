"""Labels of hypotheses: whether a hypothesis is right, and which correction turns its pose into the true pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.detectors.hypotheses import Hypotheses
from kpbench.detectors.verification import move_poses
from kpbench.fitting.templates import build_templates
from kpbench.patches.design import Patch
from kpbench.types import Float, Int

POSE_TOLERANCE, FIT_TOLERANCE = 0.2, 0.1
"""Largest distance between the centre of a right hypothesis and the keypoint, in long semi-axes: before the fit, and
after the fit."""
NEAR_RADII = 0.5
"""Largest distance between a hypothesis and its keypoint, in long semi-axes, at which a judge learns the pose."""
LARGEST_LOG_MAP = 1.0
"""Largest absolute value of an entry of the log map at which a judge learns the pose."""


def design_ids(hypotheses: Hypotheses, patches: Sequence[Patch]) -> Int:
    """Return the patch ID (n,) of each hypothesis."""
    return np.array([patch.patch_id for patch in patches])[hypotheses.design]


def mark_correct(xy: Float, patch_ids: Int, keypoints: NDArray[Any], tolerance: float) -> NDArray[np.bool_]:
    """Return whether each place (n, 2), px, is right.

    A right place has the patch ID of its nearest keypoint, and lies at most ``tolerance`` long semi-axes away from this
    keypoint.
    """
    if not len(keypoints):
        return np.zeros(len(xy), bool)
    nearest, distance = _nearest_keypoint(xy, keypoints)
    return np.asarray((distance <= tolerance) & (keypoints["patch_id"][nearest] == patch_ids))


def _nearest_keypoint(xy: Float, keypoints: NDArray[Any]) -> tuple[Int, Float]:
    """Return the index (n,) of the nearest keypoint of each place, and the distance (n,) to this keypoint.

    Distances are measured in long semi-axes of the keypoint.
    """
    distance = np.hypot(xy[:, :1] - keypoints["x"], xy[:, 1:] - keypoints["y"]) / keypoints["radius_major"]
    return distance.argmin(axis=1), distance.min(axis=1)


def label_hypotheses(
    hypotheses: Hypotheses, patches: Sequence[Patch], keypoints: NDArray[Any], tolerance: float
) -> NDArray[np.bool_]:
    """Return whether each hypothesis of an image is right.

    A right hypothesis lies within ``tolerance`` long semi-axes of its nearest keypoint and has the design of this
    keypoint. If several hypotheses of one place and one design fulfil both conditions, only the hypothesis whose
    rotation is nearest to the true rotation is right.
    """
    right = mark_correct(hypotheses.xy, design_ids(hypotheses, patches), keypoints, tolerance)
    rows = np.flatnonzero(right)
    if len(rows):
        own, _ = _nearest_keypoint(hypotheses.xy[rows], keypoints)
        relative = np.linalg.inv(hypotheses.A[rows]) @ affine_at_centre(keypoints["H_patch2image"][own])
        angle = np.arctan2(relative[:, 1, 0] - relative[:, 0, 1], relative[:, 0, 0] + relative[:, 1, 1])
        # a design that looks the same after half a turn has half as many templates as other designs, and its rotation
        # is known only up to half a turn
        rotations = np.bincount(build_templates(patches).whole.rotated_design)
        period = (2 * np.pi * rotations / rotations.max())[hypotheses.design[rows]]
        error = np.abs((angle + period / 2) % period - period / 2)
        order = np.lexsort((error, hypotheses.design[rows], hypotheses.place[rows]))
        key = np.column_stack([hypotheses.place[rows], hypotheses.design[rows]])[order]
        right[rows[order[1:][(key[1:] == key[:-1]).all(axis=1)]]] = False
    return right


def pose_errors(
    hypotheses: Hypotheses, patches: Sequence[Patch], keypoints: NDArray[Any]
) -> tuple[NDArray[np.bool_], Float, Float]:
    """Return the corrections that turn the poses of an image's hypotheses into the true poses.

    Returns
    -------
    near : ndarray of shape (n,), bool
        Whether a hypothesis has the design of its nearest keypoint and a pose near the true pose.
    shift, log_map : ndarray of shape (n, 2) and (n, 2, 2)
        Corrections, see :func:`kpbench.detectors.verification.move_poses`. Rows where ``near`` is false have no
        meaning.
    """
    shift, log_map = np.zeros((len(hypotheses), 2)), np.zeros((len(hypotheses), 2, 2))
    near = mark_correct(hypotheses.xy, design_ids(hypotheses, patches), keypoints, NEAR_RADII)
    if near.any():
        xy, A = hypotheses.xy[near], hypotheses.A[near]
        centres = np.column_stack([keypoints["x"], keypoints["y"]])
        own, _ = _nearest_keypoint(xy, keypoints)
        log_map[near] = log_ellipse(np.linalg.inv(A) @ affine_at_centre(keypoints["H_patch2image"][own]))
        _, true_A = move_poses(xy, A, shift[near], log_map[near])
        shift[near] = np.linalg.solve(true_A, (centres[own] - xy)[:, :, None])[:, :, 0]
        near[near] = np.abs(log_map[near]).max(axis=(1, 2)) < LARGEST_LOG_MAP
    return near, shift, log_map


def affine_at_centre(H: Float) -> Float:
    """Return the Jacobians (n, 2, 2) of homographies (n, 3, 3) at the origin."""
    return H[:, :2, :2] / H[:, 2:, 2:] - H[:, :2, 2:] @ H[:, 2:, :2] / H[:, 2:, 2:] ** 2


def log_ellipse(A: Float) -> Float:
    """Return the matrix logarithms (n, 2, 2) of symmetric maps S. S maps the unit circle to the same ellipse as A."""
    square, axes = np.linalg.eigh(A @ A.transpose(0, 2, 1))
    return np.asarray(np.einsum("nij,nj,nkj->nik", axes, 0.5 * np.log(square), axes))
