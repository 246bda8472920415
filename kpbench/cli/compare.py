"""The command that compares predictions files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.score import FILE, Limit, scoring_options


@click.command()
@click.argument("files", nargs=-1, required=True, type=FILE)
@scoring_options
@click.option("--json", "json_file", type=FILE, help="Write all differences.")
@click.option("--fail-on-regression", is_flag=True, help="Exit 1 if the first detector is worse over all images.")
@click.option(
    "--no-worse",
    type=Limit(),
    multiple=True,
    help="Exit 1 unless the first detector is shown to be no worse by more than VALUE over all images; repeatable.",
)
def compare(
    files: tuple[Path, ...], fail_on_regression: bool, no_worse: tuple[tuple[str, float], ...], **arguments: Any
) -> None:
    """Compare the first of several predictions files with each of the others, on the same dataset.

    Differences are paired: every resample for a 95 % interval draws the same scenes for both detectors. With
    --fail-on-regression, the exit code is 1 if the first detector has a lower detection score, a lower ID matching
    score or more false alarms over all images, and the interval of this difference does not contain 0. A rung
    is better or worse only if its p-value, adjusted for all rungs by Holm's method, is at most 0.05.

    \b
    Examples:
      kpbench compare new.json old.json --fail-on-regression
      kpbench compare new.json old.json --no-worse detection_score=0.01
      kpbench compare a.json b.json c.json --report compared.html
    """
    from kpbench.evaluate import compare_files
    from kpbench.report.summary import summarise_comparisons
    from kpbench.scoring.comparison import check_no_worse, check_regression, require_margins

    if len(files) < 2:
        raise click.UsageError("expected two or more predictions files")
    require_margins(dict(no_worse))
    compared = compare_files(files, command=["kpbench", *sys.argv[1:]], warn=print_warning, **arguments)
    echo(f"dataset {compared.dataset.path}, fingerprint {compared.dataset.fingerprint[:16]}")
    echo()
    echo(summarise_comparisons(compared.comparisons), lines=True)
    if fail_on_regression:
        check_regression(compared.comparisons)
    check_no_worse(compared.comparisons, dict(no_worse))
