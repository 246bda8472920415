"""Verification of a network's candidates on the pixels: is there a patch, of which design, and where is its centre?

A candidate is a place that the reference network found (:mod:`kpbench.detectors.superpoint`). The network's detector
head gives the place and its score. The network's ID head gives the probability of each design and of no patch. The
verification works in five steps.

1. Ellipses (:func:`find_ellipses`). A small network, the ellipse network, sees the surroundings of each place. The
   ellipse network gives the ellipse that a patch at this place would fill, and the log odds that the place lies on a
   patch.
2. Poses (:func:`propose_poses`). The likely designs are rotated within the ellipse until they agree best with the
   image. A place with a design and a pose is a hypothesis.
3. First judge (:func:`judge`). A small network sees each hypothesis: the image in the frame of the patch, the design,
   and measured :class:`~kpbench.detectors.hypotheses.Evidence`. The judge gives the log odds that the hypothesis is
   right, and corrects the pose. Likely hypotheses are measured again in the corrected pose (:func:`look_again`), and
   the first judge sees them a second time.
4. Fit (:func:`fit_hypotheses`). The design is fitted to the pixels (:func:`kpbench.fitting.fit`).
5. Second judge (:func:`judge`). Another small network sees the fitted hypothesis. The patches of an image have similar
   blur and contrast, so the evidence now also compares the hypothesis with the other likely hypotheses of the image.
   The log odds of the second judge give the score of the detection.

:mod:`kpbench.training.verifier` trains the ellipse network and the two judges on synthetic images.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from kpbench.detectors.hypotheses import (
    Evidence,
    Hypotheses,
    VerifiedCandidates,
    clipped_semi_axis,
    judge_inputs,
    select_distinct,
    select_likeliest,
)
from kpbench.detectors.inference import InferenceSession, open_session
from kpbench.fitting.align import WHOLE_RADIUS_PX, Poses, align_poses, rotate_within_ellipse
from kpbench.fitting.covariance import start_covariance
from kpbench.fitting.design_fit import fit
from kpbench.fitting.pyramid import Pyramids
from kpbench.fitting.templates import DesignTemplates, build_templates
from kpbench.fitting.views import rectify, sample_surroundings
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, Int, UInt8
from kpbench.workers import one_blas_thread

VERIFIER = "8"
"""Version of the method. Raise the version by one when detections change for any reason other than new weights."""
WEIGHTS = Path(__file__).parent / "weights"
"""Folder of the shipped networks."""
ELLIPSE, FIRST_JUDGE, SECOND_JUDGE = "ellipse", "first-judge", "second-judge"
"""Names of the networks, without ``.onnx``."""

# The limits were chosen on synthetic images with training photographs as backgrounds. Most of the measurements are in
# two sections of notebook/training-log.md:
# - "Specks, sizes, and how many places an image has"
# - "Fewer looks, and what ten thousand more images were worth"
ID_MARGIN = 3.0
"""A design is tried if its log probability, by the ID head, is at most this much below the likeliest design's."""
ALL_DESIGNS_LOG_ODDS = 0.0
"""At a place with at least these log odds from the ellipse network, all designs are tried."""
THOROUGH_LOG_ODDS = -4.8
"""At a place with at least these log odds from the ellipse network, ellipses of other sizes are tried, and a design may
keep two rotations."""
LEAST_ELLIPSE_LOG_ODDS = -6.5
"""A place with lower log odds from the ellipse network is dropped."""
SECOND_LOOK_LOG_ODDS = -5.0
"""A hypothesis with lower log odds at the first look is dropped."""
LEAST_FIT_LOG_ODDS = -3.5
"""A hypothesis with lower log odds at the second look is not fitted."""
LARGEST_FIT_MOVE = 0.1
"""If a fit moves the centre further than this, in short semi-axes, the pose before the fit is kept. After such a move,
the pose before the fit is right more often."""
USUAL_PLACES = 70
"""Number of candidates in a typical training image of 640x480 px. If an image has n > USUAL_PLACES candidates,
log(n / USUAL_PLACES) is subtracted from the second judge's log odds."""
LEAST_SEMI_AXIS_PX = 2.4
"""Short semi-axis of the smallest patch that is reported, px. Smaller patches cannot be told from specks."""
LEAST_CONTRAST = 2.0
"""Lower limit of two contrasts, grey levels.

- Before the fit, a hypothesis is dropped if (white - black) / 2 is at most the limit.
- In the evidence of the fit, a lower contrast white - black is raised to the limit.
"""
PLACES_PER_BLOCK = 2**11
"""Largest number of places that the ellipse network sees in one call. This limits the memory use."""


