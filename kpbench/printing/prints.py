"""Print files of patches and boards: lay out the sheets, then write them with their sidecars."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from kpbench.errors import DesignError
from kpbench.patches.board import DEFAULT_DIAMETER_MM, Board
from kpbench.patches.design import Patch, shipped_patches
from kpbench.printing.formats import WRITERS
from kpbench.printing.sheet import (
    PageFormat,
    Sheet,
    board_sheet,
    file_stem,
    parse_page_format,
    patch_sheet,
    save_sheet,
)

Progress = Callable[[int], None]


def print_patches(
    patches: Sequence[Patch] | None = None,
    out: str | Path = "patches-print",
    *,
    diameter_mm: float = DEFAULT_DIAMETER_MM,
    copies: int = 1,
    page: str | PageFormat = "a4",
    formats: Sequence[str] = ("pdf",),
    dpi: float = 600,
    progress: Progress = lambda sheets: None,
) -> list[Path]:
    """Write print files of patches to cut out, and a sidecar with the position of every keypoint.

    Parameters
    ----------
    patches : sequence of Patch, optional
        Default: the shipped four.
    out : str or Path
        Folder; made if missing.
    diameter_mm : float
        Diameter of the unit disc. Rims and quiet zones are added to it.
    copies : int
        Number of copies of each patch.
    page : str or PageFormat
        Such as ``"a4"`` or ``"200x300mm"``, see :func:`kpbench.printing.parse_page_format`.
    formats : sequence of str
        Among ``"pdf"``, ``"svg"``, ``"png"`` and ``"dxf"``.
    dpi : float
        Resolution of PNG.
    progress : callable
        Called with the number of sheets that were written since its last call.

    Returns
    -------
    list of Path
        The files that were written, the sidecar last.

    Raises
    ------
    DesignError
        If a patch does not fit the page, or a format or page is unknown.
    DataError
        If a file cannot be written.

    Examples
    --------
    >>> import kpbench
    >>> [path.name for path in kpbench.print_patches(diameter_mm=50, formats=["svg"])]
    ['patches.svg', 'patches.json']
    """
    sheet = patch_sheet(patches or shipped_patches(), diameter_mm, _page_format(page), copies)
    return _save_sheets([sheet], out, formats, dpi, progress)


def print_boards(
    boards: Sequence[Board],
    out: str | Path = "patches-print",
    *,
    page: str | PageFormat = "a4",
    tile: bool = False,
    formats: Sequence[str] = ("pdf",),
    dpi: float = 600,
    progress: Progress = lambda sheets: None,
) -> list[Path]:
    """Write print files of boards, and for each board a sidecar with the position of every keypoint.

    Nothing is written unless every board fits.

    Parameters
    ----------
    boards : sequence of Board
    tile : bool
        Whether a board that is larger than the page is spread over several pages.
    out, page, formats, dpi, progress
        As for :func:`print_patches`.

    Returns
    -------
    list of Path
        The files that were written, for each board its sidecar last.

    Raises
    ------
    DesignError
        If a board does not fit the page, two boards have the same file name, or a format or page is unknown.
    DataError
        If a file cannot be written.

    Examples
    --------
    >>> import kpbench
    >>> board = kpbench.hexagon_board(kpbench.shipped_patches()[0], side_mm=150)
    >>> [path.name for path in kpbench.print_boards([board])]
    ['hexagon-checker.pdf', 'hexagon-checker.json']
    """
    page = _page_format(page)
    sheets = [board_sheet(board, page, tile) for board in boards]
    stems = [file_stem(sheet.name) for sheet in sheets]
    if doubles := [stem for stem in stems if stems.count(stem) > 1]:
        raise DesignError(f"two boards would be written to {doubles[0]}; print one of them, or give them other names")
    return _save_sheets(sheets, out, formats, dpi, progress)


def _page_format(page: str | PageFormat) -> PageFormat:
    return parse_page_format(page) if isinstance(page, str) else page


def _save_sheets(
    sheets: Sequence[Sheet], out: str | Path, formats: Sequence[str], dpi: float, progress: Progress
) -> list[Path]:
    """Write sheets in every format."""
    known = [suffix.removeprefix(".") for suffix in WRITERS]
    for name in formats:
        if name not in known:
            raise DesignError(f"`formats` has {name!r}, expected some of: {', '.join(known)}")
    files = []
    for sheet in sheets:
        files += save_sheet(sheet, out, [f".{name}" for name in formats], dpi)
        progress(1)
    return files
