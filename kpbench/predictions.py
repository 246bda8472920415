"""Predictions files: what a detector found in every image of a dataset, in and out.

In memory the predictions are columns (:class:`Predictions`), so that a million images are a handful of
arrays. On disk they are ``.json`` (schema ``kpbench.predictions/1``), ``.jsonl``, ``.csv``, ``.parquet`` or
``.h5``, all with the same content; ``docs/predictions.md`` describes each.
"""

from __future__ import annotations

import csv
import gc
import importlib
import io
import json
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, NoReturn

import numpy as np
import orjson
from numpy.typing import NDArray

from kpbench.errors import PredictionsError
from kpbench.keypoints import Detections, Float

__all__ = ["Predictions", "read_predictions", "write_predictions"]

SCHEMA = "kpbench.predictions/1"
HEADER_KEYS = {"schema", "dataset", "fingerprint", "detector"}
RECORD_KEYS = {"image_id", "keypoints", "scores", "ids"}
COLUMNS = ("image_id", "x", "y", "score", "id")
PIECE_BYTES = 16 * 2**20  # of JSON that is decoded at a time

Int = NDArray[np.int64]


class _Misfit(PredictionsError):
    """A value that cannot be: in which image (position), at which keypoint of it (or None), and why."""

    def __init__(self, image: int, keypoint: int | None, image_id: int, problem: str) -> None:
        super().__init__(f"predictions[{image}] (image_id {image_id}): {problem}")
        self.image, self.keypoint, self.image_id, self.problem = image, keypoint, image_id, problem


@dataclass(frozen=True)
class Predictions:
    """Detections of N images as columns; image ``i`` owns rows ``offsets[i]:offsets[i + 1]``.

    Attributes
    ----------
    image_id : ndarray of shape (N,), int64, unique, 0 or more, in any order.
    offsets : ndarray of shape (N + 1,), int64.
    xy : ndarray of shape (K, 2), float64, px in the pixel convention of :mod:`kpbench.geometry`.
    score : ndarray of shape (K,), float64, higher is surer.
    patch_id : ndarray of shape (K,), int64, 0 or more, or None from a detector that tells no identities.
    detector : dict
        Whatever names the detector, such as ``{"name": "superpoint", "version": "1"}``.
    dataset : str or None
        Path or fingerprint of the dataset.
    fingerprint : str or None
        Fingerprint of the dataset, checked when scoring.

    Raises
    ------
    PredictionsError
        If the columns do not fit each other or hold a value that cannot be; it names image and keypoint.
    """

    image_id: Int
    offsets: Int
    xy: Float
    score: Float
    patch_id: Int | None = None
    detector: dict[str, Any] = field(default_factory=dict)
    dataset: str | None = None
    fingerprint: str | None = None

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "image_id", np.ascontiguousarray(self.image_id, np.int64).reshape(-1))
        set_(self, "offsets", np.ascontiguousarray(self.offsets, np.int64).reshape(-1))
        set_(self, "xy", np.ascontiguousarray(self.xy, np.float64).reshape(-1, 2))
        set_(self, "score", np.ascontiguousarray(self.score, np.float64).reshape(-1))
        if self.patch_id is not None:
            set_(self, "patch_id", np.ascontiguousarray(self.patch_id, np.int64).reshape(-1))
        _check(self)

    def __len__(self) -> int:
        return len(self.image_id)

    @classmethod
    def from_detections(
        cls,
        detections: Iterable[Detections],
        image_id: Sequence[int] | Int | None = None,
        detector: dict[str, Any] | None = None,
        dataset: str | None = None,
        fingerprint: str | None = None,
    ) -> Predictions:
        """One :class:`Detections` an image, to columns; ``image_id`` is 0, 1, 2, … where it is not given.

        Raises
        ------
        PredictionsError
            As the class does, and if some images with detections have identities and others have none.
        """
        found = list(detections)
        named = [d.patch_id is not None for d in found if len(d)]
        if any(named) and not all(named):
            raise PredictionsError("some images have ids and others have none; give ids to all detections or to none")
        ids = [d.patch_id for d in found if d.patch_id is not None and len(d)]
        return cls(
            image_id=np.arange(len(found)) if image_id is None else np.asarray(image_id, np.int64),
            offsets=_offsets([len(d) for d in found]),
            xy=np.concatenate([np.zeros((0, 2)), *(d.xy for d in found)]),
            score=np.concatenate([np.zeros(0), *(d.score for d in found)]),
            patch_id=np.concatenate([np.zeros(0, np.int64), *ids]) if all(named) else None,
            detector=detector or {},
            dataset=dataset,
            fingerprint=fingerprint,
        )

    def detections(self) -> list[Detections]:
        """The same as one :class:`Detections` an image, in the order of ``image_id``."""
        return [
            Detections(self.xy[a:b], self.score[a:b], None if self.patch_id is None else self.patch_id[a:b])
            for a, b in pairwise(self.offsets.tolist())
        ]


