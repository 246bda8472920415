"""The fields of COCO files, and the values that they may have."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain
from operator import attrgetter
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
from kpbench.predictions.decode import RecordBatch
from kpbench.types import Float

LARGEST_PX = 10**6
"""Largest accepted width, height, radius and coordinate, px. The squares of larger numbers may overflow."""
LARGEST_RUNG = 1e12
"""Largest accepted rung of a condition."""
Whole = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Category = Annotated[int, msgspec.Meta(ge=1, le=2**15)]
"""ID of a category: the patch ID plus 1."""
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
    """An entry of ``annotations``: a keypoint with its disc. The fields from ``radius`` on are kpbench's additions.

    UNSET, which no file can hold, stands for a missing number.
    """

    image_id: Whole
    category_id: Category
    keypoints: Point
    id: int | float | str | None = None
    radius: float | None = None
    radius_major: float | None = None
    radius_minor: float | None = None
    axis_angle: float | msgspec.UnsetType = msgspec.UNSET
    visible: float | msgspec.UnsetType = msgspec.UNSET
    iscrowd: bool | int | float | None = 0


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
    "iscrowd": "0 or 1",
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


Columns = dict[str, NDArray[Any]]
"""For each field, the values of all records."""
IMAGE_COLUMNS: dict[str, tuple[type, Any]] = {
    "id": (int, None),
    "file_name": (object, ""),
    "width": (float, 0.0),
    "height": (float, 0.0),
    "condition": (object, ""),
    "rung": (float, np.nan),
    "scene_id": (int, -1),
}
ANNOTATION_COLUMNS: dict[str, tuple[type, Any]] = {
    "image_id": (int, None),
    "category_id": (int, None),
    "id": (object, None),
    "radius": (float, np.nan),
    "radius_major": (float, np.nan),
    "radius_minor": (float, np.nan),
    "axis_angle": (float, 0.0),
    "visible": (float, 1.0),
    "iscrowd": (float, 0.0),
}
RESULT_COLUMNS: dict[str, tuple[type, Any]] = {
    "image_id": (int, None),
    "category_id": (int, None),
    "score": (float, 0.0),
}
"""For each field but ``keypoints``, the type of its column, and the value that stands for null and for no value."""


def make_columns(batches: Iterable[RecordBatch[Any]], kinds: Mapping[str, tuple[type, Any]]) -> Columns:
    """Make a column of each field of ``kinds``. The column ``keypoints`` has a row (x, y, v) per record.

    Columns of numbers hold inf in place of a given NaN.
    """

    def column(batch: RecordBatch[Any], name: str) -> NDArray[Any]:
        records, (kind, missing) = batch.records, kinds[name]
        if name not in batch.keys:
            return np.full(len(records), missing, kind)
        try:
            values: NDArray[Any] = np.fromiter(map(attrgetter(name), records), kind, len(records))
            if kind is not float or not np.isnan(values).any():
                return values
        except TypeError:  # some value is UNSET, or is null in place of a whole number
            pass
        given = [getattr(record, name) for record in records]
        return np.array([missing if v in (None, msgspec.UNSET) else v if v == v else np.inf for v in given], kind)

    def points(batch: RecordBatch[Any]) -> Float:
        values = chain.from_iterable(map(attrgetter("keypoints"), batch.records))
        return np.fromiter(values, float, 3 * len(batch.records)).reshape(-1, 3)

    parts: dict[str, list[NDArray[Any]]] = {name: [np.zeros(0, kind)] for name, (kind, _) in kinds.items()}
    if kinds is not IMAGE_COLUMNS:
        parts["keypoints"] = [np.zeros((0, 3))]
    for batch in batches:  # the records of a batch are freed before the next one is decoded
        for name, arrays in parts.items():
            arrays.append(points(batch) if name == "keypoints" else column(batch, name))
    return {name: np.concatenate(arrays) for name, arrays in parts.items()}


# --- Values --------------------------------------------------------------------------------------------------------


def require_possible_images(images: Columns) -> None:
    """Refuse images with a value that no image has.

    Raises
    ------
    DataError
        At the first such value of a field.
    """

    def refuse(name: str, valid: NDArray[np.bool_], expected: str) -> None:
        if not valid.all():
            n = int(np.argmin(valid))
            value = images[name].tolist()[n]
            raise DataError(f"images[{n}] (id {images['id'][n]}): {name} is {value!r}, expected {expected}")

    for name in ("width", "height"):
        size = images[name]
        possible = (size >= 0) & (size <= LARGEST_PX) & (size == np.floor(size))
        refuse(name, possible, f"a whole number of px up to {LARGEST_PX}, or 0 or null if unknown")
    rung, condition = images["rung"], images["condition"]
    refuse("rung", np.isnan(rung) | (np.abs(rung) <= LARGEST_RUNG), f"a finite number up to {LARGEST_RUNG:g}")
    refuse("condition", np.fromiter(map(str.isprintable, condition), bool, len(condition)), "a text")


def require_possible_keypoints(annotations: Columns, table: NDArray[Any]) -> None:
    """Refuse annotations with a value that no keypoint has, and two annotations of one keypoint.

    The coordinates and the radius of a keypoint that is not labelled (v = 0) may be anything.

    Parameters
    ----------
    annotations : dict of str to ndarray of shape (n, ...)
    table : ndarray of shape (n,), KEYPOINT_DTYPE

    Raises
    ------
    DataError
        At the first such annotation.
    """

    def refuse(wrong: NDArray[np.bool_], problem: str) -> None:
        if wrong.any():
            n = int(np.argmax(wrong))
            values = {name: table[name][n].item() for name in ("radius_major", "axis_angle", "visible")}
            text = problem.format(x=points[n, 0], y=points[n, 1], v=points[n, 2], **values)
            raise DataError(f"annotations[{n}] (image_id {annotations['image_id'][n]}): {text}")

    points = annotations["keypoints"]
    labelled = has_place(annotations, table)
    refuse(~np.isin(points[:, 2], (0, 1, 2)), "the visibility v of keypoints is {v:g}, expected 0, 1 or 2")
    lacks_radius = labelled & np.isnan(table["radius_major"])
    refuse(lacks_radius, "has no radius, expected radius, or radius_major and radius_minor, in px")
    refuse(~(np.abs(table["axis_angle"]) <= LARGEST_PX), "axis_angle is {axis_angle}, expected degrees")
    refuse(~(np.abs(table["visible"]) <= LARGEST_PX), "visible is {visible}, expected a fraction")
    possible = (np.abs(points[:, 0]) <= LARGEST_PX) & (np.abs(points[:, 1]) <= LARGEST_PX)
    for name in ("radius_major", "radius_minor"):
        possible &= (table[name] > 0) & (table[name] <= LARGEST_PX)
    expected = f"finite numbers up to {LARGEST_PX} and a radius over 0"
    refuse(
        labelled & ~possible,
        "keypoints are [{x}, {y}, {v}] and the radius is {radius_major}, expected " + expected,
    )
    _require_different(annotations, labelled)


def has_place(annotations: Columns, table: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which annotations have a keypoint: v is over 0, or it is ignored (``iscrowd``) and has a radius."""
    is_crowd = annotations["iscrowd"] == 1
    return np.asarray((annotations["keypoints"][:, 2] != 0) | (is_crowd & ~np.isnan(table["radius_major"])))


