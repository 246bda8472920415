"""Training: one loop over samples that are made on the fly, resumable to the bit.

A recipe is a TOML file (:mod:`kpbench.training`). Progress is counted in samples, so that a recipe says the
same on one processor and on eight accelerators. A checkpoint is one safetensors file with the weights,
their running mean, the optimizer's moments and, as JSON, the recipe and the number of steps; batches are
a function of (recipe, seed, step), hence nothing else is needed to go on as if nothing had happened.

Under ``torchrun`` each process takes every n-th batch and gradients are averaged; nothing else differs.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from kpbench.errors import DataError
from kpbench.files import make_folder
from kpbench.patches.design import Patch, shipped_patches
from kpbench.training.batches import Job, load_photos, make_batch, training_batches
from kpbench.training.checkpoint import State, designs_digest, read_checkpoint, save_checkpoint
from kpbench.training.losses import losses, make_targets
from kpbench.training.network import SuperPoint
from kpbench.training.recipe import Recipe, parse_recipe
from kpbench.training.validation import evaluate, validation_set
from kpbench.training.weights import grow, initial_weights, initialise, is_folded, restore_batchnorm

SAVE_EVERY = 5.0
"""Minutes between checkpoints."""


# State and checkpoints ---------------------------------------------------------------------------------


def start(recipe: Recipe, device: torch.device) -> State:
    """A fresh network, its weights a function of the recipe's seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        network = SuperPoint(recipe.network)
        mean = SuperPoint(recipe.network)
    network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    mean.to(device, memory_format=torch.channels_last).requires_grad_(False).eval()  # type: ignore[call-overload]
    mean.load_state_dict(network.state_dict())
    kind = torch.optim.Adam if recipe.optimizer == "adam" else torch.optim.AdamW
    optimizer = kind(
        network.parameters(), lr=recipe.lr, weight_decay=recipe.weight_decay, fused=device.type == "cuda" or None
    )
    return State(recipe, network, mean, optimizer)


def resume(state: State, path: Path, patches: Sequence[Patch]) -> None:
    """Put a checkpoint into a freshly started state.

    Raises
    ------
    DataError
        If it cannot be read, or belongs to another recipe or other designs.
    """
    content, tensors = read_checkpoint(path)
    theirs = parse_recipe(content["recipe"], str(path))
    changed = [f.name for f in fields(Recipe) if getattr(theirs, f.name) != getattr(state.recipe, f.name)]
    if changed:
        raise DataError(f"{path}: was trained with another {' and '.join(changed)}; use another folder with --out")
    if content["designs"] != designs_digest(patches):
        raise DataError(f"{path}: was trained on other patch designs; use another folder with --out")

    def part(name: str) -> dict[str, Tensor]:
        return {key.removeprefix(name): value for key, value in tensors.items() if key.startswith(name)}

    state.network.load_state_dict(part("network."))
    state.mean.load_state_dict(part("mean."))
    moments = part("optimizer.")
    for name, parameter in state.network.named_parameters():
        own = {key: moments[f"{key}.{name}"] for key in ("step", "exp_avg", "exp_avg_sq") if f"{key}.{name}" in moments}
        if own:
            like = torch.empty_like(parameter)  # keeps the memory format, on which rounding may depend
            on_device = {key: value if key == "step" else like.clone().copy_(value) for key, value in own.items()}
            if parameter.device.type == "cuda":
                on_device["step"] = on_device["step"].to(parameter.device)
            state.optimizer.state[parameter] = on_device
    state.step, state.seconds = content["step"], content["seconds"]


# The loop ----------------------------------------------------------------------------------------------


def _blob(images: Tensor) -> Tensor:
    """Images (B, H, W) uint8 as the network takes them."""
    return (images.float() / 255)[:, None].contiguous(memory_format=torch.channels_last)


def step_once(state: State, forward: nn.Module, images: Tensor, keypoints: Tensor, world: int) -> tuple[Tensor, Tensor]:
    """One step of the optimizer; (detector loss, identity loss)."""
    recipe, network = state.recipe, state.network
    phase, _ = recipe.phase(state.step)
    network.requires_grad_(phase.trains == "all")
    for parameter in network.attached:
        parameter.requires_grad_(True)
    network.train(phase.trains == "all")  # a frozen trunk keeps its BatchNorm statistics too
    for group in state.optimizer.param_groups:
        group["lr"] = recipe.rate(state.step)

    height, width = images.shape[-2:]
    device = images.device
    blob = _blob(images)
    with torch.autocast(device.type, torch.bfloat16, enabled=recipe.precision == "bf16"):
        detector, ids = forward(blob)
    targets = make_targets(keypoints, height, width, recipe.network.ids, recipe.loss.place)
    located, identified = losses(detector, ids, targets, recipe.loss)
    state.optimizer.zero_grad(set_to_none=True)
    (located + recipe.loss.identity_weight * identified).backward()  # type: ignore[no-untyped-call]
    if world > 1:
        _average_gradients(network, world)
    state.optimizer.step()
    _follow(state)
    state.step += 1
    return located.detach(), identified.detach()


