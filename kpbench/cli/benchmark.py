"""The command that runs the benchmark."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import BACKGROUNDS, ONLY, SEED, SIZE, WORKERS


@click.command()
@click.option("--suite", "suites", multiple=True, help="Suite to run; repeatable. Default: paper-v1.")
@click.option(
    "--dataset",
    type=click.Path(path_type=Path),
    help="Labelled images to run instead of suites: a dataset, COCO annotations (.json), or a folder with both.",
)
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
    help="Folder for all files; finished work in it is kept.",
)
@click.option("--quick", is_flag=True, help="For a laptop: the same as --images 20 --size 640x480.")
@click.option(
    "--images",
    type=int,
    help="Number of base scenes. Each scene is rendered with every board under every rung. Default: 500.",
)
@click.option(
    "--size", type=SIZE, help="Width and height in px of a camera with the same field of view. Default: 1624x1240."
)
@ONLY
@SEED
@BACKGROUNDS
@WORKERS
def bench(
    suites: tuple[str, ...],
    dataset: Path | None,
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
    """Make the suites, run the detectors, and compare the scores with the paper's scores.

    With --dataset, the detectors run over labelled images of your own, such as photographs, and their tables come out.

    Detectors of tags get boards of tags in the same scenes. The same command continues an interrupted run. The command
    prints tables as Markdown. It also writes a report per suite, and the scores and predictions of each detector.

    \b
    Examples:
      kpbench bench --quick
      kpbench bench --quick --suite paper-v1 --suite extended-v1 --detector template --detector aruco
      kpbench bench --images 50 --detector my_module:MyDetector --only blur
      kpbench bench --dataset degraded --detector superpoint-small
    """
    from kpbench.benchmark.reports import write_suite_reports
    from kpbench.benchmark.run import bench as run_bench
    from kpbench.benchmark.run import bench_dataset, count_bench_images
    from kpbench.cli.progress import progress_bar
    from kpbench.dataset.labelled import open_labelled
    from kpbench.report.tables import to_markdown
    from kpbench.synth.suite import SuiteConfig
    from kpbench.synth.suite_file import load_suite

    if quick and (images or size):
        raise click.UsageError("--quick already sets --images and --size; drop --quick, or drop --images and --size")
    if quick:
        images, size = 20, (640, 480)
    if dataset is not None and (suites or images or size or only or seed or backgrounds):
        raise click.UsageError("--dataset takes --detector, --out and --workers, and no option of a suite")
    loaded = [load_suite(name) for name in suites or ("paper-v1",)]
    if len({suite.name for suite in loaded}) < len(loaded):
        raise click.UsageError(f"two suites have the same name: {', '.join(s.name for s in loaded)}")
    configs = [SuiteConfig(suite, images, seed, size, only, backgrounds) for suite in loaded]
    try:
        if dataset is not None:
            with progress_bar(len(open_labelled(dataset)) * len(detectors), "bench") as progress:
                runs = bench_dataset(dataset, detectors, out, workers=workers, progress=progress)
        else:
            with progress_bar(count_bench_images(configs, detectors), "bench") as progress:
                runs = run_bench(configs, detectors, out, workers=workers, progress=progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("finished work is kept; the same command continues the run") from None
    for report in write_suite_reports(runs, out, command=["kpbench", *sys.argv[1:]]):
        for table in report.tables:
            echo(to_markdown(table), lines=True)
        echo(f"{report.page}: the report of {report.suite}")
        echo(f"{report.scores_folder}: the scores, one file per detector")
    failed = [(run, failure) for run in runs for failure in run.failures]
    if failed:
        for run, (image_id, problem) in failed[:5]:
            print_warning(f"{run.scores.name} on {run.suite}: image_id {image_id}: {problem}")
        print_warning(f"detectors failed on {len(failed)} images, which count as no detections")
        raise SystemExit(1)
