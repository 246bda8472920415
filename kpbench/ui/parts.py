"""What both pages are made of: the frame, the style, tables, and the thread for what takes time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from nicegui import ui
from nicegui.events import GenericEventArguments

from kpbench.text import escape_markup
from kpbench.ui.desk import Desk

Result = TypeVar("Result")
TITLES = {"/": "Design and print", "/detect": "Detect and live"}
"""Title of each page, by address."""
STYLE = """
:root { --line: #8886; --soft: #8881; }
body { --q-primary: #1a66a8 !important; }
body.body--dark { --q-primary: #74b6f2 !important; }
.q-header { background: #1d3a55; }
.kp-full { width: 100%; }
body { font-size: 15px; }
.nicegui-content { padding: 0; }
main.kp { width: 100%; max-width: 1500px; margin: 0 auto; padding: 16px; display: grid; gap: 16px; align-items: start; }
main.kp.two { grid-template-columns: minmax(330px, 5fr) minmax(0, 7fr); }
main.kp > *, .kp-stack > * { min-width: 0; }
.kp-stack { display: grid; gap: 16px; grid-template-columns: minmax(0, 1fr); }
.kp-card { border: 1px solid var(--line); border-radius: 8px; padding: 14px; display: flex; flex-direction: column;
  gap: 10px; }
.kp-card h2 { font-size: 17px; font-weight: 600; line-height: 1.3; margin: 0; }
.kp-row { display: flex; flex-wrap: wrap; gap: 8px 14px; align-items: center; }
.kp-grow { flex: 1 1 140px; min-width: 0; }
.kp-note { opacity: .75; font-size: 13.5px; }
.kp-problem { color: #b3261e; font-weight: 500; overflow-wrap: anywhere; }
.body--dark .kp-problem { color: #ff9d94; }
.kp-arc { border-top: 1px solid var(--line); padding-top: 8px; }
.kp-tables { display: grid; gap: 14px; grid-template-columns: repeat(auto-fit, minmax(230px, 1fr)); }
.kp table.figures { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
.kp table.figures caption { text-align: left; font-weight: 600; padding-bottom: 4px; }
.kp table.figures th { font-weight: 400; text-align: left; opacity: .8; }
.kp table.figures :is(th, td) { padding: 2px 8px 2px 0; border-bottom: 1px solid var(--line); }
.kp table.figures td { text-align: right; }
.kp table.previews { border-spacing: 8px; }
.kp table.previews img { width: 84px; height: 84px; image-rendering: pixelated; display: block; border-radius: 4px; }
.kp table.previews th { font-weight: 400; font-size: 13.5px; }
.kp-drawing img { width: 240px; max-width: 100%; display: block; border-radius: 6px; }
.kp-card .q-uploader { width: 100%; max-height: none; border: 2px dashed var(--line); background: none; }
.kp-card .q-uploader__header { background: none; color: inherit; }
.kp-card .q-uploader__title { line-height: 1.3; font-size: 15px; white-space: normal; }
.kp-card :is(.q-uploader__subtitle, .q-uploader__list, .q-uploader__header .q-btn) { display: none; }
.kp-sheet { background: #fff; border: 1px solid var(--line); max-width: 380px; width: 100%; }
.kp-picture { width: 100%; background: var(--soft); border-radius: 6px; overflow: hidden; }
.kp-empty { min-height: 180px; display: flex; align-items: center; justify-content: center; text-align: center;
  padding: 20px; }
.kp-nav a { color: inherit; text-decoration: none; padding: 6px 10px; border-radius: 6px; }
.kp-nav a[aria-current] { background: #fff3; text-decoration: underline; }
:focus-visible { outline: 3px solid #f6a700 !important; outline-offset: 2px; }
@media (max-width: 820px) {
  main.kp.two { grid-template-columns: minmax(0, 1fr); }
  main.kp { padding: 10px; }
  .kp-nav { flex-wrap: nowrap; gap: 0; }
  .kp-nav a { padding: 6px; font-size: 14px; white-space: nowrap; }
  .kp table.previews { border-spacing: 3px; }
  .kp table.previews img { width: 66px; height: 66px; }
}
"""

_worker = ThreadPoolExecutor(1, "kpbench-ui")


async def in_worker(function: Callable[..., Result], *arguments: object) -> Result:
    """Call a function in a thread, one at a time. The event loop answers requests meanwhile."""
    return await asyncio.get_running_loop().run_in_executor(_worker, lambda: function(*arguments))


class QuickSlider(ui.slider):
    """A slider that moves at once. NiceGUI's own waits for the server at each step, and loses steps meanwhile."""

    LOOPBACK = False


@contextmanager
def page_frame(desk: Desk, address: str) -> Iterator[None]:
    """Make the frame of a page: its style, the header with links to the pages, and the switch for the dark."""
    ui.page_title(f"{TITLES[address]} - kpbench")
    ui.add_css(STYLE)
    dark = ui.dark_mode(desk.dark)

    def switch(event: GenericEventArguments) -> None:
        desk.dark = dark.value = not event.args

    with ui.header().classes("kp-row"):
        ui.label("kpbench").style("font-weight: 600")
        with ui.element("nav").classes("kp-nav kp-row kp-grow").props('aria-label="pages"'):
            for target, title in TITLES.items():
                ui.link(title, target).props('aria-current="page"' if target == address else "")
        button = ui.button(icon="contrast").props('flat round color=white aria-label="light or dark"')
        button.on("click", switch, js_handler="() => emit(Quasar.Dark.isActive)")
    with ui.element("main").classes("kp two"):
        yield


def figures_table(caption: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as HTML: the first cell of each row is its heading."""
    head = "".join(f'<th scope="col">{escape_markup(name)}</th>' for name in columns)
    lines = []
    for first, *cells in rows:
        values = "".join(f"<td>{escape_markup(cell)}</td>" for cell in cells)
        lines.append(f'<tr><th scope="row">{escape_markup(first)}</th>{values}</tr>')
    return (
        f'<table class="figures"><caption>{escape_markup(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    )
