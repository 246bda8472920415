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

import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DesignError
from kpbench.geometry.outline import Arc, Contour, Line, Region, flatten

INK, MARKS, CUT = "INK", "MARKS", "CUT"
LAYERS = (INK, MARKS, CUT)
SVG_FONTS = "Helvetica, Arial, sans-serif"
PDF_FONT = "Vera"  # comes with reportlab, may be embedded freely
PT_PER_MM = 72 / 25.4
MAX_PIXELS = 1_000_000_000


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


def px_per_mm(dpi: float) -> float:
    """Pixels per mm of a PNG: a PNG holds whole pixels per metre, and that is the scale it is drawn at."""
    return round(dpi / 0.0254) / 1000


def _start(part: Line | Arc) -> tuple[float, float]:
    return (part.x0, part.y0) if isinstance(part, Line) else part.point(0.0)


def _pieces(part: Line | Arc, max_deg: float) -> Iterable[Line | Arc]:
    """The segment itself, or its arc cut into equal arcs of at most ``max_deg``."""
    if isinstance(part, Line):
        return (part,)
    count = math.ceil(abs(part.sweep_deg) / max_deg - 1e-9)
    step = part.sweep_deg / count
    return (Arc(part.x, part.y, part.radius, part.start_deg + n * step, step) for n in range(count))


def _segments(region: Region, max_deg: float) -> list[list[Line | Arc]]:
    return [[piece for part in contour for piece in _pieces(part, max_deg)] for contour in region]


# --- SVG ---------------------------------------------------------------------------------------------


def _mm(*values: float) -> str:
    """Numbers to 1 nm, without trailing zeros."""
    return " ".join(f"{round(v, 6) + 0.0:.6f}".rstrip("0").rstrip(".") for v in values)


def _svg_path(region: Region) -> str:
    """Path data. Arcs are at most 90 degrees: in longer ones the rounding of the ends moves the centre."""
    data = []
    for contour in _segments(region, 90.0):
        data.append("M" + _mm(*_start(contour[0])))
        for part, after in zip(contour, contour[1:] + contour[:1], strict=True):
            end = _mm(*_start(after))
            if isinstance(part, Line):
                data.append(f"L{end}")
            else:
                data.append(f"A{_mm(part.radius, part.radius)} 0 0 {int(part.sweep_deg > 0)} {end}")
        data.append("Z")
    return "".join(data)


def svg(page: Page) -> bytes:
    """The page as SVG, in mm, with true arcs."""
    size = f'width="{_mm(page.width)}mm" height="{_mm(page.height)}mm" viewBox="0 0 {_mm(page.width, page.height)}"'
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f'<svg xmlns="http://www.w3.org/2000/svg" {size}>']
    lines.append(f"<title>{escape(Text(page.title, 0, 0, 0).clean)}</title>")
    for layer in (INK, MARKS):
        lines.append(f'<g id="{layer}" fill="#000" fill-rule="nonzero">')
        lines += [f'<path d="{_svg_path(s.region)}"/>' for s in page.shapes if s.layer == layer]
        lines.append("</g>")
    lines.append(f'<g id="TEXT" font-family="{SVG_FONTS}">')
    for t in page.texts:
        place = f'transform="matrix(-1 0 0 1 {_mm(t.x, t.y)})"' if t.mirrored else f'x="{_mm(t.x)}" y="{_mm(t.y)}"'
        lines.append(f'<text {place} font-size="{_mm(t.size)}" text-anchor="{t.anchor}">{escape(t.clean)}</text>')
    return "\n".join([*lines, "</g>", "</svg>", ""]).encode()


# --- PDF ---------------------------------------------------------------------------------------------


