"""Small SVG charts: lines with intervals, and stacked bars. They inherit the page's text colour.

A page with charts needs the style sheet :data:`STYLE` once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TypeVar

COLOURS = 9  # classes s0 … s8; more series start again, dashed
# Readable on white and on near-black and apart to colour-blind eyes; after Okabe and Ito 2008
STYLE = """\
:root{--s0:#0067a8;--s1:#c2410c;--s2:#00795a;--s3:#8d5fc4;--s4:#a16207;--s5:#be185d;--s6:#3f7f93;--s7:#5b6470;--s8:#6f4518}
@media (prefers-color-scheme:dark){:root{--s0:#5cb3ec;--s1:#f59361;--s2:#3fc79a;--s3:#c3a2f0;--s4:#e0b13c;--s5:#f283b3;\
--s6:#8ccbdd;--s7:#aab3bf;--s8:#cf9f6e}}
svg.chart{font:12px system-ui,sans-serif;color:inherit;width:100%;max-width:600px;height:auto;display:block}
.chart text{fill:currentColor}.chart .grid{stroke:currentColor;stroke-opacity:.15}
.chart .axis{stroke:currentColor;stroke-opacity:.5}.chart polyline{fill:none;stroke-width:2;stroke-linejoin:round}
.chart .dashed{stroke-dasharray:5 4}.chart .band{stroke:none;fill-opacity:.16}
""" + "".join(f".s{n}{{stroke:var(--s{n});fill:var(--s{n})}}" for n in range(COLOURS))

WIDTH, HEIGHT = 480, 300
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 10, 46  # margins of the plot
ROW = 26  # of a bar
LABEL = 150  # width of the bars' names

Value = TypeVar("Value")


@dataclass(frozen=True)
class Series:
    """A line: points (x, y), where a y of None leaves a gap, and optionally (low, high) around each.

    ``style`` is the number of a colour; equal numbers in charts of a page mean equal things.
    """

    name: str
    x: Sequence[float]
    y: Sequence[float | None]
    interval: Sequence[tuple[float, float] | None] | None = None
    style: int = 0
    dashed: bool = False


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
    """An SVG of lines over one x-axis.

    Parameters
    ----------
    series : sequence of Series
    x_label, y_label : with their units.
    y_range : None for 0 to the largest value.
    x_ticks : where to write numbers, all of which the axis then holds; None for round ones.
    log_x : a logarithmic x-axis; all x must be over 0.
    markers : a dot at every point, with its numbers as a tooltip.
    """
    xs = [x for s in series for x in s.x] + list(x_ticks or ()) or [0.0]
    tops = [v for s in series for v in [*s.y, *(i[1] for i in s.interval or () if i)] if v is not None]
    low, high = y_range or (0.0, max(tops, default=1.0) * 1.05 or 1.0)
    left, right = min(xs), max(xs)

    def px(x: float) -> float:
        a, b, c = (math.log(v) for v in (left, x, right)) if log_x else (left, x, right)
        return LEFT + (WIDTH - LEFT - RIGHT) * ((b - a) / (c - a) if c > a else 0.5)

    def py(y: float) -> float:
        return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (min(max(y, low), high) - low) / (high - low)

    parts = []
    for y in _ticks(low, high):
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{py(y):.1f}" y2="{py(y):.1f}"/>')
        parts.append(_text(LEFT - 6, py(y) + 4, f"{y:g}", "end"))
    for x in x_ticks if x_ticks is not None else _ticks(left, right):
        parts.append(_text(px(x), HEIGHT - BOTTOM + 18, f"{x:g}", "middle"))
    parts.append(f'<line class="axis" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{HEIGHT - BOTTOM}" y2="{HEIGHT - BOTTOM}"/>')
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, x_label, "middle"))
    middle = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(
        f'<text text-anchor="middle" transform="translate(13 {middle:.1f}) rotate(-90)">{escape(y_label)}</text>'
    )
    for s in series:
        parts += _line(s, px, py, markers)
    names = ", ".join(s.name for s in series)
    return _svg(WIDTH, HEIGHT, f"{y_label} over {x_label}: {names}", parts)


def _line(s: Series, px: Callable[[float], float], py: Callable[[float], float], markers: bool) -> list[str]:
    colour = f"s{s.style % COLOURS}"
    dashed = " dashed" if s.dashed or s.style >= COLOURS else ""
    spread = s.interval or [None] * len(s.x)
    parts = []
    for run in _runs(zip(s.x, spread, strict=True)):
        around = [f"{px(x):.1f},{py(i[1]):.1f}" for x, i in run] + [f"{px(x):.1f},{py(i[0]):.1f}" for x, i in run[::-1]]
        parts.append(f'<polygon class="band {colour}" points="{" ".join(around)}"/>')
    for line in _runs(zip(s.x, s.y, strict=True)):
        points = " ".join(f"{px(x):.1f},{py(y):.1f}" for x, y in line)
        parts.append(f'<polyline class="{colour}{dashed}" points="{points}"/>')
    for x, y, i in zip(s.x, s.y, spread, strict=True) if markers else ():
        if y is not None:
            text = f"{s.name}: {y:.3f}" + (f" [{i[0]:.3f}, {i[1]:.3f}]" if i else "") + f" at {x:g}"
            dot = f'<circle class="{colour}" cx="{px(x):.1f}" cy="{py(y):.1f}" r="3">'
            parts.append(f"{dot}<title>{escape(text)}</title></circle>")
    return parts


def _runs(points: Iterable[tuple[float, Value | None]]) -> list[list[tuple[float, Value]]]:
    """Points between gaps."""
    runs: list[list[tuple[float, Value]]] = [[]]
    for x, value in points:
        if value is None:
            runs.append([])
        else:
            runs[-1].append((x, value))
    return [run for run in runs if run]


def bar_chart(rows: Sequence[tuple[str, Sequence[int]]], kinds: Sequence[str], styles: Sequence[int]) -> str:
    """An SVG of stacked bars, each filling the width: a row is its name and a count a kind.

    Each part tells its kind, count and share as a tooltip; a row of zeros stays empty.
    """
    parts = []
    width = WIDTH - LABEL - RIGHT
    for n, (name, counts) in enumerate(rows):
        y, x, total = n * ROW, float(LABEL), sum(counts)
        parts.append(_text(LABEL - 8, y + 17, name if len(name) <= 20 else f"{name[:19]}…", "end"))
        for kind, count, style in zip(kinds, counts, styles, strict=True):
            wide = width * count / total if total else 0.0
            text = f"{name}: {count} {kind} ({count / total:.1%})" if total else ""
            if count:
                box = f'<rect class="s{style % COLOURS}" x="{x:.1f}" y="{y + 3}" width="{wide:.1f}" height="{ROW - 6}">'
                parts.append(f"{box}<title>{escape(text)}</title></rect>")
            x += wide
    return _svg(WIDTH, len(rows) * ROW, f"Shares of {', '.join(kinds)}", parts)


def _svg(width: float, height: float, label: str, parts: Iterable[str]) -> str:
    box = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    return f'<svg class="chart" role="img" aria-label="{escape(label)}" {box}>{"".join(parts)}</svg>'


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _ticks(low: float, high: float) -> list[float]:
    """About five round numbers from low to high."""
    if high <= low:
        return [low]
    raw = (high - low) / 5
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(unit * m for m in (1, 2, 5, 10) if unit * m >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [n * step for n in range(first, math.floor(high / step + 1e-9) + 1)]
