"""Predictions as JSON and JSON lines: one object per image."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from itertools import chain, pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from kpbench.errors import PredictionsError
from kpbench.files import DoubleKeyError, open_file, read_bytes
from kpbench.predictions.coco import decode_coco_results
from kpbench.predictions.decode import (
    PIECE_BYTES,
    Place,
    RecordBatch,
    convert_records,
    decode_records,
    json_type,
    parse_json,
    require_single_keys,
    split_lists,
)
from kpbench.predictions.fields import (
    EXPECTED_IN_RECORD,
    SCHEMA,
    ImageRecord,
    encode_names,
    make_header,
    parse_header,
)
from kpbench.types import UNKNOWN, Predictions, offsets_of
from kpbench.validity import InvalidValue


def read_json(path: Path) -> Predictions:
    """Read a ``.json`` file: kpbench's own schema, or a list of COCO keypoint results.

    Raises
    ------
    PredictionsError
        At the first fault.
    """
    data = read_bytes(path)
    if data.lstrip()[:1] == b"[":
        return decode_coco_results(data)

    def place(n: int) -> str:
        return f"predictions[{n}]"

    try:
        frame, [pieces] = split_lists(data, "predictions")
        batches = decode_records(pieces, ImageRecord, EXPECTED_IN_RECORD, place)
        return _combine(batches, parse_header(frame), place)
    except (ValueError, RecursionError):
        pass  # the list cannot be split: decode the file at once, and find any fault
    content = parse_json(data, "the file")
    if not isinstance(content, dict):
        raise PredictionsError(f"holds {json_type(content)}, expected an object with schema {SCHEMA!r}")
    entries = content.pop("predictions", None)
    header = parse_header(content)
    if not isinstance(entries, list):
        raise PredictionsError(f"predictions is {json_type(entries)}, expected a list")
    return _combine([convert_records(entries, ImageRecord, EXPECTED_IN_RECORD, place)], header, place)


def read_jsonl(path: Path) -> Predictions:
    """Read a ``.jsonl`` file: a line with the header, then a line per image.

    Raises
    ------
    PredictionsError
        At the first fault.
    """
    decoder = msgspec.json.Decoder(ImageRecord)

    def decode_line(line: bytes, n: int) -> ImageRecord:
        try:
            return decoder.decode(line)
        except (ValueError, RecursionError):
            entry = parse_json(line, f"line {n}")
            return convert_records([entry], ImageRecord, EXPECTED_IN_RECORD, lambda _: f"line {n}").records[0]

    def read_batches(file: BinaryIO) -> Iterator[RecordBatch[ImageRecord]]:
        first = 2
        while lines := file.readlines(PIECE_BYTES):
            records = [decode_line(line, n) for n, line in enumerate(lines, first)]
            yield RecordBatch(records, require_single_keys(b"[%s]" % b",".join(lines), records, ImageRecord))
            first += len(lines)

    with open_file(path) as file:
        header = parse_header(parse_json(file.readline(), "line 1"))
        try:
            return _combine(read_batches(file), header, lambda n: f"line {n + 2}")
        except DoubleKeyError as error:
            raise PredictionsError(str(error)) from None


LISTS = {"scores": 1, "ids": 1, "A_patch2image": 3, "covariance": 3, "blur_px": 1, "board": 1, "points": 1}
LISTS |= {"probability": 1}
"""Optional lists of a record with an entry per keypoint, and their depth."""
WHOLE_LISTS = ("ids", "board", "points")
IMAGE_DTYPES: dict[str, Any] = {"file": object, "size": "i8", "frame_index": "i8", "time_s": "f8", "ms": "f8"}


def _make_columns(batch: RecordBatch[ImageRecord]) -> dict[str, NDArray[Any]]:
    """Return the fields of N records as columns. Fields that no record has are left out.

    The lists of all records are joined. ``NAME count`` (N,) holds the length of each record's list NAME, -1 for a
    record without the list. A column of the images holds :data:`kpbench.types.UNKNOWN` for no value, and inf for a
    given NaN.
    """
    records, columns = batch.records, dict[str, NDArray[Any]]()
    columns["image_id"] = np.fromiter([r.image_id for r in records], np.int64, len(records))
    for name, depth in {"keypoints": 2, **LISTS}.items():
        if name in batch.keys:
            lists = [getattr(r, name) for r in records]
            lengths = [-1 if values is None else len(values) for values in lists]
            columns[f"{name} count"] = np.fromiter(lengths, np.int64, len(records))
            entries: Iterator[Any] = (values for values in lists if values)
            for _ in range(depth):
                entries = chain.from_iterable(entries)
            joined = np.fromiter(entries, np.int64 if name in WHOLE_LISTS else np.float64)
            columns[name] = joined.reshape(-1, *[2] * (depth - 1))
    for name, unknown in UNKNOWN.items():
        if name in batch.keys:
            absent = (0, 0) if name == "size" else unknown
            given = [absent if v is None else v if v == v else np.inf for v in map(attrgetter(name), records)]
            columns[name] = np.array(given, IMAGE_DTYPES[name]).reshape(-1, *[2] * (name == "size"))
    return columns


def _join_columns(parts: list[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Join the columns of several batches. A batch may lack columns of another one."""
    shapes = {name: (column.shape[1:], column.dtype) for part in parts for name, column in part.items()}

    def part_of(part: dict[str, NDArray[Any]], name: str) -> NDArray[Any]:
        if name in part:
            return part[name]
        shape, dtype = shapes[name]
        return np.full((0 if name in LISTS else len(part["image_id"]), *shape), UNKNOWN.get(name, -1), dtype)

    return {name: np.concatenate([part_of(part, name) for part in parts]) for name in shapes}


