"""Verification: what the pixels say of the points that a network found.

A network says where it sees a keypoint and which design it takes it for. Here the likely designs are laid over
each such place (:func:`posed`, with :mod:`kpbench.match`), what still looks like a patch is fitted to the pixels
(:func:`fitted`, with :mod:`kpbench.refine`), and after each of the two a small network judges: it sees the place in
the frame of the patch, beside the design, and what was measured. Its answer is the log odds that there is a
patch of this design at this place; the mean of both answers counts. ``benchmarks/verification.py`` trains the judges on
synthetic images of training photographs.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench import match, refine
from kpbench.design import Patch
from kpbench.keypoints import Float, UInt8
from kpbench.match import Picture
from kpbench.runtime import Session, open_session
from kpbench.workers import one_blas_thread

__all__ = [
    "FITTED",
    "POSED",
    "Examined",
    "Hypotheses",
    "examine",
    "fitted",
    "inputs",
    "judged",
    "likeliest",
    "posed",
    "version",
]

POSED = (
    "log odds of the network's score",
    "log probability that the ID head sees a patch",
    "log probability of the design by the ID head",
    "-log(1.01 - correlation of the innermost sectors)",
    "-log(1.01 - correlation of the whole design)",
    "log of the distance from the network's place, in short semi-axes",
    "log of contrast over the range of the image",
    "log of contrast over noise",
    "log of the short semi-axis, px",
)
"""The columns of the evidence of :func:`posed`."""
FITTED = (
    *POSED,
    "-log(1.01 - correlation of the fit)",
    "log of what the fit leaves unexplained, in contrasts",
    "blur in short semi-axes",
    "log of the distance from the network's place, in short semi-axes, by the fit",
    "log of contrast over the range of the image, by the fit",
    "log of contrast over noise, by the fit",
    "log of the short semi-axis, px, by the fit",
)
"""The columns of the evidence of :func:`fitted`."""

OCTAVES = 4
"""Octaves in which a patch's core is looked for: short semi-axes from 5 px."""
DOUBT = 3.0
"""Designs whose log-probability by the ID head is further behind the likeliest one's are not tried."""
LIKENESS_IN_ID, FARNESS = 0.3, 2.0
"""What a unit of likeness weighs against a unit of the ID head's log probability when a design and its octave are
chosen, and what a unit of log distance from the network's place, px, weighs against a unit of likeness."""
TRIED = 3
"""Hypotheses a place that are judged before the fit."""
HOPELESS = -3.0
"""Log odds before the fit under which a hypothesis is not worth one."""
FAINTEST = 2.0
"""Grey levels: less than twice this between the inks is no patch; a fitted contrast counts as at least this."""


@dataclass(frozen=True)
class Hypotheses:
    """n places, each with the design and the pose that it is taken for.

    Attributes
    ----------
    place : (n,) index of the place that was asked about.
    at : (n, 2) px, that place.
    which : (n,) index of the design.
    xy, A : (n, 2) px, (n, 2, 2) patch frame to px.
    view : (n, VIEW_PX²) from :func:`kpbench.match.view`.
    evidence : (n, len(POSED)) or (n, len(FITTED))
    """

    place: NDArray[np.int64]
    at: Float
    which: NDArray[np.int64]
    xy: Float
    A: Float
    view: NDArray[np.float32]
    evidence: Float

    def __len__(self) -> int:
        return len(self.place)

    def __getitem__(self, keep: Any) -> Hypotheses:
        return Hypotheses(*(column[keep] for column in vars(self).values()))


@dataclass(frozen=True)
class Examined:
    """What is known of the n places that were worth a fit.

    Attributes
    ----------
    which : (n,) index of the likeliest design.
    xy : (n, 2) px, the fitted centre.
    minor_px : (n,) short semi-axis of the fitted disc.
    score : (n,) probability that there is a patch, and that its centre and design are right.
    """

    which: NDArray[np.int64]
    xy: Float
    minor_px: Float
    score: Float


def examine(
    grey: UInt8, xy: Float, network_score: Float, log_id: Float, patches: Sequence[Patch], threads: int = 0
) -> Examined:
    """Compare places with the designs that the network holds likely, and fit what looks like one.

    Parameters
    ----------
    grey : ndarray of shape (H, W), uint8
    xy : ndarray of shape (n, 2), px
    network_score : ndarray of shape (n,), in [0, 1]
    log_id : ndarray of shape (n, len(patches) + 1): log-probability of each design, and of none.
    patches : the designs.
    threads : of the judges; 0 means as many as OpenCV may use.
    """
    picture = Picture(grey)
    with one_blas_thread():
        before = posed(picture, xy, network_score, log_id, patches)
        odds = judged("posed", before, patches, threads)
        hopeful = odds >= HOPELESS
        found = fitted(picture, before[hopeful], patches)
    odds = (odds[hopeful] + judged("fitted", found, patches, threads)) / 2
    best = likeliest(found.place, odds)
    return Examined(found.which[best], found.xy[best], _minor(found.A[best]), 1 / (1 + np.exp(-odds[best])))


