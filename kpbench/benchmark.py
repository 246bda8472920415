"""The benchmark: suites, detectors over them, scores; what is done is kept, and an interrupted run goes on.

Everything lies in one folder, under names that hold what it was made from: a dataset's by its config, predictions
by the dataset's fingerprint and by the detector's version, settings and weights. So nothing that is found there
can be stale, and nothing has to be told to be resumed. A detector that tells no version looks again at each call.
Scoring takes seconds and is always done again.
"""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from kpbench import __version__
from kpbench.dataset.folder import MANIFEST, Dataset, open_dataset
from kpbench.dataset.generation import generate
from kpbench.dataset.shard import canonical_json
from kpbench.detectors.interface import LoadedDetector, load_detector
from kpbench.detectors.prediction import detect_some
from kpbench.errors import DataError
from kpbench.files import make_folder, require_own_folder, write_atomic
from kpbench.patches.design import shipped_patches
from kpbench.predictions.files import read_predictions, write_predictions
from kpbench.report.paper import PAPER
from kpbench.report.report import Report, write_report
from kpbench.report.result_files import collect_provenance, encode_scores
from kpbench.report.score_tables import breakpoint_table, overview_table, paper_table
from kpbench.report.tables import Table
from kpbench.scoring.scores import Scores, score
from kpbench.synth.suite import SuiteConfig
from kpbench.types import Predictions
from kpbench.workers import Progress, run_jobs

PART = 32  # images whose detections are kept together


@dataclass(frozen=True)
class Benched:
    """One detector on one suite.

    Attributes
    ----------
    config : SuiteConfig
        With the board that the detector looks for.
    dataset : Dataset
    predictions : Path
    scores : Scores
    failures : tuple of (image_id, message)
        Images on which the detector raised; they count as no detections.
    """

    config: SuiteConfig
    dataset: Dataset
    predictions: Path
    scores: Scores
    failures: tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class SuiteReport:
    """The results of one suite.

    Attributes
    ----------
    suite : str
    tables : tuple of Table
        All detectors over all images, the paper's tables with our runs, and the breakpoints.
    page : Path
        The report (HTML).
    scores : Path
        Folder with one scores file per detector.
    """

    suite: str
    tables: tuple[Table, ...]
    page: Path
    scores: Path


@dataclass(frozen=True)
class _Part:
    """Some images of a dataset, to be shown to a detector, and the file for what it finds."""

    dataset: Path
    detector: str
    about: dict[str, Any]
    first: int
    count: int
    file: Path


def images_to_do(suites: Sequence[SuiteConfig], detectors: Sequence[str]) -> int:
    """How often ``progress`` of :func:`bench` will count: images made and images looked at."""
    boards = [load_detector(name).board for name in detectors]
    return sum(replace(suite, board=board).n for suite in suites for board in [*set(boards), *boards])


def bench(
    suites: Sequence[SuiteConfig],
    detectors: Sequence[str],
    out: str | Path,
    *,
    workers: int | None = None,
    progress: Progress = lambda images: None,
) -> list[Benched]:
    """Run detectors over suites, each on its own board, and score them.

    Parameters
    ----------
    suites : sequence of SuiteConfig
        Their ``board`` does not count.
    detectors : names, see :func:`kpbench.detectors.load_detector`.
    out : folder; made if it is not there. What an earlier run finished there is taken over.
    workers : processes; None for one a core. Changes no result.
    progress : called as images are made and looked at.

    Returns
    -------
    list of Benched
        By suite, then by detector.

    Raises
    ------
    DataError
        If a detector cannot be loaded, two have one name, a dataset cannot be made, or the folder holds other files.
    """
    require_own_folder(Path(out), "suites", "a bench")
    loaded = {name: load_detector(name) for name in dict.fromkeys(detectors)}
    labels = [detector.name for detector in loaded.values()]
    if len(set(labels)) < len(labels):
        raise DataError(f"two detectors share a name, among: {', '.join(labels)}")
    datasets: dict[SuiteConfig, Dataset] = {}
    runs: list[tuple[SuiteConfig, Dataset, Path]] = []
    parts: list[_Part] = []
    for suite in suites:
        for name, detector in loaded.items():
            config = replace(suite, board=detector.board)
            if config not in datasets:
                datasets[config] = _make(config, Path(out) / "suites", workers, progress)
            dataset = datasets[config]
            folder = Path(out) / "predictions" / f"{config.name}-{dataset.fingerprint[:8]}"
            file = folder / f"{re.sub(r'[^A-Za-z0-9.]+', '-', detector.name)}-{_mark(detector)[:8]}.json"
            runs.append((config, dataset, file))
            if detector.identity is None:
                _forget(file)
            if file.exists():
                progress(len(dataset))
            else:
                parts += _parts(dataset, name, {"name": detector.name, "version": detector.version}, file)
    _detect(parts, workers, progress)
    for _, _, file in runs:
        if not file.exists():
            _join(file)
    return [_scored(*run) for run in runs]


