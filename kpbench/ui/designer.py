"""The state of the page on which patches are designed and printed, without the page."""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from kpbench.analysis.bias import camera_bias
from kpbench.analysis.cell_images import PolarGrid
from kpbench.analysis.identity import correlation_and_distance
from kpbench.analysis.localisation import design_bound
from kpbench.degrade.blurs import gaussian_blur
from kpbench.degrade.effects import noise
from kpbench.files import read_bytes
from kpbench.geometry.camera import Camera, plane_to_camera, rotation_xyz
from kpbench.patches.board import Board
from kpbench.patches.board_file import DEFAULT_DIAMETER_MM, load_boards
from kpbench.patches.design import Patch, SemiCircle, parse_patch, shipped_patches
from kpbench.patches.field import FIELD_COLUMNS, FIELD_ROWS
from kpbench.patches.reference_boards import with_reference
from kpbench.printing.page_format import parse_page_format
from kpbench.printing.prints import print_boards, print_patches
from kpbench.render.placement import Placement
from kpbench.render.scene import render_scene
from kpbench.types import UInt8

PREVIEW_RADII_PX = (5.0, 8.0, 16.0)
"""Radii of the disc in the previews and in the table of bounds, px."""
PREVIEW_VIEWS = ("sharp", "blurred", "tilted", "in noise")
"""Views of a preview: frontal; blurred by a quarter of the radius; tilted by 60 degrees; noise of 40 grey levels."""
PREVIEW_TILT_DEG, PREVIEW_BLUR, PREVIEW_NOISE = 60.0, 0.25, 40.0
SHEETS = ("patches", "hexagon", "grid", "truth", "field")
"""What can be printed: patches to cut out, and boards."""
SHEET_FORMATS = ("pdf", "svg", "png", "dxf")


@dataclass(frozen=True)
class PrintChoice:
    """What to print, as the options of ``kpbench render-patches``.

    Attributes
    ----------
    sheet : str
        One of :data:`SHEETS`.
    designs : {"this", "shipped", "mixed"}
        The edited design; the shipped four; or the shipped four with the edited design in the place of its ID.
    diameter_mm : float or None
        Diameter of the discs. None: the default of the sheet.
    page : str
        Page format, see :func:`kpbench.printing.parse_page_format`.
    rows, columns : int
        Size of a field.
    copies : int
        Copies of each patch to cut out.
    dpi : int
        Resolution of PNG.
    landscape, labels, mirror, invert, reference, tile : bool
        As the options of the command.
    """

    sheet: str = "patches"
    designs: Literal["this", "shipped", "mixed"] = "this"
    diameter_mm: float | None = None
    page: str = "a4"
    rows: int = FIELD_ROWS
    columns: int = FIELD_COLUMNS
    copies: int = 1
    dpi: int = 600
    landscape: bool = False
    labels: bool = True
    mirror: bool = False
    invert: bool = False
    reference: bool = False
    tile: bool = False


def edit_design(design: Patch, **changes: Any) -> Patch:
    """Return a design with other values, checked as those of a file.

    Raises
    ------
    DesignError
        If a value is impossible.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.ui.designer import edit_design
    >>> edit_design(kpbench.shipped_patches()[0], disc="black").disc
    'black'
    """
    return parse_patch(replace(design, **changes).to_dict(), "design")


def edit_semicircle(design: Patch, n: int, **changes: Any) -> Patch:
    """Return a design whose semi-circle ``n`` has other values. See :func:`edit_design`."""
    semicircles = list(design.semicircles)
    semicircles[n] = replace(semicircles[n], **changes)
    return edit_design(design, semicircles=tuple(semicircles))


def add_semicircle(design: Patch) -> Patch:
    """Return a design with one more semi-circle, which inverts half of the disc from 0 degrees on."""
    return edit_design(design, semicircles=(*design.semicircles, SemiCircle(1.0, 0.0, "invert")))


