"""Progress bars: only on a terminal, with rate and time left."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from kpbench.pipeline import Progress

__all__ = ["progress_bar"]


@contextmanager
def progress_bar(total: int, what: str) -> Iterator[Progress]:
    """A bar on stderr over ``total`` images; yields the function to call with each advance."""
    from tqdm import tqdm

    with tqdm(total=total, desc=what, unit="img", disable=not sys.stderr.isatty(), dynamic_ncols=True) as bar:

        def advance(images: int) -> None:
            bar.update(images)

        yield advance
