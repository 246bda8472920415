"""COCO keypoints: annotations as truth, for images that kpbench did not make, and results as predictions."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError, PredictionsError
from kpbench.predictions.decode import cut, kind, parse, records, typed, without_gc
from kpbench.predictions.table_files import from_table
from kpbench.types import KEYPOINT_DTYPE, Predictions, Truth, UInt8, offsets_of

Whole = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Category = Annotated[int, msgspec.Meta(ge=1, le=2**15)]  # a patch ID plus 1
Point = tuple[float, float, float]


class Image(msgspec.Struct, gc=False):
    """An entry of ``images``."""

    id: Whole
    file_name: str = ""
    condition: str = ""
    rung: float | None = None
    scene_id: Whole | None = None


class Annotation(msgspec.Struct, gc=False):
    """An entry of ``annotations``: one keypoint with the radius of its disc."""

    image_id: Whole
    category_id: Category
    keypoints: Point
    radius: float | None = None
    radius_major: float | None = None
    radius_minor: float | None = None
    axis_angle: float = 0.0
    visible: float = 1.0


class Info(msgspec.Struct):
    """What the export of kpbench says of the dataset."""

    fingerprint: str = ""


class Annotations(msgspec.Struct):
    """A COCO annotations file."""

    images: list[Image]
    annotations: list[Annotation]
    info: Info = msgspec.field(default_factory=Info)


class Result(msgspec.Struct, gc=False):
    """An entry of a results file: one detection."""

    image_id: Whole
    category_id: Category
    keypoints: Point
    score: float


EXPECTED = {
    "axis_angle": "degrees",
    "category_id": "a whole number from 1",
    "condition": "a text",
    "file_name": "a text",
    "id": "a whole number of 0 or more",
    "image_id": "a whole number of 0 or more",
    "keypoints": "one keypoint [x, y, v] of numbers",
    "radius": "a number of px",
    "radius_major": "a number of px",
    "radius_minor": "a number of px",
    "rung": "a number",
    "scene_id": "a whole number of 0 or more",
    "score": "a finite number",
    "visible": "a fraction",
}


@dataclass(frozen=True)
class CocoDataset:
    """What the evaluator and the report need of a dataset, from COCO annotations.

    Attributes
    ----------
    path : Path
        The annotations file.
    truth : Truth
        With the fingerprint of the dataset that was exported, else the SHA-256 of the annotations file.
    files : tuple of str
        Names of the images, below the folder of the annotations file or its ``images`` folder; may be missing.
    """

    path: Path
    truth: Truth
    files: tuple[str, ...]

    @property
    def fingerprint(self) -> str:
        """Of the dataset that ``kpbench export`` wrote, else the SHA-256 of the annotations file."""
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
        with without_gc():
            content = _annotations(data)
            truth = _truth(content, content.info.fingerprint or hashlib.sha256(data).hexdigest())
            files = tuple(image.file_name for image in content.images)
            del content  # else the collector would walk through it
        return CocoDataset(path, truth, files)
    except OSError as error:
        raise DataError(f"{path}: cannot be read, {error.strerror}") from None
    except (DataError, PredictionsError) as error:
        raise DataError(f"{path}: {error}") from None


def _annotations(data: bytes) -> Annotations:
    try:
        return msgspec.json.decode(data, type=Annotations)
    except (ValueError, RecursionError):
        content = parse(data, "the file")
    if not isinstance(content, dict):
        raise DataError(f"holds {kind(content)}, expected COCO annotations") from None
    for name in ("images", "annotations"):
        if not isinstance(content.get(name), list):
            raise DataError(f"has no list {name!r}, expected COCO annotations") from None
    info = content.get("info")
    named = info.get("fingerprint") if isinstance(info, dict) else None
    return Annotations(
        typed(content["images"], Image, EXPECTED, lambda n: f"images[{n}]"),
        typed(content["annotations"], Annotation, EXPECTED, lambda n: f"annotations[{n}]"),
        Info(named if isinstance(named, str) else ""),
    )


def _truth(content: Annotations, fingerprint: str) -> Truth:
    images, annotations = content.images, content.annotations
    ids = np.array([image.id for image in images], np.int64)
    sorter = np.argsort(ids, kind="stable")
    if np.any(np.diff(ids[sorter]) == 0):
        raise DataError("two images share an id")
    named = _column(annotations, "image_id", np.int64)
    keypoints, labelled = _keypoints(annotations)
    place = np.searchsorted(ids, named, sorter=sorter)
    unknown = np.append(ids[sorter], -1)[place] != named
    if unknown.any():
        n = int(np.argmax(unknown))
        raise DataError(f"annotations[{n}]: image_id is {named[n]}, but there is no such image")
    image = sorter[place[labelled]]
    rows = np.flatnonzero(labelled)[np.argsort(image, kind="stable")]
    return Truth(
        image_id=ids,
        offsets=offsets_of(np.bincount(image, minlength=len(ids))),
        keypoints=keypoints if np.array_equal(rows, np.arange(len(keypoints))) else keypoints[rows],
        condition=np.array([image.condition for image in images], np.str_),
        rung=np.array([np.nan if image.rung is None else image.rung for image in images]),
        scene_id=np.array([image.id if image.scene_id is None else image.scene_id for image in images], np.int64),
        fingerprint=fingerprint,
    )


def _keypoints(annotations: list[Annotation]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """The table of all annotations, and which of them are labelled."""
    table = np.zeros(len(annotations), KEYPOINT_DTYPE)
    points = _points(annotations)
    table["x"], table["y"] = points[:, 0], points[:, 1]
    table["patch_id"] = _column(annotations, "category_id", np.int64) - 1
    for name in ("axis_angle", "visible"):
        table[name] = _column(annotations, name)
    radius, major, minor = (_column(annotations, name) for name in ("radius", "radius_major", "radius_minor"))
    major = np.where(np.isnan(major), radius, major)
    for n in np.flatnonzero(np.isnan(major)).tolist():
        if annotations[n].radius is None and annotations[n].radius_major is None:
            raise DataError(
                f"annotations[{n}] (image_id {annotations[n].image_id}): has no radius, "
                "expected the disc's in px as radius, or radius_major and radius_minor"
            )
    table["radius_major"], table["radius_minor"] = major, np.where(np.isnan(minor), major, minor)
    fine = np.isfinite(points).all(axis=1) & np.isfinite(table["radius_major"]) & np.isfinite(table["radius_minor"])
    if not fine.all():
        n = int(np.argmin(fine))
        raise DataError(
            f"annotations[{n}] (image_id {annotations[n].image_id}): keypoints are {points[n].tolist()} and the radius "
            f"is {table['radius_major'][n]}, expected finite numbers"
        )
    return table, points[:, 2] > 0


def _column(entries: Sequence[Annotation | Result], name: str, kind: type = np.float64) -> NDArray[Any]:
    """One field of all entries; nan where there is none."""
    values = map(attrgetter(name), entries)
    try:
        return np.fromiter(values, kind, len(entries))
    except TypeError:  # None among them
        return np.array([getattr(entry, name) for entry in entries], kind)


def _points(entries: Sequence[Annotation | Result]) -> NDArray[np.float64]:
    """Rows x, y, v."""
    points = chain.from_iterable(map(attrgetter("keypoints"), entries))
    return np.fromiter(points, np.float64, 3 * len(entries)).reshape(-1, 3)


def coco_results(data: bytes) -> Predictions:
    """COCO keypoint results, ``[{"image_id", "category_id", "keypoints": [x, y, v], "score"}, …]``, as predictions.

    Each entry is one detection with one keypoint, whose visibility v is ignored; its patch ID is the category ID less
    1, as ``kpbench export --format coco`` numbers them. Images without detections are not listed in such a file.

    Raises
    ------
    PredictionsError
        Naming the first entry that does not fit, and its image.
    """

    def place(n: int) -> str:
        return f"results[{n}]"

    try:
        frame, pieces = cut(data, r"^\s*\[")
        if frame != []:
            raise ValueError
        parts = [_detections(batch) for batch in records(pieces, Result, EXPECTED, place)]
    except (ValueError, RecursionError):  # entries may hold objects: read it whole, which also says what is wrong
        entries = parse(data, "the file")
        if not isinstance(entries, list):
            raise PredictionsError(f"holds {kind(entries)}, expected a list of COCO keypoint results") from None
        parts = [_detections(typed(entries, Result, EXPECTED, place))]
    columns = map(np.concatenate, zip(_detections([]), *parts, strict=True))
    return from_table(dict(zip(("image_id", "id", "score", "x", "y"), columns, strict=True)), {}, place)


def _detections(batch: list[Result]) -> tuple[NDArray[Any], ...]:
    """Columns ``image_id, id, score, x, y`` of some results."""
    points = _points(batch)
    return (
        _column(batch, "image_id", np.int64),
        _column(batch, "category_id") - 1,
        _column(batch, "score"),
        points[:, 0],
        points[:, 1],
    )
