"""Rulers, lines of text, cut marks and registration crosses, in the page frame of a page that is not mirrored."""

from __future__ import annotations

from collections.abc import Iterable

from kpbench.geometry.outline import Line, Region, circle, rectangle
from kpbench.printing.font import FONT_SIZE, SMALLEST_FOOT, font_size
from kpbench.printing.page import CUT, MARKS, Shape, Text
from kpbench.printing.page_format import BLANK, PAGE_MARGIN, STRIP, PageFormat

LINE = 0.1  # mm: width of every mark
# mm: gap between a patch and a cut mark, and length of the mark. The gap between a board and a mark is TICK_GAP / 2.
TICK_GAP, TICK = 1.0, 2.0
CROSS_ARM = 2.5  # mm: length of each arm of a registration cross


def frame(page_format: PageFormat, title: str, foot: str) -> tuple[list[Shape], list[Text]]:
    """Return both rulers with their labels, the line of text at the top, and the foot at the bottom right."""
    (ruler_x, ruler_y), width, height = page_format.rulers_mm, page_format.width_mm, page_format.height_mm
    inner, below = BLANK + STRIP, height - BLANK - STRIP
    shapes = [
        Shape(_polygon((PAGE_MARGIN + u, below + v) for u, v in _ruler(ruler_x)), MARKS),
        Shape(_polygon((inner - v, height - PAGE_MARGIN - u) for u, v in _ruler(ruler_y)), MARKS),
    ]
    check = f"print at 100 %, check with a ruler: {ruler_x:g} mm"
    end, bottom = PAGE_MARGIN + ruler_x, height - BLANK - 0.6
    foot_size = font_size(foot, width - PAGE_MARGIN - end - 12)
    if foot_size < SMALLEST_FOOT:  # a small page has no room for the foot beside the ruler
        title, foot = f"{title}, {foot}", ""
    size = font_size(f"{title}    {check}", page_format.ink_size_mm[0])
    x, y = BLANK + STRIP / 2, height - PAGE_MARGIN - ruler_y
    texts = [
        Text(title, PAGE_MARGIN, BLANK + size, size),
        Text(check, width - PAGE_MARGIN, BLANK + size, size, "end"),
        Text(f"{ruler_x:g} mm", end + 1.5, bottom, FONT_SIZE),
        Text(foot, width - PAGE_MARGIN, bottom, foot_size, "end"),
        Text(f"{ruler_y:g}", x, y - 3.2, 1.7, "middle"),
        Text("mm", x, y - 1.2, 1.7, "middle"),
    ]
    return shapes, texts


def _ruler(length: float) -> list[tuple[float, float]]:
    """Return the outline of a ruler along +u with its ticks towards +v; the tick of n mm is centred on u = n."""
    half = LINE / 2
    points = [(length + half, 0.0), (-half, 0.0)]
    for n in range(round(length) + 1):
        tick = STRIP * (1.0 if n % 10 == 0 else 0.6 if n % 5 == 0 else 0.4)
        points += [(n - half, LINE), (n - half, tick), (n + half, tick), (n + half, LINE)]
    return points


def disc_marks(x: float, y: float, radius: float) -> list[Shape]:
    """Return the circular cut around a patch, and four cut marks outside the circle."""
    near, far, half = radius + TICK_GAP, radius + TICK_GAP + TICK, LINE / 2
    boxes = [(near, -half, TICK, LINE), (-far, -half, TICK, LINE), (-half, near, LINE, TICK), (-half, -far, LINE, TICK)]
    ticks = [Shape(rectangle(x + dx, y + dy, w, h), MARKS) for dx, dy, w, h in boxes]
    return [*ticks, Shape(circle(x, y, radius), CUT)]


def crop_mark(x: float, y: float, right: int, down: int) -> Region:
    """Return two cut marks that continue the edges of a board beyond its corner at (x, y).

    ``right`` is 1 if the horizontal mark leads to the right, and -1 if it leads to the left. ``down`` is 1 if the
    vertical mark leads down, and -1 if it leads up.
    """
    near, half = TICK_GAP / 2, LINE / 2
    along = rectangle(x + near if right > 0 else x - near - TICK, y - half, TICK, LINE)
    return along + rectangle(x - half, y + near if down > 0 else y - near - TICK, LINE, TICK)


def registration_cross() -> Region:
    """Return a registration cross about the origin, as one contour."""
    arm, half = CROSS_ARM, LINE / 2
    corners = [(half, -half), (arm, -half), (arm, half)]
    turns = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    return _polygon((c * x - s * y, s * x + c * y) for c, s in turns for x, y in corners)


def _polygon(points: Iterable[tuple[float, float]]) -> Region:
    corners = list(points)
    return (tuple(Line(*a, *b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)),)
