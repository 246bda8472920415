"""Hypotheses of the verification: places, each with a design, a pose and evidence.

:mod:`kpbench.detectors.verification` introduces the networks, the judges and the steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.detectors.suppression import suppress
from kpbench.fitting.align import short_semi_axis
from kpbench.fitting.templates import VIEW_PX, build_templates
from kpbench.fitting.views import blur_views
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, Int

MERGE_DISTANCE = 0.2
"""Of two hypotheses of one design, the less likely is dropped if the centres are nearer than this, in short semi-axes
of the likelier hypothesis."""
UNUSED_COLUMNS = 4
"""The second judge was trained on evidence with this many further columns, which compared a hypothesis with others
elsewhere in the image. They are 0, as for the only patch of an image, so that a score depends on its surroundings."""


class Evidence(IntEnum):
    """Columns of the evidence that a judge sees.

    The first judge sees the columns from ``NETWORK_SCORE`` to ``RADIUS``. The second judge, after the fit, sees all
    columns, and ``UNUSED_COLUMNS`` columns of zeros. All evidence comes from the surroundings of the place. Logs are
    natural. Distances are in short semi-axes. Most formulas leave out the small constants that keep the logs finite.
    The contrast is white - black.
    """

    NETWORK_SCORE = 0
    """Log odds of the detector head's score."""
    ID_PATCH = 1
    """Log probability, by the ID head, that there is a patch."""
    ID_DESIGN = 2
    """Log probability of the design, by the ID head."""
    ELLIPSE = 3
    """Log odds that the place lies on a patch, by the ellipse network."""
    NCC = 4
    """-log(1.01 - correlation of the whole design with the image)."""
    SHIFT = 5
    """Log of the distance from the candidate's place to the centre."""
    CONTRAST = 6
    """log(contrast / 2 / range of the grey levels around the place)."""
    CONTRAST_TO_NOISE = 7
    """log(contrast / 2 / noise around the place)."""
    RADIUS = 8
    """Log of the short semi-axis, px of the picture in which the place was found."""
    FIT_NCC = 9
    """-log(1.01 - correlation of the fitted design with the image)."""
    FIT_UNEXPLAINED = 10
    """log(√(residual² - noise²) / contrast), with the standard deviations of the fit's residuals and of the noise."""
    FIT_BLUR = 11
    """Standard deviation of the blur, in short semi-axes."""
    FIT_SHIFT = 12
    """Log of the distance from the candidate's place to the fitted centre."""
    FIT_MOVE = 13
    """Log of the distance from the centre before the fit to the fitted centre."""
    FIT_CONTRAST = 14
    """log(fitted contrast / range of the grey levels around the place)."""
    FIT_CONTRAST_TO_NOISE = 15
    """log(fitted contrast / noise around the place)."""
    FIT_RADIUS = 16
    """Log of the fitted short semi-axis, px of the picture in which the place was found."""
    FIRST_JUDGE = 17
    """Log odds that the first judge gave."""


