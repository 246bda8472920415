"""Files and folders: find images, read text, use a URL as a folder."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path, PureWindowsPath
from typing import Any, cast
from urllib.parse import unquote

from kpbench.errors import DataError, KpbenchError, UnreadableFile, system_reason
from kpbench.text import did_you_mean

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".gif", ".ppm", ".pgm", ".jp2")
LARGEST_FILE = 2**31
"""Largest accepted number of bytes of a file that is read as a whole."""
LARGEST_TEXT = 2**22
"""Largest accepted number of bytes of a design, a board, a suite, a recipe or a pipeline."""

PACKAGE = Path(__file__).parent
"""Folder of this package."""
_IN_CHECKOUT = {"patches": "patches", "suites": "benchmarks/suites", "configs": "configs", "cameras": "cameras"}


def shipped_folder(name: str) -> Path:
    """Return the folder of data that ships with kpbench: ``patches``, ``suites``, ``configs`` or ``cameras``.

    A checkout holds the data in the folders where people edit them. An installed package holds all data in one folder.
    """
    installed = PACKAGE / "shipped" / name
    return installed if installed.is_dir() else PACKAGE.parent / _IN_CHECKOUT[name]


def find_shipped(kind: str, name: str, word: str) -> Path:
    """Return the TOML file of a shipped name, or the path of a TOML file of the user's.

    ``kind`` : ``suites`` or ``cameras``. ``word`` : what the file describes, for the message.

    Raises
    ------
    DataError
        If the name is not among the shipped names and does not end in .toml.
    """
    shipped = shipped_files(kind)
    if name not in shipped and Path(name).suffix != ".toml":
        raise DataError(
            f"there is no {word} {name!r}, only: {', '.join(shipped)}, or a {FILES_OF_ONES_OWN[kind]} file of your own"
            f"{did_you_mean(name, shipped)}"
        )
    return shipped.get(name, Path(name))


FILES_OF_ONES_OWN = {"suites": ".toml", "cameras": ".toml, .yaml or .json"}
"""Which files of the user's may stand for a shipped name."""


def shipped_files(kind: str) -> dict[str, Path]:
    """Return the TOML files of one kind that ship with kpbench, keyed by their names."""
    return {path.stem: path for path in sorted(shipped_folder(kind).glob("*.toml"))}


def image_files(folder: Path, exclude: Path | None = None) -> tuple[str, ...]:
    """Return the paths of all images below a folder, relative to the folder.

    The paths are sorted. Every machine therefore gives the same order. Images below the folder ``exclude``, a folder of
    results, are left out.
    """
    files = [f for f in folder.rglob("*") if f.suffix.lower() in IMAGE_SUFFIXES and f.is_file()]
    if exclude is not None:
        files = [f for f in files if exclude.resolve() not in f.resolve().parents]
    return tuple(sorted(f.relative_to(folder).as_posix() for f in files))


_read: ContextVar[set[tuple[int, int]] | None] = ContextVar("read", default=None)
"""Device and inode of each file that the running command has read; None outside of commands."""


@contextmanager
def protect_read_files() -> Iterator[None]:
    """Make :func:`kpbench.writing.write_file` refuse to replace a file that the same ``with`` block has read."""
    token = _read.set(set())
    try:
        yield
    finally:
        _read.reset(token)


def note_read(path: str | Path) -> None:
    """Note that the running command reads a file. :func:`open_file` notes every file that it opens."""
    noted = _read.get()
    if noted is not None:
        with suppress(OSError, ValueError):
            found = os.stat(path)
            noted.add((found.st_dev, found.st_ino))


def is_read(path: Path) -> bool:
    """Return whether the running command has read a file, under this name or another."""
    found = path.stat()
    return (found.st_dev, found.st_ino) in (_read.get() or ())