def move_semicircle(design: Patch, n: int, to: int | None) -> Patch:
    """Return a design whose semi-circle ``n`` is painted at place ``to``, or is gone if ``to`` is None."""
    semicircles = list(design.semicircles)
    taken = semicircles.pop(n)
    if to is not None:
        semicircles.insert(max(0, to), taken)
    return edit_design(design, semicircles=tuple(semicircles))


def design_toml(design: Patch) -> bytes:
    """Return the TOML file of a design, which :func:`kpbench.load_patches` reads.

    Examples
    --------
    >>> import kpbench
    >>> from pathlib import Path
    >>> from kpbench.ui.designer import design_toml
    >>> trefoil = kpbench.shipped_patches()[1]
    >>> _ = Path("mine.toml").write_bytes(design_toml(trefoil))
    >>> kpbench.load_patches(["mine.toml"])[0] == trefoil
    True
    """
    lines = []
    for key, value in design.to_dict().items():
        if key == "semicircles":
            entries = [f"    {_inline_table(entry)},\n" for entry in value]
            lines.append(f"semicircles = [\n{''.join(entries)}]" if entries else "semicircles = []")
        else:
            lines.append(f"{key} = {_inline_table(value) if isinstance(value, Mapping) else _toml_value(value)}")
    return ("\n".join(lines) + "\n").encode()


def _inline_table(table: Mapping[str, Any]) -> str:
    return f"{{ {', '.join(f'{key} = {_toml_value(value)}' for key, value in table.items())} }}"


def _toml_value(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)  # a string, a number or true, which TOML writes as JSON does


def draw_preview(design: Patch, radius_px: float, view: str) -> UInt8:
    """Return a design as a camera shows it on mid-grey, ndarray of shape (S, S), uint8.

    Parameters
    ----------
    design : Patch
    radius_px : float
    view : str
        One of :data:`PREVIEW_VIEWS`.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.ui.designer import draw_preview
    >>> draw_preview(kpbench.shipped_patches()[0], 8.0, "in noise").shape
    (27, 27)
    """
    side = 2 * int(np.ceil(1.35 * radius_px * design.extent + 2)) + 1
    camera = Camera(side, side, 8 * radius_px)
    tilt_deg = PREVIEW_TILT_DEG if view == "tilted" else 0.0
    pose = plane_to_camera(rotation_xyz(0.0, tilt_deg, 0.0), [0.0, 0.0, 8.0])  # one disc radius is the unit of length
    background = np.full((side, side), 128, np.uint8)
    image = render_scene(background, [Placement(design, camera.K @ pose, 40.0, 220.0)]).image
    if view == "blurred":
        return gaussian_blur(image, PREVIEW_BLUR * radius_px)
    return noise(image, np.random.default_rng(0), PREVIEW_NOISE) if view == "in noise" else image


@dataclass(frozen=True)
class QuickMeasures:
    """What is measured of a design while it is edited.

    Attributes
    ----------
    bounds_px : dict of float to (float, float)
        Cramér-Rao bound of the centre in the worst direction by radius of the disc: frontal, and tilted by 60 degrees.
    bias_px : dict of str to (float, float)
        Bias by effect of a camera: for a fit that takes the camera for linear, and for one with an unknown tone curve.
    """

    bounds_px: dict[float, tuple[float, float]]
    bias_px: dict[str, tuple[float, float]]


def measure_quickly(design: Patch) -> QuickMeasures:
    """Return bounds and biases of a design, as :func:`kpbench.analysis.analyse_patches` measures them."""
    grid = PolarGrid.of([design])
    inks = grid.inks([design])

    def bound(radius_px: float, tilt_deg: float) -> float:
        return float(design_bound(grid, inks, radius_px, tilt_deg)[0][0])

    bounds = {radius_px: (bound(radius_px, 0.0), bound(radius_px, PREVIEW_TILT_DEG)) for radius_px in PREVIEW_RADII_PX}
    plain, toned = camera_bias(design), camera_bias(design, knows_tone=True)
    return QuickMeasures(bounds, {name: (plain[name], toned[name]) for name in plain})


