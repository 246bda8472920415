"""``kpbench synth`` and ``merge``, and the function that writes a dataset for ``synth`` and ``suite``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kpbench.cli.messages import echo, print_warning
from kpbench.cli.options import BACKGROUNDS, CAMERA, PATCHES, SEED, SIZE, Two, run_options

if TYPE_CHECKING:
    from kpbench.dataset.config import DatasetConfig
    from kpbench.dataset.folder import Dataset


@click.command()
@click.option("--n", "n", type=int, required=True, help="Number of images.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("kpbench-data"),
    show_default=True,
    help="Folder to write into, or a URL such as s3://bucket/name (pip install 'kpbench[remote]').",
)
@SEED
@BACKGROUNDS
@PATCHES
@click.option("--size", type=SIZE, default="640x480", show_default=True, help="Width and height of an image in px.")
@click.option("--channels", type=int, default=1, show_default=True, help="1 for grey images, 3 for RGB.")
@click.option(
    "--deteriorate",
    type=click.Choice(["none", "paper", "ladder"]),
    default=None,
    help="Effects on images. paper: as in the paper, the default without --camera. none: the default with --camera. "
    "ladder: one or two effects of kpbench degrade, mild to severe.",
)
@CAMERA
@click.option(
    "--radius-px",
    type=Two(float, "LEAST:MOST", ":", "5:80"),
    default="5:80",
    show_default=True,
    help="Radii of the discs before tilt, in px. The minor semi-axis is at least LEAST or 5 px, whichever is less.",
)
@click.option(
    "--distractors",
    type=click.IntRange(0, 1000),
    default=0,
    show_default=True,
    help="Largest number of unlabelled look-alikes per image: discs, rings, half-patches, chequers, text.",
)
@click.option(
    "--augment",
    type=click.Path(path_type=Path),
    help="File with your own albumentations pipeline, made by albumentations.save (JSON or YAML). Applied last.",
)
@click.option(
    "--shard-size", type=int, default=500, show_default=True, help="Number of images per shard. A shard is one file."
)
@run_options
def synth(
    n: int,
    out: Path,
    seed: int,
    backgrounds: Path | None,
    patches: tuple[Path, ...],
    size: tuple[int, int],
    channels: int,
    deteriorate: str | None,
    camera: str | None,
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
      kpbench synth --n 500 --camera webcam --channels 3 --out webcam
      kpbench synth --n 500 --deteriorate none --augment pipeline.json --out augmented
      kpbench synth --n 100000 --engine dask --scheduler tcp://host:8786 --out /shared/big
    """
    from kpbench.camera.preset import load_camera_preset
    from kpbench.patches.design import load_patches, shipped_patches
    from kpbench.render.placement import Limits
    from kpbench.synth.synthetic import SynthConfig
    from kpbench.synth.user_pipeline import load_augmentation

    config = SynthConfig(
        n=n,
        seed=seed,
        size_px=size,
        channels=channels,
        deteriorate=deteriorate or ("paper" if camera is None else "none"),
        camera=None if camera is None else load_camera_preset(camera),
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
    """Make one dataset from the shards of several runs with --shard-range.

    The command checks that every shard is present and undamaged, then writes the manifest. PARTS are folders. Their
    shards are linked or copied into DATASET. Leave PARTS out if all runs wrote into DATASET.

    \b
    Examples:
      kpbench synth --n 20000 --shard-range 0:20 --out train     # on one machine
      kpbench synth --n 20000 --shard-range 20:40 --out train    # on another, same shared folder
      kpbench merge train
    """
    from kpbench.dataset.generation import merge as merged

    print_dataset(merged(dataset, parts))


def write_dataset(
    config: DatasetConfig,
    out: Path,
    title: str,
    *,
    workers: int | None,
    engine: str,
    scheduler: str | None,
    shard_range: tuple[int, int] | None,
    resume: bool,
    overwrite: bool,
) -> None:
    """Write a dataset, show a progress bar with a title, and print one line about the dataset.

    The keyword parameters are the options of ``run_options``.
    """
    from kpbench.cli.progress import progress_bar
    from kpbench.dataset.generation import generate, generate_part

    if resume and overwrite:
        raise click.UsageError("--resume and --overwrite exclude each other")
    if (engine == "dask") != (scheduler is not None):
        raise click.UsageError("--engine dask and --scheduler ADDR belong together")
    shards = range(*shard_range) if shard_range else None
    total = config.n if shards is None else min(len(shards) * config.shard_size, config.n)
    how: dict[str, Any] = {"workers": workers, "scheduler": scheduler, "resume": resume, "overwrite": overwrite}
    try:
        with progress_bar(total, title) as progress:
            how["progress"] = progress
            if shards is not None:
                images = generate_part(config, out, shards, **how)
                echo(f"{out}: {images} images in shards {shards.start}:{shards.stop}; no manifest yet")
                return
            result = generate(config, out, **how)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"finished shards are kept in {out}; add --resume to continue the run") from None
    if result.broken_files:
        shown = ", ".join(result.broken_files[:5]) + (" …" if len(result.broken_files) > 5 else "")
        print_warning(f"{len(result.broken_files)} background files could not be decoded and were passed over: {shown}")
    print_dataset(result.dataset)


def print_dataset(dataset: Dataset) -> None:
    """Print one line about a finished dataset."""
    echo(f"{dataset.path}: {len(dataset)} images, {len(dataset.shards)} shards, fingerprint {dataset.fingerprint[:16]}")
