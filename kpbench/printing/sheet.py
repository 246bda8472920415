"""Patches and boards laid out on pages, with rulers, cut marks, labels and a sidecar of positions.

Page frame: mm, x right, y down, the origin is the page's top-left corner. From the page's edge inwards
lie 5 mm that many printers leave blank, a 3-mm strip for text and rulers, a 3-mm strip for cut and
registration marks, and the room for ink. A page is never scaled to fit: what does not fit is an error.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kpbench import __version__
from kpbench.errors import DesignError
from kpbench.files import make_folder, write_atomic
from kpbench.geometry.outline import Line, Region, circle, move, rectangle
from kpbench.patches.board import Board
from kpbench.patches.design import Patch
from kpbench.printing.formats import WRITERS
from kpbench.printing.page import CUT, INK, MARKS, Page, Shape, Text, mirror
from kpbench.printing.png import px_per_mm
from kpbench.printing.sidecar import BOARD_SCHEMA, SHEET_SCHEMA, nm
from kpbench.printing.tiling import Tile, cut_into_tiles

PAGE_SIZES_MM = {  # mm; ISO 216 and ANSI Y14.1
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
}
BLANK, STRIP = 5.0, 3.0
MARGIN = BLANK + 2 * STRIP
RULER = 100.0
LINE = 0.1  # width of every mark
TICK_GAP, TICK = 1.0, 2.0  # cut marks: distance from what is cut, and length
CELL_GAP = 2 * (TICK_GAP + TICK) + 2.0  # between two patches to be cut out
FONT_SIZE = 2.2
LABEL_ROOM = 4.5  # below a patch to be cut out
CROSS_ARM = 2.5


@dataclass(frozen=True)
class PageFormat:
    """A page to print on: sizes in mm, whether text is printed, and whether left and right are swapped."""

    width: float
    height: float
    labels: bool = True
    mirrored: bool = False

    @property
    def room(self) -> tuple[float, float]:
        """Width and height for ink."""
        return self.width - 2 * MARGIN, self.height - 2 * MARGIN

    @property
    def rulers(self) -> tuple[float, float]:
        """Lengths of the rulers in x and y: 100 mm, or less on a small page."""
        x, y = (min(RULER, 10.0 * math.floor(room / 10)) for room in self.room)
        return x, y

    def seen(self, x: float, y: float) -> tuple[float, float]:
        """Where a point of the layout is in the file, to 1 nm."""
        return nm(self.width - x if self.mirrored else x), nm(y)

    def page(self, shapes: Iterable[Shape], texts: Iterable[Text], title: str) -> Page:
        """The finished page."""
        page = Page(self.width, self.height, tuple(shapes), tuple(texts) if self.labels else (), title)
        return mirror(page) if self.mirrored else page


@dataclass(frozen=True)
class Sheet:
    """What goes into files of one name: the pages, and the sidecar that says where the keypoints are."""

    name: str
    pages: tuple[Page, ...]
    sidecar: Mapping[str, Any]


def parse_page_format(text: str, landscape: bool = False, labels: bool = True, mirrored: bool = False) -> PageFormat:
    """The paper called ``a4``, ``letter``, … or ``WxHmm``.

    Raises
    ------
    DesignError
        If it is neither, or a side is not from 40 to 5000 mm.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)(?:mm)?", text.lower())
    if text.lower() not in PAGE_SIZES_MM and not match:
        raise DesignError(f"page {text!r} is not known, expected {', '.join(PAGE_SIZES_MM)} or WIDTHxHEIGHTmm")
    width, height = (float(match[1]), float(match[2])) if match else PAGE_SIZES_MM[text.lower()]
    if not (40 <= width <= 5000 and 40 <= height <= 5000):
        raise DesignError(f"page {text!r} is {width:g} x {height:g} mm, expected 40 to 5000 mm a side")
    return PageFormat(*((height, width) if landscape else (width, height)), labels, mirrored)


