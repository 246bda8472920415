"""Run detectors over benchmark suites and score them; keep all finished work, so that an interrupted run can resume.

All results lie in one folder. The name of a dataset's folder contains a digest of the config and of kpbench's version.
The path of a predictions file contains digests of the dataset and of the detector's version, settings and weights.
So changed inputs change the path, and an existing file is always valid. A detector without a version runs again at each
call. Scoring takes seconds and is repeated at each call.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from kpbench import __version__
from kpbench.benchmark.detection import DetectionPart, detect_parts, join_parts, plan_parts, prepare_parts, remove_parts
from kpbench.dataset.folder import MANIFEST, Dataset, open_dataset
from kpbench.dataset.generation import generate
from kpbench.dataset.labelled import COCO_NAMES, open_labelled
from kpbench.dataset.shard import canonical_json
from kpbench.detectors.interface import LoadedDetector, load_detector
from kpbench.errors import DataError
from kpbench.files import make_folder, require_own_folder
from kpbench.locks import lock_folder
from kpbench.opencv import opencv_version, warn_of_opencv
from kpbench.patches.design import shipped_patches
from kpbench.predictions.coco import CocoDataset
from kpbench.predictions.files import read_predictions
from kpbench.scoring.scores import Scores, score
from kpbench.synth.suite import SuiteConfig
from kpbench.text import LONGEST_NAME
from kpbench.workers import Progress
from kpbench.writing import remove_file, require_writable


@dataclass(frozen=True)
class BenchRun:
    """The result of one detector on one suite or dataset.

    Attributes
    ----------
    suite : str
        Name of the suite or dataset, and of its reports.
    config : SuiteConfig or None
        The suite, with the board of the detector; None for a dataset of the user's.
    dataset : Dataset or CocoDataset
    predictions : Path
        The predictions file.
    scores : Scores
    failures : tuple of (image_id, message)
        Images on which the detector raised an error. These images count as images without detections.

    Examples
    --------
    >>> import kpbench
    >>> suite = kpbench.SuiteConfig(kpbench.load_suite("paper-v1"), images=1, size_px=(203, 155), only=("blur",))
    >>> [run] = kpbench.bench([suite], ["orb"], "bench", workers=1)
    >>> run.suite, len(run.dataset), run.predictions.suffix
    ('paper-v1', 16, '.json')
    """

    suite: str
    config: SuiteConfig | None
    dataset: Dataset | CocoDataset
    predictions: Path
    scores: Scores
    failures: tuple[tuple[int, str], ...]


def count_bench_images(suites: Sequence[SuiteConfig], detectors: Sequence[str]) -> int:
    """Count the images that :func:`bench` will report to ``progress``: images made, and images shown to a detector."""
    boards = [load_detector(name).board for name in detectors]
    return sum(replace(suite, board=board).n for suite in suites for board in [*set(boards), *boards])


def bench(
    suites: Sequence[SuiteConfig],
    detectors: Sequence[str],
    out: str | Path,
    *,
    workers: int | None = None,
    progress: Progress = lambda images: None,
) -> list[BenchRun]:
    """Run detectors over suites and score the detectors. Each detector sees the suites on its own board.

    Parameters
    ----------
    suites : sequence of SuiteConfig
        The board of the detector replaces the field ``board``.
    detectors : sequence of str
        Names as for :func:`kpbench.load_detector`.
    out : str or Path
        Folder, new or of an earlier run. Finished work of an earlier run is kept.
    workers : int or None
        Number of processes; None for one per core. The number changes no result.
    progress : function
        Called with the number of images that were made, or shown to a detector, since the last call.

    Returns
    -------
    list of BenchRun
        In the order of the suites, then of the detectors.

    Raises
    ------
    DataError
        If a detector cannot be loaded, the files of two detectors would have the same name, a dataset cannot be made,
        or the folder holds other files.

    Examples
    --------
    >>> import kpbench
    >>> suite = kpbench.SuiteConfig(kpbench.load_suite("paper-v1"), images=1, size_px=(203, 155), only=("blur",))
    >>> [run] = kpbench.bench([suite], ["orb"], "bench", workers=1)
    >>> run.scores.overall.counts["images"], run.failures
    (16, ())
    """
    with _lock_bench(Path(out)):
        loaded = _load_detectors(detectors)
        _require_reports_writable([suite.suite.name for suite in suites], loaded, Path(out))
        datasets: dict[SuiteConfig, Dataset] = {}
        jobs: list[_Job] = []
        for suite in suites:
            for name, detector in loaded.items():
                config = replace(suite, board=detector.board)
                if config not in datasets:
                    datasets[config] = make_suite_dataset(config, Path(out, "suites"), workers, progress)
                jobs.append(_Job(suite.suite.name, config, datasets[config], name, detector))
        return _run_jobs(jobs, Path(out), workers, progress)


def bench_dataset(
    source: str | Path,
    detectors: Sequence[str],
    out: str | Path,
    *,
    workers: int | None = None,
    progress: Progress = lambda images: None,
) -> list[BenchRun]:
    """Run detectors over labelled images and score the detectors, as :func:`bench` does over suites.

    Parameters
    ----------
    source : str or Path
        Labelled images, as for :func:`kpbench.dataset.open_labelled`.
    detectors, out, workers, progress
        See :func:`bench`. Detections in images of COCO annotations are not kept for a next call, because annotations
        do not tell whether an image has changed.

    Returns
    -------
    list of BenchRun
        In the order of the detectors.

    Raises
    ------
    DataError
        If the labelled images cannot be read, a detector looks for tags on another board than the images show, or as
        raised by :func:`bench`.

    Examples
    --------
    >>> import kpbench
    >>> [run] = kpbench.bench_dataset("kpbench-data", ["orb"], "bench", workers=1)
    >>> run.suite, run.scores.overall.counts["images"]
    ('kpbench-data', 6)
    """
    dataset, name = open_labelled(source), _name_dataset(source)
    shown = dataset.config.get("board", {}).get("name")
    with _lock_bench(Path(out)):
        loaded = _load_detectors(detectors)
        for detector in loaded.values():
            if detector.board not in (None, shown):
                seen = f"the board {shown}" if shown else "patches"
                raise DataError(f"{source}: shows {seen}, but {detector.name} looks for the board {detector.board}")
        _require_reports_writable([name], loaded, Path(out))
        return _run_jobs([_Job(name, None, dataset, *pair) for pair in loaded.items()], Path(out), workers, progress)


@dataclass(frozen=True)
class _Job:
    """A detector and the dataset that it looks at, with the names of both."""

    suite: str
    config: SuiteConfig | None
    dataset: Dataset | CocoDataset
    detector: str
    loaded: LoadedDetector


@contextmanager
def _lock_bench(out: Path) -> Iterator[None]:
    """Refuse a folder of other files, and lock the folder."""
    require_own_folder(out, ("suites", "predictions"), "a bench")
    with lock_folder(make_folder(out)):
        yield


def _load_detectors(names: Sequence[str]) -> dict[str, LoadedDetector]:
    loaded = {name: load_detector(name) for name in dict.fromkeys(names)}
    _refuse_equal_files([detector.name for detector in loaded.values()])
    return loaded


def _require_reports_writable(suites: Sequence[str], loaded: dict[str, LoadedDetector], out: Path) -> None:
    for suite in suites:
        for path, kind in _report_files(suite, [d.name for d in loaded.values()], out).items():
            if path.exists():
                require_writable(path, kind)


def _run_jobs(jobs: Sequence[_Job], out: Path, workers: int | None, progress: Progress) -> list[BenchRun]:
    """Run all detectors that have no predictions yet, and score them all."""
    parts, files = dict[Path, list[DetectionPart]](), list[Path]()
    for job in jobs:
        name = job.suite if job.config is None else job.config.name
        folder = out / "predictions" / _file_stem(f"{name}-{job.dataset.fingerprint[:8]}")
        file = folder / f"{_file_stem(job.loaded.name)}-{_digest_detector(job.loaded)[:8]}.json"
        about = {"name": job.loaded.name, "version": job.loaded.version, "opencv": opencv_version()}
        planned = plan_parts(job.dataset, job.detector, about, file)
        files.append(file)
        if job.loaded.identity is None or isinstance(job.dataset, CocoDataset):
            remove_file(file, "predictions")
            remove_parts(planned)
        if file.exists():
            require_writable(file, "predictions")
            progress(len(job.dataset))
        else:
            prepare_parts(planned)
            parts[file] = planned
    warn_of_opencv()
    detect_parts([part for planned in parts.values() for part in planned], workers, progress)
    for file, planned in parts.items():
        join_parts(planned, file)
    return [_score_job(job, file) for job, file in zip(jobs, files, strict=True)]


def _name_dataset(source: str | Path) -> str:
    """Return the name of labelled images as the start of a file name: that of their folder, or of their file."""
    path = Path(source).resolve()
    path = path.parent if path.name in COCO_NAMES else path
    return _file_stem(path.stem if path.suffix == ".json" else path.name) or "dataset"


def _file_stem(name: str) -> str:
    """Return the name of a detector or dataset as the start of a file name."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", name)[:LONGEST_NAME]