def _make(config: SuiteConfig, folder: Path, workers: int | None, progress: Progress) -> Dataset:
    made_of = canonical_json([__version__, config.to_dict()]).encode()
    place = folder / f"{config.name}-{hashlib.sha256(made_of).hexdigest()[:8]}"
    if (place / MANIFEST).exists():
        progress(config.n)
        return open_dataset(place)
    return generate(config, place, workers=workers, resume=True, progress=progress).dataset


def _mark(detector: LoadedDetector) -> str:
    """Digest of a detector and of the designs that it looks for."""
    parts = [detector.name, detector.identity, *(patch.digest for patch in shipped_patches())]
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _forget(file: Path) -> None:
    """Remove predictions, whole or in parts."""
    file.unlink(missing_ok=True)
    shutil.rmtree(file.with_suffix(".parts"), ignore_errors=True)


def _parts(dataset: Dataset, detector: str, about: dict[str, Any], file: Path) -> list[_Part]:
    """The parts of a predictions file, in a folder beside it until all are there."""
    folder = make_folder(file.with_suffix(".parts"))
    return [
        _Part(dataset.path, detector, about, first, min(PART, len(dataset) - first), folder / f"{first:08d}.json")
        for first in range(0, len(dataset), PART)
    ]


def _detect(parts: Sequence[_Part], workers: int | None, progress: Progress) -> None:
    todo = [part for part in parts if not part.file.exists()]
    progress(sum(part.count for part in parts) - sum(part.count for part in todo))
    for _ in run_jobs(_detect_part, todo, workers, progress):
        pass


def _detect_part(part: _Part, progress: Progress) -> None:
    dataset = _opened(part.dataset)
    images = range(part.first, part.first + part.count)
    found = detect_some(dataset, part.detector, None, images, progress)
    ids = [int(dataset.truth.image_id[n]) for n in images]
    failures = [[image_id, found[n][1]] for n, image_id in zip(images, ids, strict=True) if found[n][1]]
    detections, about = [found[n][0] for n in images], part.about | _said(failures)
    kept = Predictions.from_detections(detections, ids, about, str(dataset.path), dataset.fingerprint)
    write_predictions(part.file, kept)


def _said(failures: list[list[Any]]) -> dict[str, Any]:
    """What a predictions file says of the images on which its detector raised."""
    return {"failures": failures} if failures else {}


@cache
def _opened(path: Path) -> Dataset:
    return open_dataset(path)


def _join(file: Path) -> None:
    """One predictions file of all its parts, which are then removed."""
    folder = file.with_suffix(".parts")
    parts = [read_predictions(path) for path in sorted(folder.glob("*.json"))]
    about = parts[0].detector | _said([failure for part in parts for failure in part.detector.get("failures", [])])
    found = [detections for part in parts for detections in part.detections()]
    ids = np.concatenate([part.image_id for part in parts])
    write_predictions(file, Predictions.from_detections(found, ids, about, parts[0].dataset, parts[0].fingerprint))
    shutil.rmtree(folder)


def _scored(config: SuiteConfig, dataset: Dataset, file: Path) -> Benched:
    predictions = read_predictions(file)
    failures = tuple((int(image_id), str(said)) for image_id, said in predictions.detector.get("failures", []))
    return Benched(config, dataset, file, score(dataset, predictions), failures)


def write_suite_reports(
    runs: Iterable[Benched], out: str | Path, *, command: Sequence[str] = ()
) -> tuple[SuiteReport, ...]:
    """Write a report per suite and a scores file per detector, and return the tables.

    Parameters
    ----------
    runs : iterable of Benched
        The result of :func:`bench`.
    out : str or Path
        Folder for ``SUITE.html``, ``SUITE.md`` and ``scores/SUITE/DETECTOR.json``.
    command : sequence of str
        The command line, for the provenance.

    Raises
    ------
    DataError
        If a file cannot be written.
    """
    by_suite = groupby(runs, lambda run: run.config.suite.name)
    return tuple(_write_suite_report(suite, tuple(part), Path(out), command) for suite, part in by_suite)


def _write_suite_report(suite: str, runs: Sequence[Benched], out: Path, command: Sequence[str]) -> SuiteReport:
    dataset, scores = runs[0].dataset, tuple(run.scores for run in runs)
    provenance = collect_provenance(dataset.path, dataset.fingerprint, [run.predictions for run in runs], command)
    page = out / f"{suite}.html"
    for path in (page, page.with_suffix(".md")):
        write_report(path, Report(scores, dataset.config, provenance=provenance, title=f"{suite}, simulated"))
    folder = out / "scores" / suite
    folder.mkdir(parents=True, exist_ok=True)
    for run in runs:
        provenance = collect_provenance(run.dataset.path, run.dataset.fingerprint, [run.predictions], command)
        name = f"{run.predictions.stem.rpartition('-')[0]}.json"
        write_atomic(folder / name, encode_scores(run.scores, provenance | {"config": run.dataset.config}))
    patches = [run.scores for run in runs if run.config.board is None]
    tables = [paper_table(patches, PAPER[name]) for run in patches[:1] for name in run.conditions if name in PAPER]
    return SuiteReport(suite, (overview_table(scores), *tables, breakpoint_table(scores)), page, folder)
