"""Option decorators and parameter types that several commands share."""

from __future__ import annotations

from typing import Any

import click

__all__ = ["SIZE", "Size"]


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


SIZE = Size()
