"""Option decorators and parameter types that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import click

if TYPE_CHECKING:
    from kpbench.patches.board import Board

Number = TypeVar("Number", bound=float)


class Two(click.ParamType[tuple[Number, Number]], Generic[Number]):
    """Two numbers with a separator between them, parsed into a tuple."""

    def __init__(self, kind: type[Number], name: str, separator: str, example: str) -> None:
        self.kind, self.name, self.separator, self.example = kind, name, separator, example

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[Number, Number]:
        if isinstance(value, tuple):
            return value
        try:
            first, second = map(self.kind, str(value).lower().split(self.separator))
        except ValueError:
            self.fail(f"{value!r} is not {self.name}, expected two numbers such as {self.example}", param, ctx)
        return first, second


class Names(click.ParamType[tuple[str, ...]]):
    """Names with commas between them, parsed into a tuple."""

    name = "NAME,…"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        return value if isinstance(value, tuple) else tuple(filter(None, map(str.strip, str(value).split(","))))


class Finite(click.FloatRange):
    """A number within a range. In contrast to ``click.FloatRange``, nan and infinity are refused."""

    def _describe_range(self) -> str:
        return "" if self.min is self.max is None else super()._describe_range()

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number


class FileOfSuffix(click.Path):
    """A file to write. Its name must end in one of the given suffixes.

    A function returns the suffixes. The function may import slow modules without delaying ``kpbench --help``.
    """

    def __init__(self, suffixes: Callable[[], Iterable[str]]) -> None:
        super().__init__(dir_okay=False, path_type=Path)
        self.suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if Path(value).suffix.lower() not in self.suffixes():
            self.fail(f"{value}: expected a file ending in {', '.join(self.suffixes())}", param, ctx)
        return super().convert(value, param, ctx)


SIZE = Two(int, "WxH", "x", "640x480")
SHARDS = Two(int, "A:B", ":", "0:10")
FINITE = Finite()
BACKGROUNDS = click.option(
    "--backgrounds", type=click.Path(path_type=Path), help="Folder of photographs. Default: procedural backgrounds."
)
CAMERA = click.option(
    "--camera",
    help="Camera that takes the images: industrial, webcam, phone, action-cam, everyday, a .toml file of your own, "
    "or a calibration of OpenCV, ROS or Kalibr (.yaml, .json). Light is blurred before the tone curve, as in a real "
    "camera.",
)
ONLY = click.option(
    "--only", type=Names(), default="", help="Only these conditions, such as scale,blur. Default: all conditions."
)
SEED = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of all random choices."
)
WORKERS = click.option("--workers", type=click.IntRange(min=1), help="Number of processes. Default: one per core.")
PATCHES = click.option(
    "--patches",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE|DIR",
    help="Design of your own (TOML), or a folder of designs; repeatable. Default: the shipped four.",
)


def run_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of a command that writes a dataset: where shards are made, and which are kept."""
    for option in reversed((
        WORKERS,
        click.option(
            "--engine",
            type=click.Choice(["local", "dask"]),
            default="local",
            show_default=True,
            help="Where shards are made: in processes of this machine, or by the workers of a Dask cluster.",
        ),
        click.option("--scheduler", metavar="ADDR", help="Address of the Dask scheduler, such as tcp://host:8786."),
        click.option(
            "--shard-range", type=SHARDS, help="Make only shards A to B - 1, counted from 0; see kpbench merge."
        ),
        click.option("--resume", is_flag=True, help="Keep the finished shards of an interrupted run, make the rest."),
        click.option("--overwrite", is_flag=True, help="Delete the dataset in the folder first."),
    )):  # fmt: skip
        command = option(command)
    return command


def load_one_board(name: str) -> Board:
    """Return the board that ``--board`` names; refuse a name of several boards."""
    from kpbench.patches.board_file import load_boards

    boards = load_boards(name)
    if len(boards) > 1:
        raise click.UsageError(f"--board {name} names {len(boards)} boards; give the sidecar of one of them")
    return boards[0]
