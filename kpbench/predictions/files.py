"""Predictions files: what a detector found in every image of a dataset, in and out.

In memory the predictions are columns (:class:`kpbench.types.Predictions`), so that a million images are a handful
of arrays. On disk they are ``.json`` (schema ``kpbench.predictions/1``), ``.jsonl``, ``.csv``, ``.parquet`` or
``.h5``, all with the same content; ``docs/reference/predictions-format.md`` describes each.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from kpbench.errors import DataError, PredictionsError
from kpbench.files import write_atomic
from kpbench.predictions import json_files as records
from kpbench.predictions import table_files as columns
from kpbench.predictions.decode import without_gc
from kpbench.types import Predictions

READERS: dict[str, Callable[[Path], Predictions]] = {
    ".json": records.read_json,
    ".jsonl": records.read_jsonl,
    ".csv": columns.read_csv,
    ".parquet": columns.read_parquet,
    ".h5": columns.read_h5,
}
WRITERS: dict[str, Callable[[Predictions], bytes]] = {
    ".json": records.write_json,
    ".jsonl": records.write_jsonl,
    ".csv": columns.write_csv,
    ".parquet": columns.write_parquet,
    ".h5": columns.write_h5,
}


def read_predictions(path: str | Path) -> Predictions:
    """Read a predictions file; its suffix tells the format.

    Raises
    ------
    PredictionsError
        One line with the file, the place in it and what was expected.
    """
    path = Path(path)
    try:
        if path.suffix.lower() not in READERS:
            *some, last = READERS
            raise PredictionsError(f"unknown kind of predictions file, expected {', '.join(some)} or {last}")
        with path.open("rb") as file:  # here, so that all formats say the same of a file that is not there
            if not file.read(1):
                raise PredictionsError("the file is empty")
        with without_gc():
            return READERS[path.suffix.lower()](path)
    except PredictionsError as error:
        raise PredictionsError(f"{path}: {error}") from None
    except OSError as error:
        raise PredictionsError(f"{path}: cannot be read, {error.strerror or error}") from None


def check_target(path: str | Path) -> Path:
    """A path that predictions can be written to, by its suffix and folder; what else may fail shows when it is done.

    Raises
    ------
    PredictionsError
        If the suffix is unknown.
    DataError
        If the folder is not there.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITERS:
        *some, last = WRITERS
        raise PredictionsError(f"{path}: unknown kind of predictions file, expected {', '.join(some)} or {last}")
    if not path.parent.is_dir():
        raise DataError(f"{path}: cannot be written, there is no folder {path.parent}")
    return path


def write_predictions(path: str | Path, predictions: Predictions) -> None:
    """Write a predictions file, whole or not at all; its suffix tells the format.

    Raises
    ------
    PredictionsError
        If the suffix is unknown or pyarrow is needed and missing.
    DataError
        If the disk is full or the folder cannot be written.
    """
    path = check_target(path)
    try:
        data = WRITERS[path.suffix.lower()](predictions)
    except PredictionsError as error:
        raise PredictionsError(f"{path}: {error}") from None
    write_atomic(path, data)
