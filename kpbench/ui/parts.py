"""What both pages are made of: the frame, the style, tables, and the thread for what takes time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from nicegui import ui
from nicegui.events import GenericEventArguments

from kpbench.text import escape_markup
from kpbench.ui.desk import Desk

Result = TypeVar("Result")
TITLES = {"/": "Design and print", "/detect": "Detect and live"}
"""Title of each page, by address."""
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
    ui.add_css(Path(__file__).with_name("style.css"))
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
