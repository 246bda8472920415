"""JSON straight into typed records, a piece of a long list at a time, and what is wrong in it in one line.

Typed decoding passes over what is not asked for and makes no dictionaries. Only a file that it refuses is read again
loosely, to say where the fault is.
"""

from __future__ import annotations

import gc
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import msgspec

from kpbench.errors import PredictionsError

PIECE_BYTES = 4 * 2**20  # of JSON that is decoded at a time

Record = TypeVar("Record", bound=msgspec.Struct)
Expected = Mapping[str, str]  # what each field, and where it is a list (its name and []) each entry, holds, in words
Place = Callable[[int], str]  # what the n-th entry is called


def cut(data: bytes, opening: str) -> tuple[Any, Iterator[bytes]]:
    """The rest of a large JSON text, and the list in it, which ends with the last ``]``, cut into shorter lists.

    Decoded at once, the list would take several times its text in memory. No record holds an object, so each ends
    with the next brace; and lists that decode one by one are the list that they were cut from.

    Parameters
    ----------
    data : bytes
    opening : str
        A regular expression for what comes before the list, its bracket included.

    Returns
    -------
    frame : decoded JSON
        All but the entries of the list.
    pieces : iterator of bytes
        Lists; ValueError where one cannot be cut off.

    Raises
    ------
    ValueError
        If the text is none that can be cut like this.
    """
    found = re.search(opening.encode(), data)
    start, stop = (found.end(), data.rfind(b"]")) if found else (0, 0)
    frame = msgspec.json.decode(data[:start] + data[stop:])

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


def records(pieces: Iterable[bytes], of: type[Record], expected: Expected, place: Place) -> Iterator[list[Record]]:
    """The typed records of each piece.

    Raises
    ------
    PredictionsError
        For the first record that does not fit, see :func:`typed`.
    ValueError
        If a piece is no JSON.
    """
    decoder = msgspec.json.Decoder(list[of])  # type: ignore[valid-type]
    start = 0
    for piece in pieces:
        try:
            batch: list[Record] = decoder.decode(piece)
        except (ValueError, RecursionError):
            first = start
            batch = typed(json.loads(piece), of, expected, lambda n: place(first + n))  # noqa: B023 used at once
        yield batch
        start += len(batch)


def typed(entries: list[Any], of: type[Record], expected: Expected, place: Place) -> list[Record]:
    """Typed records from decoded JSON; NaN, which Python's own json writes, passes here.

    Raises
    ------
    PredictionsError
        Naming the first entry that does not fit, its image, the field, its value and what was expected.
    """
    try:
        return msgspec.convert(entries, list[of])  # type: ignore[valid-type]
    except msgspec.ValidationError as error:
        problem, _, path = str(error).rpartition(" - at `$")
    n, *steps = (int(index) if index else name for index, name in re.findall(r"\[(\d+)\]|\.(\w+)", path))
    entry = entries[n]
    if type(entry) is not dict:
        raise PredictionsError(f"{place(n)} is {kind(entry)}, expected an object")
    where = f"{place(n)} (image_id {short(entry['image_id'])})" if "image_id" in entry else place(n)
    if not steps:
        lacking, name = re.findall("(missing|unknown).* field `(.*)`", problem)[0]
        if lacking == "missing":
            raise PredictionsError(f"{where}: no {name}, expected {expected[name]}")
        raise PredictionsError(
            f"{where}: unknown key {name!r}, expected {', '.join(k for k in expected if k[-1] != ']')}"
        )
    name, index = str(steps[0]), steps[1:2]
    if index and f"{name}[]" in expected:
        value, what = entry[name][index[0]], expected[f"{name}[]"]
        raise PredictionsError(f"{where}: {name}[{index[0]}] is {short(value)}, expected {what}")
    raise PredictionsError(f"{where}: {name} is {short(entry[name])}, expected {expected[name]}")


def parse(data: bytes, place: str) -> Any:
    """Decode JSON, and what Python's json.dump writes for NaN too.

    Raises
    ------
    PredictionsError
    """
    try:
        return msgspec.json.decode(data)
    except (ValueError, RecursionError) as error:
        problem = str(error)
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        raise PredictionsError(f"{place} is cut off or no JSON ({problem})") from None


def kind(value: object) -> str:
    """What JSON calls the type of a value."""
    names = {dict: "an object", list: "a list", str: "a text", bool: "a truth value", type(None): "missing or null"}
    return names.get(type(value), "a number")


def short(value: object) -> str:
    """At most 60 characters of a value."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


@contextmanager
def without_gc() -> Iterator[None]:
    """Pause the garbage collector, which would walk through millions of new objects again and again."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()
