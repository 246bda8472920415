"""Prints of patches and boards: lay out the sheets, then write their files and sidecars."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from kpbench.errors import DesignError
from kpbench.files import make_folder
from kpbench.patches.board import Board
from kpbench.patches.board_file import DEFAULT_DIAMETER_MM
from kpbench.patches.design import Patch, shipped_patches
from kpbench.printing.formats import PAGE_WRITERS
from kpbench.printing.page_format import PageFormat, parse_page_format
from kpbench.printing.png import px_per_mm
from kpbench.printing.sheet import Sheet, board_sheet, patch_sheet
from kpbench.writing import kind_of, require_writable, write_file

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
    """Write prints of patches to cut out, and a sidecar with the position of every keypoint.

    Parameters
    ----------
    patches : sequence of Patch, optional
        Default: the four shipped designs.
    out : str or Path
        Folder; made if missing.
    diameter_mm : float
        Diameter of the discs. Rim and quiet zone lie around the disc.
    copies : int
        Number of copies of each patch.
    page : str or PageFormat
        Page format such as "a4" or "200x300mm". See :func:`kpbench.printing.parse_page_format`.
    formats : sequence of str
        One or more of "pdf", "svg", "png" and "dxf".
    dpi : float
        Resolution of PNG.
    progress : callable
        Called with the number of sheets written since its last call.

    Returns
    -------
    list of Path
        The files that were written, the sidecar last.

    Raises
    ------
    DesignError
        If a patch does not fit the page, or a file format or page format is unknown.
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
    """Write prints of boards, and for each board a sidecar with the position of every keypoint.

    If one board does not fit the page, no file is written for any board.

    Parameters
    ----------
    boards : sequence of Board
    tile : bool
        Whether a board that is larger than the page may be spread over several pages.
    out, page, formats, dpi, progress
        As for :func:`print_patches`.

    Returns
    -------
    list of Path
        The files that were written. The sidecar is the last file of each board.

    Raises
    ------
    DesignError
        If a board does not fit the page, two boards have the same file name, or a file format or page format is
        unknown.
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
    known = [suffix.removeprefix(".") for suffix in PAGE_WRITERS]
    for name in formats:
        if name not in known:
            raise DesignError(f"`formats` has {name!r}, expected some of: {', '.join(known)}")
    files = []
    for sheet in sheets:
        files += save_sheet(sheet, out, [f".{name}" for name in formats], dpi)
        progress(1)
    return files


def save_sheet(sheet: Sheet, folder: str | Path, suffixes: Sequence[str], dpi: float = 600) -> list[Path]:
    """Write a sheet in several formats, and its sidecar.

    The files are named ``NAME.suffix``. If a format holds one page per file and the sheet has several pages, the files
    are named ``NAME-1.suffix``, ``NAME-2.suffix``, and so on.

    Parameters
    ----------
    sheet : Sheet
    folder : str or Path
        Made if missing.
    suffixes : sequence of str
        One or more of ".pdf", ".svg", ".png" and ".dxf".
    dpi : float
        Resolution of PNG.

    Returns
    -------
    list of Path
        The files that were written, the sidecar last.

    Raises
    ------
    DataError
        If a file cannot be written.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.printing import PageFormat, patch_sheet, save_sheet
    >>> sheet = patch_sheet(kpbench.shipped_patches(), 100.0, PageFormat(210, 297))
    >>> [path.name for path in save_sheet(sheet, "print", [".svg"])]
    ['patches-1.svg', 'patches-2.svg', 'patches.json']
    """
    folder = make_folder(Path(folder))
    stem = file_stem(sheet.name)
    sidecar = dict(sheet.sidecar)
    if ".png" in suffixes:
        sidecar["png"] = {"dpi": dpi, "px_per_mm": px_per_mm(dpi)}
    sidecar_file, files = folder / f"{stem}.json", dict[Path, bytes]()
    for suffix in suffixes:
        contents = PAGE_WRITERS[suffix](sheet.pages, dpi)
        for n, content in enumerate(contents, 1):
            files[folder / f"{stem}{f'-{n}' if len(contents) > 1 else ''}{suffix}"] = content
    files[sidecar_file] = (json.dumps(sidecar, indent=1) + "\n").encode()
    for path, content in files.items():  # all of them are looked at before the first is written
        require_writable(path, kind_of(content, content) or "")
    for path, content in files.items():
        write_file(path, content)
    return [*files]


def file_stem(name: str) -> str:
    """Return a file name without suffix for a board.

    Letters, digits, ``_``, ``.`` and ``-`` stay. Each run of other characters becomes one ``-``. Dots and hyphens at
    both ends are dropped.
    """
    return re.sub(r"[^\w.-]+", "-", name).strip(".-") or "board"
