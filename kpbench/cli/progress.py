"""The progress bar of the commands: only on a terminal, with rate and time left."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from kpbench.workers import Progress


@contextmanager
def progress_bar(total: int | None, title: str) -> Iterator[Progress]:
    """Show a bar on stderr over ``total`` images; yield the function that advances the bar by a number of images."""
    from tqdm import tqdm

    with tqdm(total=total, desc=title, unit="img", disable=not sys.stderr.isatty(), dynamic_ncols=True) as bar:

        def advance(images: int) -> None:
            bar.update(images)

        yield advance
