"""The network and its losses: SuperPoint with an attached layer on each head (paper §2.2), widths as data.

A VGG encoder brings the image to cells of 8x8 pixels. The detector head gives 65 logits a cell: one a
pixel of the cell, in row order, and one for "no keypoint". The descriptor head, 256 wide, ends in an
attached layer of five ID logits: four patches and "no patch". ``forward`` ends there; what turns logits
into keypoints is :func:`kpbench.detectors.superpoint.decode`, outside the exported graph.

The parts bear the names of the MIT re-implementation (rpautrat/SuperPoint, ``superpoint_pytorch.py``),
so that its published weights fit: ``backbone.<stage>.<n>.conv|bn``, ``detector.<n>``, ``descriptor.<n>``.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import cast

import torch
from torch import Tensor, nn

from kpbench.training.recipe import NetworkConfig

CELL = 8
"""Side of a cell, px: three stages of the encoder halve the image."""

NO_KEYPOINT_PRIOR = 0.98
"""Probability of "no keypoint" and "no patch" that an untrained network starts from."""


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
            cast(Tensor, self.detector_attached.bias)[-1] = math.log(
                NO_KEYPOINT_PRIOR / (1 - NO_KEYPOINT_PRIOR) * pixels
            )
            self.descriptor_attached.weight.mul_(0.1)
            cast(Tensor, self.descriptor_attached.bias)[-1] = math.log(
                NO_KEYPOINT_PRIOR / (1 - NO_KEYPOINT_PRIOR) * ids
            )

    @property
    def attached(self) -> list[nn.Parameter]:
        """Parameters of the two attached layers, which the paper trains alone at first."""
        return [*self.detector_attached.parameters(), *self.descriptor_attached.parameters()]

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Raw heads, see the class."""
        features = self.backbone(image)
        return self.detector_attached(self.detector(features)), self.descriptor_attached(self.descriptor(features))


# Losses -----------------------------------------------------------------------------------------------
