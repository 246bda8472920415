"""Run detectors over datasets and images, degrade images of one's own: stages chained, over workers."""

from __future__ import annotations

import contextlib
import traceback
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kpbench.dataset.drawing import draw_detections
from kpbench.dataset.folder import Dataset
from kpbench.detectors.interface import LoadedDetector, load_detector, one_line
from kpbench.errors import DataError
from kpbench.files import PACKAGE
from kpbench.images import ImageSource, image_writer
from kpbench.types import Detections, Predictions, UInt8
from kpbench.workers import Progress, run_jobs


@dataclass(frozen=True)
class Predicted:
    """What a detector found, and (image, message) of every image that could not be read or on which it raised.

    Such an image counts as no detections.
    """

    predictions: Predictions
    failures: tuple[tuple[str, str], ...]


Found = tuple[Detections, str]


def predict(
    dataset: Dataset,
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
        for results in run_jobs(work, pieces, workers, progress):
            found.update(results)
        for n in range(len(dataset)) if overlay is not None else ():
            draw(f"{ids[n]:08d}.png", draw_detections(dataset.image(n), found[n][0]))
    labels = [f"image_id {image_id}" for image_id in ids]
    return _predicted(loaded, [found[n] for n in range(len(dataset))], labels, ids, dataset)


def predict_images(
    source: ImageSource,
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
    dataset: Dataset | None = None,
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
    dataset: Dataset, detector: str | LoadedDetector, threshold: float | None, piece: range, progress: Progress
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
