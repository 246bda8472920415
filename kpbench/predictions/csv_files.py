"""Predictions as CSV: one row per keypoint."""

from __future__ import annotations

import csv
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

from kpbench.errors import KpbenchWarning, PredictionsError
from kpbench.files import read_bytes
from kpbench.predictions.decode import Place, abbreviate, parse_json
from kpbench.predictions.fields import make_header, parse_header
from kpbench.predictions.tables import ID_LIMITS, build_predictions, make_table, require_column_names
from kpbench.text import escape_csv, escape_csv_comment
from kpbench.types import Predictions


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
    names = require_column_names(_split_names(first), f"line {1 + skipped}")

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
            dtype={name: object if name in (*ID_LIMITS, "file") else np.float64 for name in names},
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
                if name == "file":
                    continue
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

    frame = pd.DataFrame(make_table(predictions))
    for name in frame.columns.intersection([*ID_LIMITS]):
        frame[name] = frame[name].astype("Int64")
    if "file" in frame:
        frame["file"] = frame["file"].map(escape_csv)
    text = io.StringIO()
    text.write(escape_csv_comment(f"# {json.dumps(make_header(predictions), ensure_ascii=False)}\n"))
    frame.to_csv(text, index=False, lineterminator="\n")
    return text.getvalue().encode()
