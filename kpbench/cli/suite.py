"""``kpbench suite``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from kpbench.cli.options import BACKGROUNDS, CAMERA, ONLY, SEED, SIZE, run_options


class Distortion(click.ParamType[tuple[float, ...]]):
    """One to five numbers ``k1,k2,p1,p2,k3``, parsed into a tuple."""

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
@click.option("--out", type=click.Path(path_type=Path), help="Folder to write into. Default: kpbench-suite/NAME.")
@click.option(
    "--images",
    type=int,
    help="Number of base scenes. Each scene is rendered with every patch under every rung. "
    "Default: 500 for shipped suites, 10 films for video-v1, else as in the .toml file.",
)
@click.option("--frames", type=click.IntRange(2, 100_000), help="Frames of a film, for video-v1. Default: 60.")
@SEED
@BACKGROUNDS
@click.option(
    "--size", type=SIZE, help="Width and height in px of a camera with the same field of view. Default: 1624x1240."
)
@ONLY
@click.option(
    "--distortion", type=Distortion(), help="OpenCV's coefficients of lens distortion. Default: no distortion."
)
@CAMERA
@click.option(
    "--board", type=click.Choice(["aruco", "apriltag", "charuco"]), help="Show a board of tags instead of the patches."
)
@run_options
def suite(
    name: str,
    out: Path | None,
    images: int | None,
    frames: int | None,
    seed: int,
    backgrounds: Path | None,
    size: tuple[int, int] | None,
    only: tuple[str, ...],
    distortion: tuple[float, ...] | None,
    camera: str | None,
    board: str | None,
    **run: Any,
) -> None:
    """Write the images of a benchmark suite into a dataset folder.

    NAME is paper-v1, extended-v1, extended-v2, camera-v1, video-v1, or a .toml file of your own.

    \b
    Examples:
      kpbench suite paper-v1 --images 20 --size 640x480
      kpbench suite paper-v1 --only scale,blur --backgrounds photos/ --out scale-and-blur
      kpbench suite paper-v1 --board aruco
      kpbench suite paper-v1 --camera webcam
      kpbench suite video-v1 --images 1 --frames 10 --size 406x310
    """
    from kpbench.camera.preset import load_camera_preset
    from kpbench.cli.synth import write_dataset
    from kpbench.synth.suite import SuiteConfig
    from kpbench.synth.suite_file import load_suite

    preset = None if camera is None else load_camera_preset(camera)
    content = load_suite(name)
    if frames is not None:
        if content.film is None:
            raise click.UsageError(f"--frames is for suites of films; {name} has none")
        content = replace(content, film=replace(content.film, frames=frames))
    config = SuiteConfig(content, images, seed, size, only, backgrounds, distortion or (), board, preset=preset)
    write_dataset(config, out or Path("kpbench-suite") / config.name, "suite", **run)