def posed(picture: Picture, xy: Float, network_score: Float, log_id: Float, patches: Sequence[Patch]) -> Hypotheses:
    """The likeliest designs and poses of every place, at most TRIED (parameters as for :func:`examine`).

    The circles of an octave that is not the patch's show the background, which can look like any core. So every
    octave's pose is laid over the whole disc before some are chosen, and moving far from the place counts against it.
    """
    known, levels = match.bank(patches), picture.smooth
    octaves = min(OCTAVES, len(levels))
    level = np.repeat(np.arange(octaves), len(xy))
    likely = log_id[:, :-1] >= log_id[:, :-1].max(axis=1, keepdims=True) - DOUBT
    cores = match.search(levels, np.tile(xy, (octaves, 1)), level, known, margin=np.inf)
    cores = match.align(levels, cores[np.tile(likely.ravel(), octaves)], known.core, 3, 0.9 * match.RING_PX)
    whole = match.align(levels, match.extend(levels, cores, known), known.whole, 4, 5.6)

    place = np.tile(np.nonzero(likely)[0], octaves)
    moved = np.linalg.norm(whole.xy - xy[place], axis=1)
    likeness = match.likeness(cores.ncc, whole.ncc) - FARNESS * np.log(moved + 0.5)
    value = log_id[place, whole.which] + LIKENESS_IN_ID * likeness
    order = np.lexsort((-value, place))
    rank = np.arange(len(order)) - np.searchsorted(place[order], place[order])
    best = order[rank < TRIED]
    poses, which, place = whole[best], whole.which[best], place[best]

    view, contrast = match.view(levels, poses.xy, poses.A, which, known)
    minor = _minor(poses.A)
    evidence = np.column_stack(
        [
            _log_odds(network_score[place]),
            np.log(np.maximum(1 - np.exp(log_id[place, -1]), 1e-4)),
            log_id[place, which],
            -np.log(1.01 - cores.ncc[best]),
            -np.log(1.01 - poses.ncc),
            np.log(moved[best] / minor + 0.02),
            *_contrasts(contrast, picture),
            np.log(minor),
        ]
    )
    return Hypotheses(place, xy[place], which, poses.xy, poses.A, view, evidence)[contrast > FAINTEST]


def likeliest(place: NDArray[np.int64], odds: Float) -> NDArray[np.int64]:
    """The likeliest hypothesis of every place (indices of hypotheses), in the order of the places."""
    order = np.lexsort((-odds, place))
    return order[np.flatnonzero(np.diff(place[order], prepend=-1))]


def fitted(picture: Picture, before: Hypotheses, patches: Sequence[Patch]) -> Hypotheses:
    """The same hypotheses with the pose that fits the pixels best."""
    fit = refine.fit(picture.raw, before.xy, before.A, [patches[n] for n in before.which])
    contrast, minor = np.maximum(fit.white - fit.black, FAINTEST), _minor(fit.A)
    moved = np.linalg.norm(fit.xy - before.at, axis=1)
    unexplained = np.minimum(np.sqrt(np.maximum(fit.noise**2 - picture.noise**2, 0)) / contrast, 3.0)
    measured = np.column_stack(
        [
            -np.log(1.01 - fit.ncc),
            np.log(unexplained + 0.02),
            np.minimum(fit.blur_px / minor, 1.0),
            np.log(moved / minor + 0.02),
            *_contrasts(contrast, picture),
            np.log(minor),
        ]
    )
    view, _ = match.view(picture.smooth, fit.xy, fit.A, before.which, match.bank(patches))
    evidence = np.column_stack([before.evidence, measured])
    return Hypotheses(before.place, before.at, before.which, fit.xy, fit.A, view, evidence)


def judged(stage: str, found: Hypotheses, patches: Sequence[Patch], threads: int = 0) -> Float:
    """Log odds (n,) that there is a patch, and that its centre and design are right, after a stage."""
    if not len(found):
        return np.zeros(0)
    logit = _judge(stage, threads or cv2.getNumThreads()).run(None, inputs(found, patches))[0]
    return np.asarray(np.clip(logit, -30, 30), np.float64)


def inputs(found: Hypotheses, patches: Sequence[Patch]) -> dict[str, NDArray[np.float32]]:
    """What a judge looks at: ``view`` (n, 2, 32, 32), the place and the design, and ``evidence`` (n, columns)."""
    side = match.VIEW_PX
    pair = np.stack([found.view, match.bank(patches).picture[found.which]], axis=1)
    return {"view": pair.reshape(-1, 2, side, side), "evidence": found.evidence.astype(np.float32)}


def version() -> str:
    """Which judges these are: the first digits of the SHA-256 of their weights."""
    return hashlib.sha256(_weights("posed") + _weights("fitted")).hexdigest()[:8]


def _weights(stage: str) -> bytes:
    return (Path(__file__).parent / "weights" / f"{stage}.onnx").read_bytes()


@cache
def _judge(stage: str, threads: int) -> Session:
    return open_session(_weights(stage), threads)[0]


def _contrasts(contrast: Float, picture: Picture) -> list[Float]:
    """Logs of contrasts (n,), grey levels, over the range of the image and over its noise."""
    return [np.log(contrast / (picture.range + 5)), np.log(contrast / (picture.noise + 1))]


def _minor(A: Float) -> Float:
    return np.maximum(match.short_axis(A), 0.5)


def _log_odds(probability: Float) -> Float:
    clipped = np.clip(probability, 1e-3, 1 - 1e-3)
    return np.asarray(np.log(clipped / (1 - clipped)))
