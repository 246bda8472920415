"""Verification of a network's candidates on the pixels: is there a patch, of which design, and where is its centre?

A candidate is a place that the reference network found (:mod:`kpbench.detectors.superpoint`). The network's detector
head gives the place and its score. The network's ID head gives the probability of each design and of no patch. The
verification works in five steps.

1. Ellipses (:func:`find_ellipses`). A small network, the ellipse network, sees the surroundings of each place. The
   ellipse network gives the ellipse that a patch at this place would fill, and the log odds that the place lies on a
   patch.
2. Poses (:func:`propose_poses`). All designs are rotated within the ellipse. The two poses that agree best with the
   image are kept. A place with a design and a pose is a hypothesis.
3. First judge (:func:`judge`). A small network sees each hypothesis: the image in the frame of the patch, the design,
   and measured :class:`~kpbench.detectors.hypotheses.Evidence`. The judge gives the log odds that the hypothesis is
   right, and corrects the pose. Likely hypotheses are measured again in the corrected pose (:func:`look_again`), and
   the first judge sees them a second time.
4. Fit (:func:`fit_hypotheses`). The design is fitted to the pixels (:func:`kpbench.fitting.fit`).
5. Second judge (:func:`judge`). Another small network sees the fitted hypothesis. Its log odds give the score of the
   detection.

The networks were trained on patches with a radius of about 5 to 50 px. So that a patch may have any size, they see a
place in the picture in which it was found, a level of the image's pyramid; sizes in the evidence are px of this level.
Places, poses and fits are px of the image. Noise and grey range are measured around each place, so that a score does
not depend on the rest of the image.

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
    UNUSED_COLUMNS,
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
from kpbench.fitting.design_fit import FINE_PX, fit
from kpbench.fitting.pyramid import SURROUNDINGS_PX, Pyramids
from kpbench.fitting.templates import DesignTemplates, build_templates
from kpbench.fitting.views import rectify, sample_surroundings
from kpbench.patches.design import Patch
from kpbench.types import Float, Float32, Int, UInt8
from kpbench.workers import one_blas_thread

VERIFIER = "11"
"""Version of the method. Raise the version by one when detections change for any reason other than new weights."""
WEIGHTS = Path(__file__).parent / "weights"
"""Folder of the shipped networks."""
ELLIPSE, FIRST_JUDGE, SECOND_JUDGE = "ellipse", "first-judge", "second-judge"
VERIFIER_NETWORKS = (ELLIPSE, FIRST_JUDGE, SECOND_JUDGE)
"""Names of the networks, without ``.onnx``."""

# The limits were chosen on synthetic images over training photographs: notebook/training-log.md, "Specks, sizes, and
# how many places an image has" and "Fewer looks, and what ten thousand more images were worth".
LEAST_ELLIPSE_LOG_ODDS = -6.5
"""A place with lower log odds from the ellipse network is dropped."""
SECOND_LOOK_LOG_ODDS = -5.0
"""A hypothesis with lower log odds at the first look is dropped."""
LEAST_FIT_LOG_ODDS = -3.5
"""A hypothesis with lower log odds at the second look is not fitted."""
LARGEST_FIT_MOVE = 0.1
"""If a fit moves the centre further than this, in short semi-axes, the pose before the fit is kept. After such a move,
the pose before the fit is right more often."""
USUAL_PLACES = 8.4
"""Number of candidates in a square of ``SURROUNDINGS_PX`` of a typical training image, which had 70 in 640x480 px.
Among n > USUAL_PLACES candidates, log(n / USUAL_PLACES) is subtracted from the second judge's log odds."""
LEAST_SEMI_AXIS_PX = 2.4
"""Short semi-axis of the smallest patch that is reported, px. Smaller patches cannot be told from specks."""
LEAST_CONTRAST = 2.0
"""Lower limit of two contrasts, grey levels.

- Before the fit, a hypothesis is dropped if (white - black) / 2 is at most the limit.
- In the evidence of the fit, a lower contrast white - black is raised to the limit.
"""
PLACES_PER_BLOCK = 2**10
"""Largest number of places or hypotheses that a network sees in one call. This limits the memory use."""


