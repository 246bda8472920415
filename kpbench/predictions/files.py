"""Read and write predictions files: the detections of a detector in every image of a dataset.

In memory the predictions are columns (:class:`kpbench.Predictions`), so that a million images need only a few arrays. A
file is ``.json`` (schema ``kpbench.predictions/2``), ``.jsonl``, ``.csv``, ``.parquet`` or ``.h5``. All formats hold
the same content. ``docs/reference/predictions-format.md`` describes each format.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from kpbench.errors import PredictionsError, system_reason
from kpbench.files import open_file
from kpbench.predictions import csv_files, h5_files, json_files, parquet_files
from kpbench.predictions.decode import pause_gc
from kpbench.types import Predictions
from kpbench.writing import require_writable, write_file

READERS: dict[str, Callable[[Path], Predictions]] = {
    ".json": json_files.read_json,
    ".jsonl": json_files.read_jsonl,
    ".csv": csv_files.read_csv,
    ".parquet": parquet_files.read_parquet,
    ".h5": h5_files.read_h5,
}
"""For each file suffix, the function that reads the format."""
ENCODERS: dict[str, Callable[[Predictions], bytes]] = {
    ".json": json_files.encode_json,
    ".jsonl": json_files.encode_jsonl,
    ".csv": csv_files.encode_csv,
    ".parquet": parquet_files.encode_parquet,
    ".h5": h5_files.encode_h5,
}
"""For each file suffix, the function that encodes the format."""


def read_predictions(path: str | Path) -> Predictions:
    """Read a predictions file. Its suffix selects the format.

    Parameters
    ----------
    path : str or Path
        File ending in .json, .jsonl, .csv, .parquet or .h5.

    Returns
    -------
    Predictions

    Raises
    ------
    PredictionsError
        If the file cannot be read. The message names the file, the place of the fault and the expected value.

    Examples
    --------
    >>> import kpbench
    >>> predictions = kpbench.read_predictions("preds.json")
    >>> len(predictions), predictions.detector
    (6, {'name': 'oracle'})
    """
    path = Path(path)
    try:
        suffix = _require_known_suffix(path)
        with open_file(path) as file:  # opened here, so that all formats have one message for a missing file
            if not file.read(1):
                raise PredictionsError("the file is empty")
        with pause_gc():
            return READERS[suffix](path)
    except PredictionsError as error:
        raise PredictionsError(f"{path}: {error}") from None
    except OSError as error:
        raise PredictionsError(f"{path}: cannot be read, {system_reason(error) or error}") from None


def require_predictions_path(path: str | Path) -> Path:
    """Refuse a path to which predictions cannot be written, before any work is done.

    Raises
    ------
    PredictionsError
        If the path does not end in .json, .jsonl, .csv, .parquet or .h5.
    DataError
        If the folder does not exist or cannot be written, or if the path is a file other than predictions by kpbench.
    """
    path = Path(path)
    try:
        _require_known_suffix(path)
    except PredictionsError as error:
        raise PredictionsError(f"{path}: {error}") from None
    require_writable(path, "predictions")
    return path


def _require_known_suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in READERS:
        *some, last = READERS
        raise PredictionsError(f"unknown kind of predictions file, expected {', '.join(some)} or {last}")
    return suffix


def write_predictions(path: str | Path, predictions: Predictions) -> None:
    """Write a predictions file, whole or not at all. Its suffix selects the format.

    Parameters
    ----------
    path : str or Path
        File ending in .json, .jsonl, .csv, .parquet or .h5.
    predictions : Predictions

    Raises
    ------
    PredictionsError
        If the path has another suffix, or if the format needs pyarrow and pyarrow is not installed.
    DataError
        If the disk is full, the folder does not exist or cannot be written, or the path is a file other than
        predictions by kpbench.

    Examples
    --------
    >>> import kpbench
    >>> found = [kpbench.Detections([[100.25, 80.5]], [0.98], [0]), kpbench.Detections.none()]
    >>> kpbench.write_predictions("mine.csv", kpbench.Predictions.from_detections(found, image_id=[0, 1]))
    >>> kpbench.read_predictions("mine.csv").xy.tolist()
    [[100.25, 80.5]]
    """
    path = require_predictions_path(path)
    try:
        data = ENCODERS[path.suffix.lower()](predictions)
    except PredictionsError as error:
        raise PredictionsError(f"{path}: {error}") from None
    write_file(path, data)
