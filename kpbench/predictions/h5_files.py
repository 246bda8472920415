"""Predictions as HDF5: a dataset per column."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from kpbench.errors import PredictionsError, system_reason
from kpbench.files import encode_utf8
from kpbench.predictions.decode import parse_json
from kpbench.predictions.fields import H5_COLUMNS, make_header, parse_header
from kpbench.types import Predictions

H5_FILTERS = ("shuffle", "gzip", "fletcher32")
"""HDF5 filters that columns may use."""
REQUIRED = ("image_id", "offsets", "xy")
SHAPES = {"xy": ("K", 2), "A_patch2image": ("K", 2, 2), "covariance": ("K", 2, 2), "size": ("N", 2)}
"""Shapes of the columns of several dimensions."""


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
        name: Column(kinds, H5_FILTERS, (ndim,), name not in REQUIRED) for name, (kinds, ndim) in H5_COLUMNS.items()
    }
    try:
        file, texts = open_hdf5(path, Layout(columns, ("header",), has_variable_texts=True))
        with file:
            table: dict[str, Any] = {name: file[name][:] for name in columns if name in file}
    except StructureError as error:
        raise PredictionsError(str(error)) from None
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        if reason := system_reason(error):
            raise PredictionsError(f"cannot be read, {reason}") from None
        raise PredictionsError(f"damaged or no HDF5 file ({' '.join(str(error).split())[:120]})") from None
    header = parse_header(parse_json(texts["header"].encode(), "the attribute header")) if texts else {}
    for name, shape in SHAPES.items():
        if name in table and table[name].shape[1:] != shape[1:]:
            expected = str(shape).replace("'", "")
            raise PredictionsError(f"/{name} has shape {table[name].shape}, expected {expected}")
    score, ids = table.pop("score", np.ones(len(table["xy"]))), table.pop("id", None)
    if "file" in table:
        try:
            table["file"] = tuple(name.decode() for name in table["file"].tolist())
        except UnicodeDecodeError:
            raise PredictionsError("/file holds a name that is not UTF-8 text") from None
    return Predictions(**table, score=score, patch_id=ids, **header)


def encode_h5(predictions: Predictions) -> bytes:
    """Encode an ``.h5`` file."""
    import h5py

    p = predictions
    with h5py.File.in_memory() as file:
        file.attrs["header"] = json.dumps(make_header(p))
        for name in H5_COLUMNS:
            values = p.patch_id if name == "id" else getattr(p, name)
            if name == "file" and values is not None:
                texts = np.array([encode_utf8(text) for text in values])
                file.create_dataset(name, data=texts, compression="gzip", compression_opts=1)
            elif values is not None:
                file.create_dataset(name, data=values)
        file.flush()
        return bytes(file.id.get_file_image())
