"""One step of a training."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from kpbench.training.checkpoint import TrainingState
from kpbench.training.losses import compute_losses, make_targets
from kpbench.training.network import network_input
from kpbench.training.process_group import ProcessGroup


def train_step(
    state: TrainingState, forward: nn.Module, images: Tensor, keypoints: Tensor, group: ProcessGroup | None = None
) -> tuple[Tensor, Tensor]:
    """Take one step of the optimizer.

    Parameters
    ----------
    state : TrainingState
        Changed in place.
    forward : nn.Module
        The network of the state, compiled by ``torch.compile`` or not.
    images : Tensor of shape (B, H, W), uint8
    keypoints : Tensor of shape (B, K, 4)
        See :class:`kpbench.training.Batch`.
    group : ProcessGroup, optional
        Group of processes that train together. None: this process trains alone.

    Returns
    -------
    detector_loss, identity_loss : Tensor
        Losses of the batch with the weights before the step.

    Examples
    --------
    >>> import torch
    >>> from kpbench.training import NetworkConfig, Phase, Recipe, start_state, train_step
    >>> network = NetworkConfig((4, 4, 8, 8), (1, 1, 1, 1), head_width=8, descriptor_width=8)
    >>> state = start_state(Recipe("tiny", (Phase(100),), network=network, batch=2), torch.device("cpu"))
    >>> images, keypoints = torch.zeros(2, 32, 32, dtype=torch.uint8), torch.full((2, 12, 4), -1.0)
    >>> losses = train_step(state, state.network, images, keypoints)
    >>> state.step
    1
    """
    recipe, network = state.recipe, state.network
    phase, _ = recipe.phase(state.step)
    network.requires_grad_(phase.trains == "all")
    for parameter in network.attached:
        parameter.requires_grad_(True)
    network.train(phase.trains == "all")  # frozen layers also keep their BatchNorm statistics
    for param_group in state.optimizer.param_groups:
        param_group["lr"] = recipe.rate(state.step)

    with torch.autocast(images.device.type, torch.bfloat16, enabled=recipe.precision == "bf16"):
        detector, identity = forward(network_input(images))
    height, width = images.shape[-2:]
    targets = make_targets(keypoints, height, width, recipe.network.ids, recipe.loss.place)
    detector_loss, identity_loss = compute_losses(detector, identity, targets, recipe.loss)
    state.optimizer.zero_grad()
    (detector_loss + recipe.loss.identity_weight * identity_loss).backward()  # type: ignore[no-untyped-call]
    if group is not None:
        group.average_gradients(network)
    state.optimizer.step()
    _update_mean(state)
    state.step += 1
    return detector_loss.detach(), identity_loss.detach()


@torch.no_grad()
def _update_mean(state: TrainingState) -> None:
    """Move the running mean towards the weights; the running mean moves faster in the first steps."""
    decay = min(state.recipe.ema, (1 + state.step) / (10 + state.step))
    mean, weights = state.mean.state_dict(), state.network.state_dict()
    real = [k for k in mean if mean[k].is_floating_point()]
    torch._foreach_lerp_([mean[k] for k in real], [weights[k] for k in real], 1 - decay)
