"""Fonts of the text on a print. Each file format has its own fonts. All file formats have the same font sizes."""

from __future__ import annotations

from typing import Any

SVG_FONTS = "Helvetica, Arial, sans-serif"
"""CSS font families of an SVG. The viewer takes the first family that is installed."""
PDF_FONT = "Vera"
"""Name and file name of the font that a PDF embeds. The font ships with reportlab. Its licence permits embedding."""
FONT_SIZE = 2.2
"""Largest font size, mm."""
SMALLEST_FOOT = 1.2
"""Smallest font size of the foot of a page, mm. If the foot needs a smaller font, its text moves to the top line."""
CHARACTER_WIDTH = 0.6
"""Assumed mean width of a character, as a fraction of the font size. No font in use has a larger mean width."""


def font_size(text: str, width: float) -> float:
    """Return the largest font size, up to :data:`FONT_SIZE`, at which a text is at most ``width`` mm wide.

    The font size is never below 0.5 mm. A long text may therefore be wider than ``width``.
    """
    return max(min(FONT_SIZE, width / (CHARACTER_WIDTH * len(text))), 0.5)


def png_font(size: float) -> Any:
    """Return Pillow's built-in font at a size in pixels. The font is used for ASCII only."""
    from PIL import ImageFont

    return ImageFont.load_default(max(size, 1.0))
