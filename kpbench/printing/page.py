"""Pages of exact outlines in mm, written as SVG, PDF, PNG or DXF.

Page frame: mm, x right, y down, the origin is the page's top-left corner. Every shape is an outline of
straight lines and circular arcs that is filled black and never stroked, so no format makes an edge
fatter. What the shapes mean is the caller's business.

Layers
------
``INK`` and ``MARKS`` are printed. ``CUT`` is where a knife or laser should go: it is drawn in DXF only,
since a printed line would touch what it cuts out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from kpbench.geometry.outline import Arc, Line, Region

INK, MARKS, CUT = "INK", "MARKS", "CUT"
LAYERS = (INK, MARKS, CUT)


@dataclass(frozen=True)
class Shape:
    """A filled region of the page frame, in mm, on one of the :data:`LAYERS`."""

    region: Region
    layer: str = INK


@dataclass(frozen=True)
class Text:
    """One line of text: baseline point and font size in mm; ``anchor`` is start, middle or end."""

    text: str
    x: float
    y: float
    size: float
    anchor: str = "start"
    mirrored: bool = False

    @property
    def clean(self) -> str:
        """The text without control characters, which no format can hold."""
        return "".join(c if c.isprintable() else "?" for c in self.text)


@dataclass(frozen=True)
class Page:
    """One page, sizes in mm."""

    width: float
    height: float
    shapes: tuple[Shape, ...]
    texts: tuple[Text, ...]
    title: str


def mirror(page: Page) -> Page:
    """The page as a mirror shows it, left and right swapped, for transfer film."""
    width = page.width

    def flipped(part: Line | Arc) -> Line | Arc:
        if isinstance(part, Line):
            return Line(width - part.x0, part.y0, width - part.x1, part.y1)
        return Arc(width - part.x, part.y, part.radius, 180.0 - part.start_deg, -part.sweep_deg)

    shapes = tuple(Shape(tuple(tuple(map(flipped, c)) for c in s.region), s.layer) for s in page.shapes)
    texts = tuple(Text(t.text, width - t.x, t.y, t.size, t.anchor, not t.mirrored) for t in page.texts)
    return Page(width, page.height, shapes, texts, page.title)


def start_point(part: Line | Arc) -> tuple[float, float]:
    """Return where a segment begins, in mm."""
    return (part.x0, part.y0) if isinstance(part, Line) else part.point(0.0)


def split_arc(part: Line | Arc, max_deg: float) -> Iterable[Line | Arc]:
    """The segment itself, or its arc cut into equal arcs of at most ``max_deg``."""
    if isinstance(part, Line):
        return (part,)
    count = math.ceil(abs(part.sweep_deg) / max_deg - 1e-9)
    step = part.sweep_deg / count
    return (Arc(part.x, part.y, part.radius, part.start_deg + n * step, step) for n in range(count))


def split_arcs(region: Region, max_deg: float) -> list[list[Line | Arc]]:
    """Return the contours of a region with each arc cut into equal arcs of at most ``max_deg``."""
    return [[piece for part in contour for piece in split_arc(part, max_deg)] for contour in region]
