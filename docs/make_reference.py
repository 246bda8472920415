"""Make docs/reference/cli.md from the commands, and docs/reference/python.md from the stubs and docstrings.

    python docs/make_reference.py

A test compares both pages with what this script makes. Run the script after every change of a command, of an option,
of a public name or of the first line of a public docstring.
"""

from __future__ import annotations

import ast
import enum
import importlib
import inspect
import itertools
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click

import kpbench
from kpbench.cli import main as command_line

DOCS = Path(__file__).parent
PACKAGE = Path(kpbench.__file__).parent
CLI_PAGE, PYTHON_PAGE = DOCS / "reference" / "cli.md", DOCS / "reference" / "python.md"
SIGNATURE_COLUMNS, PROSE_COLUMNS = 100, 110
OPTION = re.compile(r"(?<![\w`-])(--[a-z][\w-]*)(?![\w`])")

CLI_HEAD = """\
# Command line

<!-- made by docs/make_reference.py from the commands; do not edit -->

Every command is a function in Python too: see [Python](python.md).

Results go to standard output, messages and progress to standard error.

| exit code | meaning |
|---|---|
| 0 | done |
| 1 | the input or the data is bad, or a gate (`--min`, `--max`, `--no-worse`, `--fail-on-…`) failed; one line tells |
| 2 | wrong usage |
| 130 | interrupted |
"""

PYTHON_HEAD = """\
# Python

<!-- made by docs/make_reference.py from the stubs and docstrings; do not edit -->

Everything that this page lists is public. Everything else may move.

Import a name from `kpbench` or from its room, never from a module inside a room:

```python
import kpbench
from kpbench import open_dataset
from kpbench.geometry import Camera
```

`import kpbench` is light: a name is loaded when it is first used. `help(name)` shows the parameters, the errors and an
example.
"""


class Public(NamedTuple):
    """A name that a stub lists: its room ("" for the top), and the module that defines it."""

    room: str
    name: str
    module: str


def read_stub(room: str) -> list[Public]:
    """Return the public names of a room, in the order of its stub."""
    stub = PACKAGE / room / "__init__.pyi"
    if not stub.exists():
        return []
    names = []
    for node in ast.parse(stub.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.level == 1:
            module = ".".join(part for part in ("kpbench", room, node.module) if part)
            names += [Public(room, alias.asname or alias.name, module) for alias in node.names]
    return names


def rooms() -> list[str]:
    """Return the rooms that have public names, by name."""
    found = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.pyi"))
    return [room for room in found if read_stub(room)]


def public_names() -> list[Public]:
    """Return every public name once: under its room, or under the top where no room lists it."""
    listed = [public for room in rooms() for public in read_stub(room)]
    known = {(public.name, public.module) for public in listed}
    names = [public for public in read_stub("") if (public.name, public.module) not in known] + listed
    return sorted(names, key=lambda public: (public.room, public.name.lower()))


def load(public: Public) -> Any:
    """Return the object of a public name."""
    return getattr(importlib.import_module(f"kpbench.{public.room}".rstrip(".")), public.name)


def first_sentence(docstring: str | None) -> str:
    """Return the summary of a docstring as Markdown."""
    summary = " ".join(inspect.cleandoc(docstring or "").partition("\n\n")[0].split())
    summary = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"`\1`", summary)
    return summary.replace("``", "`")


class Source(str):
    """Text that a signature shows as it is, without quotes."""

    __slots__ = ()
    __repr__ = str.__str__


def wrap(text: str) -> str:
    """Return a paragraph in lines of at most ``PROSE_COLUMNS``."""
    return textwrap.fill(text, PROSE_COLUMNS, break_on_hyphens=False, break_long_words=False)


def format_signature(name: str, function: Any) -> str:
    """Return a call as the reference shows it, on several lines where it is long."""
    signature = inspect.signature(function)
    parameters = [_readable(p) for p in signature.parameters.values() if p.name not in ("self", "cls")]
    returns = _annotation(signature.return_annotation)
    line = name + str(signature.replace(parameters=parameters, return_annotation=returns))
    line = line.removesuffix(" -> None") if inspect.isclass(function) else line
    if len(line) <= SIGNATURE_COLUMNS:
        return line
    kinds = [p.kind for p in parameters]
    texts = [str(p) for p in parameters]
    if inspect.Parameter.KEYWORD_ONLY in kinds and inspect.Parameter.VAR_POSITIONAL not in kinds:
        texts.insert(kinds.index(inspect.Parameter.KEYWORD_ONLY), "*")
    arrow = "" if inspect.isclass(function) or returns is inspect.Signature.empty else f" -> {returns}"
    return f"{name}(\n" + "".join(f"    {text},\n" for text in texts) + f"){arrow}"


def _annotation(value: Any) -> Any:
    """Return an annotation without the quotes that `from __future__ import annotations` gives it."""
    return Source(value) if isinstance(value, str) else value


def _readable(parameter: inspect.Parameter) -> inspect.Parameter:
    """Return a parameter whose default reads the same in every process."""
    default = parameter.default
    if default is not inspect.Parameter.empty and (callable(default) or repr(default).startswith("<")):
        default = Source("...")
    return parameter.replace(annotation=_annotation(parameter.annotation), default=default)


def members(cls: type) -> Iterator[tuple[str, str]]:
    """Yield each public method and property of a class as its call and its summary."""
    for name, member in vars(cls).items():
        wrapped = member.__func__ if isinstance(member, (classmethod, staticmethod)) else member
        if name.startswith("_") or not inspect.getdoc(wrapped):
            continue
        if isinstance(wrapped, property) or hasattr(wrapped, "attrname"):  # functools.cached_property has attrname
            yield name, first_sentence(wrapped.__doc__)
        elif inspect.isfunction(wrapped):
            parameters = [p for p in inspect.signature(wrapped).parameters if p not in ("self", "cls")]
            yield f"{name}({', '.join(parameters)})", first_sentence(wrapped.__doc__)


