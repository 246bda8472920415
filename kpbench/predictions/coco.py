"""Read COCO annotations as truth (for images that kpbench did not make), and COCO results as predictions."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError, KpbenchWarning, PredictionsError, system_reason
from kpbench.files import path_below, read_bytes
from kpbench.predictions.coco_fields import (
    ANNOTATION_COLUMNS,
    EXPECTED_IN_COCO,
    IMAGE_COLUMNS,
    RESULT_COLUMNS,
    CocoAnnotation,
    CocoImage,
    CocoResult,
    Columns,
    find_outside,
    has_place,
    make_columns,
    require_possible_images,
    require_possible_keypoints,
)
from kpbench.predictions.decode import (
    convert_records,
    decode_records,
    json_type,
    parse_json,
    pause_gc,
    require_utf8,
    split_lists,
)
from kpbench.predictions.tables import build_predictions
from kpbench.provenance import image_source
from kpbench.types import KEYPOINT_DTYPE, Predictions, Truth, UInt8, offsets_of

IMAGES_LOOKED_AT = 20
"""Number of images whose files are compared with the width and height that the annotations state."""


@dataclass(frozen=True)
class CocoDataset:
    """A dataset of COCO annotations, for scoring and reports; opened by :func:`kpbench.predictions.open_coco`.

    Attributes
    ----------
    path : Path
        The annotations file.
    truth : Truth
        ``H_patch2image`` is zero and ``contrast`` nan, as annotations do not tell them.
    files : tuple of str
        File names of the images, relative to the folder of the annotations file or to its ``images`` folder. The
        files may be missing. A file is read only if it lies below the folder, after symbolic links are followed.
    config : dict
        ``patches``: the IDs and names of the categories. ``source``: what the images are, if ``info`` has a ``source``
        that is "simulated", "simulated photographs" or "photographs".

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
    config: dict[str, Any] = field(default_factory=dict)

    @property
    def fingerprint(self) -> str:
        """Fingerprint in the annotations file; the SHA-256 of the file if the file holds no fingerprint."""
        return self.truth.fingerprint

    def __len__(self) -> int:
        return len(self.truth)

    def keypoints(self, index: int) -> NDArray[Any]:
        """Return the true keypoints of an image, a table of :data:`kpbench.KEYPOINT_DTYPE`."""
        first, last = self.truth.offsets[index : index + 2]
        return self.truth.keypoints[first:last]

    def ignored(self, index: int) -> NDArray[Any]:
        """Return the patches of an image that are not judged, a table as :meth:`keypoints`."""
        if self.truth.ignored is None:
            return self.truth.keypoints[:0]
        return np.asarray(self.truth.ignored[self.truth.ignored_image == index])

    def effects(self, index: int) -> list[dict[str, Any]]:
        """Return an empty list: annotations do not tell what degraded an image."""
        return []

    def __getitem__(self, index: int) -> tuple[UInt8, NDArray[Any]]:
        return self.image(index), self.keypoints(index)

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
    ``radius_minor``. Annotations with v = 0 are skipped. Those with ``iscrowd`` 1 and a radius are ignored
    (:attr:`kpbench.Truth.ignored`), also with v = 0. The patch ID is ``category_id`` minus 1, as
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
        data = read_bytes(path)
        require_utf8(data)
        with pause_gc():
            about, images, annotations = _decode_annotations(data)
        info = about.get("info")
        fingerprint = info.get("fingerprint") if isinstance(info, dict) else None
        if not isinstance(fingerprint, str) or not fingerprint:
            fingerprint = hashlib.sha256(data).hexdigest()
        del data  # its memory is used again
        truth = _make_truth(images, annotations, fingerprint)
        files = truth.file or ("",) * len(truth)
        _warn_of_orientation(path, images)
        _warn_of_keypoints_outside(path, images, truth)
        return CocoDataset(path, truth, files, _describe(about))
    except OSError as error:
        raise DataError(f"{path}: cannot be read, {system_reason(error) or error}") from None
    except (DataError, PredictionsError) as error:
        raise DataError(f"{path}: {error}") from None


def _warn_of_orientation(path: Path, images: Columns) -> None:
    """Warn if an image stands upright in the annotations and lies on its side when it is read, or the reverse."""
    first = (images[name][:IMAGES_LOOKED_AT].tolist() for name in ("file_name", "width", "height"))
    for name, width, height in zip(*first, strict=True):
        if not name or not width or width == height:
            continue
        try:
            files = [path_below(path.parent, prefix + name) for prefix in ("", "images/")]
        except DataError:  # told when the image is read
            continue
        file = next((file for file in files if file.is_file()), None)
        if file is None:
            continue
        from kpbench.pixels import read_size  # here, as scores need no OpenCV

        size = read_size(file)
        if size is not None and size == (height, width):
            warnings.warn(
                f"{path}: {name} is {width:g} x {height:g} there, but {size[0]} x {size[1]} "
                "when it is read, as its EXIF data rotates it; the truth must be in that orientation",
                KpbenchWarning,
                stacklevel=3,
            )
            return


def _warn_of_keypoints_outside(path: Path, images: Columns, truth: Truth) -> None:
    """Warn if keypoints lie outside of the width and height that the annotations state."""
    counts = np.diff(truth.offsets)
    width, height = images["width"], images["height"]
    outside = find_outside(np.repeat(width, counts), np.repeat(height, counts), truth.keypoints)
    if len(outside):
        k = truth.keypoints[outside[0]]
        n = int(np.searchsorted(truth.offsets, outside[0], side="right")) - 1
        warnings.warn(
            f"{path}: {len(outside)} of {len(truth.keypoints)} keypoints lie outside of the stated width and height of "
            f"their images, such as ({k['x']:g}, {k['y']:g}) in the image {truth.image_id[n]} of {width[n]:g} x "
            f"{height[n]:g}",
            KpbenchWarning,
            stacklevel=3,
        )


