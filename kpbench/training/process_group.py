"""The processes that train one network together: all processes of ``torchrun``, or a single process."""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn


@dataclass(frozen=True)
class ProcessGroup:
    """One of the processes of a training.

    Attributes
    ----------
    rank : int
        Index of the process, from 0.
    size : int
        Number of processes.
    device : torch.device
        Device of the process.
    """

    rank: int
    size: int
    device: torch.device

    def any_of(self, flag: bool) -> bool:
        """Return whether the flag is true in any process; all processes must call this method at the same step."""
        if self.size == 1:
            return flag
        total = torch.tensor(float(flag), device=self.device)
        dist.all_reduce(total)
        return bool(total.item())

    def average_gradients(self, network: nn.Module) -> None:
        """Replace each gradient by its mean over all processes. One message holds all gradients."""
        if self.size == 1:
            return
        gradients = [p.grad for p in network.parameters() if p.grad is not None]
        flat: Tensor = torch.cat([g.flatten() for g in gradients])
        dist.all_reduce(flat)
        flat /= self.size
        for gradient, part in zip(gradients, torch.split(flat, [g.numel() for g in gradients]), strict=True):
            gradient.copy_(part.view_as(gradient))


def join_process_group() -> ProcessGroup:
    """Join the group that the environment variables of ``torchrun`` describe. Return this process as a member."""
    rank, size = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    cuda = torch.cuda.is_available()
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))) if cuda else torch.device("cpu")
    if cuda:
        torch.cuda.set_device(device)
        torch.backends.cudnn.benchmark = True
    if size > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if cuda else "gloo")
    return ProcessGroup(rank, size, device)
