"""``kpbench degrade``."""

from __future__ import annotations

from pathlib import Path

import click

from kpbench.cli.messages import echo
from kpbench.cli.options import FINITE, SEED


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.option(
    "--effect", "effects", multiple=True, required=True, help="Effect; repeatable. Effects are applied in this order."
)
@click.option(
    "--level", "levels", type=FINITE, multiple=True, required=True, help="Level of the effect; one for each --effect."
)
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("degraded"), show_default=True, help="Folder to write into."
)
@SEED
def degrade(source: Path, effects: tuple[str, ...], levels: tuple[float, ...], out: Path, seed: int) -> None:
    """Degrade an image, or all images of a folder, and write them as PNG.

    The command prints one line per image: the written file, then the applied effects as JSON.

    \b
    Effects and their rungs in the suites:
      blur 3 7 11 15 px · dimming 10 20 30 40 · noise 15 30 45 60 grey levels · motion-blur 5 10 20 30 px
      defocus 2 4 6 9 px · shadow-edge 30 50 70 90 % · rain 500 1000 2000 4000 · jpeg 50 25 10 5
      low-light 4 6 8 9 stops · occlusion 10 20 30 40 % · flare 60 120 180 240
      gaussian-blur and dimming-literal are in no suite

    \b
    Examples:
      kpbench degrade photo.jpg --effect blur --level 7
      kpbench degrade photos/ --effect motion-blur --level 20 --effect noise --level 15 --out worn
    """
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
