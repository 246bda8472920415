"""Truth and detections, checked and matched: the rows that all metrics, comparisons and reports are made of."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError, PredictionsError
from kpbench.scoring.assignment import DUPLICATE, NEAR_MISS, Matches, match
from kpbench.types import Float, Int, Predictions, Truth


@dataclass(frozen=True)
class Settings:
    """How to score.

    Attributes
    ----------
    eps : float
        Largest distance of a match, in radii of the true keypoint's projected circle.
    eps_radius : {"major", "minor", "mean"}
        Which semi-axis of the projected circle is the radius; "mean" is half their sum.
    matching : {"one-to-one", "literal"}
        "literal" makes the paper's formulas as printed the main ones: every detection within ε counts,
        so that a detection score can exceed 1.
    resamples : int
        Bootstrap resamples behind the intervals.
    seed : int
        Of the bootstrap.

    Raises
    ------
    ValueError
    """

    eps: float = 0.1
    eps_radius: Literal["major", "minor", "mean"] = "major"
    matching: Literal["one-to-one", "literal"] = "one-to-one"
    resamples: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.eps < np.inf:
            raise ValueError(f"eps is {self.eps}, expected a finite number of 0 or more")
        if self.eps_radius not in ("major", "minor", "mean"):
            raise ValueError(f"eps_radius is {self.eps_radius!r}, expected major, minor or mean")
        if self.matching not in ("one-to-one", "literal"):
            raise ValueError(f"matching is {self.matching!r}, expected one-to-one or literal")
        if self.resamples < 0:
            raise ValueError(f"resamples is {self.resamples}, expected 0 or more")


@dataclass(frozen=True)
class Tally:
    """What became of T true keypoints and D detections in N images.

    Rows keep the order of the truth and of the predictions, so that what belongs to an image lies together: with
    millions of images every other order costs a cache miss a row.

    Attributes
    ----------
    truth : Truth
    truth_image : ndarray of shape (T,), int64
        Position of the image.
    truth_id : ndarray of shape (T,), int64
    radius : ndarray of shape (T,), float64, px
        The one that ε is a fraction of.
    detection : ndarray of shape (T,), int64
        Row of the detection that explains a true keypoint, or -1.
    distance : ndarray of shape (T,), float64, px
        To that detection; nan where there is none.
    correct : ndarray of shape (T,), bool
        Matched, and with the right identity.
    image : ndarray of shape (D,), int64
        Position of the image.
    xy : ndarray of shape (D, 2), float64, px
    score : ndarray of shape (D,), float64
    patch_id : ndarray of shape (D,), int64, or None
    kind : ndarray of shape (D,), uint8
        See :class:`kpbench.scoring.Matches`.
    nearest : ndarray of shape (D,), int64
        The nearest true keypoint in reach, or -1.
    literally_correct : ndarray of shape (D,), bool
        It has the identity of that one.
    contradicted : ndarray of shape (T,), bool
        See :class:`kpbench.scoring.Matches`.
    settings : Settings
    detector : dict
    """

    truth: Truth
    truth_image: Int
    truth_id: Int
    radius: Float
    detection: Int
    distance: Float
    correct: NDArray[np.bool_]
    image: Int
    xy: Float
    score: Float
    patch_id: Int | None
    kind: NDArray[np.uint8]
    nearest: Int
    literally_correct: NDArray[np.bool_]
    contradicted: NDArray[np.bool_]
    settings: Settings
    detector: dict[str, Any]

    @property
    def matched(self) -> NDArray[np.bool_]:
        """(T,) whether a true keypoint is explained."""
        return self.detection >= 0

    @cached_property
    def image_sums(self) -> Int:
        """(N, 9) counts of each image in the order of :data:`kpbench.scoring.SUMS`."""
        return self.sums(self.truth_image, self.image, len(self.truth))

    def sums(self, row_of_truth: Int, row_of_detection: Int, rows: int) -> Int:
        """(rows, 9) counts in the order of :data:`kpbench.scoring.SUMS`; what is in row -1 is left out."""

        def count(row: Int) -> Int:
            return np.bincount(row[row >= 0], minlength=rows)

        reaching = self.nearest >= 0
        columns = [
            np.ones(rows, np.int64),
            count(row_of_truth),
            count(row_of_detection),
            count(row_of_truth[self.matched]),
            count(row_of_truth[self.correct]),
            count(row_of_truth[self.nearest[reaching]]),
            count(row_of_truth[self.nearest[self.literally_correct]]),
            count(row_of_detection[self.kind == DUPLICATE]),
            count(row_of_detection[self.kind == NEAR_MISS]),
        ]
        return np.stack(columns, axis=1)


def tally(
    truth: Truth, predictions: Predictions, settings: Settings | None = None, *, allow_missing: bool = False
) -> Tally:
    """Check that the predictions are for the images of the truth, and match them.

    Raises
    ------
    PredictionsError
        If they are for other images, or for another dataset by its fingerprint.
    DataError
        If there are no images, or radii or places that are no positive finite numbers.
    """
    settings = settings or Settings()
    if not len(truth):
        raise DataError("the dataset has no images")
    image = _image_of_detections(truth, predictions, allow_missing)
    truth_xy, truth_image, radius = _places(truth, settings.eps_radius)
    truth_id = truth.keypoints["patch_id"].astype(np.int64)
    xy, score = predictions.xy, predictions.score
    # Where nothing was detected it does not matter whether the detector would have told identities
    ids = predictions.patch_id if len(xy) else np.zeros(0, np.int64)
    found: Matches = match(truth_xy, truth_image, radius, settings.eps, xy, score, image, ids)
    correct, literally = np.zeros(len(truth_xy), bool), np.zeros(len(image), bool)
    if ids is not None:
        t, d = np.flatnonzero(found.detection >= 0), np.flatnonzero(found.nearest >= 0)
        correct[t] = (ids[found.detection[t]] == truth_id[t]) & ~found.contradicted[t]
        literally[d] = ids[d] == truth_id[found.nearest[d]]
    return Tally(
        truth=truth,
        truth_image=truth_image,
        truth_id=truth_id,
        radius=radius,
        detection=found.detection,
        distance=found.distance,
        correct=correct,
        image=image,
        xy=xy,
        score=score,
        patch_id=ids,
        kind=found.kind,
        nearest=found.nearest,
        literally_correct=literally,
        contradicted=found.contradicted,
        settings=settings,
        detector=predictions.detector,
    )


def _places(truth: Truth, eps_radius: str) -> tuple[Float, Int, Float]:
    """Places (T, 2), images (T,) and radii (T,) of the true keypoints, after checking them."""
    keypoints = truth.keypoints
    xy = np.stack([keypoints["x"], keypoints["y"]], axis=1).astype(np.float64)
    major, minor = keypoints["radius_major"].astype(np.float64), keypoints["radius_minor"].astype(np.float64)
    radius = {"major": major, "minor": minor, "mean": (major + minor) / 2}[eps_radius]
    image = np.repeat(np.arange(len(truth)), np.diff(truth.offsets))
    fine = np.isfinite(xy).all(axis=1) & np.isfinite(radius) & (radius > 0)
    if not fine.all():
        row = int(np.argmin(fine))
        raise DataError(
            f"image_id {truth.image_id[image[row]]}: a true keypoint at {xy[row].tolist()} has radius "
            f"{radius[row]}, expected finite numbers and a radius over 0"
        )
    return xy, image, radius


def _image_of_detections(truth: Truth, predictions: Predictions, allow_missing: bool) -> Int:
    """Position in the truth of each detection's image, after checking that both are of the same images."""
    named = predictions.fingerprint or predictions.dataset or ""
    if re.fullmatch("[0-9a-f]{64}", named) and truth.fingerprint and named != truth.fingerprint:
        raise PredictionsError(
            f"made for the dataset with fingerprint {named[:12]}…, but this dataset's is {truth.fingerprint[:12]}…"
        )
    order = np.argsort(truth.image_id, kind="stable")
    ids = truth.image_id[order]
    if np.any(ids[1:] == ids[:-1]):
        raise DataError(f"the dataset has image_id {ids[:-1][ids[1:] == ids[:-1]][0]} twice")
    place = np.searchsorted(ids, predictions.image_id)
    unknown = np.append(ids, -1)[place] != predictions.image_id
    span = f"{len(ids)} images, image_id {ids[0]} to {ids[-1]}"
    if unknown.any():
        raise PredictionsError(
            f"image_id {predictions.image_id[unknown].min()} is not in the dataset ({span}); "
            f"{np.count_nonzero(unknown)} predictions are for images that it does not have"
        )
    missing = np.ones(len(ids), bool)
    missing[place] = False
    if missing.any() and not allow_missing:
        raise PredictionsError(
            f"no prediction for image_id {ids[missing][0]}; {np.count_nonzero(missing)} of {len(ids)} images are "
            f"missing (`allow_missing=True` takes them as images without detections)"
        )
    return np.repeat(order[place], np.diff(predictions.offsets))