def _decode_annotations(data: bytes) -> tuple[Any, Columns, Columns]:
    """Return everything but the two lists, the images and the annotations."""

    def place_image(n: int) -> str:
        return f"images[{n}]"

    def place_annotation(n: int) -> str:
        return f"annotations[{n}]"

    try:
        frame, (images, annotations) = split_lists(data, "images", "annotations")
        return (
            frame,
            make_columns(decode_records(images, CocoImage, EXPECTED_IN_COCO, place_image), IMAGE_COLUMNS),
            make_columns(
                decode_records(annotations, CocoAnnotation, EXPECTED_IN_COCO, place_annotation), ANNOTATION_COLUMNS
            ),
        )
    except (ValueError, RecursionError):
        content = parse_json(data, "the file")  # decoded at once, to find any fault
    if not isinstance(content, dict):
        raise DataError(f"holds {json_type(content)}, expected COCO annotations") from None
    for name in ("images", "annotations"):
        if not isinstance(content.get(name), list):
            raise DataError(f"has no list {name!r}, expected COCO annotations") from None
    return (
        content,
        make_columns([convert_records(content["images"], CocoImage, EXPECTED_IN_COCO, place_image)], IMAGE_COLUMNS),
        make_columns(
            [convert_records(content["annotations"], CocoAnnotation, EXPECTED_IN_COCO, place_annotation)],
            ANNOTATION_COLUMNS,
        ),
    )


def _describe(about: dict[str, Any]) -> dict[str, Any]:
    """Return :attr:`CocoDataset.config` from the annotations. Categories without a whole ID and a name are left out."""
    categories = about.get("categories")
    patches = [
        {"id": category["id"] - 1, "name": category["name"]}
        for category in (categories if isinstance(categories, list) else [])
        if isinstance(category, dict) and type(category.get("id")) is int and isinstance(category.get("name"), str)
    ]
    info = about.get("info")
    source = image_source({"source": info.get("source")} if isinstance(info, dict) else {})
    return ({"patches": patches} if patches else {}) | ({"source": source} if source else {})


def _make_truth(images: Columns, annotations: Columns, fingerprint: str) -> Truth:
    ids = images["id"]
    sorter = np.argsort(ids, kind="stable")
    if np.any(np.diff(ids[sorter]) == 0):
        raise DataError("two images share an id")
    require_possible_images(images)
    image_id = annotations["image_id"]
    keypoints, is_placed = _make_keypoints(annotations)
    is_crowd = is_placed & (annotations["iscrowd"] == 1)
    labelled = is_placed & ~is_crowd
    place = np.searchsorted(ids, image_id, sorter=sorter)
    unknown = np.append(ids[sorter], -1)[place] != image_id
    if unknown.any():
        n = int(np.argmax(unknown))
        raise DataError(f"annotations[{n}]: image_id is {image_id[n]}, but there is no such image")
    image, crowd_image = sorter[place[labelled]], sorter[place[is_crowd]]
    rows = np.flatnonzero(labelled)[np.argsort(image, kind="stable")]
    crowd_order = np.argsort(crowd_image, kind="stable")
    is_in_order = np.array_equal(rows, np.arange(len(keypoints)))
    return Truth(
        image_id=ids,
        offsets=offsets_of(np.bincount(image, minlength=len(ids))),
        keypoints=keypoints if is_in_order else keypoints[rows],
        condition=images["condition"].astype(np.str_),
        rung=images["rung"],
        scene_id=np.where(images["scene_id"] < 0, ids, images["scene_id"]),
        fingerprint=fingerprint,
        file=tuple(images["file_name"].tolist()) if any(images["file_name"]) else None,
        ignored=keypoints[is_crowd][crowd_order] if is_crowd.any() else None,
        ignored_image=crowd_image[crowd_order] if is_crowd.any() else None,
    )


def _make_keypoints(annotations: Columns) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the keypoints of all annotations, of type KEYPOINT_DTYPE, and whether each has a place."""
    points = annotations["keypoints"]
    table = np.zeros(len(points), KEYPOINT_DTYPE)
    table["x"], table["y"] = points[:, 0], points[:, 1]
    table["patch_id"] = annotations["category_id"] - 1
    table["contrast"] = np.nan
    radius, major, minor = (annotations[name] for name in ("radius", "radius_major", "radius_minor"))
    with np.errstate(over="ignore"):  # some columns have 32 bits; a number that they cannot hold is refused as inf
        for name in ("axis_angle", "visible"):
            table[name] = annotations[name]
        table["radius_major"] = np.where(np.isnan(major), radius, major)
        table["radius_minor"] = np.where(np.isnan(minor), table["radius_major"], minor)
    require_possible_keypoints(annotations, table)
    return table, has_place(annotations, table)


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
        _, [pieces] = split_lists(data)
        table = make_columns(decode_records(pieces, CocoResult, EXPECTED_IN_COCO, place), RESULT_COLUMNS)
    except (ValueError, RecursionError):  # the list cannot be split: decode the file at once, and find any fault
        entries = parse_json(data, "the file")
        if not isinstance(entries, list):
            raise PredictionsError(f"holds {json_type(entries)}, expected a list of COCO keypoint results") from None
        table = make_columns([convert_records(entries, CocoResult, EXPECTED_IN_COCO, place)], RESULT_COLUMNS)
    x, y, _ = table["keypoints"].T
    rows = {"image_id": table["image_id"], "id": table["category_id"] - 1.0, "score": table["score"], "x": x, "y": y}
    return build_predictions(rows, {}, place)
