"""Layers, training loop, shipped weights and export that the ellipse network and the judges share."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import onnx
import torch
from onnx.numpy_helper import to_array
from torch import Tensor, nn

from kpbench.detectors.verification import WEIGHTS
from kpbench.training.export import OPSET
from kpbench.training.quantise import quantise
from kpbench.training.verifier.dataset_images import progress_bar
from kpbench.training.weights import restore_batchnorm
from kpbench.writing import write_file

WEIGHT_DECAY = 2e-2
"""Weight decay of AdamW."""
LEARNING_RATE, CONTINUED_LEARNING_RATE = 3e-3, 2e-3
"""Highest learning rate of a training from random weights, and from the shipped weights."""
BATCHNORM_SAMPLES = 4096
"""Number of samples whose statistics initialise BatchNorm in a training from the shipped weights."""
OUTPUTS = ("odds", "shift", "log_map")
"""Outputs of all three networks: log odds (n,), and the corrections of ``move_poses``, (n, 2) and (n, 2, 2)."""

Say = Callable[[str], None]
"""A function that receives lines for the user."""


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
        Takes rows, and returns the loss of the samples at these rows.
    draw_rows : callable
        Returns the rows of an epoch, in random order.
    epochs, batch : int
    learning_rate : float
        Highest learning rate of the cycle.
    """
    network.eval()
    steps = epochs * (len(draw_rows()) // batch)
    if not steps:
        return
    network.train()
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, learning_rate, total_steps=steps)
    in_bf16 = bool(torch.cpu._is_avx512_bf16_supported())  # bfloat16 halves the time on such processors
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
    """Load the shipped weights into a network; the file stores the weights of convolutions in 7 bits.

    The shipped file has no BatchNorm. Each BatchNorm only adds the bias of its convolution; the inputs ``seen`` give
    the statistics.
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
    """Write a network as an ONNX file in 8-bit integers; the ONNX network takes any number of places.

    Parameters
    ----------
    network : nn.Module
    inputs : sequence of str
        Names of the network's inputs.
    seen : sequence of tuple of Tensor
        Inputs on which the ranges of the activations are measured.
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
    write_file(file, data)
    say(f"{file}: {len(data)} bytes")
