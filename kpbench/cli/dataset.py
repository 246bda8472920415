"""``kpbench inspect``, ``verify``, ``preview`` and ``export``, the commands for a finished dataset."""

from __future__ import annotations

from pathlib import Path

import click

from kpbench.cli.messages import echo
from kpbench.cli.options import Finite

DATASET = click.argument("dataset", type=click.Path(path_type=Path), default=Path("kpbench-data"))


@click.command()
@DATASET
def inspect(dataset: Path) -> None:
    """Print facts about a dataset, and histograms of its keypoints.

    DATASET may also be COCO annotations (.json), or a folder with annotations.json.

    \b
    Examples:
      kpbench inspect kpbench-data
    """
    from kpbench.dataset.card import dataset_facts, dataset_histograms
    from kpbench.dataset.labelled import open_labelled

    data = open_labelled(dataset)
    echo(f"{'dataset':12} {data.path}")
    for name, value in dataset_facts(data).items():
        echo(f"{name:12} {value}")
    for histogram in dataset_histograms(data):
        echo(histogram.title)
        most = max(int(histogram.counts.max()), 1)
        for label, count, share in zip(histogram.labels, histogram.counts, histogram.shares, strict=True):
            echo(f"  {label:>14} {count:>8} {share:6.1%} {'#' * round(30 * count / most)}")


@click.command()
@DATASET
def verify(dataset: Path) -> None:
    """Compare every byte of a dataset with its manifest. The exit code is 1 if a byte differs.

    \b
    Examples:
      kpbench verify kpbench-data
    """
    from kpbench.cli.progress import progress_bar
    from kpbench.dataset.folder import open_dataset

    data = open_dataset(dataset)
    with progress_bar(len(data), "verify") as progress:
        for shard in data.verify():
            progress(shard.count)
    echo(f"{dataset}: {len(data)} images in {len(data.shards)} shards, all as written")


@click.command()
@DATASET
@click.option("--out", type=click.Path(path_type=Path), help="PNG file to write. Default: preview.png in the dataset.")
@click.option(
    "--count", type=click.IntRange(1, 400), help="Number of images. Default: 12; of a suite, one image per rung."
)
@click.option("--columns", type=click.IntRange(1, 20), default=4, show_default=True, help="Number of images per row.")
@click.option(
    "--tile-width", type=click.IntRange(64, 4096), default=480, show_default=True, help="Width of an image in px."
)
def preview(dataset: Path, out: Path | None, count: int | None, columns: int, tile_width: int) -> None:
    """Draw a contact sheet of evenly spaced images with their true keypoints.

    Of a suite, the sheet has a row per condition and a column per rung. With --count, the images are evenly spaced.

    DATASET may also be COCO annotations (.json), or a folder with annotations.json.

    \b
    Examples:
      kpbench preview photos/annotations.json --out labels.png
      kpbench preview kpbench-data --count 20 --columns 5
      kpbench preview kpbench-suite/paper-v1 --out rungs.png
    """
    from kpbench.dataset.card import draw_overview, draw_rungs
    from kpbench.dataset.labelled import open_labelled
    from kpbench.images import encode_png
    from kpbench.writing import require_writable, write_file

    data = open_labelled(dataset)
    target = out or (data.path.parent if data.path.suffix == ".json" else data.path) / "preview.png"
    require_writable(target, "picture")
    if count is None and data.truth.condition[0]:
        sheet = draw_rungs(data, tile_width)
    else:
        sheet = draw_overview(data, count or 12, columns, tile_width)
    write_file(target, encode_png(sheet, "picture"))
    echo(target)


@click.command()
@DATASET
@click.option(
    "--format",
    "file_format",
    type=click.Choice(["coco", "yolo", "webdataset", "parquet"]),
    required=True,
    help="Format to write.",
)
@click.option("--out", type=click.Path(path_type=Path), help="New folder to write into. Default: DATASET-FORMAT.")
@click.option(
    "--val-share",
    type=Finite(0, 1, max_open=True),
    default=0.2,
    show_default=True,
    help="yolo, parquet: share of the scenes that are for validation.",
)
def export(dataset: Path, file_format: str, out: Path | None, val_share: float) -> None:
    """Write a dataset as COCO keypoints, YOLO-pose, WebDataset, or Parquet for Hugging Face datasets.

    DATASET may also be COCO annotations (.json), or a folder with annotations.json.

    \b
    Examples:
      kpbench export kpbench-data --format coco
      kpbench export val --format yolo --val-share 0.1 --out val-yolo
      kpbench export kpbench-data-coco --format webdataset
    """
    from kpbench.cli.progress import progress_bar
    from kpbench.dataset.export import UNFINISHED, export_dataset
    from kpbench.dataset.labelled import open_labelled

    data, target = open_labelled(dataset), out or Path(f"{dataset}-{file_format}")
    try:
        with progress_bar(len(data), "export") as progress:
            echo(export_dataset(data, file_format, target, progress, val_share))
    except KeyboardInterrupt:
        is_finished = (target / "README.md").exists() and not (target / UNFINISHED).exists()
        message = "the export is finished" if is_finished else "the same command continues the export"
        raise KeyboardInterrupt(message) from None
