"""Make datasets: plan the shards, keep finished shards, make the missing shards, write the manifest last.

The configuration and a shard's place in the dataset determine the shard. Any process can therefore make a shard, at
any time and in any run. An interrupted run can be resumed. Parts that were made on several machines can be
merged.
"""

from __future__ import annotations

import hashlib
import os
import platform
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

from kpbench.dataset.card import write_card
from kpbench.dataset.config import DatasetConfig
from kpbench.dataset.folder import MANIFEST, Dataset, ShardEntry, make_manifest, open_dataset, write_manifest
from kpbench.dataset.resume import (
    FinishedShard,
    PlannedShard,
    add_resume_hint,
    find_finished_shards,
    name_folder_in_errors,
    plan_shards,
    prepare_folder,
    read_shard_head,
    refuse_resume_with_overwrite,
)
from kpbench.dataset.shard import Sample, encode_shard
from kpbench.errors import DataError
from kpbench.files import folder_at, load_json, make_folder
from kpbench.locks import lock_folder
from kpbench.opencv import opencv_version, processor_features, warn_of_opencv
from kpbench.workers import Progress, dask_executor, run_jobs
from kpbench.writing import remove_leftovers, require_space, require_writable, write_file

PIXELS = 2
"""Version of the pixels. It is raised by hand whenever the same configuration gives other pixels than before."""


@dataclass(frozen=True)
class GenerationResult:
    """The result of :func:`generate`.

    Attributes
    ----------
    dataset : Dataset
    broken_files : tuple of str
        Background files that could not be decoded. Other files were used instead.
    kept : int
        Number of images kept from an earlier run.

    Examples
    --------
    >>> from kpbench import SynthConfig, generate
    >>> result = generate(SynthConfig(n=2, size_px=(64, 64)), "two", workers=1)
    >>> result.kept, result.broken_files
    (0, ())
    """

    dataset: Dataset
    broken_files: tuple[str, ...]
    kept: int


def generate(
    config: DatasetConfig,
    out: str | Path,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda images: None,
) -> GenerationResult:
    """Make a dataset.

    Parameters
    ----------
    config : DatasetConfig
        Configuration such as :class:`kpbench.SynthConfig` or :class:`kpbench.SuiteConfig`.
    out : str or Path
        Folder, or a URL that fsspec reaches, such as ``s3://bucket/name``. A missing folder is made.
    workers : int or None
        Number of worker processes, None for one per core. With 1, this process makes all shards.
    executor : concurrent.futures.Executor, optional
        Executor that makes the shards instead of worker processes. The workers of the executor must find the folder and
        the backgrounds under the same paths as this process.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``tcp://host:8786``, whose workers make the shards.
    resume : bool
        Keep the finished shards of an interrupted run, and make the others.
    overwrite : bool
        Delete the dataset in the folder first.
    progress : callable
        Called with the number of images finished since its last call.

    Returns
    -------
    GenerationResult

    Raises
    ------
    DataError
        If both ``resume`` and ``overwrite`` are set, the folder holds another dataset or other files, another run is
        writing to it, the disk is full, or a worker dies. Finished shards stay, and the message says how to resume.

    Examples
    --------
    >>> from kpbench import SynthConfig, generate
    >>> dataset = generate(SynthConfig(n=2, size_px=(64, 64)), "two", workers=1).dataset
    >>> len(dataset), dataset.image(0).shape
    (2, (64, 64))
    """
    refuse_resume_with_overwrite(resume, overwrite)
    with _open_executor(executor, scheduler) as executor:
        folder, written = make_folder(folder_at(out)), describe_config(config)
        # before a plan of a billion images is made and compared with the folder
        require_space(folder, config.n * config.image_bytes, f"{config.n} images", of_empty_disk=True)
        plan = plan_shards(config.n, config.shard_size)
        run = _Run(config, folder, written, plan, workers, executor, progress)
        with lock_folder(folder):
            kept = prepare_folder(folder, written, plan, resume, overwrite)
            with _remove_leftovers_at_end(run):
                finished = _make_missing_shards(run, kept)
            dataset, broken_files = _finish_dataset(folder, written, [finished[shard.file] for shard in plan])
    return GenerationResult(dataset, broken_files, sum(shard.entry.count for shard in kept.values()))


