"""Bundle adjustment: lens, shape of the print and poses of all photographs, by robust least squares.

The parameters are those that all photographs share (camera, shape of the print) and six per photograph. Each photograph
contributes to the normal equations of the shared parameters after its pose is eliminated (the Schur complement; B.
Triggs et al., "Bundle adjustment - a modern synthesis", 2000, section 6.1). Damping is that of Levenberg and Marquardt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kpbench.calibration.marks import BoardPoints
from kpbench.calibration.projection import Projected, camera_values, project_points, turn, with_values
from kpbench.calibration.shape import SHAPE_NAMES, PrintShape
from kpbench.geometry.camera import Camera
from kpbench.types import Float

ROUNDS, MOST_STEPS = 4, 25
"""Number of times that weights are computed anew, and largest number of steps for each."""
HUBER = 2.0
"""Whitened error, in standard deviations, from which a point's weight falls."""
OUTLIER_SIGMAS = 5.0
"""Whitened error, in standard deviations of its photograph, from which a point is left out."""
LEAST_STEP_GAIN = 1e-7
"""Relative gain of a step below which a round ends."""
PHOTO_PRIOR = 20
"""Number of points with the noise of all photographs that count into the noise of each."""
MEDIAN_OF_SQUARES = 1.3863
"""Median of the squared length of a vector of two standard normal numbers, 2 log 2."""
PRINT_SIGMA, BOW_SIGMA = 0.01, 0.02
"""Prior standard deviations: ratio and skew of a print, and the sagitta of its bow in lengths of the board."""
PIXEL_SIGMA = 0.005
"""Prior standard deviation of fx / fy - 1."""
CENTRE_SIGMA = 0.1
"""Prior standard deviation of the principal point, in widths of the image."""
LEAST_REST = 0.05
"""Least part of what is known of a parameter that is taken to come from the other photographs."""
LENS_SIGMA = {"brown": (1.0, 4.0, 0.05, 0.05, 8.0, 1.0, 4.0, 8.0, 0.05, 0.05, 0.05, 0.05), "fisheye": (0.5,) * 4}
"""Prior standard deviations of the coefficients of a lens."""


@dataclass(frozen=True)
class PhotoPose:
    """The pose of a board in one photograph: ``X_camera = rotation @ X_board + translation_mm``."""

    rotation: Float
    translation_mm: Float

    def moved(self, step: Float) -> PhotoPose:
        """Return the pose after a left-multiplied rotation vector, rad, and a translation, mm, of shape (6,)."""
        return PhotoPose(turn(step[:3]) @ self.rotation, self.translation_mm + step[3:])


@dataclass(frozen=True)
class Bundle:
    """A solved set of photographs.

    Attributes
    ----------
    camera : Camera
    shape : PrintShape
    poses : tuple of PhotoPose
    points : tuple of BoardPoints
    inlier : tuple of ndarray of shape (n,), bool
        Which points of each photograph count.
    residual : tuple of ndarray of shape (n, 2)
        Seen minus projected, px.
    noise : ndarray of shape (photos,)
        Standard deviation of the whitened residuals of each photograph.
    covariance : ndarray of shape (C, C)
        Covariance of camera and shape, in the order of :func:`camera_values` and then :data:`SHAPE_NAMES`. Parameters
        that were not solved have zeros.
    """

    camera: Camera
    shape: PrintShape
    poses: tuple[PhotoPose, ...]
    points: tuple[BoardPoints, ...]
    inlier: tuple[NDArray[np.bool_], ...]
    residual: tuple[Float, ...] = field(repr=False)
    noise: Float = field(repr=False)
    covariance: Float = field(repr=False)

    def rms_px(self) -> Float:
        """Return the root mean square residual (per coordinate) of each photograph, ndarray of shape (photos,)."""
        parts = zip(self.residual, self.inlier, strict=True)
        return np.array([np.sqrt((r[k] ** 2).mean()) if k.any() else np.nan for r, k in parts])


