"""Readers of what kpbench draws, which share no code with it: pages in, exact areas and centroids out.

A segment is given as its points and derivatives at Gauss-Legendre nodes, so that areas and moments are
line integrals (Green) without flattening. Everything is in mm of the page, y down.
"""

import math
import re
import xml.etree.ElementTree as ET
from io import BytesIO

import ezdxf
import numpy as np
import pikepdf

NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)
NODES, WEIGHTS = (NODES + 1) / 2, WEIGHTS / 2
SVG = "{http://www.w3.org/2000/svg}"


def line(a, b):
    a, b = np.array(a), np.array(b)
    return a + NODES[:, None] * (b - a), np.tile(b - a, (len(NODES), 1))


def bezier(a, b, c, d):
    a, b, c, d = map(np.array, (a, b, c, d))
    t = NODES[:, None]
    points = (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d
    return points, 3 * ((1 - t) ** 2 * (b - a) + 2 * (1 - t) * t * (c - b) + t**2 * (d - c))


def arc(centre, radius, start, sweep):
    """Angles in radians from +x towards +y."""
    angle = start + NODES * sweep
    spoke = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.array(centre) + spoke, sweep * np.column_stack([-spoke[:, 1], spoke[:, 0]])


def moments(segments):
    """Area (positive) and centroid of a closed outline of one or more contours."""
    points, slopes = (np.array(part) for part in zip(*segments, strict=True))
    x, y = np.moveaxis(points, -1, 0)
    dx, dy = np.moveaxis(slopes, -1, 0)
    area = np.sum(WEIGHTS * (x * dy - y * dx)) / 2
    mean = np.array([np.sum(WEIGHTS * x * x * dy), -np.sum(WEIGHTS * y * y * dx)]) / (2 * area)
    return abs(area), mean


# --- SVG ---


def svg_shapes(content, layer="INK"):
    """(shapes, page size in mm); checks that the unit is the millimetre."""
    root = ET.fromstring(content)
    width, height = (float(root.get(k).removesuffix("mm")) for k in ("width", "height"))
    assert [float(v) for v in root.get("viewBox").split()] == [0, 0, width, height]
    assert b"stroke" not in content
    group = next(g for g in root.iter(f"{SVG}g") if g.get("id") == layer)
    return [svg_path(p.get("d")) for p in group.iter(f"{SVG}path")], (width, height)


def svg_path(data):
    segments, at, start = [], None, None
    for command, numbers in re.findall(r"([MLAZ])([^MLAZ]*)", data):
        values = [float(v) for v in numbers.split()]
        if command == "M":
            at = start = values
        elif command == "L":
            segments.append(line(at, values))
            at = values
        elif command == "A":
            segments.append(svg_arc(at, *values))
            at = values[5:]
        else:
            assert np.hypot(at[0] - start[0], at[1] - start[1]) <= 1e-6, "Z draws no line of its own"
    return segments


def svg_arc(start, rx, ry, turn, large, sweep, x, y):
    """Endpoint to centre parametrisation (SVG 1.1, F.6.5)."""
    assert rx == ry
    assert turn == 0
    assert not large, "arcs of at most 90 degrees are well conditioned"
    half = (np.array(start) - (x, y)) / 2
    away = math.sqrt(max(rx * rx / (half @ half) - 1, 0.0)) * (1 if large != sweep else -1)
    centre = away * np.array([half[1], -half[0]]) + (np.array(start) + np.array([x, y])) / 2
    first = math.atan2(start[1] - centre[1], start[0] - centre[0])
    turned = (math.atan2(y - centre[1], x - centre[0]) - first) % (2 * math.pi)
    return arc(centre, rx, first, turned if sweep else turned - 2 * math.pi)


# --- PDF ---


def pdf_shapes(content):
    """One list of shapes a page, and page sizes in mm; raises on anything but filled paths and text."""
    document = pikepdf.open(BytesIO(content))
    pages, sizes = [], []
    for page in document.pages:
        box = [float(v) for v in page.MediaBox]
        assert box == [float(v) for v in page.TrimBox]
        sizes.append((box[2] * 25.4 / 72, box[3] * 25.4 / 72))
        pages.append(pdf_page(pikepdf.parse_content_stream(page), box[3]))
    return pages, sizes


def pdf_page(instructions, height):
    shapes, segments, at, in_text = [], [], None, False
    depth, moved = 0, False
    for operands, operator in instructions:
        name, values = str(operator), [float(v) for v in operands if not isinstance(v, (pikepdf.Name, pikepdf.String))]

        def mm(values=values):
            return [((x * 25.4 / 72), (height - y) * 25.4 / 72) for x, y in zip(values[::2], values[1::2], strict=True)]

        if name in ("q", "Q"):
            depth += 1 if name == "q" else -1
            moved = moved and depth > 0
        elif name == "cm":
            moved = moved or values != [1, 0, 0, 1, 0, 0]
        elif name in ("BT", "ET"):
            in_text = name == "BT"
        elif name in ("m", "l", "c", "h", "f"):
            assert not moved, "paths are in the page's own frame"
            if name == "m":
                at = mm()[0]
            elif name == "l":
                segments.append(line(at, mm()[0]))
                at = mm()[0]
            elif name == "c":
                segments.append(bezier(at, *mm()))
                at = mm()[-1]
            elif name == "f":
                shapes.append(segments)
                segments = []
        elif name == "n":
            segments = []
        else:
            assert in_text or name in ("w", "J", "j", "rg", "RG", "g", "G", "Tf", "Tm", "TL", "T*"), name
    return shapes


# --- DXF ---


def dxf_shapes(content, path, layer="INK"):
    """One list of contours' segments a polyline (contours of one shape are not joined)."""
    path.write_bytes(content)
    drawing = ezdxf.readfile(path)
    assert not drawing.audit().errors
    assert not drawing.audit().fixes
    assert drawing.header["$INSUNITS"] == 4
    height = drawing.header["$EXTMAX"][1]
    contours = []
    for polyline in drawing.modelspace().query(f'LWPOLYLINE[layer=="{layer}"]'):
        assert polyline.closed
        vertices = [(x, height - y, bulge) for x, y, bulge in polyline.get_points("xyb")]
        segments = []
        for (x0, y0, bulge), (x1, y1, _) in zip(vertices, vertices[1:] + vertices[:1], strict=True):
            segments.append(line((x0, y0), (x1, y1)) if not bulge else bulge_arc((x0, y0), (x1, y1), -bulge))
        contours.append(segments)
    return contours, drawing


def bulge_arc(a, b, bulge):
    """Bulge is tan(sweep / 4), here in the y-down frame."""
    a, b = np.array(a), np.array(b)
    sweep = 4 * math.atan(bulge)
    normal = np.array([-(b - a)[1], (b - a)[0]])
    centre = (a + b) / 2 + normal / (2 * math.tan(sweep / 2))
    return arc(centre, np.hypot(*(a - centre)), math.atan2(*(a - centre)[::-1]), sweep)


# --- pixels ---


def dark_centroid(grey, x, y, reach):
    """Centroid in px of the ink within a square about (x, y)."""
    left, top, right, bottom = (round(v) for v in (x - reach, y - reach, x + reach + 1, y + reach + 1))
    ink = 255.0 - grey[top:bottom, left:right]
    rows, columns = np.mgrid[top:bottom, left:right]
    return np.array([np.sum(ink * columns), np.sum(ink * rows)]) / ink.sum()


# --- what is expected ---


def ink_centroid(patch):
    """Area and centroid of a design's black ink on the unit disc, from its polar cells."""
    radii, angles, black = patch.cells
    area, moment = 0.0, np.zeros(2)
    for i, j in np.argwhere(black):
        r0, r1 = radii[i], radii[i + 1]
        a0, a1 = np.radians([angles[j], angles[j + 1] if j + 1 < len(angles) else angles[0] + 360])
        area += (r1**2 - r0**2) / 2 * (a1 - a0)
        moment += (r1**3 - r0**3) / 3 * np.array([np.sin(a1) - np.sin(a0), np.cos(a0) - np.cos(a1)])
    return area, moment / area


def ink_centroid_on_page(patch, keypoint, mirrored=False):
    """Where the sidecar's keypoint puts the centroid of the ink, mm of the page."""
    turn = np.radians(keypoint["rotate_deg"])
    c, s = np.cos(turn), np.sin(turn)
    u, v = keypoint["diameter_mm"] / 2 * np.array([[c, -s], [s, c]]) @ ink_centroid(patch)[1]
    return np.array([keypoint["page_x_mm"] + (-u if mirrored else u), keypoint["page_y_mm"] + v])