def _refuse_equal_files(detectors: Sequence[str]) -> None:
    """Raise an error if the files of two detectors would have one name."""
    for one, two in combinations(detectors, 2):
        if _file_stem(one).casefold() == _file_stem(two).casefold():
            raise DataError(
                f"the scores of the detectors {one!r} and {two!r} would be one file, {_file_stem(one)}.json; "
                "give them other names, or run each with an `out` of its own"
            )


def _report_files(suite: str, detectors: Sequence[str], out: Path) -> dict[Path, str]:
    """Return the files that :func:`write_suite_reports` writes for a suite, and their kinds."""
    scores = [out / "scores" / suite / f"{_file_stem(name)}.json" for name in detectors]
    return {out / f"{suite}.html": "report", out / f"{suite}.md": "report"} | dict.fromkeys(scores, "scores")


def make_suite_dataset(config: SuiteConfig, folder: Path, workers: int | None, progress: Progress) -> Dataset:
    """Make the images of a suite in a subfolder that their configuration names, or open them if they are there."""
    content = canonical_json([__version__, config.to_dict()]).encode()
    place = folder / f"{config.name}-{hashlib.sha256(content).hexdigest()[:8]}"
    if (place / MANIFEST).exists():
        progress(config.n)
        return open_dataset(place)
    return generate(config, place, workers=workers, resume=True, progress=progress).dataset


def _digest_detector(detector: LoadedDetector) -> str:
    """Return a digest of a detector and of all shipped patch designs."""
    parts = [detector.name, detector.identity, *(patch.digest for patch in shipped_patches())]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _score_job(job: _Job, file: Path) -> BenchRun:
    predictions = read_predictions(file)
    failures = tuple((int(image_id), str(message)) for image_id, message in predictions.detector.get("failures", []))
    return BenchRun(job.suite, job.config, job.dataset, file, score(job.dataset, predictions), failures)