def verify_candidates(
    grey: UInt8, xy: Float, network_score: Float, log_id: Float, patches: Sequence[Patch], threads: int = 0
) -> VerifiedCandidates:
    """Compare candidates with the likely designs, and fit the candidates that look like a patch.

    Parameters
    ----------
    grey : ndarray of shape (H, W), uint8
    xy : ndarray of shape (n, 2)
        Places of the candidates, px.
    network_score : ndarray of shape (n,)
        Scores of the candidates by the detector head, in [0, 1].
    log_id : ndarray of shape (n, len(patches) + 1)
        Log probabilities by the ID head: one column per design, and a last column for no patch.
    patches : sequence of Patch
        The designs.
    threads : int
        Threads of the ellipse network and the judges. 0 means the number of OpenCV's threads.

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
    # more candidates than usual do not mean more patches, so each candidate is less likely to lie on a patch
    log_odds = log_odds - np.log(max(1.0, len(xy) / USUAL_PLACES))
    best = select_likeliest(fitted.place, log_odds)
    best = best[clipped_semi_axis(fitted.A[best]) >= LEAST_SEMI_AXIS_PX]
    found, log_odds = fitted[best], log_odds[best]
    score = 1 / (1 + np.exp(-log_odds))
    fitted_pose = found.xy, found.A, found.covariance, found.blur_px
    return VerifiedCandidates(found.place, found.design, *fitted_pose, score)


def find_ellipses(pyramids: Pyramids, xy: Float, threads: int = 0) -> tuple[Float, Float, Float]:
    """Find the ellipse that a patch at each place would fill.

    Parameters
    ----------
    pyramids : Pyramids
    xy : ndarray of shape (n, 2)
        Places, px. The network was trained on places within about half a short semi-axis of a centre.
    threads : int
        As for :func:`verify_candidates`.

    Returns
    -------
    centre : ndarray of shape (n, 2)
        px.
    A : ndarray of shape (n, 2, 2)
        Symmetric map from the unit circle to the ellipse, px.
    log_odds : ndarray of shape (n,)
        Log odds that the place lies on a patch.
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
    """Return hypotheses: poses of the likely designs at every place that may lie on a patch.

    The parameters are described at :func:`verify_candidates`.
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
    """Measure views and evidence again, in the poses that a judge has corrected.

    Hypotheses of low contrast are left out.
    """
    templates = build_templates(patches)
    poses = Poses(corrected.xy, corrected.A, corrected.design, np.zeros(len(corrected)))
    poses = align_poses(pyramids.smooth, poses, templates.whole, 0, WHOLE_RADIUS_PX)
    of_networks = corrected.evidence[:, : Evidence.NCC]
    return _measure(pyramids, corrected.place, corrected.place_xy, poses, of_networks, templates)


def _measure(
    pyramids: Pyramids, place: Int, place_xy: Float, poses: Poses, of_networks: Float, templates: DesignTemplates
) -> Hypotheses:
    """Turn poses into hypotheses by measuring their views and evidence. Hypotheses of low contrast are left out.

    ``of_networks`` (n, 4) holds the evidence from the networks, which are the columns before ``Evidence.NCC``.
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
    pose = poses.xy, poses.A, start_covariance(poses.A)
    found = Hypotheses(place, place_xy, poses.design, *pose, view, np.zeros(len(place)), evidence)
    return found[half_contrast > LEAST_CONTRAST]


