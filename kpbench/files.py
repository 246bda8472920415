"""What several modules read: TOML tables, folders of images, and folders that are URLs."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from kpbench.errors import DataError, KpbenchError

__all__ = ["IMAGE_SUFFIXES", "folder_at", "image_files", "is_local", "read_text", "read_toml"]

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".gif", ".ppm", ".pgm", ".jp2")


def image_files(folder: Path) -> tuple[str, ...]:
    """Paths of all images below a folder, relative to it and sorted, so that they are the same on every machine."""
    return tuple(
        sorted(f.relative_to(folder).as_posix() for f in folder.rglob("*") if f.suffix.lower() in IMAGE_SUFFIXES)
    )


def read_toml(path: str | Path, error: type[KpbenchError]) -> dict[str, Any]:
    """The table of a TOML file.

    Raises
    ------
    error
        One line that names the file, if it cannot be read or is no TOML.
    """
    try:
        return tomllib.loads(read_text(path, error))
    except tomllib.TOMLDecodeError as problem:
        raise error(f"{path}: not valid TOML ({problem})") from None


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
