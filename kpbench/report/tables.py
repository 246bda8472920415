"""Tables as data, and as text for a terminal and Markdown.

LaTeX is in :mod:`kpbench.report.latex`, the HTML form in ``templates/report.html``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from kpbench.scoring.bootstrap import Interval
from kpbench.text import escape_markdown, escape_terminal


class Estimate(NamedTuple):
    """A number with its 95 % interval. An undefined number or interval is None.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.report.Estimate(0.882, (0.861, 0.901)).value
    0.882
    """

    value: float | None
    interval: Interval | None = None


Cell = str | int | float | Estimate | None
"""A cell of a table: text, a count, a number, a number with its interval, or None for undefined."""


@dataclass(frozen=True)
class Table:
    """Rows under named columns.

    Attributes
    ----------
    title : str
    columns : tuple of str
    rows : tuple of tuples of Cell
        A float is written with three decimals (four below 0.01), None as n/a.
    note : str
        Text below the table.
    shade : bool
        Whether a page shades each count by its share of the row's sum.

    Examples
    --------
    >>> import kpbench
    >>> table = kpbench.report.Table("Two detectors", ("detector", "score"), (("a", 0.9), ("b", None)))
    >>> print(kpbench.report.to_plain(table))
    detector  score
    a         0.900
    b         n/a
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    shade: bool = False


def cell_text(cell: Cell, digits: int = 3) -> str:
    """Write a float with ``digits`` decimals, an estimate as ``0.882 [0.861, 0.901]``, None as n/a, text in one line.

    If ``digits`` is under 4, a nonzero float below 0.01 gets one decimal more.
    """
    if cell is None:
        return "n/a"
    if isinstance(cell, Estimate):
        text = cell_text(cell.value, digits)
        if cell.value is None or cell.interval is None:
            return text
        return f"{text} [{cell.interval[0]:.{digits}f}, {cell.interval[1]:.{digits}f}]"
    if isinstance(cell, float):
        return f"{cell:.{digits + (0 < abs(cell) < 0.01 and digits < 4)}f}"
    return escape_terminal(str(cell))


def to_plain(table: Table, digits: int = 3) -> str:
    """Write a table for a terminal: columns aligned with spaces, without title and note.

    Examples
    --------
    >>> import kpbench
    >>> print(kpbench.report.to_plain(kpbench.report.Table("", ("n", "score"), ((10, 0.5),))))
    n   score
    10  0.500
    """
    rows = [[cell_text(cell, digits) for cell in row] for row in (table.columns, *table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join(lines)


def to_markdown(table: Table) -> str:
    r"""Write a table in GitHub's Markdown, under its title in bold.

    Examples
    --------
    >>> import kpbench
    >>> text = kpbench.report.to_markdown(kpbench.report.Table("Scores", ("detector", "score"), (("a", 0.5),)))
    >>> text.splitlines()[-1]
    '| a | 0.500 |'
    """

    def line(cells: Sequence[str]) -> str:
        return f"| {' | '.join(cells)} |"

    def escape(cell: Cell) -> str:
        return escape_markdown(cell) if isinstance(cell, str) else cell_text(cell)

    lines = [f"**{escape(table.title)}**", "", line([*map(escape, table.columns)]), line(["---"] * len(table.columns))]
    lines += [line([*map(escape, row)]) for row in table.rows]
    return "\n".join([*lines, *(["", escape(table.note)] if table.note else []), ""])
