"""Predictions as JSON and JSON lines: one object an image."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Annotated, Any, BinaryIO, NamedTuple

import msgspec
import numpy as np

from kpbench.errors import PredictionsError
from kpbench.predictions.coco import coco_results
from kpbench.predictions.decode import PIECE_BYTES, cut, kind, parse, records, typed
from kpbench.predictions.header import SCHEMA, header_of, read_header
from kpbench.types import Float, Int, InvalidValue, Predictions, offsets_of

Int64 = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]


class Record(msgspec.Struct, gc=False, forbid_unknown_fields=True):
    """One image of a predictions file."""

    image_id: Int64
    keypoints: list[tuple[float, float]]
    scores: list[float] | None = None
    ids: list[Int64] | None = None


EXPECTED = {
    "ids": "a list",
    "ids[]": "a patch id, 0 or more",
    "image_id": "a whole number of 64 bits",
    "keypoints": "a list",
    "keypoints[]": "two finite numbers",
    "scores": "a list",
    "scores[]": "a finite number",
}


def read_json(path: Path) -> Predictions:
    """Read ``.json``: the schema of kpbench, or a list of COCO keypoint results."""
    data = path.read_bytes()
    if data.lstrip()[:1] == b"[":
        return coco_results(data)

    def place(n: int) -> str:
        return f"predictions[{n}]"

    try:
        frame, pieces = cut(data, r'"predictions"\s*:\s*\[')
        if isinstance(frame, dict) and frame.pop("predictions", None) == []:
            return _from_batches(records(pieces, Record, EXPECTED, place), read_header(frame), place)
    except (ValueError, RecursionError):
        pass  # not of the shape that can be cut: read it whole, which also says what is wrong
    content = parse(data, "the file")
    if not isinstance(content, dict):
        raise PredictionsError(f"holds {kind(content)}, expected an object with schema {SCHEMA!r}")
    entries = content.pop("predictions", None)
    header = read_header(content)
    if not isinstance(entries, list):
        raise PredictionsError(f"predictions is {kind(entries)}, expected a list")
    return _from_batches([typed(entries, Record, EXPECTED, place)], header, place)


def read_jsonl(path: Path) -> Predictions:
    """Read ``.jsonl``: a line with the header, then a record a line."""
    decoder = msgspec.json.Decoder(Record)

    def record(line: bytes, n: int) -> Record:
        try:
            return decoder.decode(line)
        except (ValueError, RecursionError):
            return typed([parse(line, f"line {n}")], Record, EXPECTED, lambda _: f"line {n}")[0]

    def batches(file: BinaryIO) -> Iterator[list[Record]]:
        first = 2
        while lines := file.readlines(PIECE_BYTES):
            yield [record(line, n) for n, line in enumerate(lines, first)]
            first += len(lines)

    with path.open("rb") as file:
        header = read_header(parse(file.readline(), "line 1"))
        return _from_batches(batches(file), header, lambda n: f"line {n + 2}")


class _Batch(NamedTuple):
    """Some records as columns."""

    image_id: Int
    counts: Int
    xy: Float
    score: Float
    scores: Int  # how many an image, -1 where they are left out
    patch_id: Int
    ids: Int  # how many an image, -1 where they are left out


def _batch(batch: list[Record]) -> _Batch:
    def lengths(lists: list[list[Any] | None]) -> Int:
        return np.fromiter([-1 if values is None else len(values) for values in lists], np.int64, len(lists))

    def flat(lists: list[list[Any] | None], dtype: Any) -> Any:
        return np.fromiter(chain.from_iterable(values for values in lists if values), dtype)

    points, scores, ids = ([getattr(r, name) for r in batch] for name in ("keypoints", "scores", "ids"))
    return _Batch(
        np.fromiter([r.image_id for r in batch], np.int64, len(batch)),
        lengths(points),
        np.fromiter(chain.from_iterable(chain.from_iterable(points)), np.float64).reshape(-1, 2),
        flat(scores, np.float64),
        lengths(scores),
        flat(ids, np.int64),
        lengths(ids),
    )


def _from_batches(batches: Iterable[list[Record]], header: dict[str, Any], place: Callable[[int], str]) -> Predictions:
    """Columns from records; ``place`` names the n-th of all."""
    parts = [_batch([]), *map(_batch, batches)]
    image_id, counts, xy, score, scores, patch_id, ids = map(np.concatenate, zip(*parts, strict=True))

    def given(name: str, lengths: Int) -> bool:
        """Whether a column is there: for every image with keypoints, one value each, or for none."""
        wrong = np.flatnonzero((lengths >= 0) & (lengths != counts))
        lacking = np.flatnonzero((lengths < 0) & (counts > 0))
        if len(wrong):
            n = int(wrong[0])
            problem = f"{name} has {lengths[n]} values, expected one for each of {counts[n]} keypoints"
        elif len(lacking) and lengths.max() > 0:
            n = int(lacking[0])
            problem = f"no {name}, which other images have"
        else:
            return lengths.max(initial=-1) >= 0 and not len(lacking)
        raise PredictionsError(f"{place(n)} (image_id {image_id[n]}): {problem}")

    scored, named = given("scores", scores), given("ids", ids)
    try:
        return Predictions(
            image_id=image_id,
            offsets=offsets_of(counts),
            xy=xy,
            score=score if scored else np.ones(len(xy)),
            patch_id=patch_id if named else None,
            **header,
        )
    except InvalidValue as error:
        raise PredictionsError(f"{place(error.image)} (image_id {error.image_id}): {error.problem}") from None


def _lines(p: Predictions) -> Iterable[bytes]:
    """One JSON object an image."""
    encode = msgspec.json.Encoder().encode
    for image_id, (a, b) in zip(p.image_id.tolist(), pairwise(p.offsets.tolist()), strict=True):
        record = {"image_id": image_id, "keypoints": p.xy[a:b].tolist(), "scores": p.score[a:b].tolist()}
        if p.patch_id is not None:
            record["ids"] = p.patch_id[a:b].tolist()
        yield encode(record)


def write_json(p: Predictions) -> bytes:
    """The text of a ``.json`` file, a line an image."""
    head = msgspec.json.encode(header_of(p))[:-1]
    return b'%s,\n "predictions": [\n  %s\n ]}\n' % (head, b",\n  ".join(_lines(p)))


def write_jsonl(p: Predictions) -> bytes:
    """The text of a ``.jsonl`` file."""
    return b"\n".join([msgspec.json.encode(header_of(p)), *_lines(p), b""])
