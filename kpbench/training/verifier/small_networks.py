"""Images, layers, training loop, weights and export that the ellipse network and the judges share."""

from __future__ import annotations

import io
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx.numpy_helper import to_array
from torch import Tensor, nn
from tqdm import tqdm

from kpbench.dataset.folder import Dataset, open_dataset
from kpbench.detectors.verification import WEIGHTS
from kpbench.errors import DataError
from kpbench.files import write_atomic
from kpbench.images import to_grey
from kpbench.training.export import OPSET
from kpbench.training.quantise import quantise
from kpbench.training.weights import restore_batchnorm
from kpbench.types import Float, UInt8
from kpbench.workers import run_in_order

WEIGHT_DECAY = 2e-2
LEARNING_RATE, CONTINUED_LEARNING_RATE = 3e-3, 2e-3
"""Highest learning rate of a training from random weights, and from the shipped weights."""
BATCHNORM_SAMPLES = 4096
"""Samples on whose statistics BatchNorm starts in a training from the shipped weights."""
OUTPUTS = ("odds", "shift", "log_map")
"""Outputs of all three networks: log odds (n,), and the corrections of ``move_poses``, (n, 2) and (n, 2, 2)."""

Say = Callable[[str], None]
"""A function that receives lines for the user."""
Given = TypeVar("Given")
Result = TypeVar("Result")


@dataclass(frozen=True)
class ImageRef:
    """An image of a dataset, cheap to send to a worker process."""

    folder: Path
    fingerprint: str
    index: int

    def read(self) -> tuple[UInt8, NDArray[Any]]:
        """Return the image in grey, and its true keypoints."""
        image, keypoints = _open_dataset(self.folder, self.fingerprint)[self.index]
        return to_grey(image), keypoints

    def rng(self) -> np.random.Generator:
        """Return random numbers that depend on the dataset's content and the index, not on the folder's name."""
        return np.random.default_rng([int(self.fingerprint[:8], 16), self.index])


@cache
def _open_dataset(folder: Path, fingerprint: str) -> Dataset:
    """Open a dataset once per process; the fingerprint tells apart datasets that replaced each other in a folder."""
    return open_dataset(folder)


def image_refs(dataset: Dataset) -> list[ImageRef]:
    """Return the images of a dataset."""
    return [ImageRef(dataset.path, dataset.fingerprint, n) for n in range(len(dataset))]


def map_images(
    work: Callable[[ImageRef, Given], Result], dataset: Dataset, given: Iterable[Given], workers: int, label: str
) -> list[Result]:
    """Return ``work(image, argument)`` for every image of a dataset and its argument.

    Parameters
    ----------
    work : callable
        Can be pickled.
    dataset : Dataset
    given : iterable
        The argument of each image.
    workers : int
        Processes; 0: none but this one.
    label : str
        Text before the progress bar.
    """
    jobs = list(zip(image_refs(dataset), given, strict=True))
    with progress_bar(label, len(jobs)) as bar:
        results = []
        for result in run_in_order(partial(_apply, work), jobs, workers):
            results.append(result)
            bar.update()
    return results


def _apply(work: Callable[[ImageRef, Given], Result], job: tuple[ImageRef, Given]) -> Result:
    return work(*job)


@contextmanager
def progress_bar(label: str, total: int) -> Iterator[Any]:
    """Show a progress bar on stderr; only on a terminal."""
    with tqdm(total=total, desc=label, leave=False, disable=not sys.stderr.isatty()) as bar:
        yield bar