def verify_candidates(
    grey: UInt8,
    xy: Float,
    network_score: Float,
    log_id: Float,
    patches: Sequence[Patch],
    threads: int = 0,
    octave: Int | None = None,
    weights: Path | None = None,
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
    octave : ndarray of shape (n,), int64, optional
        Pyramid level of the picture in which each candidate was found: 1 if the picture had half the size of the image.
        The networks see the candidate in this picture. None: all were found in the image itself.
    weights : Path, optional
        Folder of the three networks. None: the shipped networks.

    Returns
    -------
    VerifiedCandidates

    Examples
    --------
    >>> import numpy as np
    >>> import kpbench
    >>> from kpbench.detectors import verify_candidates
    >>> patches = kpbench.shipped_patches()
    >>> v, u = (np.mgrid[:384, :384] - 191.5) / 80.0  # 4 x 4 samples a pixel
    >>> black = patches[1].is_black(np.stack([u, v], axis=-1))
    >>> grey = np.where(np.hypot(u, v) > 1, 120, np.where(black, 40, 210))
    >>> image = grey.reshape(96, 4, 96, 4).mean(axis=(1, 3)).astype(np.uint8)
    >>> log_id = np.log(np.full((1, len(patches) + 1), 0.2))
    >>> found = verify_candidates(image, np.array([[48.0, 49.0]]), np.array([0.9]), log_id, patches)
    >>> found.xy.round(1), patches[found.design[0]].name
    (array([[47.5, 47.5]]), 'trefoil')
    """
    pyramids = Pyramids(grey)
    with one_blas_thread():
        proposed = propose_poses(pyramids, xy, network_score, log_id, patches, threads, octave, weights)
        log_odds, corrected = judge(FIRST_JUDGE, proposed, patches, threads, weights)
        shown_again = look_again(pyramids, corrected[log_odds >= SECOND_LOOK_LOG_ODDS], patches)
        log_odds, corrected = judge(FIRST_JUDGE, shown_again, patches, threads, weights)
        chosen = select_distinct(corrected, log_odds, LEAST_FIT_LOG_ODDS)
        fitted = fit_hypotheses(pyramids, corrected[chosen], log_odds[chosen], patches)
    log_odds, _ = judge(SECOND_JUDGE, fitted, patches, threads, weights)
    log_odds = discount_crowds(log_odds, fitted, xy, np.zeros(len(xy), np.int64) if octave is None else octave)
    best = select_likeliest(fitted.place, log_odds)
    best = best[clipped_semi_axis(fitted.A[best]) >= LEAST_SEMI_AXIS_PX]
    found, score = fitted[best], 1 / (1 + np.exp(-log_odds[best]))
    return VerifiedCandidates(found.place, found.design, found.xy, found.A, found.covariance, found.blur_px, score)


def discount_crowds(log_odds: Float, hypotheses: Hypotheses, xy: Float, octave: Int) -> Float:
    """Return the log odds (n,) of hypotheses, lowered where there are many candidates: these do not mean more patches.

    ``xy`` (m, 2), ``octave`` (m,) : all candidates of the image. Those of equal or coarser pictures in the square
    around a hypothesis count, see ``USUAL_PLACES``.
    """
    distance = np.abs(hypotheses.place_xy[:, None] - xy).max(axis=2) * 0.5 ** hypotheses.octave[:, None]
    near = (distance < SURROUNDINGS_PX / 2) & (octave >= hypotheses.octave[:, None])
    return np.asarray(log_odds - np.log(np.maximum(1.0, np.count_nonzero(near, axis=1) / USUAL_PLACES)))


def find_ellipses(
    pyramids: Pyramids, xy: Float, threads: int = 0, octave: Int | None = None, weights: Path | None = None
) -> tuple[Float, Float, Float]:
    """Find the ellipse that a patch at each place would fill.

    Parameters
    ----------
    pyramids : Pyramids
    xy : ndarray of shape (n, 2)
        Places, px. The network was trained on places within about half a short semi-axis of a centre.
    threads, octave, weights
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
    octave = np.zeros(len(xy), np.int64) if octave is None else octave
    for first in range(0, len(xy), PLACES_PER_BLOCK):
        block = np.s_[first : first + PLACES_PER_BLOCK]
        given = {"surroundings": sample_surroundings(pyramids.smooth, xy[block], octave=octave[block])}
        log_odds, shift, log_map = _open((weights or WEIGHTS) / f"{ELLIPSE}.onnx", threads).run(None, given)
        of_octave = np.eye(2) * 2.0 ** octave[block, None, None]
        parts.append((*move_poses(xy[block], of_octave, shift, log_map), _clip_log_odds(log_odds)))
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
    pyramids: Pyramids,
    xy: Float,
    network_score: Float,
    log_id: Float,
    patches: Sequence[Patch],
    threads: int = 0,
    octave: Int | None = None,
    weights: Path | None = None,
) -> Hypotheses:
    """Return hypotheses: the best two poses at every place that may lie on a patch.

    The parameters are described at :func:`verify_candidates`.
    """
    octave = np.zeros(len(xy), np.int64) if octave is None else np.minimum(octave, len(pyramids.raw) - 1)
    centre, A, log_odds = find_ellipses(pyramids, xy, threads, octave, weights)
    likely = np.flatnonzero(log_odds >= LEAST_ELLIPSE_LOG_ODDS)
    noise, grey_range = pyramids.measure_surroundings(xy[likely], octave[likely])
    templates = build_templates(patches)
    row, poses = rotate_within_ellipse(pyramids.smooth, centre[likely], A[likely], templates)
    place, nothing = likely[row], np.zeros((len(row), 0), np.float32)
    of_networks = np.column_stack(
        [
            _log_odds(network_score[place]),
            np.log(np.maximum(1 - np.exp(log_id[place, -1]), 1e-4)),
            log_id[place, poses.design],
            log_odds[place],
        ]
    )
    of_place = place, xy[place], octave[place], noise[row], grey_range[row]
    pose = poses.xy, poses.A, start_covariance(poses.A)
    unseen = Hypotheses(*of_place, poses.design, *pose, nothing, np.zeros(len(row)), of_networks)
    return _measure(pyramids, unseen, poses.ncc, templates)


