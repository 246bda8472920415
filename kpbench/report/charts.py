"""Draw small SVG charts: lines with intervals, and stacked bars.

A chart inherits the page's text colour. A page with charts needs the style sheet :data:`CHART_STYLE` once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from kpbench.text import escape_markup

LIGHT_COLOURS = (
    "#0067a8", "#c2410c", "#00795a", "#8d5fc4", "#a16207", "#be185d", "#3f7f93", "#5b6470", "#6f4518",
)  # fmt: skip
"""Line colours on white. Colour-blind readers can tell them apart (after Okabe and Ito 2008)."""
DARK_COLOURS = (
    "#5cb3ec", "#f59361", "#3fc79a", "#c3a2f0", "#e0b13c", "#f283b3", "#8ccbdd", "#aab3bf", "#cf9f6e",
)  # fmt: skip
"""The same on near-black."""
CHART_COLOURS = len(LIGHT_COLOURS)
"""Number of line colours, which have the CSS classes s0 to s8. Further series reuse the colours with dashed lines."""


def _colour_variables(colours: Sequence[str]) -> str:
    return ";".join(f"--s{n}:{colour}" for n, colour in enumerate(colours))


CHART_STYLE = (
    f":root{{{_colour_variables(LIGHT_COLOURS)}}}\n"
    f"@media (prefers-color-scheme:dark){{:root{{{_colour_variables(DARK_COLOURS)}}}}}\n"
    """\
