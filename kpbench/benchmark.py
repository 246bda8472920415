"""Run detectors over benchmark suites and score them; keep all finished work, so that an interrupted run can resume.

All results lie in one folder. The name of a dataset's folder contains a digest of the config and of kpbench's version.
The path of a predictions file contains digests of the dataset and of the detector's version, settings and weights.
So changed inputs change the path, and an existing file is always valid. A detector without a version runs again at each
call. Scoring takes seconds and is repeated at each call.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, groupby
from pathlib import Path
from typing import Any

import numpy as np

from kpbench import __version__
from kpbench.dataset.folder import MANIFEST, Dataset, open_dataset
from kpbench.dataset.generation import generate
from kpbench.dataset.shard import canonical_json
from kpbench.detectors.interface import LoadedDetector, load_detector
from kpbench.detectors.prediction import detect_images
from kpbench.errors import DataError
from kpbench.files import make_folder, require_own_folder
from kpbench.locks import lock_folder
from kpbench.opencv import opencv_version, warn_of_opencv
from kpbench.patches.design import shipped_patches
from kpbench.predictions.files import read_predictions, write_predictions
from kpbench.report.paper import PAPER
from kpbench.report.report import Report, write_report
from kpbench.report.result_files import collect_provenance, encode_scores
from kpbench.report.score_tables import breakpoint_table, overview_table, paper_table
from kpbench.report.tables import Table
from kpbench.scoring.scores import Scores, score
from kpbench.synth.suite import SuiteConfig
from kpbench.text import LONGEST_NAME
from kpbench.types import Predictions
from kpbench.workers import Progress, run_jobs
from kpbench.writing import remove_file, remove_leftovers, require_writable, write_file

IMAGES_PER_PART = 32
"""Number of images in a part. Each part has a file of detections until all parts are joined."""


@dataclass(frozen=True)
class BenchRun:
    """The result of one detector on one suite.

    Attributes
    ----------
    config : SuiteConfig
        The suite, with the board of the detector.
    dataset : Dataset
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
    >>> run.config.n, run.predictions.suffix
    (16, '.json')
    """

    config: SuiteConfig
    dataset: Dataset
    predictions: Path
    scores: Scores
    failures: tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class SuiteReport:
    """The results of all detectors on one suite.

    Attributes
    ----------
    suite : str
        Name of the suite.
    tables : tuple of Table
        The main metrics over all images, the paper's tables with rows for the detectors, and the breakpoints.
    page : Path
        The HTML report.
    scores_folder : Path
        Folder with one scores file per detector.

    Examples
    --------
    >>> import kpbench
    >>> from pathlib import Path
    >>> kpbench.SuiteReport("paper-v1", (), Path("paper-v1.html"), Path("scores/paper-v1")).suite
    'paper-v1'
    """

    suite: str
    tables: tuple[Table, ...]
    page: Path
    scores_folder: Path


@dataclass(frozen=True)
class _Part:
    """A job: run a detector over some images of a dataset, and keep its detections in a file.

    ``description`` holds the detector's name and version. ``first`` is the position of the first image in the dataset.
    """

    dataset: Path
    detector: str
    description: dict[str, Any]
    first: int
    count: int
    file: Path


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
    require_own_folder(Path(out), "suites", "a bench")
    with lock_folder(make_folder(Path(out))):
        return _run_bench(suites, detectors, Path(out), workers, progress)


def _run_bench(
    suites: Sequence[SuiteConfig], detectors: Sequence[str], out: Path, workers: int | None, progress: Progress
) -> list[BenchRun]:
    loaded = {name: load_detector(name) for name in dict.fromkeys(detectors)}
    _refuse_equal_files([detector.name for detector in loaded.values()])
    for suite in suites:
        for path, kind in _report_files(suite.suite.name, [d.name for d in loaded.values()], out).items():
            if path.exists():
                require_writable(path, kind)
    datasets: dict[SuiteConfig, Dataset] = {}
    runs: list[tuple[SuiteConfig, Dataset, Path]] = []
    parts: dict[Path, list[_Part]] = {}
    for suite in suites:
        for name, detector in loaded.items():
            config = replace(suite, board=detector.board)
            if config not in datasets:
                datasets[config] = _make_dataset(config, out / "suites", workers, progress)
            dataset = datasets[config]
            folder = out / "predictions" / f"{config.name}-{dataset.fingerprint[:8]}"
            file = folder / f"{_file_stem(detector.name)}-{_digest_detector(detector)[:8]}.json"
            about = {"name": detector.name, "version": detector.version, "opencv": opencv_version()}
            runs.append((config, dataset, file))
            planned = _plan_parts(dataset, name, about, file)
            if detector.identity is None:
                remove_file(file, "predictions")
                _remove_parts(planned)
            if file.exists():
                require_writable(file, "predictions")
                progress(len(dataset))
            else:
                _prepare_parts(planned)
                parts[file] = planned
    warn_of_opencv()
    _detect_parts([part for planned in parts.values() for part in planned], workers, progress)
    for file, planned in parts.items():
        _join_parts(planned, file)
    return [_score_run(*run) for run in runs]


def _file_stem(detector: str) -> str:
    """Return the name of a detector as the start of a file name."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", detector)[:LONGEST_NAME]


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


def _make_dataset(config: SuiteConfig, folder: Path, workers: int | None, progress: Progress) -> Dataset:
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


