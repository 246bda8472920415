"""ASCII DXF of AutoCAD 2000 for laser cutters and plotters, with exact arcs.

The group codes and the required tables follow Autodesk's *DXF Reference*. A tag is a pair (group code, value). In the
frame of DXF, **y points up**, and the origin is the bottom-left corner of the page.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from kpbench.geometry.outline import Arc, Contour
from kpbench.printing.page import CUT, LAYERS, Page, split_arc, start_point
from kpbench.text import escape_dxf


def to_dxf(page: Page) -> bytes:
    """Return the page as DXF in mm. Contours are closed polylines. Arcs are stored exactly, as bulges of vertices.

    Parameters
    ----------
    page : Page

    Examples
    --------
    >>> from kpbench.geometry import circle
    >>> from kpbench.printing import Page, Shape, to_dxf
    >>> page = Page(40.0, 40.0, (Shape(circle(20.0, 20.0, 15.0)),), (), "a disc")
    >>> to_dxf(page).count(b'LWPOLYLINE')
    1
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
        body += [(100, "AcDbText"), *place, (40, 0.7 * t.size), (1, escape_dxf(t.clean)), (71, 2 * t.mirrored)]
        body += [(72, side), *((code + 1, v) for code, v in place if side), (100, "AcDbText")]
    tags = [
        (999, page.mark),
        *_dxf_head(page, next(handle)),
        (0, "SECTION"),
        (2, "ENTITIES"),
        *body,
        (0, "ENDSEC"),
        *DXF_END,
    ]
    return "".join(f"{code:3d}\n{_dxf_value(value)}\n" for code, value in tags).encode("cp1252")


def _dxf_value(value: Any) -> str:
    return f"{value:.9f}" if isinstance(value, float) else str(value)


def _dxf_vertices(contour: Contour, height: float) -> list[tuple[int, Any]]:
    """Return the vertices of a contour. The bulge of an arc is ``-tan(sweep / 4)``.

    The sign is negative because y points up in DXF and down in the page frame.
    """
    parts = [piece for part in contour for piece in split_arc(part, 180.0)]
    tags: list[tuple[int, Any]] = [(90, len(parts)), (70, 1), (43, 0.0)]
    for part in parts:
        x, y = start_point(part)
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
    """Return the sections before the entities: header, classes, tables, blocks."""

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
