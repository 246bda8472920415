"""Generate, predict, evaluate: the only place where stages are chained, and where workers live."""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
import shutil
import traceback
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench import degrade, store
from kpbench.detect import LoadedDetector, load_detector, one_line
from kpbench.errors import DataError
from kpbench.keypoints import Detections, UInt8
from kpbench.predictions import Predictions
from kpbench.preview import draw_detections
from kpbench.scene import stream
from kpbench.sources import Source, image_writer
from kpbench.workers import Progress, run_pieces

__all__ = ["Predicted", "Recipe", "degrade_files", "detect_some", "generate", "predict", "predict_images"]


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
        :class:`kpbench.synth.SynthConfig` or :class:`kpbench.suite.SuiteConfig`.
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
        todo = sorted((piece for piece in plan if piece[0] not in done), key=lambda piece: config.scene(piece[1]))
        _check_space(folder, config.image_bytes, sum(count for _, _, count in todo))
        progress(sum(done[name][0].count for name in done))
        results = dict(done)
        work = partial(_write_shard, config, written, folder)
        try:
            for entry, met in run_pieces(work, todo, workers, progress):
                results[entry.file] = (entry, met)
        except DataError as error:
            said = str(error) if str(error).startswith(str(folder)) else f"{folder}: {error}"
            raise DataError(f"{said}; finished shards are kept, add --resume to go on") from None
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
            if store.attribute(file, "config") != store.canonical_json(written) or path.name not in pieces:
                raise DataError(f"{path}: of another dataset than this command makes; use --overwrite or another --out")
            broken = tuple(json.loads(store.attribute(file, "broken_backgrounds")))
        entry = store.ShardEntry(*pieces[path.name], path.stat().st_size, store.sha256_of(path))
        kept[path.name] = (entry, broken)
    return kept


def _check_space(folder: Path, image_bytes: int, images: int) -> None:
    """Refuse to start what cannot end."""
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
    libraries = ("kpbench", "numpy", "opencv-python-headless", "albumentations", "h5py")
    return {
        "versions": {
            "python": platform.python_version(),
            "zlib": zlib.ZLIB_RUNTIME_VERSION,
            **{name: metadata.version(name) for name in libraries},
        },
        "broken_backgrounds": list(broken),
    }


def _write_shard(config: Recipe, written: dict[str, Any], folder: Path, piece: Piece, progress: Progress) -> Result:
    config = _of_this_process(config)
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


@cache
def _of_this_process(config: Recipe) -> Recipe:
    """One config object a process, so that the decoded photographs are cached across shards."""
    return config


@dataclass(frozen=True)
class Predicted:
    """What a detector found, and (image, message) of every image that could not be read or on which it raised.

    Such an image counts as no detections.
    """

    predictions: Predictions
    failures: tuple[tuple[str, str], ...]


Found = tuple[Detections, str]


def predict(
    dataset: store.Dataset,
    detector: str | LoadedDetector,
    *,
    threshold: float | None = None,
    workers: int | None = 1,
    overlay: Path | None = None,
    progress: Progress = lambda images: None,
) -> Predicted:
    """Run a detector over a dataset.

    Parameters
    ----------
    dataset : Dataset
    detector : name or ``MODULE:ATTR`` (see :func:`kpbench.detect.load_detector`), or a loaded one, which
        stays in this process.
    threshold : drop detections of a lower score; None keeps all.
    workers : processes, for a detector given by name; None for one a core.
    overlay : folder or video to draw the detections into.
    progress : called as images are finished.

    Raises
    ------
    DataError
        If the detector cannot be loaded, or the dataset cannot be read.
    """
    loaded = load_detector(detector) if isinstance(detector, str) else detector
    if not isinstance(detector, str):
        workers = 1
    pieces = [range(first, min(first + 32, len(dataset))) for first in range(0, len(dataset), 32)]
    work = partial(detect_some, dataset, loaded if workers == 1 else detector, threshold)
    found: dict[int, Found] = {}
    for results in run_pieces(work, pieces, workers, progress):
        found.update(results)
    ids = dataset.truth.image_id
    if overlay is not None:
        with image_writer(overlay) as draw:
            for n in range(len(dataset)):
                draw(f"{ids[n]:08d}.png", draw_detections(dataset.image(n), found[n][0]))
    labels = [f"image_id {image_id}" for image_id in ids]
    return _predicted(loaded, [found[n] for n in range(len(dataset))], labels, ids, dataset)


