"""The fields of COCO files, and the values that they may have."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from operator import attrgetter
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DataError
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


class CocoInfo(msgspec.Struct):
    """The ``info`` object. The fingerprint is kpbench's addition."""

    fingerprint: str = ""


class CocoFile(msgspec.Struct):
    """A COCO annotations file whose long lists are not yet decoded."""

    images: msgspec.Raw
    annotations: msgspec.Raw
    info: CocoInfo = msgspec.field(default_factory=CocoInfo)


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


def column(
    entries: Sequence[CocoAnnotation | CocoResult], name: str, kind: type = np.float64, missing: float = np.nan
) -> NDArray[Any]:
    """Return a field of all entries. ``missing`` stands for UNSET, and nan for None."""
    values = map(attrgetter(name), entries)
    try:
        return np.fromiter(values, kind, len(entries))
    except TypeError:  # some value is UNSET
        return np.array([missing if v is msgspec.UNSET else v for v in map(attrgetter(name), entries)], kind)


def points_of(entries: Sequence[CocoAnnotation | CocoResult]) -> Float:
    """Return an array with a row (x, y, v) per entry."""
    points = chain.from_iterable(map(attrgetter("keypoints"), entries))
    return np.fromiter(points, np.float64, 3 * len(entries)).reshape(-1, 3)


# --- Values --------------------------------------------------------------------------------------------------------


def require_possible_images(images: Sequence[CocoImage]) -> None:
    """Refuse images with a value that no image has.

    Raises
    ------
    DataError
        At the first such value.
    """
    for n, image in enumerate(images):
        for name, value in (("width", image.width), ("height", image.height)):
            if value is not None and not (0 <= value <= LARGEST_PX and value == int(value)):
                expected = f"a whole number of px up to {LARGEST_PX}, or 0 or null if unknown"
                raise DataError(f"images[{n}] (id {image.id}): {name} is {value}, expected {expected}")
        if image.rung is not None and not abs(image.rung) <= LARGEST_RUNG:
            expected = f"a finite number up to {LARGEST_RUNG:g}"
            raise DataError(f"images[{n}] (id {image.id}): rung is {image.rung}, expected {expected}")
        if not image.condition.isprintable():
            raise DataError(f"images[{n}] (id {image.id}): condition is {image.condition!r}, expected a text")


def require_possible_keypoints(annotations: Sequence[CocoAnnotation], points: Float, table: NDArray[Any]) -> None:
    """Refuse annotations with a value that no keypoint has, and two annotations of one keypoint.

    The coordinates and the radius of a keypoint that is not labelled (v = 0) may be anything.

    Parameters
    ----------
    annotations : sequence of CocoAnnotation
    points : ndarray of shape (n, 3)
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
            raise DataError(f"annotations[{n}] (image_id {annotations[n].image_id}): {text}")

    labelled = points[:, 2] != 0
    lacks_radius = labelled & np.isnan(table["radius_major"])
    for n in np.flatnonzero(lacks_radius).tolist():  # the file may hold NaN
        lacks_radius[n] = annotations[n].radius is None and annotations[n].radius_major is None
    refuse(~np.isin(points[:, 2], (0, 1, 2)), "the visibility v of keypoints is {v:g}, expected 0, 1 or 2")
    refuse(lacks_radius, "has no radius, expected radius, or radius_major and radius_minor, in px")
    refuse(~(np.abs(table["axis_angle"]) <= LARGEST_PX), "axis_angle is {axis_angle}, expected degrees")
    refuse(~(np.abs(table["visible"]) <= LARGEST_PX), "visible is {visible}, expected a fraction")
    possible = (np.abs(points[:, :2]) <= LARGEST_PX).all(axis=1)
    for name in ("radius_major", "radius_minor"):
        possible &= (table[name] > 0) & (table[name] <= LARGEST_PX)
    expected = f"finite numbers up to {LARGEST_PX} and a radius over 0"
    refuse(
        labelled & ~possible,
        "keypoints are [{x}, {y}, {v}] and the radius is {radius_major}, expected " + expected,
    )
    _require_different(annotations, points, labelled)


def _require_different(annotations: Sequence[CocoAnnotation], points: Float, labelled: NDArray[np.bool_]) -> None:
    """Refuse two annotations with one id, and two keypoints at one place of an image."""
    found = [annotation.id for annotation in annotations]
    if len(set(found)) - (None in set(found)) < len(found) - found.count(None):
        first = dict[Any, int]()
        for n, value in enumerate(found):
            if value is not None and first.setdefault(value, n) != n:
                raise DataError(f"annotations[{n}] has the id {value!r} of annotations[{first[value]}]")
    rows = np.flatnonzero(labelled)
    image_id, x, y = column(annotations, "image_id", np.int64)[rows], points[rows, 0], points[rows, 1]
    order = np.argsort(x)  # few keypoints share their x, so that little is left to sort
    shared = np.append(np.diff(x[order]) == 0, False)[: len(order)]
    order = order[shared | np.roll(shared, 1)]
    order = order[np.lexsort((y[order], x[order], image_id[order]))]
    same = np.ones(max(0, len(order) - 1), bool)
    for values in (image_id, x, y):
        same &= np.diff(values[order]) == 0
    if same.any():
        k = int(np.argmax(same))
        a, b = sorted((int(rows[order[k]]), int(rows[order[k + 1]])))
        raise DataError(
            f"annotations[{b}] (image_id {annotations[b].image_id}): is at the place of annotations[{a}], "
            "expected one annotation per keypoint"
        )


def find_outside(width: Float, height: Float, table: NDArray[Any]) -> NDArray[np.intp]:
    """Return the rows of keypoints that lie outside of their images. The size of an image is nan or 0 if unknown."""
    x, y = table["x"], table["y"]
    outside = (width > 0) & ((x < -0.5) | (x > width)) | (height > 0) & ((y < -0.5) | (y > height))
    return np.flatnonzero(outside)
