"""The network of a judge. The first judge and the second judge have the same layers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from kpbench.detectors.hypotheses import Hypotheses, judge_inputs
from kpbench.detectors.verification import move_poses
from kpbench.fitting.templates import VIEW_PX
from kpbench.patches.design import Patch
from kpbench.training.verifier.small_networks import trunk
from kpbench.types import Float


class Judge(nn.Module):
    """Network that takes views and evidence of hypotheses. It returns log odds and corrections of the poses.

    ``evidence`` : evidence (n, columns) of the training samples. The network standardises each column of its input with
    the mean and the standard deviation of the same column of ``evidence``.
    ``width`` : number of channels of the first layers.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, evidence: Float, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.from_numpy(evidence.mean(axis=0)).float())
        self.register_buffer("deviation", torch.from_numpy(evidence.std(axis=0) + 1e-6).float())
        self.view = nn.Sequential(*trunk(2, width))
        size = 3 * width * (VIEW_PX // 8) ** 2
        self.likeness = nn.Sequential(nn.Dropout(0.3), nn.Linear(size, 64))
        self.evidence = nn.Linear(evidence.shape[1], 64)
        self.odds = nn.Sequential(nn.ReLU(), nn.Dropout(0.3), nn.Linear(64, 32), nn.ReLU(), nn.Linear(32, 1))
        self.pose = nn.Sequential(nn.Linear(size, 64), nn.ReLU(), nn.Linear(64, 5))

    def forward(self, view: Tensor, evidence: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log odds (n,), shift (n, 2) and log map (n, 2, 2) of n hypotheses.

        :func:`kpbench.detectors.hypotheses.judge_inputs` makes the inputs ``view`` (n, 2, VIEW_PX, VIEW_PX) and
        ``evidence`` (n, columns). :func:`kpbench.detectors.verification.move_poses` defines shift and log map.
        """
        # the limits bound the effect of evidence that differs much from the training samples
        standard = ((evidence - self.mean) / self.deviation).clamp(-4, 4)
        if self.training:
            standard = standard + 0.05 * torch.randn_like(standard)
        features = self.view(view)
        odds = self.odds(self.likeness(features) + self.evidence(standard))[:, 0]
        x, y, xx, yy, xy = self.pose(features).unbind(1)
        return odds, torch.stack([x, y], 1), torch.stack([xx, xy, xy, yy], 1).unflatten(1, (2, 2))  # type: ignore[no-untyped-call]


def input_tensors(hypotheses: Hypotheses, patches: Sequence[Patch]) -> tuple[Tensor, Tensor]:
    """Return the inputs of a judge, view and evidence, as tensors."""
    given = judge_inputs(hypotheses, patches)
    return torch.from_numpy(given["view"]), torch.from_numpy(given["evidence"])


@torch.inference_mode()
def apply_judge(network: Judge, hypotheses: Hypotheses, patches: Sequence[Patch]) -> tuple[Float, Hypotheses]:
    """Do the work of :func:`kpbench.detectors.verification.judge` with a network in PyTorch.

    Return the log odds of the hypotheses, and the hypotheses with corrected poses.
    """
    if not len(hypotheses):
        return np.zeros(0), hypotheses
    odds, shift, log_map = (part.numpy() for part in network(*input_tensors(hypotheses, patches)))
    xy, A = move_poses(hypotheses.xy, hypotheses.A, shift, log_map)
    return odds.astype(np.float64), replace(hypotheses, xy=xy, A=A)