def _average_gradients(network: nn.Module, world: int) -> None:
    """Mean over all processes, as one message."""
    gradients = [p.grad for p in network.parameters() if p.grad is not None]
    flat = torch.cat([g.flatten() for g in gradients])
    dist.all_reduce(flat)
    flat /= world
    for gradient, part in zip(gradients, torch.split(flat, [g.numel() for g in gradients]), strict=True):
        gradient.copy_(part.view_as(gradient))


@torch.no_grad()
def _follow(state: State) -> None:
    """Move the running mean towards the weights; faster at first, when there is little to remember."""
    decay = min(state.recipe.ema, (1 + state.step) / (10 + state.step))
    mine, theirs = state.mean.state_dict(), state.network.state_dict()
    real = [k for k in mine if mine[k].is_floating_point()]
    torch._foreach_lerp_([mine[k] for k in real], [theirs[k] for k in real], 1 - decay)


@contextlib.contextmanager
def _stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C and SIGTERM end the loop after the step in hand; yields "was there one?"."""
    seen = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield seen.is_set
        return
    before = {s: signal.signal(s, lambda *_: seen.set()) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield seen.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def train(
    recipe: Recipe,
    out: str | Path,
    backgrounds: str | Path | None = None,
    *,
    init: str | Path | None = None,
    resume_run: bool = False,
    minutes: float | None = None,
    workers: int = 1,
    threads: int | None = None,
    validate_every: float = 15.0,
    validation_images: int = 32,
    tensorboard: bool = False,
    patches: Sequence[Patch] = shipped_patches(),
    say: Callable[[str], None] = lambda line: None,
) -> bool:
    """Train, or go on training; writes ``checkpoint.safetensors`` and ``log.jsonl`` into a folder.

    Parameters
    ----------
    recipe : Recipe
    out : path
    backgrounds : path, optional
        Folder of photographs; every tenth is kept for validation. None: procedural textures.
    init : path, optional
        What to start from, see :func:`initial_weights`; a checkpoint that is resumed has weights of its own.
    resume_run : bool
        Go on from the checkpoint in ``out``.
    minutes : float, optional
        Stop after this time; the rest of the recipe can be trained later.
    workers : int
        Processes that make samples; 0: none but this one.
    threads : int, optional
        Threads of torch.
    validate_every : float
        Minutes between validations.
    validation_images : int
        Whole images that are validated on, each with and without deteriorations; see :func:`validation_set`.
    tensorboard : bool
        Write the log for TensorBoard too.
    patches : sequence of Patch
        The designs, one a channel of the ID head.
    say : callable
        Receives lines for the user.

    Returns
    -------
    bool
        Whether the recipe is finished.

    Raises
    ------
    DataError
        On anything that does not fit: recipe, checkpoint, folder, initial weights.
    KeyboardInterrupt
        After a checkpoint, if a signal ended the loop.
    """
    began = time.monotonic()
    rank, world, device = _place()
    if threads:
        torch.set_num_threads(threads)
    designs = tuple(patches)
    folder = Path(out)
    checkpoint = folder / "checkpoint.safetensors"
    if len(designs) != recipe.network.ids:
        raise DataError(f"the network tells {recipe.network.ids} patches apart, but there are {len(designs)} designs")
    if recipe.batch % world:
        raise DataError(f"batch is {recipe.batch}, expected a multiple of the {world} processes")
    if checkpoint.exists() and not resume_run:
        raise DataError(f"{checkpoint}: there is a training in this folder; use --resume, or another folder")
    if resume_run and not checkpoint.exists():
        raise DataError(f"{checkpoint}: nothing to go on from yet; leave --resume out")
    make_folder(folder)
    state = start(recipe, device)
    if resume_run:
        resume(state, checkpoint, designs)
    elif init is not None:
        say(_begin_from(init, state.network, recipe, designs, backgrounds, device))
        state.mean.load_state_dict(state.network.state_dict())
    held_out = load_photos(backgrounds, "validation") if rank == 0 else []
    validation = validation_set(recipe, designs, held_out, validation_images) if rank == 0 else None
    jobs = (
        Job(step * world + rank, recipe.batch // world, recipe.phase(step)[1])
        for step in range(state.step, recipe.steps)
    )
    forward: nn.Module = torch.compile(state.network) if recipe.compile else state.network  # type: ignore[assignment]

    with (
        _recorder(folder, rank == 0, tensorboard) as record,
        _bar(state, rank) as advance,
        _stop_on_signal() as signalled,
    ):
        saved = validated = noted = time.monotonic()
        before, first = state.seconds, state.step
        sums, since = torch.zeros(2, device=device), state.step
        for batch in training_batches(recipe.samples, designs, backgrounds, recipe.seed, jobs, workers):
            images, keypoints = (torch.from_numpy(part).to(device) for part in batch)
            pair = step_once(state, forward, images, keypoints, world)
            sums += torch.stack(pair)
            now = time.monotonic()
            state.seconds = before + now - began
            stop = _agree(signalled() or (minutes is not None and now - began > 60 * minutes), world, device)
            if now - noted > 20 or stop or state.step == recipe.steps:
                located, identified = (sums / (state.step - since)).tolist()
                rate = (state.step - first) * recipe.batch / (now - began)
                advance(state.step, f"{located:.4f} {identified:.4f}")
                record(
                    state, {"loss": located, "id_loss": identified, "lr": recipe.rate(state.step), "samples_s": rate}
                )
                sums.zero_()
                noted, since = now, state.step
            last = stop or state.step == recipe.steps
            if rank == 0 and (last or now - saved > 60 * SAVE_EVERY):
                save_checkpoint(state, checkpoint, designs)
                saved = now
            if validation and (last or now - validated > 60 * validate_every):
                record(state, evaluate(state.mean, validation))
                validated = time.monotonic()
            if stop:
                break
        interrupted = signalled()
    if interrupted:
        raise KeyboardInterrupt(f"{checkpoint} is at step {state.step}; the same command with --resume goes on")
    return state.step >= recipe.steps


def _begin_from(
    init: str | Path,
    network: SuperPoint,
    recipe: Recipe,
    patches: Sequence[Patch],
    backgrounds: str | Path | None,
    device: torch.device,
) -> str:
    """Put initial weights into a network, grown where it has other sizes; one line that says what matched."""
    weights, sizes = initial_weights(init, patches)
    theirs = replace(sizes or recipe.network, ids=recipe.network.ids)
    given = network if theirs == recipe.network else start(replace(recipe, network=theirs), device).network
    line = initialise(given, weights, str(init))
    if not is_folded(weights) and given is network:
        return line
    photos = load_photos(backgrounds, "training")
    width, height = recipe.samples.size
    count = max(2, min(128, 128 * 96 * 96 // (width * height)))
    batch = make_batch(recipe.samples, patches, photos, recipe.seed, 0, count, recipe.phase(0)[1])
    images = _blob(torch.from_numpy(batch.images).to(device))
    if is_folded(weights):
        restore_batchnorm(given, [images])
    return line if given is network else f"{line}; {grow(network, given, images, str(init))}"


def _place() -> tuple[int, int, torch.device]:
    """(rank, processes, device) as ``torchrun`` says in the environment, else one process."""
    rank, world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    cuda = torch.cuda.is_available()
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))) if cuda else torch.device("cpu")
    if cuda:
        torch.cuda.set_device(device)
        torch.backends.cudnn.benchmark = True
    if world > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if cuda else "gloo")
    return rank, world, device


def _agree(stop: bool, world: int, device: torch.device) -> bool:
    """Whether any process wants to stop: all must leave the loop at the same step."""
    if world == 1:
        return stop
    flag = torch.tensor(float(stop), device=device)
    dist.all_reduce(flag)
    return bool(flag.item())


Record = Callable[[State, Mapping[str, Any]], None]


@contextlib.contextmanager
def _recorder(folder: Path, active: bool, tensorboard: bool) -> Iterator[Record]:
    """Append to ``log.jsonl``, and to TensorBoard's files if asked for."""
    if not active:
        yield lambda state, figures: None
        return
    writer: Any = None
    if tensorboard:
        from torch.utils.tensorboard import SummaryWriter

        writer = SummaryWriter(folder)
    with (folder / "log.jsonl").open("a", encoding="utf-8") as log:

        def record(state: State, figures: Mapping[str, Any]) -> None:
            rounded = {k: float(f"{v:.5g}") for k, v in figures.items()}
            at = {
                "step": state.step,
                "samples": state.step * state.recipe.batch,
                "minutes": round(state.seconds / 60, 2),
            }
            log.write(json.dumps(at | rounded) + "\n")
            log.flush()
            for key, value in figures.items() if writer else ():
                writer.add_scalar(key, value, at["samples"])

        yield record
    if writer:
        writer.close()


@contextlib.contextmanager
def _bar(state: State, rank: int) -> Iterator[Callable[[int, str], None]]:
    """A progress bar over samples with the time left; only on a terminal."""
    import sys

    from tqdm import tqdm

    batch, total = state.recipe.batch, state.recipe.steps * state.recipe.batch
    hidden = rank != 0 or not sys.stderr.isatty()
    with tqdm(total=total, initial=state.step * batch, unit="crop", unit_scale=True, disable=hidden) as bar:

        def advance(step: int, text: str) -> None:
            bar.set_postfix_str(text, refresh=False)
            bar.update(step * batch - bar.n)

        yield advance


# Validation --------------------------------------------------------------------------------------------
