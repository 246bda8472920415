"""``kpbench detect``."""

from __future__ import annotations

from pathlib import Path

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import FINITE, PATCHES, WORKERS

SHIPPED_DESIGNS_ONLY = ("template", "superpoint", "superpoint-small")
"""Detectors that look for the shipped designs only. With --patches, template looks for the given designs instead."""


@click.command()
@click.argument("source")
@click.option(
    "--detector",
    default="template",
    show_default=True,
    help="A shipped detector, FILE.onnx, MODULE:ATTR or program:COMMAND.",
)
@click.option(
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    default=Path("preds.json"),
    show_default=True,
    help="Predictions file to write.",
)
@click.option(
    "--threshold",
    type=FINITE,
    help="Least score of a detection. Default: set by the detector; 0.3 for shipped detectors.",
)
@click.option(
    "--overlay",
    type=click.Path(path_type=Path),
    help="Draw the detections into a folder, into a video (.mp4), or for a single image into a .png file.",
)
@PATCHES
@WORKERS
def detect(
    source: str,
    detector: str,
    out: Path,
    threshold: float | None,
    overlay: Path | None,
    patches: tuple[Path, ...],
    workers: int | None,
) -> None:
    """Run a detector over SOURCE: a dataset, an image, a folder of images, a video, or camera:0.

    The command writes a predictions file (.json, .jsonl, .csv, .parquet, .h5) for `kpbench score`. The images of a
    folder and the frames of a video are numbered from 0, in order.

    \b
    Examples:
      kpbench detect kpbench-data --detector template --out preds.json
      kpbench detect photos --detector my_module:MyDetector --overlay drawn
      kpbench detect photos --detector template --patches my-patch.toml
      kpbench detect film.mp4 --detector my-weights.onnx --overlay drawn.mp4
    """
    from kpbench.cli.progress import progress_bar
    from kpbench.detectors.interface import load_detector
    from kpbench.detectors.prediction import predict
    from kpbench.detectors.sources import has_other_designs, open_source
    from kpbench.images import ImageSource
    from kpbench.patches.design import load_patches
    from kpbench.predictions.files import require_predictions_path, write_predictions

    if patches and detector != "template":
        raise click.UsageError(f"--patches is for the template detector; {detector} does not take designs")
    require_predictions_path(out)
    images = open_source(source, overlay)
    if detector in SHIPPED_DESIGNS_ONLY and not patches and has_other_designs(images):
        print_warning(
            f"{source} holds other designs than {detector} looks for; use template with `patches`, "
            "or weights trained on the other designs"
        )
    loaded = load_detector(detector, threshold, load_patches(patches)) if patches else detector
    try:
        with progress_bar(images.length if isinstance(images, ImageSource) else len(images), "detect") as progress:
            run = predict(images, loaded, threshold=threshold, workers=workers, overlay=overlay, progress=progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{out} is not written; the same command starts anew") from None
    write_predictions(out, run.predictions)
    echo(f"{out}: {len(run.predictions.xy)} detections in {len(run.predictions)} images")
    if run.failures:
        pairs = [f"{label}: {problem}" for label, problem in run.failures]
        lines = images.describe_failures(run.failures) if isinstance(images, ImageSource) else pairs
        for line in lines[:5]:
            print_warning(line)
        print_warning(f"{len(run.failures)} images failed and count as images without detections")
        raise SystemExit(1)