def _offsets(counts: Sequence[int] | Int) -> Int:
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).astype(np.int64)


def _check(p: Predictions) -> None:
    """Every rule that the numbers must keep, for all formats and for arrays made in memory."""
    n, k = len(p.image_id), len(p.xy)
    if len(p.offsets) != n + 1 or p.offsets[0] != 0 or p.offsets[-1] != k or np.any(np.diff(p.offsets) < 0):
        raise PredictionsError(f"offsets do not run from 0 to {k} keypoints in {n} images")
    if len(p.score) != k or (p.patch_id is not None and len(p.patch_id) != k):
        ids = k if p.patch_id is None else len(p.patch_id)
        raise PredictionsError(f"{k} keypoints, {len(p.score)} scores and {ids} ids do not belong together")

    def complain(row: int, name: str, value: object, expected: str) -> NoReturn:
        image = int(np.searchsorted(p.offsets, row, side="right")) - 1
        keypoint = row - int(p.offsets[image])
        raise _Misfit(image, keypoint, int(p.image_id[image]), f"{name}[{keypoint}] is {value}, expected {expected}")

    if n and p.image_id.min() < 0:
        i = int(np.argmax(p.image_id < 0))
        raise _Misfit(i, None, int(p.image_id[i]), "image_id is negative, expected 0 or more")
    order = np.argsort(p.image_id, kind="stable")
    again = np.flatnonzero(np.diff(p.image_id[order]) == 0)
    if len(again):
        first, second = order[again[0]], order[again[0] + 1]
        raise _Misfit(int(second), None, int(p.image_id[second]), f"the image is there twice, first at {first}")
    if not np.isfinite(p.xy).all():
        row = int(np.argmin(np.isfinite(p.xy).all(axis=1)))
        complain(row, "keypoints", p.xy[row].tolist(), "two finite numbers")
    if not np.isfinite(p.score).all():
        row = int(np.argmin(np.isfinite(p.score)))
        complain(row, "scores", p.score[row].item(), "a finite number")
    if p.patch_id is not None and k and p.patch_id.min() < 0:
        row = int(np.argmax(p.patch_id < 0))
        complain(row, "ids", p.patch_id[row].item(), "a patch id, 0 or more")


# --- reading ----------------------------------------------------------------------------------------------------


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
        with _no_gc():
            return READERS[path.suffix.lower()](path)
    except PredictionsError as error:
        raise PredictionsError(f"{path}: {error}") from None
    except OSError as error:
        raise PredictionsError(f"{path}: cannot be read, {error.strerror or error}") from None


