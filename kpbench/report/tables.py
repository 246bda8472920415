"""Tables as data, and as text: terminal, Markdown, LaTeX. HTML is made by :mod:`kpbench.report`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from kpbench.scoring.bootstrap import Interval


class Estimate(NamedTuple):
    """A number with its 95 % interval; None where it is undefined or has none."""

    value: float | None
    interval: Interval | None = None


Cell = str | int | float | Estimate | None


@dataclass(frozen=True)
class Table:
    """Rows under named columns.

    Attributes
    ----------
    title : str
    columns : tuple of str
    rows : tuple of tuples of Cell
        An int is written as it is, a float with three decimals (small ones with four), None as n/a.
    note : str
        What the reader must know, below the table.
    shade : bool
        Whether a page may shade each count by its share of the row.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    shade: bool = False


def cell_text(cell: Cell, digits: int = 3) -> str:
    """A cell as people read it; an estimate as ``0.882 [0.861, 0.901]``."""
    if cell is None:
        return "n/a"
    if isinstance(cell, Estimate):
        text = cell_text(cell.value, digits)
        if cell.value is None or cell.interval is None:
            return text
        return f"{text} [{cell.interval[0]:.{digits}f}, {cell.interval[1]:.{digits}f}]"
    if isinstance(cell, float):
        return f"{cell:.{digits + (0 < abs(cell) < 0.01 and digits < 4)}f}"
    return str(cell)


def to_plain(table: Table, digits: int = 3) -> str:
    """Columns aligned with spaces, for a terminal; without title and note."""
    rows = [list(table.columns), *([cell_text(cell, digits) for cell in row] for row in table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join(lines)


def to_markdown(table: Table) -> str:
    """A GitHub table under its title in bold."""

    def line(cells: Sequence[str]) -> str:
        return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"

    lines = [f"**{table.title}**", "", line(table.columns), line(["---"] * len(table.columns))]
    lines += [line([cell_text(cell) for cell in row]) for row in table.rows]
    return "\n".join([*lines, *(["", table.note] if table.note else []), ""])


LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "ε": r"$\varepsilon$"} | {
    c: f"\\{c}" for c in "&%$#_{}"
}


def to_latex(table: Table) -> str:
    """A ``table`` with a ``tabular`` that needs no package; the first column is left, all others right aligned."""

    def escaped(text: str) -> str:
        return "".join(LATEX.get(c, c) for c in text)

    def line(cells: Sequence[str]) -> str:
        return f"{' & '.join(map(escaped, cells))} \\\\"

    body = [line([cell_text(cell) for cell in row]) for row in table.rows]
    caption = escaped(f"{table.title}. {table.note}" if table.note else table.title)
    return "\n".join(
        [
            r"\begin{table}",
            r"\centering",
            f"\\caption{{{caption}}}",
            f"\\begin{{tabular}}{{l{'r' * (len(table.columns) - 1)}}}",
            r"\hline",
            line(table.columns),
            r"\hline",
            *body,
            r"\hline",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )
