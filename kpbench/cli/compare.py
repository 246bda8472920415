"""The command that compares predictions files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.score import FILE, scoring_options


@click.command()
@click.argument("files", nargs=-1, required=True, type=FILE)
@scoring_options
@click.option("--json", "json_file", type=FILE, help="Write all differences.")
@click.option("--fail-on-regression", is_flag=True, help="Exit 1 if the first detector is worse over all images.")
def compare(files: tuple[Path, ...], fail_on_regression: bool, **arguments: Any) -> None:
    """Compare the first of several predictions files with each of the others, on the same dataset.

    Differences are paired: every resample for a 95 % interval draws the same scenes for both detectors. With
    --fail-on-regression, the exit code is 1 if the first detector has a lower detection score, a lower ID matching
    score or more false alarms over all images, and the interval of this difference does not contain 0.

    \b
    Examples:
      kpbench compare new.json old.json --fail-on-regression
      kpbench compare a.json b.json c.json --report compared.html
    """
    from kpbench.evaluate import compare_files
    from kpbench.report.summary import summarise_comparisons
    from kpbench.scoring.comparison import check_regression

    if len(files) < 2:
        raise click.UsageError("expected two or more predictions files")
    compared = compare_files(files, command=["kpbench", *sys.argv[1:]], warn=print_warning, **arguments)
    echo(f"dataset {compared.dataset.path}, fingerprint {compared.dataset.fingerprint[:16]}")
    echo()
    echo(summarise_comparisons(compared.comparisons), lines=True)
    if fail_on_regression:
        check_regression(compared.comparisons)
