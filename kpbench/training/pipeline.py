"""The rest of a recipe: from a trained network to all weights of a detector.

:func:`make_weights` exports the network, makes synthetic datasets, and trains the networks of the verification on them.
Each step leaves files. A run that was stopped goes on after the last finished step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from kpbench.camera.preset import load_camera_preset
from kpbench.dataset.folder import Dataset, open_dataset
from kpbench.dataset.generation import generate
from kpbench.detectors.verification import ELLIPSE, SECOND_JUDGE
from kpbench.errors import DataError
from kpbench.files import make_folder, read_bytes
from kpbench.patches.design import Patch
from kpbench.render.placement import Limits
from kpbench.synth.synthetic import SynthConfig
from kpbench.training.export import export_onnx
from kpbench.training.quantise import export_int8
from kpbench.training.recipe import Recipe, VerifierSet
from kpbench.training.verifier.ellipse import train_ellipse
from kpbench.training.verifier.judges import train_judges
from kpbench.writing import write_file

WEIGHTS_FOLDER, SETS_FOLDER, FIRST_FOLDER = "weights", "sets", "first-judges"
"""Folders within the folder of a training: the weights that are kept, the datasets, and the first judges."""


def make_weights(
    recipe: Recipe,
    folder: Path,
    backgrounds: str | Path | None,
    *,
    patches: tuple[Patch, ...],
    minutes: float | None = None,
    workers: int = 1,
    threads: int | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> bool:
    """Make all weights of a detector from the finished checkpoint of a training.

    1. The network is exported, as float32 and in 8-bit integers.
    2. The datasets of the recipe are made.
    3. The ellipse network is trained on the candidates of the new network.
    4. Judges are trained on first looks alone, on the first datasets.
    5. The judges that are kept are trained on poses that the judges of step 4 have corrected. Their threshold is placed
       on the test dataset, whose photographs trained nothing.

    The folder ``weights`` then holds a detector: ``NAME-int8.onnx`` with the networks beside it.

    Parameters
    ----------
    recipe : Recipe
        With a table ``verifier``.
    folder : Path
        Folder of the training, which holds ``checkpoint.safetensors``.
    backgrounds : path, optional
        Folder of photographs. None: procedural backgrounds.
    patches : tuple of Patch
        The designs.
    minutes : float, optional
        No step begins after this time.
    workers : int
        Number of worker processes that make images and hypotheses.
    threads : int, optional
        Threads of PyTorch.
    say : callable
        Receives lines for the user.

    Returns
    -------
    bool
        Whether all steps are finished.

    Raises
    ------
    DataError
        If the recipe has no table ``verifier``, or a step cannot read or write its files.

    Examples
    --------
    >>> from pathlib import Path
    >>> from kpbench import shipped_patches
    >>> from kpbench.training import load_recipe, make_weights
    >>> recipe, folder = load_recipe("reference"), Path("runs/superpoint-small")
    >>> make_weights(recipe, folder, "photos", patches=shipped_patches(), say=print)  # doctest: +SKIP
    True
    """
    if recipe.verifier is None:
        raise DataError(f"recipe {recipe.name}: it has no table `verifier`")
    config, began = recipe.verifier, time.monotonic()
    weights, first = make_folder(folder / WEIGHTS_FOLDER), folder / FIRST_FOLDER
    network, small = weights / f"{recipe.name}.onnx", weights / f"{recipe.name}-int8.onnx"
    ellipse = partial(train_ellipse, detector=small, workers=workers, threads=threads, say=say)
    judges = partial(train_judges, detector=small, workers=workers, threads=threads, say=say)

    def data(part: VerifierSet) -> Dataset:
        photo_part = "validation" if part is config.test else "training"
        return _make_dataset(part, folder / SETS_FOLDER, backgrounds, photo_part, patches, workers)

    def train_ellipses() -> None:
        ellipse([data(s) for s in config.sets], data(config.test), weights, epochs=config.ellipse_epochs)

    def train_first_judges() -> None:
        sets = [data(s) for s in config.sets[: config.first_sets]]
        judges(sets, data(config.test), make_folder(first), weights=weights, epochs=config.judge_epochs)
        write_file(first / f"{ELLIPSE}.onnx", read_bytes(weights / f"{ELLIPSE}.onnx"))

    def train_kept_judges() -> None:
        sets, kept = [data(s) for s in config.sets], partial(judges, alarms_per_image=config.alarms_per_image)
        kept(sets, data(config.test), weights, weights=first, epochs=config.judge_epochs)

    steps: list[tuple[Path, Callable[[], object]]] = [
        (network, lambda: export_onnx(folder / "checkpoint.safetensors", network)),
        (small, lambda: export_int8(network, small)),
        *((_dataset_folder(s, folder / SETS_FOLDER) / "dataset.json", partial(data, s)) for s in config.sets),
        (weights / f"{ELLIPSE}.onnx", train_ellipses),
        (first / f"{ELLIPSE}.onnx", train_first_judges),
        (weights / f"{SECOND_JUDGE}.onnx", train_kept_judges),
    ]
    for made, step in steps:
        if made.exists():
            continue
        if minutes is not None and time.monotonic() - began > 60 * minutes:
            return False
        step()
        say(f"{made}: made")
    return True


def _dataset_folder(part: VerifierSet, folder: Path) -> Path:
    radii = "-".join(f"{px:g}" for px in part.radius_px)
    camera = Path(part.camera).stem
    return folder / f"{part.deteriorate}-{camera}-{radii or 'usual'}-{part.seed}"


def _make_dataset(
    part: VerifierSet,
    folder: Path,
    backgrounds: str | Path | None,
    photo_part: str,
    patches: tuple[Patch, ...],
    workers: int,
) -> Dataset:
    """Make the dataset of a set, or open it if it has been made; an unfinished one is continued."""
    out = _dataset_folder(part, folder)
    if (out / "dataset.json").exists():
        return open_dataset(out)
    config = SynthConfig(
        part.images,
        seed=part.seed,
        size_px=part.size,
        deteriorate=part.deteriorate,
        backgrounds=None if backgrounds is None else Path(backgrounds),
        photo_part=photo_part,
        distractors=part.distractors,
        camera=None if part.camera == "none" else load_camera_preset(part.camera),
        limits=Limits.of_radius(*part.radius_px) if part.radius_px else Limits(),
        patches=patches,
    )
    make_folder(folder)
    return generate(config, out, workers=max(workers, 1), resume=out.exists()).dataset
