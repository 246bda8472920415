"""The command that plans the number of scenes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import ONLY, SEED, SIZE, WORKERS, Finite
from kpbench.cli.score import FILE

if TYPE_CHECKING:
    from kpbench.scoring.scores import Scores


@click.command()
@click.option("--detector", "detectors", multiple=True, help="Detector to run as a pilot; once, or twice for a pair.")
@click.option("--pilot", "pilots", multiple=True, type=FILE, help="Predictions of a pilot, in place of --detector.")
@click.option("--gt", "truth", type=click.Path(path_type=Path), help="Dataset of --pilot. Default: as kpbench score.")
@click.option("--margin", type=Finite(min=0, min_open=True), required=True, help="Margin in the unit of the metric.")
@click.option("--metric", default="detection_score", show_default=True, help="A metric that has an interval, not NEES.")
@click.option("--suite", default="paper-v1", show_default=True, help="Suite of the pilot run.")
@click.option("--images", type=click.IntRange(min=2), default=20, show_default=True, help="Base scenes of the pilot.")
@click.option("--size", type=SIZE, default="640x480", show_default=True, help="Width and height of the pilot, px.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("kpbench-bench"), show_default=True,
              help="Folder of the pilot run; finished work in it is kept.")  # fmt: skip
@click.option("--json", "json_file", type=FILE, help="Write the plan.")
@ONLY
@SEED
@WORKERS
def plan(
    detectors: tuple[str, ...],
    pilots: tuple[Path, ...],
    truth: Path | None,
    margin: float,
    metric: str,
    json_file: Path | None,
    **pilot_run: object,
) -> None:
    """Say how many scenes a measurement needs, from a pilot.

    With one detector, the 95 % interval becomes no wider than the margin to each side. With two detectors that are
    equally good, kpbench compare --no-worse METRIC=MARGIN will succeed with probability 0.9.

    \b
    Examples:
      kpbench plan --detector template --margin 0.01
      kpbench plan --detector template --detector superpoint-small --margin 0.01 --only blur
      kpbench plan --pilot new.json --pilot old.json --margin 0.01 --json plan.json
    """
    from kpbench.evaluate import compare_files, score_file
    from kpbench.files import refuse_overwrite
    from kpbench.scoring.planning import plan_scenes
    from kpbench.writing import require_writable, write_file

    if bool(detectors) == bool(pilots) or len(detectors or pilots) > 2:
        raise click.UsageError("expected one or two of --detector, or one or two of --pilot")
    if truth is not None and not pilots:
        raise click.UsageError("--gt names the dataset of --pilot, and --detector makes its own")
    if json_file is not None:
        refuse_overwrite([json_file], pilots)
        require_writable(json_file, "plan")
    runs: tuple[Scores, ...]
    if detectors:
        runs = _run_pilot(detectors, **pilot_run)  # type: ignore[arg-type]
    elif len(pilots) == 2:
        runs = compare_files(pilots, truth, warn=print_warning, resamples=0).scores
    else:
        runs = (score_file(pilots[0], truth, warn=print_warning, resamples=0).scores,)
    plans = plan_scenes(*runs, margin=margin, metric=metric)
    content = {"schema": "kpbench.plan/1", "detectors": [run.name for run in runs]}
    if json_file is not None:
        plan_json = {**content, "plans": [p.to_dict() for p in plans]}
        write_file(json_file, json.dumps(plan_json, indent=1).encode())
    echo(f"{' minus '.join(run.name for run in runs)}: scenes for {metric} within {margin:g}")
    for p in plans:
        where = "all images" if p.condition is None else f"{p.condition} {p.rung:g}"
        sigma = "undefined" if p.sigma is None else f"{p.sigma:.4f}"
        echo(f"{where:<24} {p.scenes or 'unknown':>8}  sigma between {p.pilot_scenes} scenes {sigma}")


def _run_pilot(
    detectors: tuple[str, ...],
    suite: str,
    images: int,
    size: tuple[int, int],
    out: Path,
    only: tuple[str, ...],
    seed: int,
    workers: int | None,
) -> tuple[Scores, ...]:
    from kpbench.benchmark.run import bench, count_bench_images
    from kpbench.cli.progress import progress_bar
    from kpbench.synth.suite import SuiteConfig
    from kpbench.synth.suite_file import load_suite

    configs = [SuiteConfig(load_suite(suite), images, seed, size, only)]
    with progress_bar(count_bench_images(configs, detectors), "pilot") as progress:
        runs = bench(configs, detectors, out, workers=workers, progress=progress)
    if failed := sum(len(run.failures) for run in runs):
        print_warning(f"detectors failed on {failed} images, which count as no detections")
    return tuple(run.scores for run in runs)
