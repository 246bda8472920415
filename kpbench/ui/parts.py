"""What both pages are made of: the frame, the style, tables, and the thread for what takes time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

from nicegui import background_tasks, ui
from nicegui.events import GenericEventArguments

from kpbench.text import escape_markup
from kpbench.ui.desk import Desk

Result = TypeVar("Result")
TITLES = {"/": "Design and print", "/detect": "Detect and live"}
"""Title of each page, by address."""
_actions, _measures = ThreadPoolExecutor(1, "kpbench-actions"), ThreadPoolExecutor(1, "kpbench-measures")


async def in_worker(function: Callable[..., Result], *arguments: object, is_measure: bool = False) -> Result:
    """Call a function in a thread; actions and measures one at a time each. The event loop goes on meanwhile."""
    pool = _measures if is_measure else _actions
    return await asyncio.get_running_loop().run_in_executor(pool, lambda: function(*arguments))


class Newest(Generic[Result]):
    """Calls a slow function with the newest value; what was wished while it ran is skipped, but for the last.

    Parameters
    ----------
    wish : callable
        Returns the value that is wished now.
    function : callable
        Coroutine function of the value.
    owner : Element
        Nothing is called once this element is gone.
    """

    def __init__(
        self, wish: Callable[[], Result], function: Callable[[Result], Coroutine[Any, Any, None]], owner: ui.element
    ) -> None:
        self.wish, self.function, self.owner = wish, function, owner
        self.done: object = None
        self.is_busy = False

    def start(self) -> None:
        """Call the function, unless it runs already, and will come to this wish by itself."""
        if not self.is_busy:
            self.is_busy = True
            background_tasks.create(self._run())

    async def _run(self) -> None:
        try:
            while not self.owner.is_deleted and (wanted := self.wish()) != self.done:
                self.done = wanted
                await self.function(wanted)
        finally:
            self.is_busy = False


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
