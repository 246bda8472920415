"""Resuming a run: which shards of an earlier run are kept."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kpbench.dataset.card import CARD_FILES
from kpbench.dataset.folder import MANIFEST, ShardEntry
from kpbench.dataset.shard import canonical_json, open_shard
from kpbench.errors import DataError
from kpbench.files import load_json, read_bytes, sha256_of
from kpbench.writing import is_replaceable, remove_file, remove_leftovers, require_removable, require_writable

MOST_SHARDS = 4_000_000
"""Largest number of shards of a dataset."""
LONGEST_VALUE = 40
"""An error message shows two different values of a key only if each value has fewer characters than this."""
REMEDY = "; pass `overwrite=True` to replace it, or another `out`"
"""What a user can do about a folder that holds another dataset."""


def recorded_digests(folder: Path) -> dict[str, str]:
    """Return each shard's SHA-256 from the manifest, by file name. Return {} if the manifest cannot be read."""
    try:
        shards = load_json(read_bytes(folder / MANIFEST, is_noted=False).decode())["shards"]
        return {str(shard["file"]): str(shard["sha256"]) for shard in shards}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


@dataclass(frozen=True)
class PlannedShard:
    """A shard to make: its file name, its first image, and its number of images."""

    file: str
    first: int
    count: int


@dataclass(frozen=True)
class FinishedShard:
    """A finished shard, and the background files that could not be decoded for it."""

    entry: ShardEntry
    broken_files: tuple[str, ...]


@dataclass(frozen=True)
class ShardHead:
    """The dataset's config as JSON, the background files that could not be decoded, and the image IDs of a shard."""

    config: str
    broken_files: tuple[str, ...]
    images: range


def plan_shards(n: int, shard_size: int) -> list[PlannedShard]:
    """List all shards of a dataset of n images."""
    firsts = range(0, n, shard_size)
    if len(firsts) > MOST_SHARDS:
        raise DataError(f"`n` is {n}: {len(firsts)} shards of {shard_size} images, expected at most {MOST_SHARDS}")
    return [PlannedShard(f"shard-{k:05d}.h5", first, min(shard_size, n - first)) for k, first in enumerate(firsts)]


def refuse_resume_with_overwrite(resume: bool, overwrite: bool) -> None:
    """Raise an error if both are set: the one keeps the finished shards that the other deletes.

    Raises
    ------
    DataError
        The message names both parameters.
    """
    if resume and overwrite:
        raise DataError("`resume=True` and `overwrite=True` exclude each other, expected one of them")


def prepare_folder(
    folder: Path, config: dict[str, Any], plan: Sequence[PlannedShard], resume: bool, overwrite: bool
) -> dict[str, FinishedShard]:
    """Check what a folder holds, delete what a run replaces, and return the finished shards that the run keeps.

    Parameters
    ----------
    folder : Path
    config : dict
        Config of the dataset.
    plan : sequence of PlannedShard
        The shards of the run: all shards of the dataset, or a part.
    resume, overwrite : bool
        See :func:`kpbench.generate`.

    Returns
    -------
    dict
        The finished shards by their file names.

    Raises
    ------
    DataError
        If the folder holds files, but neither a manifest nor shards. If the folder holds a manifest or planned shards,
        and neither ``resume`` nor ``overwrite`` is set. If kpbench did not write the manifest. If a shard belongs to
        another dataset or is damaged.
    """
    manifest, names = folder / MANIFEST, {shard.file for shard in plan}
    entries = [path for path in folder.glob("*") if not path.name.startswith(".")]
    present = [path for path in entries if re.fullmatch(r"shard-\d{5,}\.h5", path.name)]
    if entries and not present and not manifest.exists():
        raise DataError(f"{folder}: holds other files ({entries[0].name}, ...), expected a new or an empty folder")
    planned = [path for path in present if path.name in names]
    is_whole = len(plan) == len(plan_shards(config["n"], config["shard_size"]))
    concerned = present if is_whole else planned
    if overwrite:
        for path in [manifest, *concerned]:  # all of them are looked at before the first is removed
            require_removable(path, "dataset")
        for path in [manifest, *concerned]:
            remove_file(path, "dataset")
        for name, kind in zip(CARD_FILES, ("card", "picture"), strict=True):
            if is_replaceable(folder / name, kind):
                remove_file(folder / name, kind)
    elif not resume and (manifest.exists() or planned):
        problem = "already holds a dataset" if manifest.exists() else "holds an unfinished dataset"
        remedy = "add `resume=True` to finish it, `overwrite=True` to replace it, or another `out`"
        raise DataError(f"{folder}: {problem}; {remedy}")
    else:
        require_writable(manifest, "dataset")  # which would be refused after all shards are made
    remove_leftovers(folder / name for name in names)
    if not resume:
        return {}
    for path in concerned:
        if path.name not in names:
            raise DataError(f"{path}: of another dataset{REMEDY}")
    return find_finished_shards(folder, config, plan, REMEDY)