def patch_sheet(patches: Sequence[Patch], diameter_mm: float, paper: PageFormat, copies: int = 1) -> Sheet:
    """Patches to be cut out, ``copies`` of each, on as many pages as it takes.

    Parameters
    ----------
    patches : sequence of Patch
    diameter_mm : float
        Of the unit disc; rims and quiet zones come on top.
    paper : PageFormat
    copies : int

    Raises
    ------
    DesignError
        If one patch does not fit the page; names the largest diameter that does.
    """
    extent = max(p.extent for p in patches)
    cell_x = extent * diameter_mm + CELL_GAP
    cell_y = cell_x + LABEL_ROOM
    room_x, room_y = paper.room
    columns, rows = math.floor(room_x / cell_x + 1e-9), math.floor(room_y / cell_y + 1e-9)
    if not columns or not rows:
        largest = (min(room_x, room_y - LABEL_ROOM) - CELL_GAP) / extent
        raise DesignError(
            f"a patch of {diameter_mm:g} mm does not fit the {paper.width:g} x {paper.height:g} mm page; "
            f"the largest diameter that does is {_floored(largest)} mm"
        )
    placed = [patch for patch in patches for _ in range(copies)]
    columns = min(columns, len(placed))
    labels = {p: f"{p.name}, id {p.patch_id}, {p.digest[:8]}" for p in patches}
    label_size = min(_fitting(label, cell_x - 1.0) for label in labels.values())
    on_page = rows * columns
    pages: list[Page] = []
    keypoints: list[dict[str, Any]] = []
    for start in range(0, len(placed), on_page):
        number = len(pages) + 1
        title = f"kpbench patches, disc diameter {diameter_mm:g} mm" + (" without rim" if extent > 1 else "")
        shapes, texts = _frame(paper, title, f"page {number} of {math.ceil(len(placed) / on_page)}")
        for n, patch in enumerate(placed[start : start + on_page]):
            x = paper.width / 2 + (n % columns + 0.5 - columns / 2) * cell_x
            y = MARGIN + n // columns * cell_y + cell_x / 2
            shapes += [_ink(patch, x, y, diameter_mm, 0.0), *_disc_marks(x, y, patch.extent * diameter_mm / 2)]
            texts.append(Text(labels[patch], x, y + cell_x / 2 + LABEL_ROOM / 2, label_size, "middle"))
            keypoints.append(_entry(len(keypoints), patch, 0.0, diameter_mm, number, paper.seen(x, y)))
        pages.append(paper.page(shapes, texts, title))
    digest = hashlib.sha256(repr((nm(diameter_mm), [(p.patch_id, p.digest) for p in patches])).encode()).hexdigest()
    sidecar = _sidecar_head(SHEET_SCHEMA, "patches", digest, paper, patches) | {"keypoints": keypoints}
    return Sheet("patches", tuple(pages), sidecar)


def board_sheet(board: Board, paper: PageFormat, tile: bool = False) -> Sheet:
    """A board in the middle of one page, or with ``tile`` on as many pages as it takes.

    Tiles are cut along straight seams that pass between patches. Crosses mark the corners of every
    tile; neighbours share them.

    Raises
    ------
    DesignError
        If the board does not fit the page and ``tile`` is off (names the largest diameter that does
        fit), or if no seam passes between patches.
    """
    room_x, room_y = paper.room
    fits = board.side_x_mm <= room_x + 1e-6 and board.side_y_mm <= room_y + 1e-6
    if not fits and not tile:
        scale = min(room_x / board.side_x_mm, room_y / board.side_y_mm)
        raise DesignError(
            f"board {board.name!r} is {board.side_x_mm:g} x {board.side_y_mm:g} mm, and the {paper.width:g} x "
            f"{paper.height:g} mm page holds {room_x:g} x {room_y:g} mm; the largest diameter that fits, the whole "
            f"board made smaller with it, is {_floored(scale * max(k.diameter_mm for k in board.keypoints))} mm; "
            "`tile=True` spreads the board over pages"
        )
    tiles = cut_into_tiles(board, room_x, room_y)
    keypoints = []
    for index, k in enumerate(board.keypoints):
        page = next(n for n, t in enumerate(tiles) if t.holds(k.x_mm, k.y_mm))
        seen = paper.seen(*_on_page(tiles[page], paper, k.x_mm, k.y_mm))
        entry = _entry(index, k.patch, k.rotate_deg, k.diameter_mm, page + 1, seen)
        keypoints.append(entry | {"x_mm": nm(k.x_mm), "y_mm": nm(k.y_mm), "z_mm": 0.0})
    described = []
    for n, t in enumerate(tiles, 1):
        seen_corners = [paper.seen(*_on_page(t, paper, *corner)) for corner in t.corners]
        corners = [
            {"x_mm": nm(x), "y_mm": nm(y), "page_x_mm": page_x, "page_y_mm": page_y}
            for (x, y), (page_x, page_y) in zip(t.corners, seen_corners, strict=True)
        ]
        described.append({"page": n, "row": t.row + 1, "column": t.column + 1, "corners": corners})
    sidecar = _sidecar_head(BOARD_SCHEMA, board.name, board.digest, paper, board.patches) | {
        "frame": "mm; x right, y down, z away from the viewer; the origin is the board's centre",
        "side_mm": [nm(board.side_x_mm), nm(board.side_y_mm)],
        "keypoints": keypoints,
        "tiles": described,
    }
    return Sheet(board.name, tuple(_tile_page(board, t, tiles, paper) for t in tiles), sidecar)


