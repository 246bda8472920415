"""``kpbench degrade``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from kpbench.cli.messages import echo
from kpbench.cli.options import FINITE, ONLY, SEED, WORKERS


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--effect", "effects", multiple=True, help="Effect; repeatable. Effects are applied in this order.")
@click.option("--level", "levels", type=FINITE, multiple=True, help="Level of the effect; one for each --effect.")
@click.option("--suite", metavar="NAME|FILE", help="Suite whose artificial conditions degrade a labelled dataset.")
@ONLY
@click.option("--channels", type=int, default=1, show_default=True, help="With --suite: 1 for grey images, 3 for RGB.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("degraded"), show_default=True, help="Folder to write into."
)
@SEED
@WORKERS
@click.option("--resume", is_flag=True, help="With --suite: keep the finished shards of an interrupted run.")
@click.option("--overwrite", is_flag=True, help="With --suite: delete the dataset in the folder first.")
def degrade(
    source: Path,
    effects: tuple[str, ...],
    levels: tuple[float, ...],
    suite: str | None,
    only: tuple[str, ...],
    channels: int,
    out: Path,
    seed: int,
    **run: Any,
) -> None:
    """Degrade a labelled dataset with --suite, or images and folders of images with --effect.

    With --suite, SOURCE is a dataset, COCO annotations (.json) or a folder with annotations.json. The command writes a
    dataset: the images as they are, then under each rung of the suite's conditions that consist of effects alone. In
    paper-v1, these are blur, dimming and noise. They are applied to images without a rung, and to images of the rungs
    that the paper degraded: 16 of scale and 0 of pitch.

    With --effect, the command writes PNG files, and prints one line per image: the written file, then the applied
    effects as JSON.

    \b
    Effects and their rungs in the suites:
      blur 3 7 11 15 px · dimming 10 20 30 40 · noise 15 30 45 60 grey levels · motion-blur 5 10 20 30 px
      defocus 2 4 6 9 px · shadow-edge 30 50 70 90 % · rain 500 1000 2000 4000 · jpeg 50 25 10 5
      low-light 4 6 8 9 stops · occlusion 10 20 30 40 % · flare 60 120 180 240
      hand 25 45 70 95 % · cable 1 2 4 8 cables
      gaussian-blur and dimming-literal are in no suite

    \b
    Examples:
      kpbench degrade photo.jpg --effect blur --level 7
      kpbench degrade photos/ --effect motion-blur --level 20 --effect noise --level 15 --out worn
      kpbench degrade labelled --suite paper-v1 --out degraded
      kpbench degrade photos/annotations.json --suite extended-v1 --only jpeg,defocus --out degraded
    """
    if suite is not None:
        if effects or levels:
            raise click.UsageError("--suite and --effect exclude each other")
        _degrade_dataset(source, suite, only, channels, out, seed, run)
        return
    if only or any(run.values()) or not effects:
        raise click.UsageError("expected --suite NAME for a dataset, or --effect and --level for images")
    _degrade_images(source, effects, levels, out, seed)


def _degrade_dataset(
    source: Path, suite: str, only: tuple[str, ...], channels: int, out: Path, seed: int, run: dict[str, Any]
) -> None:
    from kpbench.cli.synth import write_dataset
    from kpbench.images import refuse_same_folder
    from kpbench.synth.degraded import DegradeConfig
    from kpbench.synth.suite_file import load_suite

    refuse_same_folder(source, out)
    config = DegradeConfig(source, load_suite(suite), only, seed, channels)
    write_dataset(config, out, "degrade", engine="local", scheduler=None, shard_range=None, **run)


def _degrade_images(source: Path, effects: tuple[str, ...], levels: tuple[float, ...], out: Path, seed: int) -> None:
    import json

    from kpbench.cli.progress import progress_bar
    from kpbench.degrade.own_images import degrade_files, open_own_images

    if len(effects) != len(levels):
        raise click.UsageError(f"{len(effects)} --effect and {len(levels)} --level, expected one level for each effect")
    steps = tuple(zip(effects, levels, strict=True))
    images = open_own_images(source, out)
    with progress_bar(images.length, "degrade") as progress:
        for path, applied in degrade_files(images, out, steps, seed):
            echo(f"{path} {json.dumps(applied)}")
            progress(1)