def adjust_bundle(
    points: Sequence[BoardPoints],
    board_mm: Float,
    camera: Camera,
    poses: Sequence[PhotoPose],
    shape: PrintShape,
    *,
    solve_camera: bool = True,
    solve_shape: bool = True,
    rounds: int = ROUNDS,
) -> Bundle:
    """Solve camera, shape and poses together.

    Parameters
    ----------
    points : sequence of BoardPoints
        Points of each photograph.
    board_mm : ndarray of shape (N, 2)
        Places of the board's points as designed.
    camera, poses, shape
        Where the solution starts. What is not solved stays.
    solve_camera, solve_shape : bool
    rounds : int

    Returns
    -------
    Bundle
    """
    problem = _Problem.of(points, board_mm, camera, solve_camera, solve_shape)
    state = _State(camera, shape, tuple(poses))
    weights = [np.ones(len(p)) for p in points]
    keep, noise = [np.ones(len(p), bool) for p in points], np.ones(len(points))
    for n in range(rounds):
        state, _ = _minimise(problem, state, weights)
        error = problem.errors(state)
        keep, noise, weights = _weigh(error, is_first=n == 0)
    state, system = _minimise(problem, state, weights)
    covariance = _estimate_covariance(system, problem.active)
    residual = tuple(
        p.xy - project_points(state.camera, pose.rotation, pose.translation_mm, state.shape.bend(board_mm[p.index])).xy
        for p, pose in zip(points, state.poses, strict=True)
    )
    return Bundle(state.camera, state.shape, state.poses, tuple(points), tuple(keep), residual, noise, covariance)


@dataclass(frozen=True)
class _State:
    camera: Camera
    shape: PrintShape
    poses: tuple[PhotoPose, ...]

    def shared(self) -> Float:
        return np.concatenate([camera_values(self.camera), self.shape.values])

    def moved(self, step: Float, pose_steps: Float) -> _State:
        values = self.shared() + step
        count = len(values) - len(SHAPE_NAMES)
        camera = with_values(self.camera, values[:count]) if step[:count].any() else self.camera
        poses = tuple(pose.moved(s) for pose, s in zip(self.poses, pose_steps, strict=True))
        return _State(camera, PrintShape(*values[count:].tolist()), poses)


@dataclass(frozen=True)
class _Problem:
    """What does not change while a bundle is solved."""

    points: Sequence[BoardPoints]
    board_mm: Float
    whiten: list[Float]
    active: NDArray[np.bool_]
    start: Float
    prior: Float

    @classmethod
    def of(
        cls, points: Sequence[BoardPoints], board_mm: Float, camera: Camera, solve_camera: bool, solve_shape: bool
    ) -> _Problem:
        length = float(np.ptp(board_mm, axis=0).max())
        start = np.concatenate([camera_values(camera), np.zeros(len(SHAPE_NAMES))])
        lens = len(camera.distortion)
        start[2:4] = (camera.width_px - 1) / 2, (camera.height_px - 1) / 2
        start[4 : 4 + lens] = 0.0
        sigma = np.array([
            np.inf, np.inf, *[CENTRE_SIGMA * camera.width_px] * 2, *LENS_SIGMA[camera.model][:lens],
            PRINT_SIGMA, PRINT_SIGMA, *[8 * BOW_SIGMA / length] * 3,
        ])  # fmt: skip
        active = np.array([solve_camera] * (4 + lens) + [solve_shape] * len(SHAPE_NAMES))
        whiten = [np.linalg.inv(np.linalg.cholesky(p.covariance)) if len(p) else np.zeros((0, 2, 2)) for p in points]
        return cls(points, board_mm, whiten, active, start, 1 / sigma**2)

    def project(self, state: _State, n: int) -> Projected:
        pose = state.poses[n]
        bent = state.shape.bend(self.board_mm[self.points[n].index])
        return project_points(state.camera, pose.rotation, pose.translation_mm, bent)

    def errors(self, state: _State) -> list[Float]:
        """Return the length of each whitened error."""
        found = []
        for n, p in enumerate(self.points):
            error = np.einsum("nij,nj->ni", self.whiten[n], p.xy - self.project(state, n).xy)
            found.append(np.hypot(error[:, 0], error[:, 1]))
        return found

    def add_prior(self, state: _State, hessian: Float, gradient: Float) -> float:
        """Add the prior to the normal equations; return its cost."""
        values = state.shared()
        off = np.where(self.active, self.start - values, 0.0)
        off[:2] = 0.0
        hessian += np.diag(np.where(self.active, self.prior, 0.0))
        gradient += np.where(self.active, self.prior, 0.0) * off
        fx, fy = values[:2]
        row = np.zeros(len(values))
        row[:2] = np.array([1 / fx, -1 / fy]) / PIXEL_SIGMA
        excess = np.log(fx / fy) / PIXEL_SIGMA
        hessian += np.outer(row, row)
        gradient -= row * excess
        return float((self.prior * off * off).sum() + excess**2)