def save_sheet(sheet: Sheet, folder: str | Path, suffixes: Sequence[str], dpi: float = 600) -> list[Path]:
    """Write a sheet in every format asked for, and its sidecar.

    Files are ``NAME.suffix``, or ``NAME-1.suffix``, ``NAME-2.suffix``, … of several pages where a
    format holds one page.

    Parameters
    ----------
    sheet : Sheet
    folder : path
        Made if it is not there.
    suffixes : sequence of str
        Keys of :data:`kpbench.printing.WRITERS`.
    dpi : float
        Resolution of PNG.

    Returns
    -------
    list of Path
        The files written, sidecar last.

    Raises
    ------
    DataError
        If a file cannot be written.
    """
    folder = make_folder(Path(folder))
    stem = file_stem(sheet.name)
    sidecar = dict(sheet.sidecar)
    if ".png" in suffixes:
        sidecar["png"] = {"dpi": dpi, "px_per_mm": px_per_mm(dpi)}
    written = []
    for suffix in suffixes:
        contents = WRITERS[suffix](sheet.pages, dpi)
        for n, content in enumerate(contents, 1):
            written.append(folder / f"{stem}{f'-{n}' if len(contents) > 1 else ''}{suffix}")
            write_atomic(written[-1], content)
    written.append(folder / f"{stem}.json")
    write_atomic(written[-1], (json.dumps(sidecar, indent=1) + "\n").encode())
    return written


def file_stem(name: str) -> str:
    """A board's name as a file name: letters, digits, ``_``, ``.`` and ``-`` stay."""
    return re.sub(r"[^\w.-]+", "-", name).strip(".-") or "board"


# --- parts of a page, before any mirroring ----------------------------------------------------------


def _frame(paper: PageFormat, title: str, foot: str) -> tuple[list[Shape], list[Text]]:
    """Both rulers, the line of text on top, and the one at the bottom right."""
    (ruler_x, ruler_y), width, height = paper.rulers, paper.width, paper.height
    inner, below = BLANK + STRIP, height - BLANK - STRIP
    shapes = [
        Shape(_polygon((MARGIN + u, below + v) for u, v in _comb(ruler_x)), MARKS),
        Shape(_polygon((inner - v, height - MARGIN - u) for u, v in _comb(ruler_y)), MARKS),
    ]
    check = f"print at 100 %, check with a ruler: {ruler_x:g} mm"
    end, bottom = MARGIN + ruler_x, height - BLANK - 0.6
    foot_size = _fitting(foot, width - MARGIN - end - 12)
    if foot_size < 1.2:  # a small page: no room beside the ruler
        title, foot = f"{title}, {foot}", ""
    size = _fitting(f"{title}    {check}", paper.room[0])
    x, y = BLANK + STRIP / 2, height - MARGIN - ruler_y
    texts = [
        Text(title, MARGIN, BLANK + size, size),
        Text(check, width - MARGIN, BLANK + size, size, "end"),
        Text(f"{ruler_x:g} mm", end + 1.5, bottom, FONT_SIZE),
        Text(foot, width - MARGIN, bottom, foot_size, "end"),
        Text(f"{ruler_y:g}", x, y - 3.2, 1.7, "middle"),
        Text("mm", x, y - 1.2, 1.7, "middle"),
    ]
    return shapes, texts


def _comb(length: float) -> list[tuple[float, float]]:
    """Outline of a ruler along +u with its ticks towards +v; the tick of n mm is centred on u = n."""
    half = LINE / 2
    points = [(length + half, 0.0), (-half, 0.0)]
    for n in range(round(length) + 1):
        tick = STRIP * (1.0 if n % 10 == 0 else 0.6 if n % 5 == 0 else 0.4)
        points += [(n - half, LINE), (n - half, tick), (n + half, tick), (n + half, LINE)]
    return points


