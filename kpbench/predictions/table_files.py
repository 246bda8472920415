"""Predictions as tables: CSV and Parquet with one row per keypoint, HDF5 with one HDF5 dataset per column."""

from __future__ import annotations

import csv
import importlib
import io
import json
import math
import re
import warnings
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import KpbenchWarning, PredictionsError, system_reason
from kpbench.files import read_bytes
from kpbench.predictions.decode import Place, abbreviate, parse_json
from kpbench.predictions.fields import H5_COLUMNS, TABLE_COLUMNS, make_header, parse_header
from kpbench.text import escape_csv_comment
from kpbench.types import Predictions, offsets_of

ID_LIMITS = {"image_id": 2**63, "id": 2**53}
"""Columns of whole numbers, and the least number that each cannot hold."""
ROOM_BYTES, MOST_EXPANSION = 2**26, 1100
"""A Parquet file may declare so many bytes of numbers, and so many more per byte of the file."""
MOST_COLUMNS = 100
"""Largest number of columns of a Parquet file."""
H5_FILTERS = ("shuffle", "gzip", "fletcher32")
"""HDF5 filters that columns may use."""


def build_predictions(table: dict[str, NDArray[Any]], header: dict[str, Any], place: Place) -> Predictions:
    """Make predictions from a table with one row per keypoint, in any order.

    Parameters
    ----------
    table : dict of str to ndarray of shape (R,)
        The columns of :data:`TABLE_COLUMNS`. nan marks a blank cell. A row with only an image_id is an image
        without keypoints.
    header : dict
        Detector, dataset and fingerprint, as fields of :class:`kpbench.Predictions`.
    place : function
        Names the n-th row.

    Raises
    ------
    PredictionsError
        At the first row with a fault.
    """
    blank = np.logical_and.reduce([np.isnan(table[name]) for name in TABLE_COLUMNS[1:] if name in table])
    rows = np.flatnonzero(~blank)
    for name in TABLE_COLUMNS[1:]:
        column = table[name][rows] if name in table else np.zeros(0)
        valid = np.isfinite(column)
        if name == "id":
            valid &= (column >= 0) & (column == np.floor(column)) & (column < 2**53)
        if not valid.all():
            row = int(rows[np.argmin(valid)])
            expected = "a patch id, a whole number of 0 or more" if name == "id" else "a finite number"
            value = table[name][row]
            raise PredictionsError(
                f"{place(row)} (image_id {table['image_id'][row]}): {name} is "
                f"{'blank' if math.isnan(value) else value}, expected {expected}"
            )
    if len(table["image_id"]) and table["image_id"].min() < 0:
        row = int(np.argmax(table["image_id"] < 0))
        raise PredictionsError(f"{place(row)}: image_id is {table['image_id'][row]}, expected 0 or more")
    image_id, image = np.unique(table["image_id"], return_inverse=True)
    rows = rows[np.argsort(image[rows], kind="stable")]
    return Predictions(
        image_id=image_id,
        offsets=offsets_of(np.bincount(image[rows], minlength=len(image_id))),
        xy=np.stack([table["x"][rows], table["y"][rows]], axis=1),
        score=table["score"][rows] if "score" in table else np.ones(len(rows)),
        patch_id=table["id"][rows].astype(np.int64) if "id" in table else None,
        **header,
    )


def _make_table(predictions: Predictions) -> dict[str, NDArray[Any]]:
    """Return columns with one row per keypoint, and one blank row per image without keypoints."""
    p = predictions
    counts = np.diff(p.offsets)
    image = np.repeat(np.arange(len(p)), np.maximum(counts, 1))
    blank = counts[image] == 0
    columns: dict[str, NDArray[Any]] = {"image_id": p.image_id[image]}
    for name, values in (("x", p.xy[:, 0]), ("y", p.xy[:, 1]), ("score", p.score), ("id", p.patch_id)):
        if values is not None:
            columns[name] = np.full(len(image), np.nan)
            columns[name][~blank] = values
    return columns


def _check_columns(names: list[str], place: str) -> list[str]:
    """Check the names of a table's columns, and return the names without blanks at the ends."""
    if not {"image_id", "x", "y"} <= set(names) <= set(TABLE_COLUMNS) or len(set(names)) < len(names):
        raise PredictionsError(
            f"{place} has columns {','.join(names)[:80]}, expected {','.join(TABLE_COLUMNS)} (score, id optional)"
        )
    return names


# --- CSV -----------------------------------------------------------------------------------------------------------