def distances_to(design: Patch, others: Sequence[Patch]) -> dict[str, float]:
    """Return the smallest distance of a design to each other design, in ink contrasts, by name.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.ui.designer import distances_to
    >>> checker, trefoil, *_ = kpbench.shipped_patches()
    >>> round(distances_to(checker, [trefoil])["trefoil"], 3)
    0.215
    """
    if not others:
        return {}
    grid = PolarGrid.of([design, *others])
    _, distance = correlation_and_distance(grid, grid.inks([design, *others]))
    return {other.name: float(value) for other, value in zip(others, distance[0, 1:], strict=True)}


def other_designs(design: Patch) -> tuple[Patch, ...]:
    """Return the shipped designs that a design stands beside: those of other ink."""
    return tuple(patch for patch in shipped_patches() if patch.digest != design.digest)


def chosen_designs(design: Patch, choice: PrintChoice) -> tuple[Patch, ...]:
    """Return the designs to print, in the order of their IDs."""
    if choice.designs == "this":
        return (design,)
    by_id = {patch.patch_id: patch for patch in shipped_patches()}
    if choice.designs == "mixed":
        by_id[design.patch_id] = design
    return tuple(by_id[patch_id] for patch_id in sorted(by_id))


def chosen_boards(design: Patch, choice: PrintChoice) -> tuple[Board, ...]:
    """Return the boards to print; none for patches to cut out.

    Raises
    ------
    DesignError
        If the board is impossible.
    """
    if choice.sheet == "patches":
        return ()
    patches = chosen_designs(design, choice)
    boards = load_boards(choice.sheet, patches, choice.diameter_mm, rows=choice.rows, columns=choice.columns)
    return tuple(map(with_reference, boards)) if choice.reference else boards


def print_files(design: Patch, choice: PrintChoice, formats: Sequence[str]) -> dict[str, bytes]:
    """Return the files that ``kpbench render-patches`` writes, by name.

    Raises
    ------
    DesignError
        If the sheet is impossible, or does not fit the page.

    Examples
    --------
    >>> import kpbench
    >>> from kpbench.ui.designer import PrintChoice, print_files
    >>> list(print_files(kpbench.shipped_patches()[0], PrintChoice("hexagon", page="a3"), ["svg"]))
    ['hexagon-checker.svg', 'hexagon-checker.json']
    """
    page = parse_page_format(choice.page, choice.landscape, choice.labels, choice.mirror, choice.invert)
    layout: dict[str, Any] = {"page": page, "formats": formats, "dpi": choice.dpi}
    with tempfile.TemporaryDirectory() as folder:
        if boards := chosen_boards(design, choice):
            files = print_boards(boards, folder, tile=choice.tile, **layout)
        else:
            diameter_mm = choice.diameter_mm or DEFAULT_DIAMETER_MM
            patches = chosen_designs(design, choice)
            files = print_patches(patches, folder, diameter_mm=diameter_mm, copies=choice.copies, **layout)
        return {path.name: read_bytes(path, is_noted=False) for path in files}


def download_of(design: Patch, choice: PrintChoice, form: str) -> tuple[str, bytes]:
    """Return name and content of a download: one file, or a ZIP archive of several.

    Parameters
    ----------
    form : str
        One of :data:`SHEET_FORMATS`; "json" for the sidecars; "toml" for the edited design.
    """
    if form == "toml":
        return f"{design.name}.toml", design_toml(design)
    made = print_files(design, choice, ["svg" if form == "json" else form])
    files = {name: content for name, content in made.items() if Path(name).suffix == f".{form}"}
    if len(files) == 1:
        return next(iter(files.items()))
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in files.items():
            file.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)  # which has a fixed date
    return f"{choice.sheet}-{form}.zip", archive.getvalue()
