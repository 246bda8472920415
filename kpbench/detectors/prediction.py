"""Run detectors over datasets and images, degrade images of one's own: stages chained, over workers."""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.dataset import shard as store
from kpbench.dataset.drawing import draw_detections
from kpbench.degrade import effects as degrade
from kpbench.detectors.interface import LoadedDetector, load_detector, one_line
from kpbench.errors import DataError
from kpbench.files import PACKAGE, write_atomic
from kpbench.images import Source, image_writer
from kpbench.render.scene import stream
from kpbench.types import Detections, Predictions, UInt8
from kpbench.workers import Progress, run_pieces


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
    detector : name or ``MODULE:ATTR`` (see :func:`kpbench.detectors.load_detector`), or a loaded one, which
        stays in this process.
    threshold : drop detections of a lower score, in place of the detector's own limit if it is given by name and has
        one (an attribute ``threshold``); None keeps all.
    workers : processes, for a detector given by name; None for one a core.
    overlay : folder or video to draw the detections into.
    progress : called as images are finished.

    Raises
    ------
    DataError
        If the detector cannot be loaded, or the dataset cannot be read.
    """
    loaded = load_detector(detector, threshold) if isinstance(detector, str) else detector
    if not isinstance(detector, str):
        workers = 1
    pieces = [range(first, min(first + 32, len(dataset))) for first in range(0, len(dataset), 32)]
    work = partial(detect_some, dataset, loaded if workers == 1 else detector, threshold)
    found: dict[int, Found] = {}
    ids = dataset.truth.image_id
    with image_writer(overlay, len(dataset)) as draw:
        for results in run_pieces(work, pieces, workers, progress):
            found.update(results)
        for n in range(len(dataset)) if overlay is not None else ():
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

    Parameters and errors are those of :func:`predict`; ``source`` is from :func:`kpbench.images.open_images`.
    """
    loaded = load_detector(detector, threshold) if isinstance(detector, str) else detector
    found, labels = list[Found](), list[str]()
    endless = () if source.length is not None else (KeyboardInterrupt,)
    with image_writer(overlay, source.length, source.fps) as draw, contextlib.suppress(*endless):
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
    except (Exception, SystemExit) as error:  # whatever a detector of somebody else raises
        return Detections.none(), f"{type(error).__name__}: {one_line(error)}{_line_of(error)}"
    return _sure(found, threshold), ""


def _sure(found: Detections, threshold: float | None) -> Detections:
    return found if threshold is None else found[found.score >= threshold]


def _line_of(error: BaseException) -> str:
    """Where in the detector's own file an error was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if PACKAGE not in Path(frame.filename).parents]
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""


@cache
def _loaded(name: str, threshold: float | None) -> LoadedDetector:
    return load_detector(name, threshold)


def detect_some(
    dataset: store.Dataset, detector: str | LoadedDetector, threshold: float | None, piece: range, progress: Progress
) -> dict[int, Found]:
    """What a detector finds in some images of a dataset, and the message of each on which it raised, else "".

    Parameters are those of :func:`predict`; ``piece`` holds the positions of the images.
    """
    loaded = _loaded(detector, threshold) if isinstance(detector, str) else detector
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
    source : from :func:`kpbench.images.open_images`; what cannot be decoded is named at the end.
    out : folder, made if it is not there; not the one that the images are in.
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
        write_atomic(target, packed.tobytes())
        yield target, effects
    if broken:
        raise DataError(f"{len(broken)} images cannot be decoded, the others are done: {', '.join(broken[:5])}")
