"""Report on the judges: detection scores on a test dataset; and the score of the second judge that means "detected".

The detection score is the share of true keypoints that are detected. A false alarm is a detection that is not right.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from kpbench.detectors.heads import Decoding
from kpbench.detectors.hypotheses import Hypotheses, select_likeliest
from kpbench.detectors.superpoint import DISC_SHARE
from kpbench.detectors.suppression import suppress
from kpbench.detectors.verification import discount_crowds
from kpbench.fitting.align import short_semi_axis
from kpbench.patches.design import Patch
from kpbench.training.verifier.judge_network import Judge, apply_judge
from kpbench.training.verifier.judge_samples import ImageFits, ImageLooks
from kpbench.training.verifier.labels import FIT_TOLERANCE, POSE_TOLERANCE, design_ids, mark_correct
from kpbench.training.verifier.small_networks import Say
from kpbench.types import Float

FALSE_ALARM_RATES = (0.03, 0.05, 0.1, 0.15, 0.25, 0.5, 0.73)
"""False alarms per image. The report gives the detection score at each of these rates."""
ABOVE_THE_ALARM = 1e-3
"""The log odds of the threshold lie so far above the most likely false alarm that is left out."""
REPORTED_SCORES = (0.3, 0.5)
"""Thresholds of the probability that a detection is right. The report gives the detection score at each threshold."""


def place_threshold(
    looks: Sequence[ImageLooks],
    fits: Sequence[ImageFits],
    second: Judge,
    patches: Sequence[Patch],
    alarms_per_image: float,
    say: Say,
) -> None:
    """Shift the log odds of the second judge, so that a score of 0.5 gives a wanted rate of false alarms.

    A detector reports scores from 0.5 on. Without a false alarm too many, the log odds stay.

    ``alarms_per_image`` : largest number of false alarms per test image.
    """
    parts = _report_of_second(looks, fits, second, patches)
    log_odds, right = (np.concatenate(column) for column in zip(*parts, strict=True))
    alarms = np.sort(log_odds[~right])[::-1]
    allowed = int(alarms_per_image * len(looks))
    shift = -float(alarms[allowed]) - ABOVE_THE_ALARM if len(alarms) > allowed else 0.0
    with torch.no_grad():
        cast(nn.Linear, second.odds[-1]).bias.add_(shift)
    say(f"a score of 0.5 gives {alarms_per_image:g} false alarms per test image: log odds shifted by {shift:+.2f}")


def _report_of_second(
    looks: Sequence[ImageLooks], fits: Sequence[ImageFits], second: Judge, patches: Sequence[Patch]
) -> list[tuple[Float, NDArray[np.bool_]]]:
    """Return what :func:`_select_reported` does for each image, with the scores that the detector would report."""
    parts = []
    for seen, fit in zip(looks, fits, strict=True):
        log_odds, _ = apply_judge(second, fit.fitted, patches)
        log_odds = discount_crowds(log_odds, fit.fitted, seen.candidate_xy, seen.candidate_octave)
        parts.append(_select_reported(log_odds, fit.fitted, seen.keypoints, patches))
    return parts


def report_judges(
    looks: Sequence[ImageLooks], fits: Sequence[ImageFits], second: Judge, patches: Sequence[Patch], say: Say
) -> None:
    """Report the detection scores of the candidates, of the first judge, and of the second judge."""
    truths, images = sum(len(image.keypoints) for image in looks), len(looks)
    say(f"{images} images, {truths} keypoints")
    say("false alarms per image     " + "".join(f"{rate:8}" for rate in FALSE_ALARM_RATES))
    keypoints = [image.keypoints for image in looks]
    corrected, fitted = [image.corrected for image in fits], [image.fitted for image in fits]
    rows = zip([image.log_odds for image in fits], corrected, keypoints, strict=True)
    candidates = [(image.candidate_score, image.candidate_right) for image in looks]
    _report_scores("candidates", [(np.log(s / (1.0001 - s)), right) for s, right in candidates], truths, say)
    _report_scores("first judge", [_select_reported(*row, patches) for row in rows], truths, say)
    _report_scores("second judge", _report_of_second(looks, fits, second, patches), truths, say)
    places = sum(image.first_look.place.max(initial=-1) + 1 for image in looks)
    say(f"fitted: {sum(map(len, fitted)) / images:.1f} of {places / images:.1f} places")
    for name, parts, tolerance in (
        ("proposed", [image.first_look for image in looks], POSE_TOLERANCE),
        ("corrected", corrected, FIT_TOLERANCE),
        ("fitted", fitted, FIT_TOLERANCE),
    ):
        explained = sum(_count_explained(*pair, patches, tolerance) for pair in zip(parts, keypoints, strict=True))
        say(f"keypoints that a {name} hypothesis explains: {explained / truths:.3f}")


def _report_scores(name: str, of_images: Iterable[tuple[Float, NDArray[np.bool_]]], truths: int, say: Say) -> None:
    """Report the detection scores of one stage.

    ``of_images`` : for each image, the log odds of its detections, and whether each detection is right.
    """
    parts = list(of_images)
    log_odds, right = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(-log_odds, kind="stable")
    alarms, found = np.cumsum(~right[order]) / len(parts), np.cumsum(right[order]) / truths
    last = np.maximum(np.searchsorted(alarms, FALSE_ALARM_RATES, side="right") - 1, 0)
    say(f"{name:27}" + "".join(f"{value:8.3f}" for value in found[last]))
    for threshold in REPORTED_SCORES:
        kept = log_odds >= np.log(threshold / (1 - threshold))
        say(
            f"    at {threshold}: detection {(right & kept).sum() / truths:.3f}, "
            f"alarms {(~right & kept).sum() / len(parts):.3f}"
        )


def _count_explained(
    hypotheses: Hypotheses, keypoints: NDArray[Any], patches: Sequence[Patch], tolerance: float
) -> int:
    """Return the number of keypoints for which at least one hypothesis is right."""
    ids = design_ids(hypotheses, patches)
    explained = [mark_correct(hypotheses.xy, ids, keypoints[k : k + 1], tolerance) for k in range(len(keypoints))]
    return sum(bool(right.any()) for right in explained)


def _select_reported(
    log_odds: Float, hypotheses: Hypotheses, keypoints: NDArray[Any], patches: Sequence[Patch]
) -> tuple[Float, NDArray[np.bool_]]:
    """Return the log odds of the hypotheses that a detector without a threshold would report.

    Also return whether each of these hypotheses is right.
    """
    best = select_likeliest(hypotheses.place, log_odds)
    hypotheses, log_odds = hypotheses[best], log_odds[best]
    reach = np.maximum(Decoding.separation_px, DISC_SHARE * short_semi_axis(hypotheses.A))
    kept = suppress(hypotheses.xy, log_odds, reach)
    ids = design_ids(hypotheses, patches)
    return log_odds[kept], mark_correct(hypotheses.xy, ids, keypoints, FIT_TOLERANCE)[kept]
