"""Verification: whether the pixels agree that a place is a patch, which design it is, and where its centre lies.

A detector's network gives *candidates*: places, each with a score and probabilities of the designs. The verification
works in these steps.

1. :func:`find_ellipses`: a small network looks at the surroundings of each place and gives the ellipse that a patch
   there fills, and the log odds that there is one.
2. :func:`propose_poses`: the likely designs are rotated within the ellipse until they agree best with the image.
3. :func:`judge`: the first judge, a small network, sees each hypothesis in the frame of the patch, beside the design
   and the measured :class:`~kpbench.detectors.hypotheses.Evidence`. It gives the log odds that the hypothesis is right
   and corrects its pose. :func:`look_again` shows it the likely ones once more, in the corrected pose.
4. :func:`fit_hypotheses`: the design is fitted to the pixels (:func:`kpbench.fitting.fit`).
5. :func:`judge`: the second judge sees the fit, and how the hypothesis compares with the other patches of the image:
   blur and contrast are much the same for all patches of an image. Its log odds are the result.

:mod:`kpbench.training.verifier` trains the three networks on synthetic images.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from kpbench.detectors.hypotheses import (
    Evidence,
    Hypotheses,
    clipped_semi_axis,
    judge_inputs,
    select_distinct,
    select_likeliest,
)
from kpbench.detectors.inference import InferenceSession, open_session
from kpbench.fitting.align import WHOLE_RADIUS_PX, Poses, align_poses, rotate_within_ellipse
from kpbench.fitting.design_fit import fit
from kpbench.fitting.pyramid import Pyramids
from kpbench.fitting.templates import DesignTemplates, build_templates
from kpbench.fitting.views import rectify, sample_surroundings
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, Int, UInt8
from kpbench.workers import one_blas_thread

VERIFIER = "7"
"""Version of the method. Raise it by one when detections change for any reason but new weights."""
WEIGHTS = Path(__file__).parent / "weights"
"""Folder of the shipped networks."""
ELLIPSE, FIRST_JUDGE, SECOND_JUDGE = "ellipse", "first-judge", "second-judge"
"""Names of the networks, without ``.onnx``."""

# Limits. Chosen on synthetic images over training photographs; notebook/training-log.md has the figures, most of them
# in "Specks, sizes, and how many places an image has" and in "Fewer looks, and what ten thousand more images were
# worth".
ID_MARGIN = 3.0
"""Designs whose log probability by the ID head is lower than the likeliest one's by more than this are not tried."""
ALL_DESIGNS_LOG_ODDS = 0.0
"""Where the ellipse is a patch with at least these log odds, all designs are tried."""
THOROUGH_LOG_ODDS = -4.8
"""From these log odds of an ellipse on, other sizes of it are tried, and a second rotation where both look alike."""
LEAST_ELLIPSE_LOG_ODDS = -6.5
"""A place whose ellipse has lower log odds is dropped."""
SECOND_LOOK_LOG_ODDS = -5.0
"""A hypothesis that has lower log odds at the first look is dropped."""
LEAST_FIT_LOG_ODDS = -3.5
"""A hypothesis that has lower log odds before the fit is not fitted."""
LARGEST_FIT_MOVE = 0.1
"""Short semi-axes. Where the fit moves a centre further, the pose before the fit is kept: it is right more often."""
USUAL_PLACES = 70
"""Candidates of a typical training image of 640x480 px. The judges' log odds hold for images with so many."""
LEAST_SEMI_AXIS_PX = 2.4
"""Short semi-axis of the smallest patch that is reported, px. Smaller patches cannot be told from specks."""
LEAST_CONTRAST = 2.0
"""Grey levels. Hypotheses of a lower half contrast are dropped; the contrast of a fit counts as at least this."""
PLACES_PER_BLOCK = 2**11
"""Places whose surroundings are looked at together: memory does not grow with the image."""


