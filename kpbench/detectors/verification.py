"""Verification: what the pixels say of the points that a network found.

A network says where it sees a keypoint and which design it takes it for. Here a small network looks at the
surroundings of each such place and says which ellipse the patch fills, if there is one (:func:`ellipses`). The likely
designs are turned within it until they agree (:func:`posed`, with :mod:`kpbench.fitting`), what may be one is fitted
to the pixels (:func:`fitted`), and after each of the two a judge, a small network too, sees
the place in the frame of the patch, beside the design, and what was measured. It gives the log odds that there is a
patch of this design at this place, and how far the pose is off; the first one looks twice, the second time in the pose
that it took for right (:func:`again`). The second one knows what the first one says, and what other patches the image
seems to have: blur and contrast of one are those of all. Its log odds count.
``benchmarks/ellipses.py`` and ``benchmarks/verification.py`` train the three, on synthetic images.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.detectors.inference import Session, open_session
from kpbench.detectors.suppression import suppress
from kpbench.fitting import design_fit as refine
from kpbench.fitting.align import WHOLE_PX, Poses, align, rotate_within_ellipse, short_axis
from kpbench.fitting.pyramid import Picture
from kpbench.fitting.templates import VIEW_PX, Bank, bank
from kpbench.fitting.views import blurred, rectify, surroundings
from kpbench.patches.design import Patch
from kpbench.types import Float, UInt8
from kpbench.workers import one_blas_thread

NCC = "-log(1.01 - correlation of the whole design)"
POSED = (
    "log odds of the network's score",
    "log probability that the ID head sees a patch",
    "log probability of the design by the ID head",
    "log odds that an ellipse here is a patch",
    NCC,
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
    "log of the distance from the pose before the fit, in short semi-axes",
    "log of contrast over the range of the image, by the fit",
    "log of contrast over noise, by the fit",
    "log of the short semi-axis, px, by the fit",
    "log odds by the first judge",
    "log of 1 + the number of other patches that the image probably has",
    "log of 1 + the number of other hypotheses that are probably wrong",
    "log of blur, px, over that of the other patches",
    "log of contrast over that of the other patches",
)
"""The columns of the evidence of :func:`fitted`."""

VERIFIER = "7"
"""Version of the method. Raise it by one when detections change in any way but by other weights."""
DOUBT = 3.0
"""Designs whose log-probability by the ID head is further behind the likeliest one's are not tried, ..."""
SURE = 0.0
"""... but for places that lie on a patch with these log odds: there all are."""
TURNED_TWICE = -4.8
"""Log odds that an ellipse is a patch from which more sizes, and two rotations where both look alike, are tried."""
EMPTY = -6.5
"""Log odds that an ellipse is a patch under which a place is left."""
DIM = -5.0
"""Log odds at the first look under which there is no second one."""
HOPELESS = -3.5
"""Log odds before the fit under which a hypothesis is not worth one."""
USUAL = 70
"""About as many places as an image of 640x480 has that the judges were trained on: their odds hold for as many."""
SAME = 0.2
"""Hypotheses of one design are one if their centres are nearer than this, in short semi-axes."""
BLOCK = 2**11
"""Places whose surroundings are looked at together: memory does not grow with the image."""
SMALLEST = 2.4
"""Short semi-axis, px, under which nothing is reported: there a patch is a speck like any other."""
FAR = 0.1
"""Short semi-axes that a fit may move a centre: beyond, in blur or noise, where it began is right more often."""
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
    view : (n, VIEW_PX²) from :func:`kpbench.fitting.rectify`, nan outside the image.
    blur_px : (n,) standard deviation by the fit, 0 before it.
    evidence : (n, len(POSED)) or (n, len(FITTED))
    """

    place: NDArray[np.int64]
    at: Float
    which: NDArray[np.int64]
    xy: Float
    A: Float
    view: NDArray[np.float32]
    blur_px: Float
    evidence: Float

    def __len__(self) -> int:
        return len(self.place)

    def __getitem__(self, keep: Any) -> Hypotheses:
        return Hypotheses(*(column[keep] for column in vars(self).values()))

    @classmethod
    def joined(cls, parts: Sequence[Hypotheses]) -> Hypotheses:
        """Those of all parts, one after the other."""
        return cls(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


@dataclass(frozen=True)
class Examined:
    """What is known of the n places that were worth a fit.

    Attributes
    ----------
    place : (n,) index of the place that was asked about.
    which : (n,) index of the likeliest design.
    xy : (n, 2) px, the fitted centre.
    minor_px : (n,) short semi-axis of the fitted disc.
    score : (n,) probability that there is a patch, and that its centre and design are right.
    """

    place: NDArray[np.int64]
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
        before = posed(picture, xy, network_score, log_id, patches, threads)
        odds, corrected = judged("posed", before, patches, threads)
        before = again(picture, corrected[odds >= DIM], patches)
        odds, corrected = judged("posed", before, patches, threads)
        hopeful = distinct(corrected, odds)
        found = fitted(picture, corrected[hopeful], odds[hopeful], patches)
    odds, _ = judged("fitted", found, patches, threads)
    # an image has so many patches, however many places it has that look like one
    odds = odds - np.log(max(1.0, len(xy) / USUAL))
    best = likeliest(found.place, odds)
    best = best[_minor(found.A[best]) >= SMALLEST]
    found, odds = found[best], odds[best]
    return Examined(found.place, found.which, found.xy, _minor(found.A), 1 / (1 + np.exp(-odds)))


def ellipses(picture: Picture, xy: Float, threads: int = 0) -> tuple[Float, Float, Float]:
    """What a patch at a place would fill.

    Parameters
    ----------
    picture : Picture
    xy : ndarray of shape (n, 2), px: within about half a short semi-axis of the centre.
    threads : of the network, as for :func:`examine`.

    Returns
    -------
    Centres (n, 2) px, symmetric maps (n, 2, 2) of the unit circle to the ellipse, px, and log odds (n,) of a patch.
    """
    parts = [(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))]
    for block in np.split(xy, range(BLOCK, len(xy), BLOCK)) if len(xy) else ():
        given = {"surroundings": surroundings(picture.smooth, block)}
        odds, shift, log_map = _network("ellipse", threads).run(None, given)
        parts.append((*moved(block, np.tile(np.eye(2), (len(block), 1, 1)), shift, log_map), _clipped(odds)))
    centre, A, sure = (np.concatenate(column) for column in zip(*parts, strict=True))
    return centre, A, sure


def moved(xy: Float, A: Float, shift: NDArray[np.float32], log_map: NDArray[np.float32]) -> tuple[Float, Float]:
    """Poses A (n, 2, 2) after the symmetric maps exp(log_map), and places (n, 2) moved within the result."""
    size, axes = np.linalg.eigh(log_map.astype(np.float64))
    A = A @ np.einsum("nij,nj,nkj->nik", axes, np.exp(np.clip(size, -6, 6)), axes)
    return xy + np.einsum("nij,nj->ni", A, shift), A


def _clipped(odds: NDArray[np.float32]) -> Float:
    return np.asarray(np.clip(odds, -30, 30), np.float64)


def posed(
    picture: Picture, xy: Float, network_score: Float, log_id: Float, patches: Sequence[Patch], threads: int = 0
) -> Hypotheses:
    """The likely designs at every place that may be a patch, posed (parameters as for :func:`examine`)."""
    known, levels = bank(patches), picture.smooth
    centre, A, odds = ellipses(picture, xy, threads)
    likely = log_id[:, :-1] >= log_id[:, :-1].max(axis=1, keepdims=True) - DOUBT
    place, which = np.nonzero((likely | (odds >= SURE)[:, None]) & (odds >= EMPTY)[:, None])
    row, poses = rotate_within_ellipse(levels, centre[place], A[place], which, known, (odds >= TURNED_TWICE)[place])
    place, which = place[row], which[row]
    said = np.column_stack(
        [
            _log_odds(network_score[place]),
            np.log(np.maximum(1 - np.exp(log_id[place, -1]), 1e-4)),
            log_id[place, which],
            odds[place],
        ]
    )
    return _shown(picture, place, xy[place], poses, said, known)


def again(picture: Picture, found: Hypotheses, patches: Sequence[Patch]) -> Hypotheses:
    """Hypotheses that a judge has moved, as the image shows them where they are now."""
    known, poses = bank(patches), Poses(found.xy, found.A, found.which, np.zeros(len(found)))
    there = align(picture.smooth, poses, known.whole, 0, WHOLE_PX)
    return _shown(picture, found.place, found.at, there, found.evidence[:, : POSED.index(NCC)], known)


def _shown(picture: Picture, place: NDArray[np.int64], at: Float, poses: Poses, said: Float, known: Bank) -> Hypotheses:
    """What the first judge looks at: the image in these poses, and what the networks ``said`` of the places."""
    view, contrast = rectify(picture.smooth, poses.xy, poses.A, poses.which, known)
    minor = _minor(poses.A)
    measured = [
        -np.log(1.01 - poses.ncc),
        np.log(np.linalg.norm(poses.xy - at, axis=1) / minor + 0.02),
        *_contrasts(contrast, picture),
        np.log(minor),
    ]
    evidence = np.column_stack([said, *measured])
    found = Hypotheses(place, at, poses.which, poses.xy, poses.A, view, np.zeros(len(at)), evidence)
    return found[contrast > FAINTEST]


def likeliest(place: NDArray[np.int64], odds: Float) -> NDArray[np.int64]:
    """The likeliest hypothesis of every place (indices of hypotheses), in the order of the places."""
    order = np.lexsort((-odds, place))
    return order[np.flatnonzero(np.diff(place[order], prepend=-1))]


def distinct(found: Hypotheses, odds: Float, least: float = HOPELESS) -> NDArray[np.int64]:
    """Hypotheses that are worth a fit: not hopeless, and none that a likelier one of the same design all but covers."""
    hopeful = np.flatnonzero(odds >= least)
    kept = [np.zeros(0, np.int64)]
    for design in np.unique(found.which[hopeful]):
        rows = hopeful[found.which[hopeful] == design]
        kept.append(rows[suppress(found.xy[rows], odds[rows], SAME * _minor(found.A[rows]))])
    return np.sort(np.concatenate(kept))


def fitted(picture: Picture, before: Hypotheses, odds: Float, patches: Sequence[Patch]) -> Hypotheses:
    """The same hypotheses with the pose that fits the pixels best, or their own where that went far away from it.

    ``odds`` : (n,) log odds by the first judge.
    """
    fit = refine.fit(picture.raw, before.xy, before.A, [patches[n] for n in before.which])
    contrast, minor = np.maximum(fit.white - fit.black, FAINTEST), _minor(fit.A)
    gone, moved_on = (np.linalg.norm(fit.xy - start, axis=1) / minor for start in (before.at, before.xy))
    unexplained = np.minimum(np.sqrt(np.maximum(fit.noise**2 - picture.noise**2, 0)) / contrast, 3.0)
    measured = np.column_stack(
        [
            -np.log(1.01 - fit.ncc),
            np.log(unexplained + 0.02),
            np.minimum(fit.blur_px / minor, 1.0),
            np.log(gone + 0.02),
            np.log(moved_on + 0.02),
            *_contrasts(contrast, picture),
            np.log(minor),
            odds,
        ]
    )
    away = moved_on > FAR
    xy, A = np.where(away[:, None], before.xy, fit.xy), np.where(away[:, None, None], before.A, fit.A)
    view, _ = rectify(picture.smooth, xy, A, before.which, bank(patches))
    beside = _beside(xy, minor, odds, np.column_stack([np.log(fit.blur_px + 0.3), np.log(contrast)]))
    evidence = np.column_stack([before.evidence, measured, beside])
    return Hypotheses(before.place, before.at, before.which, xy, A, view, fit.blur_px, evidence)


def _beside(xy: Float, minor: Float, odds: Float, like: Float) -> Float:
    """How a hypothesis compares with those elsewhere in the image that are likely.

    Parameters
    ----------
    xy, minor, odds : (n, 2) px, (n,) px, and (n,) log odds by the first judge.
    like : (n, k) what patches of one image have in common.

    Returns
    -------
    (n, 2 + k): logs of 1 + how many other hypotheses are probably right, and wrong, and how far each column of
    ``like`` is from the mean of the right ones, less where they are hardly one.
    """
    right = 1 / (1 + np.exp(-odds))
    elsewhere = np.linalg.norm(xy[:, None] - xy, axis=2) > minor[:, None]
    patches, others = elsewhere @ right, elsewhere @ (1 - right)
    weight = elsewhere * right / (patches + 0.3)[:, None]
    apart = like * weight.sum(axis=1, keepdims=True) - weight @ like
    return np.column_stack([np.log1p(patches), np.log1p(others), apart])


def judged(stage: str, found: Hypotheses, patches: Sequence[Patch], threads: int = 0) -> tuple[Float, Hypotheses]:
    """Log odds (n,) that there is a patch, and that its centre and design are right, after a stage.

    And the same hypotheses with the poses that the judge takes for right.
    """
    if not len(found):
        return np.zeros(0), found
    odds, shift, log_map = _network(stage, threads).run(None, inputs(found, patches))
    xy, A = moved(found.xy, found.A, shift, log_map)
    return _clipped(odds), replace(found, xy=xy, A=A)


def inputs(found: Hypotheses, patches: Sequence[Patch]) -> dict[str, NDArray[np.float32]]:
    """What a judge looks at: ``view`` (n, 2, 32, 32), the place and the design, and ``evidence`` (n, columns).

    The design is as blurred as the fit found the image. Outside the image there is neither: both are 0.
    """
    side, design = VIEW_PX, bank(patches).picture[found.which]
    soft = np.flatnonzero(found.blur_px)
    design[soft] = blurred(design[soft], found.A[soft], found.blur_px[soft])
    pair = np.stack([found.view, design], axis=1)
    pair[np.broadcast_to(np.isnan(found.view)[:, None], pair.shape)] = 0
    return {"view": pair.reshape(-1, 2, side, side), "evidence": found.evidence.astype(np.float32)}


def version(*asked: object) -> str:
    """Version of the verification: :data:`VERIFIER`, and the first digits of a SHA-256 of weights and places.

    ``asked``: what decides which places are asked about.
    """
    parts = [*map(_weights, ("ellipse", "posed", "fitted")), repr(asked).encode()]
    return f"v{VERIFIER}-{hashlib.sha256(b''.join(parts)).hexdigest()[:8]}"


def _weights(name: str) -> bytes:
    return (Path(__file__).parent / "weights" / f"{name}.onnx").read_bytes()


def _network(name: str, threads: int) -> Session:
    return _opened(name, threads or cv2.getNumThreads())


@cache
def _opened(name: str, threads: int) -> Session:
    return open_session(_weights(name), threads)[0]


def _contrasts(contrast: Float, picture: Picture) -> list[Float]:
    """Logs of contrasts (n,), grey levels, over the range of the image and over its noise."""
    return [np.log(contrast / (picture.range + 5)), np.log(contrast / (picture.noise + 1))]


def _minor(A: Float) -> Float:
    return np.maximum(short_axis(A), 0.5)


def _log_odds(probability: Float) -> Float:
    clipped = np.clip(probability, 1e-3, 1 - 1e-3)
    return np.asarray(np.log(clipped / (1 - clipped)))
