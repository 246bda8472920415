"""PNG in grey. Each pixel is darkened by the share of its area that ink covers. The file contains its resolution."""

from __future__ import annotations

import io
import math

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DesignError
from kpbench.geometry.outline import flatten
from kpbench.printing.font import png_font
from kpbench.printing.page import CUT, Page, Text

MAX_PIXELS = 1_000_000_000


def px_per_mm(dpi: float) -> float:
    """Return the pixels per mm of a PNG. PNG stores whole pixels per metre, so the value is rounded to 0.001.

    Examples
    --------
    >>> from kpbench.printing import px_per_mm
    >>> px_per_mm(dpi=300)
    11.811
    """
    return round(dpi / 0.0254) / 1000


def to_png(page: Page, dpi: float) -> bytes:
    """Return the page as 8-bit grey PNG.

    The page frame starts at the top-left corner of the first pixel. Pixel coordinates start at the centre of this
    pixel. A coordinate of x mm is therefore ``x * px_per_mm(dpi) - 0.5`` px.

    Parameters
    ----------
    page : Page
    dpi : float
        Pixels per inch.

    Raises
    ------
    DesignError
        If the image would have more than :data:`MAX_PIXELS` pixels.

    Examples
    --------
    >>> from kpbench.geometry import circle
    >>> from kpbench.printing import Page, Shape, to_png
    >>> page = Page(40.0, 40.0, (Shape(circle(20.0, 20.0, 15.0)),), (), "a disc")
    >>> to_png(page, dpi=300)[1:4]
    b'PNG'
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    from kpbench.geometry.coverage import bounding_box, rasterise

    scale = px_per_mm(dpi)
    width, height = round(page.width * scale), round(page.height * scale)
    if width * height > MAX_PIXELS:
        raise DesignError(
            f"{page.width:g} x {page.height:g} mm at {dpi:g} dpi is too large for a PNG; use a lower `dpi`"
        )
    paper = np.full((height, width), 255, np.uint8)

    def ink(x: int, y: int, covered: NDArray[np.float64]) -> None:
        """Darken the paper. If shapes share a pixel, their covered areas add up."""
        rows, columns = slice(max(y, 0), y + covered.shape[0]), slice(max(x, 0), x + covered.shape[1])
        below = paper[rows, columns]
        part = covered[rows.start - y :, columns.start - x :][: below.shape[0], : below.shape[1]]
        below[...] = np.maximum(below - np.rint(255 * part), 0)

    for shape in page.shapes:
        if shape.layer != CUT:
            polygons = [polygon * scale - 0.5 for polygon in flatten(shape.region, 1e-3 / scale)]
            box = bounding_box(polygons)
            ink(box[0], box[1], rasterise([polygons], [box])[0])
    for text in page.texts:
        letters, left, top = _letters(text, scale)
        ink(round(text.x * scale + left), round(text.y * scale + top), letters)
    out = io.BytesIO()
    mark = PngInfo()
    mark.add_text("Software", page.mark)
    Image.fromarray(paper).save(out, "PNG", dpi=(scale * 25.4, scale * 25.4), pnginfo=mark)
    return out.getvalue()


def _letters(text: Text, scale: float) -> tuple[NDArray[np.float64], float, float]:
    """Return an image of a text's ink coverage, and the image's top-left pixel (x, y) relative to the text's point."""
    from PIL import Image, ImageDraw

    font = png_font(text.size * scale)
    line = text.clean.encode("ascii", "replace").decode()  # Pillow's built-in font is used for ASCII only
    anchor = {"start": "ls", "middle": "ms", "end": "rs"}[text.anchor]
    left, top, right, bottom = ImageDraw.Draw(Image.new("L", (1, 1))).textbbox((0, 0), line, font, anchor)
    image = Image.new("L", (max(math.ceil(right - left), 1), max(math.ceil(bottom - top), 1)))
    ImageDraw.Draw(image).text((-left, -top), line, 255, font, anchor)
    covered = np.asarray(image) / 255.0
    return (covered[:, ::-1], -left - image.width, top) if text.mirrored else (covered, left, top)
