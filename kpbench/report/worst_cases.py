"""Pick the images on which a detector fails most, with marks for the true keypoints and the detections."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from kpbench.images import encode_jpeg
from kpbench.scoring.assignment import CLUTTER, DUPLICATE, MATCHED, NEAR_MISS
from kpbench.scoring.metrics import SUMS
from kpbench.scoring.outcomes import Outcomes
from kpbench.types import UInt8

MOST_SIDE_PX = 800
"""Largest width and height of a picture in the gallery, px. Larger images are shrunk."""
JPEG_QUALITY = 82
"""JPEG quality of a picture in the gallery, from 0 to 100."""
NAME_OF_KIND = {MATCHED: "matched", DUPLICATE: "duplicate", NEAR_MISS: "near miss", CLUTTER: "clutter"}
FAILURES = ("missed", "wrong ID", "duplicate", "near miss", "clutter")
"""The kinds of failures in an image."""


@dataclass(frozen=True)
class Mark:
    """A true keypoint or a detection, to be drawn over an image.

    Attributes
    ----------
    x, y : float
        Place in the whole image, px.
    kind : str
        For a true keypoint: "matched", "wrong ID" or "missed". For a detection: "matched", "wrong ID", "duplicate",
        "near miss" or "clutter".
    label : str
        Patch ID; "" if unknown.
    axes : (major, minor) or None
        Semi-axes of a true keypoint's disc, px. None for a detection.
    angle : float
        Angle of the major axis, degrees from +x towards +y.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.report.Mark(10.0, 20.0, "clutter", "3").axes is None
    True
    """

    x: float
    y: float
    kind: str
    label: str
    axes: tuple[float, float] | None = None
    angle: float = 0.0


@dataclass(frozen=True)
class Case:
    """An image with failures, cropped to a box around all marks.

    Attributes
    ----------
    image_id : int
    condition : str
    rung : float
    box : (left, top, width, height)
        The part of the image that the picture shows, px.
    jpeg : bytes
        The picture.
    truth, detections : tuple of Mark
    failures : dict of str to int
        Number of failures of each kind that occurs in the image: "missed", "wrong ID", "duplicate", "near miss" or
        "clutter".

    Examples
    --------
    >>> import kpbench
    >>> case = kpbench.report.Case(4, "blur", 7.0, (0, 0, 64, 48), b"", (), (), {"missed": 2})
    >>> sum(case.failures.values())
    2
    """

    image_id: int
    condition: str
    rung: float
    box: tuple[int, int, int, int]
    jpeg: bytes
    truth: tuple[Mark, ...]
    detections: tuple[Mark, ...]
    failures: dict[str, int]


def pick_worst_cases(outcomes: Outcomes, image: Callable[[int], UInt8], count: int = 12) -> tuple[Case, ...]:
    """Pick the images with the most failures, worst first.

    At most ``count`` / (number of conditions) images of each condition, rounded up, are picked.

    Parameters
    ----------
    outcomes : Outcomes
    image : function
        Function that takes an index into the truth, and returns the image as uint8, (H, W) grey or (H, W, 3) RGB.
    count : int
        Largest number of images. Images without failures are not picked.

    Returns
    -------
    tuple of Case

    Examples
    --------
    >>> import kpbench
    >>> dataset = kpbench.open_dataset("kpbench-data")
    >>> nothing = kpbench.score(dataset, [kpbench.Detections.none()] * len(dataset))
    >>> case = kpbench.report.pick_worst_cases(nothing.outcomes, dataset.image)[0]
    >>> case.failures == {"missed": len(case.truth)}
    True
    """
    n = dict(zip(SUMS, outcomes.image_sums.T, strict=True))
    found = n["matched"] if outcomes.detections.patch_id is None else n["id_correct"]
    failures = (n["truths"] - found) + (n["detections"] - n["matched"])
    condition = outcomes.truth.condition
    most_per_condition = -(-count // len(np.unique(condition)))
    picked_of: dict[str, int] = {}
    picked: list[int] = []
    for k in np.argsort(-failures, kind="stable").tolist():
        if len(picked) == count or not failures[k]:
            break
        name = str(condition[k])
        if picked_of.get(name, 0) < most_per_condition:
            picked_of[name] = picked_of.get(name, 0) + 1
            picked.append(k)
    return tuple(_make_case(outcomes, k, image(k)) for k in picked)


def _make_case(outcomes: Outcomes, k: int, image: UInt8) -> Case:
    keypoints = np.flatnonzero(outcomes.truth_points.image == k).tolist()
    found = np.flatnonzero(outcomes.detections.image == k).tolist()
    is_correct = {int(outcomes.matches.detection[t]): bool(outcomes.correct[t]) for t in keypoints}
    truth = tuple(_mark_of_truth(outcomes, t) for t in keypoints)
    detections = tuple(_mark_of_detection(outcomes, d, is_correct.get(d, True)) for d in found)
    # A wrong ID marks both the keypoint and its detection, but counts once
    kinds = [mark.kind for mark in truth] + [mark.kind for mark in detections if mark.kind != "wrong ID"]
    left, top, width, height = box = _box_around((*truth, *detections), image.shape[1], image.shape[0])
    return Case(
        image_id=int(outcomes.truth.image_id[k]),
        condition=str(outcomes.truth.condition[k]),
        rung=float(outcomes.truth.rung[k]),
        box=box,
        jpeg=_encode_jpeg(image[top : top + height, left : left + width]),
        truth=truth,
        detections=detections,
        failures={kind: kinds.count(kind) for kind in FAILURES if kind in kinds},
    )


def _mark_of_truth(outcomes: Outcomes, t: int) -> Mark:
    keypoint = outcomes.truth.keypoints[t]
    is_right = outcomes.correct[t] or outcomes.detections.patch_id is None
    kind = "missed" if not outcomes.matched[t] else "matched" if is_right else "wrong ID"
    return Mark(
        float(keypoint["x"]),
        float(keypoint["y"]),
        kind,
        str(keypoint["patch_id"]),
        (float(keypoint["radius_major"]), float(keypoint["radius_minor"])),
        float(keypoint["axis_angle"]),
    )


def _mark_of_detection(outcomes: Outcomes, d: int, is_correct: bool) -> Mark:
    found = outcomes.detections
    is_right = is_correct or found.patch_id is None
    kind = NAME_OF_KIND[int(outcomes.matches.kind[d])] if is_right else "wrong ID"
    label = "" if found.patch_id is None else str(found.patch_id[d])
    return Mark(float(found.xy[d, 0]), float(found.xy[d, 1]), kind, label)


def _box_around(marks: tuple[Mark, ...], width: int, height: int) -> tuple[int, int, int, int]:
    """Return the part of an image that holds all marks: left, top, width, height.

    The part has the proportions of the image. Its sides are at least a quarter of the image's sides.
    """
    margin = [3 * m.axes[0] if m.axes else 0.0 for m in marks]
    x, y = (np.array([getattr(m, axis) for m in marks]) for axis in ("x", "y"))
    low, high = [(v - margin).min() for v in (x, y)], [(v + margin).max() for v in (x, y)]
    share = np.clip(max((b - a) / side for a, b, side in zip(low, high, (width, height), strict=True)), 0.25, 1.0)
    box_width, box_height = int(np.ceil(share * width)), int(np.ceil(share * height))
    left = int(np.clip((low[0] + high[0] - box_width) / 2, 0, width - box_width))
    top = int(np.clip((low[1] + high[1] - box_height) / 2, 0, height - box_height))
    return left, top, box_width, box_height


def _encode_jpeg(image: UInt8) -> bytes:
    scale = MOST_SIDE_PX / max(image.shape[:2])
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return encode_jpeg(image, JPEG_QUALITY)
