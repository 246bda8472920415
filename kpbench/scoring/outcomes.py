"""Check predictions and match them to the truth. All metrics and reports are computed from the outcomes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.scoring.assignment import DUPLICATE, MATCHED, NEAR_MISS, DetectionPoints, Matches, TruthPoints, match
from kpbench.scoring.fingerprint import find_images, warn_of_ids
from kpbench.types import Float, Int, Predictions, Truth, is_ignored

TRUTH_REACH = 3.0
"""Least matching threshold, in standard deviations of the truth along its worst direction."""


@dataclass(frozen=True)
class Settings:
    """The settings of a score.

    Attributes
    ----------
    eps : float
        Matching threshold: the largest distance of a match, in radii of the true keypoint's projected circle.
    eps_radius : {"major", "minor", "mean"}
        The radius of a projected circle: its major semi-axis, its minor semi-axis, or the mean of both.
    matching : {"one-to-one", "literal"}
        "literal" takes the paper's formulas as they are printed. Every detection within the matching threshold then
        counts as a match, so a detection score can exceed 1.
    resamples : int
        Number of bootstrap resamples for the intervals. 0 computes no intervals.
    seed : int
        Seed of the bootstrap.

    Raises
    ------
    ValueError
        If a value is out of its range.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.scoring.Settings(eps=0.2).matching
    'one-to-one'
    """

    eps: float = 0.1
    eps_radius: Literal["major", "minor", "mean"] = "major"
    matching: Literal["one-to-one", "literal"] = "one-to-one"
    resamples: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.eps < np.inf:
            raise ValueError(f"`eps` is {self.eps}, expected a finite number of 0 or more")
        if self.eps_radius not in ("major", "minor", "mean"):
            raise ValueError(f"`eps_radius` is {self.eps_radius!r}, expected major, minor or mean")
        if self.matching not in ("one-to-one", "literal"):
            raise ValueError(f"`matching` is {self.matching!r}, expected one-to-one or literal")
        if self.resamples < 0:
            raise ValueError(f"`resamples` is {self.resamples}, expected 0 or more")


@dataclass(frozen=True)
class Outcomes:
    """The outcome of each of T true keypoints and D detections in N images.

    Rows keep the order of the truth and of the predictions. The rows of each image are therefore contiguous
    in memory, which makes the scoring of millions of images fast.

    Attributes
    ----------
    truth : Truth
    truth_points : TruthPoints
        Place, radius and image of each true keypoint. The image is an index into ``truth``.
    truth_id : ndarray of shape (T,), int64
        True identity.
    detections : DetectionPoints
        Place, score, image, identity and covariance of each detection. The image is an index into ``truth``.
    matches : Matches
    correct : ndarray of shape (T,), bool
        Whether the true keypoint is matched by a detection of the right identity, and the identity is not contradicted
        (see :class:`kpbench.scoring.Matches`).
    literally_correct : ndarray of shape (D,), bool
        Whether the detection has the identity of the nearest true keypoint within the matching threshold.
    settings : Settings
    detector : dict
        The description of the detector in the predictions.
    ignored_detections : int
        Number of detections that are left out: without match, within the matching threshold of an ignored patch.

    Examples
    --------
    >>> import kpbench
    >>> outcomes = kpbench.scoring.match_predictions(
    ...     kpbench.open_dataset("kpbench-data").truth, kpbench.read_predictions("preds.json")
    ... )
    >>> int(outcomes.matched.sum()), int(outcomes.correct.sum()), len(outcomes.truth_id)
    (22, 22, 23)
    """

    truth: Truth
    truth_points: TruthPoints
    truth_id: Int
    detections: DetectionPoints
    matches: Matches
    correct: NDArray[np.bool_]
    literally_correct: NDArray[np.bool_]
    settings: Settings
    detector: dict[str, Any]
    ignored_detections: int = 0

    @property
    def matched(self) -> NDArray[np.bool_]:
        """Whether each true keypoint is matched, of shape (T,)."""
        return self.matches.detection >= 0

    @property
    def truth_limited(self) -> NDArray[np.bool_]:
        """Whether the error of the truth sets the matching threshold of each keypoint, of shape (T,)."""
        points = self.truth_points
        return points.reach(self.settings.eps) > self.settings.eps * points.radius

    @cached_property
    def image_sums(self) -> Int:
        """The counts of each image, of shape (N, 9), in the order of :data:`kpbench.scoring.SUMS`."""
        return self.sum_rows(self.truth_points.image, self.detections.image, len(self.truth))

    @cached_property
    def ranking(self) -> Int:
        """The rows of the detections in rising order of the score, of shape (D,)."""
        return np.argsort(self.detections.score)

    def sum_rows(self, row_of_truth: Int, row_of_detection: Int, rows: int) -> Int:
        """Count true keypoints, detections and their outcomes per row. The caller defines the rows, such as images.

        Parameters
        ----------
        row_of_truth : ndarray of shape (T,), int64
            Row of each true keypoint.
        row_of_detection : ndarray of shape (D,), int64
            Row of each detection. Detections of row -1 are left out.
        rows : int
            Number of rows.

        Returns
        -------
        ndarray of shape (rows, 9), int64
            Counts of each row, in the order of :data:`kpbench.scoring.SUMS`.
        """

        def count(row: Int) -> Int:
            return np.bincount(row[row >= 0], minlength=rows)

        nearest, kind = self.matches.nearest, self.matches.kind
        columns = [
            np.ones(rows, np.int64),
            count(row_of_truth),
            count(row_of_detection),
            count(row_of_truth[self.matched]),
            count(row_of_truth[self.correct]),
            count(row_of_truth[nearest[nearest >= 0]]),
            count(row_of_truth[nearest[self.literally_correct]]),
            count(row_of_detection[kind == DUPLICATE]),
            count(row_of_detection[kind == NEAR_MISS]),
        ]
        return np.stack(columns, axis=1)


def match_predictions(
    truth: Truth, predictions: Predictions, settings: Settings | None = None, *, allow_missing: bool = False
) -> Outcomes:
    """Check that the predictions fit the images of the truth, and match the detections.

    Parameters
    ----------
    truth : Truth
    predictions : Predictions
    settings : Settings, optional
    allow_missing : bool
        Whether to accept an image that the predictions lack, as an image without detections. If False, such an image
        is an error.

    Returns
    -------
    Outcomes

    Raises
    ------
    PredictionsError
        If the predictions name unknown images, lack images, or name the fingerprint of another dataset, or if the
        names of files contradict the image IDs.
    DataError
        If there are no images, two images share an image_id, a place is not finite, or a radius is not a positive
        number.

    Examples
    --------
    >>> import kpbench
    >>> truth = kpbench.open_dataset("kpbench-data").truth
    >>> outcomes = kpbench.scoring.match_predictions(truth, kpbench.read_predictions("preds.json"))
    >>> len(outcomes.matched) == len(truth.keypoints)
    True
    """
    settings = settings or Settings()
    if not len(truth):
        raise DataError("the dataset has no images")
    image = find_images(truth, predictions, allow_missing)
    points = _read_points(truth, truth.keypoints, np.repeat(np.arange(len(truth)), np.diff(truth.offsets)), settings)
    truth_id = truth.keypoints["patch_id"].astype(np.int64)
    # Predictions without detections hold no IDs, but the detector may know IDs: keep the ID counts defined
    ids = predictions.patch_id if len(predictions.xy) else np.zeros(0, np.int64)
    detections = DetectionPoints(predictions.xy, predictions.score, image, ids, predictions.covariance)
    matches = match(points, detections, settings.eps)
    left_out = _find_ignored(truth, detections, matches, settings)
    if count := int(np.count_nonzero(left_out)):  # without them, the same detections match
        detections = detections.select(~left_out)
        ids, matches = detections.patch_id, match(points, detections, settings.eps)
    warn_of_ids(truth, predictions, int(np.count_nonzero(matches.detection >= 0)))
    correct, literally_correct = np.zeros(len(truth_id), bool), np.zeros(len(detections.xy), bool)
    if ids is not None:
        t, d = np.flatnonzero(matches.detection >= 0), np.flatnonzero(matches.nearest >= 0)
        correct[t] = (ids[matches.detection[t]] == truth_id[t]) & ~matches.contradicted[t]
        literally_correct[d] = ids[d] == truth_id[matches.nearest[d]]
    about = settings, predictions.detector, count
    return Outcomes(truth, points, truth_id, detections, matches, correct, literally_correct, *about)


def _find_ignored(truth: Truth, found: DetectionPoints, matches: Matches, settings: Settings) -> NDArray[np.bool_]:
    """Return which detections match no true keypoint and are within the matching threshold of an ignored patch."""
    if truth.ignored is None or truth.ignored_image is None:
        return np.zeros(len(found.xy), bool)
    points = _read_points(truth, truth.ignored, truth.ignored_image, settings)
    near = match(replace(points, least_reach_px=None), found, settings.eps).nearest >= 0
    return np.asarray(near & (matches.kind != MATCHED))


def _read_points(truth: Truth, keypoints: NDArray[Any], image: Int, settings: Settings) -> TruthPoints:
    """Check keypoints, and return them as columns."""
    xy = np.stack([keypoints["x"], keypoints["y"]], axis=1).astype(np.float64)
    major, minor = keypoints["radius_major"].astype(np.float64), keypoints["radius_minor"].astype(np.float64)
    radius = {"major": major, "minor": minor, "mean": (major + minor) / 2}[settings.eps_radius]
    valid = np.isfinite(xy).all(axis=1) & np.isfinite(radius) & (radius > 0)
    if not valid.all():
        row = int(np.argmin(valid))
        raise DataError(
            f"image_id {truth.image_id[image[row]]}: a true keypoint at {xy[row].tolist()} has radius "
            f"{radius[row]}, expected finite numbers and a radius over 0"
        )
    covariance = truth_covariance(keypoints[~is_ignored(keypoints)])
    if covariance is None or len(covariance) < len(keypoints):
        return TruthPoints(xy, radius, image)
    return TruthPoints(xy, radius, image, TRUTH_REACH * np.sqrt(np.linalg.eigvalsh(covariance)[:, 1]))


def truth_covariance(keypoints: NDArray[Any]) -> Float | None:
    """Return the covariances of the errors of the truth, ndarray of shape (T, 2, 2), px²; None if it is exact.

    Raises
    ------
    DataError
        If a standard deviation is negative or not finite, or a correlation is not within -1 and 1.
    """
    if "sigma_x" not in (keypoints.dtype.names or ()):
        return None
    x, y, rho = (keypoints[name].astype(np.float64) for name in ("sigma_x", "sigma_y", "rho"))
    valid = np.isfinite(x) & np.isfinite(y) & (np.minimum(x, y) >= 0) & (np.abs(rho) <= 1)
    if not valid.all():
        n = int(np.argmin(valid))
        raise DataError(
            f"keypoint {n} of the truth has sigma_x {x[n]}, sigma_y {y[n]} and rho {rho[n]}, expected finite numbers, "
            "sigmas of 0 or more, and rho within -1 and 1"
        )
    xy = rho * x * y
    return np.stack([np.stack([x * x, xy], axis=1), np.stack([xy, y * y], axis=1)], axis=1)
