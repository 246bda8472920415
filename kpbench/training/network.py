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
import pickle
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kpbench.errors import DataError
from kpbench.training.recipe import Loss, NetworkConfig

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
        why = (isinstance(error, OSError) and error.strerror) or "neither safetensors nor PyTorch's own"
        raise DataError(f"{path}: cannot be read as weights ({why})") from None
    if not isinstance(loaded, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in loaded.items()
    ):
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
        attached layers gets none. Weights without any BatchNorm are complete, see :func:`unfold`.
    """
    own = network.state_dict()
    bare = is_folded(weights)
    # the count of batches seen is no weight, and some files lack it
    ours = {name for name in own if not (name.endswith("num_batches_tracked") or (bare and ".bn." in name))}
    wanted = {name for name in ours if "_attached" not in name}
    given = {name for name in weights if not name.endswith("num_batches_tracked")}
    for name in sorted(given - set(own)):
        raise DataError(f"{source}: {name} has no place in this network")
    for name in sorted(wanted - given):
        raise DataError(f"{source}: {name} is missing")
    for name in sorted(given):
        if own[name].shape != weights[name].shape:
            theirs, expected = tuple(weights[name].shape), tuple(own[name].shape)
            raise DataError(f"{source}: {name} has shape {theirs}, expected {expected}")
    network.load_state_dict({name: weights[name] for name in given}, strict=False)
    fresh = sorted({name.split(".")[0] for name in ours - given})
    return f"{source}: {len(given)} tensors matched; not in it: {', '.join(fresh) or 'nothing'}"


def is_folded(weights: dict[str, Tensor]) -> bool:
    """Whether a state-dict has no BatchNorm, as that of an exported file."""
    return not any(".bn." in name for name in weights)


def unfold(network: nn.Module, inputs: Iterable[Tensor], layers: Iterable[nn.Module] | None = None) -> None:
    """Let each BatchNorm pass on what it gets, as its statistics stand on these inputs of the network.

    The contrary of folding: the network computes what its convolutions alone would, and can be trained on.
    ``layers`` are the BatchNorms to be set; None: all.
    """

    def pass_on(module: nn.Module, given: tuple[Tensor]) -> None:
        bn = cast(nn.BatchNorm2d, module)
        variance, mean = torch.var_mean(given[0], (0, 2, 3), correction=0)
        cast(Tensor, bn.running_mean).copy_(mean)
        cast(Tensor, bn.running_var).copy_(variance)
        bn.weight.copy_((variance + bn.eps).sqrt())
        bn.bias.copy_(mean)

    chosen = [m for m in network.modules() if isinstance(m, nn.BatchNorm2d)] if layers is None else layers
    hooks = [m.register_forward_pre_hook(pass_on) for m in chosen]
    mode = network.training
    with torch.no_grad():
        network.eval()(*inputs)
    network.train(mode)
    for hook in hooks:
        hook.remove()


@torch.no_grad()
def grow(network: SuperPoint, smaller: SuperPoint, images: Tensor, source: str) -> str:
    """Start a network as a trained one that is narrower, or of another depth (after Chen et al., Net2Net, ICLR 2016).

    Channels that the smaller network lacks keep their random weights, and nothing learnt listens to them yet. In
    each stage the convolutions that it lacks pass on what they get, and what it has beyond is left out. Where
    nothing is left out and both halve alike, the network computes what the smaller one does; else it begins near.

    Parameters
    ----------
    network : SuperPoint
        Changed in place.
    smaller : SuperPoint
        Its BatchNorm in place, see :func:`unfold`.
    images : Tensor of shape (B, 1, H, W) in [0, 1]
        On which the BatchNorm of convolutions that pass on stands.
    source : str
        Name of the smaller network, for messages.

    Returns
    -------
    str
        What became of it, in a few words.

    Raises
    ------
    DataError
        If the smaller network is wider somewhere, or BatchNorm stands after the activation in one of them: what
        passes on would lose its negative part.
    """
    if "after" in (smaller.config.norm, network.config.norm):
        raise DataError(f"{source}: differs from [network], and can grow only where norm is 'before' in both")
    passing: list[nn.Module] = []
    width, left_out = 1, 0
    for n, (stage, theirs) in enumerate(zip(network.backbone, smaller.backbone, strict=True)):
        for layer, given in zip_longest(_blocks(stage), _blocks(theirs)):
            if layer is None:
                left_out += 1
            elif given is None:
                nn.init.dirac_(cast(Tensor, layer.get_submodule("conv").weight)[:width])
                passing.append(layer.get_submodule("bn"))
            else:
                width = _take(layer, given, width, f"{source}: stage {n + 1}")
    for head in ("detector", "descriptor"):
        heard = width
        for name in (f"{head}.0", f"{head}.1", f"{head}_attached"):
            heard = _take(network.get_submodule(name), smaller.get_submodule(name), heard, f"{source}: {name}")
    unfold(network, [images], passing)
    return f"taken into another network, convolutions that pass on: {len(passing)}, left out: {left_out}"


def _blocks(stage: nn.Module) -> list[nn.Module]:
    return [part for part in stage.children() if isinstance(part, nn.Sequential)]


def _take(layer: nn.Module, given: nn.Module, heard: int, place: str) -> int:
    """Put a trained convolution and its BatchNorm into the first channels of another; how many those are."""
    own, theirs = (cast(nn.Conv2d, getattr(part, "conv", part)) for part in (layer, given))
    width = theirs.out_channels
    if width > own.out_channels:
        raise DataError(f"{place} is {width} wide, expected at most {own.out_channels}")
    own.weight[:width] = 0
    own.weight[:width, :heard] = theirs.weight
    cast(Tensor, own.bias)[:width] = cast(Tensor, theirs.bias)
    if layer is not own:
        kept = layer.get_submodule("bn").state_dict()
        for key, value in given.get_submodule("bn").state_dict().items():
            if value.ndim:
                kept[key][:width] = value
    return width


# Losses -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Targets:
    """What is asked of each cell.

    Attributes
    ----------
    place : Tensor of shape (B, 65, h, w): probabilities, sum 1.
    asked : Tensor of shape (B, h, w): 0 where a keypoint is ignored, else 1.
    identity : Tensor of shape (B, h, w), int64: patch, or ``ids`` for none.
    near, far : Tensor of shape (B, h, w), bool: within 8 px of a keypoint; beyond 16 px of all.
    """

    place: Tensor
    asked: Tensor
    identity: Tensor
    near: Tensor
    far: Tensor


def make_targets(keypoints: Tensor, height: int, width: int, ids: int, place: str) -> Targets:
    """Targets of a batch of (B, K, 4) keypoints (:class:`kpbench.training.Batch`) on images of that size."""
    count, h, w = len(keypoints), height // CELL, width // CELL
    xy, patch, ignore = keypoints[..., :2], keypoints[..., 2], keypoints[..., 3]
    wanted = (patch >= 0) & (ignore == 0)

    low = torch.floor(xy if place == "split" else xy + 0.5)
    part = xy - low if place == "split" else torch.zeros_like(xy)
    image = torch.zeros(count, height * width, device=keypoints.device)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = (low[..., 0] + dx).long(), (low[..., 1] + dy).long()
        share = (part[..., 0] if dx else 1 - part[..., 0]) * (part[..., 1] if dy else 1 - part[..., 1])
        share = share * (wanted & (x >= 0) & (y >= 0) & (x < width) & (y < height))
        image.scatter_add_(1, y.clamp(0, height - 1) * width + x.clamp(0, width - 1), share)
    pixels = image.view(count, h, CELL, w, CELL).permute(0, 2, 4, 1, 3).reshape(count, CELL * CELL, h, w)
    mass = pixels.sum(1, keepdim=True)
    pixels = pixels / mass.clamp(min=1.0)
    target = torch.cat([pixels, (1 - mass).clamp(min=0.0)], 1)

    rows = torch.arange(h, device=keypoints.device) * CELL + (CELL - 1) / 2
    columns = torch.arange(w, device=keypoints.device) * CELL + (CELL - 1) / 2
    distance = torch.hypot(xy[:, :, 0, None, None] - columns, xy[:, :, 1, None, None] - rows[:, None])  # (B, K, h, w)
    buried = ((ignore > 0)[..., None, None] & (distance < ignore[..., None, None] + CELL / 2)).any(1)
    asked = ~buried | (mass[:, 0] > 0)
    nearest, which = distance.masked_fill(~wanted[..., None, None], float("inf")).min(1)
    near = nearest <= CELL
    identity = patch.long().gather(1, which.flatten(1)).view_as(which)
    return Targets(target, asked.float(), torch.where(near, identity, ids), near, (nearest > 2 * CELL) & ~buried)


def losses(detector: Tensor, ids: Tensor, targets: Targets, config: Loss) -> tuple[Tensor, Tensor]:
    """(detector loss, identity loss) of raw head outputs (B, 65, h, w) and (B, ids + 1, h, w)."""
    log_p = F.log_softmax(detector.float(), 1)
    entropy = -(targets.place * log_p).sum(1)
    mass = 1 - targets.place[:, -1]
    weight = targets.asked * (1 + (config.positive_weight - 1) * mass)
    if config.focal:
        empty = log_p[:, -1].exp()
        weight = weight * (mass * empty + (1 - mass) * (1 - empty)).detach() ** config.focal
    located = (weight * entropy).sum() / targets.asked.sum().clamp(min=1.0)
    hinge = _hinge if config.identity == "hinge" else _cross_entropy
    return located, hinge(ids.float(), targets, config)


def _cross_entropy(ids: Tensor, targets: Targets, config: Loss) -> Tensor:
    entropy = F.cross_entropy(ids, targets.identity, reduction="none")
    near, far = targets.near, targets.far
    return (entropy * near).sum() / near.sum().clamp(min=1) + (entropy * far).sum() / far.sum().clamp(min=1)


def _hinge(ids: Tensor, targets: Targets, config: Loss) -> Tensor:
    """SuperPoint's descriptor loss (its eq. 4-6) of one image against the map of one-hot vectors.

    The sum over pairs of cells is grouped by the class of the second cell: the dot product with a
    one-hot vector is one channel of the normalised descriptor.
    """
    inside = targets.place[:, -1] < 1  # the class of a cell is the patch whose keypoint lies in it
    identity = torch.where(inside, targets.identity, ids.shape[1] - 1)
    dots = F.normalize(ids, dim=1).flatten(2)  # (B, C, cells)
    onehot = F.one_hot(identity.flatten(1), ids.shape[1]).permute(0, 2, 1).float()
    population = onehot.sum(2, keepdim=True)
    positive = (onehot * F.relu(config.positive_margin - dots)).sum((1, 2)) * config.lambda_d
    negative = ((1 - onehot) * population * F.relu(dots - config.negative_margin)).sum((1, 2))
    return ((positive + negative) / dots.shape[2] ** 2).mean()
