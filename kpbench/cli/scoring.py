"""The command that scores a predictions file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kpbench.cli.options import Finite

if TYPE_CHECKING:
    from kpbench.predictions import Predictions
    from kpbench.scoring import Scores
    from kpbench.store import Dataset

__all__ = ["score"]


class Limit(click.ParamType[tuple[str, float]]):
    """``METRIC=VALUE``, as a tuple; the metric must exist."""

    name = "METRIC=VALUE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        from kpbench.metrics import METRICS

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


@click.command()
@click.argument("preds", type=FILE)
@click.option(
    "--gt", type=click.Path(path_type=Path), help="Dataset; else the one named in PREDS, else ./kpbench-data."
)
@click.option("--eps", type=Finite(min=0), default=0.1, show_default=True, help="Reach of a match, in radii.")
@click.option("--eps-radius", type=click.Choice(["major", "minor", "mean"]), default="major", show_default=True)
@click.option("--matching", type=click.Choice(["one-to-one", "literal"]), default="one-to-one", show_default=True)
@click.option("--allow-missing", is_flag=True, help="An image without prediction has no detections.")
@click.option("--json", "json_file", type=FILE, help="Write all scores.")
@click.option("--csv", "csv_file", type=FILE, help="Write one row a condition, rung and patch.")
@click.option(
    "--report", "report_file", type=FILE, help="Write tables and charts: .html (one offline page), .md, .tex."
)
@click.option("--min", "least", type=Limit(), multiple=True, help="Exit 1 if a metric is lower; repeatable.")
@click.option("--max", "most", type=Limit(), multiple=True, help="Exit 1 if a metric is higher; repeatable.")
def score(
    preds: Path,
    gt: Path | None,
    eps: float,
    eps_radius: Any,
    matching: Any,
    allow_missing: bool,
    json_file: Path | None,
    csv_file: Path | None,
    report_file: Path | None,
    least: tuple[tuple[str, float], ...],
    most: tuple[tuple[str, float], ...],
) -> None:
    """Score a predictions file (.json, .jsonl, .csv, .parquet, .h5) against a dataset's true keypoints.

    \b
    Examples:
      kpbench score preds.json
      kpbench score preds.json --report report.html
      kpbench score preds.json --gt val --min detection_score=0.95 --max average_false_alarm=0.5
    """
    from kpbench.errors import PredictionsError
    from kpbench.predictions import read_predictions
    from kpbench.report import WRITERS, provenance, scores_csv, scores_file
    from kpbench.scoring import check_gates
    from kpbench.scoring import score as score_all
    from kpbench.store import write_atomic

    if report_file and report_file.suffix.lower() not in WRITERS:
        raise click.UsageError(f"--report {report_file}: expected a file ending in {', '.join(WRITERS)}")
    predictions = read_predictions(preds)
    dataset = _dataset_of(predictions, preds, gt)
    try:
        scores = score_all(
            dataset, predictions, eps=eps, eps_radius=eps_radius, matching=matching, allow_missing=allow_missing
        )
    except PredictionsError as error:
        raise PredictionsError(f"{preds} does not fit {dataset.path}: {error}") from None
    known = provenance(dataset, [preds], ["kpbench", *sys.argv[1:]])
    if json_file:
        write_atomic(json_file, scores_file(scores, known))
    if csv_file:
        write_atomic(csv_file, scores_csv(scores, known))
    if report_file:
        _write_report(report_file, scores, dataset, known)
    click.echo(f"predictions  {preds}{f', {scores.name}' if scores.detector else ''}")
    click.echo(f"dataset      {dataset.path}, fingerprint {dataset.fingerprint[:16]}")
    click.echo(_summary(scores))
    check_gates(scores, dict(least), dict(most))


def _write_report(path: Path, scores: Scores, dataset: Dataset, known: dict[str, Any]) -> None:
    from kpbench.gallery import worst_cases
    from kpbench.report import Report, write_report

    pictures = path.suffix.lower() == ".html"
    cases = (worst_cases(scores.tally, dataset.image),) if pictures else ()
    write_report(path, Report((scores,), dataset.config, cases, known, f"{scores.name} on {dataset.path.name}"))


def _dataset_of(predictions: Predictions, preds: Path, gt: Path | None) -> Dataset:
    """--gt, else the dataset that the file names, else ./kpbench-data."""
    from kpbench.errors import PredictionsError
    from kpbench.store import open_dataset

    if gt:
        return open_dataset(gt)
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
    from kpbench.exhibits import group_table
    from kpbench.metrics import LABELS, PAPER_METRICS
    from kpbench.tables import Estimate, Table, cell_text, to_plain

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
