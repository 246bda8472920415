"""``kpbench print-check``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import Two


@click.command("print-check")
@click.argument("photos", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--board", required=True, type=click.Path(path_type=Path), help="Sidecar (.json) of the board that was printed."
)
@click.option(
    "--ruler-mm",
    type=Two(float, "X,Y", ",", "99.8,100.1"),
    help="Lengths of the two rulers, measured on the paper. They give the absolute scale, which photographs do not.",
)
def print_check(photos: tuple[Path, ...], board: Path, ruler_mm: tuple[float, float] | None) -> None:
    """Measure a print in photographs: ratio of its scales, skew, bow, and ink gain.

    The command writes NAME.measured.json beside the sidecar, with lengths corrected to the real print. Without
    --ruler-mm, the print is taken to have the right size on average, and photographs tell the ratio.

    \b
    Examples:
      kpbench print-check photos/ --board patches-print/truth.json
      kpbench print-check photos/ --board patches-print/truth.json --ruler-mm 99.8,99.7
    """
    from kpbench.calibration.photos import list_photos
    from kpbench.calibration.print_check import check_print, describe_contradiction, write_measured_sidecar
    from kpbench.cli.progress import progress_bar

    source: Any = photos[0] if len(photos) == 1 else list(photos)
    with progress_bar(len(list_photos(source)), "photos") as progress:
        found = check_print(source, board, progress=progress)
    for name, (value, sigma, unit) in found.values.items():
        echo(f"{name}: {value:.5g} ± {sigma:.2g}{unit}")
    if ruler_mm is not None and (problem := describe_contradiction(found, ruler_mm)):
        print_warning(problem)
    echo(write_measured_sidecar(board, found, ruler_mm))
