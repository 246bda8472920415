"""The network: SuperPoint with an attached layer on each head (paper §2.2), its widths as data.

A VGG encoder brings the image to cells of 8x8 pixels. The detector head gives 65 logits a cell: one a
pixel of the cell, in row order, and one for "no keypoint". The descriptor head, 256 wide, ends in an
attached layer of five ID logits: four patches and "no patch". ``forward`` ends there; what turns logits
into keypoints is :func:`kpbench.detectors.superpoint.decode`, outside the exported graph.

The parts bear the names of the MIT re-implementation (rpautrat/SuperPoint, ``superpoint_pytorch.py``),
so that its published weights fit: ``backbone.<stage>.<n>.conv|bn``, ``detector.<n>``, ``descriptor.<n>``.
"""

from __future__ import annotations

import math
import pickle
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from kpbench.errors import DataError

__all__ = ["CELL", "NetworkConfig", "SuperPoint", "initialise", "read_weights"]

CELL = 8
"""Side of a cell, px: three stages of the encoder halve the image."""

NO_KEYPOINT_PRIOR = 0.98
"""Probability of "no keypoint" and "no patch" that an untrained network starts from."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the network; the defaults are SuperPoint's.

    Attributes
    ----------
    widths : tuple of 4 int
        Channels of the encoder's stages, at strides 1, 2, 4 and 8.
    depths : tuple of 4 int
        3x3 convolutions in each stage.
    down : str
        What halves the image after each of the first three stages: "max" (max-pooling) or "stride"
        (the stage's last convolution has stride 2).
    head_width, descriptor_width : int
        Channels of the hidden layer of each head, and of the descriptor.
    norm : str
        BatchNorm "before" the activation (folds into the convolution at export) or "after" it (as in the
        published SuperPoint weights, which need that).
    ids : int
        Number of patches that the ID head tells apart, besides "no patch".
    """

    widths: tuple[int, int, int, int] = (64, 64, 128, 128)
    depths: tuple[int, int, int, int] = (2, 2, 2, 2)
    down: str = "max"
    head_width: int = 256
    descriptor_width: int = 256
    norm: str = "before"
    ids: int = 4

    def __post_init__(self) -> None:
        if len(self.widths) != 4 or len(self.depths) != 4 or min(*self.widths, *self.depths) < 1:
            raise DataError(f"network: widths {self.widths} and depths {self.depths}, expected four positive numbers each")
        if self.down not in ("max", "stride") or self.norm not in ("before", "after"):
            raise DataError(
                f"network: down is {self.down!r} and norm {self.norm!r}, expected max or stride, and before or after"
            )


