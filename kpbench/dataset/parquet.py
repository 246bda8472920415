"""A dataset as Parquet, in the form that Hugging Face ``datasets`` reads: one row per image, with the image in it."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from kpbench.dataset.card import patch_names
from kpbench.dataset.folder import Dataset
from kpbench.errors import DataError
from kpbench.files import make_folder
from kpbench.images import encode_png
from kpbench.predictions.coco import CocoDataset
from kpbench.types import KEYPOINT_DTYPE
from kpbench.writing import write_file

PARQUET_MARK = "kpbench.parquet-images/1"
"""Mark in the metadata of a file of images."""
IMAGES_PER_FILE = 500
"""Images per Parquet file. A file is built in memory."""
HUB_SPLITS = {"train": "train", "val": "validation"}
"""Names that the Hugging Face hub has for kpbench's splits."""


def parquet_files(splits: list[str]) -> Iterator[tuple[str, list[int]]]:
    """Yield the name of each Parquet file below its folder, and the numbers of its images.

    Parameters
    ----------
    splits : list of str
        The split of each image, see :func:`kpbench.dataset.split_scenes`.
    """
    for split, hub_name in HUB_SPLITS.items():
        images = iter([n for n, name in enumerate(splits) if name == split])
        parts = list(iter(lambda images=images: list(islice(images, IMAGES_PER_FILE)), []))  # type: ignore[misc]
        for number, part in enumerate(parts):
            yield f"data/{hub_name}-{number:05d}-of-{len(parts):05d}.parquet", part


def export_parquet(
    dataset: Dataset | CocoDataset, folder: Path, progress: Callable[[int], None], splits: list[str]
) -> None:
    """Write Parquet files of each split below ``data``.

    Raises
    ------
    DataError
        If pyarrow is not installed, or a file cannot be written.
    """
    pa, pq = _import_pyarrow()
    schema = _image_schema(pa, patch_names(dataset))
    make_folder(folder / "data")
    for name, numbers in parquet_files(splits):
        rows = []
        for n in numbers:
            rows.append(_make_row(dataset, n))
            progress(1)
        sink = pa.BufferOutputStream()
        # PNGs do not shrink; small groups of rows let readers load few images at a time
        table = pa.Table.from_pylist(rows, schema)
        pq.write_table(table, sink, row_group_size=100, compression={"image.bytes": "none"}, write_page_index=True)
        write_file(folder / name, bytes(sink.getvalue()))


def _import_pyarrow() -> tuple[Any, Any]:
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise DataError("Parquet needs pyarrow: pip install 'kpbench[parquet]'") from None


def _image_schema(pa: Any, names: dict[int, str]) -> Any:
    """Return the schema of a file. Its metadata tell ``datasets`` that the images are images."""
    numbers = {"int16": pa.int16(), "float32": pa.float32(), "float64": pa.float64()}
    fields, features = [], dict[str, Any]()
    for name in KEYPOINT_DTYPE.names or ():
        column = KEYPOINT_DTYPE[name]
        kind, value = numbers[column.base.name], {"dtype": column.base.name, "_type": "Value"}
        is_matrix = bool(column.shape)
        fields.append((name, pa.list_(pa.list_(kind)) if is_matrix else kind))
        features[name] = [[value]] if is_matrix else value
    whole: dict[str, tuple[Any, Any]] = {
        "image": (pa.struct([("bytes", pa.binary()), ("path", pa.string())]), {"_type": "Image"}),
        "image_id": (pa.int64(), {"dtype": "int64", "_type": "Value"}),
        "scene_id": (pa.int64(), {"dtype": "int64", "_type": "Value"}),
        "condition": (pa.string(), {"dtype": "string", "_type": "Value"}),
        "rung": (pa.float64(), {"dtype": "float64", "_type": "Value"}),
        "keypoints": (pa.list_(pa.struct(fields)), [features]),
        "degradations": (pa.string(), {"dtype": "string", "_type": "Value"}),
    }
    described = {"info": {"features": {name: feature for name, (_, feature) in whole.items()}}}
    header = {"schema": PARQUET_MARK, "patches": {str(patch_id): name for patch_id, name in names.items()}}
    metadata = {"kpbench": json.dumps(header), "huggingface": json.dumps(described)}
    return pa.schema([(name, kind) for name, (kind, _) in whole.items()], metadata)


def _make_row(dataset: Dataset | CocoDataset, n: int) -> dict[str, Any]:
    """Return a row: null for nan, and the degradations as JSON."""
    (image, keypoints), truth = dataset[n], dataset.truth
    name = f"{truth.image_id[n]:08d}.png"
    columns = {name: keypoints[name].tolist() for name in keypoints.dtype.names or ()}
    return {
        "image": {"bytes": encode_png(image, "exported-image"), "path": name},
        "image_id": int(truth.image_id[n]),
        "scene_id": int(truth.scene_id[n]),
        "condition": str(truth.condition[n]),
        "rung": _known(float(truth.rung[n])),
        "keypoints": [{name: _known(values[k]) for name, values in columns.items()} for k in range(len(keypoints))],
        "degradations": json.dumps(dataset.effects(n)),
    }


def _known(value: Any) -> Any:
    """Return None for nan."""
    return None if value != value else value
