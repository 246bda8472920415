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
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

from kpbench.dataset import card
from kpbench.dataset import shard as store
from kpbench.errors import DataError
from kpbench.files import folder_at, is_local, write_atomic
from kpbench.workers import Progress, run_pieces

LOCK = ".kpbench.lock"


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

    def scene(self, index: int) -> int:
        """The base scene of an image; shards are made scene by scene, as what a scene needs is kept."""
        ...

    def make(self, index: int) -> tuple[store.Sample, tuple[str, ...]]:
        """One image, and the broken background files met on the way."""
        ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class Run:
    """What :func:`generate` did: the dataset, the broken background files, and the number of images that were kept."""

    dataset: store.Dataset
    broken: tuple[str, ...]
    kept: int


Piece = tuple[str, int, int]
"""(file, first image, number of images) of a shard."""
Result = tuple[store.ShardEntry, tuple[str, ...]]
"""A finished shard, and the background files that could not be decoded for it."""


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
    executor : where the shards are made instead, see :func:`kpbench.workers.run_pieces`; what runs there has to see
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
    folder, written = _made(out), config.to_dict()  # lists the backgrounds, before anything is touched
    plan = _plan(config.n, config.shard_size)
    with _locked(folder):
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
    folder, written = _made(out), config.to_dict()
    plan = _plan(config.n, config.shard_size)
    if not (0 <= shards.start < shards.stop <= len(plan)):
        asked = f"{shards.start}:{shards.stop}"
        raise DataError(f"--shard-range is {asked}, expected A:B with 0 <= A < B <= {len(plan)}, the number of shards")
    part = plan[shards.start : shards.stop]
    with _locked(folder, shared=True):
        kept = _prepare(folder, written, part, resume, overwrite)
        results = _complete(config, folder, written, part, kept, workers, executor, progress)
    return sum(entry.count for entry, _ in results.values())


def merge(out: str | Path, parts: Sequence[str | Path] = ()) -> store.Dataset:
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
    folder = _made(out)
    with _locked(folder):
        for part in map(folder_at, parts):
            for path in sorted(part.glob("shard-*.h5")):
                if not (folder / path.name).exists():
                    _bring(path, folder / path.name)
        present = sorted(folder.glob("shard-*.h5"))
        if not present:
            raise DataError(f"{folder}: no shards there; name the folders of the parts")
        written = json.loads(_head(present[0])[0])
        plan = _plan(written["n"], written["shard_size"])
        missing = [n for n, (name, _, _) in enumerate(plan) if not (folder / name).exists()]
        if missing:
            raise DataError(f"{folder}: {len(missing)} of {len(plan)} shards are missing, first is number {missing[0]}")
        kept = _keep(folder, written, plan)
        return _finish(folder, written, [kept[name] for name, _, _ in plan])[0]


def _bring(source: Path, target: Path) -> None:
    """A second name for a file, or a copy of it where the file system has no such names."""
    try:
        os.link(source, target)
    except OSError:
        write_atomic(target, source.read_bytes())


