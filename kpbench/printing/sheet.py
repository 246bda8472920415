"""Sheets: patches to cut out, or a board, laid out on pages with rulers, cut marks and labels.

Page frame: mm, x right, y down. The origin is the top-left corner of the page. A page is never scaled. A patch that is
larger than the page is an error. A board that is larger than the page is an error unless the board is tiled.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from kpbench.errors import DesignError
from kpbench.geometry.outline import move, rectangle
from kpbench.patches.board import Board
from kpbench.patches.board_sidecar import BOARD_SCHEMA
from kpbench.patches.design import Patch
from kpbench.patches.reference import REFERENCE_KIND, ReferenceMark
from kpbench.patches.symmetry import pose_problem
from kpbench.printing.font import font_size
from kpbench.printing.marks import TICK, TICK_GAP, crop_mark, disc_marks, frame, registration_cross
from kpbench.printing.page import CUT, INK, MARKS, Page, Shape, Text, round_to_nm
from kpbench.printing.page_format import PAGE_MARGIN, PageFormat
from kpbench.printing.sidecar import SHEET_SCHEMA, sidecar_entry, sidecar_head
from kpbench.printing.tiling import Tile, cut_into_tiles

CELL_GAP = 2 * (TICK_GAP + TICK) + 2.0  # mm: gap between two patches to cut out
LABEL_HEIGHT = 4.5  # mm: space for the label below a patch to cut out


@dataclass(frozen=True)
class Sheet:
    """Pages of one print, with the sidecar that lists the positions of the keypoints.

    Attributes
    ----------
    name : str
        Name of the print. The names of the files begin with this name.
    pages : tuple of Page
    sidecar : mapping
        Content of the JSON file.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.printing import PageFormat, patch_sheet
    >>> sheet = patch_sheet(kpbench.shipped_patches(), diameter_mm=30.0, page_format=PageFormat(210, 297))
    >>> sheet.name, len(sheet.pages), len(sheet.sidecar["keypoints"])
    ('patches', 1, 4)
    """

    name: str
    pages: tuple[Page, ...]
    sidecar: Mapping[str, Any]


def patch_sheet(patches: Sequence[Patch], diameter_mm: float, page_format: PageFormat, copies: int = 1) -> Sheet:
    """Lay out patches to cut out, on as few pages as possible.

    Parameters
    ----------
    patches : sequence of Patch
    diameter_mm : float
        Diameter of the discs. Rim and quiet zone lie around the disc.
    page_format : PageFormat
    copies : int
        Number of copies of each patch.

    Raises
    ------
    DesignError
        If a patch does not fit the page. The message names the largest diameter that fits.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.printing import PageFormat, patch_sheet
    >>> sheet = patch_sheet(kpbench.shipped_patches(), 60.0, PageFormat(210, 297), copies=2)
    >>> [keypoint["page"] for keypoint in sheet.sidecar["keypoints"]]
    [1, 1, 1, 1, 1, 1, 2, 2]
    """
    extent = max(p.extent for p in patches)
    cell_x = extent * diameter_mm + CELL_GAP
    cell_y = cell_x + LABEL_HEIGHT
    width, height = page_format.ink_size_mm
    columns, rows = math.floor(width / cell_x + 1e-9), math.floor(height / cell_y + 1e-9)
    if not columns or not rows:
        largest = (min(width, height - LABEL_HEIGHT) - CELL_GAP) / extent
        raise DesignError(
            f"a patch of {diameter_mm:g} mm does not fit the {page_format.width_mm:g} x {page_format.height_mm:g} mm "
            f"page; the largest diameter that fits is {_round_down(largest)} mm"
        )
    prints = [patch for patch in patches for _ in range(copies)]
    columns = min(columns, len(prints))
    labels = {p: f"{p.name}, id {p.patch_id}, {p.digest[:8]}" for p in patches}
    label_size = min(font_size(label, cell_x - 1.0) for label in labels.values())
    per_page = rows * columns
    pages: list[Page] = []
    keypoints: list[dict[str, Any]] = []
    for start in range(0, len(prints), per_page):
        number = len(pages) + 1
        title = f"kpbench patches, disc diameter {diameter_mm:g} mm" + (" without rim" if extent > 1 else "")
        shapes, texts = frame(page_format, title, f"page {number} of {math.ceil(len(prints) / per_page)}")
        for n, patch in enumerate(prints[start : start + per_page]):
            x = page_format.width_mm / 2 + (n % columns + 0.5 - columns / 2) * cell_x
            y = PAGE_MARGIN + n // columns * cell_y + cell_x / 2
            shapes += [
                _ink(patch, x, y, diameter_mm, 0.0, page_format),
                *disc_marks(x, y, patch.extent * diameter_mm / 2),
            ]
            texts.append(Text(labels[patch], x, y + cell_x / 2 + LABEL_HEIGHT / 2, label_size, "middle"))
            on_paper = page_format.position_on_paper(x, y)
            keypoints.append(sidecar_entry(len(keypoints), patch, 0.0, diameter_mm, number, on_paper))
        pages.append(page_format.make_page(shapes, texts, title))
    content = (round_to_nm(diameter_mm), [(p.patch_id, p.digest) for p in patches])
    digest = hashlib.sha256(repr(content).encode()).hexdigest()
    sidecar = sidecar_head(SHEET_SCHEMA, "patches", digest, page_format, patches) | {"keypoints": keypoints}
    return Sheet("patches", tuple(pages), sidecar)


def board_sheet(board: Board, page_format: PageFormat, tile: bool = False) -> Sheet:
    """Lay out a board in the middle of one page, or with ``tile`` on as few pages as possible.

    If one page is too small, the board is cut into tiles along straight seams that pass between patches. Registration
    crosses mark the corners of every tile. A corner that several tiles share gets a cross on each of these tiles.

    Parameters
    ----------
    board : Board
    page_format : PageFormat
    tile : bool
        Whether a board that is larger than the page may be spread over several pages.

    Raises
    ------
    DesignError
        If the board does not fit the page, and ``tile`` is false or no straight seam passes between the patches. If
        ``tile`` is false, the message names the largest diameter that fits.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.printing import PageFormat, board_sheet
    >>> board = kpbench.hexagon_board(kpbench.shipped_patches()[0], side_mm=350.0)
    >>> len(board_sheet(board, PageFormat(210, 297), tile=True).pages)
    4
    """
    width, height = page_format.ink_size_mm
    fits = board.side_x_mm <= width + 1e-6 and board.side_y_mm <= height + 1e-6
    if not fits and not tile:
        scale = min(width / board.side_x_mm, height / board.side_y_mm)
        raise DesignError(
            f"board {board.name!r} is {board.side_x_mm:g} x {board.side_y_mm:g} mm, and the "
            f"{page_format.width_mm:g} x {page_format.height_mm:g} mm page holds {width:g} x {height:g} mm; "
            "if the whole board is made smaller, the largest diameter that fits is "
            f"{_round_down(scale * max(k.diameter_mm for k in board.keypoints))} mm; "
            "`tile=True` spreads the board over pages"
        )
    tiles = cut_into_tiles(board, width, height)
    keypoints = []
    for index, k in enumerate(board.keypoints):
        page = next(n for n, t in enumerate(tiles) if t.contains(k.x_mm, k.y_mm))
        on_paper = page_format.position_on_paper(*_on_page(tiles[page], page_format, k.x_mm, k.y_mm))
        entry = sidecar_entry(index, k.patch, k.rotate_deg, k.diameter_mm, page + 1, on_paper)
        keypoints.append(entry | {"x_mm": round_to_nm(k.x_mm), "y_mm": round_to_nm(k.y_mm), "z_mm": 0.0})
    sidecar = sidecar_head(BOARD_SCHEMA, board.name, board.digest, page_format, board.patches) | {
        "frame": "mm; x right, y down, z away from the viewer; the origin is the board's centre",
        "side_mm": [round_to_nm(board.side_x_mm), round_to_nm(board.side_y_mm)],
        "unique_pose": not pose_problem(board),
        "field": board.is_field,
        "keypoints": keypoints,
        "tiles": [_tile_entry(t, n, page_format) for n, t in enumerate(tiles, 1)],
    }
    if board.references:
        sidecar["references"] = [_reference_entry(mark, tiles, page_format) for mark in board.references]
    return Sheet(board.name, tuple(_tile_page(board, t, tiles, page_format) for t in tiles), sidecar)


def _tile_entry(tile: Tile, page: int, page_format: PageFormat) -> dict[str, Any]:
    """Return the entry of one tile in the sidecar; pages, rows and columns count from 1."""
    corners = []
    for x, y in tile.corners:
        page_x, page_y = page_format.position_on_paper(*_on_page(tile, page_format, x, y))
        corners.append({"x_mm": round_to_nm(x), "y_mm": round_to_nm(y), "page_x_mm": page_x, "page_y_mm": page_y})
    return {"page": page, "row": tile.row + 1, "column": tile.column + 1, "corners": corners}


def _reference_entry(mark: ReferenceMark, tiles: Sequence[Tile], page_format: PageFormat) -> dict[str, Any]:
    """Return the entry of one reference mark in the sidecar; its corners are clockwise from the top left."""
    page = next(n for n, t in enumerate(tiles) if t.contains(mark.x_mm, mark.y_mm))
    corners = mark.corners_mm.tolist()
    on_paper = (page_format.position_on_paper(*_on_page(tiles[page], page_format, x, y)) for x, y in corners)
    return {
        "kind": REFERENCE_KIND,
        "dictionary": mark.dictionary,
        "id": mark.mark_id,
        "corners_mm": [[round_to_nm(x), round_to_nm(y)] for x, y in corners],
        "page": page + 1,
        "page_corners_mm": [list(corner) for corner in on_paper],
    }


def _tile_page(board: Board, tile: Tile, tiles: Sequence[Tile], page_format: PageFormat) -> Page:
    sizes = sorted({f"{k.diameter_mm:g}": k.diameter_mm for k in board.keypoints}.items(), key=lambda item: item[1])
    title = f"kpbench board {board.name}, {board.side_x_mm:.6g} x {board.side_y_mm:.6g} mm, disc diameter "
    title += " to ".join(dict.fromkeys((sizes[0][0], sizes[-1][0]))) + " mm"
    foot = f"{board.name}, {board.digest[:12]}"
    if len(tiles) > 1:
        foot += f", tile row {tile.row + 1} of {tiles[-1].row + 1}, column {tile.column + 1} of {tiles[-1].column + 1}"
    shapes, texts = frame(page_format, title, foot)
    for k in board.keypoints:
        if tile.contains(k.x_mm, k.y_mm):
            shapes.append(
                _ink(k.patch, *_on_page(tile, page_format, k.x_mm, k.y_mm), k.diameter_mm, k.rotate_deg, page_format)
            )
    for mark in board.references:
        if tile.contains(mark.x_mm, mark.y_mm):
            region = mark.white_region if page_format.inverted else mark.region
            shapes.append(Shape(move(region, *_on_page(tile, page_format, 0.0, 0.0)), INK))
    for x, y in tile.corners:
        page_x, page_y = _on_page(tile, page_format, x, y)
        right, down = (1 if x == tile.x1 else -1), (1 if y == tile.y1 else -1)
        if len(tiles) == 1:
            shapes.append(Shape(crop_mark(page_x, page_y, right, down), MARKS))
            continue
        shapes.append(Shape(move(registration_cross(), page_x, page_y), MARKS))
        anchor = "end" if right > 0 else "start"
        texts.append(Text(f"({x:.3f}, {y:.3f})", page_x - right, page_y + (1.9 if down > 0 else -0.7), 1.5, anchor))
    corner = _on_page(tile, page_format, tile.x0, tile.y0)
    shapes.append(Shape(rectangle(*corner, tile.x1 - tile.x0, tile.y1 - tile.y0), CUT))
    return page_format.make_page(shapes, texts, title)


def _on_page(tile: Tile, page_format: PageFormat, x: float, y: float) -> tuple[float, float]:
    """Return where a point of the board lies in the layout of a page. The tile lies in the middle of the page."""
    return x + (page_format.width_mm - tile.x0 - tile.x1) / 2, y + (page_format.height_mm - tile.y0 - tile.y1) / 2


def _ink(patch: Patch, x: float, y: float, diameter: float, rotate_deg: float, page_format: PageFormat) -> Shape:
    region = patch.white_region if page_format.inverted else patch.black_region
    return Shape(move(region, x, y, diameter / 2, rotate_deg), INK)


def _round_down(diameter: float) -> str:
    """Return a diameter in mm as text, rounded down to 0.01 mm so that the diameter still fits."""
    return f"{math.floor(diameter * 100 + 1e-6) / 100:g}"
