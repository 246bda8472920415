"""Poses of boards: rotation and translation from a match, with their covariance and the second solution of a plane."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kpbench.boards.frames import Frames, fit_homography, frame_errors, straighten
from kpbench.boards.matching import BoardMatch
from kpbench.errors import DataError
from kpbench.geometry.camera import Camera
from kpbench.types import Float

LEAST_POSE_POINTS = 3
"""Smallest number of points that determine the pose of a plane, together with the frames of their patches."""
LEAST_CHECKED = 4
"""Smallest number of points whose errors tell a wrong pose. With fewer points, a pose is always ambiguous."""
LEAST_ASIDE = 0.02
"""Smallest extent of the points across their main direction, relative to the extent along it."""
LEAST_SIGMA_PX = 0.05
"""Least standard deviation of a point that residuals may give."""
EXCLUDED_POSE = 25.0
"""Difference of two sums of squared errors, in standard deviations, from which the worse pose is excluded."""
SAME_POSE = 0.1
"""Two poses are one if the squared distance between them, in standard deviations, is smaller."""
WRONG_FRAME = 100.0
"""Standard deviation of a frame that does not agree with the board, in parts of the frame."""
FLOOR_PX = 0.001
"""Added to the standard deviations of points."""
LEAST_GAIN = 1e-4
"""The refinement ends when the sums of squared errors fall by no more than this part."""
STEPS = 20
"""Largest number of steps of Levenberg and Marquardt."""


@dataclass(frozen=True)
class BoardPose:
    """The pose of a board: ``X_camera = rotation @ X_board + translation_mm``.

    The camera frame has x right, y down and z forward. The board frame is that of :class:`kpbench.Board`.

    Attributes
    ----------
    rotation : ndarray of shape (3, 3)
        From the board frame to the camera frame.
    translation_mm : ndarray of shape (3,)
        The board's origin in the camera frame.
    covariance : ndarray of shape (6, 6)
        Covariance of the error (ω, δ): a rotation vector in rad and a translation in mm, both in the camera frame. The
        true pose is ``exp([ω]×) @ rotation`` and ``translation_mm + δ``.
    reprojection_rms_px : float
        Root mean square distance of the detections from the projected keypoints.
    points : int
        Number of keypoints that the pose was computed from.
    ambiguous : bool
        Whether another pose explains the image as well.
    second : BoardPose or None
        Another pose that explains the image as well, if there is one. Its own ``second`` is None.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.boards import BoardPose
    >>> pose = BoardPose(np.eye(3), np.array([0.0, 0.0, 500.0]), np.eye(6), 0.1, 6)
    >>> pose.quaternion_xyzw.tolist()
    [0.0, 0.0, 0.0, 1.0]
    """

    rotation: Float
    translation_mm: Float
    covariance: Float
    reprojection_rms_px: float
    points: int
    ambiguous: bool = False
    second: BoardPose | None = None

    @property
    def quaternion_xyzw(self) -> Float:
        """The rotation as a unit quaternion (x, y, z, w) with w ≥ 0, ndarray of shape (4,)."""
        (a, b, c), (d, e, f), (g, h, i) = self.rotation
        outer = np.array(
            [
                [a - e - i, d + b, g + c, h - f],
                [d + b, e - a - i, h + f, c - g],
                [g + c, h + f, i - a - e, d - b],
                [h - f, c - g, d - b, a + e + i],
            ]
        )
        q = np.linalg.eigh(outer)[1][:, -1]  # I. Bar-Itzhack, J. Guidance 23 (2000), 1085: the largest eigenvalue
        return np.asarray(q if q[3] >= 0 else -q) + 0.0


def estimate_pose(match: BoardMatch, camera: Camera) -> BoardPose:
    """Estimate the pose of a board that was found.

    The two poses of a plane that fit a homography (T. Collins, A. Bartoli, "Infinitesimal plane-based pose estimation",
    *IJCV* 109, 2014) are refined by Levenberg and Marquardt. Each point is weighted by its covariance. The worse pose
    is excluded if its sum of squared errors is larger by ``EXCLUDED_POSE``. If the errors are larger than their
    covariances say, the covariances are scaled up.

    Parameters
    ----------
    match : BoardMatch
        From :func:`find_board`. Without covariances of the points, all points weigh the same, and their errors are
        estimated from the residuals.
    camera : Camera
        Camera of the image.

    Returns
    -------
    BoardPose
        If the match is ambiguous, the pose is ambiguous, too, and ``second`` is the pose of the first alternative.

    Raises
    ------
    DataError
        If the match has fewer than four points, all points are close to one line, or no pose fits.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.geometry import Camera
    >>> board = kpbench.hexagon_board(kpbench.shipped_patches()[1], side_mm=100.0)
    >>> camera = Camera(640, 480, 700.0)
    >>> xy = camera.project(board.points_mm + [0, 0, 350])  # 2 px per mm
    >>> ids, frames = np.ones(6, int), np.tile(16 * np.eye(2), (6, 1, 1))
    >>> [match] = kpbench.find_board(kpbench.Detections(xy, np.ones(6), ids, frames), board, camera)
    >>> pose = kpbench.estimate_pose(match, camera)
    >>> (pose.translation_mm.round(6) + 0.0).tolist(), pose.ambiguous
    ([0.0, 0.0, 350.0], False)
    """
    first = _solve(match, camera)
    others = [other for other in match.alternatives if other.board is match.board]
    rest = [_solve(other, camera)[0] for other in others[:1]] or first[1:]
    is_ambiguous = bool(rest) or match.ambiguous or len(match.points) < LEAST_CHECKED
    return replace(first[0], ambiguous=is_ambiguous, second=rest[0] if rest else None)


def _solve(match: BoardMatch, camera: Camera) -> list[BoardPose]:
    """Return the pose, and the second one if it is not excluded, for the points of a match."""
    name, X = f"board {match.board.name!r}", match.board.points_mm[match.points]
    if len(X) < LEAST_POSE_POINTS:
        raise DataError(f"{name}: {len(X)} points, expected at least {LEAST_POSE_POINTS} for a pose")
    extent = np.linalg.svd(X - X.mean(axis=0), compute_uv=False)
    if extent[1] < LEAST_ASIDE * extent[0]:
        raise DataError(f"{name}: {len(X)} points on one line, expected some beside it for a pose")
    frames = match.frames if match.camera == camera else None
    if frames is None:
        frames = straighten(match.detections, camera)
    if not np.isfinite(frames.xy).all():
        raise DataError(f"{name}: the camera's lens shows no such points")
    H = fit_board(match, frames)
    R, t = _initial_poses(H, np.append(X[:, :2].mean(axis=0), 1.0))
    R, t, information, cost = _refine(R, t, X, frames.xy, _whitening(frames, camera))
    valid = np.isfinite(cost) & ((X @ R[:, 2, :, None])[..., 0] + t[:, 2:] > 0).all(axis=1)
    if not valid.any():
        raise DataError(f"{name}: no pose fits the {len(X)} points")
    if len(X) == 3:  # three points fit both poses exactly; the frames may tell
        cost = cost + _frame_costs(R, t, match, frames)
    scale = _scale(float(cost[valid].min()), len(X), frames.covariance is not None)
    poses, costs = list[BoardPose](), list[float]()
    for k in np.argsort(np.where(valid, cost, np.inf))[: valid.sum()].tolist():
        covariance = scale * np.linalg.inv(information[k])
        errors = camera.project(X @ R[k].T + t[k]) - match.detections.xy
        rms = float(np.sqrt((errors**2).sum(axis=1).mean()))
        poses.append(BoardPose(R[k], t[k], (covariance + covariance.T) / 2, rms, len(X)))
        costs.append(float(cost[k]))
    if len(poses) == 2 and (costs[1] - costs[0] > EXCLUDED_POSE * scale or _are_same(*poses)):
        poses.pop()
    return poses


def fit_board(match: BoardMatch, frames: Frames) -> Float:
    """Return the homography (3, 3) from (x, y, 1) of the board frame, mm, to the straight coordinates of a match."""
    X, J, scale, shape, unit_mm = _board_frames(match, frames)
    return fit_homography(X, frames.xy, J, scale, shape) @ np.diag([1, 1, unit_mm])


def _board_frames(match: BoardMatch, frames: Frames) -> tuple[Float, Float, Float, Float, float]:
    """Return points (n, 2) in mean disc radii, derivatives by them, their two errors, and the mean radius in mm."""
    points, _, to_patch = match.board.orientations
    J = frames.A @ to_patch[np.searchsorted(points, match.points)]
    scale, shape = np.array([frame_errors(match.board.keypoints[n].patch) for n in match.points]).T
    shape = np.where(match.agrees, shape, WRONG_FRAME)
    unit_mm = float(np.mean([k.diameter_mm for k in match.board.keypoints])) / 2
    return match.board.points_mm[match.points, :2] / unit_mm, J * unit_mm, scale, shape, unit_mm


def _initial_poses(H: Float, middle: Float) -> tuple[Float, Float]:
    """Return the two poses of the plane whose image is that of H to first order at the point (x, y, 1).

    With ``v`` the ray of the middle and z its depth, ``J = B R₂₂ / z``, where R₂₂ is a part of the rotation in a frame
    whose axis is v, and ``B = [I, -v] Rv``. The greatest singular value of ``B⁻¹ J`` is 1 / z (Collins and Bartoli).
    """
    a, b, w = H @ middle
    v = np.array([a, b]) / w
    J_middle = (H[:2, :2] - np.outer(v, H[2, :2])) / w
    axis = np.append(v, 1.0) / np.sqrt(1 + v @ v)
    x, y, z = axis
    Rv = np.array([[1 - x * x / (1 + z), -x * y / (1 + z), x], [-x * y / (1 + z), 1 - y * y / (1 + z), y], [-x, -y, z]])
    A = np.linalg.solve(np.column_stack([np.eye(2), -v]) @ Rv[:, :2], J_middle)
    squares, det = float((A * A).sum()), float(A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0])
    inverse_z = np.sqrt((squares + np.sqrt(max(squares**2 - 4 * det**2, 0.0))) / 2)
    R22 = A / inverse_z
    rest = np.eye(2) - R22.T @ R22
    low = np.sqrt(np.maximum(np.diag(rest), 0.0)) * [1.0, 1.0 if rest[0, 1] >= 0 else -1.0]
    R, t = np.empty((2, 3, 3)), np.empty((2, 3))
    for k, sign in enumerate((1.0, -1.0)):
        (a, b), (c, d) = R22
        e, f = sign * low
        R[k] = Rv @ np.array([[a, b, c * f - d * e], [c, d, b * e - a * f], [e, f, a * d - b * c]])
        t[k] = np.append(v, 1.0) / inverse_z - R[k][:, :2] @ middle[:2]
    return R, t


def _frame_costs(R: Float, t: Float, match: BoardMatch, frames: Frames) -> Float:
    """Return the sums (K,) of the squared errors of the frames under K poses, in their standard deviations."""
    X, J, scale, shape, unit_mm = _board_frames(match, frames)
    seen = (X * unit_mm) @ R[:, :, :2].transpose(0, 2, 1) + t[:, None]
    ray = seen[..., :2] / seen[..., 2:]
    expected = (R[:, None, :2, :2] - ray[..., None] * R[:, None, 2:, :2]) * (unit_mm / seen[..., 2:, None])
    frame = np.linalg.solve(expected, np.broadcast_to(J, expected.shape))
    size = np.sqrt(np.maximum(np.linalg.det(frame), 1e-12))
    bent = ((frame / size[..., None, None] - np.eye(2)) ** 2).sum(axis=(2, 3))
    return np.asarray((bent / shape**2 + (np.log(size) / scale) ** 2).sum(axis=1))


def _whitening(frames: Frames, camera: Camera) -> Float:
    """Return matrices (n, 2, 2) that make the errors of rays independent, of variance 1 or, without covariances, px."""
    focal = camera.K[[0, 1], [0, 1]]
    if frames.covariance is None:
        return np.tile(np.diag(focal), (len(frames.xy), 1, 1))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(frames.covariance + np.diag((FLOOR_PX / focal) ** 2))))


def _refine(R: Float, t: Float, X: Float, rays: Float, whiten: Float) -> tuple[Float, Float, Float, Float]:
    """Refine K poses at once. Return them, their information matrices (K, 6, 6) and sums of squared errors (K,)."""

    def errors(R: Float, t: Float) -> tuple[Float, Float]:
        turned = X @ R.transpose(0, 2, 1)
        Y = turned + t[:, None]
        with np.errstate(all="ignore"):
            ray = Y[..., :2] / Y[..., 2:]
            error = (whiten @ (rays - ray)[..., None])[..., 0]
        return error, np.concatenate([turned, Y], axis=-1)

    def cost_of(error: Float) -> Float:
        return np.where(np.isfinite(error).all(axis=(1, 2)), (error**2).sum(axis=(1, 2)), np.inf)

    error, points = errors(R, t)
    cost, damping = cost_of(error), np.full(len(R), 1e-6)
    for _ in range(STEPS):
        J = _jacobian(points, whiten)
        transposed = J.transpose(0, 2, 1)
        information = transposed @ J
        damped = information * (1 + damping[:, None, None] * np.eye(6))
        step = np.asarray(np.linalg.solve(damped, transposed @ error.reshape(len(R), -1, 1))[..., 0], np.float64)
        R_new, t_new = exp_rotation(step[:, :3]) @ R, t + step[:, 3:]
        error_new, points_new = errors(R_new, t_new)
        cost_new = cost_of(error_new)
        better = cost_new <= cost
        gain = np.where(better, cost - cost_new, 0.0)
        R, t = np.where(better[:, None, None], R_new, R), np.where(better[:, None], t_new, t)
        error, points = (
            np.where(better[:, None, None], new, old) for new, old in ((error_new, error), (points_new, points))
        )
        cost, damping = np.where(better, cost_new, cost), np.where(better, damping / 10, damping * 100)
        if better.all() and (gain <= LEAST_GAIN * cost + 1e-12).all():
            break
    J = _jacobian(points, whiten)
    return R, t, J.transpose(0, 2, 1) @ J, cost


def _jacobian(points: Float, whiten: Float) -> Float:
    """Return the derivatives (K, 2n, 6) of whitened rays by (ω, δ) from points (K, n, 6): turned, then moved."""
    rx, ry, rz, x, y, z = np.moveaxis(points, -1, 0)
    inverse = 1 / z
    u, v = x * inverse, y * inverse
    J = np.zeros((*z.shape, 2, 6))
    J[..., 0, 0], J[..., 0, 1], J[..., 0, 2], J[..., 0, 3], J[..., 0, 5] = -u * ry, rz + u * rx, -ry, 1.0, -u
    J[..., 1, 0], J[..., 1, 1], J[..., 1, 2], J[..., 1, 4], J[..., 1, 5] = -rz - v * ry, v * rx, rx, 1.0, -v
    J *= inverse[..., None, None]
    return np.asarray(whiten @ J).reshape(len(points), -1, 6)


def exp_rotation(rotation_vector: Float) -> Float:
    """Return rotation matrices (K, 3, 3) of rotation vectors (K, 3), by Rodrigues' formula."""
    angle = np.sqrt((rotation_vector**2).sum(axis=1))
    x, y, z = (rotation_vector / np.maximum(angle, 1e-300)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + (1 - cosine) * cross @ cross)


