"""Commands of the benchmark's suites and of the ladder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from kpbench.cli.options import FINITE, ONLY, SEED, SIZE, run_options


class Distortion(click.ParamType[tuple[float, ...]]):
    """``k1,k2,p1,p2,k3`` as a tuple; trailing ones may be left out."""

    name = "k1,k2,p1,p2,k3"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if not 1 <= len(numbers) <= 5:
            self.fail(f"{value!r} is no distortion, expected up to five numbers: k1,k2,p1,p2,k3", param, ctx)
        return numbers


@click.command()
@click.argument("name")
@click.option("--out", type=click.Path(path_type=Path), help="Folder; default: kpbench-suite/NAME.")
@click.option("--images", type=int, help="Base scenes, each seen with every patch under every rung; default: 500.")
@SEED
@click.option("--backgrounds", type=click.Path(path_type=Path), help="Folder of photographs; else procedural ones.")
@click.option("--size", type=SIZE, help="Scale the camera, same field of view; default: 1624x1240.")
@ONLY
@click.option("--distortion", type=Distortion(), help="Lens distortion as OpenCV's coefficients; default: none.")
@click.option("--board", type=click.Choice(["aruco", "apriltag", "charuco"]), help="Tags in the place of patches.")
@run_options
def suite(
    name: str,
    out: Path | None,
    images: int | None,
    seed: int,
    backgrounds: Path | None,
    size: tuple[int, int] | None,
    only: tuple[str, ...],
    distortion: tuple[float, ...] | None,
    board: str | None,
    **run: Any,
) -> None:
    """Write the images of a benchmark suite: paper-v1, extended-v1, or a .toml file of your own.

    \b
    Examples:
      kpbench suite paper-v1 --images 20 --size 640x480
      kpbench suite paper-v1 --only scale,blur --backgrounds photos/ --out scale-and-blur
      kpbench suite paper-v1 --board aruco
    """
    from kpbench.cli.progress import write_dataset
    from kpbench.synth.suite import SuiteConfig
    from kpbench.synth.suite_file import load_suite

    config = SuiteConfig(load_suite(name), images, seed, size, only, backgrounds, distortion or (), board)
    write_dataset(config, out or Path("kpbench-suite") / config.name, "suite", **run)


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.option(
    "--effect", "effects", multiple=True, required=True, help="An effect of the ladder; repeatable, in order."
)
@click.option("--level", "levels", type=FINITE, multiple=True, required=True, help="Its level; one for each effect.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("degraded"), show_default=True, help="Folder.")
@SEED
def degrade(source: Path, effects: tuple[str, ...], levels: tuple[float, ...], out: Path, seed: int) -> None:
    """Degrade an image, or all images of a folder, and write them as PNG.

    Prints one line an image: the file, and what was applied as JSON.

    \b
    Effects and their rungs in the suites:
      blur 3 7 11 15 px · dimming 10 20 30 40 · noise 15 30 45 60 grey levels · motion-blur 5 10 20 30 px
      defocus 2 4 6 9 px · shadow-edge 30 50 70 90 % · rain 500 1000 2000 4000 · jpeg 50 25 10 5
      low-light 4 6 8 9 stops · occlusion 10 20 30 40 % · flare 60 120 180 240
      gaussian-blur and dimming-literal are in none

    \b
    Examples:
      kpbench degrade photo.jpg --effect blur --level 7
      kpbench degrade photos/ --effect motion-blur --level 20 --effect noise --level 15 --out worn
    """
    import json

    from kpbench.cli.progress import progress_bar
    from kpbench.degrade.own_images import degrade_files
    from kpbench.errors import DataError
    from kpbench.images import check_apart, open_images

    if len(effects) != len(levels):
        raise click.UsageError(f"{len(effects)} --effect and {len(levels)} --level, expected one level for each effect")
    steps = tuple(zip(effects, levels, strict=True))
    if (source / "dataset.json").exists():
        raise DataError(f"{source}: a dataset, expected images; `kpbench synth` and `kpbench suite` degrade their own")
    check_apart(source, out)
    images = open_images(str(source), but=out)
    with progress_bar(images.length, "degrade") as progress:
        for path, applied in degrade_files(images, out, steps, seed):
            click.echo(f"{path} {json.dumps(applied)}")
            progress(1)
