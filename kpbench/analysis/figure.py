"""The design analysis as one page: each design, how a camera sees it, its measures, its look-alikes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kpbench.analysis.cell_images import SEEN_PX, Grid, images
from kpbench.analysis.measures import SIZES_PX, Analysis, DesignReport
from kpbench.geometry.outline import Arc, circle, move, rectangle
from kpbench.patches.design import Patch
from kpbench.printing.page import Page, Shape, Text

ROW, TOP, LEFT = 42.0, 14.0, 6.0  # mm
FONT = 2.6
ICON = 13.0  # radius
DOT = 1.9  # side of a seen pixel
BAR, BAR_STEP = 36.0, 4.6
BARS_X, PAIRS_X = 82.0, 146.0
FIGURE_SUFFIXES = (".svg", ".png", ".pdf")
"""Suffixes of files that a figure can be written to."""
FULL_BOUND_PX, FULL_DISTANCE = 0.03, 0.3  # what a whole bar stands for


def design_figure(analysis: Analysis, patches: Sequence[Patch]) -> Page:
    """One row a design: its outline, its image at 5 px radius, bounds and basin, distances to the others."""
    shapes: list[Shape] = []
    texts: list[Text] = []
    for x, title in (
        (LEFT, "design"),
        (LEFT + 2 * ICON + 4, f"at {SEEN_PX:g} px radius"),
        (BARS_X, "bound, px (short is good); basin (long)"),
        (PAIRS_X, "distance to the others (long is good)"),
    ):
        texts.append(Text(title, x, TOP - 5, FONT))
    for n, (patch, report) in enumerate(zip(patches, analysis.designs, strict=True)):
        top = TOP + n * ROW
        shapes += _icon(patch, LEFT + ICON, top + ICON) + _pixels(patch, LEFT + 2 * ICON + 4, top + 1)
        texts.append(Text(f"{report.patch_id} {report.name}", LEFT, top + 2 * ICON + 5, 1.3 * FONT))
        texts.append(Text(_line(report), LEFT, top + 2 * ICON + 9.5, FONT))
        bars = [(f"r = {r:g} px", report.bound_at(r).worst_px, FULL_BOUND_PX) for r in SIZES_PX]
        bars += [(f"r = {SIZES_PX[0]:g} px, tilted 60 deg", report.bound_at(SIZES_PX[0], 60.0).worst_px, FULL_BOUND_PX)]
        bars += [("basin", report.basin, FULL_DISTANCE)]
        others = [
            (f"{other.patch_id} {other.name}", float(analysis.distance[n, k]), FULL_DISTANCE)
            for k, other in enumerate(analysis.designs)
            if k != n
        ]
        for x, rows in ((BARS_X, bars), (PAIRS_X, others[:6])):
            for k, (label, value, full) in enumerate(rows):
                y = top + 2 + k * BAR_STEP
                width = BAR * float(np.clip(value / full, 0.005, 1.0))
                shapes.append(Shape(rectangle(x, y + 0.6, width, 1.2)))
                texts.append(Text(f"{label}: {value:.3g}", x, y, FONT))
    return Page(210.0, TOP + len(patches) * ROW, tuple(shapes), tuple(texts), "kpbench design analysis")


def _line(report: DesignReport) -> str:
    orientation = {0: "any orientation", 1: "unique orientation"}.get(
        report.symmetry_order, f"looks the same {report.symmetry_order} times a turn"
    )
    centre = "crossing" if report.centre_is_crossing else "no crossing"
    return f"{centre}, {orientation}, needs {report.pixels_needed:.1f} px"


def _icon(patch: Patch, x: float, y: float) -> list[Shape]:
    """The design, with a hairline around it."""
    hairline = (*circle(x, y, ICON + 0.1), (Arc(x, y, ICON, 0.0, -360.0),))
    return [Shape(move(patch.black_region, x, y, ICON / patch.extent)), Shape(hairline)]


def _pixels(patch: Patch, x: float, y: float) -> list[Shape]:
    """Squares as large as each pixel is dark: black ink, its surroundings a mid-grey."""
    half = int(SEEN_PX) + 1
    grid = Grid.of([patch])
    pose = np.array([[[SEEN_PX, 0, 0], [0, SEEN_PX, 0]]])
    cells = images(grid.cells(0.002), pose, half)[0]
    dark = grid.inks([patch])[0] @ cells + 0.5 * (1 - np.minimum(cells.sum(0), 1.0))
    shapes = []
    for row, column in np.ndindex(2 * half + 1, 2 * half + 1):
        side = DOT * float(np.sqrt(dark[row * (2 * half + 1) + column]))
        if side > 0.05:
            centre = (x + (column + 0.5) * DOT, y + (row + 0.5) * DOT)
            shapes.append(Shape(rectangle(centre[0] - side / 2, centre[1] - side / 2, side, side)))
    return shapes
