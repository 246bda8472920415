"""Option decorators and parameter types that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar

import click

Number = TypeVar("Number", bound=float)


class Two(click.ParamType[tuple[Number, Number]], Generic[Number]):
    """Two numbers with a separator between them, as a tuple."""

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
    """Names with commas between them, as a tuple."""

    name = "NAME,…"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        return value if isinstance(value, tuple) else tuple(filter(None, map(str.strip, str(value).split(","))))


class Finite(click.FloatRange):
    """A number within a range that is neither nan nor infinite, which click lets pass."""

    def _describe_range(self) -> str:
        return "" if self.min is self.max is None else super()._describe_range()

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number


SIZE = Two(int, "WxH", "x", "640x480")
SHARDS = Two(int, "A:B", ":", "0:10")
FINITE = Finite()
ONLY = click.option("--only", type=Names(), default="", help="Only these conditions, such as scale,blur.")
SEED = click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
WORKERS = click.option("--workers", type=click.IntRange(min=1), help="Processes; default: one a core.")
PATCHES = click.option(
    "--patches",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE|DIR",
    help="Your own design (TOML), or a folder of them; repeatable. Default: the shipped four.",
)


def run_options(command: Callable[..., None]) -> Callable[..., None]:
    """Options of every command that writes a dataset: how, and what to do with what is there."""
    for option in reversed((
        WORKERS,
        click.option("--engine", type=click.Choice(["local", "dask"]), default="local", show_default=True),
        click.option("--scheduler", metavar="ADDR", help="Of Dask, such as tcp://host:8786."),
        click.option("--shard-range", type=SHARDS, help="Only these shards, from 0; put together by kpbench merge."),
        click.option("--resume", is_flag=True, help="Finish an interrupted run."),
        click.option("--overwrite", is_flag=True, help="Replace the dataset in the folder."),
    )):  # fmt: skip
        command = option(command)
    return command
