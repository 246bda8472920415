"""The commands that score predictions files and compare them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kpbench.cli.options import Finite

if TYPE_CHECKING:
    from kpbench.dataset.folder import Dataset
    from kpbench.predictions.coco import CocoDataset
    from kpbench.report.tables import Table
    from kpbench.scoring.board_pose import PoseGroup
    from kpbench.scoring.comparison import Comparison
    from kpbench.scoring.scores import Scores
    from kpbench.types import Predictions


class Limit(click.ParamType[tuple[str, float]]):
    """``METRIC=VALUE``, as a tuple; the metric must exist."""

    name = "METRIC=VALUE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        from kpbench.scoring.metrics import METRICS

        if isinstance(value, tuple):
            return value
        metric, _, number = str(value).partition("=")
        if metric not in METRICS:
            self.fail(f"there is no metric {metric!r}, only {', '.join(METRICS)}", param, ctx)
        try:
            limit = float(number)
        except ValueError:
            limit = float("nan")
        if limit != limit:
            self.fail(f"{value!r} sets no limit, expected METRIC=VALUE such as {metric}=0.9", param, ctx)
        return metric, limit


FILE = click.Path(dir_okay=False, path_type=Path)


def how_to_score(command: Callable[..., None]) -> Callable[..., None]:
    """The options that say what a match is, and against which truth."""
    options = (
        click.option(
            "--gt",
            type=click.Path(path_type=Path),
            help="Dataset, or COCO annotations (.json); else the one that the predictions name, else ./kpbench-data.",
        ),
        click.option("--eps", type=Finite(min=0), default=0.1, show_default=True, help="Reach of a match, in radii."),
        click.option(
            "--eps-radius",
            type=click.Choice(["major", "minor", "mean"]),
            default="major",
            show_default=True,
            help="Which semi-axis of a tilted disc --eps is a share of.",
        ),
        click.option(
            "--matching",
            type=click.Choice(["one-to-one", "literal"]),
            default="one-to-one",
            show_default=True,
            help="literal: the paper's formulas as printed, where several detections of a keypoint all count.",
        ),
        click.option("--allow-missing", is_flag=True, help="An image without prediction has no detections."),
        click.option(
            "--report", "report_file", type=FILE, help="Write tables and charts: .html (one offline page), .md, .tex."
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


@click.command()
@click.argument("preds", type=FILE)
@how_to_score
@click.option("--json", "json_file", type=FILE, help="Write all scores.")
@click.option("--csv", "csv_file", type=FILE, help="Write one row a condition, rung and patch.")
@click.option("--pose", is_flag=True, help="Errors of the board's pose too; for the datasets of a suite.")
@click.option("--min", "least", type=Limit(), multiple=True, help="Exit 1 if a metric is lower; repeatable.")
@click.option("--max", "most", type=Limit(), multiple=True, help="Exit 1 if a metric is higher; repeatable.")
def score(
    preds: Path,
    gt: Path | None,
    report_file: Path | None,
    json_file: Path | None,
    csv_file: Path | None,
    pose: bool,
    least: tuple[tuple[str, float], ...],
    most: tuple[tuple[str, float], ...],
    **how: Any,
) -> None:
    """Score a predictions file (.json, .jsonl, .csv, .parquet, .h5) against a dataset's true keypoints.

    \b
    Examples:
      kpbench score preds.json
      kpbench score preds.json --report report.html
      kpbench score preds.json --gt val --min detection_score=0.95 --max average_false_alarm=0.5
    """
    from kpbench.files import check_targets, write_atomic
    from kpbench.report.figures import pose_table
    from kpbench.report.result_files import provenance, scores_csv, scores_file
    from kpbench.report.tables import to_plain
    from kpbench.scoring.scores import check_gates

    _check_report(report_file)
    check_targets((report_file, json_file, csv_file), [preds])
    dataset, (scores,) = _scored([preds], gt, how)
    poses = _poses(scores, dataset) if pose else ()
    tables = [pose_table(scores, poses)] if poses else []
    known = provenance(dataset, [preds], ["kpbench", *sys.argv[1:]])
    if json_file:
        write_atomic(json_file, scores_file(scores, known, poses))
    if csv_file:
        write_atomic(csv_file, scores_csv(scores, known))
    if report_file:
        _write_report(report_file, [scores], dataset, known, poses=tables)
    click.echo(f"predictions  {preds}{f', {scores.name}' if scores.detector else ''}")
    click.echo(f"dataset      {dataset.path}, fingerprint {dataset.fingerprint[:16]}")
    click.echo(_summary(scores))
    for table in tables:
        click.echo(f"\n{table.title}\n{to_plain(table)}")
    check_gates(scores, dict(least), dict(most))


@click.command()
@click.argument("files", nargs=-1, required=True, type=FILE)
@how_to_score
@click.option("--json", "json_file", type=FILE, help="Write all differences.")
@click.option("--fail-on-regression", is_flag=True, help="Exit 1 if the first is worse over all images.")
def compare(
    files: tuple[Path, ...],
    gt: Path | None,
    report_file: Path | None,
    json_file: Path | None,
    fail_on_regression: bool,
    **how: Any,
) -> None:
    """Compare the first of several predictions files with each of the others, on the same dataset.

    Differences are paired: their 95 % intervals resample the scenes for both alike. With --fail-on-regression the exit
    code is 1 if detection score, ID matching score or false alarms of the first are worse over all images and the
    interval of the difference leaves out 0.

    \b
    Examples:
      kpbench compare new.json old.json --fail-on-regression
      kpbench compare a.json b.json c.json --report compared.html
    """
    from kpbench.files import check_targets, write_atomic
    from kpbench.report.figures import difference_table, verdict_table
    from kpbench.report.result_files import comparison_file, provenance
    from kpbench.report.tables import to_plain
    from kpbench.scoring.comparison import check_regression
    from kpbench.scoring.comparison import compare as compare_scores

    if len(files) < 2:
        raise click.UsageError("expected two or more predictions files")
    _check_report(report_file)
    check_targets((report_file, json_file), files)
    dataset, (first, *others) = _scored(files, gt, how)
    comparisons = [compare_scores(first, other) for other in others]
    known = provenance(dataset, files, ["kpbench", *sys.argv[1:]])
    if json_file:
        write_atomic(json_file, comparison_file(comparisons, known))
    if report_file:
        _write_report(report_file, [first, *others], dataset, known, comparisons)
    click.echo(f"dataset {dataset.path}, fingerprint {dataset.fingerprint[:16]}")
    for table in (verdict_table(comparisons), *map(difference_table, comparisons)):
        click.echo(f"\n{table.title}\n{to_plain(table)}")
    if fail_on_regression:
        check_regression(comparisons)


def _check_report(path: Path | None) -> None:
    from kpbench.report.report import WRITERS

    if path and path.suffix.lower() not in WRITERS:
        raise click.UsageError(f"--report {path}: expected a file ending in {', '.join(WRITERS)}")


def _scored(files: Sequence[Path], gt: Path | None, how: dict[str, Any]) -> tuple[Dataset | CocoDataset, list[Scores]]:
    """The dataset of the first file, and the scores of all; detectors of one name are told apart by their files."""
    from dataclasses import replace

    from kpbench.errors import PredictionsError
    from kpbench.predictions.files import read_predictions
    from kpbench.scoring.scores import score as score_all

    predictions = [read_predictions(path) for path in files]
    dataset = _dataset_of(predictions[0], files[0], gt)
    scores: list[Scores] = []
    for path, found in zip(files, predictions, strict=True):
        try:
            scores.append(score_all(dataset, found, **how))
        except PredictionsError as error:
            raise PredictionsError(f"{path} does not fit {dataset.path}: {error}") from None
    names = [run.name for run in scores]
    for n, run in enumerate(scores):
        if names.count(run.name) > 1:
            scores[n] = replace(run, name=f"{run.name} {files[n]}")
    return dataset, scores


def _poses(scores: Scores, dataset: Dataset | CocoDataset) -> tuple[PoseGroup, ...]:
    from kpbench.errors import DataError
    from kpbench.scoring.board_pose import pose_errors, pose_groups
    from kpbench.synth.suite import board_in_view

    view = board_in_view(dataset.config)
    if view is None:
        raise DataError(f"{dataset.path}: shows no board that is known, --pose needs the dataset of a suite")
    return pose_groups(scores, pose_errors(scores.tally, *view))


def _write_report(
    path: Path,
    runs: Sequence[Scores],
    dataset: Dataset | CocoDataset,
    known: dict[str, Any],
    comparisons: Sequence[Comparison] = (),
    poses: Sequence[Table] = (),
) -> None:
    from kpbench.errors import DataError
    from kpbench.report.report import Report, write_report
    from kpbench.report.worst_cases import Case, worst_cases

    cases: tuple[tuple[Case, ...], ...] = ()
    if path.suffix.lower() == ".html":
        try:
            cases = tuple(worst_cases(run.tally, dataset.image, 12 // len(runs) or 1) for run in runs)
        except DataError as error:
            click.echo(f"kpbench: {path} shows no images: {error}", err=True)
    title = f"{', '.join(run.name for run in runs)} on {dataset.path.name}"
    write_report(path, Report(tuple(runs), dataset.config, cases, known, tuple(comparisons), tuple(poses), title))


def _dataset_of(predictions: Predictions, preds: Path, gt: Path | None) -> Dataset | CocoDataset:
    """--gt, else the dataset that the file names, else ./kpbench-data."""
    from kpbench.dataset.folder import open_dataset
    from kpbench.errors import PredictionsError
    from kpbench.predictions.coco import open_coco

    if gt:
        return open_coco(gt) if gt.suffix.lower() == ".json" and gt.name != "dataset.json" else open_dataset(gt)
    named = predictions.dataset
    for folder in (Path(named), preds.parent / named) if named else ():
        if folder.exists():
            return open_dataset(folder)
    fallback = Path("kpbench-data")
    absent = f"names the dataset {named!r}, which is not here" if named else "names no dataset"
    if not fallback.exists():
        raise PredictionsError(f"{preds}: {absent}, and there is no ./{fallback}; name one with --gt")
    if named and not _is_fingerprint(named):
        click.echo(f"kpbench: {preds} {absent}; scoring against ./{fallback}", err=True)
    return open_dataset(fallback)


def _is_fingerprint(text: str) -> bool:
    return len(text) == 64 and set(text) <= set("0123456789abcdef")


def _summary(scores: Scores) -> str:
    """What the terminal shows."""
    from kpbench.report.figures import group_table
    from kpbench.report.tables import Estimate, Table, cell_text, to_plain
    from kpbench.scoring.metrics import LABELS, PAPER_METRICS

    overall, settings = scores.overall, scores.settings
    # What the paper's formulas give as printed is shown wherever it differs
    same = [m for m in PAPER_METRICS if all(g.metrics[m] == g.metrics[f"{m}_literal"] for g in (overall, *scores.by))]
    n = {name: cell_text(value) for name, value in overall.counts.items()}
    lines = [
        f"match        at most {settings.eps:g} of the {settings.eps_radius} radius, {settings.matching}",
        f"images       {n['images']} in {n['scenes']} scenes, which the 95 % intervals resample",
        f"keypoints    {n['truths']}: {n['matched']} matched ({n['wrong_id']} with a wrong ID), {n['missed']} missed",
        f"detections   {n['detections']}: {n['matched']} matched, {n['duplicate']} duplicates, "
        f"{n['near_miss']} near misses, {n['clutter']} clutter",
        "",
    ]
    for name, label in LABELS.items():
        if name not in {f"{m}_literal" for m in same}:
            estimate = Estimate(overall.metrics[name], overall.intervals.get(name))
            lines.append(f"{label:<30} {cell_text(estimate, 4)}")
    if scores.confusion and any(sum(row) for row in scores.confusion["matrix"]):
        ids = [str(i) for i in scores.confusion["ids"]]
        matrix = tuple((i, *row) for i, row in zip(ids, scores.confusion["matrix"], strict=True))
        lines += ["", "ID of matched detections: true in rows, detected in columns"]
        lines.append(to_plain(Table("", ("", *ids, "other"), matrix)))
    if scores.by:
        lines += ["", to_plain(group_table(scores.by, "", errors=["error_median_px"]), 4)]
    return "\n".join(lines)