@dataclass(frozen=True)
class Hypotheses:
    """n hypotheses. Each hypothesis says that a place lies on a patch of one design, in one pose.

    Attributes
    ----------
    place : ndarray of shape (n,), int64
        Index of the place among the candidates.
    place_xy : ndarray of shape (n, 2)
        Position of the place, px.
    octave : ndarray of shape (n,), int64
        Pyramid level of the picture in which the place was found.
    noise, grey_range : ndarray of shape (n,)
        Of the surroundings of the place, from :meth:`kpbench.fitting.pyramid.Pyramids.measure_surroundings`.
    design : ndarray of shape (n,), int64
        Index of the design.
    xy, A : ndarray of shape (n, 2) and (n, 2, 2)
        Pose: the centre, px, and the map from the patch frame to px.
    covariance : ndarray of shape (n, 2, 2)
        Covariance of the error of ``xy``, px².
    view : ndarray of shape (n, VIEW_PX²)
        The image in the frame of the patch, from :func:`kpbench.fitting.views.rectify`; nan outside the image.
    blur_px : ndarray of shape (n,)
        Standard deviation of the fitted blur, px; 0 before the fit.
    evidence : ndarray of shape (n, columns)
        Columns of :class:`Evidence`.
    """

    place: Int
    place_xy: Float
    octave: Int
    noise: Float
    grey_range: Float
    design: Int
    xy: Float
    A: Float
    covariance: Float
    view: NDArray[np.floating[Any]]
    blur_px: Float
    evidence: Float

    def __len__(self) -> int:
        return len(self.place)

    def __getitem__(self, keep: Any) -> Hypotheses:
        return Hypotheses(*(column[keep] for column in vars(self).values()))

    @classmethod
    def concatenate(cls, parts: Sequence[Hypotheses]) -> Hypotheses:
        """Return the hypotheses of all parts, part by part."""
        return cls(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


@dataclass(frozen=True)
class VerifiedCandidates:
    """The n candidates that passed all steps, each with its likeliest design.

    Attributes
    ----------
    place : ndarray of shape (n,), int64
        Index of the candidate.
    design : ndarray of shape (n,), int64
        Index of the design.
    xy : ndarray of shape (n, 2)
        Fitted centre, px.
    A : ndarray of shape (n, 2, 2)
        Map from the patch frame to px.
    covariance : ndarray of shape (n, 2, 2)
        Covariance of the error of ``xy``, px².
    blur_px : ndarray of shape (n,)
        Standard deviation of the fitted blur, px.
    score : ndarray of shape (n,)
        Probability that there is a patch of this design and that the centre is right.

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.detectors import verify_candidates
    >>> image, no_places = np.full((48, 64), 120, np.uint8), np.zeros((0, 2))
    >>> found = verify_candidates(image, no_places, np.zeros(0), np.zeros((0, 5)), kpbench.shipped_patches())
    >>> found.place, found.score
    (array([], dtype=int64), array([], dtype=float64))
    """

    place: Int
    design: Int
    xy: Float
    A: Float
    covariance: Float
    blur_px: Float
    score: Float


def select_likeliest(place: Int, log_odds: Float) -> Int:
    """Return the index of the likeliest hypothesis of each place, in the order of the places."""
    order = np.lexsort((-log_odds, place))
    return order[np.flatnonzero(np.diff(place[order], prepend=-1))]


def select_distinct(hypotheses: Hypotheses, log_odds: Float, least_log_odds: float) -> Int:
    """Return the indices of distinct hypotheses with at least ``least_log_odds``.

    Of hypotheses of one design with centres nearer than :data:`MERGE_DISTANCE`, only the likeliest is kept.
    """
    likely = np.flatnonzero(log_odds >= least_log_odds)
    kept = [np.zeros(0, np.int64)]
    for design in np.unique(hypotheses.design[likely]):
        rows = likely[hypotheses.design[likely] == design]
        reach = MERGE_DISTANCE * clipped_semi_axis(hypotheses.A[rows])
        kept.append(rows[suppress(hypotheses.xy[rows], log_odds[rows], reach)])
    return np.sort(np.concatenate(kept))


def judge_inputs(hypotheses: Hypotheses, patches: Sequence[Patch]) -> dict[str, Float32]:
    """Return the inputs of a judge's network.

    Returns
    -------
    dict
        ``view`` has the shape (n, 2, VIEW_PX, VIEW_PX): the image and the design in the frame of the patch. The design
        is blurred by ``blur_px``. Both are 0 at pixels outside the image. ``evidence`` has the shape (n, columns).
    """
    design = build_templates(patches).view[hypotheses.design]
    soft = np.flatnonzero(hypotheses.blur_px)
    design[soft] = blur_views(design[soft], hypotheses.A[soft], hypotheses.blur_px[soft])
    pair = np.stack([hypotheses.view, design], axis=1)
    pair[np.broadcast_to(np.isnan(hypotheses.view)[:, None], pair.shape)] = 0
    return {"view": pair.reshape(-1, 2, VIEW_PX, VIEW_PX), "evidence": hypotheses.evidence.astype(np.float32)}


def clipped_semi_axis(A: Float) -> Float:
    """Return the short semi-axes (n,) of maps (n, 2, 2), px. Semi-axes below 0.5 px are raised to 0.5 px."""
    return np.maximum(short_semi_axis(A), 0.5)