def generate_part(
    config: DatasetConfig,
    out: str | Path,
    shards: range,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda images: None,
) -> int:
    """Make some shards of a dataset, without a manifest.

    Several runs may make different shards in the same folder. :func:`merge` then makes the dataset.

    Parameters
    ----------
    shards : range
        The shards to make, counted from 0.
    config, out, workers, executor, scheduler, resume, overwrite, progress
        See :func:`generate`.

    Returns
    -------
    int
        Number of images in these shards, kept images included.

    Raises
    ------
    DataError
        If the dataset does not have these shards, or in a case that :func:`generate` lists.

    Examples
    --------
    >>> from kpbench import SynthConfig, merge
    >>> from kpbench.dataset import generate_part
    >>> config = SynthConfig(n=4, size_px=(64, 64), shard_size=2)
    >>> [generate_part(config, "four", range(n, n + 1), workers=1) for n in range(2)]
    [2, 2]
    >>> len(merge("four"))
    4
    """
    refuse_resume_with_overwrite(resume, overwrite)
    images = min(config.n, len(shards) * config.shard_size)
    require_space(make_folder(folder_at(out)), images * config.image_bytes, f"{images} images", of_empty_disk=True)
    plan = plan_shards(config.n, config.shard_size)
    if not (0 <= shards.start < shards.stop <= len(plan)):
        asked, expected = f"{shards.start}:{shards.stop}", f"A:B with 0 <= A < B <= {len(plan)}"
        raise DataError(f"`shards` is {asked}, expected {expected}, the number of shards")
    part = plan[shards.start : shards.stop]
    with _open_executor(executor, scheduler) as executor:
        folder, written = make_folder(folder_at(out)), describe_config(config)
        run = _Run(config, folder, written, part, workers, executor, progress)
        with lock_folder(folder, shared=True):
            kept = prepare_folder(folder, written, part, resume, overwrite)
            with _remove_leftovers_at_end(run):
                finished = _make_missing_shards(run, kept)
    return sum(shard.entry.count for shard in finished.values())


def merge(out: str | Path, parts: Sequence[str | Path] = ()) -> Dataset:
    """Make one dataset from shards that several runs made.

    Parameters
    ----------
    out : str or Path
        Folder of the dataset. The folder may already hold shards.
    parts : sequence of (str or Path)
        Folders whose shards are linked or copied into ``out``.

    Returns
    -------
    Dataset

    Raises
    ------
    DataError
        If a shard is missing, is damaged, or belongs to another dataset than the first shard. Shards whose pixels were
        made with another OpenCV or on another kind of machine belong to another dataset.

    Examples
    --------
    See :func:`kpbench.dataset.generate_part`.

    >>> from kpbench import SynthConfig, merge
    >>> from kpbench.dataset import generate_part
    >>> generate_part(SynthConfig(n=2, size_px=(64, 64)), "part", range(1), workers=1)
    2
    >>> len(merge("whole", ["part"]))
    2
    """
    folder = make_folder(folder_at(out))
    require_writable(folder / MANIFEST, "dataset")
    with lock_folder(folder):
        for part in map(folder_at, parts):
            for path in sorted(part.glob("shard-*.h5")):
                if not (folder / path.name).exists():
                    _link_or_copy(path, folder / path.name)
        present = sorted(folder.glob("shard-*.h5"))
        if not present:
            raise DataError(f"{folder}: no shards there; name the folders of the `parts`")
        written = load_json(read_shard_head(present[0]).config)
        plan = plan_shards(written["n"], written["shard_size"])
        missing = [n for n, shard in enumerate(plan) if not (folder / shard.file).exists()]
        if missing:
            raise DataError(f"{folder}: {len(missing)} of {len(plan)} shards are missing, first is number {missing[0]}")
        finished = find_finished_shards(folder, written, plan)
        return _finish_dataset(folder, written, [finished[shard.file] for shard in plan])[0]


def _link_or_copy(source: Path, target: Path) -> None:
    """Make a hard link to a file. Copy the file if the link fails."""
    try:
        os.link(source, target)
    except OSError:
        write_file(target, source.read_bytes())


def _open_executor(executor: Executor | None, scheduler: str | None) -> AbstractContextManager[Executor | None]:
    """Connect to the Dask scheduler if an address is given. Otherwise, pass the executor on."""
    return nullcontext(executor) if scheduler is None else dask_executor(scheduler)


