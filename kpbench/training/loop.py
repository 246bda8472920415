"""The training loop. Worker processes make the samples while the network is trained.

A recipe is a TOML file (:mod:`kpbench.training.recipe`). A recipe counts progress in samples, and therefore means the
same on one processor and on eight accelerators. Recipe and step determine a batch. A training that is resumed from a
checkpoint (:mod:`kpbench.training.checkpoint`) therefore ends in the same weights, to the bit, as an uninterrupted
training.

Under ``torchrun`` with n processes, each process takes 1/n of the samples of each step, and gradients are averaged.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import nn

from kpbench.errors import DataError
from kpbench.files import make_folder
from kpbench.locks import lock_folder
from kpbench.patches.design import Patch, shipped_patches
from kpbench.signals import handle_end_signals
from kpbench.training.batches import Batch, BatchJob, load_photos, training_batches
from kpbench.training.checkpoint import TrainingState, restore_state, save_checkpoint, start_state
from kpbench.training.process_group import ProcessGroup, join_process_group
from kpbench.training.recipe import Recipe
from kpbench.training.run_log import LossMeter, Timer, open_log, training_bar
from kpbench.training.step import train_step
from kpbench.training.validation import ValidationSets, estimate_validation_s, make_validation_sets, validate_network
from kpbench.training.weights import load_initial_weights

SAVE_EVERY_S, REPORT_EVERY_S = 300.0, 20.0
"""Time between checkpoints, s, and time between log lines with losses, s."""


@dataclass(frozen=True)
class TrainOptions:
    """Options of a training: where it starts, when it stops, and how it uses the machine.

    Attributes
    ----------
    init : path, optional
        Weights to start from: ``superpoint`` or ``superpoint-small`` (the shipped weights), an exported ONNX file, a
        checkpoint, or published SuperPoint weights. None: random weights. A resumed training ignores ``init``.
    resume : bool
        Resume from the checkpoint in the output folder.
    minutes : float, optional
        Minutes after which this run stops, with its checkpoint and its last validation. The training can be resumed
        later. None: the run lasts until the recipe is finished.
    workers : int
        Number of worker processes that make samples; 0: the training process makes the samples.
    threads : int, optional
        Number of threads of PyTorch; None: PyTorch chooses.
    validate_every : float
        Minutes between validations.
    validation_images : int
        Number of images in each validation set of whole images. The validation set of crops has eight times this
        number.
    tensorboard : bool
        Also write the log in TensorBoard's format.

    Examples
    --------
    >>> from kpbench.training import TrainOptions
    >>> TrainOptions(minutes=30).workers
    1
    """

    init: str | Path | None = None
    resume: bool = False
    minutes: float | None = None
    workers: int = 1
    threads: int | None = None
    validate_every: float = 15.0
    validation_images: int = 32
    tensorboard: bool = False


def train(
    recipe: Recipe,
    out: str | Path,
    backgrounds: str | Path | None = None,
    *,
    patches: Sequence[Patch] = shipped_patches(),
    options: TrainOptions = TrainOptions(),
    say: Callable[[str], None] = lambda line: None,
) -> bool:
    """Train the detector's network, or resume a training.

    The folder ``out`` receives the checkpoint ``checkpoint.safetensors`` and the log ``log.jsonl``.

    Parameters
    ----------
    recipe : Recipe
    out : path
        Folder for the checkpoint and the log.
    backgrounds : path, optional
        Folder of photographs; every tenth photograph is kept for validation. None: procedural textures.
    patches : sequence of Patch
        The designs, one per channel of the ID head.
    options : TrainOptions
    say : callable
        Receives lines for the user.

    Returns
    -------
    bool
        True if the recipe is finished, False if the time limit stopped the training.

    Raises
    ------
    DataError
        If recipe, designs, checkpoint, folder and initial weights do not fit together, or if a file cannot be read.
    KeyboardInterrupt
        If a signal ended the training. The checkpoint is written before this exception is raised.

    Examples
    --------
    >>> from kpbench.training import NetworkConfig, Phase, Recipe, TrainOptions, train
    >>> network = NetworkConfig((4, 4, 8, 8), (1, 1, 1, 1), head_width=8, descriptor_width=8)
    >>> recipe = Recipe("tiny", (Phase(4),), network=network, batch=4)
    >>> train(recipe, "run", options=TrainOptions(workers=0, validation_images=1))
    True
    """
    training = _Training(recipe, Path(out), backgrounds, tuple(patches), options, join_process_group())
    training.check()
    leads = training.group.rank == 0
    signals = list[int]()
    with lock_folder(make_folder(training.folder)) if leads else nullcontext(), handle_end_signals(signals.append):
        training.check()  # again, because another run may have written a checkpoint before the lock was taken
        state = training.begin(say)
        training.run(state, signals)
    if signals:
        raise KeyboardInterrupt(
            f"{training.checkpoint} is at step {state.step}; the same command with `resume` goes on"
        )
    return state.step >= recipe.steps


@dataclass(frozen=True)
class _Training:
    """Everything about a training that does not change during the training."""

    recipe: Recipe
    folder: Path
    backgrounds: str | Path | None
    designs: tuple[Patch, ...]
    options: TrainOptions
    group: ProcessGroup
    began: float = field(default_factory=time.monotonic)

    @property
    def checkpoint(self) -> Path:
        return self.folder / "checkpoint.safetensors"

    def check(self) -> None:
        """Raise an error if recipe, designs, number of processes and folder do not fit together."""
        ids, count = self.recipe.network.ids, len(self.designs)
        if count != ids:
            raise DataError(f"the network tells {ids} patches apart, but there are {count} designs")
        if self.recipe.batch % self.group.size:
            raise DataError(f"batch is {self.recipe.batch}, expected a multiple of the {self.group.size} processes")
        if self.checkpoint.exists() and not self.options.resume:
            raise DataError(f"{self.checkpoint}: there is a training in this folder; use `resume`, or another folder")
        if self.options.resume and not self.checkpoint.exists():
            raise DataError(f"{self.checkpoint}: nothing to go on from yet; leave `resume` out")

    def begin(self, say: Callable[[str], None]) -> TrainingState:
        """Return the state from which the run starts: random weights, initial weights, or the checkpoint."""
        if self.options.threads:
            torch.set_num_threads(self.options.threads)
        state = start_state(self.recipe, self.group.device)
        if self.options.resume:
            restore_state(state, self.checkpoint, self.designs)
        elif self.options.init is not None:
            init, device = self.options.init, self.group.device
            say(load_initial_weights(state, init, self.designs, self.backgrounds, device))
        return state

    def run(self, state: TrainingState, signals: Sequence[int]) -> None:
        """Train until the recipe is finished, the time limit is reached, or a signal comes.

        Checkpoints, validations and log lines are written at regular intervals.
        """
        group, options, leads = self.group, self.options, self.group.rank == 0
        validation = self.make_validation() if leads else []
        validation_s = 0.0 if options.minutes is None else estimate_validation_s(state.mean, validation)
        forward: nn.Module = torch.compile(state.network) if self.recipe.compile else state.network  # type: ignore[assignment]
        before = state.seconds
        stop_s = None if options.minutes is None else 60 * options.minutes - validation_s
        with (
            open_log(self.folder, leads, options.tensorboard) as record,
            training_bar(state, leads, stop_s) as advance,
        ):
            saving, reporting, validating = (
                Timer(SAVE_EVERY_S),
                Timer(REPORT_EVERY_S),
                Timer(60 * options.validate_every),
            )
            meter = LossMeter(state, group.device, self.began)
            for batch in self.batches(state):
                images, keypoints = (torch.from_numpy(part).to(group.device) for part in batch)
                meter.add(train_step(state, forward, images, keypoints, group))
                elapsed = time.monotonic() - self.began
                state.seconds = before + elapsed
                stop = group.any_of(bool(signals) or (stop_s is not None and elapsed > stop_s))
                advance(state.step, elapsed)
                last = stop or state.step == self.recipe.steps
                if last or reporting.due():
                    figures = meter.read(state)
                    advance(state.step, elapsed, f"loss {figures['loss']:.4f} id {figures['id_loss']:.4f}")
                    record(state, figures)
                    reporting.restart()
                if leads and (last or saving.due()):
                    save_checkpoint(state, self.checkpoint, self.designs)
                    saving.restart()
                if leads and (last or validating.due()):
                    record(state, validate_network(state.mean, validation))
                    validating.restart()
                if stop:
                    break

    def make_validation(self) -> ValidationSets:
        """Return the validation sets; their backgrounds are the validation photographs."""
        photos = load_photos(self.backgrounds, "validation")
        return make_validation_sets(self.recipe, self.designs, photos, self.options.validation_images)

    def batches(self, state: TrainingState) -> Iterator[Batch]:
        """Return the batches that this process trains on, from the step of ``state`` to the end of the recipe."""
        recipe, group = self.recipe, self.group
        jobs = (
            BatchJob(step * group.size + group.rank, recipe.batch // group.size, recipe.phase(step)[1])
            for step in range(state.step, recipe.steps)
        )
        workers = self.options.workers
        return training_batches(recipe.samples, self.designs, self.backgrounds, recipe.seed, jobs, workers)