def look_again(pyramids: Pyramids, corrected: Hypotheses, patches: Sequence[Patch]) -> Hypotheses:
    """Measure views and evidence again, in the poses that a judge has corrected.

    Hypotheses of low contrast are left out.
    """
    templates = build_templates(patches)
    poses = Poses(corrected.xy, corrected.A, corrected.design, np.zeros(len(corrected)))
    poses = align_poses(pyramids.smooth, poses, templates.whole, 0, WHOLE_RADIUS_PX)
    return _measure(pyramids, corrected, poses.ncc, templates)


def _measure(pyramids: Pyramids, hypotheses: Hypotheses, ncc: Float, templates: DesignTemplates) -> Hypotheses:
    """Measure the views of hypotheses, and the evidence from ``Evidence.NCC`` to ``Evidence.RADIUS``.

    ``ncc`` (n,) holds the correlations of the designs with the image. Hypotheses of low contrast are left out.
    """
    xy, A = hypotheses.xy, hypotheses.A
    view, half_contrast = rectify(pyramids.smooth, xy, A, hypotheses.design, templates)
    minor = clipped_semi_axis(A)
    measured = [
        -np.log(1.01 - ncc),
        np.log(np.linalg.norm(xy - hypotheses.place_xy, axis=1) / minor + 0.02),
        *_contrast_evidence(half_contrast, hypotheses),
        np.log(minor * 0.5**hypotheses.octave),
    ]
    evidence = np.column_stack([hypotheses.evidence[:, : Evidence.NCC], *measured])
    measured_again = replace(hypotheses, covariance=start_covariance(A), view=view, evidence=evidence)
    return measured_again[half_contrast > LEAST_CONTRAST]


