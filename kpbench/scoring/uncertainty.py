"""Bias and scatter of the errors of matched keypoints, and whether the predicted covariances describe the errors.

An error is the matched detection minus the true keypoint, px. A detector that always errs to the same side of a design
has a bias in the frame of the patch, although its errors cancel in the frame of the image. Errors are therefore turned
into the frame of the patch, by the rotation that is nearest to the affine part of ``H_patch2image`` at the centre (the
polar decomposition [1]_).

The normalised estimation error squared (NEES) of an error e with covariance C is eᵀC⁻¹e. If C is right, its mean is 2
for the two coordinates of a keypoint [2]_. If the truth has an error, its covariance is added to C.

References
----------
.. [1] N. J. Higham, "Computing the polar decomposition with applications", SIAM Journal on Scientific and Statistical
   Computing 7(4), 1986. https://doi.org/10.1137/0907079
.. [2] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley, 2001,
   section 5.4.2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kpbench.scoring.bootstrap import Interval, bootstrap_intervals
from kpbench.scoring.outcomes import Outcomes, truth_covariance
from kpbench.types import Float, Int

LEAST_TILT = 1e-9
"""Smallest change of depth over a radius that gives a direction of tilt, in parts of the depth; rounding is smaller."""
BINS = 5
"""Number of bins of :func:`compute_nees_by_sigma`: quintiles."""


class MatchedErrors(NamedTuple):
    """Errors of M matched keypoints as columns; nan where a value is unknown."""

    in_patch: Float
    """Of shape (M, 2), px along the patch's own u and v; nan if the truth has no homography, as in COCO files."""
    along_tilt: Float
    """Of shape (M,), px towards the side of the patch that is farther away; nan for a patch without perspective."""
    nees: Float | None
    """Of shape (M,); inf if the covariance has no inverse. None without covariances."""
    sigma_px: Float | None
    """Predicted standard deviation of a coordinate, the root of half the trace of the covariance, of shape (M,)."""
    scene: Int
    """Scene ID of the image, of shape (M,)."""

    def select(self, rows: Int) -> MatchedErrors:
        """Return some rows."""
        return MatchedErrors(*(None if c is None else c[rows] for c in self))  # type: ignore[arg-type]

    def rank(self, distance: Float) -> Int:
        """Return the order by distance (M,), and by all other values at equal distance.

        So no order of the input changes the last digit of a sum.
        """
        order = np.argsort(distance)
        if np.any(np.diff(distance[order]) == 0):
            of_covariance = () if self.nees is None or self.sigma_px is None else (self.sigma_px, self.nees)
            order = np.lexsort((*of_covariance, self.along_tilt, *self.in_patch.T, distance))
        return order


def measure_errors(outcomes: Outcomes, row: Int) -> MatchedErrors:
    """Return the errors of some matched keypoints.

    Parameters
    ----------
    outcomes : Outcomes
    row : ndarray of shape (M,), int64
        Rows of matched keypoints.
    """
    detection = outcomes.matches.detection[row]
    error = outcomes.detections.xy[detection] - outcomes.truth_points.xy[row]
    covariance = outcomes.detections.covariance
    nees, sigma_px = (None, None) if covariance is None else _normalise(error, covariance[detection])
    of_truth = truth_covariance(outcomes.truth.keypoints)
    if covariance is not None and of_truth is not None:  # the truth errs, too
        nees = _normalise(error, covariance[detection] + of_truth[row])[0]
    in_patch, along_tilt = _turn(error, outcomes.truth.keypoints["H_patch2image"][row])
    scene = outcomes.truth.scene_id[outcomes.truth_points.image[row]]
    return MatchedErrors(in_patch, along_tilt, nees, sigma_px, scene)


def _turn(error: Float, H_patch2image: Float) -> tuple[Float, Float]:
    """Return errors (M, 2) in the frame of their patches, and along the direction of tilt."""
    (a, b, x), (c, d, y), (g, h, w) = np.moveaxis(H_patch2image, 0, -1)
    with np.errstate(all="ignore"):
        x, y, g, h = x / w, y / w, g / w, h / w
        a, b, c, d = (
            a / w - x * g,
            b / w - x * h,
            c / w - y * g,
            d / w - y * h,
        )  # derivatives of the image at the centre
        handed = np.sign(a * d - b * c)
        cos, sin = a + handed * d, c - handed * b
        size = np.where(handed != 0, np.hypot(cos, sin), np.nan)
        u = (cos * error[:, 0] + sin * error[:, 1]) / size
        v = handed * (cos * error[:, 1] - sin * error[:, 0]) / size
        # depth is proportional to 1 + g u + h v, so it grows fastest along (g, h)
        away_x, away_y = a * g + b * h, c * g + d * h
        away = np.where(np.hypot(g, h) > LEAST_TILT, np.hypot(away_x, away_y), np.nan)
        along_tilt = (away_x * error[:, 0] + away_y * error[:, 1]) / away
    return np.stack([u, v], axis=1), np.where(np.isfinite(along_tilt), along_tilt, np.nan)


