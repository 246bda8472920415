"""Commands that make and look at datasets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from kpbench.cli.options import PATCHES, SEED, SIZE, Two, run_options

DATASET = click.argument("dataset", type=click.Path(path_type=Path), default=Path("kpbench-data"))


@click.command()
@click.option("--n", "n", type=int, required=True, help="Number of images.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("kpbench-data"),
    show_default=True,
    help="Folder, or a URL such as s3://bucket/name (pip install 'kpbench[remote]').",
)
@SEED
@click.option("--backgrounds", type=click.Path(path_type=Path), help="Folder of photographs; else procedural ones.")
@PATCHES
@click.option("--size", type=SIZE, default="640x480", show_default=True)
@click.option("--channels", type=int, default=1, show_default=True, help="1 grey, 3 RGB.")
@click.option(
    "--deteriorate",
    type=click.Choice(["none", "paper", "ladder"]),
    default="paper",
    show_default=True,
    help="none; as the paper does; or one or two effects of kpbench degrade, from nothing to their last rung.",
)
@click.option(
    "--radius-px",
    type=Two(float, "LEAST:MOST", ":", "5:80"),
    default="5:80",
    show_default=True,
    help="Of the discs before tilt. No short semi-axis is under the least of them or 5 px, whichever is less.",
)
@click.option(
    "--distractors",
    type=click.IntRange(0, 1000),
    default=0,
    show_default=True,
    help="Up to so many look-alikes an image, without a label: discs, rings, half-patches, chequers, text.",
)
@click.option(
    "--augment",
    type=click.Path(path_type=Path),
    help="Your own albumentations pipeline, as albumentations.save writes it (JSON or YAML), applied last.",
)
@click.option("--shard-size", type=int, default=500, show_default=True, help="Images a file.")
@run_options
def synth(
    n: int,
    out: Path,
    seed: int,
    backgrounds: Path | None,
    patches: tuple[Path, ...],
    size: tuple[int, int],
    channels: int,
    deteriorate: str,
    radius_px: tuple[float, float],
    distractors: int,
    augment: Path | None,
    shard_size: int,
    **run: Any,
) -> None:
    """Write N synthetic labelled images into a dataset folder.

    \b
    Examples:
      kpbench synth --n 2000 --backgrounds photos/ --out val --seed 1
      kpbench synth --n 500 --patches mine.toml --patches other.toml --out own-designs
      kpbench synth --n 500 --radius-px 3:20 --deteriorate ladder --out small-and-worn
      kpbench synth --n 500 --deteriorate none --augment pipeline.json --out augmented
      kpbench synth --n 100000 --engine dask --scheduler tcp://host:8786 --out /shared/big
    """
    from kpbench.cli.progress import write_dataset
    from kpbench.patches.design import load_patches, shipped_patches
    from kpbench.render.scene import Limits
    from kpbench.synth.synthetic import SynthConfig
    from kpbench.synth.user_pipeline import load_augmentation

    config = SynthConfig(
        n=n,
        seed=seed,
        size_px=size,
        channels=channels,
        deteriorate=deteriorate,
        limits=Limits.of_radius(*radius_px),
        shard_size=shard_size,
        backgrounds=backgrounds,
        distractors=distractors,
        augmentation=None if augment is None else load_augmentation(augment),
        patches=load_patches(patches) if patches else shipped_patches(),
    )
    write_dataset(config, out, "synth", **run)


@click.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.argument("parts", nargs=-1, type=click.Path(path_type=Path))
def merge(dataset: Path, parts: tuple[Path, ...]) -> None:
    """Make one dataset of shards that --shard-range made: check that all are there, write the manifest.

    PARTS are folders whose shards are linked or copied into DATASET; none where all parts wrote into it.

    \b
    Examples:
      kpbench synth --n 20000 --shard-range 0:20 --out train     # on one machine
      kpbench synth --n 20000 --shard-range 20:40 --out train    # on another, same shared folder
      kpbench merge train
    """
    from kpbench.cli.progress import tell_dataset
    from kpbench.dataset.generation import merge as merged

    tell_dataset(merged(dataset, parts))


@click.command()
@DATASET
def inspect(dataset: Path) -> None:
    """Say what is in a dataset: size, counts, and how its keypoints are distributed.

    \b
    Example:
      kpbench inspect kpbench-data
    """
    from kpbench.dataset.card import facts, histograms
    from kpbench.dataset.folder import open_dataset

    data = open_dataset(dataset)
    click.echo(f"{'dataset':12} {data.path}")
    for name, value in facts(data).items():
        click.echo(f"{name:12} {value}")
    for histogram in histograms(data):
        click.echo(histogram.title)
        most = max(int(histogram.counts.max()), 1)
        for label, count, share in zip(histogram.labels, histogram.counts, histogram.shares, strict=True):
            click.echo(f"  {label:>14} {count:>8} {share:6.1%} {'#' * round(30 * count / most)}")


@click.command()
@DATASET
def verify(dataset: Path) -> None:
    """Check every byte of a dataset against its manifest; exit 1 at the first that differs.

    \b
    Example:
      kpbench verify kpbench-data
    """
    from kpbench.cli.progress import progress_bar
    from kpbench.dataset.folder import open_dataset

    data = open_dataset(dataset)
    with progress_bar(len(data), "verify") as progress:
        for shard in data.verify():
            progress(shard.count)
    click.echo(f"{dataset}: {len(data)} images in {len(data.shards)} shards, all as written")


@click.command()
@DATASET
@click.option("--out", type=click.Path(path_type=Path), help="PNG file; default: preview.png in the dataset.")
@click.option("--count", type=click.IntRange(1, 400), default=12, show_default=True, help="Images on the sheet.")
@click.option("--columns", type=click.IntRange(1, 20), default=4, show_default=True)
@click.option(
    "--tile-width", type=click.IntRange(64, 4096), default=480, show_default=True, help="Width of an image, px."
)
def preview(dataset: Path, out: Path | None, count: int, columns: int, tile_width: int) -> None:
    """Draw a contact sheet of evenly spaced images with their true keypoints.

    \b
    Example:
      kpbench preview kpbench-data --count 20 --columns 5
    """
    import cv2

    from kpbench.dataset.card import overview
    from kpbench.dataset.folder import open_dataset
    from kpbench.files import write_atomic

    data = open_dataset(dataset)
    sheet = overview(data, count, columns, tile_width)
    target = out or data.path / "preview.png"
    write_atomic(target, cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))[1].tobytes())
    click.echo(str(target))


@click.command()
@DATASET
@click.option("--format", "form", type=click.Choice(["coco", "yolo", "webdataset"]), required=True)
@click.option("--out", type=click.Path(path_type=Path), help="New folder; default: DATASET-FORMAT.")
def export(dataset: Path, form: str, out: Path | None) -> None:
    """Write a dataset as COCO keypoints, YOLO-pose or WebDataset.

    \b
    Example:
      kpbench export kpbench-data --format coco
    """
    from kpbench.cli.progress import progress_bar
    from kpbench.dataset.export import export_dataset
    from kpbench.dataset.folder import open_dataset

    data = open_dataset(dataset)
    with progress_bar(len(data), "export") as progress:
        click.echo(str(export_dataset(data, form, out or Path(f"{dataset}-{form}"), progress)))
