"""PDF with filled paths, an embedded font, and a request to the viewer not to scale."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

from kpbench.geometry.outline import Line, Region
from kpbench.printing.font import PDF_FONT
from kpbench.printing.page import CUT, Page, split_arcs, start_point
from kpbench.text import replace_unprinted

PT_PER_MM = 72 / 25.4
LONGEST_ARC_DEG = 22.5  # largest sweep of one Bézier curve; the curve deviates from the arc by less than 1e-7 radii


def to_pdf(pages: Sequence[Page]) -> bytes:
    """Return all pages as one PDF.

    An arc becomes cubic Bézier curves of at most :data:`LONGEST_ARC_DEG` degrees. The two inner control points of a
    curve lie on the tangents at its ends, ``4/3 tan(sweep / 4)`` radii away from the ends.

    Parameters
    ----------
    pages : sequence of Page

    Examples
    --------
    >>> from kpbench.geometry import circle
    >>> from kpbench.printing import Page, Shape, to_pdf
    >>> page = Page(40.0, 40.0, (Shape(circle(20.0, 20.0, 15.0)),), (), "a disc")
    >>> to_pdf([page]).startswith(b'%PDF')
    True
    """
    from reportlab.pdfbase import pdfmetrics
    from reportlab.pdfbase.ttfonts import TTFont
    from reportlab.pdfgen.canvas import FILL_NON_ZERO, Canvas

    font = TTFont(PDF_FONT, f"{PDF_FONT}.ttf")
    pdfmetrics.registerFont(font)
    out = io.BytesIO()
    canvas = Canvas(out, invariant=1, pageCompression=0, initialFontName=PDF_FONT, lang="en")
    canvas.setTitle(replace_unprinted(pages[0].title))
    canvas.setAuthor("kpbench")
    canvas.setCreator("kpbench")
    canvas.setKeywords(pages[0].mark)
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

    for contour in split_arcs(region, LONGEST_ARC_DEG):
        path.moveTo(*pt(*start_point(contour[0])))
        for part, after in zip(contour, contour[1:] + contour[:1], strict=True):
            if isinstance(part, Line):
                path.lineTo(*pt(*start_point(after)))
                continue
            (x0, y0), (x1, y1) = part.point(0.0), part.point(1.0)
            k = 4 / 3 * math.tan(math.radians(part.sweep_deg) / 4)
            first = (x0 - k * (y0 - part.y), y0 + k * (x0 - part.x))
            second = (x1 + k * (y1 - part.y), y1 - k * (x1 - part.x))
            path.curveTo(*pt(*first), *pt(*second), *pt(*start_point(after)))
        path.close()
    return path
