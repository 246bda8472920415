"""The images on which a detector failed worst, with truth and detections as shapes to draw over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from kpbench.images import encode_jpeg
from kpbench.scoring.assignment import CLUTTER, DUPLICATE, MATCHED, NEAR_MISS
from kpbench.scoring.metrics import SUMS
from kpbench.scoring.outcomes import Tally
from kpbench.types import UInt8

MOST_SIDE_PX = 800  # larger images are shrunk; the marks keep the image's own px
JPEG_QUALITY = 82
KINDS = {MATCHED: "matched", DUPLICATE: "duplicate", NEAR_MISS: "near miss", CLUTTER: "clutter"}


@dataclass(frozen=True)
class Mark:
    """A true keypoint (with the axes of its disc) or a detection; px of the image, degrees."""

    x: float
    y: float
    kind: str  # of a keypoint: matched, wrong ID, missed; of a detection: one of KINDS, or wrong ID
    label: str
    axes: tuple[float, float] | None = None
    angle: float = 0.0


@dataclass(frozen=True)
class Case:
    """One image, or the part of it that holds all marks, with what was wrong in it."""

    image_id: int
    condition: str
    rung: float
    box: tuple[int, int, int, int]  # of the picture in the image: first column and row, width, height
    jpeg: bytes
    truth: tuple[Mark, ...]
    detections: tuple[Mark, ...]
    failures: dict[str, int]  # missed, wrong ID, duplicate, near miss, clutter


def worst_cases(rows: Tally, image: Callable[[int], UInt8], count: int = 12) -> tuple[Case, ...]:
    """The images with most failures, worst first, shared out evenly among the conditions.

    Parameters
    ----------
    rows : Tally
    image : function from a position in the truth to the image, (H, W) or (H, W, 3) uint8.
    count : at most so many; an image without failures is never among them.
    """
    n = dict(zip(SUMS, rows.image_sums.T, strict=True))
    failures = (n["truths"] - n["id_correct"] if rows.patch_id is not None else n["truths"] - n["matched"]) + (
        n["detections"] - n["matched"]
    )
    condition = rows.truth.condition
    most = -(-count // len(np.unique(condition)))
    taken: dict[str, int] = {}
    chosen: list[int] = []
    for k in np.argsort(-failures, kind="stable").tolist():
        if len(chosen) == count or not failures[k]:
            break
        name = str(condition[k])
        if taken.get(name, 0) < most:
            taken[name] = taken.get(name, 0) + 1
            chosen.append(k)
    return tuple(_case(rows, k, image(k)) for k in chosen)


def _case(rows: Tally, k: int, image: UInt8) -> Case:
    truth = tuple(_true(rows, t) for t in np.flatnonzero(rows.truth_image == k).tolist())
    explained = {int(rows.detection[t]): bool(rows.correct[t]) for t in np.flatnonzero(rows.truth_image == k)}
    found = tuple(_found(rows, d, explained.get(d)) for d in np.flatnonzero(rows.image == k).tolist())
    kinds = [mark.kind for mark in (*truth, *found) if mark.axes or mark.kind not in ("matched", "wrong ID")]
    failures = {kind: kinds.count(kind) for kind in ("missed", "wrong ID", "duplicate", "near miss", "clutter")}
    box = _box((*truth, *found), image.shape[1], image.shape[0])
    return Case(
        image_id=int(rows.truth.image_id[k]),
        condition=str(rows.truth.condition[k]),
        rung=float(rows.truth.rung[k]),
        box=box,
        jpeg=_jpeg(image[box[1] : box[1] + box[3], box[0] : box[0] + box[2]]),
        truth=truth,
        detections=found,
        failures={kind: n for kind, n in failures.items() if n},
    )


def _true(rows: Tally, t: int) -> Mark:
    keypoint = rows.truth.keypoints[t]
    kind = "missed" if not rows.matched[t] else "matched" if rows.correct[t] or rows.patch_id is None else "wrong ID"
    return Mark(
        float(keypoint["x"]),
        float(keypoint["y"]),
        kind,
        str(keypoint["patch_id"]),
        (float(keypoint["radius_major"]), float(keypoint["radius_minor"])),
        float(keypoint["axis_angle"]),
    )


def _found(rows: Tally, d: int, correct: bool | None) -> Mark:
    kind = "wrong ID" if correct is False and rows.patch_id is not None else KINDS[int(rows.kind[d])]
    label = "" if rows.patch_id is None else str(rows.patch_id[d])
    return Mark(float(rows.xy[d, 0]), float(rows.xy[d, 1]), kind, label)


def _box(marks: tuple[Mark, ...], width: int, height: int) -> tuple[int, int, int, int]:
    """The part of the image around all marks, of the image's proportions and at least a quarter of its sides."""
    around = [3 * m.axes[0] if m.axes else 0.0 for m in marks]
    x, y = (np.array([getattr(m, axis) for m in marks]) for axis in ("x", "y"))
    spans = [(v - around).min() for v in (x, y)], [(v + around).max() for v in (x, y)]
    share = np.clip(max((b - a) / side for a, b, side in zip(*spans, (width, height), strict=True)), 0.25, 1.0)
    box_width, box_height = int(np.ceil(share * width)), int(np.ceil(share * height))
    left = int(np.clip((spans[0][0] + spans[1][0] - box_width) / 2, 0, width - box_width))
    top = int(np.clip((spans[0][1] + spans[1][1] - box_height) / 2, 0, height - box_height))
    return left, top, box_width, box_height


def _jpeg(image: UInt8) -> bytes:
    scale = MOST_SIDE_PX / max(image.shape[:2])
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return encode_jpeg(image, JPEG_QUALITY)
