"""SVG in millimetres, with true arcs."""

from __future__ import annotations

from kpbench.geometry.outline import Line, Region
from kpbench.printing.font import SVG_FONTS
from kpbench.printing.page import INK, MARKS, Page, round_to_nm, split_arcs, start_point
from kpbench.text import escape_markup, replace_unprinted


def _mm(*values: float) -> str:
    """Return lengths in mm as text, rounded to 1 nm, without trailing zeros."""
    return " ".join(f"{round_to_nm(v):.6f}".rstrip("0").rstrip(".") for v in values)


def _svg_path(region: Region) -> str:
    """Return path data. Arcs are split into pieces of at most 90 degrees.

    SVG stores only the ends and the radius of an arc. On a longer arc, rounding the ends would move the centre.
    """
    data = []
    for contour in split_arcs(region, 90.0):
        data.append("M" + _mm(*start_point(contour[0])))
        for part, after in zip(contour, contour[1:] + contour[:1], strict=True):
            end = _mm(*start_point(after))
            if isinstance(part, Line):
                data.append(f"L{end}")
            else:
                data.append(f"A{_mm(part.radius, part.radius)} 0 0 {int(part.sweep_deg > 0)} {end}")
        data.append("Z")
    return "".join(data)


def to_svg(page: Page) -> bytes:
    """Return the page as SVG, in mm, with true arcs.

    Parameters
    ----------
    page : Page

    Examples
    --------
    >>> from kpbench.geometry import circle
    >>> from kpbench.printing import Page, Shape, to_svg
    >>> page = Page(40.0, 40.0, (Shape(circle(20.0, 20.0, 15.0)),), (), "a disc")
    >>> to_svg(page).startswith(b'<?xml')
    True
    """
    size = f'width="{_mm(page.width)}mm" height="{_mm(page.height)}mm" viewBox="0 0 {_mm(page.width, page.height)}"'
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f'<svg xmlns="http://www.w3.org/2000/svg" {size}>']
    lines.append(f"<!-- {page.mark} -->")
    lines.append(f"<title>{escape_markup(replace_unprinted(page.title))}</title>")
    for layer in (INK, MARKS):
        lines.append(f'<g id="{layer}" fill="#000" fill-rule="nonzero">')
        lines += [f'<path d="{_svg_path(s.region)}"/>' for s in page.shapes if s.layer == layer]
        lines.append("</g>")
    lines.append(f'<g id="TEXT" font-family="{SVG_FONTS}">')
    for t in page.texts:
        place = f'transform="matrix(-1 0 0 1 {_mm(t.x, t.y)})"' if t.mirrored else f'x="{_mm(t.x)}" y="{_mm(t.y)}"'
        lines.append(
            f'<text {place} font-size="{_mm(t.size)}" text-anchor="{t.anchor}">{escape_markup(t.clean)}</text>'
        )
    return "\n".join([*lines, "</g>", "</svg>", ""]).encode()
