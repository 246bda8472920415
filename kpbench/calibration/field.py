"""The field of residuals on the board of one photograph, by universal kriging.

Lens, pose and shape of the print leave a smooth field on the board: a thin prism, a rolling shutter, a sheet that
bends otherwise. The residuals of the marks are ``J b + f + e``: a correction b of the pose with any value, a Gaussian
process f with Matern's covariance (C. E. Rasmussen, C. K. I. Williams, "Gaussian processes for machine learning", 2006,
eq. 4.17 and 2.41), and the errors e of the marks. Amplitude and length of f are averaged over their posterior, from the
restricted likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kpbench.types import Float, Int

FIELD_LENGTHS = (0.15, 0.4, 1.0)
"""Lengths of the process, in diagonals of the board."""
AMPLITUDES = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0)
"""Variances of the process, in mean variances of the marks. 0 is considered, too."""
LEAST_WEIGHT = 0.02
"""Posterior weight, relative to the largest one, below which amplitude and length are left out."""
LEAST_MARK_NOISE = 0.25
"""Least variance of the errors, in stated variances: more marks than a few tell no smaller one."""


class FieldPrediction(NamedTuple):
    """The field at m points."""

    mean: Float
    """Of shape (m, 2), px."""
    covariance: Float
    """Of shape (m, 2, 2), px²."""


class LeaveOneOut(NamedTuple):
    """Residuals of m points that are predicted from the points of all other marks."""

    error: Float
    """Of shape (m, 2): seen minus predicted, px."""
    nees: Float
    """Normalised squared error of each point, of shape (m,); 2 on average."""


@dataclass(frozen=True)
class _Model:
    """One amplitude and length, with what all predictions need."""

    weight: float
    amplitude: float
    length_mm: float
    scale: float
    precision: Float
    """Inverse of the covariance of one coordinate of the residuals, up to ``scale``; of shape (n, n)."""
    trend: Float
    """Of shape (2 n, 6); the rows of a point's x and y follow each other."""
    trend_covariance: Float
    beta: Float
    weighted_rest: Float
    """Precision times the residuals without trend, of shape (n, 2)."""

    def cover(self, a_mm: Float, b_mm: Float) -> Float:
        return _matern(a_mm, b_mm, self.length_mm) * self.amplitude


@dataclass(frozen=True)
class ResidualField:
    """The field of one photograph.

    Attributes
    ----------
    points_mm : ndarray of shape (n, 2)
    models : tuple
    """

    points_mm: Float
    models: tuple[_Model, ...]

    def predict(self, at_mm: Float, by_pose: Float) -> FieldPrediction:
        """Return the field at points of the board, with the correction of the pose.

        Parameters
        ----------
        at_mm : ndarray of shape (m, 2)
        by_pose : ndarray of shape (m, 2, 6)
            Derivatives of the images of these points by the pose.
        """
        means, covariances = list[Float](), list[Float]()
        for model in self.models:
            cross = model.cover(at_mm, self.points_mm)
            gain = cross @ model.precision
            through = np.einsum("mn,nij->mij", gain, model.trend.reshape(len(self.points_mm), 2, -1))
            rest = by_pose - through
            means.append(by_pose @ model.beta + cross @ model.weighted_rest)
            variance = np.maximum(model.amplitude - (gain * cross).sum(axis=1), 0.0)
            covariance = variance[:, None, None] * np.eye(2) + rest @ model.trend_covariance @ rest.transpose(0, 2, 1)
            covariances.append(covariance * model.scale)
        weight = np.array([model.weight for model in self.models])
        mean = np.einsum("k,kmi->mi", weight, np.array(means))
        off = np.array(means) - mean
        total = np.array(covariances) + off[..., :, None] * off[..., None, :]
        return FieldPrediction(mean, np.einsum("k,kmij->mij", weight, total))

    def leave_one_out(self, residual: Float, group: Int) -> LeaveOneOut:
        """Predict the points of each group, a mark, from all other points (O. Dubrule, 1983).

        Parameters
        ----------
        residual : ndarray of shape (n, 2)
        group : ndarray of shape (n,), int64
        """
        model = max(self.models, key=lambda m: m.weight)
        n = len(residual)
        whole = np.kron(model.precision, np.eye(2))
        through = whole @ model.trend
        P = whole - through @ model.trend_covariance @ through.T
        weighted = P @ residual.ravel()
        error, nees = np.zeros((n, 2)), np.zeros(n)
        for g in np.unique(group):
            rows = np.flatnonzero(group == g)
            both = np.stack([2 * rows, 2 * rows + 1], axis=1).ravel()
            covariance = np.linalg.inv(P[np.ix_(both, both)])
            off = (covariance @ weighted[both]).reshape(-1, 2)
            error[rows] = off
            for k, row in enumerate(rows):
                own = covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] * model.scale
                nees[row] = off[k] @ np.linalg.solve(own, off[k])
        return LeaveOneOut(error, nees)


