"""Commands that make the weights of the reference detector."""

from __future__ import annotations

from pathlib import Path

import click

from kpbench.cli.options import PATCHES

INSTALL = "needs PyTorch: pip install 'kpbench[train]'"


@click.command()
@click.option("--config", type=click.Path(path_type=Path), required=True, help="Recipe, TOML.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the run; default: runs/NAME of the recipe.")
@click.option("--backgrounds", type=click.Path(path_type=Path), help="Folder of photographs; else procedural ones.")
@PATCHES
@click.option(
    "--init",
    type=click.Path(path_type=Path),
    help="Weights to start from: superpoint or superpoint-small (those that ship), an exported .onnx, a checkpoint, "
    "or SuperPoint's (.pth, .safetensors).",
)
@click.option("--resume", is_flag=True, help="Go on from the checkpoint in the folder, whatever --init says.")
@click.option("--minutes", type=click.FloatRange(min=0.0), help="Stop after this time; --resume goes on later.")
@click.option("--workers", type=click.IntRange(min=0), default=1, show_default=True, help="Processes making samples.")
@click.option("--threads", type=click.IntRange(min=1), help="Threads of PyTorch.")
@click.option("--tensorboard", is_flag=True, help="Write the log for TensorBoard too.")
def train(
    config: Path,
    out: Path | None,
    backgrounds: Path | None,
    patches: tuple[Path, ...],
    init: Path | None,
    resume: bool,
    minutes: float | None,
    workers: int,
    threads: int | None,
    tensorboard: bool,
) -> None:
    """Train the detector on samples that are made on the fly; any run can be resumed to the bit.

    \b
    Examples:
      kpbench train --config configs/reference.toml --backgrounds photos/ --minutes 30
      kpbench train --config configs/reference.toml --backgrounds photos/ --resume
      torchrun --nproc-per-node 4 -m kpbench train --config configs/reference.toml --workers 4
    """
    from kpbench.patches.design import load_patches, shipped_patches
    from kpbench.training.recipe import load_recipe

    recipe = load_recipe(config)
    try:
        from kpbench.training import loop as training
    except ModuleNotFoundError as error:
        raise click.ClickException(f"kpbench train {INSTALL} ({error})") from None
    folder = out or Path("runs") / recipe.name
    finished = training.train(
        recipe,
        folder,
        backgrounds,
        init=init,
        resume_run=resume,
        minutes=minutes,
        workers=workers,
        threads=threads,
        tensorboard=tensorboard,
        patches=load_patches(patches) if patches else shipped_patches(),
        say=lambda line: click.echo(line, err=True),
    )
    click.echo(f"{folder / 'checkpoint.safetensors'}: {'finished' if finished else 'go on with --resume'}")


@click.command("export-model")
@click.argument("checkpoint", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="ONNX file to write.")
@click.option("--int8", is_flag=True, help="Write an exported ONNX file again in 8-bit integers, for processors.")
def export_model(checkpoint: Path, out: Path, int8: bool) -> None:
    """Write the trained network as one ONNX file, and check it against PyTorch.

    With --int8 that file is read instead of a checkpoint.

    \b
    Examples:
      kpbench export-model runs/superpoint-small/checkpoint.safetensors --out superpoint-small.onnx
      kpbench export-model superpoint-small.onnx --int8 --out superpoint-small-int8.onnx
    """
    try:
        from kpbench.training.export import export
        from kpbench.training.quantise import export_int8
    except ModuleNotFoundError as error:
        raise click.ClickException(f"kpbench export-model {INSTALL} ({error})") from None
    from kpbench.errors import DataError
    from kpbench.files import refuse_overwrite

    if out.suffix != ".onnx":
        raise DataError(f"{out}: expected a name ending in .onnx")
    if int8 != (checkpoint.suffix == ".onnx"):
        needed = "--int8 takes the .onnx file of export-model, not a checkpoint" if int8 else "is exported already"
        raise DataError(f"{checkpoint}: {needed}; export-model makes CHECKPOINT to .onnx, and --int8 that to integers")
    refuse_overwrite([out], [checkpoint])
    done, model = (export_int8(checkpoint, out), "float32") if int8 else (export(checkpoint, out), "PyTorch")
    click.echo(f"{out}: {done.bytes} bytes, step {done.step}, differs from {model} by at most {done.difference:.1e}")
