"""What several modules read from disk: TOML tables, and folders of images."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from kpbench.errors import KpbenchError

__all__ = ["IMAGE_SUFFIXES", "image_files", "read_toml"]

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
        return tomllib.loads(Path(path).read_text("utf-8"))
    except OSError as problem:
        raise error(f"{path}: cannot be read, {problem.strerror}") from None
    except UnicodeDecodeError:
        raise error(f"{path}: cannot be read, not UTF-8 text") from None
    except tomllib.TOMLDecodeError as problem:
        raise error(f"{path}: not valid TOML ({problem})") from None
