"""References to images of datasets. Worker processes receive references and read the images themselves."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from kpbench.dataset.folder import Dataset, open_dataset
from kpbench.detectors.superpoint import SmallSuperPointDetector, SuperPointDetector
from kpbench.images import to_grey
from kpbench.types import UInt8
from kpbench.workers import run_in_order

Given = TypeVar("Given")
Result = TypeVar("Result")


@dataclass(frozen=True)
class ImageRef:
    """Reference to an image of a dataset.

    Attributes
    ----------
    folder : Path
        Folder of the dataset.
    fingerprint : str
        Fingerprint of the dataset.
    index : int
        Position of the image in the dataset.
    """

    folder: Path
    fingerprint: str
    index: int

    def read(self) -> tuple[UInt8, NDArray[Any]]:
        """Read the image. Return the image in grey, and its true keypoints."""
        image, keypoints = _open_dataset(self.folder, self.fingerprint)[self.index]
        return to_grey(image), keypoints

    def rng(self) -> np.random.Generator:
        """Return a generator of random numbers, seeded with the fingerprint of the dataset and the index."""
        return np.random.default_rng([int(self.fingerprint[:8], 16), self.index])


@cache
def _open_dataset(folder: Path, fingerprint: str) -> Dataset:
    """Open a dataset, once per process. The fingerprint is a key of the cache: a replaced dataset is opened again."""
    return open_dataset(folder)


def image_refs(dataset: Dataset) -> list[ImageRef]:
    """Return references to all images of a dataset."""
    return [ImageRef(dataset.path, dataset.fingerprint, n) for n in range(len(dataset))]


def map_images(
    work: Callable[[ImageRef, Given], Result], dataset: Dataset, given: Iterable[Given], workers: int, label: str
) -> list[Result]:
    """Return ``work(image, argument)`` for every image of a dataset, in the order of the images.

    Parameters
    ----------
    work : callable
        A picklable function of the image and of the image's argument.
    dataset : Dataset
    given : iterable
        One argument per image, in the order of the images.
    workers : int
        Number of worker processes; 0: this process does the work.
    label : str
        Text to the left of the progress bar.
    """
    jobs = list(zip(image_refs(dataset), given, strict=True))
    with progress_bar(label, len(jobs)) as bar:
        results = []
        for result in run_in_order(partial(_apply, work), jobs, workers):
            results.append(result)
            bar.update()
    return results


def _apply(work: Callable[[ImageRef, Given], Result], job: tuple[ImageRef, Given]) -> Result:
    return work(*job)


@contextmanager
def progress_bar(label: str, total: int) -> Iterator[Any]:
    """Show a progress bar on stderr if stderr is a terminal."""
    with tqdm(total=total, desc=label, leave=False, disable=not sys.stderr.isatty()) as bar:
        yield bar


@cache
def load_places_detector(path: Path | None) -> SuperPointDetector:
    """Return the detector whose candidates are judged; each process loads the detector once.

    ``path`` : file of ``kpbench export-model``. None: ``superpoint-small``.
    """
    return SuperPointDetector(path) if path else SmallSuperPointDetector()
