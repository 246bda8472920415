"""Run detectors over datasets, and over images without truth."""

from __future__ import annotations

import contextlib
import math
import platform
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kpbench.dataset.drawing import draw_detections, enlarge_for_drawing
from kpbench.dataset.folder import Dataset
from kpbench.detectors.interface import LoadedDetector, in_one_line, load_detector
from kpbench.detectors.inverted import InvertedPrints
from kpbench.errors import DataError
from kpbench.files import PACKAGE
from kpbench.images import UNDECODABLE, ImageSource, image_writer
from kpbench.memory import peak_mib
from kpbench.opencv import opencv_version, warn_of_opencv
from kpbench.predictions.coco import CocoDataset
from kpbench.types import Detections, Int, Predictions, UInt8
from kpbench.workers import Progress, count_cores, run_jobs

IMAGES_PER_PIECE = 32
"""Number of images that a worker process gets at a time."""


@dataclass(frozen=True)
class PredictionRun:
    """The result of running a detector over images.

    Attributes
    ----------
    predictions : Predictions
        A failed image has no detections.
    failures : tuple of (str, str)
        Name and message of each image that could not be read or on which the detector raised an error.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.predict(kpbench.open_dataset("kpbench-data"), "sift").predictions.detector["name"]
    'sift'
    """

    predictions: Predictions
    failures: tuple[tuple[str, str], ...]


class ImageResult(NamedTuple):
    """What a detector found in an image."""

    detections: Detections
    problem: str = ""
    """The error message; "" if the image did not fail."""
    size: tuple[int, int] = (0, 0)
    """Width and height, px; 0 for an image that cannot be decoded."""
    ms: float = math.nan
    """Time that the detector took, milliseconds; nan for an image that failed."""


Sink = Callable[[Predictions], None]
"""A function of the predictions of some images."""
Decorate = Callable[[Detections, tuple[int, int], UInt8], None]
"""A function of the detections of an image, its width and height in px, and its picture, RGB, that it draws into."""


def predict(
    source: Dataset | CocoDataset | ImageSource,
    detector: str | LoadedDetector,
    *,
    threshold: float | None = None,
    workers: int | None = 1,
    overlay: Path | None = None,
    decorate: Decorate | None = None,
    progress: Progress = lambda images: None,
    sink: Sink | None = None,
) -> PredictionRun:
    """Run a detector over a dataset, or over images without truth (see :func:`predict_images`).

    Parameters
    ----------
    source : Dataset, CocoDataset or ImageSource
        See :func:`open_source`.
    detector : str or LoadedDetector
        A name as for :func:`kpbench.load_detector`, or a loaded detector.
    threshold : float, optional
        Detections with a lower score are dropped. A detector given by name gets this threshold in place of its own
        threshold. None keeps all detections.
    workers : int, optional
        Number of processes; None for one per core. The processes share the cores: each uses cores / workers threads, in
        OpenCV, BLAS and torch. A loaded detector always runs in the calling process, and so does
        any detector on images without truth.
    overlay : Path, optional
        Folder or video file to draw the detections into, see :func:`kpbench.dataset.draw_detections`. Small images are
        enlarged. The pictures of a dataset also show the truth.
    decorate : callable, optional
        Draws more into each picture, such as the axes of a board.
    progress : callable
        Called with the number of images finished since the last call.
    sink : callable, optional
        Called with the predictions of some images as soon as they are finished, in any order; first with those of no
        image, which tell the detector and the dataset.

    Returns
    -------
    PredictionRun

    Raises
    ------
    DataError
        If the detector cannot be loaded, the detector fails on every image, or the dataset cannot be read.

    Examples
    --------
    >>> import kpbench
    >>> run = kpbench.predict(kpbench.open_dataset("kpbench-data"), "sift")
    >>> len(run.predictions), run.failures
    (6, ())
    """
    if isinstance(source, ImageSource):
        options = {"threshold": threshold, "overlay": overlay, "decorate": decorate, "progress": progress, "sink": sink}
        return predict_images(source, detector, **options)  # type: ignore[arg-type]
    dataset = source
    warn_of_opencv()
    loaded = load_detector(detector, threshold) if isinstance(detector, str) else detector
    if not isinstance(detector, str):
        workers = 1
    count, size = len(dataset), IMAGES_PER_PIECE
    pieces = [range(first, min(first + size, count)) for first in range(0, count, size)]
    work = partial(detect_images, dataset, loaded if workers == 1 else detector, threshold)
    found: dict[int, ImageResult] = {}
    ids = dataset.truth.image_id
    names = [f"{image_id:08d}.png" for image_id in ids]
    pass_on = _pass_on(sink, loaded, dataset)
    with image_writer(overlay, count, names=names) as draw:
        for results in run_jobs(work, pieces, workers, progress, share_cores=True):
            found.update(results)
            pass_on([*results.values()], [], ids[[*results]])
        for n in range(count) if overlay is not None else ():
            draw(names[n], _draw(loaded, dataset.image(n), found[n].detections, decorate, dataset.keypoints(n)))
    labels = [f"image_id {image_id}" for image_id in ids]
    return _finish(loaded, [found[n] for n in range(count)], labels, ids, dataset)


