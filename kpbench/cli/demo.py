"""``kpbench demo``."""

from __future__ import annotations

from pathlib import Path

import click

from kpbench.cli.messages import echo
from kpbench.cli.options import BACKGROUNDS


@click.command()
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("kpbench-demo"),
    show_default=True,
    help="Folder to write into.",
)
@click.option("--n", type=click.IntRange(1, 100_000), default=100, show_default=True, help="Number of images.")
@click.option("--detector", default="superpoint-small", show_default=True, help="Detector, as for kpbench detect.")
@BACKGROUNDS
@click.pass_context
def demo(ctx: click.Context, out: Path, n: int, detector: str, backgrounds: Path | None) -> None:
    """Print, synthesise, detect and score: the whole chain with few images, in about a minute.

    \b
    Examples:
      kpbench demo
    """
    from kpbench.detectors.interface import load_detector
    from kpbench.files import require_own_folder
    from kpbench.writing import require_writable

    require_own_folder(out, ["print"], "the demo")
    load_detector(detector)  # which fails before the images are made, if it fails
    data, preds = out / "data", out / "preds.json"
    for file, kind in ((preds, "predictions"), (out / "contact-sheet.png", "picture"), (out / "scores.json", "scores")):
        if file.exists():
            require_writable(file, kind)
    photographs = ["--backgrounds", str(backgrounds)] if backgrounds else []
    steps = [
        ("print the patches", ["render-patches", "--pdf", "--png", "--dpi", "150", "--out", str(out / "print")]),
        ("synthesise images", ["synth", "--n", str(n), "--out", str(data), "--overwrite", *photographs]),
        ("draw a contact sheet", ["preview", str(data), "--out", str(out / "contact-sheet.png")]),
        ("detect", ["detect", str(data), "--detector", detector, "--out", str(preds)]),
        ("score", ["score", str(preds), "--json", str(out / "scores.json")]),
    ]
    kpbench = ctx.find_root().command
    for title, arguments in steps:
        echo()
        echo(f"{title}: kpbench {' '.join(arguments)}", bold=True)
        with kpbench.make_context("kpbench", arguments, parent=ctx.parent) as step:
            kpbench.invoke(step)
    echo()
    echo("Open:", bold=True)
    for name, content in (
        ("print/patches.pdf", "the print sheet"),
        ("contact-sheet.png", "images with their true keypoints"),
        ("scores.json", "all scores"),
    ):
        echo(f"  {out / name}  {content}")
