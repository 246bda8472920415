"""Covariance of a fitted centre: from the normal equations, the measured noise, and what the model cannot explain.

The last step of a fit gives the normal matrix and the residuals. Four parts are added:

1. Noise. If all residuals were independent noise of variance s², the covariance of the unknowns would be
   s² N⁻¹ (J W² Jᵀ) N⁻¹, with the derivatives J, the robust weights W and the normal matrix N = J W Jᵀ + priors
   (P. Huber, *Robust Statistics*, 1981, chapter 7).
2. What a richer model would change. In real images, light falls off across a patch, and blur is wider in one direction.
   The fit has no unknowns for these. Their coefficients are estimated from the residuals, with priors. They say how far
   the centre would move if they were unknowns of the fit.
3. The rest of the way. A fit stops before it stands still. The centre is still off by a share of its last step.
4. Rejected pixels. Robust weights below 1 tell that the model is wrong in places.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.types import Float, Float32, Int

Real = NDArray[np.floating[Any]]

LEAST_VARIANCE = 1 / 6
"""Lower limit of the variance of the noise, squared grey levels. Rounding to whole grey levels has 1/12, but is not
independent from pixel to pixel. The factor 2 was chosen on training photographs."""
PIXEL_VARIANCE = 1 / 12
"""Variance of the blur that the area of a pixel adds, px²."""
LEVEL_GRAIN = 3.3
"""Grain of the noise in every pyramid level but level 0, see :func:`centre_covariance`. The kernel (1, 4, 6, 4, 1) of
the pyramid leaves a correlation of 28/70 between neighbours, and of 1/70 at two pixels: (1 + 2·29/70)² = 3.3."""
LIGHT_SLOPE = 0.03
"""Prior of the richer model: standard deviation of the change of light from the centre to the rim, as a share."""
UNEVEN_BLUR_PX2 = 1.2
"""Prior of the richer model: standard deviation of the difference of the blur's variances in two directions, px²."""
RICHER_SHARE = 0.7
"""Share of the shift by the richer model that is counted. Chosen on training photographs."""
LAST_STEP_SHARE = 0.3
"""Standard deviation of the rest of the way, in last steps of the centre. Chosen on training photographs."""
REJECTED_PX = 1.0
"""Standard deviation of the centre, px, is this times the square of the rejected share of the weights. Chosen on
training photographs."""
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


def richer_columns(ink: Float32, at: Int, grey: Real, steep: Real, u: Real, v: Real) -> Real:
    """Return the derivatives (4, n) of n grey values of a patch with respect to the unknowns of the richer model.

    The unknowns are the slope of the light along u and v, and the unevenness of the blur: half the difference of its
    variances along x and y, and its covariance. Each has a prior with standard deviation 1.

    Parameters
    ----------
    ink : ndarray of shape (h, w)
        Blurred coverage by black ink.
    at : ndarray of shape (n,), int64
        Flat indices of the pixels in ``ink``.
    grey : ndarray of shape (n,)
        Grey values of the model.
    steep : ndarray of shape (n,)
        Derivatives of the grey values with respect to the ink.
    u, v : ndarray of shape (n,)
        Places in the patch frame.
    """
    xx, yy = (cv2.Sobel(ink, cv2.CV_32F, *order, ksize=1).ravel()[at] for order in ((2, 0), (0, 2)))
    xy = cv2.Sobel(ink, cv2.CV_32F, 1, 1, ksize=3, scale=0.25).ravel()[at]
    light, uneven = LIGHT_SLOPE * grey, UNEVEN_BLUR_PX2 / 2 * steep
    return np.stack([light * u, light * v, uneven / 2 * (xx - yy), uneven * xy])


def centre_covariance(
    moves: Float, weighted: Float, residual: Float32, normal: Float, change: Float, richer: Real, grain: float
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
    richer : ndarray of shape (m, n)
        From :func:`richer_columns`.
    grain : float
        Variance of the mean of many neighbouring pixels' noise, relative to independent noise.
    """
    inverse, weight = np.linalg.inv(normal), weighted[0]
    total = float(weight.sum())
    columns = np.concatenate([richer, (residual - change @ moves)[None]])
    across = weighted @ columns.T
    products = (columns * weight) @ columns.T
    squares = float(products[-1, -1])
    products -= across.T @ (inverse @ across)  # the unknowns of the fit take their part
    within, target = products[:-1, :-1], products[:-1, -1]
    degrees = max(total - len(moves), 1.0)
    prior = max(squares / degrees, LEAST_VARIANCE) * np.eye(len(within))
    found = np.linalg.solve(within + prior, target)
    variance = max((squares - 2 * float(found @ target) + float(found @ within @ found)) / degrees, LEAST_VARIANCE)
    influence, shift = inverse[2:4] @ weighted, RICHER_SHARE * (inverse[2:4] @ (across[:, :-1] @ found))
    step, rejected = LAST_STEP_SHARE * change[2:4], REJECTED_PX * (1 - total / len(weight)) ** 2
    even = float(step @ step) + rejected**2
    return np.asarray(
        grain * variance * (influence @ influence.T) + np.outer(shift, shift) + np.outer(step, step) + even * np.eye(2)
    )
