"""Table of the print formats: a writer for each file suffix."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from kpbench.printing.dxf import to_dxf
from kpbench.printing.page import Page
from kpbench.printing.pdf import to_pdf
from kpbench.printing.png import to_png
from kpbench.printing.svg import to_svg

PAGE_WRITERS: dict[str, Callable[[Sequence[Page], float], list[bytes]]] = {
    ".svg": lambda pages, dpi: [to_svg(page) for page in pages],
    ".png": lambda pages, dpi: [to_png(page, dpi) for page in pages],
    ".pdf": lambda pages, dpi: [to_pdf(pages)],
    ".dxf": lambda pages, dpi: [to_dxf(page) for page in pages],
}
"""Writers by suffix. A writer takes (pages, dpi) and returns the contents of the files: one file for PDF, otherwise one
file per page."""