def _read_json(path: Path) -> Predictions:
    data = path.read_bytes()
    try:
        header, pieces = _pieces(data)
        return _from_batches(map(orjson.loads, pieces), _header(header), lambda n: f"predictions[{n}]")
    except orjson.JSONDecodeError:  # not of the shape that can be cut: read it whole, which also says what is wrong
        content = _parse(data, "the file")
    if isinstance(content, list):
        return coco_results(content)
    if not isinstance(content, dict):
        raise PredictionsError(f"holds {_kind(content)}, expected an object with schema {SCHEMA!r}")
    records = content.pop("predictions", None)
    header = _header(content)
    if not isinstance(records, list):
        raise PredictionsError(f"predictions is {_kind(records)}, expected a list")
    return _from_batches([records], header, lambda n: f"predictions[{n}]")


def _pieces(data: bytes) -> tuple[dict[str, Any], Iterator[bytes]]:
    """A large file's header, and its list of predictions cut into shorter lists.

    Decoded at once, the list would take five times its file in memory. No record holds an object, so each ends
    with the next brace; and lists that decode one by one are the list that they were cut from.

    Raises
    ------
    orjson.JSONDecodeError
        If the file is none that can be cut like this.
    """
    opening = re.search(rb'"predictions"\s*:\s*\[', data)
    start, stop = (opening.end(), data.rfind(b"]")) if opening else (0, 0)
    header = orjson.loads(data[:start] + data[stop:])
    if not isinstance(header, dict) or header.pop("predictions", None) != []:
        raise orjson.JSONDecodeError("not to be cut", "", 0)

    def cut() -> Iterator[bytes]:
        low, more = start, False
        while low < stop or more:
            high = data.find(b"}", low + PIECE_BYTES, stop) + 1 or stop
            piece = data[low:high]
            if more and not piece.strip():
                raise orjson.JSONDecodeError("nothing after a comma", "", low)
            yield b"[%s]" % piece
            comma = data.find(b",", high, stop)
            more, low = comma >= 0, comma + 1 if comma >= 0 else stop
            if data[high : comma if more else stop].strip():
                raise orjson.JSONDecodeError("no comma after a record", "", high)

    return header, cut()


def _read_jsonl(path: Path) -> Predictions:
    def batches(file: BinaryIO) -> Iterator[list[Any]]:
        first = 2
        while lines := file.readlines(PIECE_BYTES):
            yield [_parse(line, f"line {n}") for n, line in enumerate(lines, first)]
            first += len(lines)

    with path.open("rb") as file:
        header = _header(_parse(file.readline(), "line 1"))
        return _from_batches(batches(file), header, lambda n: f"line {n + 2}")


