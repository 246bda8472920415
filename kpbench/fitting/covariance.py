"""Covariance of a fitted centre: from the normal equations and the measured noise.

If all residuals were independent noise of variance s², the covariance of the unknowns would be s² N⁻¹ (J W² Jᵀ) N⁻¹,
with the derivatives J, the robust weights W and the normal matrix N = J W Jᵀ + priors (P. Huber, *Robust Statistics*,
1981, chapter 7). Noise that neighbouring pixels share counts more. The uncertainty of the priors is added.
"""

from __future__ import annotations

import numpy as np

from kpbench.types import Float, Float32

LEAST_VARIANCE = 1 / 12
"""Variance that rounding to whole grey levels adds to the noise, squared grey levels."""
PIXEL_VARIANCE = 1 / 12
"""Variance of the blur that the area of a pixel adds, px²."""
START_ERROR = 0.1
"""Standard deviation of a centre that was not fitted, in semi-axes of its ellipse."""


def start_covariance(A: Float) -> Float:
    """Return the covariances (..., 2, 2), px², of centres that were not fitted, from maps A (..., 2, 2).

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.fitting.covariance import start_covariance
    >>> start_covariance(np.diag([20.0, 10.0]))
    array([[4., 0.],
           [0., 1.]])
    """
    return np.asarray(START_ERROR**2 * A @ np.swapaxes(A, -1, -2))


def noise_grain(residual: Float32) -> float:
    """Return the variance of the mean of many neighbouring pixels' noise, relative to independent noise.

    It follows from the correlation of neighbours in the rows of the image. In a coarse level of a pyramid, whose kernel
    is (1, 4, 6, 4, 1), it is 3.3.

    Parameters
    ----------
    residual : ndarray of shape (n,)
        Residuals of the pixels of a patch, row by row.
    """
    correlation = float(residual[:-1] @ residual[1:]) / max(float(residual @ residual), 1e-9)
    return float((1 + 2 * max(correlation, 0.0)) ** 2)


def centre_covariance(
    moves: Float32,
    weighted: Float32,
    residual: Float32,
    normal: Float,
    change: Float,
    prior: Float,
    grain: float,
) -> Float:
    """Return the covariance (2, 2) of a fitted centre, px², without the effect of a change of blur.

    Parameters
    ----------
    moves : ndarray of shape (k, n)
        Derivatives of n grey values with respect to the k unknowns. Unknown 0 is a grey level, and unknowns 2 and 3 are
        the centre.
    weighted : ndarray of shape (k, n)
        ``moves`` times the robust weights.
    residual : ndarray of shape (n,)
        Grey levels, before the last step.
    normal : ndarray of shape (k, k)
        Matrix of the normal equations, with priors.
    change : ndarray of shape (k,)
        The last step.
    prior : ndarray of shape (k,)
        What the priors add to the diagonal of ``normal``.
    grain : float
        From :func:`noise_grain`.
    """
    inverse, weight = np.linalg.inv(normal), weighted[0]
    total = float(weight.sum())
    left = residual - change.astype(np.float32) @ moves
    variance = max(float((left * weight) @ left) / max(total - len(moves), 1.0), LEAST_VARIANCE)
    influence = inverse[2:4].astype(np.float32) @ weighted
    # rounding to whole grey levels has no grain
    grained = LEAST_VARIANCE + grain * (variance - LEAST_VARIANCE)
    noise = grained * (influence @ influence.T).astype(np.float64)
    return np.asarray(noise + variance * (inverse[2:4] * prior) @ inverse[2:4].T)
