"""PNG: every pixel grey by the exact area that ink covers, with its resolution inside."""

from __future__ import annotations

import io
import math

import numpy as np
from numpy.typing import NDArray

from kpbench.errors import DesignError
from kpbench.geometry.outline import flatten
from kpbench.printing.page import CUT, Page, Text

MAX_PIXELS = 1_000_000_000


def px_per_mm(dpi: float) -> float:
    """Pixels per mm of a PNG: a PNG holds whole pixels per metre, and that is the scale it is drawn at."""
    return round(dpi / 0.0254) / 1000


def to_png(page: Page, dpi: float) -> bytes:
    """The page as 8-bit grey PNG, every pixel grey by the exact area that ink covers.

    The page's top-left corner is the corner of the first pixel, hence a point (x, y) in mm lies at
    ``x * px_per_mm(dpi) - 0.5`` px.

    Raises
    ------
    DesignError
        If the image would have more than :data:`MAX_PIXELS`.
    """
    from PIL import Image

    from kpbench.geometry.coverage import bounding_box, rasterise

    scale = px_per_mm(dpi)
    width, height = round(page.width * scale), round(page.height * scale)
    if width * height > MAX_PIXELS:
        raise DesignError(
            f"{page.width:g} x {page.height:g} mm at {dpi:g} dpi is too large for a PNG; use a lower `dpi`"
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
            box = bounding_box(polygons)
            ink(box[0], box[1], rasterise([polygons], [box])[0])
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
