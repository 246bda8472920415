"""Functions that the ellipse network and the two judges share: layers, training loop, loading and export."""

from __future__ import annotations

import io
import json
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
"""Highest learning rate of a training that starts from random weights, and of a training that starts from the shipped
weights."""
BATCHNORM_SAMPLES = 4096
"""Number of samples from which :func:`load_shipped` computes the statistics of BatchNorm."""
OUTPUTS = ("odds", "shift", "log_map")
"""Names of the outputs of all three networks. ``odds`` (n,) are log odds.
:func:`kpbench.detectors.verification.move_poses` defines ``shift`` (n, 2) and ``log_map`` (n, 2, 2)."""

Say = Callable[[str], None]
"""A function that receives lines for the user."""


def convolution(c_in: int, c_out: int, side: int = 3, stride: int = 1) -> list[nn.Module]:
    """Return three layers: a convolution, BatchNorm and ReLU."""
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
    """Train with AdamW and the one-cycle schedule of the learning rate (Smith and Topin, *Super-convergence*, 2019).

    Parameters
    ----------
    network : nn.Module
        Changed in place; left in evaluation mode.
    loss : callable
        Takes the rows of a batch. Returns the loss of the samples in these rows.
    draw_rows : callable
        Returns the rows of an epoch, in random order.
    epochs, batch : int
        Number of epochs, and number of rows per step.
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
    """Load the shipped weights into a network.

    The shipped file stores the weights of convolutions as integers, and has no BatchNorm: the export folded each
    BatchNorm into its convolution. The convolutions of the network have no bias. On the inputs ``seen``, each
    BatchNorm is therefore made to add the stored bias and to change nothing else.
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


NETWORK_KIND = "verifier"
"""Kind of the files of networks, see :mod:`kpbench.writing`."""


def write_network(
    network: nn.Module, inputs: Sequence[str], seen: Sequence[tuple[Tensor, ...]], file: Path, say: Say
) -> None:
    """Write a network as an ONNX file in 8-bit integers; the ONNX network takes any number of samples.

    Parameters
    ----------
    network : nn.Module
    inputs : sequence of str
        Names of the network's inputs.
    seen : sequence of tuple of Tensor
        Batches of inputs on which the ranges of the activations are measured.
    file : Path
    say : callable
        Receives one line with the size of the file.
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
    quantised = quantise(onnx.load_from_string(buffer.getvalue()), feeds)
    onnx.helper.set_model_props(quantised, {"kpbench": json.dumps({"schema": f"kpbench.{NETWORK_KIND}/1"})})
    data = bytes(quantised.SerializeToString())
    write_file(file, data)
    say(f"{file}: {len(data)} bytes")