svg.chart{font:12px system-ui,sans-serif;color:inherit;width:100%;max-width:600px;height:auto;display:block}
.chart text{fill:currentColor}.chart .grid{stroke:currentColor;stroke-opacity:.15}
.chart .axis{stroke:currentColor;stroke-opacity:.5}.chart polyline{fill:none;stroke-width:2;stroke-linejoin:round}
.chart .dashed{stroke-dasharray:5 4}.chart .band{stroke:none;fill-opacity:.16}
""" + "".join(f".s{n}{{stroke:var(--s{n});fill:var(--s{n})}}" for n in range(CHART_COLOURS))
)
"""Style sheet (CSS) for all charts of a page."""

# Sizes and positions are in SVG user units; a browser shows a chart at most 600 px wide
CHART_WIDTH, CHART_HEIGHT = 480, 300
PLOT_LEFT, PLOT_RIGHT, PLOT_TOP, PLOT_BOTTOM = 52, 468, 10, 254
"""Edges of the plot; the labels of the axes are outside."""
BAR_HEIGHT = 26
"""Height of a bar, including the gap to the next bar."""
BAR_LABEL_WIDTH = 150
"""Width of the column of names to the left of the bars."""

Value = TypeVar("Value")


@dataclass(frozen=True)
class Series:
    """A line of a chart.

    Attributes
    ----------
    name : str
    x : sequence of float
    y : sequence of float or None
        None leaves a gap.
    interval : sequence of (low, high) or None, optional
        A band around the line; None leaves a gap.
    style : int
        Index of the line's colour, from 0.
    dashed : bool

    Examples
    --------
    >>> import kpbench
    >>> kpbench.report.Series("a", [1, 2, 3], [0.9, None, 0.7]).dashed
    False
    """

    name: str
    x: Sequence[float]
    y: Sequence[float | None]
    interval: Sequence[tuple[float, float] | None] | None = None
    style: int = 0
    dashed: bool = False


@dataclass(frozen=True)
class Panel:
    """Lines over one pair of axes.

    Attributes
    ----------
    series : tuple of Series
    x_label, y_label : str
        Labels of the axes, with their units.
    y_range : (low, high) or None
        None: from 0 to a little over the largest value.
    x_ticks : tuple of float
        Positions of the numbers on the x-axis.
    log_x : bool
        Whether the x-axis is logarithmic.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.report.Panel((kpbench.report.Series("a", [1, 2], [0.9, 0.7]),), "blur (px)", "score").log_x
    False
    """

    series: tuple[Series, ...]
    x_label: str
    y_label: str
    y_range: tuple[float, float] | None = None
    x_ticks: tuple[float, ...] = ()
    log_x: bool = False


def line_chart(
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    *,
    y_range: tuple[float, float] | None = None,
    x_ticks: Sequence[float] | None = None,
    log_x: bool = False,
    markers: bool = True,
) -> str:
    """Draw lines over one x-axis.

    Parameters
    ----------
    series : sequence of Series
    x_label, y_label : str
        Labels of the axes, with their units.
    y_range : (low, high), optional
        Default: from 0 to a little over the largest value.
    x_ticks : sequence of float, optional
        Positions of the numbers on the x-axis. The axis spans these positions and all points of the lines. Default:
        about five round numbers.
    log_x : bool
        Whether the x-axis is logarithmic. Then all x must be positive.
    markers : bool
        Whether each point is a dot with a tooltip that shows the numbers.

    Returns
    -------
    str
        An ``<svg>`` element.

    Examples
    --------
    >>> import kpbench
    >>> svg = kpbench.report.line_chart([kpbench.report.Series("a", [1, 2], [0.9, 0.7])], "blur (px)", "score")
    >>> svg.startswith("<svg"), svg.count("<polyline")
    (True, 1)
    """
    xs = [x for s in series for x in s.x] + list(x_ticks or ()) or [0.0]
    tops = [v for s in series for v in [*s.y, *(i[1] for i in s.interval or () if i)] if v is not None]
    low, high = y_range or (0.0, max(tops, default=1.0) * 1.05 or 1.0)
    left, right = min(xs), max(xs)

    def to_px(x: float) -> float:
        a, b, c = (math.log(v) for v in (left, x, right)) if log_x else (left, x, right)
        return PLOT_LEFT + (PLOT_RIGHT - PLOT_LEFT) * ((b - a) / (c - a) if c > a else 0.5)

    def to_py(y: float) -> float:
        return PLOT_BOTTOM - (PLOT_BOTTOM - PLOT_TOP) * (min(max(y, low), high) - low) / (high - low)

    parts = []
    for y in _round_numbers(low, high):
        height = to_py(y)
        parts.append(f'<line class="grid" x1="{PLOT_LEFT}" x2="{PLOT_RIGHT}" y1="{height:.1f}" y2="{height:.1f}"/>')
        parts.append(_text(PLOT_LEFT - 6, height + 4, f"{y:g}", "end"))
    for x in x_ticks if x_ticks is not None else _round_numbers(left, right):
        parts.append(_text(to_px(x), PLOT_BOTTOM + 18, f"{x:g}", "middle"))
    parts.append(f'<line class="axis" x1="{PLOT_LEFT}" x2="{PLOT_RIGHT}" y1="{PLOT_BOTTOM}" y2="{PLOT_BOTTOM}"/>')
    parts.append(_text((PLOT_LEFT + PLOT_RIGHT) / 2, CHART_HEIGHT - 8, x_label, "middle"))
    middle = (PLOT_TOP + PLOT_BOTTOM) / 2
    parts.append(
        f'<text text-anchor="middle" transform="translate(13 {middle:.1f}) rotate(-90)">{escape_markup(y_label)}</text>'
    )
    for s in series:
        parts += _draw_series(s, to_px, to_py, markers)
    return _svg(CHART_WIDTH, CHART_HEIGHT, f"{y_label} over {x_label}: {', '.join(s.name for s in series)}", parts)


def _draw_series(
    s: Series, to_px: Callable[[float], float], to_py: Callable[[float], float], markers: bool
) -> list[str]:
    colour = f"s{s.style % CHART_COLOURS}"
    dashed = " dashed" if s.dashed or s.style >= CHART_COLOURS else ""
    intervals = s.interval or [None] * len(s.x)
    name = f'data-series="{escape_markup(s.name)}"'
    parts = []
    for run in _split_at_gaps(zip(s.x, intervals, strict=True)):
        upper = [f"{to_px(x):.1f},{to_py(i[1]):.1f}" for x, i in run]
        lower = [f"{to_px(x):.1f},{to_py(i[0]):.1f}" for x, i in run[::-1]]
        parts.append(f'<polygon {name} class="band {colour}" points="{" ".join(upper + lower)}"/>')
    for line in _split_at_gaps(zip(s.x, s.y, strict=True)):
        points = " ".join(f"{to_px(x):.1f},{to_py(y):.1f}" for x, y in line)
        parts.append(f'<polyline {name} class="{colour}{dashed}" points="{points}"/>')
    for x, y, i in zip(s.x, s.y, intervals, strict=True) if markers else ():
        if y is not None:
            text = f"{s.name}: {y:.3f}" + (f" [{i[0]:.3f}, {i[1]:.3f}]" if i else "") + f" at {x:g}"
            dot = f'<circle {name} class="{colour}" cx="{to_px(x):.1f}" cy="{to_py(y):.1f}" r="3">'
            parts.append(f"{dot}<title>{escape_markup(text)}</title></circle>")
    return parts


def _split_at_gaps(points: Iterable[tuple[float, Value | None]]) -> list[list[tuple[float, Value]]]:
    """Return the runs of points between values of None."""
    runs: list[list[tuple[float, Value]]] = [[]]
    for x, value in points:
        if value is None:
            runs.append([])
        else:
            runs[-1].append((x, value))
    return [run for run in runs if run]


def bar_chart(rows: Sequence[tuple[str, Sequence[int]]], kinds: Sequence[str], styles: Sequence[int]) -> str:
    """Draw stacked bars, all of the same length.

    Each part has a tooltip with its kind, count and share.

    Parameters
    ----------
    rows : sequence of (name, counts)
        The name of a bar, and one count per kind. A row of zeros has no bar.
    kinds : sequence of str
        Names of the parts of a bar.
    styles : sequence of int
        Index of each part's colour, from 0.

    Returns
    -------
    str
        An ``<svg>`` element.

    Examples
    --------
    >>> import kpbench
    >>> svg = kpbench.report.bar_chart([("a", (3, 1)), ("b", (4, 0))], ("matched", "missed"), (0, 1))
    >>> svg.count("<rect")
    3
    """
    parts = []
    width = PLOT_RIGHT - BAR_LABEL_WIDTH
    for n, (name, counts) in enumerate(rows):
        y, x, total = n * BAR_HEIGHT, float(BAR_LABEL_WIDTH), sum(counts)
        parts.append(_text(BAR_LABEL_WIDTH - 8, y + 17, name if len(name) <= 20 else f"{name[:19]}…", "end"))
        for kind, count, style in zip(kinds, counts, styles, strict=True):
            part_width = width * count / total if total else 0.0
            text = f"{name}: {count} {kind} ({count / total:.1%})" if total else ""
            if count:
                size = f'width="{part_width:.1f}" height="{BAR_HEIGHT - 6}"'
                box = f'<rect class="s{style % CHART_COLOURS}" x="{x:.1f}" y="{y + 3}" {size}>'
                parts.append(f"{box}<title>{escape_markup(text)}</title></rect>")
            x += part_width
    return _svg(CHART_WIDTH, len(rows) * BAR_HEIGHT, f"Shares of {', '.join(kinds)}", parts)


def _svg(width: float, height: float, label: str, parts: Iterable[str]) -> str:
    box = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    return f'<svg class="chart" role="img" aria-label="{escape_markup(label)}" {box}>{"".join(parts)}</svg>'


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape_markup(text)}</text>'


def _round_numbers(low: float, high: float) -> list[float]:
    """Return about five round numbers from low to high."""
    if high <= low:
        return [low]
    raw = (high - low) / 5
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(unit * m for m in (1, 2, 5, 10) if unit * m >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [n * step for n in range(first, math.floor(high / step + 1e-9) + 1)]
