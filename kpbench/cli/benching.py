"""The command that runs the benchmark."""

from __future__ import annotations

import sys
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kpbench.cli.options import ONLY, SEED, SIZE, WORKERS

if TYPE_CHECKING:
    from kpbench.benchmark import Benched


@click.command()
@click.option("--suite", "suites", multiple=True, default=["paper-v1"], show_default=True, help="Repeatable.")
@click.option(
    "--detector",
    "detectors",
    multiple=True,
    default=["template", "superpoint-small"],
    show_default=True,
    help="A shipped detector, FILE.onnx, MODULE:ATTR, or program:COMMAND; repeatable.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("kpbench-bench"),
    show_default=True,
    help="Folder for everything; what is done there is not done again.",
)
@click.option("--quick", is_flag=True, help="For a laptop: stands for --images 20 --size 640x480.")
@click.option("--images", type=int, help="Base scenes, each seen with every board under every rung; default: 500.")
@click.option("--size", type=SIZE, help="Scale the camera, same field of view; default: 1624x1240.")
@ONLY
@SEED
@click.option("--backgrounds", type=click.Path(path_type=Path), help="Folder of photographs; else procedural ones.")
@WORKERS
def bench(
    suites: tuple[str, ...],
    detectors: tuple[str, ...],
    out: Path,
    quick: bool,
    images: int | None,
    size: tuple[int, int] | None,
    only: tuple[str, ...],
    seed: int,
    backgrounds: Path | None,
    workers: int | None,
) -> None:
    """Make the suites, run the detectors, score them, and set the tables beside the paper's.

    Detectors of tags get boards of tags in the same scenes. An interrupted run is taken up by the same command.
    Prints the tables as Markdown; writes the report of each suite, and the scores and predictions of each detector.

    \b
    Examples:
      kpbench bench --quick
      kpbench bench --quick --suite paper-v1 --suite extended-v1 --detector template --detector aruco
      kpbench bench --images 50 --detector my_module:MyDetector --only blur
    """
    from kpbench.benchmark import bench as run_bench
    from kpbench.benchmark import images_to_do
    from kpbench.cli.progress import progress_bar
    from kpbench.synth.suite import SuiteConfig
    from kpbench.synth.suite_file import load_suite

    if quick and (images or size):
        raise click.UsageError("--quick sets --images and --size; drop one of them")
    if quick:
        images, size = 20, (640, 480)
    loaded = [load_suite(name) for name in suites]
    if len({suite.name for suite in loaded}) < len(loaded):
        raise click.UsageError(f"suites of one name, {', '.join(s.name for s in loaded)}: their results would be mixed")
    configs = [SuiteConfig(suite, images, seed, size, only, backgrounds) for suite in loaded]
    try:
        with progress_bar(images_to_do(configs, detectors), "bench") as progress:
            benched = run_bench(configs, detectors, out, workers=workers, progress=progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("what is done is kept; the same command goes on") from None
    for suite, runs in groupby(benched, lambda run: run.config.suite.name):
        _report(out, suite, list(runs))
    failed = [(run, failure) for run in benched for failure in run.failures]
    if failed:
        for run, (image_id, problem) in failed[:5]:
            click.echo(f"kpbench: {run.scores.name} on {run.config.name}: image_id {image_id}: {problem}", err=True)
        click.echo(f"kpbench: detectors failed on {len(failed)} images, which count as no detections", err=True)
        raise SystemExit(1)


def _report(out: Path, suite: str, runs: list[Benched]) -> None:
    """Print the tables of one suite, and write its report and scores."""
    from kpbench.files import write_atomic
    from kpbench.report.figures import breakpoint_table, overview_table, paper_table
    from kpbench.report.paper import PAPER
    from kpbench.report.report import Report, write_report
    from kpbench.report.result_files import provenance, scores_file
    from kpbench.report.tables import to_markdown

    scores = tuple(run.scores for run in runs)
    known = provenance(runs[0].dataset, [run.predictions for run in runs], ["kpbench", *sys.argv[1:]])
    for suffix in ("html", "md"):
        report = Report(scores, runs[0].dataset.config, provenance=known, title=f"{suite}, simulated")
        write_report(out / f"{suite}.{suffix}", report)
    folder = out / "scores" / suite
    folder.mkdir(parents=True, exist_ok=True)
    for run in runs:
        known = provenance(run.dataset, [run.predictions], ["kpbench", *sys.argv[1:]])
        name = f"{run.predictions.stem.rpartition('-')[0]}.json"
        write_atomic(folder / name, scores_file(run.scores, known | {"config": run.dataset.config}))
    patches = [run.scores for run in runs if run.config.board is None]
    tables = [paper_table(patches, PAPER[name]) for run in patches[:1] for name in run.conditions if name in PAPER]
    for table in (overview_table(scores), *tables, breakpoint_table(scores)):
        click.echo(to_markdown(table))
    click.echo(f"{out / suite}.html: the report of {suite}\n{folder}: the scores, one file a detector")