def _plan_parts(dataset: Dataset, detector: str, description: dict[str, Any], file: Path) -> list[_Part]:
    """Return the parts of a predictions file."""
    return [
        _Part(
            dataset.path,
            detector,
            description,
            first,
            min(IMAGES_PER_PART, len(dataset) - first),
            file.with_suffix(".parts") / f"{first:08d}.json",
        )
        for first in range(0, len(dataset), IMAGES_PER_PART)
    ]


def _prepare_parts(parts: Sequence[_Part]) -> None:
    """Make the folder for the files of the parts, and refuse files in it that kpbench did not write.

    The folder is no symbolic link: the files behind a link may be those of another run.
    """
    folder = parts[0].file.parent
    if folder.is_symlink():
        raise DataError(f"{folder}: is a symbolic link, expected a folder of this run; remove the link")
    make_folder(folder)
    for part in parts:
        require_writable(part.file, "predictions")


def _remove_parts(parts: Sequence[_Part]) -> None:
    """Remove the files of the parts, and their folder if nothing else lies in it."""
    folder = parts[0].file.parent
    if folder.is_symlink():
        return
    for part in parts:
        remove_file(part.file, "predictions")
    with suppress(OSError):  # a file of the user's
        folder.rmdir()


def _detect_parts(parts: Sequence[_Part], workers: int | None, progress: Progress) -> None:
    """Run all parts whose files do not exist."""
    missing = [part for part in parts if not part.file.exists()]
    progress(sum(part.count for part in parts) - sum(part.count for part in missing))
    try:
        for _ in run_jobs(_detect_part, missing, workers, progress, share_cores=True):
            pass
    except BaseException:
        remove_leftovers(part.file for part in missing)  # of killed workers
        raise


def _detect_part(part: _Part, progress: Progress) -> None:
    dataset = _open_once(part.dataset)
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
def _open_once(path: Path) -> Dataset:
    """Open a dataset once per process."""
    return open_dataset(path)


def _join_parts(planned: Sequence[_Part], file: Path) -> None:
    """Write a predictions file from its parts, and remove the parts."""
    parts = [read_predictions(part.file) for part in planned]
    failures = [failure for part in parts for failure in part.detector.get("failures", [])]
    description = parts[0].detector | _describe_failures(failures)
    found = [detections for part in parts for detections in part.detections()]
    ids = np.concatenate([part.image_id for part in parts])
    of_dataset = parts[0].dataset, parts[0].fingerprint, parts[0].truth_digest
    predictions = Predictions.from_detections(found, ids, description, *of_dataset)
    write_predictions(file, predictions)
    _remove_parts(planned)


def _score_run(config: SuiteConfig, dataset: Dataset, file: Path) -> BenchRun:
    predictions = read_predictions(file)
    failures = tuple((int(image_id), str(message)) for image_id, message in predictions.detector.get("failures", []))
    return BenchRun(config, dataset, file, score(dataset, predictions), failures)


def write_suite_reports(
    runs: Iterable[BenchRun], out: str | Path, *, command: Sequence[str] = ()
) -> tuple[SuiteReport, ...]:
    """Write a report per suite, and a scores file per suite and detector.

    Parameters
    ----------
    runs : iterable of BenchRun
        The result of :func:`bench`.
    out : str or Path
        Folder for ``SUITE.html``, ``SUITE.md`` and ``scores/SUITE/DETECTOR.json``.
    command : sequence of str
        The command line, for the provenance.

    Returns
    -------
    tuple of SuiteReport

    Raises
    ------
    DataError
        If a file cannot be written.

    Examples
    --------
    >>> import kpbench
    >>> suite = kpbench.SuiteConfig(kpbench.load_suite("paper-v1"), images=1, size_px=(203, 155), only=("blur",))
    >>> runs = kpbench.bench([suite], ["orb"], "bench", workers=1)
    >>> [report] = kpbench.write_suite_reports(runs, "bench")
    >>> report.page.as_posix(), report.tables[0].title
    ('bench/paper-v1.html', 'All images')
    """
    by_suite = groupby(runs, lambda run: run.config.suite.name)
    return tuple(_write_suite_report(suite, tuple(part), Path(out), command) for suite, part in by_suite)


def _write_suite_report(suite: str, runs: Sequence[BenchRun], out: Path, command: Sequence[str]) -> SuiteReport:
    dataset, scores = runs[0].dataset, tuple(run.scores for run in runs)
    provenance = collect_provenance(dataset.path, dataset.fingerprint, [run.predictions for run in runs], command)
    page = out / f"{suite}.html"
    for path in (page, page.with_suffix(".md")):
        write_report(path, Report(scores, dataset.config, provenance=provenance, title=f"{suite}, simulated"))
    folder = make_folder(out / "scores" / suite)
    for run in runs:
        provenance = collect_provenance(run.dataset.path, run.dataset.fingerprint, [run.predictions], command)
        name = f"{run.predictions.stem.rpartition('-')[0]}.json"
        write_file(folder / name, encode_scores(run.scores, provenance | {"config": run.dataset.config}))
    patches = [run.scores for run in runs if run.config.board is None]
    tables = [paper_table(patches, PAPER[name]) for run in patches[:1] for name in run.conditions if name in PAPER]
    return SuiteReport(suite, (overview_table(scores), *tables, breakpoint_table(scores)), page, folder)
