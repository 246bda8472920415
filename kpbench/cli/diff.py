"""The command that compares two datasets."""

from __future__ import annotations

import json
from pathlib import Path

import click

from kpbench.cli.messages import echo
from kpbench.cli.options import SEED, Finite
from kpbench.cli.score import FILE


@click.command()
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path))
@click.option("--max-shift", type=Finite(0, 1, max_open=True), default=0.05, show_default=True,
              help="Largest share of the values that may lie elsewhere without drift.")  # fmt: skip
@click.option("--fail-on-drift", is_flag=True, help="Exit 1 if a distribution drifted.")
@click.option("--json", "json_file", type=FILE, help="Write all differences.")
@SEED
def diff(a: Path, b: Path, max_shift: float, fail_on_drift: bool, json_file: Path | None, seed: int) -> None:
    """Compare two datasets, or two versions of one: config, truth, pixels and distributions.

    A and B are datasets, COCO annotations (.json), or folders with annotations.json. A distribution drifted if more
    than --max-shift of its values would have to move, and a test finds that chance does not explain it: its p-value,
    adjusted for all distributions by Holm's method, is at most 0.05. With --fail-on-drift, the exit code is then 1.

    \b
    Examples:
      kpbench diff kpbench-data kpbench-data-2
      kpbench diff old/annotations.json new/annotations.json --fail-on-drift --max-shift 0.1
    """
    from kpbench.cli.progress import progress_bar
    from kpbench.dataset.labelled import open_labelled
    from kpbench.drift.datasets import check_drift, count_images_read
    from kpbench.drift.datasets import diff as compare_datasets
    from kpbench.drift.summary import summarise_difference
    from kpbench.writing import require_writable, write_file

    if json_file is not None:
        require_writable(json_file, "file of differences")
    first, second = open_labelled(a), open_labelled(b)
    with progress_bar(count_images_read(first, second), "diff") as progress:
        difference = compare_datasets(first, second, max_shift=max_shift, seed=seed, progress=progress)
    if json_file is not None:
        write_file(json_file, json.dumps(difference.to_dict(), indent=1).encode())
    echo(summarise_difference(difference), lines=True)
    if fail_on_drift:
        check_drift(difference)
