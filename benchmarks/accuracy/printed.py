"""Where other people's programs see the keypoints of a print.

Writes the shipped sheet and boards as SVG, PDF, PNG and DXF, reads them back with programs and libraries that
share no code with kpbench, and compares every keypoint with the sidecar. Vector files are read as curves, and
the centre follows from the exact centroid of the ink. Rasters are fitted: position, affine deformation, ink,
paper, and a spread of the ink are free. What is not installed is left out.

Last, how finely each program places an edge: the left and the upper edge of a shape at 64 places within a pixel.
A program that knows 4 places puts edges off by up to 1/8 px and more, at every resolution.

    python benchmarks/accuracy/printed.py --dpi 1200
"""

from __future__ import annotations

import argparse
import io
import shutil
import subprocess
import sys
from collections.abc import Callable
from itertools import chain, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "printing"))
import readers

from kpbench.geometry import Line, flatten, move, rasterise
from kpbench.patches import Patch, grid_board, hexagon_board, shipped_patches
from kpbench.printing import (
    Page,
    PageFormat,
    Shape,
    Sheet,
    board_sheet,
    patch_sheet,
    px_per_mm,
    to_dxf,
    to_pdf,
    to_png,
    to_svg,
)
from kpbench.types import Float

Image.MAX_IMAGE_PIXELS = None


def run(folder: Path, *command: Any) -> None:
    subprocess.run([str(part) for part in command], cwd=folder, check=True, capture_output=True)


def grey(image: Image.Image | Path) -> Float:
    return np.asarray((Image.open(image) if isinstance(image, Path) else image).convert("L"), np.uint8)


# Each gives the picture and its scale, px a mm in x and y.
Picture = tuple[Any, tuple[float, float]]


def own_png(folder: Path, sheet: Sheet, dpi: float) -> Picture:
    scale = px_per_mm(dpi)
    return grey(Image.open(io.BytesIO(to_png(sheet.pages[0], dpi)))), (scale, scale)


def pdftoppm(folder: Path, sheet: Sheet, dpi: float) -> Picture:
    run(folder, "pdftoppm", "-gray", "-singlefile", "-r", dpi, "a.pdf", "a")
    return grey(folder / "a.pgm"), (dpi / 25.4, dpi / 25.4)


def pdftocairo(folder: Path, sheet: Sheet, dpi: float) -> Picture:
    run(folder, "pdftocairo", "-png", "-gray", "-singlefile", "-r", dpi, "a.pdf", "a")
    return grey(folder / "a.png"), (dpi / 25.4, dpi / 25.4)


def rsvg_convert(folder: Path, sheet: Sheet, dpi: float) -> Picture:
    run(folder, "rsvg-convert", "-d", dpi, "-p", dpi, "-b", "white", "-o", "a.png", "a.svg")
    return grey(folder / "a.png"), (dpi / 25.4, dpi / 25.4)


def pdfium(folder: Path, sheet: Sheet, dpi: float) -> Picture:
    """Stretches the page to whole pixels."""
    import pypdfium2

    page = pypdfium2.PdfDocument(folder / "a.pdf")[0].render(scale=dpi / 72, grayscale=True)
    picture = page.to_numpy().reshape(page.height, -1)[:, : page.width]
    return picture, (page.width / sheet.pages[0].width, page.height / sheet.pages[0].height)


def chromium(folder: Path, sheet: Sheet, dpi: float) -> Picture:
    """Stretches the page to whole pixels of the screen."""
    zoom = max(1, round(min(dpi, 288) / 96))  # a larger picture of A4 comes out cropped
    page = sheet.pages[0]
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={folder}/profile"]
    size = [f"--window-size={page.width * 4:.0f},{page.height * 4 + 200:.0f}", f"--force-device-scale-factor={zoom}"]
    run(folder, "chromium", *options, *size, "--screenshot=a.png", f"file://{folder}/a.svg")
    width, height = (round(side * zoom * 96 / 25.4) for side in (page.width, page.height))
    return grey(folder / "a.png"), (width / page.width, height / page.height)


RASTERS: dict[str, Callable[[Path, Sheet, float], Picture]] = {
    f.__name__.replace("_", "-"): f for f in (own_png, pdftoppm, pdftocairo, rsvg_convert, pdfium, chromium)
}


def available() -> dict[str, Callable[[Path, Sheet, float], Picture]]:
    """The rasters whose program is installed."""
    return {name: f for name, f in RASTERS.items() if name in ("own-png", "pdfium") or shutil.which(name)}


def fitted(picture: Any, scale: tuple[float, float], patch: Patch, k: dict[str, Any]) -> Float:
    """Distance in px, (2,), of a keypoint in a raster from where the sidecar puts it: one Gauss-Newton step."""
    px = np.array(scale)
    centre = np.array([k["page_x_mm"], k["page_y_mm"]]) * px - 0.5
    region = move(patch.black_region, k["page_x_mm"], k["page_y_mm"], k["diameter_mm"] / 2, k["rotate_deg"])
    reach = (patch.extent * k["diameter_mm"] / 2 + 0.3) * px  # cut marks begin 1 mm off
    x0, y0 = np.floor(centre - reach).astype(int)
    x1, y1 = np.ceil(centre + reach).astype(int) + 1
    polygons = [polygon * px - 0.5 for polygon in flatten(region, 1e-3 / px.max())]
    ink = rasterise([polygons], [(x0, y0, x1 - x0, y1 - y0)])[0]
    gy, gx = np.gradient(ink)
    rows, columns = np.nonzero((gx != 0) | (gy != 0))
    gx, gy, ink = (part[rows, columns] for part in (gx, gy, ink))
    u, v = (columns + x0 - centre[0]) / reach[0], (rows + y0 - centre[1]) / reach[1]
    seen = 1 - picture[y0:y1, x0:x1][rows, columns] / 255.0
    design = [-gx, -gy, -gx * u, -gx * v, -gy * u, -gy * v, np.hypot(gx, gy), ink, np.ones_like(ink)]
    return np.linalg.lstsq(np.column_stack(design), seen - ink, rcond=None)[0][:2]


