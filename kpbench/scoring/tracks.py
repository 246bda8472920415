"""Scores of a board that was followed through films, beside its true poses.

Conventions
-----------
A film is a run of frames in order. The error of a pose is the distance of the board's origin, mm, and the angle of the
rotation between the two poses, degrees. Raw poses are measured in one frame each; filtered poses come from a filter.

Metrics
-------
* ``frames_with_pose``: part of the frames with a raw pose.
* ``translation_median_mm``, ``translation_p95_mm``, ``rotation_median_deg``, ``rotation_p95_deg``: errors of raw poses.
* ``filtered_translation_median_mm`` … ``filtered_rotation_p95_deg``: the same of filtered poses, guesses included.
* ``jitter_mm``, ``jitter_deg``: root mean square change of the raw pose's error from a frame to the next, divided by
  √2. For errors that are independent from frame to frame, it is their standard deviation.
* ``lag_ms``: the delay τ of the filtered places, with which ``p(t) = truth(t - τ)`` fits best to first order:
  ``-Σ e·v / Σ v·v`` for the errors e and the true velocities v. Positive if the filter trails.
* ``identity_switches``: number of times that a raw pose with wrong points follows another or no raw pose. A pose has
  wrong points if it puts any point of the board nearer to another point's true place.
* ``losses``: number of times that raw poses stop.
* ``frames_to_find_again``: mean number of frames without a raw pose after the first one, per loss, that show at least
  ``LEAST_VISIBLE_POINTS`` keypoints by at least ``LEAST_VISIBLE`` of their discs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kpbench.types import Float, Int

LEAST_VISIBLE_POINTS, LEAST_VISIBLE = 4, 0.9
_ERRORS = ("translation_median_mm", "translation_p95_mm", "rotation_median_deg", "rotation_p95_deg")
TRACK_METRICS = (
    *("frames", "frames_with_pose", *_ERRORS, *(f"filtered_{name}" for name in _ERRORS)),
    *("jitter_mm", "jitter_deg", "lag_ms", "identity_switches", "losses", "frames_to_find_again"),
)
"""Names of the metrics, in the order of tables."""


@dataclass(frozen=True)
class PoseSeries:
    """Poses of N frames: rotations (N, 3, 3) and translations (N, 3), mm; nan for frames without."""

    rotation: Float
    translation_mm: Float

    def __getitem__(self, rows: Int) -> PoseSeries:
        return PoseSeries(self.rotation[rows], self.translation_mm[rows])

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """Whether each frame has a pose."""
        return np.isfinite(self.translation_mm[:, 0])


@dataclass(frozen=True)
class FilmTruth:
    """What N frames truly show, film by film, in order.

    Attributes
    ----------
    film : ndarray of shape (N,), int64
        Number of the film of each frame.
    time_s : ndarray of shape (N,)
    poses : PoseSeries
    shows_board : ndarray of shape (N,), bool
        Whether enough of the board is visible.
    points_mm : ndarray of shape (K, 3)
        Points of the board.
    """

    film: Int
    time_s: Float
    poses: PoseSeries
    shows_board: NDArray[np.bool_]
    points_mm: Float

    def __getitem__(self, rows: Int) -> FilmTruth:
        return FilmTruth(self.film[rows], self.time_s[rows], self.poses[rows], self.shows_board[rows], self.points_mm)


def score_tracks(truth: FilmTruth, raw: PoseSeries, filtered: PoseSeries) -> dict[str, float | None]:
    """Compute the metrics of the poses of N frames, see :mod:`kpbench.scoring.tracks`; None for an undefined one.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.scoring import FilmTruth, PoseSeries, score_tracks
    >>> x_mm = 10.0 * np.arange(5)
    >>> def series(x_mm):
    ...     return PoseSeries(np.tile(np.eye(3), (5, 1, 1)), np.column_stack([x_mm, 0 * x_mm, 0 * x_mm + 500]))
    >>> points_mm = np.array([[-50.0, 0, 0], [50, 0, 0], [0, 50, 0], [0, -50, 0]])
    >>> truth = FilmTruth(np.zeros(5, int), np.arange(5) / 10, series(x_mm), np.ones(5, bool), points_mm)
    >>> scores = score_tracks(truth, series(x_mm), series(x_mm - 2))  # the filter is 2 mm of 100 mm/s behind
    >>> scores["frames_with_pose"], scores["jitter_mm"], round(scores["lag_ms"], 6)
    (1.0, 0.0, 20.0)
    """
    turn_deg, error_mm = _errors(truth.poses, raw)
    found = raw.has_pose
    next_too = found[1:] & found[:-1] & (np.diff(truth.film) == 0)
    steps_mm, steps_rad = np.diff(error_mm, axis=0)[next_too], np.diff(np.radians(turn_deg), axis=0)[next_too]
    wrong = found.copy()
    wrong[found] = _has_wrong_points(truth.poses[np.flatnonzero(found)], raw[np.flatnonzero(found)], truth.points_mm)
    starts = np.concatenate([[True], np.diff(truth.film) != 0])
    before = np.concatenate([[False], wrong[:-1]]) & ~starts
    losses, missed = _losses(truth, found)
    scores: dict[str, float | None] = {
        "frames": float(len(truth.film)),
        "frames_with_pose": float(found.mean()) if len(found) else None,
        **_percentiles("", turn_deg, error_mm),
        **_percentiles("filtered_", *_errors(truth.poses, filtered)),
        "jitter_mm": _jitter(steps_mm),
        "jitter_deg": None if (rad := _jitter(steps_rad)) is None else float(np.degrees(rad)),
        "lag_ms": _lag_ms(truth, filtered),
        "identity_switches": float((wrong & ~before).sum()),
        "losses": float(losses),
        "frames_to_find_again": missed / losses if losses else None,
    }
    return {name: scores[name] for name in TRACK_METRICS}


def _errors(truth: PoseSeries, poses: PoseSeries) -> tuple[Float, Float]:
    """Return rotation vectors (N, 3), degrees, and translations (N, 3), mm, from the truth to the poses."""
    turn = poses.rotation @ truth.rotation.transpose(0, 2, 1)
    sine = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)
    length = np.linalg.norm(sine, axis=1)
    # arctan2 of sine and cosine resolves small angles, which arccos of the trace would round to zero
    angle = np.degrees(np.arctan2(length, np.trace(turn, axis1=1, axis2=2) - 1))
    return sine * (angle / np.maximum(length, 1e-300))[:, None], poses.translation_mm - truth.translation_mm


def _percentiles(prefix: str, turn_deg: Float, error_mm: Float) -> dict[str, float | None]:
    sizes = [np.linalg.norm(error, axis=1) for error in (error_mm, turn_deg)]
    values = [
        v for s in sizes for v in (np.percentile(s[np.isfinite(s)], (50, 95)) if np.isfinite(s).any() else (None,) * 2)
    ]
    return {f"{prefix}{name}": None if v is None else float(v) for name, v in zip(_ERRORS, values, strict=True)}


def _jitter(steps: Float) -> float | None:
    return float(np.sqrt((steps**2).sum(axis=1).mean() / 2)) if len(steps) else None


def _lag_ms(truth: FilmTruth, filtered: PoseSeries) -> float | None:
    place, inside = truth.poses.translation_mm, np.diff(truth.film) == 0
    middle = np.flatnonzero(inside[1:] & inside[:-1]) + 1
    middle = middle[filtered.has_pose[middle]]
    if not len(middle):
        return None
    v = (place[middle + 1] - place[middle - 1]) / (truth.time_s[middle + 1] - truth.time_s[middle - 1])[:, None]
    error, squares = filtered.translation_mm[middle] - place[middle], float((v * v).sum())
    return -1000 * float((error * v).sum()) / squares if squares else None


def _has_wrong_points(truth: PoseSeries, poses: PoseSeries, points_mm: Float) -> NDArray[np.bool_]:
    true, found = (
        np.einsum("nij,kj->nki", series.rotation, points_mm) + series.translation_mm[:, None]
        for series in (truth, poses)
    )
    nearest = np.linalg.norm(found[:, :, None] - true[:, None], axis=3).argmin(axis=2)
    return np.asarray((nearest != np.arange(len(points_mm))).any(axis=1))


def _losses(truth: FilmTruth, found: NDArray[np.bool_]) -> tuple[int, int]:
    """Return the number of losses, and the number of frames without a pose that show enough of the board."""
    losses = missed = 0
    for film in np.unique(truth.film):
        rows = np.flatnonzero(truth.film == film)
        has = found[rows]
        if not has.any():
            continue
        first = int(has.argmax())
        losses += int((has[first:-1] & ~has[first + 1 :]).sum())
        missed += int((~has[first:] & truth.shows_board[rows][first:]).sum())
    return losses, missed
