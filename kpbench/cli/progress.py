"""Progress bars: only on a terminal, with rate and time left."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import click

from kpbench.dataset.folder import Dataset
from kpbench.dataset.generation import Recipe, generate, generate_part
from kpbench.workers import Progress, dask_executor


@contextmanager
def progress_bar(total: int | None, what: str) -> Iterator[Progress]:
    """A bar on stderr over ``total`` images; yields the function to call with each advance."""
    from tqdm import tqdm

    with tqdm(total=total, desc=what, unit="img", disable=not sys.stderr.isatty(), dynamic_ncols=True) as bar:

        def advance(images: int) -> None:
            bar.update(images)

        yield advance


def write_dataset(
    recipe: Recipe,
    out: Path,
    what: str,
    *,
    workers: int | None,
    engine: str,
    scheduler: str | None,
    shard_range: tuple[int, int] | None,
    resume: bool,
    overwrite: bool,
) -> None:
    """Make a dataset with a progress bar, and say what it is; the options are those of ``run_options``."""
    if resume and overwrite:
        raise click.UsageError("--resume and --overwrite exclude each other")
    if (engine == "dask") != (scheduler is not None):
        raise click.UsageError("--engine dask and --scheduler ADDR belong together")
    part = range(*shard_range) if shard_range else None
    total = recipe.n if part is None else min(len(part) * recipe.shard_size, recipe.n)
    how: dict[str, Any] = {"workers": workers, "resume": resume, "overwrite": overwrite}
    try:
        with (
            nullcontext() if scheduler is None else dask_executor(scheduler) as executor,
            progress_bar(total, what) as progress,
        ):
            how |= {"executor": executor, "progress": progress}
            if part is not None:
                images = generate_part(recipe, out, part, **how)
                click.echo(f"{out}: {images} images in shards {part.start}:{part.stop}; no manifest yet")
                return
            run = generate(recipe, out, **how)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"finished shards are kept in {out}; the same command with --resume goes on") from None
    if run.broken:
        shown = ", ".join(run.broken[:5]) + (" …" if len(run.broken) > 5 else "")
        click.echo(
            f"kpbench: {len(run.broken)} background files could not be decoded and were passed over: {shown}", err=True
        )
    tell_dataset(run.dataset)


def tell_dataset(dataset: Dataset) -> None:
    """One line about a finished dataset."""
    click.echo(
        f"{dataset.path}: {len(dataset)} images, {len(dataset.shards)} shards, fingerprint {dataset.fingerprint[:16]}"
    )
