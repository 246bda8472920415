"""The command that verifies submissions to the leaderboard."""

from __future__ import annotations

import json
from pathlib import Path

import click

from kpbench.cli.messages import echo
from kpbench.cli.options import BACKGROUNDS, WORKERS, Finite
from kpbench.cli.score import FILE

VERIFICATION_SCHEMA = "kpbench.verification/1"


@click.command()
@click.argument("action", type=click.Choice(["verify"]))
@click.argument("submission", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--out", type=click.Path(path_type=Path), default=Path("kpbench-verify"), show_default=True,
              help="Folder for the images, which are made anew; finished images in it are kept.")  # fmt: skip
@click.option("--percent", type=Finite(min=0, min_open=True, max=100), default=2.0, show_default=True,
              help="Share of the images on which a detector runs again.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the choice of images. Default: one nobody foresees.")
@click.option("--detector", "detectors", multiple=True, metavar="NAME=LOAD",
              help="How to load a detector that does not ship with kpbench; repeatable.")  # fmt: skip
@click.option("--json", "json_file", type=FILE, help="Write what was verified.")
@BACKGROUNDS
@WORKERS
def leaderboard(
    action: str,
    submission: Path,
    out: Path,
    percent: float,
    seed: int | None,
    detectors: tuple[str, ...],
    json_file: Path | None,
    backgrounds: Path | None,
    workers: int | None,
) -> None:
    """Verify the scores in a folder of kpbench bench by running their detectors again.

    The images are made anew, and their fingerprint is compared. The scores must follow from the predictions. The
    detector runs again on a random part of the images, and must find the same. The exit code is 1 if scores are
    refuted. Code that a submission names is not run, unless --detector says so.

    \b
    Examples:
      kpbench leaderboard verify kpbench-bench
      kpbench leaderboard verify theirs --percent 5 --json verified.json
      kpbench leaderboard verify theirs --detector MyDetector=my_module:MyDetector
    """
    from kpbench.benchmark.rerun import verify_submission
    from kpbench.cli.progress import progress_bar
    from kpbench.writing import require_writable, write_file

    if json_file is not None:
        require_writable(json_file, "verification")
    pairs = [text.partition("=") for text in detectors]
    if any(not name or not load for name, _, load in pairs):
        raise click.UsageError("--detector expects NAME=LOAD, such as MyDetector=my_module:MyDetector")
    with progress_bar(None, "images") as progress:
        found = verify_submission(
            submission,
            out,
            percent=percent,
            seed=seed,
            detectors={name: load for name, _, load in pairs},
            backgrounds=backgrounds,
            workers=workers,
            progress=progress,
        )
    for entry in found:
        verdict = f"refuted: {entry.problem}" if entry.problem else f"verified on {len(entry.images)} images"
        echo(f"{entry.suite} {entry.detector}: {verdict} (seed {entry.seed})")
    if json_file is not None:
        content = {"schema": VERIFICATION_SCHEMA, "results": [entry.to_dict() for entry in found]}
        write_file(json_file, json.dumps(content, indent=1).encode())
    if any(entry.problem for entry in found):
        raise SystemExit(1)