def vectors(sheet: Sheet, folder: Path, known: dict[int, Patch]) -> dict[str, float]:
    """Worst distance in um of a keypoint in each vector format."""
    keypoints = sheet.sidecar["keypoints"]
    expected = [readers.ink_centroid_on_page(known[k["patch_id"]], k) for k in keypoints]
    page = sheet.pages[0]
    contours, _ = readers.dxf_shapes(to_dxf(page), folder / "a.dxf")
    counts = [len(s.region) for s in page.shapes if s.layer == "INK"]
    starts = np.cumsum([0, *counts])
    printed = [s for s in page.shapes if s.layer != "CUT"]
    drawn = readers.pdf_shapes((folder / "a.pdf").read_bytes())[0][0]
    shapes = {
        "SVG": readers.svg_shapes((folder / "a.svg").read_bytes())[0],
        "PDF": [d for d, s in zip(drawn, printed, strict=True) if s.layer == "INK"],
        "DXF": [list(chain.from_iterable(contours[a:b])) for a, b in pairwise(starts)],
    }
    return {
        name: 1e3 * max(np.hypot(*(readers.moments(s)[1] - e)) for s, e in zip(found, expected, strict=True))
        for name, found in shapes.items()
    }


def corner_page(px_mm: float, steps: int = 64) -> Page:
    """Shapes with a left and an upper edge, each at another place within its pixel.

    They are no rectangles, as some programs snap those to whole pixels.
    """
    corners = [(0.0, 0.0), (5.0, 0.0), (5.7, 3.0), (3.0, 5.7), (0.0, 5.0)]
    shapes = []
    for n in range(steps):
        x, y = 20 + 10 * (n % 8) + n / steps, 20 + 10 * (n // 8) + n / steps
        around = [((x + u) * px_mm, (y + v) * px_mm) for u, v in corners]
        shapes.append(Shape((tuple(Line(*a, *b) for a, b in zip(around, around[1:] + around[:1], strict=True)),)))
    return Page(200 * px_mm, 200 * px_mm, tuple(shapes), (), "corners")


def places(picture: Any, steps: int = 64) -> tuple[Float, tuple[int, int]]:
    """Error in px of every edge of :func:`corner_page`, (steps, 2), and how many places in x and in y there are."""
    ink = 1 - picture / 255.0
    seen = []
    for n in range(steps):
        x, y = 20 + 10 * (n % 8), 20 + 10 * (n // 8)
        seen.append(
            [3 - ink[y + 2 : y + 4, x : x + 3].mean(axis=0).sum(), 3 - ink[y : y + 3, x + 2 : x + 4].mean(axis=1).sum()]
        )
    edges = np.array(seen)
    count = [len(np.unique(np.round(edges[:, axis] % 1, 2))) for axis in (0, 1)]
    return edges - np.arange(steps)[:, None] / steps, (count[0], count[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dpi", type=int, default=300)
    parser.add_argument("--only", help="one sheet, by the beginning of its name")
    options = parser.parse_args()
    patches, paper = shipped_patches(), PageFormat(210, 297)
    known = {p.patch_id: p for p in patches}
    sheets = [patch_sheet(patches, 30, paper), board_sheet(grid_board(patches, 4, 3, 30, 60), paper)]
    sheets += [board_sheet(hexagon_board(p, 187.5), paper) for p in patches]
    print(f"{'sheet':<18} {'read by':<14} {'px':>7} {'um':>8}   worst distance of a keypoint from the sidecar")
    for sheet in sheets:
        if options.only and not sheet.name.startswith(options.only):
            continue
        with TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "a.pdf").write_bytes(to_pdf(sheet.pages))
            (folder / "a.svg").write_bytes(to_svg(sheet.pages[0]))
            for kind, worst in vectors(sheet, folder, known).items():
                print(f"{sheet.name:<18} {kind:<14} {'':>7} {worst:>8.4f}", flush=True)
            for reader, render in available().items():
                picture, scale = render(folder, sheet, options.dpi)
                off = [np.hypot(*fitted(picture, scale, known[k["patch_id"]], k)) for k in sheet.sidecar["keypoints"]]
                at = f"{reader} {scale[0] * 25.4:.0f}"
                print(f"{sheet.name:<18} {at:<15} {max(off):>6.4f} {1e3 * max(off) / scale[0]:>8.4f}", flush=True)
    dpi = 96  # one that the screen knows too
    sheet = Sheet("corners", (corner_page(25.4 / dpi),), {})
    print(f"\n{'program':<18} {'places in x':>11} {'in y':>5} {'worst edge px':>14}")
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "a.pdf").write_bytes(to_pdf(sheet.pages))
        (folder / "a.svg").write_bytes(to_svg(sheet.pages[0]))
        for reader, render in available().items():
            errors, (across, down) = places(render(folder, sheet, dpi)[0])
            print(f"{reader:<18} {across:>11} {down:>5} {np.abs(errors).max():>14.3f}", flush=True)


if __name__ == "__main__":
    main()