def predict_images(
    source: Source,
    detector: str | LoadedDetector,
    *,
    threshold: float | None = None,
    overlay: Path | None = None,
    progress: Progress = lambda images: None,
) -> Predicted:
    """Run a detector over images that have no truth; ``image_id`` is their place in the source.

    Parameters and errors are those of :func:`predict`; ``source`` is from :func:`kpbench.sources.open_images`.
    """
    loaded = load_detector(detector) if isinstance(detector, str) else detector
    found, labels = list[Found](), list[str]()
    with image_writer(overlay, source.fps) as draw, contextlib.suppress(KeyboardInterrupt):
        # a camera never ends: Ctrl-C keeps what was found so far
        for label, image in source.images:
            found.append(
                (Detections.none(), "cannot be decoded") if image is None else _detect(loaded, image, threshold)
            )
            labels.append(label)
            if image is not None:
                draw(label, draw_detections(image, found[-1][0]))
            progress(1)
    return _predicted(loaded, found, labels, np.arange(len(found)))


def _predicted(
    detector: LoadedDetector,
    found: list[Found],
    labels: list[str],
    ids: NDArray[np.int64],
    dataset: store.Dataset | None = None,
) -> Predicted:
    if found and all(said for _, said in found):
        raise DataError(
            f"detector {detector.name}: failed on all {len(found)} images, first {labels[0]}: {found[0][1]}"
        )
    about = {"name": detector.name, "version": detector.version}
    where = {} if dataset is None else {"dataset": str(dataset.path), "fingerprint": dataset.fingerprint}
    predictions = Predictions.from_detections([d for d, _ in found], ids, about, **where)
    return Predicted(predictions, tuple((label, said) for label, (_, said) in zip(labels, found, strict=True) if said))


def _detect(detector: LoadedDetector, image: UInt8, threshold: float | None) -> Found:
    try:
        found = detector(image)
    except Exception as error:  # whatever a detector of somebody else raises
        return Detections.none(), f"{type(error).__name__}: {one_line(error)}{_line_of(error)}"
    return _sure(found, threshold), ""


def _sure(found: Detections, threshold: float | None) -> Detections:
    return found if threshold is None else found[found.score >= threshold]


def _line_of(error: BaseException) -> str:
    """Where in the detector's own file an error was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    inside = Path(__file__).parent
    own = [frame for frame in frames if inside not in Path(frame.filename).parents]
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""


@cache
def _loaded(name: str) -> LoadedDetector:
    return load_detector(name)


def detect_some(
    dataset: store.Dataset, detector: str | LoadedDetector, threshold: float | None, piece: range, progress: Progress
) -> dict[int, Found]:
    """What a detector finds in some images of a dataset, and the message of each on which it raised, else "".

    Parameters are those of :func:`predict`; ``piece`` holds the positions of the images.
    """
    loaded = _loaded(detector) if isinstance(detector, str) else detector
    if loaded.run_many is not None:
        with contextlib.suppress(Exception):  # if it fails, one by one tells on which images
            together = loaded.detect_many([dataset.image(n) for n in piece])
            progress(len(piece))
            return {n: (_sure(found, threshold), "") for n, found in zip(piece, together, strict=True)}
    results: dict[int, Found] = {}
    for n in piece:
        results[n] = _detect(loaded, dataset.image(n), threshold)
        progress(1)
    return results


def degrade_files(
    source: Source, out: Path, steps: Sequence[tuple[str, float]], seed: int = 0
) -> Iterator[tuple[Path, list[dict[str, Any]]]]:
    """Degrade images one by one and write them as PNG under their own names, with the folders they are in.

    Parameters
    ----------
    source : from :func:`kpbench.sources.open_images`; what cannot be decoded is named at the end.
    out : folder; made if it is not there.
    steps : (effect, level) of :data:`kpbench.degrade.LADDER`, applied in order.
    seed : the n-th image written is a function of the n-th image, the steps, the seed and n.

    Yields
    ------
    path : the file that was written.
    effects : what was applied, see :func:`kpbench.degrade.climb`.

    Raises
    ------
    DataError
        If an effect is not known, a level is out of range, a file cannot be written, or, after all others
        are done, if images could not be decoded.
    """
    broken = []
    for n, (name, image) in enumerate(source.images):
        if image is None:
            broken.append(name)
            continue
        if (image == image[..., :1]).all():  # grey, whatever the file's mode
            image = np.ascontiguousarray(image[..., 0])
        rng = stream(seed, n, 0)
        effects = [degrade.climb(rng, effect, level, (image.shape[1], image.shape[0])) for effect, level in steps]
        image = degrade.apply(image, rng, effects)
        target = out / name if name.endswith(".png") else out / f"{name}.png"
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(f"{target.parent}: cannot be made, {error.strerror}") from None
        packed = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]) if image.ndim == 3 else image)[1]
        store.write_atomic(target, packed.tobytes())
        yield target, effects
    if broken:
        raise DataError(f"{len(broken)} images cannot be decoded, the others are done: {', '.join(broken[:5])}")