def fit_hypotheses(pyramids: Pyramids, before: Hypotheses, log_odds: Float, patches: Sequence[Patch]) -> Hypotheses:
    """Fit the designs of hypotheses to the pixels, and add the evidence of the fit.

    The returned hypotheses have the fitted poses. A hypothesis keeps its pose if the fit moved the centre further than
    ``LARGEST_FIT_MOVE``. ``log_odds`` (n,) come from the first judge.
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
    covariance = np.where(far[:, None, None], start_covariance(before.A), fits.covariance)
    view, _ = rectify(pyramids.smooth, xy, A, before.design, build_templates(patches))
    shared = np.column_stack([np.log(fits.blur_px + 0.3), np.log(contrast)])
    evidence = np.column_stack([before.evidence, measured, _compare_with_others(xy, minor, log_odds, shared)])
    return Hypotheses(before.place, before.place_xy, before.design, xy, A, covariance, view, fits.blur_px, evidence)


def _compare_with_others(xy: Float, minor_px: Float, log_odds: Float, shared: Float) -> Float:
    """Compare each hypothesis with the hypotheses elsewhere in the image.

    Hypothesis b is elsewhere, seen from hypothesis a, if the distance of the centres is larger than the short semi-axis
    of a. Let p be the probability, by the first judge, that a hypothesis is right.

    Parameters
    ----------
    xy, minor_px, log_odds : ndarray of shape (n, 2), (n,) and (n,)
        Centres and short semi-axes, px, and log odds by the first judge.
    shared : ndarray of shape (n, k)
        Measures that the patches of an image have in common.

    Returns
    -------
    ndarray of shape (n, 2 + k)
        Column 0 is log(1 + R), where R is the sum of p over the hypotheses elsewhere. Column 1 is log(1 + W), where W
        is the sum of 1 - p over the hypotheses elsewhere. Column 2 + j is R / (R + 0.3) · (s - m), where s is column j
        of ``shared``, and m is the mean of s over the hypotheses elsewhere, weighted by p. The factor R / (R + 0.3) is
        near 0 if few right hypotheses are expected elsewhere.
    """
    right = 1 / (1 + np.exp(-log_odds))
    elsewhere = np.linalg.norm(xy[:, None] - xy, axis=2) > minor_px[:, None]
    patches, errors = elsewhere @ right, elsewhere @ (1 - right)
    weight = elsewhere * right / (patches + 0.3)[:, None]
    difference = shared * weight.sum(axis=1, keepdims=True) - weight @ shared
    return np.column_stack([np.log1p(patches), np.log1p(errors), difference])


def judge(network: str, hypotheses: Hypotheses, patches: Sequence[Patch], threads: int = 0) -> tuple[Float, Hypotheses]:
    """Run a judge, ``FIRST_JUDGE`` or ``SECOND_JUDGE``, on hypotheses.

    Returns
    -------
    log_odds : ndarray of shape (n,)
        Log odds that there is a patch of this design and that the centre is right.
    corrected : Hypotheses
        The same hypotheses, in the poses that the judge corrected.
    """
    if not len(hypotheses):
        return np.zeros(0), hypotheses
    log_odds, shift, log_map = _session(network, threads).run(None, judge_inputs(hypotheses, patches))
    xy, A = move_poses(hypotheses.xy, hypotheses.A, shift, log_map)
    return _clip_log_odds(log_odds), replace(hypotheses, xy=xy, A=A)


def verifier_version(*candidate_settings: object) -> str:
    """Return the version of the method and a digest of weights and settings, such as "v7-0123abcd".

    The digest is the first 8 hexadecimal digits of a SHA-256 of the three networks and of ``candidate_settings``.
    """
    weights = [(WEIGHTS / f"{name}.onnx").read_bytes() for name in (ELLIPSE, FIRST_JUDGE, SECOND_JUDGE)]
    digest = hashlib.sha256(b"".join([*weights, repr(candidate_settings).encode()])).hexdigest()
    return f"v{VERIFIER}-{digest[:8]}"


def _session(network: str, threads: int) -> InferenceSession:
    return _open(network, threads or cv2.getNumThreads())


@cache
def _open(network: str, threads: int) -> InferenceSession:
    return open_session((WEIGHTS / f"{network}.onnx").read_bytes(), threads)[0]


def _contrast_evidence(contrast: Float, pyramids: Pyramids) -> list[Float]:
    """Return log(contrast / (grey range + 5)) and log(contrast / (noise + 1)) for contrasts (n,) in one image."""
    return [np.log(contrast / (pyramids.grey_range + 5)), np.log(contrast / (pyramids.noise + 1))]


def _log_odds(probability: Float) -> Float:
    clipped = np.clip(probability, 1e-3, 1 - 1e-3)
    return np.asarray(np.log(clipped / (1 - clipped)))
