"""Reports of a running training: ``log.jsonl``, TensorBoard's files, and a progress bar."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from kpbench.errors import DataError, system_reason
from kpbench.files import read_bytes
from kpbench.training.checkpoint import TrainingState
from kpbench.writing import require_writable, write_file

LOG = "log.jsonl"
Record = Callable[[TrainingState, Mapping[str, Any]], None]
"""A function that logs figures at the current step."""


@contextmanager
def open_log(folder: Path, active: bool, tensorboard: bool) -> Iterator[Record]:
    """Open the log ``log.jsonl``; yield a function that adds a line of figures, and writes the log anew.

    ``tensorboard`` : also write the figures to TensorBoard's files.

    If ``active`` is false, no file is opened, and the function does nothing.
    """
    if not active:
        yield lambda state, figures: None
        return
    writer: Any = None
    if tensorboard:
        from torch.utils.tensorboard import SummaryWriter

        writer = SummaryWriter(folder)
    path = folder / LOG
    require_writable(path, "training-log")
    try:
        lines = read_bytes(path, is_noted=False).splitlines(keepends=True) if path.exists() else []
    except OSError as error:
        raise DataError(f"{path}: cannot be read, {system_reason(error) or error}") from None

    def record(state: TrainingState, figures: Mapping[str, Any]) -> None:
        rounded = {k: float(f"{v:.5g}") for k, v in figures.items()}
        samples = state.step * state.recipe.batch
        at = {"step": state.step, "samples": samples, "minutes": round(state.seconds / 60, 2)}
        mark = {} if lines else {"schema": "kpbench.training-log/1"}
        lines.append(json.dumps(mark | at | rounded).encode() + b"\n")
        write_file(path, b"".join(lines))
        for key, value in figures.items() if writer else ():
            writer.add_scalar(key, value, samples)

    yield record
    if writer:
        writer.close()


@contextmanager
def training_bar(state: TrainingState, active: bool, stop_s: float | None) -> Iterator[Callable[..., None]]:
    """Show a progress bar, only on a terminal; yield a function that takes its step, its seconds and its text.

    The bar counts samples. With ``stop_s``, the seconds at which the training stops, the bar counts seconds.
    """
    batch, total = state.recipe.batch, state.recipe.steps * state.recipe.batch
    count: dict[str, Any] = {"total": total, "initial": state.step * batch, "unit": "crop", "unit_scale": True}
    if stop_s is not None:
        count = {"total": max(round(stop_s), 1), "bar_format": "{l_bar}{bar}| {n:.0f} of {total} s{postfix}"}
    hidden = not active or not sys.stderr.isatty()
    with tqdm(desc="train", disable=hidden, **count) as bar:

        def advance(step: int, seconds: float, text: str = "") -> None:
            if text:
                bar.set_postfix_str(f"step {step}, {text}", refresh=False)
            bar.update(step * batch - bar.n if stop_s is None else min(seconds, stop_s) - bar.n)

        yield advance


class LossMeter:
    """Meter of the mean losses since the last :meth:`read`, and of the samples per second since this run began."""

    def __init__(self, state: TrainingState, device: torch.device, began: float) -> None:
        self._began, self._first = began, state.step
        self._sums, self._since = torch.zeros(2, device=device), state.step

    def add(self, losses: tuple[Tensor, Tensor]) -> None:
        """Add the losses of a step."""
        self._sums += torch.stack(losses)

    def read(self, state: TrainingState) -> dict[str, float]:
        """Return the figures for the log, and start new means."""
        detector_loss, identity_loss = (self._sums / (state.step - self._since)).tolist()
        samples = (state.step - self._first) * state.recipe.batch
        self._sums.zero_()
        self._since = state.step
        return {
            "loss": detector_loss,
            "id_loss": identity_loss,
            "lr": state.recipe.rate(state.step),
            "samples_s": samples / (time.monotonic() - self._began),
        }


class Timer:
    """A timer that is due when ``seconds`` have passed since its start or its last restart."""

    def __init__(self, seconds: float) -> None:
        self._seconds, self._since = seconds, time.monotonic()

    def due(self) -> bool:
        """Return whether the timer is due."""
        return time.monotonic() - self._since > self._seconds

    def restart(self) -> None:
        """Restart the timer."""
        self._since = time.monotonic()
