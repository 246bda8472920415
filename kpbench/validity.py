"""The values that the columns of predictions may have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import PredictionsError

ROUNDING = 1e-9
"""How much a covariance may differ from a symmetric, positive semi-definite matrix, in parts of its trace."""

Valid = Callable[[NDArray[Any]], NDArray[np.bool_]]
"""A function that says which values of a column are possible."""


class InvalidValue(PredictionsError):
    """A value of a predictions table is impossible.

    Attributes
    ----------
    image : int
        Position of the image in the table.
    keypoint : int or None
        Position of the keypoint within the image; None if the value belongs to the image.
    image_id : int
        Identity of the image.
    problem : str
        The impossible value and the expected value, without their place in the table.
    """

    def __init__(self, image: int, keypoint: int | None, image_id: int, problem: str) -> None:
        super().__init__(f"predictions[{image}] (image_id {image_id}): {problem}")
        self.image, self.keypoint, self.image_id, self.problem = image, keypoint, image_id, problem


def is_covariance(matrices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether each matrix (n, 2, 2) is finite, symmetric and positive semi-definite, of shape (n,).

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.validity import is_covariance
    >>> is_covariance(np.array([[[1.0, 0.5], [0.5, 1.0]], [[1.0, 2.0], [2.0, 1.0]]])).tolist()
    [True, False]
    """
    xx, xy, yx, yy = matrices.reshape(-1, 4).T
    with np.errstate(invalid="ignore", over="ignore"):
        slack = ROUNDING * (xx + yy)
        is_definite = (xx >= 0) & (yy >= 0) & (np.abs(xy) <= np.sqrt(xx) * np.sqrt(yy) + slack)
        return np.isfinite(matrices).all(axis=(1, 2)) & (np.abs(xy - yx) <= slack) & is_definite


def as_whole(name: str, values: Any) -> NDArray[np.int64]:
    """Return whole numbers as int64.

    Raises
    ------
    PredictionsError
        If a number is not whole.
    """
    given = np.asarray(values)
    if given.dtype.kind == "f" and not (given == np.floor(given)).all():
        raise PredictionsError(f"{name} holds numbers that are not whole")
    return np.ascontiguousarray(given, np.int64)


def check_columns(p: Any) -> None:
    """Check every rule of the columns of :class:`kpbench.Predictions`, for files of all formats and for arrays.

    Raises
    ------
    InvalidValue
        At the first value that is impossible.
    PredictionsError
        If columns do not belong together.
    """
    n, k = len(p.image_id), len(p.xy)
    if len(p.offsets) != n + 1 or p.offsets[0] != 0 or p.offsets[-1] != k or np.any(np.diff(p.offsets) < 0):
        raise PredictionsError(f"offsets do not run from 0 to {k} keypoints in {n} images")
    ids = np.zeros(k, np.int64) if p.patch_id is None else p.patch_id
    if len(p.score) != k or len(ids) != k:
        raise PredictionsError(f"{k} keypoints, {len(p.score)} scores and {len(ids)} ids do not belong together")
    shapes = {"A_patch2image": (k, 2, 2), "covariance": (k, 2, 2), "size": (n, 2)}
    shapes |= {"blur_px": (k,), "board": (k,), "points": (k,), "probability": (k,)}
    for name in (*shapes, "frame_index", "time_s", "ms"):
        shape, column = shapes.get(name, (n,)), getattr(p, name)
        if column is not None and column.shape != shape:
            raise PredictionsError(f"{name} has shape {column.shape}, expected {shape}")
    if (p.board is None) != (p.points is None):
        raise PredictionsError("one of board and points is missing, expected both or none")
    if p.probability is not None and p.points is None:
        raise PredictionsError("probability is given without board and points")
    if p.file is not None and len(p.file) != n:
        raise PredictionsError(f"{n} images have {len(p.file)} file names, expected one per image")
    _check_images(p)
    _check_detections(p, ids)


def _check_images(p: Any) -> None:
    if len(p) and p.image_id.min() < 0:
        i = int(np.argmax(p.image_id < 0))
        raise InvalidValue(i, None, int(p.image_id[i]), "image_id is negative, expected 0 or more")
    order = np.argsort(p.image_id, kind="stable")
    repeated = np.flatnonzero(np.diff(p.image_id[order]) == 0)
    if len(repeated):
        first, second = order[repeated[0]], order[repeated[0] + 1]
        raise InvalidValue(int(second), None, int(p.image_id[second]), f"the image occurs twice, first at {first}")
    rules: tuple[tuple[str, Valid, str], ...] = (
        ("size", lambda v: (v > 0).all(axis=1) | (v == 0).all(axis=1), "width and height in px, whole numbers over 0"),
        ("frame_index", lambda v: v >= -1, "a whole number of 0 or more"),
        ("time_s", lambda v: ~np.isinf(v), "a finite number of seconds"),
        ("ms", lambda v: np.isnan(v) | ((v >= 0) & (v < np.inf)), "milliseconds, a finite number of 0 or more"),
    )
    for name, is_valid, expected in rules:
        column = getattr(p, name)
        if column is not None and not (valid := is_valid(column)).all():
            i = int(np.argmin(valid))
            raise InvalidValue(i, None, int(p.image_id[i]), f"{name} is {column[i].tolist()}, expected {expected}")


def _check_detections(p: Any, ids: NDArray[np.int64]) -> None:
    k = len(p.xy)
    rules: tuple[tuple[str, Any, Valid, str], ...] = (
        ("keypoints", p.xy, np.isfinite, "two finite numbers"),
        ("scores", p.score, np.isfinite, "a finite number"),
        ("ids", ids, lambda v: v >= 0, "a patch id, 0 or more"),
        ("A_patch2image", p.A_patch2image, np.isfinite, "a matrix (2, 2) of finite numbers"),
        (
            "covariance",
            p.covariance,
            is_covariance,
            "a symmetric, positive semi-definite matrix (2, 2) of finite numbers",
        ),
        ("blur_px", p.blur_px, lambda v: (v >= 0) & (v < np.inf), "a finite number of 0 or more"),
        ("board", p.board, lambda v: (v >= -1) & (v < len(p.boards)), "the number of one of the boards, or -1"),
        ("points", p.points, lambda v: (v == -1) | ((v >= 0) & (p.board >= 0)), "the index of a board's point, or -1"),
        ("probability", p.probability, lambda v: (v >= 0) & (v <= 1), "a number from 0 to 1"),
    )
    for name, column, is_valid, expected in rules:
        if column is not None and not (valid := is_valid(column)).all():
            row = int(np.argmin(valid.reshape(k, -1).all(axis=1)))
            image = int(np.searchsorted(p.offsets, row, side="right")) - 1
            keypoint = row - int(p.offsets[image])
            problem = f"{name}[{keypoint}] is {column[row].tolist()}, expected {expected}"
            raise InvalidValue(image, keypoint, int(p.image_id[image]), problem)
