"""What the network should say, and how far it is off."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from kpbench.detectors.superpoint import CELL_PX
from kpbench.training.recipe import LossConfig


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
    count, h, w = len(keypoints), height // CELL_PX, width // CELL_PX
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
    pixels = image.view(count, h, CELL_PX, w, CELL_PX).permute(0, 2, 4, 1, 3).reshape(count, CELL_PX * CELL_PX, h, w)
    mass = pixels.sum(1, keepdim=True)
    pixels = pixels / mass.clamp(min=1.0)
    target = torch.cat([pixels, (1 - mass).clamp(min=0.0)], 1)

    rows = torch.arange(h, device=keypoints.device) * CELL_PX + (CELL_PX - 1) / 2
    columns = torch.arange(w, device=keypoints.device) * CELL_PX + (CELL_PX - 1) / 2
    distance = torch.hypot(xy[:, :, 0, None, None] - columns, xy[:, :, 1, None, None] - rows[:, None])  # (B, K, h, w)
    buried = ((ignore > 0)[..., None, None] & (distance < ignore[..., None, None] + CELL_PX / 2)).any(1)
    asked = ~buried | (mass[:, 0] > 0)
    nearest, which = distance.masked_fill(~wanted[..., None, None], float("inf")).min(1)
    near = nearest <= CELL_PX
    identity = patch.long().gather(1, which.flatten(1)).view_as(which)
    return Targets(target, asked.float(), torch.where(near, identity, ids), near, (nearest > 2 * CELL_PX) & ~buried)


def losses(detector: Tensor, ids: Tensor, targets: Targets, config: LossConfig) -> tuple[Tensor, Tensor]:
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


def _cross_entropy(ids: Tensor, targets: Targets, config: LossConfig) -> Tensor:
    entropy = F.cross_entropy(ids, targets.identity, reduction="none")
    near, far = targets.near, targets.far
    return (entropy * near).sum() / near.sum().clamp(min=1) + (entropy * far).sum() / far.sum().clamp(min=1)


def _hinge(ids: Tensor, targets: Targets, config: LossConfig) -> Tensor:
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