def _weigh(error: list[Float], is_first: bool) -> tuple[list[NDArray[np.bool_]], Float, list[Float]]:
    """Return which points count, the noise of each photograph, and the weight of each point."""
    own = np.array([np.sqrt(np.median(e**2) / MEDIAN_OF_SQUARES) if len(e) else 0.0 for e in error])
    count = np.array([len(e) for e in error])
    everyone = float(np.median(own[count > 0])) if (count > 0).any() else 1.0
    noise = np.sqrt((count * own**2 + PHOTO_PRIOR * everyone**2) / (count + PHOTO_PRIOR))
    noise = np.maximum(noise, 1e-3)
    keep = [e < OUTLIER_SIGMAS * s for e, s in zip(error, noise, strict=True)]
    weights = []
    for e, s, k in zip(error, noise, keep, strict=True):
        robust = np.minimum(1.0, HUBER * s / np.maximum(e, 1e-12))
        if is_first:  # far from the solution, every photograph weighs by its own errors
            robust = robust**2
        weights.append(np.where(k, robust, robust if is_first else 0.0) / s**2)
    return keep, noise, weights


def _minimise(problem: _Problem, state: _State, weights: list[Float]) -> tuple[_State, _System]:
    """Return the state of least cost, and the normal equations there."""
    damping = 1e-4
    system = _build(problem, state, weights)
    for _ in range(MOST_STEPS):
        step, pose_steps = system.solve(damping, problem.active)
        moved = state.moved(step, pose_steps)
        cost = _cost(problem, moved, weights)
        if not np.isfinite(cost) or cost > system.cost:
            damping *= 10
            if damping > 1e8:
                break
            continue
        gain = system.cost - cost
        state, damping = moved, max(damping / 10, 1e-9)
        system = _build(problem, state, weights)
        if gain < LEAST_STEP_GAIN * cost:
            break
    return state, system


def _cost(problem: _Problem, state: _State, weights: list[Float]) -> float:
    size = len(problem.prior)
    if min(camera_values(state.camera)[:2]) <= 0:
        return np.inf
    with np.errstate(all="ignore"):  # a step that is much too long
        prior = problem.add_prior(state, np.zeros((size, size)), np.zeros(size))
        return prior + sum(float((w * e * e).sum()) for w, e in zip(weights, problem.errors(state), strict=True))


@dataclass(frozen=True)
class _System:
    """Normal equations: those of the shared parameters, and of each photograph."""

    hessian: Float
    gradient: Float
    photo_hessian: Float
    """Contribution of each photograph to ``hessian``, of shape (photos, C, C)."""
    photo_gradient: Float
    """Contribution of each photograph to ``gradient``, of shape (photos, C)."""
    cross: Float
    """Of shape (photos, C, 6)."""
    of_pose: Float
    """Of shape (photos, 6, 6)."""
    pose_gradient: Float
    cost: float

    def reduced(self, damping: float) -> tuple[Float, Float, Float]:
        """Return the Schur complement, its right side, and the inverses of the blocks of the poses."""
        damped = self.of_pose * (1 + damping * np.eye(6)) + 1e-12 * np.eye(6)
        inverse = np.linalg.inv(damped)
        through = self.cross @ inverse
        hessian = self.hessian * (1 + damping * np.eye(len(self.hessian))) - np.einsum(
            "nij,nkj->ik", through, self.cross
        )
        gradient = self.gradient - np.einsum("nij,nj->i", through, self.pose_gradient)
        return np.asarray(hessian), np.asarray(gradient), np.asarray(inverse, np.float64)

    def solve(self, damping: float, active: NDArray[np.bool_]) -> tuple[Float, Float]:
        hessian, gradient, inverse = self.reduced(damping)
        step = np.zeros(len(gradient))
        if active.any():
            rows = np.flatnonzero(active)
            scale = 1 / np.sqrt(np.maximum(np.diag(self.hessian)[rows], 1e-300))
            scaled = hessian[np.ix_(rows, rows)] * scale[:, None] * scale
            step[rows] = scale * np.linalg.lstsq(scaled, scale * gradient[rows], rcond=1e-14)[0]
        rest = self.pose_gradient - np.einsum("nij,i->nj", self.cross, step)
        return step, np.einsum("nij,nj->ni", inverse, rest)


