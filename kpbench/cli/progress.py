"""The progress bar of the commands, with rate and time left. The bar is shown on a terminal only."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from kpbench.workers import Progress


@contextmanager
def progress_bar(total: int | None, title: str, unit: str = "img", shown: bool = True) -> Iterator[Progress]:
    """Show a progress bar on stderr. Yield the function that advances the bar by a number of units.

    ``unit`` names what the bar counts; the default is images. ``total`` is the number of units, or None if unknown.
    """
    from tqdm import tqdm

    with tqdm(
        total=total, desc=title, unit=unit, disable=not (shown and sys.stderr.isatty()), dynamic_ncols=True
    ) as bar:

        def advance(count: int) -> None:
            bar.update(count)

        yield advance