def _combine(batches: Iterable[RecordBatch[ImageRecord]], header: dict[str, Any], place: Place) -> Predictions:
    """Make predictions from all records; ``place`` names the n-th record."""
    none = RecordBatch[ImageRecord]([], ("image_id", "keypoints"))
    whole = _join_columns([_make_columns(none), *map(_make_columns, batches)])
    keypoint_count = whole["keypoints count"]

    def take(name: str) -> NDArray[Any] | None:
        """Check that all or none of the images with keypoints have the list. Return the joined lists."""
        if name not in whole:
            return None
        counts = whole[f"{name} count"]
        wrong = np.flatnonzero((counts >= 0) & (counts != keypoint_count))
        lacking = np.flatnonzero((counts < 0) & (keypoint_count > 0))
        if len(wrong):
            n = int(wrong[0])
            problem = f"{name} has {counts[n]} values, expected one for each of {keypoint_count[n]} keypoints"
        elif len(lacking) and counts.max() > 0:
            n = int(lacking[0])
            problem = f"no {name}, which other images have"
        else:
            return whole[name] if counts.max(initial=-1) >= 0 and not len(lacking) else None
        raise PredictionsError(f"{place(n)} (image_id {whole['image_id'][n]}): {problem}")

    lists: dict[str, Any] = {name: take(name) for name in LISTS}
    scores, ids = lists.pop("scores"), lists.pop("ids")
    try:
        return Predictions(
            image_id=whole["image_id"],
            offsets=offsets_of(keypoint_count),
            xy=whole["keypoints"],
            score=np.ones(len(whole["keypoints"])) if scores is None else scores,
            patch_id=ids,
            **lists,
            **{name: whole.get(name) for name in UNKNOWN},  # type: ignore[arg-type]
            **header,
        )
    except InvalidValue as error:
        raise PredictionsError(f"{place(error.image)} (image_id {error.image_id}): {error.problem}") from None


def encode_images(predictions: Predictions) -> Iterator[bytes]:
    """Encode each image as a JSON object in one line."""
    encode, p = msgspec.json.Encoder().encode, predictions
    lists = {"keypoints": p.xy, "scores": p.score, "ids": p.patch_id}
    lists |= {name: getattr(p, name) for name in LISTS if name not in lists}
    given = [(name, values) for name, values in lists.items() if values is not None]
    of_images: dict[str, list[Any]] = {}
    for name, unknown in UNKNOWN.items():
        values = encode_names(p) if name == "file" else getattr(p, name)
        if values is not None:
            listed = values if isinstance(values, list) else values.tolist()
            absent = [0, 0] if name == "size" else unknown
            of_images[name] = [None if v == absent or v != v else v for v in listed]
    for n, (image_id, (a, b)) in enumerate(zip(p.image_id.tolist(), pairwise(p.offsets.tolist()), strict=True)):
        record = {"image_id": image_id}
        for name, column in of_images.items():
            if column[n] is not None:
                record[name] = column[n]
        for name, rows in given:
            record[name] = rows[a:b].tolist()
        yield encode(record)


def encode_lines(predictions: Predictions, with_header: bool) -> Iterator[str]:
    """Yield the lines of a ``.jsonl`` file in ASCII, without their ends: the header if asked, then a line per image."""
    lines = [msgspec.json.encode(make_header(predictions))] if with_header else []
    for line in chain(lines, encode_images(predictions)):
        yield json.dumps(json.loads(line), separators=(",", ":"))


def encode_json(predictions: Predictions) -> bytes:
    """Encode a ``.json`` file, a line per image."""
    header = msgspec.json.encode(make_header(predictions))[:-1]
    return b'%s,\n "predictions": [\n  %s\n ]}\n' % (header, b",\n  ".join(encode_images(predictions)))


def encode_jsonl(predictions: Predictions) -> bytes:
    """Encode a ``.jsonl`` file: a line with the header, then a line per image."""
    return b"\n".join([msgspec.json.encode(make_header(predictions)), *encode_images(predictions), b""])