def open_file(path: str | Path, is_noted: bool = True) -> io.BufferedReader:
    """Open a regular file for reading, and note that it is read. Every file of the user's is opened here.

    ``is_noted`` : False for a file that the running command may replace later.

    A device may have no end, and a pipe may have no beginning. Both are refused, also behind a symbolic link.

    Raises
    ------
    OSError
        If the file cannot be opened.
    UnreadableFile
        If the path names no regular file.
    """
    if not is_local(path):
        return cast(Path, path).open("rb")
    if is_noted:
        note_read(path)
    _require_regular(os.stat(path).st_mode)  # opening some devices does something
    # without O_NONBLOCK, a pipe that has taken the file's place since then would block
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        _require_regular(os.fstat(descriptor).st_mode)
    except BaseException:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def _require_regular(mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(mode):
        kind = "pipe" if stat.S_ISFIFO(mode) else "socket" if stat.S_ISSOCK(mode) else "device"
        raise UnreadableFile(f"it is a {kind}, expected a file")


def read_bytes(path: str | Path, most: int = LARGEST_FILE, is_noted: bool = True) -> bytes:
    """Return the content of a regular file.

    Raises
    ------
    OSError
        If the file cannot be read.
    UnreadableFile
        If the path names no regular file, or a file of more than ``most`` bytes.
    """
    with open_file(path, is_noted) as file:
        size = os.fstat(file.fileno()).st_size if is_local(path) else 0
        data = (file.read(size + 1 if size else -1) or b"") if size <= most else b""  # read(n) takes memory for n bytes
    if max(size, len(data)) > most:
        raise UnreadableFile(f"it has more than {most} bytes")
    return data


def read_text(path: str | Path, error: type[KpbenchError]) -> str:
    """Return the text of a UTF-8 file.

    Raises
    ------
    error
        If the file cannot be read. The message names the file.
    """
    try:
        return read_bytes(path, LARGEST_TEXT).decode()
    except OSError as problem:
        raise error(f"{path}: cannot be read, {system_reason(problem) or problem}") from None
    except UnicodeDecodeError:
        raise error(f"{path}: cannot be read, not UTF-8 text") from None
    except ValueError:  # such as a NUL in the name
        raise error(f"{str(path)!r}: no file can have this name") from None


class DoubleKeyError(ValueError):
    """An object of a JSON text has a key twice. Readers disagree which of the two values counts."""


def _require_single_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        double = next(key for n, key in enumerate(keys) if key in keys[:n])
        start = ", ".join(f"{key!r}: {str(value)[:20]}" for key, value in pairs[:2])
        raise DoubleKeyError(f"the key {double!r} is there twice in {{{start[:80]}, ...}}")
    return content


def load_json(text: str | bytes) -> Any:
    """Return the content of a JSON text.

    Raises
    ------
    ValueError
        If the text is no JSON, or is nested too deeply. If an object has a key twice (:class:`DoubleKeyError`).
    """
    try:
        return json.loads(text, object_pairs_hook=_require_single_keys)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def encode_utf8(text: str) -> bytes:
    r"""Encode text as UTF-8. What is no text becomes an escape such as ``\udcff``: bytes of file names, surrogates."""
    return text.encode(errors="backslashreplace")


def escape_surrogates(content: Any) -> Any:
    """Return the content of a JSON file with all its texts as :func:`encode_utf8` would write them."""
    if isinstance(content, str):
        return encode_utf8(content).decode()
    if isinstance(content, Mapping):
        return {escape_surrogates(key): escape_surrogates(value) for key, value in content.items()}
    return [*map(escape_surrogates, content)] if isinstance(content, list | tuple) else content


def require_readable(path: Path, error: type[KpbenchError] = DataError) -> None:
    """Note that a file is read, and refuse a file that cannot be opened, for libraries that do not say why.

    Raises
    ------
    error
        If the file cannot be opened. The message names the file and the reason.
    """
    try:
        open_file(path).close()
    except OSError as problem:
        raise error(f"{path}: cannot be read, {system_reason(problem) or problem}") from None


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file as 64 hexadecimal digits.

    Raises
    ------
    DataError
        If the file cannot be read.
    """
    try:
        with open_file(path, is_noted=False) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"{path}: cannot be read, {system_reason(error) or error}") from None


def folder_at(place: str | Path) -> Path:
    """Return the folder at a path, or at a URL such as ``s3://bucket/name``.

    fsspec reads and writes folders at URLs. The result behaves like a path, also for a URL.

    Raises
    ------
    DataError
        If the package that reaches this kind of URL is not installed.
    """
    if not is_local(place):
        return place  # type: ignore[return-value]
    url = re.match(r"([a-z][a-z0-9+.-]+):/+(.*)", str(place))  # Path turns "//" into "/"
    if url is None:
        return Path(place)
    if url[1] == "file":
        return Path("/", unquote(url[2]))
    try:
        from upath import UPath

        folder = UPath(f"{url[1]}://{url[2]}")
        assert folder.fs is not None  # imports the package of this kind of URL
    except (ImportError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{url[0]}: cannot be reached ({reason}); pip install 'kpbench[remote]'") from None
    return folder  # type: ignore[return-value]


def path_below(folder: Path, name: str) -> Path:
    """Return the path of a file below a folder, for a relative path that a file of data names.

    Raises
    ------
    DataError
        If the path is absolute, has ``..`` or a drive letter, or leads out of the folder over a symbolic link.
    """
    path, parts = folder / name, PureWindowsPath(name)  # both separators, also on Linux
    try:
        os.fsencode(name)
        is_below = "\0" not in name and path.resolve().is_relative_to(folder.resolve())
    except UnicodeEncodeError:  # half of a surrogate pair: no file can have this name
        is_below = False
    if parts.anchor or ".." in parts.parts or not is_below:
        raise DataError(f"{name!r} is not read, expected a file below {folder}")
    return path


def is_local(path: object) -> bool:
    """Return whether a path belongs to the file system of this machine. A path at a URL does not."""
    return isinstance(path, (str, Path))


def refuse_overwrite(targets: Iterable[Path | None], sources: Iterable[Path] = ()) -> None:
    """Raise an error if a target is one of the sources, or if two targets are the same file.

    Raises
    ------
    DataError
        The message names the target.
    """
    taken = {path.resolve() for path in sources}
    for target in targets:
        if target is None:
            continue
        if target.resolve() in taken:
            raise DataError(f"{target}: this command reads it, or writes it twice; name another file to write")
        taken.add(target.resolve())


def require_own_folder(folder: Path, marks: Sequence[str], purpose: str) -> None:
    """Raise an error unless a folder is new, is empty, or holds one of the files ``marks`` of an earlier run.

    Raises
    ------
    DataError
        The message names a file in the folder, or says that the path is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{folder}: a file, expected a folder")
    others = sorted(path.name for path in folder.glob("*") if not path.name.startswith("."))
    if others and not any((folder / mark).exists() for mark in marks):
        raise DataError(
            f"{folder}: holds other files ({others[0]}, ...), expected a new or an empty folder for {purpose}"
        )


def make_folder(folder: Path) -> Path:
    """Make a folder and its parents unless they exist, and return the folder.

    Raises
    ------
    DataError
        If the folder cannot be made. The message names the folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made, {system_reason(error) or error}") from None
    return folder
