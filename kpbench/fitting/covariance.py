"""Covariance of a fitted centre: from the normal equations, the measured noise, and what the model cannot explain.

The last step of a fit gives the normal matrix and the residuals. Three parts are added:

1. Noise. If all residuals were independent noise of variance s², the covariance of the unknowns would be
   s² N⁻¹ (J W² Jᵀ) N⁻¹, with the derivatives J, the robust weights W and the normal matrix N = J W Jᵀ + priors
   (P. Huber, *Robust Statistics*, 1981, chapter 7). Noise of neighbouring pixels that is alike counts more.
2. Priors. The unknowns that have a prior differ from it.
3. What a richer model would change. In real images, blur is wider in one direction. The fit has no unknowns for this.
   Their coefficients are estimated from the residuals, with priors. They say how far the centre would move if they were
   unknowns of the fit.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.types import Float, Float32, Int

Real = NDArray[np.floating[Any]]

LEAST_VARIANCE = 1 / 12
"""Variance that rounding to whole grey levels adds to the noise, squared grey levels."""
PIXEL_VARIANCE = 1 / 12
"""Variance of the blur that the area of a pixel adds, px²."""
UNEVEN_BLUR_PX2 = 1.2
"""Prior of the richer model: standard deviation of the difference of the blur's variances in two directions, px²."""
RICHER_SHARE = 0.5
"""Share of the shift by the richer model that is counted. Chosen on training photographs."""
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


def uneven_columns(ink: Float32, at: Int, steep: Real) -> Real:
    """Return the derivatives (2, n) of n grey values with respect to the unevenness of the blur.

    The unknowns are half the difference of the blur's variances along x and y, and their covariance. Each has a prior
    with standard deviation 1.

    Parameters
    ----------
    ink : ndarray of shape (h, w)
        Blurred coverage by black ink.
    at : ndarray of shape (n,), int64
        Flat indices of the pixels in ``ink``.
    steep : ndarray of shape (n,)
        Derivatives of the grey values with respect to the ink.
    """
    xx, yy = (cv2.Sobel(ink, cv2.CV_32F, *order, ksize=1).ravel()[at] for order in ((2, 0), (0, 2)))
    xy = cv2.Sobel(ink, cv2.CV_32F, 1, 1, ksize=3, scale=0.25).ravel()[at]
    uneven = UNEVEN_BLUR_PX2 / 2 * steep
    return np.stack([uneven / 2 * (xx - yy), uneven * xy])


def centre_covariance(
    moves: Float32,
    weighted: Float32,
    residual: Float32,
    normal: Float,
    change: Float,
    prior: Float,
    richer: Real,
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
    prior : ndarray of shape (p,)
        What the priors add to the diagonal of ``normal``, for the last p unknowns.
    richer : ndarray of shape (m, n)
        From :func:`uneven_columns`.
    grain : float
        From :func:`noise_grain`.
    """
    inverse, weight = np.linalg.inv(normal), weighted[0]
    total = float(weight.sum())
    columns = np.concatenate([richer, (residual - change.astype(np.float32) @ moves)[None]])
    across = (weighted @ columns.T).astype(np.float64)
    products = ((columns * weight) @ columns.T).astype(np.float64)
    squares = float(products[-1, -1])
    products -= across.T @ (inverse @ across)  # the unknowns of the fit take their part
    within, target = products[:-1, :-1], products[:-1, -1]
    degrees = max(total - len(moves), 1.0)
    found = np.linalg.solve(within + max(squares / degrees, LEAST_VARIANCE) * np.eye(len(within)), target)
    variance = max((squares - 2 * float(found @ target) + float(found @ within @ found)) / degrees, LEAST_VARIANCE)
    influence = inverse[2:4].astype(np.float32) @ weighted
    shift, unsure = RICHER_SHARE * (inverse[2:4] @ (across[:, :-1] @ found)), inverse[2:4, -len(prior) :]
    # rounding to whole grey levels has no grain
    grained = LEAST_VARIANCE + grain * (variance - LEAST_VARIANCE)
    noise = grained * (influence @ influence.T).astype(np.float64)
    return np.asarray(noise + variance * (unsure * prior) @ unsure.T + np.outer(shift, shift))
