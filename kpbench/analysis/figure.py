"""Figure of an analysis: a page with each design, its image in a camera, its measures and its distances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpbench.analysis.cell_images import WINDOW_PX, PolarGrid, render_polygons
from kpbench.analysis.measures import Analysis, DesignMeasures
from kpbench.geometry.outline import Arc, circle, move, rectangle
from kpbench.patches.design import Patch
from kpbench.printing.page import Page, Shape, Text

FIGURE_SUFFIXES = (".svg", ".png", ".pdf")
"""Suffixes of files that a figure can be written to."""
PAGE_WIDTH = 210.0  # all lengths in mm
ROW, TOP, LEFT = 42.0, 14.0, 6.0  # height of a row, top of the first row, left border of the first column
FONT = 2.6
ICON = 13.0  # radius of the outline of a design
DOT = 1.9  # side of the square for a black pixel of the image
BAR, BAR_STEP = 36.0, 4.6  # length of a full bar, and distance from one bar to the bar below
BARS_X, PAIRS_X = 82.0, 146.0  # left borders of the column of measures and of the column of other designs
FULL_BOUND_PX, FULL_DISTANCE = 0.03, 0.3  # values at which a bar reaches its full length
MOST_OTHERS = 6  # largest number of other designs in a row


def draw_designs(analysis: Analysis, patches: Sequence[Patch]) -> Page:
    """Return a page with one row per design: outline, image at 5 px radius, bounds and basin, distances to others."""
    shapes: list[Shape] = []
    texts: list[Text] = []
    for x, title in (
        (LEFT, "design"),
        (LEFT + 2 * ICON + 4, f"at {WINDOW_PX:g} px radius"),
        (BARS_X, "bound, px (short is good); basin (long)"),
        (PAIRS_X, "distance to the others (long is good)"),
    ):
        texts.append(Text(title, x, TOP - 5, FONT))
    for n, (patch, design) in enumerate(zip(patches, analysis.designs, strict=True)):
        top = TOP + n * ROW
        shapes += _icon(patch, LEFT + ICON, top + ICON) + _pixels(patch, LEFT + 2 * ICON + 4, top + 1)
        texts.append(Text(f"{design.patch_id} {design.name}", LEFT, top + 2 * ICON + 5, 1.3 * FONT))
        texts.append(Text(_summary(design), LEFT, top + 2 * ICON + 9.5, FONT))
        bars = [(f"r = {r:g} px", design.bound_at(r).worst_px, FULL_BOUND_PX) for r in design.sizes_px]
        least = design.sizes_px[0]
        bars += [(f"r = {least:g} px, tilted 60 deg", design.bound_at(least, 60.0).worst_px, FULL_BOUND_PX)]
        bars += [("basin", design.basin, FULL_DISTANCE)]
        others = [
            (f"{other.patch_id} {other.name}", float(analysis.distance[n, k]), FULL_DISTANCE)
            for k, other in enumerate(analysis.designs)
            if k != n
        ]
        for x, rows in ((BARS_X, bars), (PAIRS_X, others[:MOST_OTHERS])):
            for k, (label, value, full) in enumerate(rows):
                y = top + 2 + k * BAR_STEP
                width = BAR * float(np.clip(value / full, 0.005, 1.0))
                shapes.append(Shape(rectangle(x, y + 0.6, width, 1.2)))
                texts.append(Text(f"{label}: {value:.3g}", x, y, FONT))
    return Page(
        PAGE_WIDTH, TOP + len(patches) * ROW, tuple(shapes), tuple(texts), "kpbench design analysis", "kpbench.figure/1"
    )


def _summary(design: DesignMeasures) -> str:
    orientation = {0: "any orientation", 1: "unique orientation"}.get(
        design.symmetry_order, f"looks the same {design.symmetry_order} times a turn"
    )
    centre = "crossing" if design.centre_is_crossing else "no crossing"
    return f"{centre}, {orientation}, needs {design.pixels_needed:.1f} px"


def _icon(patch: Patch, x: float, y: float) -> list[Shape]:
    """Return the design with a hairline around it."""
    hairline = (*circle(x, y, ICON + 0.1), (Arc(x, y, ICON, 0.0, -360.0),))
    return [Shape(move(patch.black_region, x, y, ICON / patch.extent)), Shape(hairline)]


def _pixels(patch: Patch, x: float, y: float) -> list[Shape]:
    """Return one black square per pixel, larger for darker pixels. The surroundings of the design are mid-grey."""
    half = int(WINDOW_PX) + 1
    grid = PolarGrid.of([patch])
    pose = np.array([[[WINDOW_PX, 0, 0], [0, WINDOW_PX, 0]]])
    cells = render_polygons(grid.cell_polygons(0.002), pose, half)[0]
    dark = grid.inks([patch])[0] @ cells + 0.5 * (1 - np.minimum(cells.sum(0), 1.0))
    shapes = []
    for row, column in np.ndindex(2 * half + 1, 2 * half + 1):
        side = DOT * float(np.sqrt(dark[row * (2 * half + 1) + column]))
        if side > 0.05:
            centre = (x + (column + 0.5) * DOT, y + (row + 0.5) * DOT)
            shapes.append(Shape(rectangle(centre[0] - side / 2, centre[1] - side / 2, side, side)))
    return shapes
