"""``kpbench train`` and ``kpbench export-model``."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import click

from kpbench.cli.messages import echo
from kpbench.cli.options import BACKGROUNDS, PATCHES

EPOCHS = {"ellipse": 6, "judges": 10}
"""Default of --epochs for each choice of --verifier."""
VERIFIER_ONLY = {"datasets", "test", "epochs", "detector"}
"""Parameters that are accepted only with --verifier."""
SHARED = {"verifier", "out", "init", "workers", "threads"}
"""Parameters that are accepted with and without --verifier."""


@contextmanager
def _needs_torch(command: str) -> Iterator[None]:
    """Turn the error of a missing module into a message with the command that installs the module."""
    try:
        yield
    except ModuleNotFoundError as error:
        message = f"kpbench {command} needs PyTorch: pip install 'kpbench[train]' ({error})"
        raise click.ClickException(message) from None


@click.command()
@click.argument("datasets", nargs=-1, type=click.Path(path_type=Path), metavar="[DATASET]...")
@click.option("--config", help="Recipe: the name of a shipped recipe, such as reference, or a TOML file.")
@click.option(
    "--verifier",
    type=click.Choice(list(EPOCHS)),
    help="Train the verifier's networks on DATASETs, instead of the detector's network.",
)
@click.option(
    "--test",
    type=click.Path(path_type=Path),
    help="With --verifier: dataset for the report, and for the calibration of the ellipse network.",
)
@click.option(
    "--epochs",
    type=click.IntRange(min=0),
    help="With --verifier: passes over the datasets; 0 trains nothing. Default: 6 for ellipse, 10 for judges.",
)
@click.option(
    "--detector",
    type=click.Path(path_type=Path),
    metavar="FILE.onnx",
    help="With --verifier judges: weights of the detector whose candidates are judged. Default: superpoint-small.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Folder of the run. Default: runs/ and the recipe's name; with --verifier: runs/ellipse or runs/judges.",
)
@BACKGROUNDS
@PATCHES
@click.option(
    "--init",
    help="Initial weights: superpoint or superpoint-small (shipped), an exported .onnx, a checkpoint, or SuperPoint's "
    "published weights (.pth, .safetensors). With --verifier, the only choice is: shipped. Default: random weights.",
)
@click.option("--resume", is_flag=True, help="Continue from the checkpoint in --out; --init is ignored.")
@click.option(
    "--minutes", type=click.FloatRange(min=0.0), help="Stop after this time in all. Continue later with --resume."
)
@click.option(
    "--workers",
    type=click.IntRange(min=0),
    help="Number of processes that make samples. Default: 1; with --verifier: one per core.",
)
@click.option("--threads", type=click.IntRange(min=1), help="Number of PyTorch threads. Default: chosen by PyTorch.")
@click.option("--tensorboard", is_flag=True, help="Also write the log for TensorBoard.")
@click.pass_context
def train(
    ctx: click.Context,
    datasets: tuple[Path, ...],
    config: str | None,
    verifier: str | None,
    test: Path | None,
    epochs: int | None,
    detector: Path | None,
    out: Path | None,
    backgrounds: Path | None,
    patches: tuple[Path, ...],
    init: str | None,
    resume: bool,
    minutes: float | None,
    workers: int | None,
    threads: int | None,
    tensorboard: bool,
) -> None:
    """Train the detector's network by a recipe, or the networks that verify its candidates.

    The detector is trained on samples that are made on the fly. An interrupted run can be resumed. On a CPU, a resumed
    run gives the same bits as an uninterrupted run. If the recipe has a table "verifier", the networks that verify
    candidates are then trained too, and all weights lie in the run's folder "weights". With --verifier, these networks
    are trained alone, on synthetic DATASETs.

    \b
    Examples:
      kpbench train --config reference --backgrounds photos/ --minutes 30
      kpbench train --config reference --backgrounds photos/ --resume
      torchrun --nproc-per-node 4 -m kpbench train --config reference --workers 4
      kpbench train --verifier ellipse set-1 set-2 --test set-3
      kpbench train --verifier judges set-1 set-2 --test set-3 --init shipped
    """
    given = {name for name in ctx.params if ctx.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT}
    if verifier is None:
        if misplaced := given & VERIFIER_ONLY:
            raise click.UsageError(f"{_spell(misplaced)} only with --verifier")
        if config is None:
            raise click.UsageError("one of --config and --verifier is missing")
        _train_detector(config, out, backgrounds, patches, init, resume, minutes, workers, threads, tensorboard)
        return
    if misplaced := given - VERIFIER_ONLY - SHARED:
        raise click.UsageError(f"{_spell(misplaced)} not with --verifier")
    if not datasets or test is None:
        raise click.UsageError("--verifier needs at least one DATASET, and --test DATASET")
    if init not in (None, "shipped"):
        raise click.UsageError(f"--init is {init!r}, expected shipped with --verifier")
    if detector is not None and verifier == "ellipse":
        raise click.UsageError("--detector only with --verifier judges")
    _train_verifier(verifier, datasets, test, epochs, detector, out, init is not None, workers, threads)


def _spell(parameters: set[str]) -> str:
    """Return the names of the command's parameters as a user types them."""
    return ", ".join("DATASET" if name == "datasets" else f"--{name}" for name in sorted(parameters))


