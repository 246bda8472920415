"""Generate, predict, evaluate: the only place where stages are chained, and where workers live."""

from __future__ import annotations

import contextlib
import hashlib
import json
import multiprocessing
import os
import platform
import shutil
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cache, cached_property
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from kpbench import degrade, store
from kpbench.background import Background, PhotoFolder, procedural
from kpbench.design import Patch, shipped_patches
from kpbench.errors import DataError
from kpbench.keypoints import UInt8
from kpbench.scene import Limits, Rendered, measure_contrast, random_placements, render_scene

__all__ = ["Progress", "Recipe", "SynthConfig", "generate", "make_sample"]

Progress = Callable[[int], None]
"""Called with the number of images that are finished since the last call."""

BACKGROUND, SCENE, DETERIORATION = range(3)


class Recipe(Protocol):
    """A dataset's definition: picklable, hashable, and all that its images are a function of.

    ``n`` images in shards of ``shard_size``; ``image_bytes`` is what one is expected to take on disk.
    """

    @property
    def n(self) -> int: ...
    @property
    def shard_size(self) -> int: ...
    @property
    def image_bytes(self) -> int: ...
    def to_dict(self) -> dict[str, Any]:
        """The config that is written into the dataset: no path of this machine."""
        ...

    def make(self, index: int) -> tuple[store.Sample, tuple[str, ...]]:
        """One image, and the broken background files met on the way."""
        ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True)
class SynthConfig:
    """All that a synthetic set is a function of, besides the background files.

    Attributes
    ----------
    n : number of images.
    seed : any whole number from 0.
    size_px : (width, height).
    channels : 1 (grey) or 3 (RGB).
    deteriorate : "none" or "paper" (:func:`kpbench.degrade.paper_mix`); the scenes are the same.
    shard_size : images a shard; changes the files but no image.
    backgrounds : folder of photographs, or None for procedural ones.
    limits : what a scene may hold.
    patches : the designs to place.

    Raises
    ------
    DataError
        If a value is out of its range.
    """

    n: int
    seed: int = 0
    size_px: tuple[int, int] = (640, 480)
    channels: int = 1
    deteriorate: str = "paper"
    shard_size: int = 500
    backgrounds: Path | None = None
    limits: Limits = field(default_factory=Limits)
    patches: tuple[Patch, ...] = field(default_factory=shipped_patches)

    def __post_init__(self) -> None:
        def need(good: bool, what: str) -> None:
            if not good:
                raise DataError(what)

        need(1 <= self.n <= 10**9, f"--n is {self.n}, expected a number of images from 1 to 1,000,000,000")
        need(self.seed >= 0, f"--seed is {self.seed}, expected a whole number from 0")
        need(min(self.size_px) >= 64, f"--size is {self.size_px[0]}x{self.size_px[1]}, expected at least 64x64")
        need(max(self.size_px) <= 16384, f"--size is {self.size_px[0]}x{self.size_px[1]}, at most 16384 a side")
        need(self.channels in (1, 3), f"--channels is {self.channels}, expected 1 or 3")
        need(self.deteriorate in ("none", "paper"), f"--deteriorate is {self.deteriorate!r}, expected none or paper")
        need(self.shard_size >= 1, f"--shard-size is {self.shard_size}, expected a number of images from 1")

    @cached_property
    def photos(self) -> PhotoFolder | None:
        """The listed background folder."""
        return None if self.backgrounds is None else PhotoFolder.open(self.backgrounds)

    def to_dict(self) -> dict[str, Any]:
        """What is written into the dataset: no path, so that a moved folder gives the same bytes."""
        photos = self.photos
        source = {"kind": "procedural"} if photos is None else {
            "kind": "photographs", "files": len(photos.files), "listing_sha256": photos.digest,
        }  # fmt: skip
        return {
            "kind": "synth",
            "n": self.n,
            "seed": self.seed,
            "size_px": list(self.size_px),
            "channels": self.channels,
            "deteriorate": self.deteriorate,
            "shard_size": self.shard_size,
            "backgrounds": source,
            "limits": {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self.limits).items()},
            "patches": [patch.to_dict() for patch in self.patches],
        }

    @property
    def image_bytes(self) -> int:
        """Expected size on disk: photographs deflate to about two thirds, noise hardly at all."""
        width, height = self.size_px
        return int(width * height * self.channels * (0.85 if self.deteriorate == "paper" else 0.7))

    def make(self, index: int) -> tuple[store.Sample, tuple[str, ...]]:
        """See :func:`make_sample`."""
        return make_sample(self, index)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "photos"}