def fit_hypotheses(pyramids: Pyramids, before: Hypotheses, log_odds: Float, patches: Sequence[Patch]) -> Hypotheses:
    """Fit the designs of hypotheses to the pixels, and add the evidence of the fit.

    The returned hypotheses have the fitted poses. A hypothesis keeps its pose if the fit moved the centre further than
    ``LARGEST_FIT_MOVE``. ``log_odds`` (n,) come from the first judge.
    """
    designs = [patches[n] for n in before.design]
    fits = fit(pyramids.raw, before.xy, before.A, designs)
    contrast, minor = np.maximum(fits.white - fits.black, LEAST_CONTRAST), clipped_semi_axis(fits.A)
    shift, move = (np.linalg.norm(fits.xy - start, axis=1) / minor for start in (before.place_xy, before.xy))
    noise, _ = pyramids.measure_surroundings(before.place_xy, _fit_level(before.A, designs, len(pyramids.raw)))
    unexplained = np.minimum(np.sqrt(np.maximum(fits.noise**2 - noise**2, 0)) / contrast, 3.0)
    measured = np.column_stack(
        [
            -np.log(1.01 - fits.ncc),
            np.log(unexplained + 0.02),
            np.minimum(fits.blur_px / minor, 1.0),
            np.log(shift + 0.02),
            np.log(move + 0.02),
            *_contrast_evidence(contrast, before),
            np.log(minor * 0.5**before.octave),
            log_odds,
            *np.zeros((UNUSED_COLUMNS, len(before))),
        ]
    )
    far = move > LARGEST_FIT_MOVE
    xy, A = np.where(far[:, None], before.xy, fits.xy), np.where(far[:, None, None], before.A, fits.A)
    covariance = np.where(far[:, None, None], start_covariance(before.A), fits.covariance)
    view, _ = rectify(pyramids.smooth, xy, A, before.design, build_templates(patches))
    evidence = np.column_stack([before.evidence, measured])
    return replace(before, xy=xy, A=A, covariance=covariance, view=view, blur_px=fits.blur_px, evidence=evidence)


def _fit_level(A: Float, designs: Sequence[Patch], levels: int) -> Int:
    """Return the pyramid levels (n,) in which the last steps of the fits are taken."""
    size = np.linalg.norm(A, 2, axis=(1, 2)) * [patch.extent for patch in designs] if len(A) else np.zeros(0)
    return np.clip(np.ceil(np.log2(np.maximum(size, 1e-6) / FINE_PX)), 0, levels - 1).astype(np.int64)


def judge(
    network: str, hypotheses: Hypotheses, patches: Sequence[Patch], threads: int = 0, weights: Path | None = None
) -> tuple[Float, Hypotheses]:
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
    blocks = (hypotheses[n : n + PLACES_PER_BLOCK] for n in range(0, len(hypotheses), PLACES_PER_BLOCK))
    session = _open((weights or WEIGHTS) / f"{network}.onnx", threads)
    parts = [session.run(None, judge_inputs(block, patches)) for block in blocks]
    log_odds, shift, log_map = (np.concatenate(column) for column in zip(*parts, strict=True))
    xy, A = move_poses(hypotheses.xy, hypotheses.A, shift, log_map)
    return _clip_log_odds(log_odds), replace(hypotheses, xy=xy, A=A)


def verifier_version(weights: Path, *candidate_settings: object) -> str:
    """Return the version of the method and a digest of weights and settings, such as "v7-0123abcd".

    The digest is the first 8 hexadecimal digits of a SHA-256 of the three networks in the folder ``weights`` and of
    ``candidate_settings``.
    """
    networks = [(weights / f"{name}.onnx").read_bytes() for name in VERIFIER_NETWORKS]
    digest = hashlib.sha256(b"".join([*networks, repr(candidate_settings).encode()])).hexdigest()
    return f"v{VERIFIER}-{digest[:8]}"


@cache
def _open_session(network: Path, threads: int) -> InferenceSession:
    return open_session(network.read_bytes(), threads)[0]


def _open(network: Path, threads: int) -> InferenceSession:
    return _open_session(network, threads or cv2.getNumThreads())


def _contrast_evidence(contrast: Float, hypotheses: Hypotheses) -> list[Float]:
    """Return log(contrast / (grey range + 5)) and log(contrast / (noise + 1)) for contrasts (n,)."""
    return [np.log(contrast / (hypotheses.grey_range + 5)), np.log(contrast / (hypotheses.noise + 1))]


def _log_odds(probability: Float) -> Float:
    clipped = np.clip(probability, 1e-3, 1 - 1e-3)
    return np.asarray(np.log(clipped / (1 - clipped)))
