"""Decode JSON into typed records, a long list piece by piece, and describe the first fault in one line.

Decoding into typed records makes no dictionaries. If a file has a fault or its list cannot be split, the file or the
piece is decoded again into plain objects. The second decoding finds the place of the fault.
"""

from __future__ import annotations

import gc
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import attrgetter
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec

from kpbench.errors import PredictionsError
from kpbench.files import DoubleKeyError, escape_surrogates, load_json

PIECE_BYTES = 2**18
"""Bytes of JSON that are decoded at a time. The records of a piece then fit into the cache of a processor."""

Record = TypeVar("Record", bound=msgspec.Struct)
Expected = Mapping[str, str]
"""The expected value of each field of a record, in words. ``NAME[]`` describes the entries of the list ``NAME``."""
Place = Callable[[int], str]
"""A function that names the n-th record of a file, such as ``predictions[12]``."""


def split_lists(data: bytes, *names: str) -> tuple[Any, list[Iterator[bytes]]]:
    """Split the long lists of a JSON text into shorter lists.

    A list that is decoded at once takes several times the memory of its text, and more time than pieces that fit into
    the cache of a processor. Records may contain objects, but no lists of objects.

    Parameters
    ----------
    data : bytes
        An object whose values include the lists, or a list.
    names : str
        Key of each list in the object. Without names, the text is the list.

    Returns
    -------
    frame : decoded JSON
        The text without the lists.
    lists : list of iterators of bytes
        For each name, the shorter lists, as JSON.

    Raises
    ------
    ValueError
        If the rest of the text is not JSON, or the lists are not found. A list without objects is never found. If the
        lists are split at wrong places, some shorter list is not JSON.
    """
    key = rb'"(%s)"%s:' % ("|".join(names).encode(), _BLANK) if names else rb"^()"
    opening = re.compile(rb"%s%s(?=\[%s\{)" % (key, _BLANK, _BLANK))
    rest, spans, end = list[bytes](), dict[str, tuple[int, int]](), 0
    while found := opening.search(data, end):
        low = data.rfind(b'"image_id"') if len(spans) + 1 >= len(names) else 0  # near the end of the last list
        last = _LAST.search(data, max(low, found.end()))
        if last is None or found[1].decode() in spans:
            raise ValueError("a list has no end, or is there twice")
        rest.append(data[end : found.end()])
        spans[found[1].decode()], end = (found.end() + 1, last.start() + 1), last.end()
    frame = load_json((b'"%s"' % _MARK.encode()).join([*rest, data[end:]]))
    content = frame if names and isinstance(frame, dict) else {"": frame}
    if any(content.pop(name, None) != _MARK for name in names or ("",)):
        raise ValueError("a list is not found")
    return frame, [_split_span(data, *spans[name]) for name in names or ("",)]


_BLANK = rb"[ \t\r\n]*"
_LAST = re.compile(rb"\}%s\]" % _BLANK)
"""The end of a list of objects."""
_NEXT = re.compile(rb"\}%s,%s(?=\{)" % (_BLANK, _BLANK))
"""The end of an object in a list, if another object follows."""
_MARK = f"a list {os.urandom(16).hex()}"
"""The text that stands for a list that is cut out. It is random, so that no file can hold it."""


def _split_span(data: bytes, low: int, stop: int) -> Iterator[bytes]:
    view = memoryview(data)
    while cut := _NEXT.search(data, low + PIECE_BYTES, stop):
        yield b"".join((b"[", view[low : cut.start() + 1], b"]"))
        low = cut.end()
    yield b"".join((b"[", view[low:stop], b"]"))


class RecordBatch(NamedTuple, Generic[Record]):
    """Some typed records of a list."""

    records: list[Record]
    keys: Collection[str]
    """Names of all fields that the records have in the file. Fields that no record has may be included."""


def decode_records(
    pieces: Iterable[bytes], record: type[Record], expected: Expected, place: Place
) -> Iterator[RecordBatch[Record]]:
    """Decode the typed records of each piece of a list.

    Parameters
    ----------
    pieces : iterable of bytes
        Lists of records, as JSON.
    record : type
    expected : mapping of str to str
    place : function
        Names the n-th record of all pieces.

    Raises
    ------
    PredictionsError
        At the first record with a fault, see :func:`convert_records`.
    ValueError
        If a piece is not JSON.
    """
    decoder = msgspec.json.Decoder(list[record])  # type: ignore[valid-type]
    start = 0
    for piece in pieces:
        try:
            records: list[Record] = decoder.decode(piece)
            batch = RecordBatch(records, require_single_keys(piece, records, record))
        except DoubleKeyError as error:
            raise PredictionsError(str(error)) from None
        except (ValueError, RecursionError):
            first = start
            batch = convert_records(load_json(piece), record, expected, lambda n: place(first + n))  # noqa: B023
        yield batch
        start += len(batch.records)