def fit_field(points_mm: Float, residual: Float, variance: Float, by_pose: Float) -> ResidualField:
    """Fit the field of one photograph.

    Parameters
    ----------
    points_mm : ndarray of shape (n, 2)
    residual : ndarray of shape (n, 2)
        Seen minus projected, px.
    variance : ndarray of shape (n,)
        Variance of a coordinate of each point, px², up to a common factor.
    by_pose : ndarray of shape (n, 2, 6)
    """
    n = len(points_mm)
    size = float(np.hypot(*np.ptp(points_mm, axis=0)))
    scale_of_pose = np.sqrt((by_pose**2).mean(axis=(0, 1)))
    trend = (by_pose / scale_of_pose).reshape(2 * n, -1)
    candidates = [(0.0, FIELD_LENGTHS[0]), *((a, length) for a in AMPLITUDES for length in FIELD_LENGTHS)]
    found = list[tuple[float, _Model]]()
    for ratio, length in candidates:
        amplitude = ratio * float(variance.mean())
        K = _matern(points_mm, points_mm, length * size) * amplitude + np.diag(variance)
        precision = np.asarray(np.linalg.inv(K), np.float64)
        through = np.einsum("nm,mik->nik", precision, trend.reshape(n, 2, -1)).reshape(2 * n, -1)
        information = trend.T @ through
        covariance = np.asarray(np.linalg.inv(information), np.float64)
        beta = covariance @ (through.T @ residual.ravel())
        rest = (residual.ravel() - trend @ beta).reshape(n, 2)
        weighted = precision @ rest
        freedom = 2 * n - trend.shape[1]
        scale = max(float((rest * weighted).sum()) / freedom, LEAST_MARK_NOISE)
        likelihood = -float(np.linalg.slogdet(K)[1]) - 0.5 * float(np.linalg.slogdet(information)[1])
        likelihood -= 0.5 * freedom * np.log(scale)
        model = _Model(
            0.0,
            amplitude,
            length * size,
            scale,
            precision,
            trend * np.tile(scale_of_pose, (2 * n, 1)),
            covariance / np.outer(scale_of_pose, scale_of_pose),
            beta / scale_of_pose,
            np.asarray(weighted),
        )
        found.append((likelihood, model))
    best = max(likelihood for likelihood, _ in found)
    kept = [(float(np.exp(likelihood - best)), model) for likelihood, model in found]
    kept = [(weight, model) for weight, model in kept if weight >= LEAST_WEIGHT]
    total = sum(weight for weight, _ in kept)
    return ResidualField(
        points_mm, tuple(_Model(weight / total, *list(vars(model).values())[1:]) for weight, model in kept)
    )


def _matern(a_mm: Float, b_mm: Float, length_mm: float) -> Float:
    """Return Matern's correlation of order 5/2, ndarray of shape (len(a), len(b))."""
    distance = np.sqrt(5.0) / length_mm * np.linalg.norm(a_mm[:, None] - b_mm, axis=2)
    return np.asarray((1 + distance + distance * distance / 3) * np.exp(-distance))
