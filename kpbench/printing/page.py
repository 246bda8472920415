"""Pages of exact outlines in mm, which the writers turn into SVG, PDF, PNG or DXF.

Page frame: mm, x right, y down. The origin is the top-left corner of the page. A shape is an outline of straight lines
and circular arcs, filled black. Shapes are never stroked: a stroke would make them larger.

Layers
------
``INK`` and ``MARKS`` are printed. ``CUT`` is the path of a knife or laser. Only DXF contains the layer ``CUT``: a
printed line along the cut would stay visible on the part that is cut out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from kpbench.geometry.outline import Arc, Line, Region
from kpbench.text import replace_unprinted

INK, MARKS, CUT = "INK", "MARKS", "CUT"
LAYERS = (INK, MARKS, CUT)


@dataclass(frozen=True)
class Shape:
    """A filled region of a page.

    Attributes
    ----------
    region : tuple of contours
        Outline in mm of the page frame, such as :func:`kpbench.geometry.circle`.
    layer : str
        "INK", "MARKS" or "CUT".

    Examples
    --------
    >>> from kpbench.geometry import circle
    >>> from kpbench.printing import Shape
    >>> Shape(circle(20.0, 20.0, 15.0)).layer
    'INK'
    """

    region: Region
    layer: str = INK


@dataclass(frozen=True)
class Text:
    """A line of text.

    Attributes
    ----------
    text : str
    x, y : float
        Point on the baseline, mm.
    size : float
        Font size, mm.
    anchor : str
        Part of the text that lies at the point: "start", "middle" or "end".
    mirrored : bool
        Whether the letters are mirrored.

    Examples
    --------
    >>> from kpbench.printing import Text
    >>> Text("print at 100 %", x=10.0, y=10.0, size=2.2).clean
    'print at 100 %'
    """

    text: str
    x: float
    y: float
    size: float
    anchor: str = "start"
    mirrored: bool = False

    @property
    def clean(self) -> str:
        """The text with a question mark in place of each character that is not printable."""
        return replace_unprinted(self.text)


@dataclass(frozen=True)
class Page:
    """A page with its shapes and texts.

    Attributes
    ----------
    width, height : float
        Size, mm.
    shapes : tuple of Shape
    texts : tuple of Text
    title : str
    mark : str
        Mark in every file of the page. :func:`kpbench.writing.write_file` replaces only files with the same mark.

    Examples
    --------
    >>> from kpbench.geometry import circle
    >>> from kpbench.printing import Page, Shape
    >>> page = Page(40.0, 40.0, (Shape(circle(20.0, 20.0, 15.0)),), (), "a disc")
    >>> len(page.shapes)
    1
    """

    width: float
    height: float
    shapes: tuple[Shape, ...]
    texts: tuple[Text, ...]
    title: str
    mark: str = "kpbench.print/1"


def round_to_nm(value: float) -> float:
    """Return a length in mm rounded to 1 nm, which keeps rounding errors out of files."""
    return round(value, 6) + 0.0


def mirror_page(page: Page) -> Page:
    """Return the page with left and right swapped, for transfer film."""
    width = page.width

    def flip(part: Line | Arc) -> Line | Arc:
        if isinstance(part, Line):
            return Line(width - part.x0, part.y0, width - part.x1, part.y1)
        return Arc(width - part.x, part.y, part.radius, 180.0 - part.start_deg, -part.sweep_deg)

    shapes = tuple(Shape(tuple(tuple(map(flip, c)) for c in s.region), s.layer) for s in page.shapes)
    texts = tuple(Text(t.text, width - t.x, t.y, t.size, t.anchor, not t.mirrored) for t in page.texts)
    return replace(page, shapes=shapes, texts=texts)


def start_point(part: Line | Arc) -> tuple[float, float]:
    """Return the first point of a segment."""
    return (part.x0, part.y0) if isinstance(part, Line) else part.point(0.0)


def split_arc(part: Line | Arc, max_deg: float) -> Iterable[Line | Arc]:
    """Split an arc into equal arcs of at most ``max_deg`` degrees. Return a line unchanged."""
    if isinstance(part, Line):
        return (part,)
    count = math.ceil(abs(part.sweep_deg) / max_deg - 1e-9)
    step = part.sweep_deg / count
    return (Arc(part.x, part.y, part.radius, part.start_deg + n * step, step) for n in range(count))


def split_arcs(region: Region, max_deg: float) -> list[list[Line | Arc]]:
    """Return the contours of a region with each arc split into equal arcs of at most ``max_deg`` degrees."""
    return [[piece for part in contour for piece in split_arc(part, max_deg)] for contour in region]