def _require_different(annotations: Columns, labelled: NDArray[np.bool_]) -> None:
    """Refuse two annotations with one id, and two keypoints at one place of an image."""
    found = annotations["id"].tolist()
    if len(set(found)) < len(found):
        first = dict[Any, int]()
        for n, value in enumerate(found):
            if value is not None and first.setdefault(value, n) != n:
                raise DataError(f"annotations[{n}] has the id {value!r} of annotations[{first[value]}]")
    rows = np.flatnonzero(labelled)
    image_id, (x, y, _) = annotations["image_id"][rows], annotations["keypoints"][rows].T
    key = image_id * (4.0 * LARGEST_PX) + x  # nearly sorted in most files, and shared by few, which are left to sort
    order = np.argsort(key, kind="stable")
    shared = np.append(np.diff(key[order]) == 0, False)[: len(order)]
    order = order[shared | np.roll(shared, 1)]
    order = order[np.lexsort((y[order], x[order], image_id[order]))]
    same = np.ones(max(0, len(order) - 1), bool)
    for values in (image_id, x, y):
        same &= np.diff(values[order]) == 0
    if same.any():
        k = int(np.argmax(same))
        a, b = sorted((int(rows[order[k]]), int(rows[order[k + 1]])))
        raise DataError(
            f"annotations[{b}] (image_id {annotations['image_id'][b]}): is at the place of annotations[{a}], "
            "expected one annotation per keypoint"
        )


def find_outside(width: Float, height: Float, table: NDArray[Any]) -> NDArray[np.intp]:
    """Return the rows of keypoints that lie outside of their images. The size of an image is nan or 0 if unknown."""
    x, y = table["x"], table["y"]
    outside = (width > 0) & ((x < -0.5) | (x > width)) | (height > 0) & ((y < -0.5) | (y > height))
    return np.flatnonzero(outside)