@dataclass(frozen=True)
class _Run:
    """One call of :func:`generate` or :func:`generate_part`.

    Attributes
    ----------
    config : DatasetConfig
    folder : Path
    written : dict
        The config as it is written into the dataset.
    plan : list of PlannedShard
        The shards that this run makes.
    workers, executor, progress
        See :func:`generate`.
    """

    config: DatasetConfig
    folder: Path
    written: dict[str, Any]
    plan: list[PlannedShard]
    workers: int | None
    executor: Executor | None
    progress: Progress


@contextmanager
def _remove_leftovers_at_end(run: _Run) -> Iterator[None]:
    """Remove, if the run ends early, what its killed workers were writing."""
    try:
        yield
    except BaseException:
        remove_leftovers(run.folder / shard.file for shard in run.plan)
        raise


def _make_missing_shards(run: _Run, kept: dict[str, FinishedShard]) -> dict[str, FinishedShard]:
    """Make the planned shards that are not kept. Return all planned shards by their file names."""
    warn_of_opencv()
    missing = [shard for shard in run.plan if shard.file not in kept]
    # shards of the same scenes follow each other, so that cached backgrounds are used again
    missing.sort(key=lambda shard: run.config.scene_id(shard.first))
    images = sum(shard.count for shard in missing)
    require_space(run.folder, images * run.config.image_bytes, f"{images} images")
    run.progress(sum(shard.entry.count for shard in kept.values()))
    finished = dict(kept)
    work = partial(_make_shard, run.config, run.written, run.folder.resolve())
    with add_resume_hint(run.folder):
        for shard in run_jobs(work, missing, run.workers, run.progress, run.executor):
            finished[shard.entry.file] = shard
    return finished


def _finish_dataset(
    folder: Path, written: dict[str, Any], shards: list[FinishedShard]
) -> tuple[Dataset, tuple[str, ...]]:
    """Write the dataset's card, and last the manifest, which makes the folder a finished dataset.

    Returns
    -------
    dataset : Dataset
    broken_files : tuple of str
        Background files that could not be decoded.
    """
    broken_files = tuple(sorted({file for shard in shards for file in shard.broken_files}))
    with name_folder_in_errors(folder):
        manifest = make_manifest(written, [shard.entry for shard in shards], _provenance(broken_files))
        write_card(Dataset(folder, manifest), folder)
        write_manifest(folder, manifest)
        return open_dataset(folder), broken_files


def describe_config(config: DatasetConfig) -> dict[str, Any]:
    """Return the config that is written into every shard: what it says, and the software that its pixels depend on.

    Shards with different configs are never mixed, in a resumed run or a merge. kpbench's own pixels do not depend on
    the model of the processor. The pixels of a user's pipeline do.
    """
    content = config.to_dict()
    pixels = {"version": PIXELS, "machine": platform.machine(), "opencv": opencv_version()}
    if content.get("augmentation"):
        pixels |= {"albumentations": metadata.version("albumentations"), "processor": processor_features()}
    return {**content, "pixels": pixels}


def _provenance(broken_files: tuple[str, ...]) -> dict[str, Any]:
    """Return the versions of software that can change pixels, and the broken files. Equal runs give equal results."""
    libraries = ("kpbench", "numpy", "opencv-python-headless", "albumentations", "h5py", "deflate")
    return {
        "versions": {
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in libraries},
            "cv2": opencv_version(),  # that of another package, if several install OpenCV
        },
        "broken_backgrounds": list(broken_files),
    }


_one_shard_at_a_time = threading.Lock()
"""Lock for the threads of an executor: caches and albumentations' random generators are not thread-safe."""


def _make_shard(
    config: DatasetConfig, written: dict[str, Any], folder: Path, shard: PlannedShard, progress: Progress
) -> FinishedShard:
    """Make one shard and write it into the folder."""
    broken_files: set[str] = set()

    def make_samples() -> Iterator[Sample]:
        cached_config = _config_of_process(config)
        for index in range(shard.first, shard.first + shard.count):
            sample, broken = cached_config.make(index)
            broken_files.update(broken)
            yield sample
            progress(1)

    with _one_shard_at_a_time:
        data = encode_shard(make_samples(), shard.count, written, broken_files)
    write_file(folder / shard.file, data)
    entry = ShardEntry(shard.file, shard.first, shard.count, len(data), hashlib.sha256(data).hexdigest())
    return FinishedShard(entry, tuple(sorted(broken_files)))


@cache
def _config_of_process(config: DatasetConfig) -> DatasetConfig:
    """Return the same object for equal configs in a process. All shards then share its cache of photographs."""
    return config