@contextmanager
def _no_gc() -> Iterator[None]:
    """Pause the garbage collector, which would walk through millions of new lists again and again."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()


def _parse(data: bytes, place: str) -> Any:
    try:
        return orjson.loads(data)
    except orjson.JSONDecodeError as error:
        problem = str(error)
    try:  # Python's own json.dump writes NaN, which is no JSON; read it so that the keypoint can be named
        return json.loads(data)
    except (ValueError, RecursionError):
        raise PredictionsError(f"{place} is cut off or no JSON ({problem})") from None


def _header(content: Any) -> dict[str, Any]:
    """Check what all formats share; gives the keyword arguments ``detector``, ``dataset``, ``fingerprint``."""
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        found = repr(content["schema"]) if isinstance(content, dict) and "schema" in content else "missing"
        raise PredictionsError(f"schema is {found}, expected {SCHEMA!r}")
    for key in sorted(content.keys() - HEADER_KEYS):
        raise PredictionsError(f"unknown key {key!r}, expected {', '.join(sorted(HEADER_KEYS))} and predictions")
    detector, dataset = content.get("detector", {}), content.get("dataset")
    if not isinstance(detector, dict):
        raise PredictionsError(f"detector is {_kind(detector)}, expected an object")
    if not isinstance(dataset, str | None):
        raise PredictionsError(f"dataset is {_kind(dataset)}, expected a path or a fingerprint")
    fingerprint = content.get("fingerprint")
    if not isinstance(fingerprint, str | None):
        raise PredictionsError(f"fingerprint is {_kind(fingerprint)}, expected that of a dataset")
    return {"detector": detector, "dataset": dataset, "fingerprint": fingerprint}


class _Batch(NamedTuple):
    """Some records as columns; scores and ids are None where no record has any."""

    image_id: list[int]
    counts: Int
    xy: Float
    score: Float | None
    patch_id: Int | None


def _from_batches(batches: Iterable[list[Any]], header: dict[str, Any], place: Callable[[int], str]) -> Predictions:
    """Columns from lists of objects, one object an image; ``place`` names the n-th of all."""
    parts: list[_Batch] = []
    start = 0
    for records in batches:
        parts.append(_batch(records, start, place))
        start += len(records)
    filled = [part for part in parts if len(part.xy)]
    for name in ("score", "patch_id"):
        bare = [getattr(part, name) is None for part in filled]
        if any(bare) and not all(bare):
            lacking = filled[bare.index(True)]
            n = sum(len(part.image_id) for part in parts[: next(k for k, p in enumerate(parts) if p is lacking)])
            first = int(np.flatnonzero(lacking.counts)[0])
            what = {"score": "scores", "patch_id": "ids"}[name]
            raise PredictionsError(
                f"{place(n + first)} (image_id {lacking.image_id[first]}): no {what}, which other images have"
            )
    try:
        named = filled and filled[0].patch_id is not None
        scored = filled and filled[0].score is not None
        keypoints = sum(len(part.xy) for part in filled)
        return Predictions(
            image_id=np.fromiter(chain.from_iterable(part.image_id for part in parts), np.int64),
            offsets=_offsets(np.concatenate([np.zeros(0, np.int64), *(part.counts for part in parts)])),
            xy=np.concatenate([np.zeros((0, 2)), *(part.xy for part in filled)]),
            score=np.concatenate([part.score for part in filled]) if scored else np.ones(keypoints),
            patch_id=np.concatenate([part.patch_id for part in filled]) if named else None,
            **header,
        )
    except _Misfit as error:
        raise PredictionsError(f"{place(error.image)} (image_id {error.image_id}): {error.problem}") from None


def _batch(records: list[Any], start: int, place: Callable[[int], str]) -> _Batch:
    """Columns from one object an image, of which the first is number ``start``.

    Types are tested on whole columns; only when a test fails are the values walked through for the first offender.
    """
    image_id: list[int] = []
    columns: dict[str, list[list[Any]]] = {"keypoints": [], "scores": [], "ids": []}
    given = {"scores": 0, "ids": 0}
    filled = 0
    for n, record in enumerate(records, start):
        if type(record) is not dict or not record.keys() <= RECORD_KEYS or type(record.get("image_id")) is not int:
            raise PredictionsError(f"{place(n)} {_record_problem(record)}")
        image_id.append(record["image_id"])
        points = record.get("keypoints")
        if type(points) is not list:
            raise PredictionsError(
                f"{place(n)} (image_id {image_id[-1]}): keypoints is {_kind(points)}, expected a list"
            )
        columns["keypoints"].append(points)
        filled += bool(points)
        for name in given:
            values = record.get(name)
            if values is None:
                continue
            if type(values) is not list or len(values) != len(points):
                found = f"{len(values)} values" if type(values) is list else _kind(values)
                raise PredictionsError(
                    f"{place(n)} (image_id {image_id[-1]}): {name} has {found}, expected one for each of "
                    f"{len(points)} keypoints"
                )
            given[name] += bool(points)
            columns[name].append(values)
    for name, count in given.items():
        if 0 < count < filled:
            n = next(i for i, r in enumerate(records) if r["keypoints"] and r.get(name) is None)
            raise PredictionsError(f"{place(start + n)} (image_id {image_id[n]}): no {name}, which other images have")
    flat = list(chain.from_iterable(columns["keypoints"]))
    numbers: list[Any] = []
    if set(map(type, flat)) <= {list} and set(map(len, flat)) <= {2}:
        numbers = list(chain.from_iterable(flat))
    sound = len(numbers) == 2 * len(flat) and set(map(type, numbers)) <= {float, int}
    scores, ids = (list(chain.from_iterable(columns[name])) for name in ("scores", "ids"))
    try:
        if not sound or not set(map(type, scores)) <= {float, int} or not set(map(type, ids)) <= {int}:
            raise OverflowError
        np.fromiter(image_id, np.int64, len(image_id))
        return _Batch(
            image_id,
            np.fromiter(map(len, columns["keypoints"]), np.int64, len(image_id)),
            np.fromiter(numbers, np.float64, len(numbers)).reshape(-1, 2),
            np.fromiter(scores, np.float64, len(scores)) if given["scores"] else None,
            np.fromiter(ids, np.int64, len(ids)) if given["ids"] else None,
        )
    except OverflowError:
        raise _first_offender(records, lambda n: place(start + n)) from None


def _record_problem(record: Any) -> str:
    if type(record) is not dict:
        return f"is {_kind(record)}, expected an object"
    unknown = sorted(record.keys() - RECORD_KEYS)
    if unknown:
        return f"has the unknown key {unknown[0]!r}, expected {', '.join(sorted(RECORD_KEYS))}"
    return f"has image_id {_short(record.get('image_id'))}, expected a whole number"


def _first_offender(records: list[Any], place: Callable[[int], str]) -> PredictionsError:
    """The error for the first value of a wrong type or size."""

    def number(value: Any, kinds: tuple[type, ...]) -> bool:
        return type(value) in kinds and -(2**63) <= value < 2**63 if type(value) is int else type(value) in kinds

    for n, record in enumerate(records):
        where = f"{place(n)} (image_id {record['image_id']})"
        if not number(record["image_id"], (int,)):
            return PredictionsError(f"{where}: image_id is larger than 64 bits hold")
        for k, point in enumerate(record["keypoints"]):
            if type(point) is not list or len(point) != 2 or not all(number(v, (int, float)) for v in point):
                return PredictionsError(f"{where}: keypoints[{k}] is {_short(point)}, expected two finite numbers")
        for name, kinds, expected in (
            ("scores", (int, float), "a finite number"),
            ("ids", (int,), "a patch id, 0 or more"),
        ):
            for k, value in enumerate(record.get(name) or []):
                if not number(value, kinds):
                    return PredictionsError(f"{where}: {name}[{k}] is {_short(value)}, expected {expected}")
    raise AssertionError("the columns were refused, but no value is at fault")


def _kind(value: object) -> str:
    names = {dict: "an object", list: "a list", str: "a text", bool: "a truth value", type(None): "missing or null"}
    return names.get(type(value), "a number")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def coco_results(entries: list[Any]) -> Predictions:
    """COCO keypoint results, ``[{"image_id", "category_id", "keypoints": [x, y, v], "score"}, …]``, as predictions.

    Each entry is one detection with one keypoint, whose visibility v is ignored; its patch ID is the category ID less
    1, as ``kpbench export --format coco`` numbers them. Images without detections are not listed in such a file.
    """
    rows: list[tuple[int, float, float, float, int]] = []
    for n, entry in enumerate(entries):
        place = f"results[{n}]"
        if type(entry) is not dict:
            raise PredictionsError(f"{place} is {_kind(entry)}, expected an object of COCO keypoint results")
        image_id, category, score = (entry.get(name) for name in ("image_id", "category_id", "score"))
        point = entry.get("keypoints")
        if type(image_id) is not int or type(category) is not int or category < 1:
            found = f"image_id {_short(image_id)} and category_id {_short(category)}"
            raise PredictionsError(f"{place} has {found}, expected whole numbers, the category from 1")
        if type(point) is not list or len(point) != 3 or not {type(v) for v in (*point, score)} <= {int, float}:
            raise PredictionsError(
                f"{place} (image_id {image_id}): keypoints is {_short(point)} and score {_short(score)}, "
                "expected [x, y, v] and a number"
            )
        rows.append((image_id, point[0], point[1], score or 0, category - 1))
    columns = [np.array(column) for column in zip(*rows, strict=True)] or [np.zeros(0)] * len(COLUMNS)
    table = dict(zip(COLUMNS, [columns[0].astype(np.int64), *(c.astype(np.float64) for c in columns[1:])], strict=True))
    return _from_table(table, {}, lambda row: f"results[{row}]")


def _read_csv(path: Path) -> Predictions:
    import pandas as pd

    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        first = file.readline()
        header = {}
        skipped = 0
        if first.startswith("#"):
            header = _header(_parse(first[1:].encode(), "line 1, after #,"))
            first, skipped = file.readline(), 1
    names = _columns(next(csv.reader([first]), []), f"line {1 + skipped}")

    def place(row: int) -> str:
        return f"line {row + 2 + skipped}"

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pandas 3.1 deprecates float_precision, pandas 2 is inexact without
            warnings.simplefilter("error", pd.errors.ParserWarning)  # a row that is too long is only a warning
            table = pd.read_csv(
                path,
                skiprows=skipped,
                index_col=False,
                dtype={name: np.int64 if name == "image_id" else np.float64 for name in names},
                float_precision="round_trip",
                keep_default_na=False,
                na_values=[""],
                skip_blank_lines=False,
                encoding="utf-8-sig",
            )
    except (ValueError, Warning) as error:  # pandas' parser errors are ValueErrors
        raise _first_bad_row(path, skipped, names, place, error) from None
    return _from_table({name: table[name].to_numpy() for name in names}, header, place)


def _columns(names: list[str], place: str) -> list[str]:
    names = [name.strip() for name in names]
    if not {"image_id", "x", "y"} <= set(names) <= set(COLUMNS) or len(set(names)) < len(names):
        raise PredictionsError(
            f"{place} has columns {','.join(names)[:80]}, expected {','.join(COLUMNS)} (score, id optional)"
        )
    return names


def _first_bad_row(
    path: Path, skipped: int, names: list[str], place: Callable[[int], str], error: BaseException
) -> PredictionsError:
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        for row, cells in enumerate(csv.reader(file), -1 - skipped):
            if row < 0:
                continue
            if len(cells) != len(names):
                return PredictionsError(f"{place(row)} has {len(cells)} values, expected {len(names)}")
            for name, cell in zip(names, cells, strict=True):
                try:
                    value = int(cell) if name == "image_id" else float(cell or 0)
                    fine = abs(value) < 2**63 if name == "image_id" else math.isfinite(value)
                except ValueError:
                    fine = False
                if not fine:
                    expected = "a whole number" if name in ("image_id", "id") else "a finite number"
                    return PredictionsError(f"{place(row)}: {name} is {_short(cell)}, expected {expected}")
    return PredictionsError(f"no table ({' '.join(str(error).split())[:120]})")


def _read_parquet(path: Path) -> Predictions:
    pa, pq = _pyarrow()
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, ValueError) as error:
        raise PredictionsError(f"damaged or no Parquet file ({' '.join(str(error).split())[:120]})") from None
    metadata = table.schema.metadata or {}
    header = _header(_parse(metadata[b"kpbench"], "the metadata")) if b"kpbench" in metadata else {}
    names = _columns(table.column_names, "the table")
    columns = {}
    for name in names:
        whole = name == "image_id"
        try:
            column = table.column(name).cast(pa.int64() if whole else pa.float64())
            if whole and column.null_count:
                raise ValueError("it has nulls")
            columns[name] = column.to_numpy()
        except (pa.ArrowException, ValueError) as error:
            raise PredictionsError(f"column {name} holds no plain numbers ({str(error)[:80]})") from None
    return _from_table(columns, header, lambda row: f"row {row}")


def _pyarrow() -> tuple[Any, Any]:
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise PredictionsError("Parquet needs pyarrow: pip install pyarrow") from None


def _from_table(table: dict[str, NDArray[Any]], header: dict[str, Any], place: Callable[[int], str]) -> Predictions:
    """Columns from one row a keypoint, in any order; a row with nothing but an image_id is an image without any."""
    values = np.stack([table[name].astype(np.float64) for name in COLUMNS[1:] if name in table], axis=1)
    rows = np.flatnonzero(~np.isnan(values).all(axis=1))
    for name in COLUMNS[1:]:
        column = table[name][rows] if name in table else np.zeros(0)
        fine = np.isfinite(column)
        if name == "id":
            fine &= (column >= 0) & (column == np.floor(column)) & (column < 2**53)
        if not fine.all():
            row = int(rows[np.argmin(fine)])
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
        offsets=_offsets(np.bincount(image[rows], minlength=len(image_id))),
        xy=np.stack([table["x"][rows], table["y"][rows]], axis=1),
        score=table["score"][rows] if "score" in table else np.ones(len(rows)),
        patch_id=table["id"][rows].astype(np.int64) if "id" in table else None,
        **header,
    )


H5_COLUMNS = {"image_id": "i", "offsets": "i", "xy": "f", "score": "f", "id": "i"}


def _read_h5(path: Path) -> Predictions:
    import h5py

    columns: dict[str, NDArray[Any]] = {}
    try:
        with h5py.File(path, "r", locking="best-effort") as file:
            header = {}
            if "header" in file.attrs:
                header = _header(_parse(str(file.attrs["header"]).encode(), "the attribute header"))
            for name in sorted(set(file) - H5_COLUMNS.keys()):
                raise PredictionsError(f"unknown dataset /{name}, expected {', '.join(H5_COLUMNS)}")
            for name, kind in H5_COLUMNS.items():
                if name not in file and name in ("score", "id"):
                    continue
                if not isinstance(file.get(name, getlink=True), h5py.HardLink):
                    raise PredictionsError(f"/{name} is missing or a link to elsewhere")
                data = file[name]
                # A file may name other files of this machine, or declare more than it holds
                if not isinstance(data, h5py.Dataset) or data.is_virtual or data.external:
                    raise PredictionsError(f"/{name} is not stored in this file")
                if data.nbytes > 1100 * data.id.get_storage_size():
                    raise PredictionsError(f"/{name} declares {data.nbytes} bytes, the file holds fewer")
                if data.dtype.kind not in (kind + "u" if kind == "i" else "fi") or data.ndim != 1 + (name == "xy"):
                    raise PredictionsError(f"/{name} is {data.dtype} of shape {data.shape}, expected {kind}8 columns")
                columns[name] = data[:]
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        raise PredictionsError(f"damaged or no HDF5 file ({' '.join(str(error).split())[:120]})") from None
    if columns["xy"].shape[1:] != (2,):
        raise PredictionsError(f"/xy has shape {columns['xy'].shape}, expected (K, 2)")
    return Predictions(
        image_id=columns["image_id"],
        offsets=columns["offsets"],
        xy=columns["xy"],
        score=columns.get("score", np.ones(len(columns["xy"]))),
        patch_id=columns.get("id"),
        **header,
    )


READERS: dict[str, Callable[[Path], Predictions]] = {
    ".json": _read_json,
    ".jsonl": _read_jsonl,
    ".csv": _read_csv,
    ".parquet": _read_parquet,
    ".h5": _read_h5,
}


# --- writing ----------------------------------------------------------------------------------------------------


def write_predictions(path: str | Path, predictions: Predictions) -> None:
    """Write a predictions file, whole or not at all; its suffix tells the format.

    Raises
    ------
    PredictionsError
        If the suffix is unknown or pyarrow is needed and missing.
    DataError
        If the disk is full or the folder cannot be written.
    """
    from kpbench.store import write_atomic

    path = Path(path)
    if path.suffix.lower() not in WRITERS:
        *some, last = WRITERS
        raise PredictionsError(f"{path}: unknown kind of predictions file, expected {', '.join(some)} or {last}")
    try:
        data = WRITERS[path.suffix.lower()](predictions)
    except PredictionsError as error:
        raise PredictionsError(f"{path}: {error}") from None
    write_atomic(path, data)


def _header_of(p: Predictions) -> dict[str, Any]:
    named = {"dataset": p.dataset, "fingerprint": p.fingerprint}
    return {"schema": SCHEMA, **{k: v for k, v in named.items() if v is not None}, "detector": p.detector}


def _lines(p: Predictions) -> Iterable[bytes]:
    """One JSON object an image."""
    for image_id, (a, b) in zip(p.image_id.tolist(), pairwise(p.offsets.tolist()), strict=True):
        record = {"image_id": image_id, "keypoints": p.xy[a:b], "scores": p.score[a:b]}
        if p.patch_id is not None:
            record["ids"] = p.patch_id[a:b]
        yield orjson.dumps(record, option=orjson.OPT_SERIALIZE_NUMPY)


def _write_json(p: Predictions) -> bytes:
    head = orjson.dumps(_header_of(p))[:-1]
    return b'%s,\n "predictions": [\n  %s\n ]}\n' % (head, b",\n  ".join(_lines(p)))


def _write_jsonl(p: Predictions) -> bytes:
    return b"\n".join([orjson.dumps(_header_of(p)), *_lines(p), b""])


def _table(p: Predictions) -> dict[str, NDArray[Any]]:
    """One row a keypoint, and one blank row for an image without any."""
    counts = np.diff(p.offsets)
    image = np.repeat(np.arange(len(p)), np.maximum(counts, 1))
    blank = counts[image] == 0
    columns: dict[str, NDArray[Any]] = {"image_id": p.image_id[image]}
    for name, values in (("x", p.xy[:, 0]), ("y", p.xy[:, 1]), ("score", p.score), ("id", p.patch_id)):
        if values is not None:
            columns[name] = np.full(len(image), np.nan)
            columns[name][~blank] = values
    return columns


def _write_csv(p: Predictions) -> bytes:
    import pandas as pd

    frame = pd.DataFrame(_table(p))
    if "id" in frame:
        frame["id"] = frame["id"].astype("Int64")
    text = io.StringIO()
    text.write(f"# {json.dumps(_header_of(p), ensure_ascii=False)}\n")
    frame.to_csv(text, index=False, lineterminator="\n")
    return text.getvalue().encode()


def _write_parquet(p: Predictions) -> bytes:
    pa, pq = _pyarrow()
    types = {name: pa.int64() if name in ("image_id", "id") else pa.float64() for name in COLUMNS}
    columns = {name: pa.array(v, types[name], from_pandas=True) for name, v in _table(p).items()}
    table = pa.table(columns).replace_schema_metadata({"kpbench": json.dumps(_header_of(p))})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return bytes(sink.getvalue())


def _write_h5(p: Predictions) -> bytes:
    import h5py

    with h5py.File.in_memory() as file:
        file.attrs["header"] = json.dumps(_header_of(p))
        columns = {"image_id": p.image_id, "offsets": p.offsets, "xy": p.xy, "score": p.score, "id": p.patch_id}
        for name, values in columns.items():
            if values is not None:
                file.create_dataset(name, data=values)
        file.flush()
        return bytes(file.id.get_file_image())


WRITERS: dict[str, Callable[[Predictions], bytes]] = {
    ".json": _write_json,
    ".jsonl": _write_jsonl,
    ".csv": _write_csv,
    ".parquet": _write_parquet,
    ".h5": _write_h5,
}
