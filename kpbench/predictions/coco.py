"""Read COCO annotations as truth (for images that kpbench did not make), and COCO results as predictions."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError, KpbenchWarning, PredictionsError, system_reason
from kpbench.files import note_read, path_below
from kpbench.predictions.decode import (
    convert_records,
    decode_records,
    json_type,
    parse_json,
    pause_gc,
    require_utf8,
    split_list,
)
from kpbench.predictions.table_files import build_predictions
from kpbench.types import KEYPOINT_DTYPE, Predictions, Truth, UInt8, offsets_of

Whole = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Category = Annotated[int, msgspec.Meta(ge=1, le=2**15)]
"""ID of a category: the patch ID plus 1."""
IMAGES_LOOKED_AT = 20
"""Number of images whose files are compared with the width and height that the annotations state."""
Point = tuple[float, float, float]
"""Place x, y in px, and COCO's visibility v; v = 0 means "not labelled"."""


class CocoImage(msgspec.Struct, gc=False):
    """An entry of ``images``. Condition, rung and scene are kpbench's additions."""

    id: Whole
    file_name: str = ""
    width: float | None = None
    height: float | None = None
    condition: str = ""
    rung: float | None = None
    scene_id: Whole | None = None


class CocoAnnotation(msgspec.Struct, gc=False):
    """An entry of ``annotations``: a keypoint with its disc. The fields from ``radius`` on are kpbench's additions."""

    image_id: Whole
    category_id: Category
    keypoints: Point
    radius: float | None = None
    radius_major: float | None = None
    radius_minor: float | None = None
    axis_angle: float = 0.0
    visible: float = 1.0


class CocoInfo(msgspec.Struct):
    """The ``info`` object. The fingerprint is kpbench's addition."""

    fingerprint: str = ""


class CocoAnnotations(msgspec.Struct):
    """A COCO annotations file."""

    images: list[CocoImage]
    annotations: list[CocoAnnotation]
    info: CocoInfo = msgspec.field(default_factory=CocoInfo)


class CocoResult(msgspec.Struct, gc=False):
    """An entry of a results file: a detection."""

    image_id: Whole
    category_id: Category
    keypoints: Point
    score: float


EXPECTED_IN_COCO = {
    "axis_angle": "degrees",
    "category_id": "a whole number from 1",
    "condition": "a text",
    "file_name": "a text",
    "height": "a number of px",
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
    "width": "a number of px",
}
"""The expected value of each field of the records above, in words."""


@dataclass(frozen=True)
class CocoDataset:
    """A dataset of COCO annotations, for scoring and reports; opened by :func:`kpbench.predictions.open_coco`.

    Attributes
    ----------
    path : Path
        The annotations file.
    truth : Truth
    files : tuple of str
        File names of the images, relative to the folder of the annotations file or to its ``images`` folder. The
        files may be missing. A file is read only if it lies below the folder, after symbolic links are followed.

    Examples
    --------
    >>> import kpbench
    >>> folder = kpbench.export_dataset(kpbench.open_dataset("kpbench-data"), "coco", "coco")
    >>> dataset = kpbench.predictions.open_coco("coco/annotations.json")
    >>> len(dataset.truth), len(dataset.files)
    (6, 6)
    """

    path: Path
    truth: Truth
    files: tuple[str, ...]

    @property
    def fingerprint(self) -> str:
        """Fingerprint in the annotations file; the SHA-256 of the file if the file holds no fingerprint."""
        return self.truth.fingerprint

    @property
    def config(self) -> dict[str, Any]:
        """Empty: annotations do not tell how the images were made."""
        return {}

    def image(self, index: int) -> UInt8:
        """Return the image at an index into the truth, as uint8 of shape (H, W, 3), RGB.

        Raises
        ------
        DataError
            If the image is missing or cannot be decoded, or the file does not lie below the folder of the annotations.
        """
        from kpbench.images import read_rgb  # here, as scores need no OpenCV

        for prefix in ("", "images/") if self.files[index] else ():
            pixels = read_rgb(path_below(self.path.parent, prefix + self.files[index]))
            if pixels is not None:
                return pixels
        raise DataError(f"{self.path.parent / self.files[index]}: no image there that can be decoded")