def _tile_page(board: Board, tile: Tile, tiles: Sequence[Tile], paper: PageFormat) -> Page:
    sizes = sorted({f"{k.diameter_mm:g}": k.diameter_mm for k in board.keypoints}.items(), key=lambda item: item[1])
    title = f"kpbench board {board.name}, {board.side_x_mm:.6g} x {board.side_y_mm:.6g} mm, disc diameter "
    title += " to ".join(dict.fromkeys((sizes[0][0], sizes[-1][0]))) + " mm"
    foot = f"{board.name}, {board.digest[:12]}"
    if len(tiles) > 1:
        foot += f", tile row {tile.row + 1} of {tiles[-1].row + 1}, column {tile.column + 1} of {tiles[-1].column + 1}"
    shapes, texts = _frame(paper, title, foot)
    for k in board.keypoints:
        if tile.holds(k.x_mm, k.y_mm):
            shapes.append(_ink(k.patch, *_on_page(tile, paper, k.x_mm, k.y_mm), k.diameter_mm, k.rotate_deg))
    for x, y in tile.corners:
        page_x, page_y = _on_page(tile, paper, x, y)
        right, down = (1 if x == tile.x1 else -1), (1 if y == tile.y1 else -1)
        if len(tiles) == 1:
            shapes.append(Shape(_crop_mark(page_x, page_y, right, down), MARKS))
            continue
        shapes.append(Shape(move(_cross(), page_x, page_y), MARKS))
        anchor = "end" if right > 0 else "start"
        texts.append(Text(f"({x:.3f}, {y:.3f})", page_x - right, page_y + (1.9 if down > 0 else -0.7), 1.5, anchor))
    corner = _on_page(tile, paper, tile.x0, tile.y0)
    shapes.append(Shape(rectangle(*corner, tile.x1 - tile.x0, tile.y1 - tile.y0), CUT))
    return paper.page(shapes, texts, title)


def _on_page(tile: Tile, paper: PageFormat, x: float, y: float) -> tuple[float, float]:
    """A point of the board on the tile's page: the tile's window sits in the page's middle."""
    return x + (paper.width - tile.x0 - tile.x1) / 2, y + (paper.height - tile.y0 - tile.y1) / 2


def _ink(patch: Patch, x: float, y: float, diameter: float, rotate_deg: float) -> Shape:
    return Shape(move(patch.black_region, x, y, diameter / 2, rotate_deg), INK)


def _disc_marks(x: float, y: float, radius: float) -> list[Shape]:
    """Four cut marks that stay clear of the ink, and the cut itself."""
    near, far, half = radius + TICK_GAP, radius + TICK_GAP + TICK, LINE / 2
    boxes = [(near, -half, TICK, LINE), (-far, -half, TICK, LINE), (-half, near, LINE, TICK), (-half, -far, LINE, TICK)]
    ticks = [Shape(rectangle(x + dx, y + dy, w, h), MARKS) for dx, dy, w, h in boxes]
    return [*ticks, Shape(circle(x, y, radius), CUT)]


def _crop_mark(x: float, y: float, right: int, down: int) -> Region:
    """Two cut marks that continue the edges of a board beyond its corner."""
    near, half = TICK_GAP / 2, LINE / 2
    along = rectangle(x + near if right > 0 else x - near - TICK, y - half, TICK, LINE)
    return along + rectangle(x - half, y + near if down > 0 else y - near - TICK, LINE, TICK)


def _cross() -> Region:
    """A registration cross about the origin, as one contour."""
    arm, half = CROSS_ARM, LINE / 2
    corners = [(half, -half), (arm, -half), (arm, half)]
    turns = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    return _polygon((c * x - s * y, s * x + c * y) for c, s in turns for x, y in corners)


def _polygon(points: Iterable[tuple[float, float]]) -> Region:
    corners = list(points)
    return (tuple(Line(*a, *b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)),)


def _fitting(text: str, room: float) -> float:
    """Font size in mm: no font that is used is wider than 0.6 of its size on average, in digits and lower case."""
    return max(min(FONT_SIZE, room / (0.6 * len(text))), 0.5)


def _floored(diameter: float) -> str:
    """A largest diameter in mm, rounded so that it still fits."""
    return f"{math.floor(diameter * 100 + 1e-6) / 100:g}"


# --- parts of a sidecar ------------------------------------------------------------------------------


def _sidecar_head(schema: str, name: str, digest: str, paper: PageFormat, patches: Iterable[Patch]) -> dict[str, Any]:
    return {
        "schema": schema,
        "kpbench": __version__,
        "name": name,
        "digest": digest,
        "page_mm": [paper.width, paper.height],
        "mirrored": paper.mirrored,
        "ruler_mm": list(paper.rulers),
        "print_scale": [1.0, 1.0],
        "patches": [{"id": p.patch_id, "name": p.name, "digest": p.digest} for p in patches],
    }


def _entry(
    index: int, patch: Patch, rotate_deg: float, diameter_mm: float, page: int, seen: tuple[float, float]
) -> dict[str, Any]:
    return {
        "index": index,
        "patch_id": patch.patch_id,
        "rotate_deg": rotate_deg,
        "diameter_mm": nm(diameter_mm),
        "page": page,
        "page_x_mm": seen[0],
        "page_y_mm": seen[1],
    }
