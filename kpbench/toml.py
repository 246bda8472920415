"""Strict reading of TOML: an unknown key or a wrong value raises an error that names the key and the expected value."""

from __future__ import annotations

import math
import re
import sys
import tomllib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kpbench.errors import KpbenchError
from kpbench.files import read_text
from kpbench.text import NAME_RULE, did_you_mean, is_name

LARGEST = sys.float_info.max
"""Largest number that is read. Python's whole numbers have no limit, but numbers with a fraction have."""
DEEPEST_KEY = 50
"""Largest number of parts of a dotted key, such as ``a.b.c``."""
DEEP_KEY = re.compile(rf"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){{{DEEPEST_KEY}}}""")
MOST_ENTRIES = 10_000
"""Largest number of entries of a list of tables."""


def read_toml(path: str | Path, error: type[KpbenchError]) -> dict[str, Any]:
    """Return the content of a TOML file.

    Raises
    ------
    error
        If the file cannot be read or is no TOML. The message names the file.
    """
    text = read_text(path, error)
    if DEEP_KEY.search(text):  # tomllib takes gigabytes for a key of a hundred thousand parts
        raise error(f"{path}: not valid TOML (it has a key of over {DEEPEST_KEY} parts)")
    try:
        return tomllib.loads(text)
    except ValueError as problem:  # TOMLDecodeError, or a number of thousands of digits
        raise error(f"{path}: not valid TOML ({problem})") from None
    except RecursionError:
        raise error(f"{path}: not valid TOML (it is nested too deeply)") from None


@contextmanager
def name_source(source: str | Path, error: type[KpbenchError]) -> Iterator[None]:
    """Put the name of a file before the message of each :class:`KpbenchError`, and raise the message as ``error``."""
    try:
        yield
    except KpbenchError as problem:
        raise error(f"{source}: {problem}") from None


@dataclass(frozen=True)
class TomlTable:
    """A table whose keys are known.

    A method returns the checked value of a key. If the table lacks the key, the method returns the default, or raises
    an error if the method has no default.

    Attributes
    ----------
    values : mapping
        The table as it was read.
    known : collection of str
        All keys that the table may have.
    error : type of KpbenchError
        Raised for an unknown key or a wrong value. The message does not name the file, see :func:`name_source`.
    place : str
        Name of the table within the file, such as ``keypoint[3]``; "" for the file itself.
    """

    values: Mapping[str, Any]
    known: Collection[str]
    error: type[KpbenchError]
    place: str = ""

    def __post_init__(self) -> None:
        names = ", ".join(self.known)
        if not isinstance(self.values, Mapping):
            raise self.error(f"{self.place or 'the file'} is {_show(self.values)}, expected a table with: {names}")
        for key in self.values:
            if key not in self.known:
                within = f" in {self.place}" if self.place else ""
                close = did_you_mean(key, self.known)
                raise self.error(f"unknown key {key!r}{within}; known are: {names}{close}")

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def path(self, key: str) -> str:
        """Return the name of a value within the file, such as ``keypoint[3].x_mm``."""
        return f"{self.place}.{key}" if self.place else key

    def problem(self, key: str, expected: str) -> KpbenchError:
        """Return the error for the wrong value of a key. The caller raises the error."""
        value = _show(self.values[key]) if key in self.values else "missing"
        return self.error(f"{self.path(key)} is {value}, expected {expected}")

    def require_schema(self, schema: str, optional: bool = False) -> None:
        """Raise an error unless the key ``schema`` holds the given text. If ``optional``, the key may be missing."""
        if self.values.get("schema", schema if optional else None) != schema:
            raise self.problem("schema", repr(schema))

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text that is not empty."""
        value = self.values.get(key, default)
        if not isinstance(value, str) or not value:
            raise self.problem(key, "a non-empty text")
        return value

    def name(self, key: str = "name", default: str | None = None) -> str:
        """Return a name, which may become a part of a path. See :func:`kpbench.text.is_name`."""
        value = self.values.get(key, default)
        if not is_name(value):
            raise self.problem(key, NAME_RULE)
        return str(value)

    def choice(self, key: str, choices: Collection[str], default: str | None = None) -> str:
        """Return a text that is one of the choices."""
        value = self.values.get(key, default)
        if not isinstance(value, str) or value not in choices:
            raise self.problem(key, f"one of: {', '.join(choices)}")
        return value

    def flag(self, key: str) -> bool:
        """Return a value that is true or false."""
        value = self.values.get(key)
        if not isinstance(value, bool):
            raise self.problem(key, "true or false")
        return value

    def number(self, key: str, low: float, high: float = math.inf, default: float | None = None) -> float:
        """Return a finite number from ``low`` to ``high``."""
        return self._number(key, self.values.get(key, default), low, high)

    def whole_number(self, key: str, low: int, high: float = math.inf) -> int:
        """Return a whole number from ``low`` to ``high``."""
        return int(self._number(key, self.values.get(key), low, high, whole=True))

    def numbers(
        self, key: str, low: float, high: float = math.inf, count: int | None = None, whole: bool = False
    ) -> tuple[float, ...]:
        """Return numbers from ``low`` to ``high``. If ``count`` is given, the list must have this length."""
        value = self.values.get(key)
        if not isinstance(value, list | tuple) or count not in (None, len(value)):
            raise self.problem(key, f"a list of {'' if count is None else f'{count} '}numbers")
        return tuple(self._number(f"{key}[{n}]", entry, low, high, whole) for n, entry in enumerate(value))

    def span(self, key: str, low: float, high: float) -> tuple[float, float]:
        """Return (least, most). The file holds ``[least, most]``, or one number that is both least and most."""
        if not isinstance(self.values.get(key), list):
            value = self.number(key, low, high)
            return value, value
        least, most = self.numbers(key, low, high, 2)
        if least > most:
            raise self.problem(key, "[least, most]")
        return least, most

    def entries(self, key: str, expected: str) -> list[Any]:
        """Return a list that is not empty. Its entries are not checked."""
        value = self.values.get(key)
        if not isinstance(value, list) or not value:
            raise self.problem(key, expected)
        return value

    def table(self, key: str, known: Collection[str], default: Mapping[str, Any] | None = None) -> TomlTable:
        """Return the table under a key."""
        return TomlTable(self.values.get(key, default), known, self.error, self.path(key))

    def tables(self, key: str, known: Collection[str], most: int = MOST_ENTRIES) -> list[TomlTable]:
        """Return the list of tables under a key, with at most ``most`` entries."""
        value = self.values.get(key)
        if not isinstance(value, list | tuple):
            raise self.problem(key, f"a list of tables with: {', '.join(known)}")
        if len(value) > most:
            raise self.error(f"{self.path(key)} has {len(value)} entries, expected at most {most}")
        return [TomlTable(entry, known, self.error, f"{self.path(key)}[{n}]") for n, entry in enumerate(value)]

    def _number(self, key: str, value: object, low: float, high: float, whole: bool = False) -> float:
        limits = f"from {low:.10g}" if high == math.inf else f"from {low:.10g} to {high:.10g}"
        problem = f"{self.path(key)} is {'missing' if value is None else _show(value)}"
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise self.error(f"{problem}, expected a {'whole ' * whole}number {limits}")
        if abs(value) > LARGEST or (whole and value % 1):
            raise self.error(f"{problem}, expected a {'whole' if whole else 'finite'} number {limits}")
        return int(value) if whole else float(value)


def _show(value: object) -> str:
    """Return a value as an error message shows it."""
    try:
        return repr(value)
    except (RecursionError, ValueError):  # nested too deeply, or a number of thousands of digits
        return "..."