def require_single_keys(data: bytes, records: Sequence[Record], record: type[Record]) -> Collection[str]:
    """Refuse a JSON list of records in which an object has a key twice. msgspec takes the last one in silence.

    Records with keys that are not fields are compared with the first one. Otherwise, and if they have other keys than
    the first one, keys are counted in the text and in the records. Only if the counts differ, the text is decoded again
    into plain objects. Objects within the records may not be looked at.

    Returns
    -------
    collection of str
        :attr:`RecordBatch.keys`.

    Raises
    ------
    DoubleKeyError
    """
    names, defaults = record.__struct_fields__, record.__struct_defaults__
    if not record.__struct_config__.forbid_unknown_fields:
        keys = _keys_of_all(data, len(records))
        if keys:
            return keys
    counts = dict.fromkeys(names, len(records))
    colons = data.count(b":")
    optional = names[len(names) - len(defaults) :]
    for name, default in zip(optional, defaults, strict=True):
        counts[name] -= list(map(attrgetter(name), records)).count(default)
        if name != optional[-1] and colons == sum(counts[n] for n in names[: names.index(name) + 1]):
            return names[: names.index(name) + 1]  # no colon is left for a key of a later field
    if colons != sum(counts.values()) and (
        b"\\" in data or any(data.count(b'"%s"' % name.encode()) != count for name, count in counts.items())
    ):
        load_json(data)
    return names


NUMBER_BYTES = b"0123456789+-.eE[], \t\r\n"
"""What numbers and lists of numbers are written with."""


def _keys_of_all(data: bytes, count: int) -> Collection[str]:
    """Return the keys of the first object of a list if all objects have these keys, in one order, each once.

    Nothing may also be returned if they have. Without numbers, such objects are one text that is repeated.
    """
    first = data[data.find(b"{") : data.find(b"}") + 1]
    keys = re.findall(rb'"([^"]*)"%s:' % _BLANK, first)
    is_distinct = len({key.translate(None, NUMBER_BYTES) for key in keys}) == first.count(b":")
    bare = first.translate(None, NUMBER_BYTES)
    if b"\\" in first or not is_distinct or data.translate(None, NUMBER_BYTES) != bare * count:
        return ()
    return [key.decode() for key in keys]


def convert_records(entries: list[Any], record: type[Record], expected: Expected, place: Place) -> RecordBatch[Record]:
    """Convert decoded JSON to typed records. Values of NaN, which Python's own json writes, are accepted.

    Raises
    ------
    PredictionsError
        At the first record with a fault. The message names the record, its image, the field, the value and the
        expected value.
    """
    try:
        return RecordBatch(msgspec.convert(entries, list[record]), record.__struct_fields__)  # type: ignore[valid-type]
    except UnicodeEncodeError:  # a key holds half of a character, which msgspec cannot compare
        return convert_records(escape_surrogates(entries), record, expected, place)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).rpartition(" - at `$")
    n, *steps = (int(index) if index else name for index, name in re.findall(r"\[(\d+)\]|\.(\w+)", path))
    entry = entries[n]
    if type(entry) is not dict:
        raise PredictionsError(f"{place(n)} is {json_type(entry)}, expected an object")
    where = f"{place(n)} (image_id {abbreviate(entry['image_id'])})" if "image_id" in entry else place(n)
    if not steps:
        fault, name = re.findall("(missing|unknown).* field `(.*)`", problem, re.DOTALL)[0]
        if fault == "missing":
            raise PredictionsError(f"{where}: no {name}, expected {expected[name]}")
        raise PredictionsError(
            f"{where}: unknown key {name!r}, expected {', '.join(k for k in expected if k[-1] != ']')}"
        )
    name, index = str(steps[0]), steps[1:2]
    if index and f"{name}[]" in expected:
        value = abbreviate(entry[name][index[0]])
        raise PredictionsError(f"{where}: {name}[{index[0]}] is {value}, expected {expected[f'{name}[]']}")
    raise PredictionsError(f"{where}: {name} is {abbreviate(entry[name])}, expected {expected[name]}")


def parse_json(data: bytes, place: str) -> Any:
    """Decode JSON into plain objects. Values of NaN, which Python's own json writes, are accepted.

    Raises
    ------
    PredictionsError
        If the data is not JSON; the message begins with ``place``.
    """
    try:
        return load_json(data)
    except DoubleKeyError as error:
        raise PredictionsError(f"{place}: {error}") from None
    except ValueError as error:
        raise PredictionsError(f"{place} is cut off or no JSON ({error})") from None


def require_utf8(data: bytes) -> None:
    """Refuse bytes that are not UTF-8 text. msgspec does not look at the texts that it skips.

    Raises
    ------
    PredictionsError
    """
    try:
        data.isascii() or data.decode()
    except UnicodeDecodeError as error:
        raise PredictionsError(f"byte {error.start} is not UTF-8 text") from None


def json_type(value: object) -> str:
    """Name the JSON type of a decoded value, with its article."""
    names = {dict: "an object", list: "a list", str: "a text", bool: "a truth value", type(None): "missing or null"}
    return names.get(type(value), "a number")


def abbreviate(value: object) -> str:
    """Write a value with at most 60 characters."""
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # nested deeply, or a number of thousands of digits
        return "..."
    return text if len(text) <= 60 else text[:57] + "..."


@contextmanager
def pause_gc() -> Iterator[None]:
    """Pause the garbage collector, which would scan millions of new objects many times."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()