@dataclass(frozen=True)
class VerifiedCandidates:
    """The n candidates that were worth a fit.

    Attributes
    ----------
    place : ndarray of shape (n,), int64
        Index of the candidate.
    design : ndarray of shape (n,), int64
        Index of its likeliest design.
    xy : ndarray of shape (n, 2)
        Fitted centre, px.
    minor_px : ndarray of shape (n,)
        Short semi-axis of the fitted disc, px.
    score : ndarray of shape (n,)
        Probability that there is a patch of this design whose centre is right.

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
    minor_px: Float
    score: Float


def verify_candidates(
    grey: UInt8, xy: Float, network_score: Float, log_id: Float, patches: Sequence[Patch], threads: int = 0
) -> VerifiedCandidates:
    """Compare candidates with the designs that the network holds likely, and fit those that look like a patch.

    Parameters
    ----------
    grey : ndarray of shape (H, W), uint8
    xy : ndarray of shape (n, 2)
        Places, px.
    network_score : ndarray of shape (n,)
        In [0, 1].
    log_id : ndarray of shape (n, len(patches) + 1)
        Log probability of each design, and of no patch.
    patches : sequence of Patch
        The designs.
    threads : int
        Threads of the three networks; 0 means as many as OpenCV may use.

    Returns
    -------
    VerifiedCandidates

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.detectors import verify_candidates
    >>> patches = kpbench.shipped_patches()
    >>> v, u = (np.mgrid[:96, :96] - 47.5) / 20.0
    >>> black = patches[1].is_black(np.stack([u, v], axis=-1))
    >>> image = np.where(np.hypot(u, v) > 1, 120, np.where(black, 40, 210)).astype(np.uint8)
    >>> log_id = np.log(np.full((1, len(patches) + 1), 0.2))
    >>> found = verify_candidates(image, np.array([[48.0, 49.0]]), np.array([0.9]), log_id, patches)
    >>> found.xy.round(1), patches[found.design[0]].name
    (array([[47.5, 47.5]]), 'trefoil')
    """
    pyramids = Pyramids(grey)
    with one_blas_thread():
        proposed = propose_poses(pyramids, xy, network_score, log_id, patches, threads)
        log_odds, corrected = judge(FIRST_JUDGE, proposed, patches, threads)
        shown_again = look_again(pyramids, corrected[log_odds >= SECOND_LOOK_LOG_ODDS], patches)
        log_odds, corrected = judge(FIRST_JUDGE, shown_again, patches, threads)
        chosen = select_distinct(corrected, log_odds, LEAST_FIT_LOG_ODDS)
        fitted = fit_hypotheses(pyramids, corrected[chosen], log_odds[chosen], patches)
    log_odds, _ = judge(SECOND_JUDGE, fitted, patches, threads)
    # the number of patches in an image does not grow with the number of places that look like one
    log_odds = log_odds - np.log(max(1.0, len(xy) / USUAL_PLACES))
    best = select_likeliest(fitted.place, log_odds)
    best = best[clipped_semi_axis(fitted.A[best]) >= LEAST_SEMI_AXIS_PX]
    found, log_odds = fitted[best], log_odds[best]
    score = 1 / (1 + np.exp(-log_odds))
    return VerifiedCandidates(found.place, found.design, found.xy, clipped_semi_axis(found.A), score)


def find_ellipses(pyramids: Pyramids, xy: Float, threads: int = 0) -> tuple[Float, Float, Float]:
    """Find the ellipse that a patch at each place fills.

    Parameters
    ----------
    pyramids : Pyramids
    xy : ndarray of shape (n, 2)
        Places, px, within about half a short semi-axis of the centre.
    threads : int
        As for :func:`verify_candidates`.

    Returns
    -------
    centre : ndarray of shape (n, 2)
        px.
    A : ndarray of shape (n, 2, 2)
        Symmetric map of the unit circle to the ellipse, px.
    log_odds : ndarray of shape (n,)
        That the place lies on a patch.
    """
    parts = [(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))]
    for block in np.split(xy, range(PLACES_PER_BLOCK, len(xy), PLACES_PER_BLOCK)) if len(xy) else ():
        given = {"surroundings": sample_surroundings(pyramids.smooth, block)}
        log_odds, shift, log_map = _session(ELLIPSE, threads).run(None, given)
        one_to_one = np.tile(np.eye(2), (len(block), 1, 1))
        parts.append((*move_poses(block, one_to_one, shift, log_map), _clip_log_odds(log_odds)))
    centre, A, every_log_odds = (np.concatenate(column) for column in zip(*parts, strict=True))
    return centre, A, every_log_odds


def move_poses(xy: Float, A: Float, shift: Float32 | Float, log_map: Float32 | Float) -> tuple[Float, Float]:
    """Apply the corrections of a network to n poses.

    Parameters
    ----------
    xy, A : ndarray of shape (n, 2) and (n, 2, 2)
        Poses, px.
    shift : ndarray of shape (n, 2)
        Change of the centre, in the frame of the new pose.
    log_map : ndarray of shape (n, 2, 2)
        Symmetric; the new map is ``A @ exp(log_map)``.

    Returns
    -------
    xy, A : ndarray of shape (n, 2) and (n, 2, 2)
    """
    size, axes = np.linalg.eigh(log_map.astype(np.float64))
    A = A @ np.einsum("nij,nj,nkj->nik", axes, np.exp(np.clip(size, -6, 6)), axes)
    return xy + np.einsum("nij,nj->ni", A, shift), A


def _clip_log_odds(log_odds: Float32) -> Float:
    return np.asarray(np.clip(log_odds, -30, 30), np.float64)


def propose_poses(
    pyramids: Pyramids, xy: Float, network_score: Float, log_id: Float, patches: Sequence[Patch], threads: int = 0
) -> Hypotheses:
    """Return hypotheses of the likely designs at every place that may be a patch.

    Parameters are those of :func:`verify_candidates`.
    """
    templates = build_templates(patches)
    centre, A, log_odds = find_ellipses(pyramids, xy, threads)
    likely = log_id[:, :-1] >= log_id[:, :-1].max(axis=1, keepdims=True) - ID_MARGIN
    tried = (likely | (log_odds >= ALL_DESIGNS_LOG_ODDS)[:, None]) & (log_odds >= LEAST_ELLIPSE_LOG_ODDS)[:, None]
    place, design = np.nonzero(tried)
    thorough = (log_odds >= THOROUGH_LOG_ODDS)[place]
    row, poses = rotate_within_ellipse(pyramids.smooth, centre[place], A[place], design, templates, thorough)
    place, design = place[row], design[row]
    of_networks = np.column_stack(
        [
            _log_odds(network_score[place]),
            np.log(np.maximum(1 - np.exp(log_id[place, -1]), 1e-4)),
            log_id[place, design],
            log_odds[place],
        ]
    )
    return _measure(pyramids, place, xy[place], poses, of_networks, templates)


def look_again(pyramids: Pyramids, corrected: Hypotheses, patches: Sequence[Patch]) -> Hypotheses:
    """Return hypotheses whose poses a judge has corrected, with view and evidence for the corrected poses."""
    templates = build_templates(patches)
    poses = Poses(corrected.xy, corrected.A, corrected.design, np.zeros(len(corrected)))
    poses = align_poses(pyramids.smooth, poses, templates.whole, 0, WHOLE_RADIUS_PX)
    of_networks = corrected.evidence[:, : Evidence.NCC]
    return _measure(pyramids, corrected.place, corrected.place_xy, poses, of_networks, templates)


def _measure(
    pyramids: Pyramids, place: Int, place_xy: Float, poses: Poses, of_networks: Float, templates: DesignTemplates
) -> Hypotheses:
    """Return the hypotheses of some poses with their views and evidence; those of too low a contrast are left out.

    ``of_networks`` : (n, 4) evidence of the networks, the columns before ``Evidence.NCC``.
    """
    view, half_contrast = rectify(pyramids.smooth, poses.xy, poses.A, poses.design, templates)
    minor = clipped_semi_axis(poses.A)
    measured = [
        -np.log(1.01 - poses.ncc),
        np.log(np.linalg.norm(poses.xy - place_xy, axis=1) / minor + 0.02),
        *_contrast_evidence(half_contrast, pyramids),
        np.log(minor),
    ]
    evidence = np.column_stack([of_networks, *measured])
    found = Hypotheses(place, place_xy, poses.design, poses.xy, poses.A, view, np.zeros(len(place)), evidence)
    return found[half_contrast > LEAST_CONTRAST]


def fit_hypotheses(pyramids: Pyramids, before: Hypotheses, log_odds: Float, patches: Sequence[Patch]) -> Hypotheses:
    """Return the same hypotheses in the poses that fit the pixels best; where a fit moved far, in the pose before.

    ``log_odds`` : (n,) by the first judge.
    """
    fits = fit(pyramids.raw, before.xy, before.A, [patches[n] for n in before.design])
    contrast, minor = np.maximum(fits.white - fits.black, LEAST_CONTRAST), clipped_semi_axis(fits.A)
    shift, move = (np.linalg.norm(fits.xy - start, axis=1) / minor for start in (before.place_xy, before.xy))
    unexplained = np.minimum(np.sqrt(np.maximum(fits.noise**2 - pyramids.noise**2, 0)) / contrast, 3.0)
    measured = np.column_stack(
        [
            -np.log(1.01 - fits.ncc),
            np.log(unexplained + 0.02),
            np.minimum(fits.blur_px / minor, 1.0),
            np.log(shift + 0.02),
            np.log(move + 0.02),
            *_contrast_evidence(contrast, pyramids),
            np.log(minor),
            log_odds,
        ]
    )
    far = move > LARGEST_FIT_MOVE
    xy, A = np.where(far[:, None], before.xy, fits.xy), np.where(far[:, None, None], before.A, fits.A)
    view, _ = rectify(pyramids.smooth, xy, A, before.design, build_templates(patches))
    shared = np.column_stack([np.log(fits.blur_px + 0.3), np.log(contrast)])
    evidence = np.column_stack([before.evidence, measured, _compare_with_others(xy, minor, log_odds, shared)])
    return Hypotheses(before.place, before.place_xy, before.design, xy, A, view, fits.blur_px, evidence)


def _compare_with_others(xy: Float, minor_px: Float, log_odds: Float, shared: Float) -> Float:
    """Compare each hypothesis with the likely hypotheses elsewhere in the image.

    Parameters
    ----------
    xy, minor_px, log_odds : ndarray of shape (n, 2), (n,) and (n,)
        Centres and short semi-axes, px, and log odds by the first judge.
    shared : ndarray of shape (n, k)
        Measures that the patches of an image have in common.

    Returns
    -------
    ndarray of shape (n, 2 + k)
        Logs of 1 + the number of other hypotheses that are probably right, and probably wrong. Then the difference of
        each column of ``shared`` from its mean over the right ones; it tends to 0 where there are hardly any.
    """
    right = 1 / (1 + np.exp(-log_odds))
    elsewhere = np.linalg.norm(xy[:, None] - xy, axis=2) > minor_px[:, None]
    patches, errors = elsewhere @ right, elsewhere @ (1 - right)
    weight = elsewhere * right / (patches + 0.3)[:, None]
    difference = shared * weight.sum(axis=1, keepdims=True) - weight @ shared
    return np.column_stack([np.log1p(patches), np.log1p(errors), difference])


def judge(network: str, hypotheses: Hypotheses, patches: Sequence[Patch], threads: int = 0) -> tuple[Float, Hypotheses]:
    """Judge hypotheses by ``FIRST_JUDGE`` or ``SECOND_JUDGE``.

    Returns
    -------
    log_odds : ndarray of shape (n,)
        That there is a patch of this design whose centre is right.
    corrected : Hypotheses
        The same hypotheses in the poses that the judge takes for right.
    """
    if not len(hypotheses):
        return np.zeros(0), hypotheses
    log_odds, shift, log_map = _session(network, threads).run(None, judge_inputs(hypotheses, patches))
    xy, A = move_poses(hypotheses.xy, hypotheses.A, shift, log_map)
    return _clip_log_odds(log_odds), replace(hypotheses, xy=xy, A=A)


def verifier_version(*candidate_settings: object) -> str:
    """Return :data:`VERIFIER` and the first digits of a SHA-256 of the weights and of the candidates' settings."""
    weights = [(WEIGHTS / f"{name}.onnx").read_bytes() for name in (ELLIPSE, FIRST_JUDGE, SECOND_JUDGE)]
    digest = hashlib.sha256(b"".join([*weights, repr(candidate_settings).encode()])).hexdigest()
    return f"v{VERIFIER}-{digest[:8]}"


def _session(network: str, threads: int) -> InferenceSession:
    return _open(network, threads or cv2.getNumThreads())


@cache
def _open(network: str, threads: int) -> InferenceSession:
    return open_session((WEIGHTS / f"{network}.onnx").read_bytes(), threads)[0]


def _contrast_evidence(contrast: Float, pyramids: Pyramids) -> list[Float]:
    """Return the logs of contrasts (n,), grey levels, over the range of the image and over its noise."""
    return [np.log(contrast / (pyramids.grey_range + 5)), np.log(contrast / (pyramids.noise + 1))]


def _log_odds(probability: Float) -> Float:
    clipped = np.clip(probability, 1e-3, 1 - 1e-3)
    return np.asarray(np.log(clipped / (1 - clipped)))
