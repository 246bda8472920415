"""The fields of predictions files: keys of the header, keys of an image in JSON, and columns of tables."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from kpbench.errors import PredictionsError
from kpbench.files import encode_utf8, escape_surrogates
from kpbench.predictions.decode import json_type
from kpbench.types import Predictions

SCHEMA = "kpbench.predictions/2"
"""Name and version of the format of predictions files."""
READ_SCHEMAS = ("kpbench.predictions/1", SCHEMA)
"""The formats that are read. Version 1 lacks the optional fields from ``A_patch2image`` on."""
HEADER_KEYS = {"schema", "dataset", "fingerprint", "truth_digest", "detector", "boards"}
MATRIX_CELLS = {
    "A_patch2image": ("A_11", "A_12", "A_21", "A_22"),
    "covariance": ("covariance_xx", "covariance_xy", "covariance_yy"),
}
"""Columns of CSV and Parquet for each matrix of a detection, by row. A covariance is symmetric."""
DETECTION_CELLS = (
    *("x", "y", "score", "id", *MATRIX_CELLS["A_patch2image"], *MATRIX_CELLS["covariance"]),
    *("blur_px", "board", "points", "probability"),
)
IMAGE_CELLS = ("file", "width", "height", "frame_index", "time_s", "ms")
TABLE_COLUMNS = ("image_id", *DETECTION_CELLS, *IMAGE_CELLS)
"""Columns of CSV and Parquet; all but image_id, x and y are optional."""
H5_COLUMNS = {
    "image_id": ("iu", 1),
    "offsets": ("iu", 1),
    "xy": ("fiu", 2),
    "score": ("fiu", 1),
    "id": ("iu", 1),
    "A_patch2image": ("fiu", 3),
    "covariance": ("fiu", 3),
    "blur_px": ("fiu", 1),
    "board": ("iu", 1),
    "points": ("iu", 1),
    "probability": ("fiu", 1),
    "file": ("S", 1),
    "size": ("iu", 2),
    "frame_index": ("iu", 1),
    "time_s": ("fiu", 1),
    "ms": ("fiu", 1),
}
"""HDF5 datasets of a file: kinds of NumPy, and number of dimensions. All but the first three are optional."""
Int64 = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
Side = Annotated[int, msgspec.Meta(ge=1, le=2**31 - 1)]
Whole64 = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Matrix = tuple[tuple[float, float], tuple[float, float]]


class ImageRecord(msgspec.Struct, gc=False, forbid_unknown_fields=True):
    """The detections in one image."""

    image_id: Int64
    keypoints: list[tuple[float, float]]
    scores: list[float] | None = None
    ids: list[Int64] | None = None
    A_patch2image: list[Matrix] | None = None
    covariance: list[Matrix] | None = None
    blur_px: list[float] | None = None
    board: list[Int64] | None = None
    points: list[Int64] | None = None
    probability: list[float] | None = None
    file: str | None = None
    size: tuple[Side, Side] | None = None
    frame_index: Whole64 | None = None
    time_s: float | None = None
    ms: float | None = None


EXPECTED_IN_RECORD = {
    "A_patch2image": "a list",
    "A_patch2image[]": "a matrix (2, 2) of finite numbers",
    "blur_px": "a list",
    "blur_px[]": "a finite number of 0 or more",
    "board": "a list",
    "board[]": "the number of one of the boards, or -1",
    "covariance": "a list",
    "covariance[]": "a symmetric, positive semi-definite matrix (2, 2) of finite numbers",
    "file": "a text",
    "frame_index": "a whole number of 0 or more",
    "ids": "a list",
    "ids[]": "a patch id, 0 or more",
    "image_id": "a whole number of 64 bits",
    "keypoints": "a list",
    "keypoints[]": "two finite numbers",
    "ms": "milliseconds, a finite number of 0 or more",
    "points": "a list",
    "points[]": "the index of a board's point, or -1",
    "probability": "a list",
    "probability[]": "a number from 0 to 1",
    "scores": "a list",
    "scores[]": "a finite number",
    "size": "width and height in px, whole numbers over 0",
    "time_s": "a finite number of seconds",
}
"""The expected value of each field of :class:`ImageRecord`, in words."""


def parse_header(content: Any) -> dict[str, Any]:
    """Check a decoded header, and return its fields but for the schema.

    Raises
    ------
    PredictionsError
        At the first key that is unknown, missing or of a wrong type.
    """
    if not isinstance(content, dict) or content.get("schema") not in READ_SCHEMAS:
        found = repr(content["schema"]) if isinstance(content, dict) and "schema" in content else "missing"
        raise PredictionsError(f"schema is {found}, expected {SCHEMA!r}")
    for key in sorted(content.keys() - HEADER_KEYS):
        raise PredictionsError(f"unknown key {key!r}, expected {', '.join(sorted(HEADER_KEYS))} and predictions")
    detector, dataset = content.get("detector", {}), content.get("dataset")
    if not isinstance(detector, dict):
        raise PredictionsError(f"detector is {json_type(detector)}, expected an object")
    if not isinstance(dataset, str | None):
        raise PredictionsError(f"dataset is {json_type(dataset)}, expected a path or a fingerprint")
    digests = {name: content.get(name) for name in ("fingerprint", "truth_digest")}
    for name, digest in digests.items():
        if not isinstance(digest, str | None):
            raise PredictionsError(f"{name} is {json_type(digest)}, expected the {name.replace('_', ' ')} of a dataset")
    boards = content.get("boards", [])
    if not isinstance(boards, list) or not all(isinstance(name, str) for name in boards):
        raise PredictionsError(f"boards is {json_type(boards)}, expected a list of names")
    return {"detector": detector, "dataset": dataset, **digests, "boards": tuple(boards)}


def encode_names(predictions: Predictions) -> list[str] | None:
    """Return the file names of predictions as valid text, or None if there are none."""
    return None if predictions.file is None else [encode_utf8(name).decode() for name in predictions.file]


def make_header(predictions: Predictions) -> dict[str, Any]:
    """Return the header of predictions as a dict for JSON."""
    named = {name: getattr(predictions, name) for name in ("dataset", "fingerprint", "truth_digest")}
    header = {"schema": SCHEMA, **{k: v for k, v in named.items() if v is not None}, "detector": predictions.detector}
    if predictions.boards:
        header["boards"] = list(predictions.boards)
    return dict(escape_surrogates(header))