def describe(public: Public) -> str:
    """Return the entry of a public name as Markdown."""
    value = load(public)
    lines = [f"### `{full_name(public)}`", ""]
    if inspect.isclass(value):
        is_error = issubclass(value, BaseException)
        plain = is_error or getattr(value, "_is_protocol", False) or issubclass(value, enum.Enum)
        call = "" if plain else format_signature(public.name, value)
        lines += [*_code(call), wrap(first_sentence(value.__doc__)), ""]
        table = [table_row(f"`{name}`", summary) for name, summary in members(value)]
        lines += ["| member | |", "|---|---|", *table, ""] if table and not is_error else []
    elif callable(value):
        lines += [*_code(format_signature(public.name, value)), wrap(first_sentence(value.__doc__)), ""]
    else:
        lines += [wrap(_constant_summary(public)), ""]
    return "\n".join(lines)


def _code(call: str) -> list[str]:
    return ["```py", call, "```", ""] if call else []


def _constant_summary(public: Public) -> str:
    """Return the first sentence of the string that stands below a constant in its module."""
    body = ast.parse(inspect.getsource(importlib.import_module(public.module))).body
    for node, below in itertools.pairwise(body):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        named = any(isinstance(target, ast.Name) and target.id == public.name for target in targets)
        if named and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            return first_sentence(str(below.value.value))
    return ""


def full_name(public: Public) -> str:
    """Return a name with its room, as it can be imported."""
    return ".".join(part for part in ("kpbench", public.room, public.name) if part)


def anchor(public: Public) -> str:
    """Return the fragment that GitHub gives to the heading of a name."""
    return full_name(public).replace(".", "").lower()


def python_page() -> str:
    """Return docs/reference/python.md."""
    entries = public_names()
    parts = [PYTHON_HEAD, "## `kpbench`\n", "| name | |", "|---|---|"]
    homes = {(public.name, public.module): public for public in entries}
    for top in sorted(read_stub(""), key=lambda public: public.name.lower()):
        home = homes[top.name, top.module]
        value = load(home)
        summary = first_sentence(value.__doc__) if callable(value) else _constant_summary(home)
        parts.append(table_row(f"[`{top.name}`](#{anchor(home)})", summary))
    parts.append("")
    parts += [describe(public) for public in entries if not public.room]
    for room in rooms():
        about = first_sentence(importlib.import_module(f"kpbench.{room}").__doc__)
        parts += [f"## `kpbench.{room}`\n", f"{wrap(about)}\n"]
        parts += [describe(public) for public in entries if public.room == room]
    return "\n".join(parts).rstrip() + "\n"


def help_text(text: str) -> str:
    """Return the help of a command as Markdown: paragraphs, and code where click is told to keep the lines."""
    parts = []
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        if paragraph.startswith("\b"):
            first, *rest = paragraph.removeprefix("\b\n").splitlines()
            parts.append(f"{first}\n\n```text\n" + inspect.cleandoc("\n" + "\n".join(rest)) + "\n```")
        else:
            marked = OPTION.sub(r"`\1`", " ".join(paragraph.split()))
            parts.append(wrap(marked))
    return "\n\n".join(parts)


def table_row(*cells: str) -> str:
    """Return a row of a Markdown table."""
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def describe_option(option: click.Option, context: click.Context) -> str:
    """Return the row of an option: its name and value, its meaning, its default."""
    value = "" if option.is_flag else f" {option.make_metavar(context)}".replace(" RANGE", "")
    extra = option.get_help_extra(context)
    about = OPTION.sub(r"`\1`", option.help or "")
    about += f" Range: `{extra['range']}`." if extra.get("range") else ""
    about += " Repeatable." if option.multiple and "epeatable" not in about else ""
    default = "required" if option.required else f"`{extra['default']}`" if extra.get("default") else ""
    return table_row(f"`{', '.join(option.opts)}{value}`", about.strip(), default)


def describe_command(name: str, command: click.Command) -> str:
    """Return the section of a command."""
    context = click.Context(command, info_name=f"kpbench {name}")
    usage = " ".join([f"kpbench {name}", *command.collect_usage_pieces(context)])
    rows = [describe_option(p, context) for p in command.params if isinstance(p, click.Option) and not p.hidden]
    table = ["", "| option | meaning | default |", "|---|---|---|", *rows] if rows else []
    return "\n".join(
        [f"## `kpbench {name}`", "", f"```text\n{usage}\n```", "", help_text(command.help or ""), *table, ""]
    )


def cli_page() -> str:
    """Return docs/reference/cli.md."""
    context = click.Context(command_line)
    commands = {name: command_line.get_command(context, name) for name in command_line.list_commands(context)}
    parts = [CLI_HEAD, "| command | |", "|---|---|"]
    for name, command in commands.items():
        assert command is not None
        summary = inspect.cleandoc(command.help or "").partition("\n\n")[0].replace("\n", " ")
        parts.append(table_row(f"[`{name}`](#kpbench-{name})", OPTION.sub(r"`\1`", summary)))
    parts.append("")
    parts += [describe_command(name, command) for name, command in commands.items() if command]
    return "\n".join(parts).rstrip() + "\n"


if __name__ == "__main__":
    CLI_PAGE.write_text(cli_page())
    PYTHON_PAGE.write_text(python_page())