def _stream(seed: int, index: int, stage: int) -> np.random.Generator:
    """Random numbers of one stage of one image, independent of every other stage and image."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(index, stage))))


def make_sample(config: SynthConfig, index: int) -> tuple[store.Sample, tuple[str, ...]]:
    """Image ``index`` of a synthetic set, and the broken background files met on the way.

    A function of (config, index, background files) and of nothing else.
    """
    width, height = config.size_px
    background = _background(config, _stream(config.seed, index, BACKGROUND))
    placements = random_placements(_stream(config.seed, index, SCENE), width, height, config.patches, config.limits)
    scene = render_scene(background.image, placements)
    image, effects = scene.image, list[dict[str, Any]]()
    if config.deteriorate == "paper":
        image, effects = _deteriorated(scene, _stream(config.seed, index, DETERIORATION))
    return store.Sample(index, image, scene.keypoints, effects, background.file), background.broken


def _background(config: SynthConfig, rng: np.random.Generator) -> Background:
    width, height = config.size_px
    if config.photos is None:
        return Background(procedural(rng, width, height, config.channels))
    return config.photos.sample(rng, width, height, config.channels)


def _deteriorated(scene: Rendered, rng: np.random.Generator) -> tuple[UInt8, list[dict[str, Any]]]:
    image, effects = degrade.paper_mix(scene.image, rng)
    scene.keypoints["contrast"] = measure_contrast(image, scene.masks)
    return image, effects


@dataclass(frozen=True)
class Run:
    """What :func:`generate` did."""

    dataset: store.Dataset
    broken: tuple[str, ...]
    kept: int


def generate(
    config: Recipe,
    out: str | Path,
    *,
    workers: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = lambda images: None,
) -> Run:
    """Write a dataset into a folder.

    Parameters
    ----------
    config : Recipe
        :class:`SynthConfig` or :class:`kpbench.suite.SuiteConfig`.
    out : folder; made if it is not there.
    workers : processes; None for one a core. 1 works in this process.
    resume : keep the finished shards of an interrupted run and make the rest.
    overwrite : delete the dataset that is in the folder first.
    progress : called as images are finished.

    Raises
    ------
    DataError
        If the folder holds another dataset, another run is writing to it, the disk is full, or a worker
        dies; finished shards stay, and the message says how to go on.
    """
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made, {error.strerror}") from None
    written = config.to_dict()  # lists the backgrounds, before anything is touched
    with _locked(folder):
        plan = _plan(config)
        done = _prepare(folder, config, written, plan, resume, overwrite)
        todo = [piece for piece in plan if piece[0] not in done]
        _check_space(folder, config.image_bytes, sum(count for _, _, count in todo))
        progress(sum(done[name][0].count for name in done))
        results = dict(done)
        for entry, broken in _run(config, written, folder, todo, workers, progress):
            results[entry.file] = (entry, broken)
        entries = [results[name][0] for name, _, _ in plan]
        broken = tuple(sorted({file for _, files in results.values() for file in files}))
        store.write_manifest(folder, written, entries, _provenance(broken))
    return Run(store.open_dataset(folder), broken, sum(entry.count for entry, _ in done.values()))


Piece = tuple[str, int, int]
Result = tuple[store.ShardEntry, tuple[str, ...]]


def _plan(config: Recipe) -> list[Piece]:
    """(file, first image, number of images) of every shard."""
    firsts = range(0, config.n, config.shard_size)
    return [(f"shard-{k:05d}.h5", first, min(config.shard_size, config.n - first)) for k, first in enumerate(firsts)]


def _prepare(
    folder: Path, config: Recipe, written: dict[str, Any], plan: list[Piece], resume: bool, overwrite: bool
) -> dict[str, Result]:
    """Look at what the folder holds; return the finished shards that this run can keep."""
    manifest = folder / store.MANIFEST
    present = sorted(folder.glob("shard-*.h5"))
    if overwrite:
        for path in [manifest, *present]:
            path.unlink(missing_ok=True)
    elif (manifest.exists() or present) and not resume:
        what = "already holds a dataset" if manifest.exists() else "holds an unfinished dataset"
        raise DataError(f"{folder}: {what}; add --resume to finish it, --overwrite to replace it, or another --out")
    for leftover in folder.glob(".*.part"):  # of a run that was killed while it wrote
        leftover.unlink(missing_ok=True)
    if overwrite or not resume:
        return {}
    kept: dict[str, Result] = {}
    pieces = {piece[0]: piece for piece in plan}
    for path in present:
        with store.open_shard(path) as file:
            if file.attrs["config"] != store.canonical_json(written) or path.name not in pieces:
                raise DataError(f"{path}: of another dataset than this command makes; use --overwrite or another --out")
            broken = tuple(json.loads(file.attrs["broken_backgrounds"]))
        entry = store.ShardEntry(*pieces[path.name], path.stat().st_size, store.sha256_of(path))
        kept[path.name] = (entry, broken)
    return kept


def _check_space(folder: Path, image_bytes: int, images: int) -> None:
    """Refuse to start what cannot end."""
    need = images * image_bytes
    free = shutil.disk_usage(folder).free
    if need > free:
        raise DataError(
            f"{folder}: {images} images need about {need / 1e9:.1f} GB, the disk has {free / 1e9:.1f} GB free"
        )


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the folder against a second run; the lock ends with the process, however that ends."""
    try:
        import fcntl
    except ImportError:  # Windows has no flock; there the check is left out
        yield
        return
    path = folder / ".kpbench.lock"
    try:
        file = path.open("w")
    except OSError as error:
        raise DataError(f"{path}: cannot be written, {error.strerror}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise DataError(f"{folder}: another kpbench run is writing to it") from None
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _provenance(broken: tuple[str, ...]) -> dict[str, Any]:
    """Versions that can change pixels, and the broken files; nothing that differs between equal runs."""
    libraries = ("kpbench", "numpy", "opencv-python-headless", "albumentations", "h5py", "isal")
    return {
        "versions": {"python": platform.python_version(), **{name: metadata.version(name) for name in libraries}},
        "broken_backgrounds": list(broken),
    }


def _write_shard(config: Recipe, written: dict[str, Any], folder: Path, piece: Piece, progress: Progress) -> Result:
    name, first, count = piece
    samples, met = [], set[str]()
    for index in range(first, first + count):
        sample, failed = config.make(index)
        samples.append(sample)
        met.update(failed)
        progress(1)
    broken = tuple(sorted(met))
    data = store.encode_shard(samples, written, broken)
    store.write_atomic(folder / name, data)
    return store.ShardEntry(name, first, count, len(data), hashlib.sha256(data).hexdigest()), broken


def _run(
    config: Recipe,
    written: dict[str, Any],
    folder: Path,
    todo: list[Piece],
    workers: int | None,
    progress: Progress,
) -> Iterator[Result]:
    workers = min(workers or cores(), len(todo))
    if workers <= 1:
        cv2.setNumThreads(1)
        for piece in todo:
            yield _write_shard(config, written, folder, piece, progress)
        return
    spawn = multiprocessing.get_context("spawn")  # a forked OpenCV or HDF5 may hang
    counter = spawn.Value("q", 0)
    pool = ProcessPoolExecutor(workers, spawn, _start_worker, (counter,))
    try:
        yield from _collect(pool, config, written, folder, todo, counter, progress)
    except BrokenProcessPool:
        raise DataError(
            f"{folder}: a worker process died (out of memory?); finished shards are kept, add --resume to go on"
        ) from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()


def _collect(
    pool: Executor,
    config: Recipe,
    written: dict[str, Any],
    folder: Path,
    todo: list[Piece],
    counter: Any,
    progress: Progress,
) -> Iterator[Result]:
    """Yield shards as they are finished, passing on the workers' image counter meanwhile."""
    waiting: set[Future[Result]] = {pool.submit(_work, config, written, folder, piece) for piece in todo}
    seen = 0
    while waiting:
        done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
        progress(counter.value - seen)
        seen = counter.value
        for future in done:
            yield future.result()


_counter: Any = None


def _start_worker(counter: Any) -> None:
    """Runs once in each worker: one thread, and Ctrl-C is the parent's business."""
    global _counter
    _counter = counter
    cv2.setNumThreads(1)
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _count(images: int) -> None:
    with _counter.get_lock():
        _counter.value += images


def _work(config: Recipe, written: dict[str, Any], folder: Path, piece: Piece) -> Result:
    return _write_shard(_of_this_process(config), written, folder, piece, _count)


@cache
def _of_this_process(config: Recipe) -> Recipe:
    """One config object a process, so that the decoded photographs are cached across shards."""
    return config


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
