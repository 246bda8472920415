"""Predictions as JSON and JSON lines: one object per image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec
import numpy as np

from kpbench.errors import PredictionsError
from kpbench.files import DoubleKeyError, open_file, read_bytes
from kpbench.predictions.coco import decode_coco_results
from kpbench.predictions.decode import (
    PIECE_BYTES,
    Place,
    convert_records,
    decode_records,
    json_type,
    parse_json,
    require_single_keys,
    split_lists,
)
from kpbench.predictions.fields import EXPECTED_IN_RECORD, SCHEMA, ImageRecord, make_header, parse_header
from kpbench.types import Float, Int, InvalidValue, Predictions, offsets_of


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
        return _combine((batch.records for batch in batches), parse_header(frame), place)
    except (ValueError, RecursionError):
        pass  # the list cannot be split: decode the file at once, and find any fault
    content = parse_json(data, "the file")
    if not isinstance(content, dict):
        raise PredictionsError(f"holds {json_type(content)}, expected an object with schema {SCHEMA!r}")
    entries = content.pop("predictions", None)
    header = parse_header(content)
    if not isinstance(entries, list):
        raise PredictionsError(f"predictions is {json_type(entries)}, expected a list")
    return _combine([convert_records(entries, ImageRecord, EXPECTED_IN_RECORD, place).records], header, place)


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

    def read_batches(file: BinaryIO) -> Iterator[list[ImageRecord]]:
        first = 2
        while lines := file.readlines(PIECE_BYTES):
            batch = [decode_line(line, n) for n, line in enumerate(lines, first)]
            require_single_keys(b"[%s]" % b",".join(lines), batch, ImageRecord)
            yield batch
            first += len(lines)

    with open_file(path) as file:
        header = parse_header(parse_json(file.readline(), "line 1"))
        try:
            return _combine(read_batches(file), header, lambda n: f"line {n + 2}")
        except DoubleKeyError as error:
            raise PredictionsError(str(error)) from None


class _Batch(NamedTuple):
    """Some records as columns, for N images and K detections."""

    image_id: Int
    """Of shape (N,)."""
    keypoint_count: Int
    """Of shape (N,)."""
    xy: Float
    """Of shape (K, 2), px."""
    score: Float
    score_count: Int
    """Length of each image's list of scores, of shape (N,); -1 for an image without the list."""
    patch_id: Int
    patch_id_count: Int
    """Length of each image's list of IDs, of shape (N,); -1 for an image without the list."""


def _make_batch(records: list[ImageRecord]) -> _Batch:
    def lengths(lists: list[list[Any] | None]) -> Int:
        return np.fromiter([-1 if values is None else len(values) for values in lists], np.int64, len(lists))

    def flatten(lists: list[list[Any] | None], dtype: Any) -> Any:
        return np.fromiter(chain.from_iterable(values for values in lists if values), dtype)

    points, scores, ids = ([getattr(r, name) for r in records] for name in ("keypoints", "scores", "ids"))
    return _Batch(
        np.fromiter([r.image_id for r in records], np.int64, len(records)),
        lengths(points),
        np.fromiter(chain.from_iterable(chain.from_iterable(points)), np.float64).reshape(-1, 2),
        flatten(scores, np.float64),
        lengths(scores),
        flatten(ids, np.int64),
        lengths(ids),
    )


def _combine(batches: Iterable[list[ImageRecord]], header: dict[str, Any], place: Place) -> Predictions:
    """Make predictions from all records; ``place`` names the n-th record."""
    columns = map(np.concatenate, zip(_make_batch([]), *map(_make_batch, batches), strict=True))
    whole = _Batch(*columns)

    def has_values(name: str, counts: Int) -> bool:
        """Check that all or none of the images with keypoints have the list. Return whether all have the list."""
        wrong = np.flatnonzero((counts >= 0) & (counts != whole.keypoint_count))
        lacking = np.flatnonzero((counts < 0) & (whole.keypoint_count > 0))
        if len(wrong):
            n = int(wrong[0])
            problem = f"{name} has {counts[n]} values, expected one for each of {whole.keypoint_count[n]} keypoints"
        elif len(lacking) and counts.max() > 0:
            n = int(lacking[0])
            problem = f"no {name}, which other images have"
        else:
            return counts.max(initial=-1) >= 0 and not len(lacking)
        raise PredictionsError(f"{place(n)} (image_id {whole.image_id[n]}): {problem}")

    has_scores, has_ids = has_values("scores", whole.score_count), has_values("ids", whole.patch_id_count)
    try:
        return Predictions(
            image_id=whole.image_id,
            offsets=offsets_of(whole.keypoint_count),
            xy=whole.xy,
            score=whole.score if has_scores else np.ones(len(whole.xy)),
            patch_id=whole.patch_id if has_ids else None,
            **header,
        )
    except InvalidValue as error:
        raise PredictionsError(f"{place(error.image)} (image_id {error.image_id}): {error.problem}") from None


def _encode_images(predictions: Predictions) -> Iterator[bytes]:
    """Encode each image as a JSON object in one line."""
    encode, ids = msgspec.json.Encoder().encode, predictions.patch_id
    for image_id, (a, b) in zip(predictions.image_id.tolist(), pairwise(predictions.offsets.tolist()), strict=True):
        xy, scores = predictions.xy[a:b].tolist(), predictions.score[a:b].tolist()
        record = {"image_id": image_id, "keypoints": xy, "scores": scores}
        yield encode(record if ids is None else record | {"ids": ids[a:b].tolist()})


def encode_json(predictions: Predictions) -> bytes:
    """Encode a ``.json`` file, a line per image."""
    header = msgspec.json.encode(make_header(predictions))[:-1]
    return b'%s,\n "predictions": [\n  %s\n ]}\n' % (header, b",\n  ".join(_encode_images(predictions)))


def encode_jsonl(predictions: Predictions) -> bytes:
    """Encode a ``.jsonl`` file: a line with the header, then a line per image."""
    return b"\n".join([msgspec.json.encode(make_header(predictions)), *_encode_images(predictions), b""])
