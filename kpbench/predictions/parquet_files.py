"""Predictions as Parquet: one row per keypoint."""

from __future__ import annotations

import importlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import PredictionsError
from kpbench.predictions.decode import parse_json
from kpbench.predictions.fields import TABLE_COLUMNS, make_header, parse_header
from kpbench.predictions.tables import ID_LIMITS, build_predictions, make_table, require_column_names
from kpbench.types import Predictions

ROOM_BYTES, MOST_EXPANSION = 2**26, 1100
"""A Parquet file may declare so many bytes of numbers, and so many more per byte of the file."""
MOST_COLUMNS = 100
"""Largest number of columns of a Parquet file."""


def read_parquet(path: Path) -> Predictions:
    """Read a ``.parquet`` file: the columns of CSV, with the header in the metadata.

    Raises
    ------
    PredictionsError
        At the first fault, or if pyarrow is not installed.
    """
    pa, pq = _import_pyarrow()
    try:
        described = pq.read_metadata(path)
        # plain numbers need 8 bytes per cell; Parquet's own counts may say anything
        declared = max(8 * described.num_rows * described.num_columns, _unpacked_bytes(described))
        most = ROOM_BYTES + MOST_EXPANSION * path.stat().st_size
        if not 0 <= declared <= most or described.num_columns > MOST_COLUMNS:
            raise PredictionsError(
                f"declares {described.num_rows} rows, {described.num_columns} columns and {declared} bytes, "
                f"expected at most {MOST_COLUMNS} columns and {most} bytes in a file of this size"
            )
        # the file as a dictionary: it may repeat a long text any number of times
        table = pq.read_table(path, read_dictionary=["file"] if "file" in described.schema.names else None)
    except (pa.ArrowException, ValueError) as error:
        raise PredictionsError(f"damaged or no Parquet file ({' '.join(str(error).split())[:120]})") from None
    metadata = table.schema.metadata or {}
    header = parse_header(parse_json(metadata[b"kpbench"], "the metadata")) if b"kpbench" in metadata else {}
    names = require_column_names(table.column_names, "the table")
    columns = {}
    for position, name in enumerate(names):
        is_whole = name == "image_id"
        try:
            stored = table.column(position)
            if name == "file":
                columns[name] = _read_names(pa, stored)
                continue
            if not (pa.types.is_integer(stored.type) or pa.types.is_floating(stored.type)):
                raise ValueError(f"it has the type {stored.type}")
            column = stored.cast(pa.int64() if is_whole else pa.float64())
            if is_whole and column.null_count:
                raise ValueError("it has nulls")
            columns[name] = column.to_numpy()
        except (pa.ArrowException, ValueError) as error:
            kind = "texts" if name == "file" else "plain numbers"
            raise PredictionsError(f"column {name} holds no {kind} ({str(error)[:80]})") from None
    return build_predictions(columns, header, lambda row: f"row {row}")


def _read_names(pa: Any, stored: Any) -> NDArray[Any]:
    """Return the texts of a column of Parquet, nan for null."""
    is_text = pa.types.is_dictionary(stored.type) and (
        pa.types.is_string(stored.type.value_type) or pa.types.is_large_string(stored.type.value_type)
    )
    if not is_text:
        raise ValueError(f"it has the type {stored.type}")
    parts = [np.zeros(0, object)]
    for chunk in stored.chunks:
        texts = [math.nan if text is None else text for text in [*chunk.dictionary.to_pylist(), None]]
        parts.append(np.array(texts, object)[chunk.indices.fill_null(len(texts) - 1).to_numpy(zero_copy_only=False)])
    return np.concatenate(parts)


def _unpacked_bytes(described: Any) -> int:
    """Return how many bytes the columns of a Parquet file say that they have when they are unpacked."""
    # pyarrow ends the process over some damaged descriptions of columns, so only the sums are read
    return sum(described.row_group(n).total_byte_size for n in range(described.num_row_groups))


def _import_pyarrow() -> tuple[Any, Any]:
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise PredictionsError("Parquet needs pyarrow: pip install pyarrow") from None


def encode_parquet(predictions: Predictions) -> bytes:
    """Encode a ``.parquet`` file."""
    pa, pq = _import_pyarrow()
    types = {name: pa.int64() if name in ID_LIMITS else pa.float64() for name in TABLE_COLUMNS} | {"file": pa.string()}
    columns = {name: pa.array(v, types[name], from_pandas=True) for name, v in make_table(predictions).items()}
    table = pa.table(columns).replace_schema_metadata({"kpbench": json.dumps(make_header(predictions))})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return bytes(sink.getvalue())
