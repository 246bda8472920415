"""The page on which patches are designed and printed."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from nicegui import ui

from kpbench.errors import KpbenchError
from kpbench.images import encode_png
from kpbench.patches.design import INKS, Patch, shipped_patches
from kpbench.patches.symmetry import pose_problem
from kpbench.printing.page_format import PAGE_SIZES_MM
from kpbench.types import UInt8
from kpbench.ui.designer import (
    PREVIEW_RADII_PX,
    PREVIEW_VIEWS,
    SHEET_FORMATS,
    SHEETS,
    PrintChoice,
    QuickMeasures,
    add_semicircle,
    chosen_boards,
    distances_to,
    download_of,
    draw_preview,
    edit_design,
    edit_semicircle,
    measure_quickly,
    move_semicircle,
    other_designs,
    print_files,
)
from kpbench.ui.desk import Desk
from kpbench.ui.parts import Newest, QuickSlider, figures_table, in_worker

DRAWING_RADIUS_PX = 120.0
"""Radius of the disc in the large drawing, px."""
MOST_MEASURED = 8
"""Largest number of semi-circles of a design that is measured: the time grows with its square."""
DESIGN_CHOICES = {"this": "this design", "shipped": "the shipped four", "mixed": "the four, this one by its ID"}
SHEET_NAMES = dict(
    zip(SHEETS, ("patches to cut out", "hexagon board", "grid board", "truth board", "field"), strict=True)
)
SWITCHES = {
    "landscape": "landscape",
    "labels": "labels",
    "reference": "reference marks",
    "tile": "several pages",
    "mirror": "mirror",
    "invert": "invert",
}


class DesignPage:
    """The page. It shows the design and the print of a desk, and changes them."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        with ui.element("section").classes("kp-card"):
            ui.html("<h2>Design</h2>", sanitize=False)
            shipped = {patch.patch_id: patch.name for patch in shipped_patches()}
            ui.select(shipped, label="Start from", on_change=lambda event: self.start_from(event.value)).classes(
                "kp-full"
            )
            self.controls = ui.column().classes("kp-full").style("gap: 8px")
            add = partial(self.edit, add_semicircle, True)
            ui.button("Add a semi-circle", icon="add", on_click=add).props("outline")
            self.problem = ui.label().classes("kp-problem").props('role="alert"')
        with ui.element("div").classes("kp-stack"):
            with ui.element("section").classes("kp-card kp"):
                ui.html("<h2>As a camera sees it</h2>", sanitize=False)
                with ui.element("div").classes("kp-row").style("align-items: flex-start"):
                    self.drawing = ui.html("", sanitize=False).classes("kp-drawing")
                    self.previews = ui.html("", sanitize=False).props('data-kp="previews"')
                ui.label("Rows: radius of the disc. Tilted by 60°, noise of 40 grey levels.").classes("kp-note")
            with ui.element("section").classes("kp-card kp"):
                ui.html("<h2>How exact, how distinct</h2>", sanitize=False)
                self.measures = ui.html("", sanitize=False).props('data-kp="measures" aria-live="polite"')
            self._make_print()
        self.printer = Newest(lambda: (desk.design, desk.choice), self.show_sheet, self.sheet)
        self.measurer = Newest(lambda: desk.design, self.show_measures, self.measures)
        self.show_controls()
        self.refresh()

    def show_controls(self) -> None:
        """Make the controls of the design anew."""
        design, inks = self.desk.design, ["white", "black"]
        width: dict[str, Any] = {"min": 0, "max": 2, "step": 0.05}
        self.controls.clear()
        with self.controls:
            with ui.element("div").classes("kp-row kp-full"):
                self._bind(ui.input("Name", value=design.name), "name")
                self._bind(ui.number("ID", value=design.patch_id, min=0, max=32767, precision=0), "patch_id")
                self._bind(ui.select(inks, label="Disc", value=design.disc), "disc")
            with ui.element("div").classes("kp-row kp-full"):
                self._bind(ui.number("Rim (radii)", value=design.rim, **width), "rim")
                self._bind(ui.select(inks, label="Ink of the rim", value=design.rim_ink), "rim_ink")
                self._bind(ui.number("Quiet zone (radii)", value=design.quiet_zone, **width), "quiet_zone")
            for n in range(len(design.semicircles)):
                with (
                    ui.element("div").classes("kp-arc kp-full").props(f'role="group" aria-label="semi-circle {n + 1}"')
                ):
                    self._make_semicircle(n)

    def _bind(self, control: Any, key: str) -> None:
        control.classes("kp-grow").on_value_change(lambda event: self.change(**{key: event.value}))

    def _make_semicircle(self, n: int) -> None:
        """Make the controls of a semi-circle."""
        semicircle, last = self.desk.design.semicircles[n], len(self.desk.design.semicircles) - 1
        self._make_slider(n, "radius", semicircle.radius, 0.01, 1.0, 0.01, "Radius")
        self._make_slider(n, "start_deg", semicircle.start_deg, -180.0, 180.0, 1.0, "Start (°)")
        with ui.element("div").classes("kp-row"):
            ink = ui.toggle(list(INKS), value=semicircle.ink).props("dense no-caps").classes("kp-grow")
            ink.on_value_change(lambda event: self.change_semicircle(n, ink=event.value))
            up, down, away = (partial(move_semicircle, n=n, to=to) for to in (n - 1, n + 1, None))
            moves = (("arrow_upward", up, "up", n > 0), ("arrow_downward", down, "down", n < last))
            for icon, move, where, is_possible in (*moves, ("delete", away, "away", True)):
                button = ui.button(icon=icon, on_click=partial(self.edit, move, True)).props("flat round dense")
                name = f"remove semi-circle {n + 1}" if where == "away" else f"move semi-circle {n + 1} {where}"
                button.props(f'aria-label="{name}"').set_enabled(is_possible)

    def _make_slider(self, n: int, key: str, value: float, low: float, high: float, step: float, title: str) -> None:
        """Make a number and a slider for one value of a semi-circle. The number takes any value, the slider some."""
        with ui.element("div").classes("kp-row").style("flex-wrap: nowrap"):
            number = ui.number(title, value=value, step=step, format="%.6g").props("dense").style("width: 96px")
            slider = QuickSlider(min=low, max=high, step=step, value=value).classes("kp-grow")
            slider.props(f'aria-label="{title} of semi-circle {n + 1}"')
        slider.on_value_change(lambda event: number.set_value(event.value))
        number.on_value_change(lambda event: None if event.value is None else slider.set_value(event.value))
        number.on_value_change(lambda event: self.change_semicircle(n, **{key: event.value}))

    def start_from(self, patch_id: int) -> None:
        """Take a shipped design, with its name and ID."""
        self.edit(lambda _: next(patch for patch in shipped_patches() if patch.patch_id == patch_id), True)

    def change_semicircle(self, n: int, **values: Any) -> None:
        """Change values of a semi-circle."""
        if None not in values.values():
            self.edit(partial(edit_semicircle, n=n, **values))

    def change(self, **values: Any) -> None:
        """Change values of the whole design."""
        if None not in values.values():
            self.edit(partial(edit_design, **values))

    def edit(self, change: Callable[[Patch], Patch], is_rebuilt: bool = False) -> None:
        """Change the design, if the change is possible, and show what follows."""
        try:
            design = change(self.desk.design)
        except KpbenchError as error:
            self.problem.text = str(error)
            return
        self.problem.text = ""
        if design != self.desk.design:
            self.desk.design = design
            self.refresh()
            if is_rebuilt:
                self.show_controls()

    def refresh(self) -> None:
        """Show the design, and measure and print it anew."""
        design = self.desk.design
        self.drawing.content = _picture(draw_preview(design, DRAWING_RADIUS_PX, "sharp"), f"the design {design.name}")
        head = "".join(f'<th scope="col">{view}</th>' for view in PREVIEW_VIEWS)
        rows = []
        for radius_px in PREVIEW_RADII_PX:
            cells = (
                f"<td>{_picture(draw_preview(design, radius_px, view), f'{radius_px:g} px, {view}')}</td>"
                for view in PREVIEW_VIEWS
            )
            rows.append(f'<tr><th scope="row">{radius_px:g} px</th>{"".join(cells)}</tr>')
        self.previews.content = f'<table class="previews"><tr><td></td>{head}</tr>{"".join(rows)}</table>'
        self.printer.start()
        self.measurer.start()

    async def show_measures(self, design: Patch) -> None:
        """Show bounds and biases, and then distances, unless the design has changed meanwhile."""
        if len(design.semicircles) > MOST_MEASURED:
            self.measures.content = f"Designs of more than {MOST_MEASURED} semi-circles are not measured here."
            return
        quick = await in_worker(measure_quickly, design, is_measure=True)
        self.measures.content = _measure_tables(design, quick, None)
        if self.desk.design == design:
            distances = await in_worker(distances_to, design, other_designs(design), is_measure=True)
            self.measures.content = _measure_tables(design, quick, distances)

    def _make_print(self) -> None:
        """Make the card of the print."""
        choice = self.desk.choice
        with ui.element("section").classes("kp-card kp"):
            ui.html("<h2>Print</h2>", sanitize=False)
            with ui.element("div").classes("kp-row"):
                sheet = ui.select(SHEET_NAMES, label="Sheet", value=choice.sheet)
                self._field(sheet, "sheet")
                self._field(ui.select(DESIGN_CHOICES, label="Designs", value=choice.designs), "designs")
                self._field(
                    ui.number("Diameter (mm)", placeholder="usual", value=choice.diameter_mm, min=0.1, max=5000).props(
                        "stack-label"
                    ),
                    "diameter_mm",
                )
                self._field(ui.input("Page", value=choice.page, autocomplete=list(PAGE_SIZES_MM)), "page")
            with ui.element("div").classes("kp-row"):
                for key, title, most in (
                    ("copies", "Copies", 1000),
                    ("rows", "Rows", 100),
                    ("columns", "Columns", 100),
                ):
                    number = ui.number(title, value=getattr(choice, key), min=1, max=most, precision=0)
                    self._field(number, key)
                    number.bind_visibility_from(sheet, "value", value="patches" if key == "copies" else "field")
                self._field(ui.number("PNG: dots per inch", value=choice.dpi, min=36, max=1200, precision=0), "dpi")
            with ui.element("div").classes("kp-row"):
                for key, title in SWITCHES.items():
                    self._field(ui.checkbox(title, value=getattr(choice, key)), key, "")
            self.print_problem = ui.label().classes("kp-problem").props('role="alert"')
            self.print_note = ui.label().classes("kp-note")
            self.sheet = ui.html("", sanitize=False).props('data-kp="sheet"')
            with ui.element("div").classes("kp-row"):
                for form in (*SHEET_FORMATS, "json", "toml"):
                    button = ui.button(form, icon="download", on_click=partial(self.download, form)).props("outline")
                    button.props(f'aria-label="download {form}"')
            ui.label("Print at 100 % (no scaling), then measure both rulers.").classes("kp-note")
            ui.label("JSON: the sidecar, which tells where the points are. TOML: the design.").classes("kp-note")

    def _field(self, control: Any, key: str, classes: str = "kp-grow") -> None:
        control.classes(classes).on_value_change(lambda event: self.choose(key, event.value))

    def choose(self, key: str, value: Any) -> None:
        """Change what is printed."""
        whole = key in ("rows", "columns", "copies", "dpi")
        if value is None and key != "diameter_mm":
            return
        change: dict[str, Any] = {key: int(value) if whole else value}
        self.desk.choice = replace(self.desk.choice, **change)
        self.printer.start()

    async def show_sheet(self, wanted: tuple[Patch, PrintChoice]) -> None:
        """Show the first page, or why it cannot be printed."""
        try:
            design, choice = wanted
            files = await in_worker(print_files, design, choice, ["svg"])
            problems = [problem for board in chosen_boards(design, choice) if (problem := pose_problem(board))]
        except KpbenchError as error:
            self.print_problem.text, self.print_note.text, self.sheet.content = _said_here(error), "", ""
            return
        pages = [name for name in files if name.endswith(".svg")]
        self.print_problem.text = ""
        count = f"{len(pages)} pages; the first: " if len(pages) > 1 else ""
        self.print_note.text = f"{count}{pages[0]}" + (f"; the pose is not unique: {problems[0]}" if problems else "")
        address = self.desk.offer(pages[0], files[pages[0]])
        self.sheet.content = f'<img class="kp-sheet" src="{address}" alt="the printed page">'

    async def download(self, form: str) -> None:
        """Send a file to the browser."""
        try:
            name, content = await in_worker(download_of, self.desk.design, self.desk.choice, form)
        except KpbenchError as error:
            self.print_problem.text = _said_here(error)
            return
        ui.download.from_url(self.desk.offer(name, content), name)


