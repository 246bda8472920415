"""The command that scores a predictions file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kpbench.cli.options import Finite

if TYPE_CHECKING:
    from kpbench.predictions import Predictions
    from kpbench.scoring import Group, Scores
    from kpbench.store import Dataset

__all__ = ["score"]


class Limit(click.ParamType[tuple[str, float]]):
    """``METRIC=VALUE``, as a tuple; the metric must exist."""

    name = "METRIC=VALUE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        from kpbench.scoring import METRICS

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
    least: tuple[tuple[str, float], ...],
    most: tuple[tuple[str, float], ...],
) -> None:
    """Score a predictions file (.json, .jsonl, .csv, .parquet, .h5) against a dataset's true keypoints.

    \b
    Examples:
      kpbench score preds.json
      kpbench score preds.json --gt val --min detection_score=0.95 --max average_false_alarm=0.5
    """
    from kpbench.errors import PredictionsError
    from kpbench.predictions import read_predictions
    from kpbench.scoring import check_gates
    from kpbench.scoring import score as score_all

    predictions = read_predictions(preds)
    dataset = _dataset_of(predictions, preds, gt)
    try:
        scores = score_all(
            dataset, predictions, eps=eps, eps_radius=eps_radius, matching=matching, allow_missing=allow_missing
        )
    except PredictionsError as error:
        raise PredictionsError(f"{preds} does not fit {dataset.path}: {error}") from None
    if json_file:
        _write_json(json_file, scores, preds, dataset)
    if csv_file:
        _write_csv(csv_file, scores)
    name = " ".join(str(scores.detector[key]) for key in ("name", "version") if scores.detector.get(key))
    click.echo(f"predictions  {preds}{f', {name}' if name else ''}")
    click.echo(f"dataset      {dataset.path}, fingerprint {dataset.fingerprint[:16]}")
    click.echo(_table(scores))
    check_gates(scores, dict(least), dict(most))


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


def _write_json(path: Path, scores: Scores, preds: Path, dataset: Dataset) -> None:
    from importlib.metadata import version

    import orjson

    from kpbench import __version__
    from kpbench.store import sha256_of, write_atomic

    provenance = {
        "kpbench": __version__,
        "predictions": {"file": str(preds), "sha256": sha256_of(preds)},
        "dataset": str(dataset.path),
        "versions": {name: version(name) for name in ("numpy", "scipy")},
    }
    content = scores.to_dict() | {"provenance": provenance}
    write_atomic(path, orjson.dumps(content, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE))


def _write_csv(path: Path, scores: Scores) -> None:
    import csv
    import io

    from kpbench.store import write_atomic

    rows = scores.rows()
    text = io.StringIO()
    table = csv.DictWriter(text, rows[0], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_atomic(path, text.getvalue().encode())


# --- the table on the terminal ----------------------------------------------------------------------------------

LABELS = {
    "detection_score": "detection score",
    "id_matching_score": "ID matching score",
    "average_false_alarm": "false alarms an image",
    "detection_score_literal": "detection score, as printed",
    "id_matching_score_literal": "ID matching score, as printed",
    "average_false_alarm_literal": "false alarms, as printed",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
    "average_precision": "average precision",
    "error_median_px": "error, median (px)",
    "error_p95_px": "error, 95th percentile (px)",
    "error_rms_px": "error, RMS (px)",
    "error_median_radii": "error, median (radii)",
    "error_p95_radii": "error, 95th percentile (radii)",
    "error_rms_radii": "error, RMS (radii)",
}
PAPER = ("detection_score", "id_matching_score", "average_false_alarm")


def _number(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.4f}"


def _with_interval(group: Group, name: str) -> str:
    interval = group.intervals.get(name)
    text = _number(group.metrics[name])
    return text if interval is None else f"{text} [{interval[0]:.4f}, {interval[1]:.4f}]"


def _count(value: int | None) -> str:
    return "n/a" if value is None else str(value)


def _table(scores: Scores) -> str:
    overall, settings = scores.overall, scores.settings
    groups = (overall, *scores.by)
    # What the paper's formulas give as printed is shown wherever it differs
    printed = [name for name in PAPER if any(g.metrics[name] != g.metrics[f"{name}_literal"] for g in groups)]
    n = {name: _count(value) for name, value in overall.counts.items()}
    lines = [
        f"match        at most {settings.eps:g} of the {settings.eps_radius} radius, {settings.matching}",
        f"images       {n['images']} in {n['scenes']} scenes, which the 95 % intervals resample",
        f"keypoints    {n['truths']}: {n['matched']} matched ({n['wrong_id']} with a wrong ID), {n['missed']} missed",
        f"detections   {n['detections']}: {n['matched']} matched, {n['duplicate']} duplicates, "
        f"{n['near_miss']} near misses, {n['clutter']} clutter",
        "",
    ]
    hidden = {f"{name}_literal" for name in PAPER if name not in printed}
    lines += [f"{label:<30} {_with_interval(overall, name)}" for name, label in LABELS.items() if name not in hidden]
    if scores.confusion and any(sum(row) for row in scores.confusion["matrix"]):
        lines += ["", "ID of matched detections: true in rows, detected in columns"]
        lines += _aligned(
            [["", *map(str, scores.confusion["ids"]), "other"]]
            + [
                [str(true), *map(str, row)]
                for true, row in zip(scores.confusion["ids"], scores.confusion["matrix"], strict=True)
            ]
        )
    if scores.by:
        columns = [*PAPER, *(f"{name}_literal" for name in printed), "error_median_px"]
        rows = [["condition", "rung", "patch", "images", *(LABELS[name] for name in columns)]]
        for g in scores.by:
            key = ["all" if part is None else f"{part}" for part in (g.condition, g.rung, g.patch_id)]
            rows.append([*key, _count(g.counts["images"]), *(_with_interval(g, name) for name in columns)])
        lines += ["", *_aligned(rows)]
    return "\n".join(lines)


def _aligned(rows: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