def read_csv(path: Path) -> Predictions:
    """Read a ``.csv`` file: one row per keypoint. The first line may be a ``#`` followed by the header.

    Raises
    ------
    PredictionsError
        At the first fault.
    """
    data = read_bytes(path)
    is_ended = data.endswith((b"\n", b"\r"))
    data = data.removeprefix(b"\xef\xbb\xbf").rstrip() + b"\n"  # some editors leave blank lines at the end
    header, skipped = {}, 0
    if data.startswith(b"#"):
        first, data = _cut_line(data)
        header, skipped = parse_header(parse_json(first[1:].encode(), "line 1, after #,")), 1
    first, data = _cut_line(data)
    names = _check_columns(_split_names(first), f"line {1 + skipped}")

    def place(row: int) -> str:
        return f"line {row + 2 + skipped}"

    try:
        table = _parse_csv(data, names)
    except (ValueError, Warning, csv.Error) as error:  # the errors of pandas' parser are ValueErrors
        raise _find_bad_row(data, names, place, error) from None
    predictions = build_predictions(table, header, place)
    if not is_ended:
        warnings.warn(f"{path}: the last line has no line end; it may be cut off", KpbenchWarning, stacklevel=2)
    return predictions


def _split_names(line: str) -> list[str]:
    try:
        return [name.strip() for name in next(csv.reader([line], strict=True), [])]
    except csv.Error as error:
        raise PredictionsError(f"its line of names is no CSV ({error})") from None


def _cut_line(data: bytes) -> tuple[str, bytes]:
    """Return the first line without its end, and the lines after it."""
    line, _, rest = data.partition(b"\n")
    if b"\r" in line.rstrip(b"\r"):  # lines end in carriage returns alone
        line, _, rest = data.partition(b"\r")
    try:
        return line.rstrip(b"\r").decode(), rest
    except UnicodeDecodeError:
        raise PredictionsError("its first lines are no UTF-8 text") from None


def _parse_csv(data: bytes, names: list[str]) -> dict[str, NDArray[Any]]:
    """Return the columns of the rows of a CSV file.

    Numbers are read to the last bit. IDs are read as texts, of which each different one is converted once and exactly:
    through float, large IDs would change, and ``1e-400`` would become 0.

    Raises
    ------
    ValueError
        If a row has too few or too many cells, or a cell holds no number.
    """
    import pandas as pd

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pandas 3.1 deprecates float_precision; pandas 2 is inexact without it
        warnings.simplefilter("error", pd.errors.ParserWarning)  # pandas only warns of a row that is too long
        table = pd.read_csv(
            io.BytesIO(data),
            header=None,
            names=names,
            index_col=False,
            dtype={name: object if name in ID_LIMITS else np.float64 for name in names},
            float_precision="round_trip",
            skipinitialspace=True,
            keep_default_na=False,
            na_values=[""],
            skip_blank_lines=False,
            encoding_errors="replace",
        )
    # pandas fills up short rows in silence, and reads quotation marks that do not pair
    is_quoted = b'"' in data
    if is_quoted and any(len(row) != len(names) for row in csv.reader(io.StringIO(data.decode()), strict=True)):
        raise ValueError("a row is too short")
    if not is_quoted and data.count(b",") != (len(names) - 1) * len(table):
        raise ValueError("a row is too short")
    columns: dict[str, NDArray[Any]] = {}
    for name in names:
        if name not in ID_LIMITS:
            columns[name] = table[name].to_numpy()
            continue
        codes, texts = pd.factorize(table[name])
        blank = [] if name == "image_id" else [math.nan]
        values = np.array([*(_parse_id(text, ID_LIMITS[name]) for text in texts), *blank], "i8" if not blank else "f8")
        if name == "image_id" and codes.min(initial=0) < 0:
            raise ValueError("an image_id is blank")
        columns[name] = values[codes]  # the code of a blank cell is -1
    return columns


def _parse_id(text: str, limit: int) -> int:
    """Return a whole number under ``limit``, such as ``12`` or ``12.0``; raise ValueError for any other text."""
    if not re.fullmatch(r"\s*[+-]?[0-9.]{1,400}(e[+-]?[0-9]{1,3})?\s*", text, re.IGNORECASE | re.ASCII):
        raise ValueError
    try:
        exact = Decimal(text.strip())
    except InvalidOperation:
        raise ValueError from None
    if exact != exact.to_integral_value() or abs(exact) >= limit:
        raise ValueError
    return int(exact)