def predict_images(
    source: ImageSource,
    detector: str | LoadedDetector,
    *,
    threshold: float | None = None,
    overlay: Path | None = None,
    decorate: Decorate | None = None,
    progress: Progress = lambda images: None,
    sink: Sink | None = None,
) -> PredictionRun:
    """Run a detector over images that have no truth.

    The ``image_id`` of an image is its position in the source.

    Parameters
    ----------
    source : ImageSource
        From :func:`kpbench.images.open_images`. Ctrl-C ends a source of unknown length, such as a camera, and keeps the
        detections so far.
    detector, threshold, overlay, decorate, progress, sink
        As for :func:`predict`.

    Returns
    -------
    PredictionRun

    Raises
    ------
    DataError
        If the detector cannot be loaded or fails on every image.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.detectors import predict_images
    >>> from kpbench.images import ImageSource
    >>> images = iter([("a.png", np.full((48, 64), 128, np.uint8)), ("broken.png", None)])
    >>> predict_images(ImageSource(images, 2), "template").failures
    (('broken.png', 'cannot be decoded'),)
    """
    warn_of_opencv()
    loaded = load_detector(detector, threshold) if isinstance(detector, str) else detector
    found, labels, inverted = list[ImageResult](), list[str](), InvertedPrints(loaded)
    pass_on = _pass_on(sink, loaded, source)
    ends_by = () if source.length is not None else (KeyboardInterrupt,)
    with image_writer(overlay, source.length, source.fps, source.names) as draw, contextlib.suppress(*ends_by):
        for label, image in source.images:
            if image is None:
                result = ImageResult(Detections.none(), source.problems.get(label, UNDECODABLE))
            else:
                result = _detect(loaded, image, threshold)
                inverted.look(label, image, result.detections)
            found.append(result)
            labels.append(label)
            pass_on([result], [label], np.array([len(found) - 1]))
            drawn = None if image is None or overlay is None else _draw(loaded, image, result.detections, decorate)
            draw(label, drawn)
            progress(1)
    return _finish(loaded, found, labels, np.arange(len(found)), source)


def _draw(
    detector: LoadedDetector,
    image: UInt8,
    found: Detections,
    decorate: Decorate | None,
    truth: NDArray[Any] | None = None,
) -> UInt8:
    """Return the picture of an image for ``overlay``."""
    names = {patch.patch_id: patch.name for patch in detector.patches}
    below = None if decorate is None else partial(decorate, found, _size(image))
    return draw_detections(image, found, names, truth, enlarge_for_drawing(image), draw_below=below)


def _finish(
    detector: LoadedDetector,
    found: list[ImageResult],
    labels: list[str],
    ids: Int,
    source: Dataset | CocoDataset | ImageSource,
) -> PredictionRun:
    failures = tuple((label, r.problem) for label, r in zip(labels, found, strict=True) if r.problem)
    if found and len(failures) == len(found):
        if isinstance(source, ImageSource):
            first = source.describe_failures(failures)[0]
        else:
            first = f"{source.path}, {labels[0]}: {found[0].problem}"
        raise DataError(f"detector {detector.name}: failed on all {len(found)} images, first {first}")
    return PredictionRun(_collect(detector, found, labels, ids, source), failures)


