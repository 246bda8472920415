"""What the commands print: the one function that prints, and messages of the library in words of the command line."""

from __future__ import annotations

import re

import click

from kpbench.errors import one_line
from kpbench.text import escape_terminal

OPTION_OF = {
    "augmentation": "--augment",
    "shards": "--shard-range",
    "size_px": "--size",
}
"""Options whose names differ from the names of the library's parameters, for all commands."""


def echo(text: object = "", *, lines: bool = False, err: bool = False, bold: bool | None = None) -> None:
    """Print a line to stdout, or with ``err`` to stderr. Every command prints through this function.

    File names and names in files may hold anything. Control characters, escape sequences and line feeds are therefore
    printed as escapes such as ``\\x1b``. With ``lines``, the text is a table or has several lines, and line feeds stay.
    A message to stderr is one line of moderate length, see :func:`kpbench.errors.one_line`.
    """
    shown = escape_terminal(str(text), lines)
    click.secho(one_line(shown) if err else shown, err=err, bold=bold)


def clean_usage_error(error: click.ClickException) -> click.ClickException:
    """Return an error that click will print itself, with the message as :func:`echo` would print it."""
    text = "\n".join(map(one_line, escape_terminal(error.format_message(), lines=True).split("\n")))
    error.format_message = lambda: text  # type: ignore[method-assign]
    return error


def name_options(message: str, command: click.Command | None) -> str:
    """Translate parameters that the library names in backticks into options and arguments of a command.

    `n` becomes --n, `limits.radius_px` becomes --radius-px, `resume=True` becomes --resume, and `channels=3` becomes
    --channels 3. `parts` becomes PARTS if the command has this argument. Other text in backticks is not changed, such
    as a metric or another command.
    """
    if command is None:
        return message
    options = {param.name: max(param.opts, key=len) for param in command.params if isinstance(param, click.Option)}
    arguments = {param.name: param.human_readable_name for param in command.params if isinstance(param, click.Argument)}
    renamed = {name: option for name, option in OPTION_OF.items() if option in options.values()}
    known = renamed | arguments | options

    def translate(found: re.Match[str]) -> str:
        option, value = known.get(found["field"]), found["value"]
        if option is None:
            return found[0]
        return option if value in (None, "True") else f"{option} {value}"

    return re.sub(r"""`(?:\w+\.)*(?P<field>\w+)(?:=["']?(?P<value>[^`]+?)["']?)?`""", translate, message)


def print_warning(message: str) -> None:
    """Print one line to stderr, with parameters of the library named as options of the running command."""
    echo(f"kpbench: {name_options(message, click.get_current_context().command)}", err=True)
