"""The fields of predictions files: keys of the header, keys of an image in JSON, and columns of tables."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from kpbench.errors import PredictionsError
from kpbench.files import escape_surrogates
from kpbench.predictions.decode import json_type
from kpbench.types import Predictions

SCHEMA = "kpbench.predictions/1"
"""Name and version of the format of predictions files."""
HEADER_KEYS = {"schema", "dataset", "fingerprint", "truth_digest", "detector"}
TABLE_COLUMNS = ("image_id", "x", "y", "score", "id")
"""Columns of CSV and Parquet; score and id are optional."""
H5_COLUMNS = {"image_id": "i", "offsets": "i", "xy": "f", "score": "f", "id": "i"}
"""HDF5 datasets of a file: "i" holds whole numbers, "f" holds any numbers; score and id are optional."""
Int64 = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]


class ImageRecord(msgspec.Struct, gc=False, forbid_unknown_fields=True):
    """The detections in one image."""

    image_id: Int64
    keypoints: list[tuple[float, float]]
    scores: list[float] | None = None
    ids: list[Int64] | None = None


EXPECTED_IN_RECORD = {
    "ids": "a list",
    "ids[]": "a patch id, 0 or more",
    "image_id": "a whole number of 64 bits",
    "keypoints": "a list",
    "keypoints[]": "two finite numbers",
    "scores": "a list",
    "scores[]": "a finite number",
}
"""The expected value of each field of :class:`ImageRecord`, in words."""


def parse_header(content: Any) -> dict[str, Any]:
    """Check a decoded header, and return its ``detector``, ``dataset``, ``fingerprint`` and ``truth_digest``.

    Raises
    ------
    PredictionsError
        At the first key that is unknown, missing or of a wrong type.
    """
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
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
    return {"detector": detector, "dataset": dataset, **digests}


def make_header(predictions: Predictions) -> dict[str, Any]:
    """Return the header of predictions as a dict for JSON."""
    named = {name: getattr(predictions, name) for name in ("dataset", "fingerprint", "truth_digest")}
    header = {"schema": SCHEMA, **{k: v for k, v in named.items() if v is not None}, "detector": predictions.detector}
    return dict(escape_surrogates(header))
