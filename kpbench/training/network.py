"""The network: SuperPoint with one more layer, the attached layer, on each head (paper §2.2).

The recipe sets the sizes of the layers.

A VGG encoder reduces the image to cells of 8x8 px. The detector head gives 65 logits per cell: one per pixel of the
cell, row by row, and one for "no keypoint". The descriptor head ends in an attached layer with one logit per design
and one for "no patch"; this head is also called the ID head. ``forward`` and the exported graph return logits.
:func:`kpbench.detectors.decode` turns the logits into keypoints.

The modules have the same names as in the MIT-licensed re-implementation (rpautrat/SuperPoint,
``superpoint_pytorch.py``), so that the published weights of the re-implementation can be loaded. The names are
``backbone.<stage>.<n>.conv|bn``, ``detector.<n>`` and ``descriptor.<n>``.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import cast

import torch
from torch import Tensor, nn

from kpbench.detectors.heads import CELL_PX
from kpbench.training.recipe import NetworkConfig

HALVINGS = 3
"""Number of encoder stages that halve the image; a cell is ``2**HALVINGS`` px wide."""
NO_KEYPOINT_PRIOR = 0.98
"""Probability that an untrained network gives to "no keypoint" and to "no patch"."""


def conv_block(c_in: int, c_out: int, kernel: int, norm: str, stride: int = 1, relu: bool = True) -> nn.Sequential:
    """Return a convolution, a BatchNorm and a ReLU.

    ``norm`` : position of BatchNorm, "before" or "after" the ReLU. ``relu`` : False leaves the ReLU out.
    """
    conv = nn.Conv2d(c_in, c_out, kernel, stride, padding=kernel // 2)
    bn, activation = nn.BatchNorm2d(c_out, eps=1e-3), nn.ReLU(inplace=True) if relu else nn.Identity()
    parts = [("bn", bn), ("activation", activation)] if norm == "before" else [("activation", activation), ("bn", bn)]
    return nn.Sequential(OrderedDict([("conv", conv), *parts]))


class SuperPoint(nn.Module):
    """SuperPoint with an attached layer on each head.

    Parameters
    ----------
    config : NetworkConfig
        Sizes of the layers.

    Examples
    --------
    >>> import torch
    >>> from kpbench.training import NetworkConfig, SuperPoint
    >>> network = SuperPoint(NetworkConfig(widths=(4, 4, 8, 8), head_width=8, descriptor_width=8)).eval()
    >>> detector, identity = network(torch.zeros(1, 1, 32, 48))
    >>> detector.shape, identity.shape
    (torch.Size([1, 65, 4, 6]), torch.Size([1, 5, 4, 6]))
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        stages: list[nn.Module] = []
        before = 1
        for n, (width, depth) in enumerate(zip(config.widths, config.depths, strict=True)):
            halves = n < HALVINGS
            layers: list[nn.Module] = []
            for k in range(depth):
                stride = 2 if halves and config.down == "stride" and k == depth - 1 else 1
                layers.append(conv_block(before, width, 3, config.norm, stride))
                before = width
            if halves and config.down == "max":
                layers.append(nn.MaxPool2d(2, 2))
            stages.append(nn.Sequential(*layers))
        self.backbone = nn.Sequential(*stages)
        places = CELL_PX * CELL_PX + 1
        self.detector = self._head(before, places)
        self.descriptor = self._head(before, config.descriptor_width)
        self.detector_attached = nn.Conv2d(places, places, 1)
        self.descriptor_attached = nn.Conv2d(config.descriptor_width, config.ids + 1, 1)
        self._initialise()

    def _head(self, c_in: int, c_out: int) -> nn.Sequential:
        width, norm = self.config.head_width, self.config.norm
        return nn.Sequential(conv_block(c_in, width, 3, norm), conv_block(width, c_out, 1, norm, relu=False))

    def _initialise(self) -> None:
        """Set random weights (Kaiming), and biases that give ``NO_KEYPOINT_PRIOR``. Without it, training fails."""
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(cast(Tensor, module.bias))
        pixels, ids = CELL_PX * CELL_PX, self.config.ids
        with torch.no_grad():
            # the attached layer of the detector head starts as the identity
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
        """Parameters of the two attached layers. The first phase of the paper's training trains only these layers."""
        return [*self.detector_attached.parameters(), *self.descriptor_attached.parameters()]

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return the logits of the two heads.

        Parameters
        ----------
        image : Tensor of shape (B, 1, H, W)
            Grey images in [0, 1]; H and W are multiples of 8.

        Returns
        -------
        detector : Tensor of shape (B, 65, H/8, W/8)
        identity : Tensor of shape (B, ids + 1, H/8, W/8)
        """
        features = self.backbone(image)
        return self.detector_attached(self.detector(features)), self.descriptor_attached(self.descriptor(features))


def network_input(images: Tensor) -> Tensor:
    """Convert images (B, H, W), uint8, to the input of the network: (B, 1, H, W), float32, in [0, 1]."""
    return (images.float() / 255)[:, None].contiguous(memory_format=torch.channels_last)