def rotation_vector(R: Float) -> Float:
    """Return the rotation vector (3,), rad, of a rotation matrix (3, 3)."""
    sine = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    length = float(np.linalg.norm(sine))
    angle = np.arctan2(length, (np.trace(R) - 1) / 2)
    if length < 1e-9 and angle > 1:  # half a turn: R + I is twice the outer product of the axis
        axis = (R + np.eye(3))[:, int(np.argmax(np.diag(R)))]
        return np.asarray(np.pi * axis / np.linalg.norm(axis))
    return sine * (angle / length if length > 0 else 1.0)


def pose_distance(first: BoardPose, second: BoardPose) -> float:
    """Return the squared distance of two poses in standard deviations of the first, ``eᵀ C⁻¹ e``.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.boards import BoardPose, pose_distance
    >>> pose = BoardPose(np.eye(3), np.array([0.0, 0.0, 500.0]), np.eye(6), 0.1, 6)
    >>> pose_distance(pose, BoardPose(np.eye(3), np.array([0.0, 3.0, 500.0]), np.eye(6), 0.1, 6))
    9.0
    """
    error = np.append(rotation_vector(second.rotation @ first.rotation.T), second.translation_mm - first.translation_mm)
    return float(error @ np.linalg.solve(first.covariance, error))


def _are_same(first: BoardPose, second: BoardPose) -> bool:
    return pose_distance(first, second) < SAME_POSE


def _scale(cost: float, n: int, has_covariance: bool) -> float:
    """Return the factor of the covariances that explains the residuals."""
    freedom = 2 * n - 6
    if not freedom:
        return 1.0 if has_covariance else LEAST_SIGMA_PX**2
    return max(1.0, cost / freedom) if has_covariance else max(LEAST_SIGMA_PX**2, cost / freedom)
