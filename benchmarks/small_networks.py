"""The small networks of :mod:`kpbench.detectors`: what `ellipses.py` and `verification.py` share."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx.numpy_helper import to_array
from torch import nn
from tqdm import tqdm

from kpbench.detectors import verification as verify
from kpbench.training.quantise import quantise
from kpbench.training.weights import unfold

BF16 = torch.cpu._is_avx512_bf16_supported()
"""Whether this processor computes in bfloat16, which then takes about half the time."""


def convolution(inside: int, outside: int, side: int = 3, stride: int = 1) -> list[nn.Module]:
    conv = nn.Conv2d(inside, outside, side, stride, side // 2, bias=False)
    return [conv, nn.BatchNorm2d(outside), nn.ReLU()]


def trunk(inside: int, width: int) -> list[nn.Module]:
    """Pictures (n, inside, VIEW_PX, VIEW_PX) to (n, 3 * width * (VIEW_PX // 8)²)."""
    return [
        *convolution(inside, width, 5, 2),
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


def one_cycle(
    network: nn.Module,
    loss: Callable[[torch.Tensor], torch.Tensor],
    drawn: Callable[[], torch.Tensor],
    epochs: int,
    batch: int,
    lr: float,
) -> None:
    """Minimise ``loss(rows)`` over batches of the rows that ``drawn()`` gives for each epoch.

    AdamW, one cycle of the learning rate (Smith and Topin, *Super-convergence*, 2019).
    """
    network.eval()
    steps = epochs * (len(drawn()) // batch)
    if not steps:
        return
    network.train()
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=2e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, total_steps=steps)
    with tqdm(total=steps, desc="train", leave=False) as progress:
        while progress.n < steps:
            for rows in drawn().split(batch)[: steps - progress.n]:
                with torch.autocast("cpu", torch.bfloat16, enabled=BF16):
                    value = loss(rows)
                optimizer.zero_grad()
                value.backward()
                optimizer.step()
                schedule.step()
                progress.update()
                progress.set_postfix(loss=f"{value.item():.3f}", refresh=False)
    network.eval()


def shipped(name: str) -> Path:
    """The file of a network: ``ellipse``, ``posed`` or ``fitted``."""
    return Path(verify.__file__).parent / "weights" / f"{name}.onnx"


@torch.no_grad()
def start_from_shipped(network: nn.Module, name: str, seen: tuple[torch.Tensor, ...]) -> None:
    """Give a network the weights that ship, as near as their 7 bits are.

    Each BatchNorm passes on what it gets, as its statistics stand on what is ``seen``.
    """
    graph = onnx.load(shipped(name)).graph
    stored = {tensor.name: to_array(tensor) for tensor in graph.initializer}
    weights = {key: torch.from_numpy(stored[key].copy()) for key in network.state_dict() if key in stored}
    for node in graph.node:
        if node.op_type == "DequantizeLinear" and node.input[0] in stored:
            whole, scale, zero = (stored[part] for part in node.input)
            each = (-1,) + (1,) * (whole.ndim - 1)
            stored[node.output[0]] = (whole.astype(np.float32) - zero.reshape(each)) * scale.reshape(each)
    convolutions = [node for node in graph.node if node.op_type == "Conv"]
    layers = [node.name.split("/")[-2] for node in convolutions]
    for layer, node in zip(layers, convolutions, strict=True):
        weights[f"{layer}.weight"] = torch.from_numpy(stored[node.input[1]])
    network.load_state_dict({**network.state_dict(), **weights})
    for layer, node in zip(layers, convolutions, strict=True):
        body, place = layer.split(".")
        batch_norm = network.get_submodule(f"{body}.{int(place) + 1}")
        unfold(network, seen, [batch_norm])
        batch_norm.bias += torch.from_numpy(stored[node.input[2]])


def exported(network: nn.Module, seen: list[tuple[torch.Tensor, ...]], inputs: list[str]) -> bytes:
    """A network as ONNX, for any number of places: these inputs, outputs ``odds``, ``shift``, ``log_map``.

    In 8-bit integers, whose ranges are those of some inputs that the network has ``seen``.
    """
    buffer, outputs = io.BytesIO(), ["odds", "shift", "log_map"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            network,
            seen[0],
            buffer,
            dynamo=False,
            opset_version=17,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes={name: {0: "places"} for name in [*inputs, *outputs]},
        )
    feeds = (dict(zip(inputs, (part.numpy() for part in one), strict=True)) for one in seen)
    return bytes(quantise(onnx.load_from_string(buffer.getvalue()), feeds).SerializeToString())


def affine(H: np.ndarray) -> np.ndarray:
    """Derivatives (n, 2, 2) of homographies (n, 3, 3) at the origin."""
    return H[:, :2, :2] / H[:, 2:, 2:] - H[:, :2, 2:] @ H[:, 2:, :2] / H[:, 2:, 2:] ** 2


def log_of_map(A: np.ndarray) -> np.ndarray:
    """Logarithms (n, 2, 2) of the symmetric maps that give the same ellipses as A (n, 2, 2)."""
    square, axes = np.linalg.eigh(A @ A.transpose(0, 2, 1))
    return np.einsum("nij,nj,nkj->nik", axes, 0.5 * np.log(square), axes)