def _said_here(error: KpbenchError) -> str:
    """Return a message with what the page calls an argument of Python."""
    return str(error).replace("`tile=True`", f"'{SWITCHES['tile']}'")


def _picture(image: UInt8, text: str) -> str:
    content = base64.b64encode(encode_png(image, "preview")).decode()
    return f'<img src="data:image/png;base64,{content}" alt="{text}">'


def _measure_tables(design: Patch, quick: QuickMeasures, distances: dict[str, float] | None) -> str:
    """Return the measures of a design as HTML."""
    bounds = [(f"{px:g} px radius", f"{a:.4f}", f"{b:.4f}") for px, (a, b) in quick.bounds_px.items()]
    bias = [(name, f"{a:.3f}", f"{b:.3f}") for name, (a, b) in quick.bias_px.items()]
    found = distances or {}
    away = [(name, f"{value:.3f}") for name, value in sorted(found.items(), key=lambda item: item[1])]
    turns = design.symmetry_order
    facts = [
        ("edges cross at the centre", "yes" if design.centre_is_crossing else "no"),
        (
            "looks the same in",
            "every turn" if turns == 0 else f"{turns} of its turns" if turns > 1 else "one turn only",
        ),
    ]
    tables = [
        figures_table("Cramér-Rao bound of the centre, px", ("", "frontal", "60° tilt"), bounds),
        figures_table("Bias by a camera at 20 px radius, px", ("", "linear fit", "tone fitted"), bias),
        figures_table("Distance to other designs, ink contrasts" + (" …" if distances is None else ""), ("", ""), away),
        figures_table("Shape", ("", ""), facts),
    ]
    note = "Noise of 10, contrast of 180 grey levels. A distance of 0.1 is a difference of 18 grey levels."
    cells = "".join(f"<div>{table}</div>" for table in tables)
    return f'<div class="kp-tables">{cells}</div><p class="kp-note">{note}</p>'
