"""Checkpoints: everything that a run needs to go on to the bit."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kpbench import __version__
from kpbench.errors import DataError
from kpbench.files import write_atomic
from kpbench.patches.design import Patch
from kpbench.training.network import SuperPoint
from kpbench.training.recipe import Recipe, parse_recipe

SCHEMA = "kpbench.checkpoint/1"


def designs_digest(patches: Sequence[Patch]) -> str:
    """SHA-256 over the designs, in their order: which network output means which ink."""
    return hashlib.sha256("".join(p.digest for p in patches).encode()).hexdigest()


def save_checkpoint(state: State, path: Path, patches: Sequence[Patch]) -> None:
    """Write all of the state to one safetensors file, whole or not at all."""
    from safetensors.torch import save

    tensors = {f"network.{k}": v for k, v in state.network.state_dict().items()}
    tensors |= {f"mean.{k}": v for k, v in state.mean.state_dict().items()}
    for name, parameter in state.network.named_parameters():
        for key, value in state.optimizer.state.get(parameter, {}).items():
            tensors[f"optimizer.{key}.{name}"] = value
    content = {
        "schema": SCHEMA,
        "recipe": asdict(state.recipe),
        "step": state.step,
        "seconds": round(state.seconds, 1),
        "patches": [p.to_dict() for p in patches],
        "designs": designs_digest(patches),
        "versions": {"kpbench": __version__, "torch": torch.__version__},
    }
    packed = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    write_atomic(path, save(packed, {"kpbench": json.dumps(content)}))


def read_checkpoint(path: str | Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """(content, tensors) of a checkpoint.

    Raises
    ------
    DataError
        If the file is no checkpoint of this version.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            content = json.loads((file.metadata() or {}).get("kpbench", "{}"))
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as a checkpoint ({str(error).splitlines()[0]})") from None
    if content.get("schema") != SCHEMA:
        raise DataError(f"{path}: no checkpoint of kpbench train, expected schema {SCHEMA!r} inside")
    return content, tensors


def network_of(content: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> SuperPoint:
    """The running mean of a checkpoint as a network in evaluation mode."""
    network = SuperPoint(parse_recipe(content["recipe"], "checkpoint").network)
    network.load_state_dict({k.removeprefix("mean."): v for k, v in tensors.items() if k.startswith("mean.")})
    return network.eval()


@dataclass
class State:
    """What changes while training."""

    recipe: Recipe
    network: SuperPoint
    mean: SuperPoint  # exponential moving average of ``network``
    optimizer: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0
