"""Verification: what the pixels say of the points that a network found.

A network says where it sees a keypoint and which design it takes it for. Here all designs are laid over each
such place (:mod:`kpbench.match`), the likeliest is fitted to the pixels (:mod:`kpbench.refine`), and both kinds of
evidence together give the identity, the centre, and the probability that there is a patch: a logistic regression,
which ``benchmarks/verification.py`` fits to synthetic images of training photographs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kpbench import match, refine
from kpbench.design import Patch
from kpbench.keypoints import Float, UInt8

__all__ = ["EVIDENCE", "Examined", "examine", "score", "terms"]

EVIDENCE = (
    "log odds of the network's score",
    "log probability that the ID head sees a patch",
    "likeness of the coarse match",
    "-log(1.01 - correlation of the fit)",
    "log of what the fit leaves unexplained, in contrasts",
    "blur in short semi-axes",
    "log of contrast over the range of the image",
    "log of the distance from the network's place, in short semi-axes",
    "log of contrast over noise",
    "log of the short semi-axis, px",
)
"""The columns of :attr:`Examined.evidence`."""

CLIP = 3.0
"""Evidence is cut off at so many standard deviations: beyond what the fit has seen a square would run away."""

LIKENESS_IN_ID = 0.3
"""What a unit of likeness weighs against a unit of the ID head's log probability when the design is chosen."""
HOPE, HOPELESS = np.array([0.57, 12.3, 0.24]), -0.4
"""What the first three of the evidence weigh before the fit, and the sum under which a place is not worth one."""
FAINTEST = 2.0
"""Grey levels between the inks under which nothing that is fitted means anything."""
OCTAVES = 2
"""Best octaves by the coarse search of which each is aligned before one is chosen."""
LEAST_FIT = 0.7
"""Correlation of design and pixels from which a fitted centre is trusted more than the network's."""


@dataclass(frozen=True)
class Examined:
    """What is known of the n places that were worth a fit.

    Attributes
    ----------
    place : (n,) index of the place that was asked about.
    which : (n,) index of the likeliest design.
    xy : (n, 2) px, the fitted centre, or the place itself where the fit is not to be trusted.
    minor_px : (n,) short semi-axis of the fitted disc.
    evidence : (n, len(EVIDENCE))
    """

    place: NDArray[np.int64]
    which: NDArray[np.int64]
    xy: Float
    minor_px: Float
    evidence: Float


def examine(grey: UInt8, xy: Float, network_score: Float, log_id: Float, patches: Sequence[Patch]) -> Examined:
    """Compare places with all designs, and fit the likeliest.

    Parameters
    ----------
    grey : ndarray of shape (H, W), uint8
    xy : ndarray of shape (n, 2), px
    network_score : ndarray of shape (n,), in [0, 1]
    log_id : ndarray of shape (n, len(patches) + 1): log-probability of each design, and of none.
    patches : the designs.
    """
    known = match.bank(patches)
    raw, smooth = match.pyramid(grey, 0), match.pyramid(grey)
    core = _core(smooth, xy, known)
    whole = match.align(smooth, match.extend(smooth, core, known), known.whole, 4, 5.6)
    likeness = match.likeness(core.ncc, whole.ncc).reshape(len(xy), len(patches))
    which = np.argmax(log_id[:, :-1] + LIKENESS_IN_ID * likeness, axis=1)
    patch_seen = np.log(np.maximum(1 - np.exp(log_id[:, -1]), 1e-4))
    before = np.column_stack([_log_odds(network_score), patch_seen, likeness[np.arange(len(xy)), which]])
    place = np.flatnonzero(before @ HOPE > HOPELESS)

    poses = whole[place * len(patches) + which[place]]
    fit = refine.fit(raw, poses.xy, poses.A, [patches[n] for n in poses.which])
    seen = np.flatnonzero(fit.white - fit.black > FAINTEST)
    place, fit = place[seen], fit[seen]
    minor = np.maximum(match.short_axis(fit.A), 0.5)
    moved = np.linalg.norm(fit.xy - xy[place], axis=1)
    trusted = (fit.ncc >= LEAST_FIT) & (moved <= np.maximum(3.0, 0.35 * minor))
    centres = np.where(trusted[:, None], fit.xy, xy[place])
    evidence = np.column_stack([before[place], _evidence(grey, raw[0], fit, minor, moved)])
    return Examined(place, which[place], centres, minor, np.nan_to_num(evidence))


def _evidence(grey: UInt8, image: NDArray[np.float32], fit: refine.Fit, minor: Float, moved: Float) -> Float:
    """The columns of :data:`EVIDENCE` that come from the fit."""
    contrast, noise = fit.white - fit.black, match.noise(image)
    dark, bright = np.percentile(grey[::4, ::4], (2, 98))
    unexplained = np.minimum(np.sqrt(np.maximum(fit.noise**2 - noise**2, 0)) / contrast, 3.0)
    return np.column_stack(
        [
            -np.log(1.01 - fit.ncc),
            np.log(unexplained + 0.02),
            np.minimum(fit.blur_px / minor, 1.0),
            np.log(contrast / (bright - dark + 5)),
            np.log(moved / minor + 0.02),
            np.log(contrast / (noise + 1)),
            np.log(minor),
        ]
    )


def _core(levels: Sequence[NDArray[np.float32]], xy: Float, known: match.Bank) -> match.Poses:
    """The best pose of every design's core at every place, (n * designs), over four octaves."""
    octaves, count = min(4, len(levels)), len(xy) * len(known.patches)
    level = np.repeat(np.arange(octaves), len(xy))
    poses = match.search(levels, np.tile(xy, (octaves, 1)), level, known, margin=2.0)  # all designs at each
    likeliest = np.argsort(-poses.ncc.reshape(octaves, count), axis=0, kind="stable")[:OCTAVES]
    poses = poses[(likeliest * count + np.arange(count)).ravel()]
    poses = match.align(levels, poses, known.core, 3, 0.9 * match.RING_PX)
    return poses[poses.ncc.reshape(-1, count).argmax(axis=0) * count + np.arange(count)]


def score(found: Examined) -> Float:
    """Probability (n,) that there is a patch, and that its centre and design are right."""
    fitted = _fitted()
    logit = terms(found.evidence, fitted["mean"], fitted["deviation"]) @ fitted["weights"]
    return np.asarray(1 / (1 + np.exp(-np.clip(logit, -30, 30))))


@cache
def _fitted() -> dict[str, Float]:
    with np.load(Path(__file__).parent / "weights" / "verification.npz") as columns:
        return dict(columns)


def terms(evidence: Float, mean: Float, deviation: Float) -> Float:
    """What a logistic regression weighs: the evidence (n, E), standardised, its products by pairs, and 1."""
    z = np.clip((evidence - mean) / deviation, -CLIP, CLIP)
    first, second = np.triu_indices(z.shape[1])
    return np.column_stack([z, z[:, first] * z[:, second], np.ones(len(z))])


def _log_odds(probability: Float) -> Float:
    clipped = np.clip(probability, 1e-3, 1 - 1e-3)
    return np.asarray(np.log(clipped / (1 - clipped)))
