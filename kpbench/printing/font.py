"""The fonts of the text on a print: one family per file format, and the size for all formats."""

from __future__ import annotations

from typing import Any

SVG_FONTS = "Helvetica, Arial, sans-serif"
"""CSS font families of an SVG. The viewer takes the first that is installed."""
PDF_FONT = "Vera"
"""Name and file name of the font that a PDF embeds. It ships with reportlab; its licence permits embedding."""
FONT_SIZE = 2.2
"""mm: largest font size."""
SMALLEST_FOOT = 1.2
"""mm: smallest font size of the foot of a page. A longer foot joins the line on top."""
CHARACTER_WIDTH = 0.6
"""Width of a character, in font sizes. No font in use is wider on average for digits and lower case."""


def font_size(text: str, width: float) -> float:
    """Return the font size in mm, at most :data:`FONT_SIZE`, at which a text is no wider than ``width`` mm."""
    return max(min(FONT_SIZE, width / (CHARACTER_WIDTH * len(text))), 0.5)


def png_font(size: float) -> Any:
    """Return Pillow's built-in font, which holds only ASCII, in a size in pixels."""
    from PIL import ImageFont

    return ImageFont.load_default(max(size, 1.0))