def find_finished_shards(
    folder: Path, config: dict[str, Any], plan: Sequence[PlannedShard], remedy: str = ""
) -> dict[str, FinishedShard]:
    """Find the planned shards that a folder holds, and check each of these shards.

    Parameters
    ----------
    folder : Path
    config : dict
        Config of the dataset.
    plan : sequence of PlannedShard
    remedy : str
        Text to append to the message about a shard of another dataset.

    Returns
    -------
    dict
        The finished shards by their file names.

    Raises
    ------
    DataError
        If a shard belongs to another dataset or holds other images, or is damaged. Damage of pixels is found only if
        the folder has a manifest, which records the digest of each shard.
    """
    digests = recorded_digests(folder)
    finished: dict[str, FinishedShard] = {}
    for planned in plan:
        path = folder / planned.file
        if not path.exists():
            continue
        head = read_shard_head(path)
        if head.config != canonical_json(config) or head.images != range(planned.first, planned.first + planned.count):
            difference = first_difference(load_json(head.config), config)
            raise DataError(f"{path}: of another dataset{difference}{remedy}")
        entry = ShardEntry(planned.file, planned.first, planned.count, path.stat().st_size, sha256_of(path))
        if digests.get(planned.file, entry.sha256) != entry.sha256:
            raise DataError(f"{path}: damaged since it was written; delete it, and resume the run that makes it")
        finished[planned.file] = FinishedShard(entry, head.broken_files)
    return finished


def read_shard_head(path: Path) -> ShardHead:
    """Open a shard, and return the facts that tell to which dataset and to which place in it the shard belongs."""
    with open_shard(path) as file:
        ids = file["image_id"][:]
        broken_files = tuple(load_json(file.texts["broken_backgrounds"]))
        return ShardHead(file.texts["config"], broken_files, range(int(ids[0]), int(ids[-1]) + 1))


def first_difference(found: dict[str, Any], expected: dict[str, Any]) -> str:
    """Describe the first key whose value differs between two configs. Return "" if the configs agree.

    If the value is a table in both configs, the first different key of the table is described.
    """
    for key in expected:
        if found.get(key) != expected[key]:
            if isinstance(found.get(key), dict) and isinstance(expected[key], dict):
                return first_difference(found[key], expected[key])
            values = [str(config.get(key)) for config in (found, expected)]
            is_short = max(map(len, values)) < LONGEST_VALUE
            return f" ({key} is {values[0]} there, {values[1]} here)" if is_short else f" ({key} differs)"
    return ""


@contextmanager
def name_folder_in_errors(folder: Path) -> Iterator[None]:
    """Make errors begin with the folder's name as the user wrote it."""
    try:
        yield
    except DataError as error:
        message = str(error).replace(str(folder.resolve()), str(folder))
        raise DataError(message if message.startswith(str(folder)) else f"{folder}: {message}") from None


@contextmanager
def add_resume_hint(folder: Path) -> Iterator[None]:
    """Make errors say how to resume the run, if the folder holds finished shards."""
    try:
        with name_folder_in_errors(folder):
            yield
    except DataError as error:
        has_shards = any(folder.glob("shard-*.h5"))
        hint = "; finished shards are kept, add `resume=True` to go on" if has_shards else ""
        raise DataError(f"{error}{hint}") from None