def _normalise(error: Float, covariance: Float) -> tuple[Float, Float]:
    """Return eᵀC⁻¹e of errors (M, 2) and covariances (M, 2, 2), and the standard deviations."""
    x, y = error.T
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = xx * yy - xy * xy
    square = yy * x * x - 2 * xy * x * y + xx * y * y
    nees = np.divide(square, determinant, out=np.full(len(x), np.inf), where=determinant > 0)
    return nees, np.sqrt((xx + yy) / 2)


def compute_uncertainty_metrics(errors: MatchedErrors) -> dict[str, float | None]:
    """Compute bias, scatter, NEES and the median predicted standard deviation. An undefined metric is None."""
    u, v = errors.in_patch[np.isfinite(errors.in_patch[:, 0])].T
    tilt = errors.along_tilt[np.isfinite(errors.along_tilt)]
    found: dict[str, Any] = dict.fromkeys(UNCERTAINTY_METRICS)
    if len(u):
        mean_u, mean_v = np.mean(u), np.mean(v)
        found["bias_px"] = np.hypot(mean_u, mean_v)
        found["bias_u_px"], found["bias_v_px"] = mean_u, mean_v
        found["scatter_px"] = np.sqrt(np.mean((u - mean_u) ** 2 + (v - mean_v) ** 2))
    if len(tilt):
        found["bias_tilt_px"] = np.mean(tilt)
    if errors.nees is not None and errors.sigma_px is not None and len(errors.nees):
        found["sigma_median_px"] = np.median(errors.sigma_px)
        found["nees"] = np.mean(errors.nees) if np.isfinite(errors.nees).all() else None
    return {name: None if value is None else float(value) for name, value in found.items()}


UNCERTAINTY_METRICS = ("bias_px", "bias_u_px", "bias_v_px", "bias_tilt_px", "scatter_px", "sigma_median_px", "nees")
"""Names of the metrics of :func:`compute_uncertainty_metrics`."""


def estimate_nees_interval(errors: MatchedErrors, resamples: int, seed: int) -> Interval | None:
    """Return the 95 % interval of the mean NEES, from a bootstrap over the scenes with matched keypoints."""
    if errors.nees is None or not len(errors.nees) or not np.isfinite(errors.nees).all():
        return None
    order = np.lexsort((errors.nees, errors.scene))
    first = np.flatnonzero(np.append(True, np.diff(errors.scene[order]) != 0))
    sums = np.stack([np.add.reduceat(errors.nees[order], first), np.diff([*first, len(order)])], axis=1)

    def mean(total: NDArray[Any]) -> dict[str, Float]:
        whole = total[..., 1]
        return {"nees": np.divide(total[..., 0], whole, out=np.full(np.shape(whole), np.nan), where=whole > 0)}

    return bootstrap_intervals(sums, mean, resamples, seed)["nees"]


def compute_nees_by_sigma(outcomes: Outcomes) -> list[dict[str, Any]]:
    """Compute the NEES of the matched keypoints of each quintile of the predicted standard deviation.

    Equal standard deviations stay together, so there may be fewer than five bins.

    Returns
    -------
    list of dict
        ``sigma_px`` [least, largest], ``matched``, ``nees`` and its ``interval``; empty without covariances.
    """
    row = np.flatnonzero(outcomes.matched)
    errors = measure_errors(outcomes, row)
    if not len(row) or errors.sigma_px is None:
        return []
    order = errors.rank(outcomes.matches.distance[row])
    sigma, errors = errors.sigma_px[order], errors.select(order)
    edges = np.quantile(sigma, np.arange(1, BINS) / BINS, method="inverted_cdf")
    bin_of = np.searchsorted(edges, sigma)
    settings, bins = outcomes.settings, []
    for n in np.unique(bin_of):
        inside = np.flatnonzero(bin_of == n)
        part = errors.select(inside)
        bins.append(
            {
                "sigma_px": [float(sigma[inside].min()), float(sigma[inside].max())],
                "matched": len(inside),
                "nees": compute_uncertainty_metrics(part)["nees"],
                "interval": estimate_nees_interval(part, settings.resamples, settings.seed),
            }
        )
    return bins
