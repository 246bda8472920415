"""Figures for papers: panels of lines as PDF, PNG or SVG, drawn by Matplotlib. Needs the extra ``report``."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from typing import Any

from kpbench.errors import DataError
from kpbench.report.charts import CHART_COLOURS, LIGHT_COLOURS, Panel, Series

FIGURE_FORMATS = (".pdf", ".png", ".svg")
"""Suffixes of files that a figure can be written to."""
FIGURE_MARK = "kpbench.report/1"
"""The mark that lets :func:`kpbench.writing.write_file` replace a figure."""
PANEL_INCHES = 2.35, 1.85
"""Width and height of a panel; three panels fill the text width of a page in two columns."""
MARKERS = "osD^vPX*h"
"""One marker per colour, so that lines can be told apart in print without colour."""
MATPLOTLIB_STYLE: dict[str, Any] = {
    "font.size": 7,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.linewidth": 0.4,
    "grid.alpha": 0.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 2.8,
    "pdf.fonttype": 42,
    "svg.hashsalt": "kpbench",
    "savefig.dpi": 200,
}
"""Settings of Matplotlib. The fixed salt gives the same panels the same bytes."""


def draw_panels(panels: Sequence[Panel], suffix: str, *, columns: int = 3) -> bytes:
    """Draw panels side by side, with one legend for all.

    Parameters
    ----------
    panels : sequence of Panel
    suffix : {".pdf", ".png", ".svg"}
    columns : int
        Panels per row.

    Returns
    -------
    bytes
        The content of a file. The same panels give the same bytes with the same version of Matplotlib.

    Raises
    ------
    DataError
        If Matplotlib is not installed.

    Examples
    --------
    >>> import kpbench
    >>> line = kpbench.report.Series("a", [1, 2], [0.9, 0.7], [(0.8, 1.0), (0.6, 0.8)])
    >>> kpbench.report.draw_panels([kpbench.report.Panel((line,), "blur (px)", "score")], ".pdf")[:5]
    b'%PDF-'
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError:
        raise DataError(f"a figure ({suffix}) needs one more package: pip install 'kpbench[report]'") from None
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    style: dict[Any, Any] = {**matplotlib.rcParamsDefault, "backend": "agg", **MATPLOTLIB_STYLE}
    with matplotlib.rc_context(style):
        figure = Figure((columns * PANEL_INCHES[0], rows * PANEL_INCHES[1] + 0.35), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        named: dict[str, Any] = {}
        for axes, panel in zip(grid, panels, strict=False):
            for s in panel.series:
                named.setdefault(s.name, _draw_line(axes, s))
            _set_axes(axes, panel)
        for axes in grid[len(panels) :]:
            axes.set_axis_off()
        figure.legend(named.values(), [*named], loc="outside lower center", ncols=min(len(named), 4), frameon=False)
        file = io.BytesIO()
        figure.savefig(file, format=suffix[1:], metadata=_metadata(suffix))
    return _mark_svg(file.getvalue()) if suffix == ".svg" else file.getvalue()


def _draw_line(axes: Any, s: Series) -> Any:
    """Draw a line with its band. Return the line."""
    colour, missing = LIGHT_COLOURS[s.style % CHART_COLOURS], (math.nan, math.nan)
    dashed = s.dashed or s.style >= CHART_COLOURS
    y = [math.nan if v is None else v for v in s.y]
    marker = MARKERS[s.style % CHART_COLOURS]
    [line] = axes.plot(s.x, y, color=colour, marker=marker, linestyle="--" if dashed else "-", clip_on=False, zorder=3)
    if s.interval is not None:
        low, high = zip(*(i or missing for i in s.interval), strict=True) if len(s.interval) else ((), ())
        axes.fill_between(s.x, low, high, color=colour, alpha=0.15, linewidth=0)
    return line


def _set_axes(axes: Any, panel: Panel) -> None:
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label, ylim=panel.y_range or (0, None))
    if panel.log_x:
        axes.set_xscale("log")
    ticks = panel.x_ticks[:: -(-len(panel.x_ticks) // 8)] if panel.x_ticks else ()
    axes.set_xticks(ticks, [f"{x:g}" for x in ticks])
    axes.minorticks_off()


def _metadata(suffix: str) -> dict[str, Any]:
    """Return the metadata that make the file replaceable, without the date."""
    if suffix == ".png":
        return {"Software": FIGURE_MARK}
    return {"Keywords": FIGURE_MARK, "CreationDate": None} if suffix == ".pdf" else {"Date": None}


def _mark_svg(svg: bytes) -> bytes:
    """Return an SVG whose head is two lines, followed by the mark."""
    text = svg.decode()
    head = re.search(r"<svg [^>]*>", text)
    assert head is not None
    start, mark = '<?xml version="1.0" encoding="utf-8"?>', f"<!-- {FIGURE_MARK} -->"
    return f"{start}\n{' '.join(head[0].split())}\n{mark}\n{text[head.end() :].lstrip()}".encode()
