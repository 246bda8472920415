"""Option decorators and parameter types that several commands share."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

__all__ = ["FINITE", "ONLY", "PATCHES", "SEED", "SIZE", "WORKERS", "Finite", "Size"]


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

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number


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
