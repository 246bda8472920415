"""Truth from COCO keypoint annotations, for images that kpbench did not make. Results are read as predictions."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kpbench.errors import DataError
from kpbench.keypoints import KEYPOINT_DTYPE, Truth, UInt8

__all__ = ["CocoDataset", "open_coco"]


@dataclass(frozen=True)
class CocoDataset:
    """What the evaluator and the report need of a dataset, from COCO annotations.

    Attributes
    ----------
    path : Path
        The annotations file.
    truth : Truth
        With the SHA-256 of the annotations file as fingerprint.
    files : tuple of str
        Names of the images, below the folder of the annotations file or its ``images`` folder; may be missing.
    """

    path: Path
    truth: Truth
    files: tuple[str, ...]

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the annotations file."""
        return self.truth.fingerprint

    @property
    def config(self) -> dict[str, Any]:
        """Empty: nothing is known of how the images were made."""
        return {}

    def image(self, index: int) -> UInt8:
        """The image at a position, (H, W, 3) uint8 RGB.

        Raises
        ------
        DataError
            If there is none, or it cannot be decoded.
        """
        import cv2

        for folder in (self.path.parent, self.path.parent / "images"):
            pixels = cv2.imread(str(folder / self.files[index]), cv2.IMREAD_COLOR) if self.files[index] else None
            if pixels is not None:
                return np.asarray(pixels[..., ::-1], np.uint8)
        raise DataError(f"{self.path.parent / self.files[index]}: no image there that can be decoded")


def open_coco(path: str | Path) -> CocoDataset:
    """Read true keypoints from a COCO annotations file.

    Every annotation has one keypoint ``[x, y, v]`` (with v = 0 it is passed over) and its radius in px: ``radius``, or
    ``radius_major`` and ``radius_minor``. Its patch ID is ``category_id`` less 1, as ``kpbench export --format coco``
    numbers them. Images may have a ``condition`` (text), a ``rung`` (number) and a ``scene_id`` (whole number).

    Raises
    ------
    DataError
        One line with the file, the entry in it and what was expected.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
        content = json.loads(data)
    except OSError as error:
        raise DataError(f"{path}: cannot be read, {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: no JSON ({error})") from None
    try:
        truth = replace(_truth(content), fingerprint=hashlib.sha256(data).hexdigest())
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    return CocoDataset(path, truth, tuple(str(entry.get("file_name", "")) for entry in content["images"]))


def _truth(content: Any) -> Truth:
    images, annotations = (_list(content, name) for name in ("images", "annotations"))
    ids = [_whole(entry, "id", f"images[{n}]") for n, entry in enumerate(images)]
    place = {image_id: n for n, image_id in enumerate(ids)}
    if len(place) < len(ids):
        raise DataError("two images share an id")
    of_image: list[int] = []
    keypoints = np.zeros(len(annotations), KEYPOINT_DTYPE)
    for n, entry in enumerate(annotations):
        where = f"annotations[{n}]"
        image_id = _whole(entry, "image_id", where)
        if image_id not in place:
            raise DataError(f"{where}: image_id is {image_id}, but there is no such image")
        of_image.append(place[image_id] if _keypoint(entry, where, keypoints[n : n + 1]) else -1)
    image = np.array(of_image, np.int64)
    order = np.argsort(image, kind="stable")[np.count_nonzero(image < 0) :]
    rungs = [entry.get("rung") for entry in images]
    return Truth(
        image_id=np.array(ids, np.int64),
        offsets=np.concatenate([[0], np.cumsum(np.bincount(image[order], minlength=len(ids)))]).astype(np.int64),
        keypoints=keypoints[order],
        condition=np.array([str(entry.get("condition", "")) for entry in images]),
        rung=np.array([math.nan if r is None else _number(r, f"images[{n}]: rung") for n, r in enumerate(rungs)]),
        scene_id=np.array([entry.get("scene_id", image_id) for entry, image_id in zip(images, ids, strict=True)]),
    )


def _keypoint(entry: dict[str, Any], where: str, row: Any) -> bool:
    """Fill a row of the table; False for a keypoint that is not labelled."""
    point = entry.get("keypoints")
    if not isinstance(point, list) or len(point) != 3:
        raise DataError(f"{where}: keypoints is {str(point)[:60]}, expected one keypoint [x, y, v]")
    x, y, visibility = (_number(value, f"{where}: a number of keypoints") for value in point)
    major = entry.get("radius_major", entry.get("radius"))
    if major is None:
        raise DataError(
            f"{where}: has no radius, expected the disc's in px as radius, or radius_major and radius_minor"
        )
    row["x"], row["y"], row["patch_id"] = x, y, _whole(entry, "category_id", where) - 1
    row["radius_major"] = _number(major, f"{where}: radius")
    row["radius_minor"] = _number(entry.get("radius_minor", major), f"{where}: radius_minor")
    row["axis_angle"], row["visible"] = entry.get("axis_angle", 0.0), entry.get("visible", 1.0)
    return visibility > 0


def _list(content: Any, name: str) -> list[dict[str, Any]]:
    value = content.get(name) if isinstance(content, dict) else None
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise DataError(f"has no list {name!r} of objects, expected COCO annotations")
    return value


def _whole(entry: dict[str, Any], name: str, where: str) -> int:
    value = entry.get(name)
    if type(value) is not int or not 0 <= value < 2**63:
        raise DataError(f"{where}: {name} is {str(value)[:60]}, expected a whole number of 0 or more")
    return value


def _number(value: Any, what: str) -> float:
    if type(value) not in (int, float) or not math.isfinite(value):
        raise DataError(f"{what} is {str(value)[:60]}, expected a finite number")
    return float(value)
