"""Fonts of the text on a print: the fonts differ between file formats, the font sizes do not."""

from __future__ import annotations

from typing import Any

SVG_FONTS = "Helvetica, Arial, sans-serif"
"""CSS font families of an SVG. The viewer takes the first family that is installed."""
PDF_FONT = "Vera"
"""Name and file name of the font that a PDF embeds. The font ships with reportlab. Its licence permits embedding."""
FONT_SIZE = 2.2
"""Largest font size, mm."""
SMALLEST_FOOT = 1.2
"""Smallest font size of the foot of a page, mm. A foot that needs a smaller font joins the line on top instead."""
CHARACTER_WIDTH = 0.6
"""Assumed width of a character, in font sizes. In all fonts in use, digits and lower case are no wider on average."""


def font_size(text: str, width: float) -> float:
    """Return the font size, from 0.5 mm to :data:`FONT_SIZE`, at which a text is at most ``width`` mm wide.

    At the least size of 0.5 mm, a long text may be wider.
    """
    return max(min(FONT_SIZE, width / (CHARACTER_WIDTH * len(text))), 0.5)


def png_font(size: float) -> Any:
    """Return Pillow's built-in font at a size in pixels. The font is used for ASCII only."""
    from PIL import ImageFont

    return ImageFont.load_default(max(size, 1.0))
