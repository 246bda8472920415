"""Make datasets: plan the shards, keep the finished ones, have the others made, write the manifest last.

A shard is a function of (config, its place) and of nothing else, so it does not matter which process makes it, when,
or in which run: an interrupted run is finished, and parts made elsewhere are put together, by the same rule.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

from kpbench.dataset import card
from kpbench.dataset.folder import MANIFEST, Dataset, ShardEntry, open_dataset, write_manifest
from kpbench.dataset.resume import (
    Piece,
    Result,
    keep_shards,
    lock_folder,
    naming_folder,
    read_head,
    telling_how_to_resume,
)
from kpbench.dataset.shard import Sample, encode_shard
from kpbench.errors import DataError
from kpbench.files import folder_at, is_local, make_folder, write_atomic
from kpbench.workers import Progress, run_jobs


class Recipe(Protocol):
    """A dataset's definition: picklable, hashable, and all that its images are a function of."""

    @property
    def n(self) -> int:
        """Number of images."""
        ...

    @property
    def shard_size(self) -> int:
        """Images a shard."""
        ...

    @property
    def image_bytes(self) -> int:
        """What one image is expected to take on disk."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """The config that is written into the dataset: no path of this machine."""
        ...

    def scene_id(self, index: int) -> int:
        """The base scene of an image; shards are made scene by scene, as what a scene needs is kept."""
        ...

    def make(self, index: int) -> tuple[Sample, tuple[str, ...]]:
        """One image, and the broken background files met on the way."""
        ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class Run:
    """What :func:`generate` did: the dataset, the broken background files, and the number of images that were kept."""

    dataset: Dataset
    broken: tuple[str, ...]
    kept: int


def generate(
    config: Recipe,
    out: str | Path,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda images: None,
) -> Run:
    """Write a dataset into a folder.

    Parameters
    ----------
    config : Recipe
        :class:`kpbench.synth.SynthConfig` or :class:`kpbench.synth.SuiteConfig`.
    out : folder, made if it is not there; or a URL that fsspec reaches, such as ``s3://bucket/name``.
    workers : processes; None for one a core. 1 works in this process.
    executor : where the shards are made instead, see :func:`kpbench.workers.run_jobs`; what runs there has to see
        the folder and the backgrounds under the same paths.
    resume : keep the finished shards of an interrupted run and make the rest.
    overwrite : delete the dataset that is in the folder first.
    progress : called as images are finished.

    Raises
    ------
    DataError
        If the folder holds another dataset or other files, another run is writing to it, the disk is full, or a
        worker dies; finished shards stay, and the message says how to go on.
    """
    folder, written = make_folder(folder_at(out)), config.to_dict()  # lists the backgrounds, before anything is touched
    plan = _plan(config.n, config.shard_size)
    with lock_folder(folder):
        kept = _prepare(folder, written, plan, resume, overwrite)
        results = _complete(config, folder, written, plan, kept, workers, executor, progress)
        dataset, broken = _finish(folder, written, [results[name] for name, _, _ in plan])
    return Run(dataset, broken, sum(entry.count for entry, _ in kept.values()))


def generate_part(
    config: Recipe,
    out: str | Path,
    shards: range,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda images: None,
) -> int:
    """Write some of a dataset's shards and no manifest; several such runs may share a folder. See :func:`merge`.

    Parameters
    ----------
    shards : range
        Places of the shards to make, of all that :func:`generate` would make.

    The others, and the errors, are those of :func:`generate`.

    Returns
    -------
    int
        Number of images that are finished now.
    """
    folder, written = make_folder(folder_at(out)), config.to_dict()
    plan = _plan(config.n, config.shard_size)
    if not (0 <= shards.start < shards.stop <= len(plan)):
        asked = f"{shards.start}:{shards.stop}"
        raise DataError(f"--shard-range is {asked}, expected A:B with 0 <= A < B <= {len(plan)}, the number of shards")
    part = plan[shards.start : shards.stop]
    with lock_folder(folder, shared=True):
        kept = _prepare(folder, written, part, resume, overwrite)
        results = _complete(config, folder, written, part, kept, workers, executor, progress)
    return sum(entry.count for entry, _ in results.values())


def merge(out: str | Path, parts: Sequence[str | Path] = ()) -> Dataset:
    """Make one dataset of shards that were made in parts: check that all are there, write the manifest.

    Parameters
    ----------
    out : the folder of the dataset; it may hold shards already.
    parts : folders whose shards are linked or copied into it.

    Raises
    ------
    DataError
        If a shard is missing, damaged, or of another dataset than the first.
    """
    folder = make_folder(folder_at(out))
    with lock_folder(folder):
        for part in map(folder_at, parts):
            for path in sorted(part.glob("shard-*.h5")):
                if not (folder / path.name).exists():
                    _bring(path, folder / path.name)
        present = sorted(folder.glob("shard-*.h5"))
        if not present:
            raise DataError(f"{folder}: no shards there; name the folders of the parts")
        written = json.loads(read_head(present[0])[0])
        plan = _plan(written["n"], written["shard_size"])
        missing = [n for n, (name, _, _) in enumerate(plan) if not (folder / name).exists()]
        if missing:
            raise DataError(f"{folder}: {len(missing)} of {len(plan)} shards are missing, first is number {missing[0]}")
        kept = keep_shards(folder, written, plan)
        return _finish(folder, written, [kept[name] for name, _, _ in plan])[0]


def _bring(source: Path, target: Path) -> None:
    """A second name for a file, or a copy of it where the file system has no such names."""
    try:
        os.link(source, target)
    except OSError:
        write_atomic(target, source.read_bytes())


def _plan(n: int, shard_size: int) -> list[Piece]:
    firsts = range(0, n, shard_size)
    return [(f"shard-{k:05d}.h5", first, min(shard_size, n - first)) for k, first in enumerate(firsts)]


def _prepare(
    folder: Path, written: dict[str, Any], plan: list[Piece], resume: bool, overwrite: bool
) -> dict[str, Result]:
    """Look at what the folder holds; return the finished shards of the plan that this run can keep."""
    manifest = folder / MANIFEST
    there = [path for path in folder.glob("*") if not path.name.startswith(".")]
    present = [path for path in there if fnmatch(path.name, "shard-*.h5")]
    names = {name for name, _, _ in plan}
    mine = [path for path in present if path.name in names]
    if there and not present and not manifest.exists():
        raise DataError(f"{folder}: holds other files ({there[0].name}, ...), expected a new or an empty folder")
    if overwrite:
        whole = plan[0][1] == 0 and len(plan) * plan[0][2] >= written["n"]
        for path in [manifest, *(folder / name for name in card.FILES), *(present if whole else mine)]:
            path.unlink(missing_ok=True)
    elif not resume and (manifest.exists() or mine):
        what = "already holds a dataset" if manifest.exists() else "holds an unfinished dataset"
        raise DataError(f"{folder}: {what}; add --resume to finish it, --overwrite to replace it, or another --out")
    for name in names:
        for leftover in folder.glob(f".{name}.*.part"):  # of a run that was killed while it wrote
            leftover.unlink(missing_ok=True)
    if overwrite or not resume:
        return {}
    if present and len(plan) != len(_plan(written["n"], written["shard_size"])):
        present = mine
    for path in present:
        if path.name not in names:
            raise DataError(f"{path}: of another dataset than this command makes; use --overwrite or another --out")
    return keep_shards(folder, written, plan)


def _complete(
    config: Recipe,
    folder: Path,
    written: dict[str, Any],
    plan: list[Piece],
    kept: dict[str, Result],
    workers: int | None,
    executor: Executor | None,
    progress: Progress,
) -> dict[str, Result]:
    """Have the shards of a plan made that are not there yet."""
    todo = sorted((piece for piece in plan if piece[0] not in kept), key=lambda piece: config.scene_id(piece[1]))
    _check_space(folder, config.image_bytes, sum(count for _, _, count in todo))
    progress(sum(entry.count for entry, _ in kept.values()))
    results = dict(kept)
    work = partial(_write_shard, config, written, folder.resolve())
    with telling_how_to_resume(folder):
        for entry, met in run_jobs(work, todo, workers, progress, executor):
            results[entry.file] = (entry, met)
    return results


def _finish(folder: Path, written: dict[str, Any], results: list[Result]) -> tuple[Dataset, tuple[str, ...]]:
    """Write the manifest, which makes the folder a dataset, and its card."""
    broken = tuple(sorted({file for _, files in results for file in files}))
    with naming_folder(folder):
        write_manifest(folder, written, [entry for entry, _ in results], _provenance(broken))
        dataset = open_dataset(folder)
        card.write_card(dataset, folder)
    return dataset, broken


def _check_space(folder: Path, image_bytes: int, images: int) -> None:
    """Refuse to start what cannot end."""
    if not is_local(folder):
        return
    need = images * image_bytes
    free = shutil.disk_usage(folder).free
    if need > free:
        raise DataError(f"{folder}: {images} images need about {_size(need)}, the disk has {_size(free)} free")


def _size(count: float) -> str:
    """Bytes for people: 12.3 MB."""
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000 or unit == "TB":
            break
        count /= 1000
    return f"{count:.3g} {unit}"


def _provenance(broken: tuple[str, ...]) -> dict[str, Any]:
    """Versions that can change pixels, and the broken files; nothing that differs between equal runs."""
    libraries = ("kpbench", "numpy", "opencv-python-headless", "albumentations", "h5py", "deflate")
    return {
        "versions": {
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in libraries},
        },
        "broken_backgrounds": list(broken),
    }


_turn = threading.Lock()


def _write_shard(config: Recipe, written: dict[str, Any], folder: Path, piece: Piece, progress: Progress) -> Result:
    name, first, count = piece
    met: set[str] = set()

    def made() -> Iterator[Sample]:
        ours = _of_this_process(config)
        for index in range(first, first + count):
            sample, failed = ours.make(index)
            met.update(failed)
            yield sample
            progress(1)

    with _turn:  # an executor may have several threads a process; caches and albumentations' generators are not theirs
        data = encode_shard(made(), count, written, met)
    write_atomic(folder / name, data)
    return ShardEntry(name, first, count, len(data), hashlib.sha256(data).hexdigest()), tuple(sorted(met))


@cache
def _of_this_process(config: Recipe) -> Recipe:
    """One config object a process, so that the decoded photographs are cached across shards."""
    return config
