"""What an earlier run left: which shards stay, what differs, and who else is writing."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from kpbench.dataset.folder import ShardEntry, recorded_digests
from kpbench.dataset.shard import attribute, canonical_json, open_shard
from kpbench.errors import DataError
from kpbench.files import is_local, sha256_of

LOCK = ".kpbench.lock"


def keep_shards(folder: Path, written: dict[str, Any], plan: list[Piece]) -> dict[str, Result]:
    """Those shards of a plan that are there, after a look into each; if the dataset was finished, byte by byte."""
    known = recorded_digests(folder)
    kept: dict[str, Result] = {}
    for name, first, count in plan:
        path = folder / name
        if path.exists():
            config, broken, images = read_head(path)
            if config != canonical_json(written) or images != range(first, first + count):
                why = first_difference(json.loads(config), written)
                raise DataError(
                    f"{path}: of another dataset than this command makes{why}; use --overwrite or another --out"
                )
            entry = ShardEntry(name, first, count, path.stat().st_size, sha256_of(path))
            if known.get(name, entry.sha256) != entry.sha256:
                raise DataError(f"{path}: damaged since it was written; delete it, and --resume makes it again")
            kept[name] = (entry, broken)
    return kept


def read_head(path: Path) -> tuple[str, tuple[str, ...], range]:
    """A shard's config as text, its broken backgrounds, and which images it holds."""
    with open_shard(path) as file:
        ids = file["image_id"][:]
        broken = tuple(json.loads(attribute(file, "broken_backgrounds")))
        return attribute(file, "config"), broken, range(int(ids[0]), int(ids[-1]) + 1)


def first_difference(there: dict[str, Any], here: dict[str, Any]) -> str:
    """The first option in which two configs differ, for people; of a table, the first entry."""
    for key in here:
        if there.get(key) != here[key]:
            if isinstance(there.get(key), dict) and isinstance(here[key], dict):
                return first_difference(there[key], here[key])
            values = [str(config.get(key)) for config in (there, here)]
            said = f" is {values[0]} there, {values[1]} here" if max(map(len, values)) < 40 else " differs"
            return f" ({key}{said})"
    return ""


@contextmanager
def naming_folder(folder: Path) -> Iterator[None]:
    """Let errors name the folder as the user does."""
    try:
        yield
    except DataError as error:
        said = str(error).replace(str(folder.resolve()), str(folder))
        raise DataError(said if said.startswith(str(folder)) else f"{folder}: {said}") from None


@contextmanager
def telling_how_to_resume(folder: Path) -> Iterator[None]:
    """Let errors say how to go on, too, where something is there to go on from."""
    try:
        with naming_folder(folder):
            yield
    except DataError as error:
        kept = "; finished shards are kept, add --resume to go on" if any(folder.glob("shard-*.h5")) else ""
        raise DataError(f"{error}{kept}") from None


@contextmanager
def lock_folder(folder: Path, shared: bool = False) -> Iterator[None]:
    """Hold the folder against another run; the lock ends with the process, however that ends.

    Runs of a part of the shards share it with each other.
    """
    try:
        import fcntl
    except ImportError:  # Windows has no flock; there the check is left out
        yield
        return
    if not is_local(folder):  # nor has an object store
        yield
        return
    path = folder / LOCK
    try:
        file = path.open("w")
    except OSError as error:
        raise DataError(f"{path}: cannot be written, {error.strerror}") from None
    with file:
        try:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            if not os.path.samestat(os.fstat(file.fileno()), path.stat()):  # unlinked between open and lock
                raise OSError
        except OSError:
            raise DataError(f"{folder}: another kpbench run is writing to it") from None
        try:
            yield
        finally:
            if not shared:
                path.unlink(missing_ok=True)


Piece = tuple[str, int, int]
"""(file, first image, number of images) of a shard."""


Result = tuple[ShardEntry, tuple[str, ...]]
"""A finished shard, and the background files that could not be decoded for it."""
