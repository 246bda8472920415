"""Page formats: the size of the paper, its margins, and whether labels and mirroring are wanted.

A page has four zones, from the edge inwards:

1. a margin of 5 mm that many printers leave blank,
2. a strip of 3 mm for text and rulers,
3. a strip of 3 mm for cut marks and registration crosses,
4. the area for ink.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

from kpbench.errors import DesignError
from kpbench.printing.page import Page, Shape, Text, mirror_page, round_to_nm

PAGE_SIZES_MM = {  # width and height; ISO 216 and ANSI Y14.1
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
}
BLANK, STRIP = 5.0, 3.0  # mm: widths of the zones in the module's docstring
PAGE_MARGIN = BLANK + 2 * STRIP  # mm: from the edge of the page to the area for ink
LONGEST_RULER = 100.0  # mm


@dataclass(frozen=True)
class PageFormat:
    """A page to print on.

    Attributes
    ----------
    width_mm, height_mm : float
        Size of the page.
    labels : bool
        Whether text is printed. Rulers and cut marks are always printed.
    mirrored : bool
        Whether left and right are swapped, for transfer film.
    inverted : bool
        Whether black and white are swapped within each patch, for processes that invert the print.

    Examples
    --------
    >>> from kpbench.printing import PageFormat
    >>> PageFormat(210.0, 297.0).ink_size_mm
    (188.0, 275.0)
    """

    width_mm: float
    height_mm: float
    labels: bool = True
    mirrored: bool = False
    inverted: bool = False

    @property
    def ink_size_mm(self) -> tuple[float, float]:
        """Width and height of the area for ink."""
        return self.width_mm - 2 * PAGE_MARGIN, self.height_mm - 2 * PAGE_MARGIN

    @property
    def rulers_mm(self) -> tuple[float, float]:
        """Lengths of the rulers in x and y: 100 mm, or on a small page the largest multiple of 10 mm that fits."""
        x, y = (min(LONGEST_RULER, 10.0 * math.floor(side / 10)) for side in self.ink_size_mm)
        return x, y

    def position_on_paper(self, x: float, y: float) -> tuple[float, float]:
        """Return where a point of the layout lies on the paper, in mm rounded to 1 nm. A mirrored page mirrors x."""
        return round_to_nm(self.width_mm - x if self.mirrored else x), round_to_nm(y)

    def make_page(self, shapes: Iterable[Shape], texts: Iterable[Text], title: str) -> Page:
        """Return the page with its shapes and labels, mirrored if the format asks for it."""
        page = Page(self.width_mm, self.height_mm, tuple(shapes), tuple(texts) if self.labels else (), title)
        return mirror_page(page) if self.mirrored else page


def parse_page_format(
    page: str, landscape: bool = False, labels: bool = True, mirrored: bool = False, inverted: bool = False
) -> PageFormat:
    """Return the page format for a name or a size.

    Parameters
    ----------
    page : str
        "a4", "a3", "a2", "letter", "legal", or width and height in mm such as "200x300mm".
    landscape : bool
        Whether to swap width and height.
    labels, mirrored, inverted : bool
        See :class:`PageFormat`.

    Raises
    ------
    DesignError
        If the name is unknown, or a side is shorter than 40 mm or longer than 5000 mm.

    Examples
    --------
    >>> from kpbench.printing import parse_page_format
    >>> parse_page_format("a4", landscape=True)
    PageFormat(width_mm=297.0, height_mm=210.0, labels=True, mirrored=False, inverted=False)
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)(?:mm)?", page.lower())
    if page.lower() not in PAGE_SIZES_MM and not match:
        raise DesignError(f"`page` is {page!r}, expected {', '.join(PAGE_SIZES_MM)} or WIDTHxHEIGHTmm")
    width, height = (float(match[1]), float(match[2])) if match else PAGE_SIZES_MM[page.lower()]
    if not (40 <= width <= 5000 and 40 <= height <= 5000):
        raise DesignError(f"`page` is {page!r}, {width:g} x {height:g} mm, expected 40 to 5000 mm a side")
    return PageFormat(*((height, width) if landscape else (width, height)), labels, mirrored, inverted)
