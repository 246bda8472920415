"""The header of predictions files, which all formats share."""

from __future__ import annotations

from typing import Any

from kpbench.errors import PredictionsError
from kpbench.predictions.decode import kind
from kpbench.types import Predictions

SCHEMA = "kpbench.predictions/1"
HEADER_KEYS = {"schema", "dataset", "fingerprint", "detector"}


def read_header(content: Any) -> dict[str, Any]:
    """Check what all formats share; gives the keyword arguments ``detector``, ``dataset``, ``fingerprint``."""
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        found = repr(content["schema"]) if isinstance(content, dict) and "schema" in content else "missing"
        raise PredictionsError(f"schema is {found}, expected {SCHEMA!r}")
    for key in sorted(content.keys() - HEADER_KEYS):
        raise PredictionsError(f"unknown key {key!r}, expected {', '.join(sorted(HEADER_KEYS))} and predictions")
    detector, dataset = content.get("detector", {}), content.get("dataset")
    if not isinstance(detector, dict):
        raise PredictionsError(f"detector is {kind(detector)}, expected an object")
    if not isinstance(dataset, str | None):
        raise PredictionsError(f"dataset is {kind(dataset)}, expected a path or a fingerprint")
    fingerprint = content.get("fingerprint")
    if not isinstance(fingerprint, str | None):
        raise PredictionsError(f"fingerprint is {kind(fingerprint)}, expected that of a dataset")
    return {"detector": detector, "dataset": dataset, "fingerprint": fingerprint}


def header_of(p: Predictions) -> dict[str, Any]:
    """What a file says before the predictions."""
    named = {"dataset": p.dataset, "fingerprint": p.fingerprint}
    return {"schema": SCHEMA, **{k: v for k, v in named.items() if v is not None}, "detector": p.detector}
