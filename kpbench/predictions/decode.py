"""Decode JSON into typed records, a long list piece by piece, and describe the first fault in one line.

Decoding into typed records makes no dictionaries. If a file has a fault or its list cannot be split, the file or the
piece is decoded again into plain objects. The second decoding finds the place of the fault.
"""

from __future__ import annotations

import gc
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import attrgetter
from typing import Any, TypeVar

import msgspec

from kpbench.errors import PredictionsError
from kpbench.files import DoubleKeyError, escape_surrogates, load_json

PIECE_BYTES = 4 * 2**20
"""Bytes of JSON that are decoded at a time."""

Record = TypeVar("Record", bound=msgspec.Struct)
Expected = Mapping[str, str]
"""The expected value of each field of a record, in words. ``NAME[]`` describes the entries of the list ``NAME``."""
Place = Callable[[int], str]
"""A function that names the n-th record of a file, such as ``predictions[12]``."""


def split_list(data: bytes, opening: str) -> tuple[Any, Iterator[bytes]]:
    """Split the long list of a JSON text into shorter lists.

    A list that is decoded at once takes several times the memory of its text. The list is split at closing braces, so
    its records must not contain objects. No other list may follow in the text.

    Parameters
    ----------
    data : bytes
    opening : str
        Regular expression for the text that ends with the opening bracket of the list.

    Returns
    -------
    frame : decoded JSON
        The text with an empty list in place of the long list; the whole text if ``opening`` is not found.
    pieces : iterator of bytes
        The shorter lists, as JSON; none if ``opening`` is not found. Iteration raises ValueError where the list cannot
        be split.

    Raises
    ------
    ValueError
        If the frame is not JSON.
    """
    found = re.search(opening.encode(), data)
    start, stop = (found.end(), data.rfind(b"]")) if found else (0, 0)
    frame = load_json(data[:start] + data[stop:])

    def pieces() -> Iterator[bytes]:
        low, more = start, False
        while low < stop or more:
            high = data.find(b"}", low + PIECE_BYTES, stop) + 1 or stop
            piece = data[low:high]
            if more and not piece.strip():
                raise ValueError("nothing after a comma")
            yield b"[%s]" % piece
            comma = data.find(b",", high, stop)
            more, low = comma >= 0, comma + 1 if comma >= 0 else stop
            if data[high : comma if more else stop].strip():
                raise ValueError("no comma after a record")

    return frame, pieces()


def decode_records(
    pieces: Iterable[bytes], record: type[Record], expected: Expected, place: Place
) -> Iterator[list[Record]]:
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
            batch: list[Record] = decoder.decode(piece)
            require_single_keys(piece, batch, record)
        except DoubleKeyError as error:
            raise PredictionsError(str(error)) from None
        except (ValueError, RecursionError):
            first = start
            batch = convert_records(load_json(piece), record, expected, lambda n: place(first + n))  # noqa: B023
        yield batch
        start += len(batch)


def require_single_keys(data: bytes, records: Sequence[Record], record: type[Record]) -> None:
    """Refuse a JSON list of records in which an object has a key twice. msgspec takes the last one in silence.

    Records with keys that are not fields are compared with the first one. Otherwise, and if they have other keys than
    the first one, keys are counted in the text and in the records. Only if the counts differ, the text is decoded again
    into plain objects. Objects within the records may not be looked at.

    Raises
    ------
    DoubleKeyError
    """
    names, defaults = record.__struct_fields__, record.__struct_defaults__
    if not record.__struct_config__.forbid_unknown_fields and _has_keys_of_first(data, len(records)):
        return
    counts = dict.fromkeys(names, len(records))
    for name, default in zip(names[len(names) - len(defaults) :], defaults, strict=True):
        counts[name] -= list(map(attrgetter(name), records)).count(default)
    if data.count(b":") == sum(counts.values()):
        return
    if b"\\" in data or any(data.count(b'"%s"' % name.encode()) != count for name, count in counts.items()):
        load_json(data)


NUMBER_BYTES = b"0123456789+-.eE[], \t\r\n"
"""What numbers and lists of numbers are written with."""


def _has_keys_of_first(data: bytes, count: int) -> bool:
    """Return whether the objects of a list have the keys of the first one, in its order, each once.

    False may also be returned if they have. Without numbers, such objects are one text that is repeated.
    """
    first = data[data.find(b"{") : data.find(b"}") + 1]
    try:
        keys = {key.encode().translate(None, NUMBER_BYTES) for key in load_json(first)}
    except (DoubleKeyError, ValueError):
        return False
    bare = first.translate(None, NUMBER_BYTES)
    is_distinct = len(keys) == first.count(b":") and b"\\" not in first
    return is_distinct and data.translate(None, NUMBER_BYTES) == bare * count


def convert_records(entries: list[Any], record: type[Record], expected: Expected, place: Place) -> list[Record]:
    """Convert decoded JSON to typed records. Values of NaN, which Python's own json writes, are accepted.

    Raises
    ------
    PredictionsError
        At the first record with a fault. The message names the record, its image, the field, the value and the
        expected value.
    """
    try:
        return msgspec.convert(entries, list[record])  # type: ignore[valid-type]
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
        data.decode()
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
