"""Files: read as TOML or text, found as images, written whole or not at all; and folders that are URLs."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import unquote

from kpbench.errors import DataError, KpbenchError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".gif", ".ppm", ".pgm", ".jp2")

PACKAGE = Path(__file__).parent
"""The folder of this package."""
_IN_CHECKOUT = {"patches": "patches", "suites": "benchmarks/suites", "configs": "configs"}


def shipped_folder(name: str) -> Path:
    """Find data that ships with kpbench: ``patches``, ``suites`` or ``configs``.

    In a checkout they lie where people edit them, in an installed package all in one folder.
    """
    installed = PACKAGE / "shipped" / name
    return installed if installed.is_dir() else PACKAGE.parent / _IN_CHECKOUT[name]


def image_files(folder: Path, but: Path | None = None) -> tuple[str, ...]:
    """Paths of all images below a folder, relative to it and sorted, so that they are the same on every machine.

    What lies in the folder ``but``, where results are written, is left out.
    """
    files = [f for f in folder.rglob("*") if f.suffix.lower() in IMAGE_SUFFIXES and f.is_file()]
    if but is not None:
        files = [f for f in files if but.resolve() not in f.resolve().parents]
    return tuple(sorted(f.relative_to(folder).as_posix() for f in files))


def read_text(path: str | Path, error: type[KpbenchError]) -> str:
    """The text of a UTF-8 file.

    Raises
    ------
    error
        One line that names the file, if it cannot be read.
    """
    try:
        return Path(path).read_text("utf-8")
    except OSError as problem:
        raise error(f"{path}: cannot be read, {problem.strerror}") from None
    except UnicodeDecodeError:
        raise error(f"{path}: cannot be read, not UTF-8 text") from None


def sha256_of(path: Path) -> str:
    """Compute the SHA-256 of a file, as 64 hexadecimal digits.

    Raises
    ------
    DataError
        If the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"{path}: cannot be read, {error.strerror}") from None


def folder_at(where: str | Path) -> Path:
    """A folder of this machine, or one that fsspec reaches by a URL such as ``s3://bucket/name``, used like a path.

    Raises
    ------
    DataError
        If it is a URL and what it takes to reach it is not installed.
    """
    if not is_local(where):
        return where  # type: ignore[return-value]
    url = re.match(r"([a-z][a-z0-9+.-]+):/+(.*)", str(where))  # pathlib makes one slash of two
    if url is None:
        return Path(where)
    if url[1] == "file":
        return Path("/", unquote(url[2]))
    try:
        from upath import UPath

        folder = UPath(f"{url[1]}://{url[2]}")
        assert folder.fs is not None  # looks for the file system's own package
    except (ImportError, ValueError) as error:
        said = " ".join(str(error).split())
        raise DataError(f"{url[0]}: cannot be reached ({said}); pip install 'kpbench[remote]'") from None
    return folder  # type: ignore[return-value]


def is_local(path: object) -> bool:
    """Whether a path is one of this machine's file system, and not a URL's."""
    return isinstance(path, (str, Path))


def refuse_overwrite(targets: Iterable[Path | None], sources: Iterable[Path] = ()) -> None:
    """Refuse to write a file that the same command reads, or writes twice.

    Raises
    ------
    DataError
        Naming it.
    """
    taken = {path.resolve() for path in sources}
    for target in targets:
        if target is None:
            continue
        if target.resolve() in taken:
            raise DataError(f"{target}: this command reads it, or writes it twice; name another file to write")
        taken.add(target.resolve())


def require_own_folder(folder: Path, mark: str, what: str) -> None:
    """Refuse to write among other files: a folder must be new, empty, or hold ``mark`` from an earlier run.

    Raises
    ------
    DataError
        Naming one of the other files; or the folder, if it is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{folder}: a file, expected a folder")
    others = sorted(path.name for path in folder.glob("*") if not path.name.startswith("."))
    if others and not (folder / mark).exists():
        raise DataError(f"{folder}: holds other files ({others[0]}, ...), expected a new or an empty folder for {what}")


def make_folder(folder: Path) -> Path:
    """Make a folder and those above it unless they exist, and return it.

    Raises
    ------
    DataError
        If the folder cannot be made. The message names it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made, {error.strerror}") from None
    return folder


def write_atomic(path: Path, data: bytes | memoryview) -> None:
    """Write a file whole or not at all: temporary sibling, fsync, rename, fsync of the folder.

    Under a URL it is put in one piece, which object stores do whole or not at all.

    Raises
    ------
    DataError
        If the disk is full or the folder cannot be written; nothing is left behind.
    """
    if not is_local(path):
        with _reaching(path):
            path.write_bytes(bytes(data))
        return
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(name, 0o644)
            os.replace(name, path)
        except BaseException:
            with suppress(OSError):
                os.unlink(name)
            raise
        with suppress(OSError):  # not every file system lets a folder be opened
            folder = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    except OSError as error:
        why = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else error.strerror
        raise DataError(f"{path}: cannot be written, {why}") from None


@contextmanager
def _reaching(path: Path) -> Iterator[None]:
    """Turn whatever a remote file system raises into one line."""
    try:
        yield
    except Exception as error:
        raise DataError(f"{path}: cannot be written ({' '.join(str(error).split())[:160]})") from None
