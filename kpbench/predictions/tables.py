"""Predictions as a table with one row per keypoint, as in CSV and Parquet."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import PredictionsError
from kpbench.predictions.decode import Place, abbreviate
from kpbench.predictions.fields import DETECTION_CELLS, IMAGE_CELLS, MATRIX_CELLS, TABLE_COLUMNS, encode_names
from kpbench.types import UNKNOWN, Float, Int, Predictions, offsets_of
from kpbench.validity import InvalidValue

ID_LIMITS = {"image_id": 2**63, "id": 2**53, "board": 2**31, "points": 2**31}
ID_LIMITS |= {"width": 2**31, "height": 2**31, "frame_index": 2**53}
"""Columns of whole numbers, and the least number that each cannot hold."""
WHOLE_CELLS = {
    "id": (0, "a patch id, a whole number of 0 or more"),
    "board": (-1, "the number of one of the boards, or -1"),
    "points": (-1, "the index of a board's point, or -1"),
}
"""Columns of whole numbers of a detection, their least value, and the expected value in words."""
LEAST_OF_IMAGE = {
    "width": (1, "px, a whole number over 0"),
    "height": (1, "px, a whole number over 0"),
    "frame_index": (0, "a whole number of 0 or more"),
}
"""Columns of whole numbers of an image, their least value, and the expected value in words."""


def build_predictions(table: dict[str, NDArray[Any]], header: dict[str, Any], place: Place) -> Predictions:
    """Make predictions from a table with one row per keypoint, in any order.

    Parameters
    ----------
    table : dict of str to ndarray of shape (R,)
        The columns of :data:`TABLE_COLUMNS`. nan marks a blank cell. A row with no value of :data:`DETECTION_CELLS` is
        an image without keypoints.
    header : dict
        Detector, dataset and fingerprint, as fields of :class:`kpbench.Predictions`.
    place : function
        Names the n-th row.

    Raises
    ------
    PredictionsError
        At the first row with a fault.
    """
    cells = [name for name in DETECTION_CELLS if name in table]
    blank = np.logical_and.reduce([np.isnan(table[name]) for name in cells])
    rows = np.flatnonzero(~blank)
    for name in cells:
        column = table[name][rows]
        valid, expected = np.isfinite(column), "a finite number"
        if name in WHOLE_CELLS:
            least, expected = WHOLE_CELLS[name]
            valid &= (column >= least) & (column == np.floor(column)) & (column < ID_LIMITS[name])
        if not valid.all():
            raise _bad_cell(table, name, int(rows[np.argmin(valid)]), place, expected)
    if len(table["image_id"]) and table["image_id"].min() < 0:
        row = int(np.argmax(table["image_id"] < 0))
        raise PredictionsError(f"{place(row)}: image_id is {table['image_id'][row]}, expected 0 or more")
    image_id, image = np.unique(table["image_id"], return_inverse=True)
    rows = rows[np.argsort(image[rows], kind="stable")]
    offsets = offsets_of(np.bincount(image[rows], minlength=len(image_id)))
    try:
        return Predictions(
            image_id=image_id,
            offsets=offsets,
            xy=np.stack([table["x"][rows], table["y"][rows]], axis=1),
            score=table["score"][rows] if "score" in table else np.ones(len(rows)),
            patch_id=table["id"][rows].astype(np.int64) if "id" in table else None,
            blur_px=table["blur_px"][rows] if "blur_px" in table else None,
            board=table["board"][rows] if "board" in table else None,
            points=table["points"][rows] if "points" in table else None,
            probability=table["probability"][rows] if "probability" in table else None,
            A_patch2image=_matrices(table, "A_patch2image", rows),
            covariance=_matrices(table, "covariance", rows),
            **_columns_of_images(table, image, place),
            **header,
        )
    except InvalidValue as error:
        if error.keypoint is None:
            row = int(np.argmax(image == error.image))
        else:
            row = int(rows[offsets[error.image] + error.keypoint])
        raise PredictionsError(f"{place(row)} (image_id {error.image_id}): {error.problem}") from None


def _bad_cell(table: dict[str, NDArray[Any]], name: str, row: int, place: Place, expected: str) -> PredictionsError:
    value = table[name][row]
    shown = "blank" if value != value else abbreviate(value) if isinstance(value, str) else value
    return PredictionsError(f"{place(row)} (image_id {table['image_id'][row]}): {name} is {shown}, expected {expected}")


def _matrices(table: dict[str, NDArray[Any]], name: str, rows: Int) -> Float | None:
    """Return the matrices (n, 2, 2) of some rows, or None if the table has none."""
    if MATRIX_CELLS[name][0] not in table:
        return None
    first, second, *third, last = [table[cell][rows] for cell in MATRIX_CELLS[name]]
    return np.stack([first, second, *(third or [second]), last], axis=1).reshape(-1, 2, 2)


def _columns_of_images(table: dict[str, NDArray[Any]], image: Int, place: Place) -> dict[str, Any]:
    """Return the columns of the images, and refuse rows of one image that disagree.

    Parameters
    ----------
    image : ndarray of shape (R,), int64
        Index of the image of each row.
    """
    first = np.zeros(image.max(initial=-1) + 1, np.int64)
    first[image[::-1]] = np.arange(len(image))[::-1]
    columns: dict[str, Any] = {}
    for name in [name for name in IMAGE_CELLS if name in table]:
        cells = table[name]
        known = cells == cells
        differs = (known != known[first[image]]) | (known & (cells != cells[first[image]]))
        if differs.any():
            row = int(np.argmax(differs))
            earlier = int(first[image[row]])
            same = (
                abbreviate(cells[earlier] if name == "file" else float(cells[earlier])) if known[earlier] else "blank"
            )
            raise _bad_cell(table, name, row, place, f"{same} as in {place(earlier)}")
        if name in LEAST_OF_IMAGE:
            least, expected = LEAST_OF_IMAGE[name]
            is_whole = (cells >= least) & (cells == np.floor(cells)) & (cells < ID_LIMITS[name])
            if (known & ~is_whole).any():
                raise _bad_cell(table, name, int(np.argmax(known & ~is_whole)), place, expected)
        columns[name] = np.where(known, cells, UNKNOWN.get(name, 0))[first]
    if "width" in columns:
        columns["size"] = np.stack([columns.pop("width"), columns.pop("height")], axis=1)
    return columns


def make_table(predictions: Predictions) -> dict[str, NDArray[Any]]:
    """Return columns with one row per keypoint, and one row per image without keypoints."""
    p = predictions
    counts = np.diff(p.offsets)
    image = np.repeat(np.arange(len(p)), np.maximum(counts, 1))
    blank = counts[image] == 0
    columns: dict[str, NDArray[Any]] = {"image_id": p.image_id[image]}
    cells = {"x": p.xy[:, 0], "y": p.xy[:, 1], "score": p.score, "id": p.patch_id}
    for name, names in MATRIX_CELLS.items():
        matrices = getattr(p, name)
        if matrices is not None:
            places = (0, 1, 3) if len(names) == 3 else range(4)
            cells |= {cell: matrices.reshape(-1, 4)[:, k] for cell, k in zip(names, places, strict=True)}
    cells |= {name: getattr(p, name) for name in ("blur_px", "board", "points", "probability")}
    for name, values in cells.items():
        if values is not None:
            columns[name] = np.full(len(image), np.nan)
            columns[name][~blank] = values
    file_names = encode_names(p)
    if file_names is not None:
        columns["file"] = np.array(file_names, object)[image]
    width, height = (None, None) if p.size is None else p.size.T
    of_images = {"width": width, "height": height, "frame_index": p.frame_index, "time_s": p.time_s, "ms": p.ms}
    for name, values in of_images.items():
        if values is not None:
            columns[name] = np.where(values == UNKNOWN.get(name, 0), np.nan, values)[image]
    return columns


def require_column_names(names: list[str], place: str) -> list[str]:
    """Check the names of a table's columns, and return the names without blanks at the ends."""
    together = (*MATRIX_CELLS.values(), ("board", "points"), ("width", "height"))
    is_whole = all(len({*cells} & {*names}) in (0, len(cells)) for cells in together)
    if not {"image_id", "x", "y"} <= set(names) <= set(TABLE_COLUMNS) or len(set(names)) < len(names) or not is_whole:
        raise PredictionsError(
            f"{place} has columns {','.join(names)[:80]}, expected {','.join(TABLE_COLUMNS)} "
            "(optional from score on; those of a matrix, of a board and of a size together)"
        )
    return names
