"""Export of a trained network as one ONNX file.

The network in the file takes any number of images of one size. The sides must be multiples of 8 px.
"""

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

from kpbench.detectors.heads import CELL_PX
from kpbench.detectors.inference import open_session
from kpbench.detectors.superpoint import SCHEMA
from kpbench.errors import DataError
from kpbench.training.checkpoint import load_mean_network, read_checkpoint
from kpbench.training.network import SuperPoint
from kpbench.writing import require_writable, write_file

OPSET = 17
"""Version of the ONNX operator set."""
MOST_DIFFERENCE = 1e-4
"""Largest allowed difference between a logit computed by PyTorch and the same logit computed by ONNX Runtime."""


@dataclass(frozen=True)
class Exported:
    """Facts about a file that :func:`export_onnx` or :func:`kpbench.training.export_int8` wrote.

    Attributes
    ----------
    bytes : int
        Size of the file.
    step : int
        Number of steps for which the network was trained.
    difference : float
        Largest difference between a logit of the file and the same logit of the network before its conversion.

    Examples
    --------
    >>> from kpbench.training import Exported
    >>> Exported(bytes=1000, step=2, difference=1e-6).step
    2
    """

    bytes: int
    step: int
    difference: float


def fold_batchnorm(network: SuperPoint) -> SuperPoint:
    """Fold each BatchNorm into the convolution before it, in place. A BatchNorm that follows a ReLU is kept."""
    network.eval()
    for module in network.modules():
        parts = dict(module.named_children())
        if "bn" in parts and network.config.norm == "before":
            conv, bn = cast(nn.Conv2d, parts["conv"]), cast(nn.BatchNorm2d, parts["bn"])
            module.conv = fuse_conv_bn_eval(conv, bn)
            module.bn = nn.Identity()
    return network


def to_onnx(network: SuperPoint, metadata: dict[str, Any]) -> bytes:
    """Return an ONNX file as bytes: input ``image`` (B, 1, H, W) in [0, 1], outputs ``detector`` and ``identity``."""
    import onnx

    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # the exporter is deprecated, but its successor needs more packages
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


def require_onnx_target(out: str | Path) -> None:
    """Raise an error if no ONNX file can be written to a path. Callers check the path before they start work."""
    if Path(out).suffix != ".onnx":
        raise DataError(f"{out}: expected a name ending in .onnx")
    require_writable(Path(out), "superpoint")


def export_onnx(checkpoint: str | Path, out: str | Path) -> Exported:
    """Write the running mean of a checkpoint's weights as an ONNX file.

    The file is written only if ONNX Runtime and PyTorch give the same logits, to 1e-4.

    Parameters
    ----------
    checkpoint, out : path
        Checkpoint of :func:`kpbench.training.train`, and the ONNX file to write.

    Returns
    -------
    Exported

    Raises
    ------
    DataError
        If the checkpoint cannot be read, or ONNX Runtime and PyTorch differ by more than 1e-4 in a logit.

    Examples
    --------
    >>> from kpbench.training import export_onnx
    >>> export_onnx("runs/superpoint-small/checkpoint.safetensors", "small.onnx")  # doctest: +SKIP
    Exported(bytes=3633412, step=46875, difference=1.5e-05)
    """
    require_onnx_target(out)
    content, tensors = read_checkpoint(checkpoint)
    network = load_mean_network(content, tensors)
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
    data = to_onnx(fold_batchnorm(network), metadata)
    difference = largest_difference(data, image.numpy(), expected)
    if difference > MOST_DIFFERENCE:
        raise DataError(f"{out}: ONNX Runtime differs from PyTorch by {difference:.1e}, expected at most 1e-4")
    write_file(Path(out), data)
    return Exported(len(data), content["step"], difference)


def largest_difference(data: bytes, image: Any, expected: list[Any]) -> float:
    """Return the largest difference between an output of an ONNX model, for the input ``image``, and ``expected``."""
    got = open_session(data)[0].run(None, {"image": image})
    return max(float(np.abs(a - b).max()) for a, b in zip(got, expected, strict=True))
