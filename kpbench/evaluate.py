"""Score predictions files: read predictions and truth, score or compare them, write the results and a report."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

from kpbench.dataset.labelled import LabelledImages, open_labelled
from kpbench.errors import DataError, PredictionsError
from kpbench.files import refuse_overwrite
from kpbench.predictions.files import read_predictions
from kpbench.provenance import image_source
from kpbench.report.detail_tables import pose_table
from kpbench.report.report import require_report_suffix, write_report
from kpbench.report.result_files import (
    collect_provenance,
    encode_comparisons,
    encode_images_csv,
    encode_scores,
    encode_scores_csv,
)
from kpbench.report.sections import Report, name_runs
from kpbench.scoring.board_pose import PoseGroup, compute_pose_errors, group_pose_errors
from kpbench.scoring.comparison import Comparison, compare
from kpbench.scoring.scores import Scores, score
from kpbench.types import Predictions
from kpbench.writing import require_writable, write_file

DEFAULT_DATASET = Path("kpbench-data")
"""Default folder of ``kpbench synth``. Scoring uses the folder if no dataset is named or the named one is gone."""
MOST_CASES = 12
"""Largest number of images in the galleries of a report, divided among its detectors."""


class ScoreOptions(TypedDict, total=False):
    """The keyword arguments of :func:`kpbench.score`."""

    eps: float
    eps_radius: Literal["major", "minor", "mean"]
    matching: Literal["one-to-one", "literal"]
    allow_missing: bool
    resamples: int
    seed: int


@dataclass(frozen=True)
class ScoredFile:
    """The result of :func:`score_file`.

    Attributes
    ----------
    scores : Scores
    dataset : LabelledImages
        The dataset that the predictions were scored against.
    poses : tuple of PoseGroup
        Errors of the board's pose; empty if `pose` was False.
    provenance : dict
        Files, digests and versions behind the numbers.

    Examples
    --------
    >>> import kpbench
    >>> scored = kpbench.score_file("preds.json")
    >>> [entry["file"] for entry in scored.provenance["predictions"]]
    ['preds.json']
    """

    scores: Scores
    dataset: LabelledImages
    poses: tuple[PoseGroup, ...]
    provenance: dict[str, Any]


@dataclass(frozen=True)
class ComparedFiles:
    """The result of :func:`compare_files`.

    Attributes
    ----------
    comparisons : tuple of Comparison
        Comparisons of the first file with every other file.
    scores : tuple of Scores
        The scores of each file.
    dataset : LabelledImages
        The dataset that all files were scored against.
    provenance : dict
        Files, digests and versions behind the numbers.

    Examples
    --------
    >>> import kpbench
    >>> compared = kpbench.compare_files(["preds.json", "preds.json"])
    >>> [scores.name for scores in compared.scores]  # file names tell the two detectors apart
    ['oracle preds.json', 'oracle preds.json']
    """

    comparisons: tuple[Comparison, ...]
    scores: tuple[Scores, ...]
    dataset: LabelledImages
    provenance: dict[str, Any]


def score_file(
    predictions: str | Path,
    truth: str | Path | LabelledImages | None = None,
    *,
    pose: bool = False,
    json_file: str | Path | None = None,
    csv_file: str | Path | None = None,
    images_csv_file: str | Path | None = None,
    report_file: str | Path | None = None,
    names: Sequence[str] = (),
    command: Sequence[str] = (),
    warn: Callable[[str], None] = warnings.warn,
    **options: Unpack[ScoreOptions],
) -> ScoredFile:
    """Score a predictions file and write the results to files.

    Parameters
    ----------
    predictions : str or Path
        File ending in .json, .jsonl, .csv, .parquet or .h5.
    truth : str, Path, LabelledImages or None
        Path as for :func:`kpbench.dataset.open_labelled`, or an open dataset. None takes the dataset that the
        predictions name, else the folder ``kpbench-data``.
    pose : bool
        Whether to compute errors of the board's pose also. The dataset must be made from a suite.
    json_file, csv_file, images_csv_file, report_file : str, Path or None
        Files to write: all scores as JSON, one row per group as CSV, one row per image as CSV, and a report (.html, .md
        or .tex; severity curves as .pdf, .png or .svg).
    names : sequence of str
        Name of the detector in the report. Empty: the name in the predictions, without version.
    command : sequence of str
        The command line, for the provenance.
    warn : function
        Called with a line of text if the images for the report are missing, or if the dataset that the predictions
        name is missing.
    **options
        The keyword arguments of :func:`kpbench.score`, such as ``eps=0.2``.

    Returns
    -------
    ScoredFile

    Raises
    ------
    PredictionsError
        If the predictions cannot be read or do not fit the dataset.
    DataError
        If the dataset cannot be read, a file cannot be written, or `pose` is True and the dataset shows no known board.

    Examples
    --------
    >>> import kpbench
    >>> scored = kpbench.score_file("preds.json", json_file="scores.json", report_file="report.html", eps=0.2)
    >>> scored.scores["precision"], scored.dataset.path.name
    (1.0, 'kpbench-data')
    """
    path, to_json, to_report = Path(predictions), _as_path(json_file), _as_path(report_file)
    to_csv, to_images = _as_path(csv_file), _as_path(images_csv_file)
    _refuse_overwrite([path], {"scores": to_json, "table": to_csv, "images": to_images, "report": to_report})
    dataset, [scores] = _score_files([path], truth, warn, options)
    poses = _compute_poses(scores, dataset) if pose else ()
    provenance = collect_provenance(dataset, [path], command)
    if to_json:
        write_file(to_json, encode_scores(scores, provenance, poses))
    if to_csv:
        write_file(to_csv, encode_scores_csv(scores, provenance))
    if to_images:
        write_file(to_images, encode_images_csv(scores))
    if to_report:
        _write_report(to_report, name_runs([scores], names), dataset, provenance, warn, poses=poses)
    return ScoredFile(scores, dataset, poses, provenance)


def compare_files(
    predictions: Sequence[str | Path],
    truth: str | Path | LabelledImages | None = None,
    *,
    json_file: str | Path | None = None,
    report_file: str | Path | None = None,
    names: Sequence[str] = (),
    command: Sequence[str] = (),
    warn: Callable[[str], None] = warnings.warn,
    **options: Unpack[ScoreOptions],
) -> ComparedFiles:
    """Compare the first of several predictions files with every other file, on the same truth.

    Parameters
    ----------
    predictions : sequence of str or Path
        Two or more predictions files.
    truth, command, warn, **options
        As for :func:`score_file`. None as `truth` takes the dataset that the first file names.
    json_file, report_file : str, Path or None
        Files to write: all differences as JSON, and a report (.html, .md or .tex; severity curves as .pdf, .png or
        .svg).
    names : sequence of str
        Names of the detectors, one per file. Empty: the names in the predictions; detectors that share a name are told
        apart by version and file.

    Returns
    -------
    ComparedFiles

    Raises
    ------
    ValueError
        If there are fewer than two files.
    PredictionsError, DataError
        As raised by :func:`score_file`.

    Examples
    --------
    >>> import kpbench
    >>> compared = kpbench.compare_files(["preds.json", "preds.json"], json_file="compared.json")
    >>> compared.comparisons[0].differences[0].verdict
    'even'
    """
    if len(predictions) < 2:
        raise ValueError(f"{len(predictions)} predictions files, expected two or more")
    paths, to_json, to_report = [Path(file) for file in predictions], _as_path(json_file), _as_path(report_file)
    _refuse_overwrite(paths, {"comparison": to_json, "report": to_report})
    dataset, scores = _score_files(paths, truth, warn, options)
    scores = name_runs(scores, names)
    comparisons = tuple(compare(scores[0], other) for other in scores[1:])
    provenance = collect_provenance(dataset, paths, command)
    if to_json:
        write_file(to_json, encode_comparisons(comparisons, provenance))
    if to_report:
        _write_report(to_report, scores, dataset, provenance, warn, comparisons)
    return ComparedFiles(comparisons, tuple(scores), dataset, provenance)


def _as_path(file: str | Path | None) -> Path | None:
    return None if file is None else Path(file)


def _refuse_overwrite(sources: Sequence[Path], targets: Mapping[str, Path | None]) -> None:
    """Raise an error, before any work is done, if a target cannot be written or is a source.

    The keys of ``targets`` are the kinds of the files.
    """
    if report := targets["report"]:
        require_report_suffix(report)
    refuse_overwrite(targets.values(), sources)
    for kind, target in targets.items():
        if target:
            require_writable(target, kind)


def _score_files(
    files: Sequence[Path],
    truth: str | Path | LabelledImages | None,
    warn: Callable[[str], None],
    options: ScoreOptions,
) -> tuple[LabelledImages, list[Scores]]:
    """Score all files against the dataset of the first file.

    If detectors share a name, the names of their files are appended.
    """
    predictions = [read_predictions(path) for path in files]
    dataset = _find_dataset(predictions[0], files[0], truth, warn)
    scores: list[Scores] = []
    for path, found in zip(files, predictions, strict=True):
        try:
            scores.append(score(dataset, found, **options))
        except PredictionsError as error:
            raise PredictionsError(f"{path} does not fit {dataset.path}: {error}") from None
    names = [run.name for run in scores]
    return dataset, [
        replace(run, name=f"{run.name} {path}") if names.count(run.name) > 1 else run
        for run, path in zip(scores, files, strict=True)
    ]


def _find_dataset(
    predictions: Predictions, file: Path, truth: str | Path | LabelledImages | None, warn: Callable[[str], None]
) -> LabelledImages:
    """Open the dataset ``truth``, else the dataset that the predictions name, else ``kpbench-data``."""
    if truth is not None:
        return open_labelled(truth) if isinstance(truth, str | Path) else truth
    named = predictions.dataset
    for folder in (Path(named), file.parent / named) if named else ():
        if os.path.exists(folder):  # Path.exists raises an error for a name that is too long
            return open_labelled(folder)
    problem = f"names the dataset {named!r}, which is not here" if named else "names no dataset"
    if not DEFAULT_DATASET.exists():
        raise PredictionsError(f"{file}: {problem}, and there is no ./{DEFAULT_DATASET}; name one with `truth`")
    if named and not re.fullmatch("[0-9a-f]{64}", named):  # a fingerprint names no folder that could be missing
        warn(f"{file} {problem}; scoring against ./{DEFAULT_DATASET}")
    return open_labelled(DEFAULT_DATASET)


def _compute_poses(scores: Scores, dataset: LabelledImages) -> tuple[PoseGroup, ...]:
    from kpbench.synth.suite_boards import board_in_view  # imported here, because few runs need it and it loads OpenCV

    view = board_in_view(dataset.config)
    if view is None:
        raise DataError(f"{dataset.path}: shows no known board, `pose=True` needs the dataset of a suite")
    return group_pose_errors(scores, compute_pose_errors(scores.outcomes, *view))


def _write_report(
    path: Path,
    runs: Sequence[Scores],
    dataset: LabelledImages,
    provenance: Mapping[str, Any],
    warn: Callable[[str], None],
    comparisons: Sequence[Comparison] = (),
    poses: Sequence[PoseGroup] = (),
) -> None:
    from kpbench.report.worst_cases import Case, pick_worst_cases  # imported here, because it loads OpenCV

    cases: tuple[tuple[Case, ...], ...] = ()
    if path.suffix.lower() == ".html":
        try:
            cases = tuple(pick_worst_cases(run.outcomes, dataset.image, MOST_CASES // len(runs) or 1) for run in runs)
        except DataError as error:
            warn(f"{path} shows no images: {error}")
    source = image_source(dataset.config)
    title = f"{', '.join(run.name for run in runs)} on {dataset.path.name}{f', {source}' if source else ''}"
    tables = (pose_table(runs[0], poses),) if poses else ()
    write_report(path, Report(tuple(runs), dataset.config, cases, provenance, tuple(comparisons), tables, title))
