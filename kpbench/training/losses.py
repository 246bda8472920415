"""Targets of the network, and the losses between the network's outputs and the targets."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from kpbench.detectors.heads import CELL_PX
from kpbench.training.recipe import LossConfig


@dataclass(frozen=True)
class Targets:
    """Targets of all cells of a batch.

    Attributes
    ----------
    place : Tensor of shape (B, 65, h, w)
        Probability of each of the 64 pixels of a cell, and of "no keypoint"; the 65 probabilities sum to 1.
    valid : Tensor of shape (B, h, w)
        1 in cells where the detector head is trained. 0 near ignored keypoints, except in cells that hold a keypoint
        that must be found.
    identity : Tensor of shape (B, h, w), int64
        Index of the design; ``ids`` means "no patch".
    near, far : Tensor of shape (B, h, w), bool
        ``near``: whether the centre of the cell lies within 8 px of a keypoint that must be found. ``far``: whether the
        centre lies more than 16 px from every keypoint that must be found, and is not near an ignored keypoint.
    """

    place: Tensor
    valid: Tensor
    identity: Tensor
    near: Tensor
    far: Tensor


def make_targets(keypoints: Tensor, height: int, width: int, ids: int, place: str) -> Targets:
    """Return the targets of a batch.

    Parameters
    ----------
    keypoints : Tensor of shape (B, K, 4)
        See :class:`kpbench.training.Batch`.
    height, width : int
        Size of the images, px.
    ids : int
        Number of designs.
    place : str
        "pixel" or "split", see :class:`kpbench.training.LossConfig`.
    """
    count, h, w = len(keypoints), height // CELL_PX, width // CELL_PX
    xy, design, ignore = keypoints[..., :2], keypoints[..., 2], keypoints[..., 3]
    wanted = (design >= 0) & (ignore == 0)

    low = torch.floor(xy if place == "split" else xy + 0.5)
    part = xy - low if place == "split" else torch.zeros_like(xy)
    image = torch.zeros(count, height * width, device=keypoints.device)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = (low[..., 0] + dx).long(), (low[..., 1] + dy).long()
        share = (part[..., 0] if dx else 1 - part[..., 0]) * (part[..., 1] if dy else 1 - part[..., 1])
        share = share * (wanted & (x >= 0) & (y >= 0) & (x < width) & (y < height))
        image.scatter_add_(1, y.clamp(0, height - 1) * width + x.clamp(0, width - 1), share)
    cells = image.view(count, h, CELL_PX, w, CELL_PX).permute(0, 2, 4, 1, 3)
    pixels = cells.reshape(count, CELL_PX * CELL_PX, h, w)
    mass = pixels.sum(1, keepdim=True)
    pixels = pixels / mass.clamp(min=1.0)
    target = torch.cat([pixels, (1 - mass).clamp(min=0.0)], 1)

    rows = torch.arange(h, device=keypoints.device) * CELL_PX + (CELL_PX - 1) / 2
    columns = torch.arange(w, device=keypoints.device) * CELL_PX + (CELL_PX - 1) / 2
    distance = torch.hypot(xy[:, :, 0, None, None] - columns, xy[:, :, 1, None, None] - rows[:, None])  # (B, K, h, w)
    ignored = ((ignore > 0)[..., None, None] & (distance < ignore[..., None, None] + CELL_PX / 2)).any(1)
    valid = ~ignored | (mass[:, 0] > 0)
    distance, nearest = distance.masked_fill(~wanted[..., None, None], float("inf")).min(1)
    near = distance <= CELL_PX
    identity = design.long().gather(1, nearest.flatten(1)).view_as(nearest)
    far = (distance > 2 * CELL_PX) & ~ignored
    return Targets(target, valid.float(), torch.where(near, identity, ids), near, far)


def compute_losses(detector: Tensor, identity: Tensor, targets: Targets, config: LossConfig) -> tuple[Tensor, Tensor]:
    """Return the loss of the detector head and the loss of the ID head.

    Parameters
    ----------
    detector : Tensor of shape (B, 65, h, w)
        Logits of the detector head.
    identity : Tensor of shape (B, ids + 1, h, w)
        Logits of the ID head.
    targets : Targets
    config : LossConfig
    """
    log_p = F.log_softmax(detector.float(), 1)
    entropy = -(targets.place * log_p).sum(1)
    mass = 1 - targets.place[:, -1]
    weight = targets.valid * (1 + (config.positive_weight - 1) * mass)
    if config.focal:
        empty = log_p[:, -1].exp()
        weight = weight * (mass * empty + (1 - mass) * (1 - empty)).detach() ** config.focal
    detector_loss = (weight * entropy).sum() / targets.valid.sum().clamp(min=1.0)
    identity_loss = _hinge if config.identity == "hinge" else _cross_entropy
    return detector_loss, identity_loss(identity.float(), targets, config)


def _cross_entropy(identity: Tensor, targets: Targets, config: LossConfig) -> Tensor:
    """Return the mean cross-entropy of the ``near`` cells plus the mean cross-entropy of the ``far`` cells."""
    entropy = F.cross_entropy(identity, targets.identity, reduction="none")
    near, far = targets.near, targets.far
    return (entropy * near).sum() / near.sum().clamp(min=1) + (entropy * far).sum() / far.sum().clamp(min=1)


def _hinge(identity: Tensor, targets: Targets, config: LossConfig) -> Tensor:
    """Return SuperPoint's descriptor loss (eq. 4 to 6 of the SuperPoint paper).

    The loss is a sum over pairs of cells. The first cell gives a normalised descriptor, the second cell gives the
    one-hot vector of its class. The class of a cell is the design of its keypoint, or "no patch". The dot product of a
    descriptor and a one-hot vector is one channel of the descriptor. The sum is therefore computed class by class, and
    not pair by pair.
    """
    has_keypoint = targets.place[:, -1] < 1
    classes = torch.where(has_keypoint, targets.identity, identity.shape[1] - 1)
    dots = F.normalize(identity, dim=1).flatten(2)  # (B, C, cells)
    onehot = F.one_hot(classes.flatten(1), identity.shape[1]).permute(0, 2, 1).float()
    population = onehot.sum(2, keepdim=True)
    positive = (onehot * F.relu(config.positive_margin - dots)).sum((1, 2)) * config.lambda_d
    negative = ((1 - onehot) * population * F.relu(dots - config.negative_margin)).sum((1, 2))
    return ((positive + negative) / dots.shape[2] ** 2).mean()