def open_coco(path: str | Path) -> CocoDataset:
    """Read true keypoints from a COCO annotations file.

    Each annotation has one keypoint ``[x, y, v]`` and its radius in px: ``radius``, or ``radius_major`` and
    ``radius_minor``. Annotations with v = 0 are skipped. The patch ID is ``category_id`` minus 1, as
    :func:`kpbench.export_dataset` numbers the categories. Images may have a ``condition`` (text), a ``rung`` (number)
    and a ``scene_id`` (whole number).

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    CocoDataset

    Raises
    ------
    DataError
        If the file cannot be read. The message names the file, the faulty entry and the expected value.

    Examples
    --------
    >>> import json, pathlib, kpbench
    >>> annotation = {"image_id": 1, "category_id": 1, "keypoints": [10, 20, 2], "radius": 5}
    >>> content = {"images": [{"id": 1, "file_name": "1.png"}], "annotations": [annotation]}
    >>> _ = pathlib.Path("truth.json").write_text(json.dumps(content))
    >>> kpbench.predictions.open_coco("truth.json").truth.keypoints["radius_major"].tolist()
    [5.0]
    """
    path = Path(path)
    try:
        note_read(path)
        data = path.read_bytes()
        require_utf8(data)
        with pause_gc():
            content = _decode_annotations(data)
            truth = _make_truth(content, content.info.fingerprint or hashlib.sha256(data).hexdigest())
            files = tuple(image.file_name for image in content.images)
            _warn_of_orientation(path, content.images[:IMAGES_LOOKED_AT])
            del content  # freed before the garbage collector resumes and scans it
        return CocoDataset(path, truth, files)
    except OSError as error:
        raise DataError(f"{path}: cannot be read, {system_reason(error) or error}") from None
    except (DataError, PredictionsError) as error:
        raise DataError(f"{path}: {error}") from None


def _warn_of_orientation(path: Path, images: Sequence[CocoImage]) -> None:
    """Warn if an image stands upright in the annotations and lies on its side when it is read, or the reverse."""
    for image in images:
        if not image.file_name or not image.width or image.width == image.height:
            continue
        try:
            files = [path_below(path.parent, prefix + image.file_name) for prefix in ("", "images/")]
        except DataError:  # told when the image is read
            continue
        file = next((file for file in files if file.is_file()), None)
        if file is None:
            continue
        from kpbench.pixels import read_size  # here, as scores need no OpenCV

        size = read_size(file)
        if size is not None and size == (image.height, image.width):
            warnings.warn(
                f"{path}: {image.file_name} is {image.width:g} x {image.height:g} there, but {size[0]} x {size[1]} "
                "when it is read, as its EXIF data rotates it; the truth must be in that orientation",
                KpbenchWarning,
                stacklevel=3,
            )
            return


def _decode_annotations(data: bytes) -> CocoAnnotations:
    try:
        return msgspec.json.decode(data, type=CocoAnnotations)
    except (ValueError, RecursionError):
        content = parse_json(data, "the file")  # decoded again, to find the place of the fault
    if not isinstance(content, dict):
        raise DataError(f"holds {json_type(content)}, expected COCO annotations") from None
    for name in ("images", "annotations"):
        if not isinstance(content.get(name), list):
            raise DataError(f"has no list {name!r}, expected COCO annotations") from None
    info = content.get("info")
    fingerprint = info.get("fingerprint") if isinstance(info, dict) else None
    return CocoAnnotations(
        convert_records(content["images"], CocoImage, EXPECTED_IN_COCO, lambda n: f"images[{n}]"),
        convert_records(content["annotations"], CocoAnnotation, EXPECTED_IN_COCO, lambda n: f"annotations[{n}]"),
        CocoInfo(fingerprint if isinstance(fingerprint, str) else ""),
    )


def _make_truth(content: CocoAnnotations, fingerprint: str) -> Truth:
    images, annotations = content.images, content.annotations
    ids = np.array([image.id for image in images], np.int64)
    sorter = np.argsort(ids, kind="stable")
    if np.any(np.diff(ids[sorter]) == 0):
        raise DataError("two images share an id")
    image_id = _column(annotations, "image_id", np.int64)
    keypoints, labelled = _make_keypoints(annotations)
    for n, found in enumerate(images):
        if found.rung is not None and not math.isfinite(found.rung):
            raise DataError(f"images[{n}] (id {found.id}): rung is {found.rung}, expected a finite number")
        if not found.condition.isprintable():
            raise DataError(f"images[{n}] (id {found.id}): condition is {found.condition!r}, expected a text")
    place = np.searchsorted(ids, image_id, sorter=sorter)
    unknown = np.append(ids[sorter], -1)[place] != image_id
    if unknown.any():
        n = int(np.argmax(unknown))
        raise DataError(f"annotations[{n}]: image_id is {image_id[n]}, but there is no such image")
    image = sorter[place[labelled]]
    rows = np.flatnonzero(labelled)[np.argsort(image, kind="stable")]
    is_in_order = np.array_equal(rows, np.arange(len(keypoints)))
    return Truth(
        image_id=ids,
        offsets=offsets_of(np.bincount(image, minlength=len(ids))),
        keypoints=keypoints if is_in_order else keypoints[rows],
        condition=np.array([image.condition for image in images], np.str_),
        rung=np.array([np.nan if image.rung is None else image.rung for image in images]),
        scene_id=np.array([image.id if image.scene_id is None else image.scene_id for image in images], np.int64),
        fingerprint=fingerprint,
    )