def pdf(pages: Sequence[Page]) -> bytes:
    """All pages as one PDF: filled paths only, text in an embedded font, and a request to the viewer not to scale.

    An arc becomes cubic Béziers of at most 22.5 degrees, with control points at ``4/3 tan(sweep/4)``
    radii along the tangents; the edge is then off by less than 1e-7 of the radius.
    """
    from reportlab.pdfbase import pdfmetrics
    from reportlab.pdfbase.ttfonts import TTFont
    from reportlab.pdfgen.canvas import FILL_NON_ZERO, Canvas

    font = TTFont(PDF_FONT, "Vera.ttf")
    pdfmetrics.registerFont(font)
    out = io.BytesIO()
    canvas = Canvas(out, invariant=1, pageCompression=0, initialFontName=PDF_FONT, lang="en")
    canvas.setTitle(pages[0].title)
    canvas.setAuthor("kpbench")
    canvas.setCreator("kpbench")
    canvas.setSubject("True to scale: print at 100 %")
    canvas.setViewerPreference("PrintScaling", "None")
    for page in pages:
        width, height = page.width * PT_PER_MM, page.height * PT_PER_MM
        canvas.setPageSize((width, height))
        canvas.setTrimBox((0, 0, width, height))
        for shape in page.shapes:
            if shape.layer != CUT:
                canvas.drawPath(
                    _pdf_path(canvas.beginPath(), shape.region, height), stroke=0, fill=1, fillMode=FILL_NON_ZERO
                )
        for text in page.texts:
            canvas.saveState()
            canvas.transform(-1 if text.mirrored else 1, 0, 0, 1, text.x * PT_PER_MM, height - text.y * PT_PER_MM)
            canvas.setFont(PDF_FONT, text.size * PT_PER_MM)
            draw = {"start": canvas.drawString, "middle": canvas.drawCentredString, "end": canvas.drawRightString}
            draw[text.anchor](0, 0, "".join(c if ord(c) in font.face.charToGlyph else "?" for c in text.clean))
            canvas.restoreState()
        canvas.showPage()
    canvas.save()
    return out.getvalue()


def _pdf_path(path: Any, region: Region, height_pt: float) -> Any:
    def pt(x: float, y: float) -> tuple[float, float]:
        return x * PT_PER_MM, height_pt - y * PT_PER_MM

    for contour in _segments(region, 22.5):
        path.moveTo(*pt(*_start(contour[0])))
        for part, after in zip(contour, contour[1:] + contour[:1], strict=True):
            if isinstance(part, Line):
                path.lineTo(*pt(*_start(after)))
                continue
            (x0, y0), (x1, y1) = part.point(0.0), part.point(1.0)
            k = 4 / 3 * math.tan(math.radians(part.sweep_deg) / 4)
            first = (x0 - k * (y0 - part.y), y0 + k * (x0 - part.x))
            second = (x1 + k * (y1 - part.y), y1 - k * (x1 - part.x))
            path.curveTo(*pt(*first), *pt(*second), *pt(*_start(after)))
        path.close()
    return path


# --- PNG ---------------------------------------------------------------------------------------------


def png(page: Page, dpi: float) -> bytes:
    """The page as 8-bit grey PNG, every pixel grey by the exact area that ink covers.

    The page's top-left corner is the corner of the first pixel, hence a point (x, y) in mm lies at
    ``x * px_per_mm(dpi) - 0.5`` px.

    Raises
    ------
    DesignError
        If the image would have more than :data:`MAX_PIXELS`.
    """
    from PIL import Image

    from kpbench.geometry.coverage import box_around, coverage

    scale = px_per_mm(dpi)
    width, height = round(page.width * scale), round(page.height * scale)
    if width * height > MAX_PIXELS:
        raise DesignError(
            f"{page.width:g} x {page.height:g} mm at {dpi:g} dpi is too large for a PNG; use a lower --dpi"
        )
    paper = np.full((height, width), 255, np.uint8)

    def ink(x: int, y: int, covered: NDArray[np.float64]) -> None:
        """Darken the paper; where two shapes share a pixel their areas add up."""
        rows, columns = slice(max(y, 0), y + covered.shape[0]), slice(max(x, 0), x + covered.shape[1])
        below = paper[rows, columns]
        part = covered[rows.start - y :, columns.start - x :][: below.shape[0], : below.shape[1]]
        below[...] = np.maximum(below - np.rint(255 * part), 0)

    for shape in page.shapes:
        if shape.layer != CUT:
            polygons = [polygon * scale - 0.5 for polygon in flatten(shape.region, 1e-3 / scale)]
            box = box_around(polygons)
            ink(box[0], box[1], coverage([polygons], [box])[0])
    for text in page.texts:
        letters, left, top = _letters(text, scale)
        ink(round(text.x * scale + left), round(text.y * scale + top), letters)
    out = io.BytesIO()
    Image.fromarray(paper).save(out, "PNG", dpi=(scale * 25.4, scale * 25.4))
    return out.getvalue()


