"""The command that scores a predictions file, and the options that it shares with ``kpbench compare``."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import FileOfSuffix, Finite


class Limit(click.ParamType[tuple[str, float]]):
    """A limit ``METRIC=VALUE``, parsed into a tuple. The metric must exist."""

    name = "METRIC=VALUE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        from kpbench.scoring.metrics import METRICS
        from kpbench.scoring.tracks import TRACK_METRICS
        from kpbench.text import did_you_mean

        if isinstance(value, tuple):
            return value
        metric, _, number = str(value).partition("=")
        if metric not in (*METRICS, *TRACK_METRICS):
            close = did_you_mean(metric, (*METRICS, *TRACK_METRICS))
            self.fail(f"there is no metric {metric!r}, only {', '.join(METRICS)}{close}", param, ctx)
        try:
            limit = float(number)
        except ValueError:
            limit = float("nan")
        if limit != limit:
            self.fail(f"{value!r} sets no limit, expected METRIC=VALUE such as {metric}=0.9", param, ctx)
        return metric, limit


def report_suffixes() -> Iterable[str]:
    """Return the suffixes of report files."""
    from kpbench.report.report import REPORT_SUFFIXES

    return REPORT_SUFFIXES


FILE = click.Path(dir_okay=False, path_type=Path)
OPTIONS_OF_POSES = ("preds", "truth", "json_file", "least", "most")
"""Parameters of ``kpbench score`` that a file of poses has a use for."""


def scoring_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options for the ground truth, the matching and the report to a command."""
    options = (
        click.option(
            "--gt",
            "truth",
            type=click.Path(path_type=Path),
            help="Dataset or COCO annotations (.json). Default: the path in the predictions, else ./kpbench-data.",
        ),
        click.option(
            "--eps",
            type=Finite(min=0),
            default=0.1,
            show_default=True,
            help="Matching threshold: largest distance from detection to keypoint, in radii of the keypoint.",
        ),
        click.option(
            "--eps-radius",
            type=click.Choice(["major", "minor", "mean"]),
            default="major",
            show_default=True,
            help="The radius of a tilted disc: its major or minor semi-axis, or half their sum.",
        ),
        click.option(
            "--matching",
            type=click.Choice(["one-to-one", "literal"]),
            default="one-to-one",
            show_default=True,
            help="literal: the paper's formulas as printed. Several detections of a keypoint then all count.",
        ),
        click.option(
            "--allow-missing",
            is_flag=True,
            help="Score an image missing from the predictions as an image without detections.",
        ),
        click.option(
            "--report",
            "report_file",
            type=FileOfSuffix(report_suffixes),
            help="Write tables and charts: .html (one offline page), .md, .tex; severity curves: .pdf, .png, .svg.",
        ),
        click.option("--name", "names", multiple=True, help="Name of a detector in the report; once per file."),
    )
    for option in reversed(options):
        command = option(command)
    return command


@click.command()
@click.argument("preds", type=FILE)
@scoring_options
@click.option("--json", "json_file", type=FILE, help="Write all scores.")
@click.option("--csv", "csv_file", type=FILE, help="Write one row per condition, rung and patch.")
@click.option("--images-csv", "images_csv_file", type=FILE, help="Write one row per image, such as for pandas.")
@click.option(
    "--pose", is_flag=True, help="Also compute errors of the board's pose. The dataset must be made by kpbench suite."
)
@click.option("--min", "least", type=Limit(), multiple=True, help="Exit 1 if a metric is lower; repeatable.")
@click.option("--max", "most", type=Limit(), multiple=True, help="Exit 1 if a metric is higher; repeatable.")
def score(
    preds: Path, least: tuple[tuple[str, float], ...], most: tuple[tuple[str, float], ...], **arguments: Any
) -> None:
    """Score a predictions file (.json, .jsonl, .csv, .parquet, .h5) against a dataset's true keypoints.

    A file of poses (.jsonl, .csv) is scored against the true poses of a dataset of films, see `kpbench track`.

    \b
    Examples:
      kpbench score preds.json
      kpbench score preds.json --report report.html
      kpbench score preds.json --gt val --min detection_score=0.95 --max average_false_alarm=0.5
      kpbench score poses.jsonl --gt kpbench-suite/video-v1 --min frames_with_pose=0.9
    """
    from kpbench.boards.pose_files import holds_poses
    from kpbench.evaluate import score_file
    from kpbench.provenance import image_source
    from kpbench.report.summary import summarise_scores
    from kpbench.scoring.scores import check_gates

    if holds_poses(preds):
        _refuse_options_of_predictions(preds)
        _score_poses(preds, dict(least), dict(most), arguments["truth"], arguments["json_file"])
        return
    scored = score_file(preds, command=["kpbench", *sys.argv[1:]], warn=print_warning, **arguments)
    scores, dataset = scored.scores, scored.dataset
    echo(f"predictions  {preds}{f', {scores.name}' if scores.detector else ''}")
    source = image_source(dataset.config)
    echo(f"dataset      {dataset.path}, {f'{source}, ' if source else ''}fingerprint {dataset.fingerprint[:16]}")
    echo(summarise_scores(scores, scored.poses), lines=True)
    check_gates(scores, dict(least), dict(most))


def _refuse_options_of_predictions(poses: Path) -> None:
    """Refuse options that a file of poses has no use for."""
    context = click.get_current_context()
    for option in context.command.params:
        is_given = context.get_parameter_source(option.name or "") is click.core.ParameterSource.COMMANDLINE
        if is_given and option.name not in OPTIONS_OF_POSES:
            shown = ", ".join(f"--{n}" for n in ("gt", "json", "min", "max"))
            raise click.UsageError(f"{poses} holds poses; {option.opts[0]} is for detections, expected only {shown}.")


def _score_poses(
    poses: Path, least: dict[str, float], most: dict[str, float], truth: Path | None, json_file: Path | None
) -> None:
    """Score a file of poses."""
    from kpbench.scoring.scores import check_gates
    from kpbench.tracking.scores import score_poses, summarise_tracks
    from kpbench.writing import require_writable, write_file

    if truth is None:
        raise click.UsageError(f"{poses} holds poses; --gt must name the dataset of films")
    if json_file is not None:
        require_writable(json_file, "scores")
    scores = score_poses(poses, truth)
    if json_file is not None:
        write_file(json_file, json.dumps(scores.to_dict(), indent=1).encode())
    echo(summarise_tracks(scores), lines=True)
    check_gates(scores, least, most)
