"""``kpbench detect``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kpbench.cli.options import FINITE, PATCHES, WORKERS

if TYPE_CHECKING:
    from kpbench.detectors.interface import LoadedDetector
    from kpbench.detectors.prediction import PredictionRun


@click.command()
@click.argument("source")
@click.option(
    "--detector",
    "name",
    default="template",
    show_default=True,
    help="Detector: a name, FILE.onnx, MODULE:ATTR or program:COMMAND.",
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
    help="Least score of a detection. Default: the detector's own; the shipped ones have 0.3.",
)
@click.option(
    "--overlay",
    type=click.Path(path_type=Path),
    help="Draw the detections into a folder, a video (.mp4), or a .png of a single image.",
)
@PATCHES
@WORKERS
def detect(
    source: str,
    name: str,
    out: Path,
    threshold: float | None,
    overlay: Path | None,
    patches: tuple[Path, ...],
    workers: int | None,
) -> None:
    """Run a detector over SOURCE: a dataset, an image, a folder of images, a video, or camera:0.

    --out is a predictions file (.json, .jsonl, .csv, .parquet, .h5), which `kpbench score` reads. The images of a
    folder and the frames of a video are numbered from 0, in order.

    \b
    Examples:
      kpbench detect kpbench-data --detector template --out preds.json
      kpbench detect photos --detector my_module:MyDetector --overlay drawn
      kpbench detect photos --detector template --patches my-patch.toml
      kpbench detect film.mp4 --detector my-weights.onnx --overlay drawn.mp4
    """
    from kpbench.images import refuse_same_folder
    from kpbench.predictions.files import require_predictions_path, write_predictions

    require_predictions_path(out)
    if overlay is not None:
        refuse_same_folder(source, overlay)
    detector = _load_template(name, patches, threshold) if patches else name
    try:
        run = _run(source, detector, threshold, overlay, workers)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{out} is not written; the same command starts anew") from None
    write_predictions(out, run.predictions)
    click.echo(f"{out}: {len(run.predictions.xy)} detections in {len(run.predictions)} images")
    if run.failures:
        for label, problem in run.failures[:5]:
            click.echo(f"kpbench: {label}: {problem}", err=True)
        click.echo(f"kpbench: {len(run.failures)} images failed, they count as no detections", err=True)
        raise SystemExit(1)


def _run(
    source: str, detector: str | LoadedDetector, threshold: float | None, overlay: Path | None, workers: int | None
) -> PredictionRun:
    """Run a detector over a dataset or over images, with a progress bar."""
    from kpbench.cli.progress import progress_bar
    from kpbench.dataset.folder import open_dataset
    from kpbench.detectors.prediction import predict, predict_images
    from kpbench.images import open_images

    if not ((Path(source) / "dataset.json").exists() or any(Path(source).glob("shard-*.h5"))):
        images = open_images(source, exclude=overlay)
        with progress_bar(images.length, "detect") as progress:
            return predict_images(images, detector, threshold=threshold, overlay=overlay, progress=progress)
    dataset = open_dataset(source)
    if detector in ("template", "superpoint", "superpoint-small") and _has_other_designs(dataset.config):
        click.echo(
            f"kpbench: {source} holds other designs than {detector} looks for; use template with --patches, "
            "or weights trained on them",
            err=True,
        )
    with progress_bar(len(dataset), "detect") as progress:
        return predict(dataset, detector, threshold=threshold, workers=workers, overlay=overlay, progress=progress)


def _has_other_designs(config: dict[str, Any]) -> bool:
    """Return whether a dataset holds other designs than the shipped ones."""
    from kpbench.patches.design import shipped_patches

    return "patches" in config and config["patches"] != [patch.to_dict() for patch in shipped_patches()]


def _load_template(name: str, patches: tuple[Path, ...], threshold: float | None) -> LoadedDetector:
    """Return the template detector for designs of the user; a loaded detector runs in this process alone."""
    from kpbench.detectors.interface import LoadedDetector
    from kpbench.detectors.template import TemplateDetector
    from kpbench.patches.design import load_patches

    if name != "template":
        raise click.UsageError(f"--patches is for the template detector; {name} has designs of its own")
    detector = TemplateDetector(load_patches(patches))
    if threshold is not None:
        detector.threshold = threshold
    return LoadedDetector(detector.name, detector.version, detector)