def _letters(text: Text, scale: float) -> tuple[NDArray[np.float64], float, float]:
    """Coverage of a line of text, and where its first pixel lies relative to the baseline point, in px."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(max(text.size * scale, 1.0))
    line = text.clean.encode("ascii", "replace").decode()  # all that the built-in font knows
    anchor = {"start": "ls", "middle": "ms", "end": "rs"}[text.anchor]
    left, top, right, bottom = ImageDraw.Draw(Image.new("L", (1, 1))).textbbox((0, 0), line, font, anchor)
    image = Image.new("L", (max(math.ceil(right - left), 1), max(math.ceil(bottom - top), 1)))
    ImageDraw.Draw(image).text((-left, -top), line, 255, font, anchor)
    covered = np.asarray(image) / 255.0
    return (covered[:, ::-1], -left - image.width, top) if text.mirrored else (covered, left, top)


# --- DXF ---------------------------------------------------------------------------------------------


def dxf(page: Page) -> bytes:
    """The page as ASCII DXF of AutoCAD 2000, in mm, arcs exact as bulges of closed polylines.

    The frame is DXF's: **y up**, the origin is the page's bottom-left corner, so y is ``height - y`` of
    the page frame. Group codes and the tables that a reader insists on: Autodesk, *DXF Reference*.
    """
    handle = iter(range(0x100, 0x7FFFFFFF))
    body: list[tuple[int, Any]] = []
    for shape in page.shapes:
        for contour in shape.region:
            body += [(0, "LWPOLYLINE"), (5, f"{next(handle):X}"), (330, "1F"), (100, "AcDbEntity"), (8, shape.layer)]
            body += [(100, "AcDbPolyline"), *_dxf_vertices(contour, page.height)]
    for t in page.texts:
        side = {"start": 0, "middle": 1, "end": 2}[t.anchor]
        place = [(10, t.x), (20, page.height - t.y), (30, 0.0)]
        body += [(0, "TEXT"), (5, f"{next(handle):X}"), (330, "1F"), (100, "AcDbEntity"), (8, "TEXT")]
        body += [(100, "AcDbText"), *place, (40, 0.7 * t.size), (1, _dxf_text(t.clean)), (71, 2 * t.mirrored)]
        body += [(72, side), *((code + 1, v) for code, v in place if side), (100, "AcDbText")]
    tags = [*_dxf_head(page, next(handle)), (0, "SECTION"), (2, "ENTITIES"), *body, (0, "ENDSEC"), *DXF_END]
    return "".join(f"{code:3d}\n{_dxf_value(value)}\n" for code, value in tags).encode("cp1252")


def _dxf_value(value: Any) -> str:
    return f"{value:.9f}" if isinstance(value, float) else str(value)


def _dxf_text(text: str) -> str:
    """DXF escapes what is not in the code page, and reads ``%%`` as a control code."""
    units = "".join(c if c.isascii() else f"\\U+{ord(c):04X}" for c in text if ord(c) < 0x10000)
    return units.replace("%%", "% %")


def _dxf_vertices(contour: Contour, height: float) -> list[tuple[int, Any]]:
    """Vertices with bulge = tan(sweep / 4); y up makes a positive sweep run clockwise, which is negative."""
    parts = [piece for part in contour for piece in _pieces(part, 180.0)]
    tags: list[tuple[int, Any]] = [(90, len(parts)), (70, 1), (43, 0.0)]
    for part in parts:
        x, y = _start(part)
        tags += [(10, float(x)), (20, float(height - y))]
        if isinstance(part, Arc):
            tags.append((42, -math.tan(math.radians(part.sweep_deg) / 4)))
    return tags


def _dxf_table(name: str, handle: str, entries: Sequence[Sequence[tuple[int, Any]]]) -> list[tuple[int, Any]]:
    tags: list[tuple[int, Any]] = [(0, "TABLE"), (2, name), (5, handle), (330, 0), (100, "AcDbSymbolTable")]
    tags.append((70, len(entries)))
    if name == "DIMSTYLE":
        tags.append((100, "AcDbDimStyleTable"))
    return [*tags, *(tag for entry in entries for tag in entry), (0, "ENDTAB")]


def _dxf_head(page: Page, next_handle: int) -> list[tuple[int, Any]]:
    """Header, tables and blocks, up to the entities."""

    def record(kind: str, handle: str, owner: str, sub: str, name: str, *rest: tuple[int, Any]) -> list[Any]:
        table_record = (100, "AcDbSymbolTableRecord")
        return [(0, kind), (5, handle), (330, owner), table_record, (100, f"AcDb{sub}"), (2, name), *rest]

    layers = [(name, 7) for name in ("0", *LAYERS[:2], "TEXT")] + [(CUT, 1)]
    linetypes = [
        record(
            "LTYPE", f"{0x14 + n:X}", "5", "LinetypeTableRecord", name, (70, 0), (3, ""), (72, 65), (73, 0), (40, 0.0)
        )
        for n, name in enumerate(("ByBlock", "ByLayer", "Continuous"))
    ]
    style = [(70, 0), (40, 0.0), (41, 1.0), (50, 0.0), (71, 0), (42, 2.5), (3, "arial.ttf"), (4, "")]
    spaces = (("*Model_Space", "1F", "20", "21"), ("*Paper_Space", "1B", "1C", "1D"))
    layer_records = [
        record("LAYER", f"{0x30 + n:X}", "2", "LayerTableRecord", name, (70, 0), (62, colour), (6, "Continuous"))
        for n, (name, colour) in enumerate(layers)
    ]
    tags: list[tuple[int, Any]] = [
        *[(0, "SECTION"), (2, "HEADER"), (9, "$ACADVER"), (1, "AC1015"), (9, "$DWGCODEPAGE"), (3, "ANSI_1252")],
        *[(9, "$INSUNITS"), (70, 4), (9, "$MEASUREMENT"), (70, 1), (9, "$HANDSEED"), (5, f"{next_handle:X}")],
        *[(9, "$EXTMIN"), (10, 0.0), (20, 0.0), (30, 0.0)],
        *[(9, "$EXTMAX"), (10, float(page.width)), (20, float(page.height)), (30, 0.0)],
        *[(9, "$LIMMIN"), (10, 0.0), (20, 0.0), (9, "$LIMMAX"), (10, float(page.width)), (20, float(page.height))],
        *[(0, "ENDSEC"), (0, "SECTION"), (2, "CLASSES"), (0, "ENDSEC"), (0, "SECTION"), (2, "TABLES")],
        *_dxf_table("VPORT", "8", []),
        *_dxf_table("LTYPE", "5", linetypes),
        *_dxf_table("LAYER", "2", layer_records),
        *_dxf_table("STYLE", "3", [record("STYLE", "11", "3", "TextStyleTableRecord", "Standard", *style)]),
        *_dxf_table("VIEW", "6", []),
        *_dxf_table("UCS", "7", []),
        *_dxf_table("APPID", "9", [record("APPID", "12", "9", "RegAppTableRecord", "ACAD", (70, 0))]),
        *_dxf_table("DIMSTYLE", "A", []),
        *_dxf_table(
            "BLOCK_RECORD", "1", [record("BLOCK_RECORD", h, "1", "BlockTableRecord", name) for name, h, _, _ in spaces]
        ),
        *[(0, "ENDSEC"), (0, "SECTION"), (2, "BLOCKS")],
    ]
    for name, owner, begin, end in spaces:
        tags += [(0, "BLOCK"), (5, begin), (330, owner), (100, "AcDbEntity"), (8, "0"), (100, "AcDbBlockBegin")]
        tags += [(2, name), (70, 0), (10, 0.0), (20, 0.0), (30, 0.0), (3, name), (1, "")]
        tags += [(0, "ENDBLK"), (5, end), (330, owner), (100, "AcDbEntity"), (8, "0"), (100, "AcDbBlockEnd")]
    return [*tags, (0, "ENDSEC")]


DXF_END: list[tuple[int, Any]] = [
    *[(0, "SECTION"), (2, "OBJECTS"), (0, "DICTIONARY"), (5, "C"), (330, 0), (100, "AcDbDictionary"), (281, 1)],
    *[(3, "ACAD_GROUP"), (350, "D"), (0, "DICTIONARY"), (5, "D"), (330, "C"), (100, "AcDbDictionary"), (281, 1)],
    *[(0, "ENDSEC"), (0, "EOF")],
]

# ------------------------------------------------------------------------------------------------------

WRITERS: dict[str, Callable[[Sequence[Page], float], list[bytes]]] = {
    ".svg": lambda pages, dpi: [svg(page) for page in pages],
    ".png": lambda pages, dpi: [png(page, dpi) for page in pages],
    ".pdf": lambda pages, dpi: [pdf(pages)],
    ".dxf": lambda pages, dpi: [dxf(page) for page in pages],
}
"""Suffix to (pages, dpi) -> the contents of the files: one for PDF, one a page for the others."""
