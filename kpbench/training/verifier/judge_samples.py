"""Collection of the hypotheses on which the judges are trained and tested.

The first judge sees a hypothesis twice. The first look is at the proposed pose. The second look is at the pose that the
judge corrected at the first look. :func:`collect_looks` collects the hypotheses of both looks, with an earlier first
judge. :func:`collect_fits` collects the fitted hypotheses, with the new first judge.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from kpbench.detectors.hypotheses import Hypotheses, select_distinct
from kpbench.detectors.verification import (
    FIRST_JUDGE,
    LEAST_FIT_LOG_ODDS,
    SECOND_LOOK_LOG_ODDS,
    fit_hypotheses,
    judge,
    look_again,
    propose_poses,
)
from kpbench.fitting.pyramid import Pyramids
from kpbench.training.verifier.dataset_images import ImageRef, load_places_detector
from kpbench.training.verifier.judge_network import Judge, apply_judge
from kpbench.training.verifier.labels import FIT_TOLERANCE, mark_correct
from kpbench.types import Float, Int, UInt8

TRAINING_MARGIN = 1.0
"""Amount by which training lowers two log-odds thresholds: ``SECOND_LOOK_LOG_ODDS`` and ``LEAST_FIT_LOG_ODDS``."""
SPECKLED_EVERY = 3
"""Every third training image has specks."""


@dataclass(frozen=True)
class ImageLooks:
    """Keypoints, candidates and hypotheses of one image before the fit.

    Attributes
    ----------
    keypoints : structured ndarray
        The true keypoints.
    candidate_xy, candidate_octave, candidate_score : ndarray of shape (n, 2), (n,) and (n,)
        Place of each candidate, px; pyramid level in which it was found; score that the detector's network gives it.
    candidate_right : ndarray of shape (n,), bool
        Whether each candidate, with its likeliest design, is right.
    first_look, second_look : Hypotheses
        Hypotheses in the proposed poses, and likely hypotheses in the poses that the earlier first judge corrected.
    earlier_log_odds : ndarray
        Log odds from the earlier first judge: first for ``first_look``, then for ``second_look``.
    """

    keypoints: NDArray[Any]
    candidate_xy: Float
    candidate_octave: Int
    candidate_score: Float
    candidate_right: NDArray[np.bool_]
    first_look: Hypotheses
    second_look: Hypotheses
    earlier_log_odds: Float


@dataclass(frozen=True)
class ImageFits:
    """The n hypotheses of one image that are fitted.

    Attributes
    ----------
    log_odds : ndarray of shape (n,)
        Log odds from the new first judge at the second look.
    corrected : Hypotheses
        The hypotheses before the fit, in the poses that the new first judge corrected at the second look.
    fitted : Hypotheses
        The hypotheses after the fit.
    """

    log_odds: Float
    corrected: Hypotheses
    fitted: Hypotheses


@lru_cache(maxsize=1)
def _unpack_judge(packed: bytes) -> Judge:
    return cast(Judge, pickle.loads(packed))


def collect_looks(detector_path: Path | None, weights: Path, image: ImageRef, train: bool) -> ImageLooks:
    """Return the hypotheses of one image at the two looks of an earlier first judge.

    The threshold of the log odds for the second look is ``SECOND_LOOK_LOG_ODDS - TRAINING_MARGIN``.

    ``detector_path`` : see :func:`load_places_detector`.
    ``weights`` : folder of the ellipse network and of the earlier first judge. Without an earlier judge, there is no
    second look, and all log odds are 0.
    ``train`` : draw specks into every third image.
    """
    detector = load_places_detector(detector_path)
    grey, keypoints = read_image(image, train)
    xy, score, log_id, octave = detector.candidates([grey])[0]
    patch_ids = np.array([patch.patch_id for patch in detector.patches])[log_id[:, :-1].argmax(axis=1)]
    right = mark_correct(xy, patch_ids, keypoints, FIT_TOLERANCE)
    pyramids = Pyramids(grey)
    first_look = propose_poses(pyramids, xy, score, log_id, detector.patches, octave=octave, weights=weights)
    if (weights / f"{FIRST_JUDGE}.onnx").exists():
        log_odds, corrected = judge(FIRST_JUDGE, first_look, detector.patches, weights=weights)
        again = corrected[log_odds >= SECOND_LOOK_LOG_ODDS - TRAINING_MARGIN]
        second_look = look_again(pyramids, again, detector.patches)
        second_log_odds, _ = judge(FIRST_JUDGE, second_look, detector.patches, weights=weights)
        log_odds = np.concatenate([log_odds, second_log_odds])
    else:
        second_look, log_odds = first_look[:0], np.zeros(len(first_look))
    seen = _halve_memory(first_look), _halve_memory(second_look)
    return ImageLooks(keypoints, xy, octave, score, right, *seen, log_odds)


def _halve_memory(hypotheses: Hypotheses) -> Hypotheses:
    return replace(hypotheses, view=hypotheses.view.astype(np.float16))


def collect_fits(
    detector_path: Path | None, packed_judge: bytes, train: bool, image: ImageRef, first_look: Hypotheses
) -> ImageFits:
    """Show the hypotheses of one image to the new first judge, twice; fit the likely hypotheses and return them.

    ``packed_judge`` : the new first judge, pickled.
    ``train`` : draw the same specks as :func:`collect_looks`, and lower both thresholds by ``TRAINING_MARGIN``. On its
    own training images, the first judge gives wrong hypotheses very low log odds. With the usual thresholds, the second
    judge would see too few wrong hypotheses.
    """
    patches, new_judge = load_places_detector(detector_path).patches, _unpack_judge(packed_judge)
    pyramids, margin = Pyramids(read_image(image, train)[0]), TRAINING_MARGIN if train else 0.0
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # one image is too little work for several threads
    log_odds, corrected = apply_judge(new_judge, first_look, patches)
    second_look = look_again(pyramids, corrected[log_odds >= SECOND_LOOK_LOG_ODDS - margin], patches)
    log_odds, corrected = apply_judge(new_judge, second_look, patches)
    torch.set_num_threads(threads)
    chosen = select_distinct(corrected, log_odds, LEAST_FIT_LOG_ODDS - margin)
    log_odds, corrected = log_odds[chosen], corrected[chosen]
    fitted = fit_hypotheses(pyramids, corrected, log_odds, patches)
    return ImageFits(log_odds, _halve_memory(corrected), _halve_memory(fitted))


def read_image(image: ImageRef, speckle: bool) -> tuple[UInt8, NDArray[Any]]:
    """Return one image in grey, and its keypoints.

    ``speckle`` : draw specks beside the patches of every third image. A speck is 1 to 6 px wide. Specks imitate hot
    pixels, dust, distant leaves and distant windows, which a detector often mistakes for small patches.
    """
    grey, keypoints = image.read()
    if not speckle or image.index % SPECKLED_EVERY:
        return grey, keypoints
    grey, rng = grey.copy(), image.rng()
    xy = rng.uniform(0, grey.shape[::-1], (rng.integers(1, 40) * grey.size // 200_000, 2))
    apart = np.hypot(xy[:, :1] - keypoints["x"], xy[:, 1:] - keypoints["y"]) > keypoints["radius_major"] + 4
    for x, y in np.rint(16 * xy[apart.all(axis=1)]).astype(int).tolist():
        axes = np.rint(16 * rng.uniform(0.4, 3.0, 2)).astype(int).tolist()
        level = float(rng.choice([0, 255, int(rng.integers(256))]))
        cv2.ellipse(grey, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, level, -1, cv2.LINE_AA, 4)
    return grey, keypoints