def record_cost(predictions: Predictions) -> Predictions:
    """Return predictions whose description of the detector tells what this process took, as ``cost``.

    ``cost`` holds median and 95th percentile of the time per image (ms), peak memory of a process (MiB; None if the
    system does not tell), and the machine.

    Examples
    --------
    >>> import kpbench
    >>> run = kpbench.predict(kpbench.open_dataset("kpbench-data"), "sift")
    >>> sorted(kpbench.detectors.record_cost(run.predictions).detector["cost"])
    ['machine', 'ms_median', 'ms_p95', 'peak_mib']
    """
    ms = np.zeros(0) if predictions.ms is None else predictions.ms[np.isfinite(predictions.ms)]
    median, high = (round(float(v), 3) for v in np.quantile(ms, (0.5, 0.95))) if len(ms) else (None, None)
    machine = f"{platform.system()} {platform.machine()}, {count_cores()} cores"
    cost = {"ms_median": median, "ms_p95": high, "peak_mib": peak_mib(), "machine": machine}
    return replace(predictions, detector=predictions.detector | {"cost": cost})


def _pass_on(
    sink: Sink | None, detector: LoadedDetector, source: Dataset | CocoDataset | ImageSource
) -> Callable[[list[ImageResult], list[str], Int], None]:
    """Return a function that gives the predictions of some images to ``sink``, and give it those of no image."""

    def pass_on(found: list[ImageResult], labels: list[str], ids: Int) -> None:
        if sink is not None:
            sink(_collect(detector, found, labels, ids, source))

    pass_on([], [], np.zeros(0, np.int64))
    return pass_on


def _collect(
    detector: LoadedDetector,
    found: list[ImageResult],
    labels: list[str],
    ids: Int,
    source: Dataset | CocoDataset | ImageSource,
) -> Predictions:
    about = {"name": detector.name, "version": detector.version, "opencv": opencv_version()}
    of_dataset: dict[str, Any] = {"size": [r.size for r in found], "ms": [r.ms for r in found]}
    if not isinstance(source, ImageSource):
        of_dataset |= {"dataset": str(source.path), "fingerprint": source.fingerprint}
        of_dataset["truth_digest"] = source.truth.digest
    elif found:
        located = zip(*map(source.locate, labels), strict=True)
        of_dataset |= dict(zip(("file", "frame_index", "time_s"), located, strict=True))
    return Predictions.from_detections([r.detections for r in found], ids, about, **of_dataset)


def _detect(detector: LoadedDetector, image: UInt8, threshold: float | None) -> ImageResult:
    start = time.perf_counter()
    try:
        found = detector(image)
    except (Exception, SystemExit) as error:  # a user's detector may raise any exception
        problem = f"{type(error).__name__}: {in_one_line(error)}{_user_line(error)}"
        return ImageResult(Detections.none(), problem, _size(image))
    return ImageResult(_apply_threshold(found, threshold), "", _size(image), _ms_since(start))


def _size(image: UInt8) -> tuple[int, int]:
    return image.shape[1], image.shape[0]


def _ms_since(start: float) -> float:
    """Return the time since ``start``, milliseconds, to the microsecond."""
    return round(1000 * (time.perf_counter() - start), 3)


def _apply_threshold(found: Detections, threshold: float | None) -> Detections:
    return found if threshold is None else found[found.score >= threshold]


def _user_line(error: BaseException) -> str:
    """Return file and line of the last call outside kpbench in an error's traceback; "" if kpbench made all calls."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if PACKAGE not in Path(frame.filename).parents]
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""


@cache
def _load_once(name: str, threshold: float | None) -> LoadedDetector:
    return load_detector(name, threshold)


def detect_images(
    dataset: Dataset | CocoDataset,
    detector: str | LoadedDetector,
    threshold: float | None,
    positions: Sequence[int],
    progress: Progress,
) -> dict[int, ImageResult]:
    """Run a detector over some images of a dataset.

    The parameters that are not listed below are described at :func:`predict`.

    Parameters
    ----------
    positions : sequence of int
        Positions of the images in the dataset.

    Returns
    -------
    dict
        Position → :class:`ImageResult`.
    """
    loaded = _load_once(detector, threshold) if isinstance(detector, str) else detector
    if loaded.run_many is not None:
        with contextlib.suppress(Exception):  # after an error, the loop below tries the images one by one
            images = [dataset.image(n) for n in positions]
            start = time.perf_counter()
            batch = loaded.detect_many(images)
            ms = round(_ms_since(start) / len(images), 3)
            progress(len(positions))
            return {
                n: ImageResult(_apply_threshold(found, threshold), "", _size(image), ms)
                for n, image, found in zip(positions, images, batch, strict=True)
            }
    results: dict[int, ImageResult] = {}
    for n in positions:
        results[n] = _detect(loaded, dataset.image(n), threshold)
        progress(1)
    return results
