"""The progress bar of the commands: only on a terminal, with rate and time left."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from kpbench.workers import Progress


@contextmanager
def progress_bar(total: int | None, title: str, unit: str = "img", shown: bool = True) -> Iterator[Progress]:
    """Show a bar on stderr over ``total`` images; yield the function that advances the bar by a number of images.

    ``unit`` names another thing than images that the bar counts. ``total`` is None if their number is not known.
    """
    from tqdm import tqdm

    with tqdm(
        total=total, desc=title, unit=unit, disable=not (shown and sys.stderr.isatty()), dynamic_ncols=True
    ) as bar:

        def advance(count: int) -> None:
            bar.update(count)

        yield advance
