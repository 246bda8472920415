"""Option decorators and parameter types that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

__all__ = ["FINITE", "ONLY", "PATCHES", "SEED", "SIZE", "WORKERS", "Finite", "Pair", "Size", "run_options"]


class Size(click.ParamType[tuple[int, int]]):
    """``WIDTHxHEIGHT`` in px, as a tuple."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        try:
            width, height = (int(part) for part in str(value).lower().split("x"))
        except ValueError:
            self.fail(f"{value!r} is no size, expected WIDTHxHEIGHT such as 640x480", param, ctx)
        return width, height


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


class Span(click.ParamType[range]):
    """``A:B`` as a range."""

    name = "A:B"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> range:
        try:
            first, last = (int(part) for part in str(value).split(":"))
        except ValueError:
            self.fail(f"{value!r} is no range, expected A:B such as 0:10", param, ctx)
        return range(first, last)


class Pair(click.ParamType[tuple[float, float]]):
    """``LEAST:MOST`` as a tuple of numbers."""

    name = "LEAST:MOST"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            least, most = (float(part) for part in str(value).split(":"))
        except ValueError:
            self.fail(f"{value!r} is no pair, expected LEAST:MOST such as 5:80", param, ctx)
        return least, most


SIZE = Size()
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
        click.option("--shard-range", type=Span(), help="Only these shards, from 0; put together by kpbench merge."),
        click.option("--resume", is_flag=True, help="Finish an interrupted run."),
        click.option("--overwrite", is_flag=True, help="Replace the dataset in the folder."),
    )):  # fmt: skip
        command = option(command)
    return command