def _train_detector(
    config: str,
    out: Path | None,
    backgrounds: Path | None,
    patches: tuple[Path, ...],
    init: str | None,
    resume: bool,
    minutes: float | None,
    workers: int | None,
    threads: int | None,
    tensorboard: bool,
) -> None:
    began = time.monotonic()  # before PyTorch is loaded, which takes seconds
    from kpbench.patches.design import load_patches, shipped_patches
    from kpbench.training.recipe import load_recipe

    recipe = load_recipe(config)
    if sys.stderr.isatty():
        echo(f"{recipe.name}: loading PyTorch, making images for the validation", err=True)
    with _needs_torch("train"):
        from kpbench.training.loop import TrainOptions
        from kpbench.training.loop import train as train_network
        from kpbench.training.pipeline import make_weights

    def left() -> float | None:
        return None if minutes is None else minutes - (time.monotonic() - began) / 60

    folder = out or Path("runs") / recipe.name
    designs = load_patches(patches) if patches else shipped_patches()
    processes = 1 if workers is None else workers
    finished = train_network(
        recipe,
        folder,
        backgrounds,
        patches=designs,
        options=TrainOptions(init, resume, left(), processes, threads, tensorboard=tensorboard),
        say=lambda line: echo(line, err=True),
    )
    echo(f"{folder / 'checkpoint.safetensors'}: {'finished' if finished else 'go on with --resume'}")
    if finished and recipe.verifier is not None:
        finished = make_weights(
            recipe, folder, backgrounds, patches=designs, minutes=left(), workers=processes, threads=threads, say=echo
        )
        echo(f"{folder / 'weights'}: {'finished' if finished else 'go on with --resume'}")


def _train_verifier(
    verifier: str,
    datasets: tuple[Path, ...],
    test: Path,
    epochs: int | None,
    detector: Path | None,
    out: Path | None,
    from_shipped: bool,
    workers: int | None,
    threads: int | None,
) -> None:
    from kpbench.dataset.folder import open_dataset
    from kpbench.workers import count_cores

    with _needs_torch("train"):
        from kpbench.training.verifier.ellipse import train_ellipse
        from kpbench.training.verifier.judges import train_judges
    train_it = train_ellipse if verifier == "ellipse" else partial(train_judges, detector=detector)
    train_it(
        [open_dataset(dataset) for dataset in datasets],
        open_dataset(test),
        out or Path("runs") / verifier,
        epochs=EPOCHS[verifier] if epochs is None else epochs,
        from_shipped=from_shipped,
        workers=count_cores() if workers is None else workers,
        threads=threads,
        say=echo,
    )


@click.command("export-model")
@click.argument("checkpoint", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="ONNX file to write.")
@click.option("--int8", is_flag=True, help="Convert an exported ONNX file to 8-bit integers, for CPUs.")
def export_model(checkpoint: Path, out: Path, int8: bool) -> None:
    """Write the trained network as one ONNX file, and compare its output with PyTorch's output.

    With --int8, CHECKPOINT is an ONNX file that export-model wrote.

    \b
    Examples:
      kpbench export-model runs/superpoint-small/checkpoint.safetensors --out superpoint-small.onnx
      kpbench export-model superpoint-small.onnx --int8 --out superpoint-small-int8.onnx
    """
    with _needs_torch("export-model"):
        from kpbench.training.export import export_onnx
        from kpbench.training.quantise import export_int8
    done, other = (export_int8(checkpoint, out), "float32") if int8 else (export_onnx(checkpoint, out), "PyTorch")
    echo(f"{out}: {done.bytes} bytes, step {done.step}, differs from {other} by at most {done.difference:.1e}")