def block(c_in: int, c_out: int, kernel: int, norm: str, stride: int = 1, relu: bool = True) -> nn.Sequential:
    """Convolution, BatchNorm and ReLU, in the order that ``norm`` names."""
    conv = nn.Conv2d(c_in, c_out, kernel, stride, padding=kernel // 2)
    bn, activation = nn.BatchNorm2d(c_out, eps=1e-3), nn.ReLU(inplace=True) if relu else nn.Identity()
    parts = [("bn", bn), ("activation", activation)] if norm == "before" else [("activation", activation), ("bn", bn)]
    return nn.Sequential(OrderedDict([("conv", conv), *parts]))


class SuperPoint(nn.Module):
    """Grey images to raw head outputs.

    ``forward`` takes (B, 1, H, W) in [0, 1], H and W multiples of 8, and returns the detector logits
    (B, 65, H/8, W/8) and the ID logits (B, ids + 1, H/8, W/8).
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        stages: list[nn.Module] = []
        before = 1
        for n, (width, depth) in enumerate(zip(config.widths, config.depths, strict=True)):
            halves = n < 3
            layers: list[nn.Module] = []
            for k in range(depth):
                stride = 2 if halves and config.down == "stride" and k == depth - 1 else 1
                layers.append(block(before, width, 3, config.norm, stride))
                before = width
            if halves and config.down == "max":
                layers.append(nn.MaxPool2d(2, 2))
            stages.append(nn.Sequential(*layers))
        self.backbone = nn.Sequential(*stages)
        cells = CELL * CELL + 1
        self.detector = self._head(before, cells)
        self.descriptor = self._head(before, config.descriptor_width)
        self.detector_attached = nn.Conv2d(cells, cells, 1)
        self.descriptor_attached = nn.Conv2d(config.descriptor_width, config.ids + 1, 1)
        self._start()

    def _head(self, c_in: int, c_out: int) -> nn.Sequential:
        width, norm = self.config.head_width, self.config.norm
        return nn.Sequential(block(c_in, width, 3, norm), block(width, c_out, 1, norm, relu=False))

    def _start(self) -> None:
        """Kaiming weights; final biases at the prior, without which training from scratch does not start."""
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(cast(Tensor, module.bias))
        pixels, ids = CELL * CELL, self.config.ids
        with torch.no_grad():
            # the attached layer starts as "pass on what the detector head says"
            self.detector_attached.weight.copy_(torch.eye(pixels + 1)[:, :, None, None])
            cast(Tensor, self.detector_attached.bias)[-1] = math.log(NO_KEYPOINT_PRIOR / (1 - NO_KEYPOINT_PRIOR) * pixels)
            self.descriptor_attached.weight.mul_(0.1)
            cast(Tensor, self.descriptor_attached.bias)[-1] = math.log(NO_KEYPOINT_PRIOR / (1 - NO_KEYPOINT_PRIOR) * ids)

    @property
    def attached(self) -> list[nn.Parameter]:
        """Parameters of the two attached layers, which the paper trains alone at first."""
        return [*self.detector_attached.parameters(), *self.descriptor_attached.parameters()]

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        features = self.backbone(image)
        return self.detector_attached(self.detector(features)), self.descriptor_attached(self.descriptor(features))


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Read a state-dict: ``.safetensors``, or a pickled one without unpickling anything but tensors.

    Raises
    ------
    DataError
        If the file cannot be read, or holds anything but named tensors.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        if Path(path).suffix == ".safetensors":
            return dict(load_file(path))
        loaded = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, SafetensorError, RuntimeError, EOFError, ValueError, KeyError, pickle.UnpicklingError) as error:
        raise DataError(f"{path}: cannot be read as weights ({str(error).splitlines()[0]})") from None
    if not isinstance(loaded, dict) or not all(isinstance(value, Tensor) for value in loaded.values()):
        raise DataError(f"{path}: holds no state-dict, expected names with tensors")
    return loaded


def initialise(network: SuperPoint, weights: dict[str, Tensor], source: str) -> str:
    """Load published SuperPoint weights into all but the attached layers.

    Parameters
    ----------
    network : SuperPoint
        Changed in place.
    weights : dict of str to Tensor
    source : str
        Name of the file, for messages.

    Returns
    -------
    str
        One line that says what matched and what keeps its random start.

    Raises
    ------
    DataError
        If a tensor has no place in the network or another shape, or a part of the network but the
        attached layers gets none.
    """
    own = network.state_dict()
    # the count of batches seen is no weight, and some files lack it
    wanted = {name for name in own if "_attached" not in name and not name.endswith("num_batches_tracked")}
    given = {name for name in weights if not name.endswith("num_batches_tracked")}
    for name in sorted(given - set(own)):
        raise DataError(f"{source}: {name} has no place in this network")
    for name in sorted(wanted - given):
        raise DataError(f"{source}: {name} is missing")
    for name in sorted(given):
        if own[name].shape != weights[name].shape:
            theirs, ours = tuple(weights[name].shape), tuple(own[name].shape)
            raise DataError(f"{source}: {name} has shape {theirs}, expected {ours}")
    network.load_state_dict({name: weights[name] for name in given}, strict=False)
    fresh = sorted({name.split(".")[0] for name in own if name not in given and "num_batches" not in name})
    return f"{source}: {len(given)} tensors matched; not in it: {', '.join(fresh) or 'nothing'}"
