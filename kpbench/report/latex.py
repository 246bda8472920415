r"""Tables as LaTeX that fits a page of ``article``. The document needs ``\usepackage{booktabs,longtable}``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import count

from kpbench.report.tables import Cell, Estimate, Table, cell_text
from kpbench.text import escape_latex

TEXT_WIDTH_PT = 345.0
r"""``\textwidth`` of ``article`` at 10 pt, the narrowest of its sizes."""
CHARACTER_PT, SCRIPT_PT = 4.6, 3.6
r"""Width of a character in ``\footnotesize``, and of one in its sub- and superscripts; digits are 8 % narrower."""
COLUMN_GAP_PT = 6.0
r"""Space between two columns, twice ``\tabcolsep``."""
MOST_ROWS = 30
"""A table with more rows may break across pages."""
LONGEST_TEXT = 24
"""A text of more characters is set in lines of this many characters."""
MOST_KEYS = 3
"""Number of leading columns of text that every part of a wide table repeats."""


def to_latex(table: Table) -> str:
    r"""Write a table for LaTeX with ``booktabs``, in parts if it is wider than the page.

    Each part repeats the leading columns of text, and has a label: ``tab:`` and the title in lower case, with ``-2``
    and so on for further parts. A part with many rows is a ``longtable``. The bounds of an interval are sub- and
    superscript of the value.

    Examples
    --------
    >>> import kpbench
    >>> text = kpbench.report.to_latex(kpbench.report.Table("Scores", ("detector", "score"), (("a_b", 0.5),)))
    >>> print(text.splitlines()[8])
    a\_b & 0.500 \\
    """
    keys = next((n for n in range(MOST_KEYS) if not _is_text(table, n)), MOST_KEYS)
    keys = min(max(keys, 1), len(table.columns))
    widths = [_column_width_pt(table, n) for n in range(len(table.columns))]
    parts, used = [[*range(keys)]], sum(widths[:keys])
    for n in range(keys, len(widths)):
        if used + widths[n] > TEXT_WIDTH_PT and len(parts[-1]) > keys:
            parts.append([*range(keys)])
            used = sum(widths[:keys])
        parts[-1].append(n)
        used += widths[n]
    return "\n".join(_write_part(table, columns, n) for n, columns in zip(count(1), parts, strict=False))


def _is_text(table: Table, column: int) -> bool:
    return column < len(table.columns) and all(isinstance(row[column], str) for row in table.rows)


def _column_width_pt(table: Table, column: int) -> float:
    """Return an upper estimate of the width of a column with its gap."""
    words = max(map(len, re.split(r"[\s-]", table.columns[column])), default=0)
    cells = max((_cell_width_pt(row[column]) for row in table.rows), default=0.0)
    return max(CHARACTER_PT * words, cells) + COLUMN_GAP_PT


def _cell_width_pt(cell: Cell) -> float:
    if isinstance(cell, Estimate) and cell.value is not None and cell.interval is not None:
        return CHARACTER_PT * len(cell_text(cell.value)) + SCRIPT_PT * max(len(f"{b:.3f}") for b in cell.interval)
    return CHARACTER_PT * min(len(cell_text(cell)), LONGEST_TEXT)


def _write_part(table: Table, columns: Sequence[int], number: int) -> str:
    slug = re.sub(r"[^a-z0-9]+", "-", table.title.lower()).strip("-") or "table"
    label = f"tab:{slug}" if number == 1 else f"tab:{slug}-{number}"
    title = table.title if number == 1 else f"{table.title}, part {number}"
    note = " Sub- and superscripts are 95 % intervals." if any(_has_interval(row) for row in table.rows) else ""
    caption = escape_latex(f"{title}.{f' {table.note}' if table.note else ''}{note}")
    head = " & ".join(_write_head(table.columns[n], "l" if n == columns[0] else "r") for n in columns) + r" \\"
    aligned = "".join("l" if n == columns[0] or _is_text(table, n) else "r" for n in columns)
    body = [" & ".join(_write_cell(row[n]) for n in columns) + r" \\" for row in table.rows]
    size = rf"\footnotesize\setlength{{\tabcolsep}}{{{COLUMN_GAP_PT / 2:g}pt}}"
    titled = rf"\caption{{{caption}}}\label{{{label}}}"
    if len(table.rows) > MOST_ROWS:
        top = [rf"\begin{{longtable}}{{{aligned}}}", rf"{titled}\\", r"\toprule", head, r"\midrule", r"\endfirsthead"]
        again = [r"\toprule", head, r"\midrule", r"\endhead", r"\bottomrule", r"\endfoot"]
        return "\n".join([rf"\begingroup{size}", *top, *again, *body, r"\end{longtable}\endgroup", ""])
    top = [r"\begin{table}", r"\centering", size, titled, rf"\begin{{tabular}}{{{aligned}}}", r"\toprule", head]
    return "\n".join([*top, r"\midrule", *body, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def _has_interval(row: Sequence[Cell]) -> bool:
    return any(isinstance(cell, Estimate) and cell.interval is not None for cell in row)


def _write_head(name: str, side: str) -> str:
    """Return the name of a column, one word per line."""
    words = [escape_latex(word) for word in name.split()]
    lines = r"\\".join(words)
    return rf"\shortstack[{side}]{{{lines}}}" if len(words) > 1 else lines


def _write_cell(cell: Cell) -> str:
    if isinstance(cell, Estimate) and cell.value is not None and cell.interval is not None:
        low, high = (f"{bound:.3f}" for bound in cell.interval)
        return rf"${cell_text(cell.value)}\sb{{{low}}}\sp{{{high}}}$"
    text = cell_text(cell)
    if len(text) <= LONGEST_TEXT:
        return escape_latex(text)
    return rf"\parbox[t]{{{LONGEST_TEXT * CHARACTER_PT:.0f}pt}}{{\raggedright {escape_latex(text)}\strut}}"
