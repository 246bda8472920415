"""Which writer makes the file of which suffix."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from kpbench.printing.dxf import dxf
from kpbench.printing.page import Page
from kpbench.printing.pdf import pdf
from kpbench.printing.png import png
from kpbench.printing.svg import svg

WRITERS: dict[str, Callable[[Sequence[Page], float], list[bytes]]] = {
    ".svg": lambda pages, dpi: [svg(page) for page in pages],
    ".png": lambda pages, dpi: [png(page, dpi) for page in pages],
    ".pdf": lambda pages, dpi: [pdf(pages)],
    ".dxf": lambda pages, dpi: [dxf(page) for page in pages],
}
"""Suffix to (pages, dpi) -> the contents of the files: one for PDF, one a page for the others."""