def _made(out: str | Path) -> Path:
    folder = folder_at(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made, {error.strerror}") from None
    return folder


def _plan(n: int, shard_size: int) -> list[Piece]:
    firsts = range(0, n, shard_size)
    return [(f"shard-{k:05d}.h5", first, min(shard_size, n - first)) for k, first in enumerate(firsts)]


def _prepare(
    folder: Path, written: dict[str, Any], plan: list[Piece], resume: bool, overwrite: bool
) -> dict[str, Result]:
    """Look at what the folder holds; return the finished shards of the plan that this run can keep."""
    manifest = folder / store.MANIFEST
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
    return _keep(folder, written, plan)


def _keep(folder: Path, written: dict[str, Any], plan: list[Piece]) -> dict[str, Result]:
    """Those shards of a plan that are there, after a look into each; if the dataset was finished, byte by byte."""
    known = store.recorded_digests(folder)
    kept: dict[str, Result] = {}
    for name, first, count in plan:
        path = folder / name
        if path.exists():
            config, broken, images = _head(path)
            if config != store.canonical_json(written) or images != range(first, first + count):
                why = _difference(json.loads(config), written)
                raise DataError(
                    f"{path}: of another dataset than this command makes{why}; use --overwrite or another --out"
                )
            entry = store.ShardEntry(name, first, count, path.stat().st_size, store.sha256_of(path))
            if known.get(name, entry.sha256) != entry.sha256:
                raise DataError(f"{path}: damaged since it was written; delete it, and --resume makes it again")
            kept[name] = (entry, broken)
    return kept


def _head(path: Path) -> tuple[str, tuple[str, ...], range]:
    """A shard's config as text, its broken backgrounds, and which images it holds."""
    with store.open_shard(path) as file:
        ids = file["image_id"][:]
        broken = tuple(json.loads(store.attribute(file, "broken_backgrounds")))
        return store.attribute(file, "config"), broken, range(int(ids[0]), int(ids[-1]) + 1)


def _difference(there: dict[str, Any], here: dict[str, Any]) -> str:
    """The first option in which two configs differ, for people; of a table, the first entry."""
    for key in here:
        if there.get(key) != here[key]:
            if isinstance(there.get(key), dict) and isinstance(here[key], dict):
                return _difference(there[key], here[key])
            values = [str(config.get(key)) for config in (there, here)]
            said = f" is {values[0]} there, {values[1]} here" if max(map(len, values)) < 40 else " differs"
            return f" ({key}{said})"
    return ""


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
    todo = sorted((piece for piece in plan if piece[0] not in kept), key=lambda piece: config.scene(piece[1]))
    _check_space(folder, config.image_bytes, sum(count for _, _, count in todo))
    progress(sum(entry.count for entry, _ in kept.values()))
    results = dict(kept)
    work = partial(_write_shard, config, written, folder.resolve())
    with _resumable(folder):
        for entry, met in run_pieces(work, todo, workers, progress, executor):
            results[entry.file] = (entry, met)
    return results


@contextmanager
def _named(folder: Path) -> Iterator[None]:
    """Let errors name the folder as the user does."""
    try:
        yield
    except DataError as error:
        said = str(error).replace(str(folder.resolve()), str(folder))
        raise DataError(said if said.startswith(str(folder)) else f"{folder}: {said}") from None


@contextmanager
def _resumable(folder: Path) -> Iterator[None]:
    """Let errors say how to go on, too, where something is there to go on from."""
    try:
        with _named(folder):
            yield
    except DataError as error:
        kept = "; finished shards are kept, add --resume to go on" if any(folder.glob("shard-*.h5")) else ""
        raise DataError(f"{error}{kept}") from None


def _finish(folder: Path, written: dict[str, Any], results: list[Result]) -> tuple[store.Dataset, tuple[str, ...]]:
    """Write the manifest, which makes the folder a dataset, and its card."""
    broken = tuple(sorted({file for _, files in results for file in files}))
    with _named(folder):
        store.write_manifest(folder, written, [entry for entry, _ in results], _provenance(broken))
        dataset = store.open_dataset(folder)
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


@contextmanager
def _locked(folder: Path, shared: bool = False) -> Iterator[None]:
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

    def made() -> Iterator[store.Sample]:
        ours = _of_this_process(config)
        for index in range(first, first + count):
            sample, failed = ours.make(index)
            met.update(failed)
            yield sample
            progress(1)

    with _turn:  # an executor may have several threads a process; caches and albumentations' generators are not theirs
        data = store.encode_shard(made(), count, written, met)
    write_atomic(folder / name, data)
    return store.ShardEntry(name, first, count, len(data), hashlib.sha256(data).hexdigest()), tuple(sorted(met))


@cache
def _of_this_process(config: Recipe) -> Recipe:
    """One config object a process, so that the decoded photographs are cached across shards."""
    return config
