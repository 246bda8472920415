"""Run detectors over datasets in parts. Each part has a file of detections, so that an interrupted run can resume."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from kpbench.dataset.folder import Dataset
from kpbench.dataset.labelled import open_labelled
from kpbench.detectors.prediction import detect_images
from kpbench.errors import DataError
from kpbench.files import make_folder
from kpbench.predictions.coco import CocoDataset
from kpbench.predictions.files import read_predictions, write_predictions
from kpbench.types import Predictions
from kpbench.workers import Progress, run_jobs
from kpbench.writing import remove_file, remove_leftovers, require_writable

IMAGES_PER_PART = 32
"""Number of images in a part. Each part has a file of detections until all parts are joined."""


@dataclass(frozen=True)
class DetectionPart:
    """A job: run a detector over some images of a dataset, and keep its detections in a file.

    ``description`` holds the detector's name and version. ``first`` is the position of the first image in the dataset.
    """

    dataset: Path
    fingerprint: str
    detector: str
    description: dict[str, Any]
    first: int
    count: int
    file: Path


def plan_parts(
    dataset: Dataset | CocoDataset, detector: str, description: dict[str, Any], file: Path
) -> list[DetectionPart]:
    """Return the parts of a predictions file."""
    return [
        DetectionPart(
            dataset.path,
            dataset.fingerprint,
            detector,
            description,
            first,
            min(IMAGES_PER_PART, len(dataset) - first),
            file.with_suffix(".parts") / f"{first:08d}.json",
        )
        for first in range(0, len(dataset), IMAGES_PER_PART)
    ]


def prepare_parts(parts: Sequence[DetectionPart]) -> None:
    """Make the folder for the files of the parts, and refuse files in it that kpbench did not write.

    The folder is no symbolic link: the files behind a link may be those of another run.
    """
    folder = parts[0].file.parent
    if folder.is_symlink():
        raise DataError(f"{folder}: is a symbolic link, expected a folder of this run; remove the link")
    make_folder(folder)
    for part in parts:
        require_writable(part.file, "predictions")


def remove_parts(parts: Sequence[DetectionPart]) -> None:
    """Remove the files of the parts, and their folder if nothing else lies in it."""
    folder = parts[0].file.parent
    if folder.is_symlink():
        return
    for part in parts:
        remove_file(part.file, "predictions")
    with suppress(OSError):  # a file of the user's
        folder.rmdir()


def detect_parts(parts: Sequence[DetectionPart], workers: int | None, progress: Progress) -> None:
    """Run all parts whose files do not exist."""
    missing = [part for part in parts if not part.file.exists()]
    progress(sum(part.count for part in parts) - sum(part.count for part in missing))
    try:
        for _ in run_jobs(_detect_part, missing, workers, progress, share_cores=True):
            pass
    except BaseException:
        remove_leftovers(part.file for part in missing)  # of killed workers
        raise


def _detect_part(part: DetectionPart, progress: Progress) -> None:
    dataset = _open_once(part.dataset, part.fingerprint)
    images = range(part.first, part.first + part.count)
    found = detect_images(dataset, part.detector, None, images, progress)
    ids = [int(dataset.truth.image_id[n]) for n in images]
    failures = [[image_id, found[n][1]] for n, image_id in zip(images, ids, strict=True) if found[n][1]]
    detections, description = [found[n][0] for n in images], part.description | _describe_failures(failures)
    digests = dataset.fingerprint, dataset.truth.digest
    predictions = Predictions.from_detections(detections, ids, description, str(dataset.path), *digests)
    write_predictions(part.file, predictions)


def _describe_failures(failures: list[list[Any]]) -> dict[str, Any]:
    """Return the field ``failures`` of a detector's description; an empty dict without failures."""
    return {"failures": failures} if failures else {}


@cache
def _open_once(path: Path, fingerprint: str) -> Dataset | CocoDataset:
    """Open a dataset once per process and fingerprint, as the dataset at a path may be replaced."""
    return open_labelled(path)


def join_parts(planned: Sequence[DetectionPart], file: Path) -> None:
    """Write a predictions file from its parts, and remove the parts."""
    parts = [read_predictions(part.file) for part in planned]
    failures = [failure for part in parts for failure in part.detector.get("failures", [])]
    description = parts[0].detector | _describe_failures(failures)
    found = [detections for part in parts for detections in part.detections()]
    ids = np.concatenate([part.image_id for part in parts])
    of_dataset = parts[0].dataset, parts[0].fingerprint, parts[0].truth_digest
    predictions = Predictions.from_detections(found, ids, description, *of_dataset)
    write_predictions(file, predictions)
    remove_parts(planned)