def convolution(c_in: int, c_out: int, side: int = 3, stride: int = 1) -> list[nn.Module]:
    """Return a convolution with BatchNorm and ReLU."""
    conv = nn.Conv2d(c_in, c_out, side, stride, side // 2, bias=False)
    return [conv, nn.BatchNorm2d(c_out), nn.ReLU()]


def trunk(c_in: int, width: int) -> list[nn.Module]:
    """Return the layers from views (n, c_in, VIEW_PX, VIEW_PX) to features (n, 3 * width * (VIEW_PX // 8)²)."""
    return [
        *convolution(c_in, width, 5, 2),
        *convolution(width, width),
        *convolution(width, width),
        nn.MaxPool2d(2),
        *convolution(width, 2 * width),
        *convolution(2 * width, 2 * width),
        *convolution(2 * width, 2 * width),
        nn.MaxPool2d(2),
        *convolution(2 * width, 3 * width),
        nn.Flatten(),
    ]


def train_one_cycle(
    network: nn.Module,
    loss: Callable[[Tensor], Tensor],
    draw_rows: Callable[[], Tensor],
    epochs: int,
    batch: int,
    learning_rate: float,
) -> None:
    """Minimise a loss with AdamW under one cycle of the learning rate (Smith and Topin, *Super-convergence*, 2019).

    Parameters
    ----------
    network : nn.Module
        Changed in place; in evaluation mode afterwards.
    loss : callable
        Loss of the samples at some rows.
    draw_rows : callable
        Returns the rows of an epoch, in random order.
    epochs, batch : int
    learning_rate : float
        The highest one.
    """
    network.eval()
    steps = epochs * (len(draw_rows()) // batch)
    if not steps:
        return
    network.train()
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, learning_rate, total_steps=steps)
    in_bf16 = bool(torch.cpu._is_avx512_bf16_supported())  # takes about half the time there
    with progress_bar("train", steps) as bar:
        step = 0
        while step < steps:
            for rows in torch.split(draw_rows(), batch)[: steps - step]:
                with torch.autocast("cpu", torch.bfloat16, enabled=in_bf16):
                    value = loss(rows)
                optimizer.zero_grad()
                value.backward()  # type: ignore[no-untyped-call]
                optimizer.step()
                schedule.step()
                step += 1
                bar.update()
                bar.set_postfix(loss=f"{value.item():.3f}", refresh=False)
    network.eval()


@torch.no_grad()
def load_shipped(network: nn.Module, name: str, seen: tuple[Tensor, ...]) -> None:
    """Give a network the shipped weights, as near as their 7 bits are.

    The shipped file has no BatchNorm; each BatchNorm becomes the identity, by its statistics on the inputs ``seen``.
    """
    graph = onnx.load(WEIGHTS / f"{name}.onnx").graph
    stored = {tensor.name: to_array(tensor) for tensor in graph.initializer}
    weights = {key: torch.from_numpy(stored[key].copy()) for key in network.state_dict() if key in stored}
    for node in graph.node:
        if node.op_type == "DequantizeLinear" and node.input[0] in stored:
            integers, scale, zero = (stored[part] for part in node.input)
            per_channel = (-1,) + (1,) * (integers.ndim - 1)
            floats = (integers.astype(np.float32) - zero.reshape(per_channel)) * scale.reshape(per_channel)
            stored[node.output[0]] = floats
    convolutions = [node for node in graph.node if node.op_type == "Conv"]
    layers = [node.name.split("/")[-2] for node in convolutions]
    for layer, node in zip(layers, convolutions, strict=True):
        weights[f"{layer}.weight"] = torch.from_numpy(stored[node.input[1]])
    network.load_state_dict({**network.state_dict(), **weights})
    for layer, node in zip(layers, convolutions, strict=True):
        body, place = layer.split(".")
        batch_norm = cast(nn.BatchNorm2d, network.get_submodule(f"{body}.{int(place) + 1}"))
        restore_batchnorm(network, seen, [batch_norm])
        batch_norm.bias.add_(torch.from_numpy(stored[node.input[2]]))


def write_network(
    network: nn.Module, inputs: Sequence[str], seen: Sequence[tuple[Tensor, ...]], file: Path, say: Say
) -> None:
    """Write a network as an ONNX file in 8-bit integers, for any number of places.

    Parameters
    ----------
    network : nn.Module
    inputs : sequence of str
        Names of its inputs.
    seen : sequence of tuple of Tensor
        Inputs that give the ranges of the integers.
    file : Path
    say : callable
    """
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            network,
            seen[0],
            buffer,  # type: ignore[arg-type]
            dynamo=False,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=list(OUTPUTS),
            dynamic_axes={name: {0: "places"} for name in [*inputs, *OUTPUTS]},
        )
    feeds = (dict(zip(inputs, (part.numpy() for part in one), strict=True)) for one in seen)
    data = bytes(quantise(onnx.load_from_string(buffer.getvalue()), feeds).SerializeToString())
    write_atomic(file, data)
    say(f"{file}: {len(data)} bytes")


def prepare_training(out: Path, threads: int | None) -> None:
    """Make the folder for the weights, and set the threads of PyTorch (None: as they are)."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{out}: cannot be made, {error.strerror}") from None
    if threads:
        torch.set_num_threads(threads)


def affine_at_centre(H: Float) -> Float:
    """Return the derivatives (n, 2, 2) of homographies (n, 3, 3) at the origin."""
    return H[:, :2, :2] / H[:, 2:, 2:] - H[:, :2, 2:] @ H[:, 2:, :2] / H[:, 2:, 2:] ** 2


def log_ellipse(A: Float) -> Float:
    """Return the logarithms (n, 2, 2) of the symmetric maps that give the same ellipses as maps A (n, 2, 2)."""
    square, axes = np.linalg.eigh(A @ A.transpose(0, 2, 1))
    return np.asarray(np.einsum("nij,nj,nkj->nik", axes, 0.5 * np.log(square), axes))