def _find_bad_row(data: bytes, names: list[str], place: Place, error: BaseException) -> PredictionsError:
    """Return an error that names the first row that cannot be read."""
    for row, cells in enumerate(csv.reader(io.StringIO(data.decode(errors="replace"), newline=""))):
        if len(cells) != len(names):
            return PredictionsError(f"{place(row)} has {len(cells)} values, expected {len(names)}")
        for name, cell in zip(names, cells, strict=True):
            try:
                if name in ID_LIMITS and (cell.strip() or name == "image_id"):
                    _parse_id(cell, ID_LIMITS[name])
                elif not math.isfinite(float(cell.strip() or 0)):
                    raise ValueError
            except ValueError:
                is_id = name in ID_LIMITS
                expected = f"a whole number under {ID_LIMITS[name]}" if is_id else "a finite number"
                return PredictionsError(f"{place(row)}: {name} is {abbreviate(cell)}, expected {expected}")
    return PredictionsError(f"no table ({' '.join(str(error).split())[:120]})")


def encode_csv(predictions: Predictions) -> bytes:
    """Encode a ``.csv`` file."""
    import pandas as pd

    frame = pd.DataFrame(_make_table(predictions))
    if "id" in frame:
        frame["id"] = frame["id"].astype("Int64")
    text = io.StringIO()
    text.write(escape_csv_comment(f"# {json.dumps(make_header(predictions), ensure_ascii=False)}\n"))
    frame.to_csv(text, index=False, lineterminator="\n")
    return text.getvalue().encode()


# --- Parquet -------------------------------------------------------------------------------------------------------


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
        table = pq.read_table(path)
    except (pa.ArrowException, ValueError) as error:
        raise PredictionsError(f"damaged or no Parquet file ({' '.join(str(error).split())[:120]})") from None
    metadata = table.schema.metadata or {}
    header = parse_header(parse_json(metadata[b"kpbench"], "the metadata")) if b"kpbench" in metadata else {}
    names = _check_columns(table.column_names, "the table")
    columns = {}
    for position, name in enumerate(names):
        is_whole = name == "image_id"
        try:
            stored = table.column(position)
            if not (pa.types.is_integer(stored.type) or pa.types.is_floating(stored.type)):
                raise ValueError(f"it has the type {stored.type}")
            column = stored.cast(pa.int64() if is_whole else pa.float64())
            if is_whole and column.null_count:
                raise ValueError("it has nulls")
            columns[name] = column.to_numpy()
        except (pa.ArrowException, ValueError) as error:
            raise PredictionsError(f"column {name} holds no plain numbers ({str(error)[:80]})") from None
    return build_predictions(columns, header, lambda row: f"row {row}")


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
    types = {name: pa.int64() if name in ("image_id", "id") else pa.float64() for name in TABLE_COLUMNS}
    columns = {name: pa.array(v, types[name], from_pandas=True) for name, v in _make_table(predictions).items()}
    table = pa.table(columns).replace_schema_metadata({"kpbench": json.dumps(make_header(predictions))})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return bytes(sink.getvalue())


# --- HDF5 ----------------------------------------------------------------------------------------------------------


def read_h5(path: Path) -> Predictions:
    """Read an ``.h5`` file: an HDF5 dataset per column, with the header in an attribute.

    Raises
    ------
    PredictionsError
        At the first fault, or if data is stored outside the file.
    """
    from kpbench.hdf5 import open_hdf5
    from kpbench.hdf5_structure import Column, Layout, StructureError

    columns = {
        name: Column("iu" if kind == "i" else "fiu", H5_FILTERS, (1 + (name == "xy"),), name in ("score", "id"))
        for name, kind in H5_COLUMNS.items()
    }
    try:
        file, texts = open_hdf5(path, Layout(columns, ("header",), has_variable_texts=True))
        with file:
            table = {name: file[name][:] for name in columns if name in file}
    except StructureError as error:
        raise PredictionsError(str(error)) from None
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        if reason := system_reason(error):
            raise PredictionsError(f"cannot be read, {reason}") from None
        raise PredictionsError(f"damaged or no HDF5 file ({' '.join(str(error).split())[:120]})") from None
    header = parse_header(parse_json(texts["header"].encode(), "the attribute header")) if texts else {}
    if table["xy"].shape[1:] != (2,):
        raise PredictionsError(f"/xy has shape {table['xy'].shape}, expected (K, 2)")
    return Predictions(
        image_id=table["image_id"],
        offsets=table["offsets"],
        xy=table["xy"],
        score=table.get("score", np.ones(len(table["xy"]))),
        patch_id=table.get("id"),
        **header,
    )


def encode_h5(predictions: Predictions) -> bytes:
    """Encode an ``.h5`` file."""
    import h5py

    p = predictions
    with h5py.File.in_memory() as file:
        file.attrs["header"] = json.dumps(make_header(p))
        columns = {"image_id": p.image_id, "offsets": p.offsets, "xy": p.xy, "score": p.score, "id": p.patch_id}
        for name, values in columns.items():
            if values is not None:
                file.create_dataset(name, data=values)
        file.flush()
        return bytes(file.id.get_file_image())
