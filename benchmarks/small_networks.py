"""The small networks of :mod:`kpbench.verify`: what `ellipses.py` and `verification.py` share."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable

import numpy as np
import onnx
import torch
from torch import nn
from tqdm import tqdm

from kpbench.export import quantise


def convolution(inside: int, outside: int, side: int = 3, stride: int = 1) -> list[nn.Module]:
    conv = nn.Conv2d(inside, outside, side, stride, side // 2, bias=False)
    return [conv, nn.BatchNorm2d(outside), nn.ReLU()]


def one_cycle(
    network: nn.Module,
    loss: Callable[[torch.Tensor], torch.Tensor],
    drawn: Callable[[], torch.Tensor],
    epochs: int,
    batch: int,
    lr: float,
) -> None:
    """Minimise ``loss(rows)`` over batches of the rows that ``drawn()`` gives for each epoch, as many for every one.

    AdamW, one cycle of the learning rate (Smith and Topin, *Super-convergence*, 2019).
    """
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=2e-2)
    batches = len(drawn()) // batch
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, lr, total_steps=epochs * batches)
    with tqdm(total=epochs * batches, desc="train", leave=False) as progress:
        for _ in range(epochs):
            for rows in drawn().split(batch)[:batches]:
                value = loss(rows)
                optimizer.zero_grad()
                value.backward()
                optimizer.step()
                schedule.step()
                progress.update()
                progress.set_postfix(loss=f"{value.item():.3f}", refresh=False)
    network.eval()


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