def _build(problem: _Problem, state: _State, weights: list[Float]) -> _System:
    size, photos = len(problem.prior), len(problem.points)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    photo_hessian, photo_gradient = np.zeros((photos, size, size)), np.zeros((photos, size))
    cross, of_pose, pose_gradient = np.zeros((photos, size, 6)), np.zeros((photos, 6, 6)), np.zeros((photos, 6))
    cost = problem.add_prior(state, hessian, gradient)
    for n, p in enumerate(problem.points):
        seen = problem.project(state, n)
        whiten = problem.whiten[n] * np.sqrt(weights[n])[:, None, None]
        error = np.einsum("nij,nj->ni", whiten, p.xy - seen.xy).ravel()
        shared = (whiten @ np.concatenate([seen.by_camera, seen.by_shape], axis=2)).reshape(-1, size)
        pose = (whiten @ seen.by_pose).reshape(-1, 6)
        photo_hessian[n] = shared.T @ shared
        hessian += photo_hessian[n]
        photo_gradient[n] = shared.T @ error
        gradient += photo_gradient[n]
        cross[n], of_pose[n], pose_gradient[n] = shared.T @ pose, pose.T @ pose, pose.T @ error
        cost += float(error @ error)
    return _System(hessian, gradient, photo_hessian, photo_gradient, cross, of_pose, pose_gradient, cost)


def _estimate_covariance(system: _System, active: NDArray[np.bool_]) -> Float:
    """Return the covariance of the shared parameters, ndarray of shape (C, C).

    The inverse of the normal matrix is right if all errors are independent. Errors of one photograph are not, if lens
    or paper bend in a way that the model does not have. The gradients of the photographs then scatter more than they
    should (clusters in the bias-reduced linearization of R. M. Bell, D. F. McCaffrey, *Survey Methodology* 28, 2002).
    The covariance grows to their mean scatter, and to half of their scatter in each direction.
    """
    rows = np.flatnonzero(active)
    covariance = np.zeros((len(active), len(active)))
    if not len(rows):
        return covariance
    hessian, _, inverse = system.reduced(0.0)
    hessian = hessian[np.ix_(rows, rows)]
    scale = 1 / np.sqrt(np.diag(hessian))
    values, vectors = np.linalg.eigh(hessian * scale[:, None] * scale)
    root = scale[:, None] * vectors / np.sqrt(np.maximum(values, 1e-14 * values.max()))  # root rootᵀ is the inverse
    through = np.einsum("nij,njk->nik", system.cross, inverse)
    of_photos = (system.photo_gradient - np.einsum("nij,nj->ni", through, system.pose_gradient))[:, rows]
    own = system.photo_hessian[:, rows][:, :, rows]
    own = own - np.einsum("nij,nkj->nik", through[:, rows], system.cross[:, rows])
    own = root.T @ own @ root
    shares, axes = np.linalg.eigh(own)
    unbiased = np.einsum("nij,nj,nkj->nik", axes, 1 / np.sqrt(np.maximum(1 - shares, LEAST_REST)), axes)
    step = np.einsum("nij,nj->ni", unbiased, of_photos @ root)
    scatter, directions = np.linalg.eigh(step.T @ step)
    growth = np.maximum(scatter / 2, max(1.0, float(scatter.mean())))
    root = root @ directions
    covariance[np.ix_(rows, rows)] = root * growth @ root.T
    return covariance
