"""Checkpoint → one ONNX file: BatchNorm folded, any batch, any size in multiples of 8; float32, or 8-bit integers."""

from __future__ import annotations

import io
import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from kpbench.detectors.inference import open_session
from kpbench.detectors.superpoint import CELL_PX, SCHEMA
from kpbench.errors import DataError
from kpbench.files import write_atomic
from kpbench.training.checkpoint import network_of, read_checkpoint
from kpbench.training.network import SuperPoint

OPSET = 17
MOST_DIFFERENCE = 1e-4


@dataclass(frozen=True)
class Exported:
    """What was written: size in bytes, steps of training, and the largest difference from PyTorch's logits."""

    bytes: int
    step: int
    difference: float


def fold(network: SuperPoint) -> SuperPoint:
    """Multiply each BatchNorm into the convolution before it, in place; those after a ReLU stay."""
    network.eval()
    for module in network.modules():
        parts = dict(module.named_children())
        if "bn" in parts and network.config.norm == "before":
            conv, bn = cast(nn.Conv2d, parts["conv"]), cast(nn.BatchNorm2d, parts["bn"])
            module.conv = fuse_conv_bn_eval(conv, bn)
            module.bn = nn.Identity()
    return network


def to_onnx(network: SuperPoint, metadata: dict[str, Any]) -> bytes:
    """The network as ONNX: input ``image`` (B, 1, H, W) in [0, 1], outputs ``detector`` and ``identity``."""
    import onnx

    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # the newer exporter needs packages that nothing else here needs
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            network,
            (torch.zeros(1, 1, 8 * CELL_PX, 8 * CELL_PX),),
            buffer,  # type: ignore[arg-type]
            dynamo=False,
            opset_version=OPSET,
            input_names=["image"],
            output_names=["detector", "identity"],
            dynamic_axes={
                "image": {0: "batch", 2: "height", 3: "width"},
                "detector": {0: "batch", 2: "rows", 3: "columns"},
                "identity": {0: "batch", 2: "rows", 3: "columns"},
            },
        )
    model = onnx.load_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, {"kpbench": json.dumps(metadata, sort_keys=True)})
    onnx.checker.check_model(model)
    return cast(bytes, model.SerializeToString())


def export_onnx(checkpoint: str | Path, out: str | Path) -> Exported:
    """Write a checkpoint's mean weights as an ONNX file and compare it with PyTorch.

    Raises
    ------
    DataError
        If the checkpoint cannot be read, or the file's output differs from PyTorch's by more than 1e-4.
    """
    content, tensors = read_checkpoint(checkpoint)
    network = network_of(content, tensors)
    recipe = content["recipe"]
    metadata = {
        "schema": SCHEMA,
        "name": recipe["name"],
        "recipe": recipe,
        "patches": content["patches"],
        "designs": content["designs"],
        "step": content["step"],
        "samples": content["step"] * recipe["batch"],
        "versions": content["versions"],
    }
    image = torch.from_numpy(np.random.default_rng(0).random((2, 1, 72, 104), np.float32))
    with torch.inference_mode():
        expected = [part.numpy() for part in network(image)]
    data = to_onnx(fold(network), metadata)
    difference = largest_difference(data, image.numpy(), expected)
    if difference > MOST_DIFFERENCE:
        raise DataError(f"{out}: ONNX Runtime differs from PyTorch by {difference:.1e}, expected at most 1e-4")
    write_atomic(Path(out), data)
    return Exported(len(data), content["step"], difference)


def largest_difference(data: bytes, image: Any, expected: list[Any]) -> float:
    """Return the largest difference between the outputs of an ONNX model and expected outputs, for one image."""
    got = open_session(data)[0].run(None, {"image": image})
    return max(float(np.abs(a - b).max()) for a, b in zip(got, expected, strict=True))