def _make_keypoints(annotations: list[CocoAnnotation]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the keypoints of all annotations, of type KEYPOINT_DTYPE, and whether each is labelled (v over 0)."""
    table = np.zeros(len(annotations), KEYPOINT_DTYPE)
    points = _points(annotations)
    table["x"], table["y"] = points[:, 0], points[:, 1]
    table["patch_id"] = _column(annotations, "category_id", np.int64) - 1
    for name in ("axis_angle", "visible"):
        table[name] = _column(annotations, name)
    radius, major, minor = (_column(annotations, name) for name in ("radius", "radius_major", "radius_minor"))
    major = np.where(np.isnan(major), radius, major)
    labelled = points[:, 2] > 0
    for n in np.flatnonzero(np.isnan(major) & labelled).tolist():
        if annotations[n].radius is None and annotations[n].radius_major is None:
            raise DataError(
                f"annotations[{n}] (image_id {annotations[n].image_id}): has no radius, "
                "expected radius, or radius_major and radius_minor, in px"
            )
    for name in ("axis_angle", "visible"):  # nan stands for a missing value, so the file must not hold it
        for n in np.flatnonzero(np.isnan(table[name])).tolist():
            if getattr(annotations[n], name) is not None:
                raise DataError(f"annotations[{n}] (image_id {annotations[n].image_id}): {name} is no finite number")
    table["radius_major"], table["radius_minor"] = major, np.where(np.isnan(minor), major, minor)
    valid = np.isfinite(points).all(axis=1) & np.isfinite(table["radius_major"]) & np.isfinite(table["radius_minor"])
    valid &= ~np.isinf(table["axis_angle"]) & ~np.isinf(table["visible"])
    valid &= (table["radius_major"] > 0) & (table["radius_minor"] > 0)
    valid |= ~labelled & np.isfinite(points[:, 2])
    if not valid.all():
        n = int(np.argmin(valid))
        raise DataError(
            f"annotations[{n}] (image_id {annotations[n].image_id}): keypoints are {points[n].tolist()} and the radius "
            f"is {table['radius_major'][n]}, expected finite numbers and a radius over 0"
        )
    return table, labelled


def _column(entries: Sequence[CocoAnnotation | CocoResult], name: str, kind: type = np.float64) -> NDArray[Any]:
    """Return a field of all entries. None becomes nan."""
    values = map(attrgetter(name), entries)
    try:
        return np.fromiter(values, kind, len(entries))
    except TypeError:  # some value is None
        return np.array([getattr(entry, name) for entry in entries], kind)


def _points(entries: Sequence[CocoAnnotation | CocoResult]) -> NDArray[np.float64]:
    """Return an array with a row (x, y, v) per entry."""
    points = chain.from_iterable(map(attrgetter("keypoints"), entries))
    return np.fromiter(points, np.float64, 3 * len(entries)).reshape(-1, 3)


def decode_coco_results(data: bytes) -> Predictions:
    """Decode COCO keypoint results, ``[{"image_id", "category_id", "keypoints": [x, y, v], "score"}, …]``.

    Each entry is a detection with one keypoint. The visibility v is ignored. The patch ID is the category ID minus 1,
    as :func:`kpbench.export_dataset` numbers the categories. Results do not list images without detections.

    Raises
    ------
    PredictionsError
        At the first entry with a fault. The message names the entry and the image.
    """
    require_utf8(data)

    def place(n: int) -> str:
        return f"results[{n}]"

    try:
        frame, pieces = split_list(data, r"^\s*\[")
        if frame != []:
            raise ValueError
        parts = [_to_columns(batch) for batch in decode_records(pieces, CocoResult, EXPECTED_IN_COCO, place)]
    except (ValueError, RecursionError):  # the list cannot be split: decode the file at once, and find any fault
        entries = parse_json(data, "the file")
        if not isinstance(entries, list):
            raise PredictionsError(f"holds {json_type(entries)}, expected a list of COCO keypoint results") from None
        parts = [_to_columns(convert_records(entries, CocoResult, EXPECTED_IN_COCO, place))]
    columns = map(np.concatenate, zip(_to_columns([]), *parts, strict=True))
    return build_predictions(dict(zip(("image_id", "id", "score", "x", "y"), columns, strict=True)), {}, place)


def _to_columns(batch: list[CocoResult]) -> tuple[NDArray[Any], ...]:
    """Return the columns ``image_id, id, score, x, y`` of some results."""
    points = _points(batch)
    return (
        _column(batch, "image_id", np.int64),
        _column(batch, "category_id") - 1,
        _column(batch, "score"),
        points[:, 0],
        points[:, 1],
    )
