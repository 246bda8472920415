"""Progress bars: only on a terminal, with rate and time left."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from kpbench.pipeline import Recipe, generate
from kpbench.workers import Progress

__all__ = ["progress_bar", "write_dataset"]


@contextmanager
def progress_bar(total: int | None, what: str) -> Iterator[Progress]:
    """A bar on stderr over ``total`` images; yields the function to call with each advance."""
    from tqdm import tqdm

    with tqdm(total=total, desc=what, unit="img", disable=not sys.stderr.isatty(), dynamic_ncols=True) as bar:

        def advance(images: int) -> None:
            bar.update(images)

        yield advance


def write_dataset(recipe: Recipe, out: Path, workers: int | None, resume: bool, overwrite: bool, what: str) -> None:
    """Make a dataset with a progress bar, and say what it is."""
    if resume and overwrite:
        raise click.UsageError("--resume and --overwrite exclude each other")
    try:
        with progress_bar(recipe.n, what) as progress:
            run = generate(recipe, out, workers=workers, resume=resume, overwrite=overwrite, progress=progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"finished shards are kept in {out}; the same command with --resume goes on") from None
    if run.broken:
        shown = ", ".join(run.broken[:5]) + (" …" if len(run.broken) > 5 else "")
        click.echo(
            f"kpbench: {len(run.broken)} background files could not be decoded and were passed over: {shown}", err=True
        )
    dataset = run.dataset
    click.echo(
        f"{dataset.path}: {len(dataset)} images, {len(dataset.shards)} shards, fingerprint {dataset.fingerprint[:16]}"
    )
