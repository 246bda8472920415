"""State of a training, and the checkpoints that store the state.

A resumed training ends in the same weights, to the bit, as an uninterrupted training.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kpbench import __version__
from kpbench.errors import DataError, system_reason
from kpbench.files import open_file
from kpbench.patches.design import PATCH_KEYS, Patch
from kpbench.toml import TomlTable, name_source
from kpbench.training.network import SuperPoint
from kpbench.training.recipe import NetworkConfig, Recipe, parse_recipe
from kpbench.writing import write_file

SCHEMA = "kpbench.checkpoint/1"
CONTENT_KEYS = ("schema", "recipe", "step", "seconds", "patches", "designs", "versions")
"""Keys of the metadata of a checkpoint."""


@dataclass
class TrainingState:
    """State of a training between two steps.

    Attributes
    ----------
    recipe : Recipe
    network : SuperPoint
        The network that is trained.
    mean : SuperPoint
        A network whose weights are the running mean of the weights of ``network``. This network is validated and
        exported.
    optimizer : torch.optim.Optimizer
    step : int
        Number of completed steps.
    seconds : float
        Duration of the training so far, s.

    Examples
    --------
    >>> import torch
    >>> from kpbench.training import TrainingState, load_recipe, start_state
    >>> state = start_state(load_recipe("reference"), torch.device("cpu"))
    >>> isinstance(state, TrainingState)
    True
    """

    recipe: Recipe
    network: SuperPoint
    mean: SuperPoint
    optimizer: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0


def start_state(recipe: Recipe, device: torch.device) -> TrainingState:
    """Return the state of a training before its first step; the recipe's seed determines the random weights.

    Examples
    --------
    >>> import torch
    >>> from kpbench.training import load_recipe, start_state
    >>> start_state(load_recipe("reference"), torch.device("cpu")).step
    0
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        network = SuperPoint(recipe.network)
        mean = SuperPoint(recipe.network)
    network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    mean.to(device, memory_format=torch.channels_last).requires_grad_(False).eval()  # type: ignore[call-overload]
    mean.load_state_dict(network.state_dict())
    kind = torch.optim.Adam if recipe.optimizer == "adam" else torch.optim.AdamW
    optimizer = kind(
        network.parameters(), lr=recipe.lr, weight_decay=recipe.weight_decay, fused=device.type == "cuda" or None
    )
    return TrainingState(recipe, network, mean, optimizer)


def digest_designs(patches: Sequence[Patch]) -> str:
    """Return one SHA-256 of a list of designs. The order of the list counts: design n is channel n of the ID head."""
    return hashlib.sha256("".join(p.digest for p in patches).encode()).hexdigest()


def save_checkpoint(state: TrainingState, path: Path, patches: Sequence[Patch]) -> None:
    """Write a state, and its designs, to one safetensors file. An interruption leaves no partial file."""
    from safetensors.torch import save

    tensors = {f"network.{k}": v for k, v in state.network.state_dict().items()}
    tensors |= {f"mean.{k}": v for k, v in state.mean.state_dict().items()}
    for name, parameter in state.network.named_parameters():
        for key, value in state.optimizer.state.get(parameter, {}).items():
            tensors[f"optimizer.{key}.{name}"] = value
    content = {
        "schema": SCHEMA,
        "recipe": {key: value for key, value in asdict(state.recipe).items() if key != "verifier"},
        "step": state.step,
        "seconds": round(state.seconds, 1),
        "patches": [p.to_dict() for p in patches],
        "designs": digest_designs(patches),
        "versions": {"kpbench": __version__, "torch": torch.__version__},
    }
    packed = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    write_file(path, save(packed, {"kpbench": json.dumps(content)}))


def read_checkpoint(path: str | Path, is_noted: bool = True) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the metadata and the tensors of a checkpoint.

    ``is_noted`` : False for a checkpoint that the running command may replace later.

    Raises
    ------
    DataError
        If the file cannot be read, or is no checkpoint of this schema.
    """
    from safetensors import SafetensorError, safe_open

    try:
        open_file(path, is_noted).close()  # refuses what is no file; the library would wait or end the process
        with safe_open(path, framework="pt") as file:
            content = json.loads((file.metadata() or {}).get("kpbench", "{}"))
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, ValueError, RecursionError) as error:
        why = system_reason(error) or str(error) or type(error).__name__
        raise DataError(f"{path}: cannot be read as a checkpoint ({why})") from None
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise DataError(f"{path}: no checkpoint of kpbench train, expected schema {SCHEMA!r} inside")
    with name_source(path, DataError):
        table = TomlTable(content, CONTENT_KEYS, DataError)
        table.whole_number("step", 0)
        table.number("seconds", 0)
        table.text("designs")
        table.tables("patches", PATCH_KEYS)
        table.table("versions", ("kpbench", "torch"))
        _require_fitting_tensors(content, tensors)
    return content, tensors


def empty_network(config: NetworkConfig) -> SuperPoint:
    """Return a network whose tensors have shapes, but no memory: a file may declare any sizes."""
    with torch.device("meta"):
        return SuperPoint(config)


def _require_fitting_tensors(content: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Refuse tensors whose names or shapes are not those of the network that the recipe declares."""
    network = empty_network(parse_recipe(content.get("recipe", {}), "recipe").network)
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    needed = {f"{part}.{name}": shape for part in ("network", "mean") for name, shape in shapes.items()}
    optional = {f"optimizer.{key}.{n}": shapes[n] for key in ("exp_avg", "exp_avg_sq") for n in shapes}
    optional |= {f"optimizer.step.{n}": () for n in shapes}
    for name in sorted({*needed, *tensors}):
        expected = needed.get(name, optional.get(name))
        theirs = tuple(tensors[name].shape) if name in tensors else None
        if theirs != expected:
            given = "missing" if theirs is None else f"of shape {theirs}"
            wanted = "no such tensor" if expected is None else f"shape {expected}"
            raise DataError(f"the tensors do not fit the recipe: {name} is {given}, expected {wanted}")


def restore_state(state: TrainingState, path: Path, patches: Sequence[Patch]) -> None:
    """Load a checkpoint into a state that :func:`start_state` returned.

    Raises
    ------
    DataError
        If the file is no checkpoint, or if its recipe or its designs differ from those of the training.
    """
    content, tensors = read_checkpoint(path, is_noted=False)
    theirs = parse_recipe(content["recipe"], str(path))
    ours = replace(state.recipe, verifier=None)  # how the verification is trained does not matter to this network
    changed = [f.name for f in fields(Recipe) if getattr(theirs, f.name) != getattr(ours, f.name)]
    if changed:
        raise DataError(f"{path}: was trained with another {' and '.join(changed)}; use another folder as `out`")
    if content["designs"] != digest_designs(patches):
        raise DataError(f"{path}: was trained on other patch designs; use another folder as `out`")

    def part(prefix: str) -> dict[str, Tensor]:
        return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}

    state.network.load_state_dict(part("network."))
    state.mean.load_state_dict(part("mean."))
    moments = part("optimizer.")
    for name, parameter in state.network.named_parameters():
        own = {key: moments[f"{key}.{name}"] for key in ("step", "exp_avg", "exp_avg_sq") if f"{key}.{name}" in moments}
        if own:
            like = torch.empty_like(parameter)  # has the memory format of the parameter; rounding may depend on it
            on_device = {key: value if key == "step" else like.clone().copy_(value) for key, value in own.items()}
            if parameter.device.type == "cuda":
                on_device["step"] = on_device["step"].to(parameter.device)
            state.optimizer.state[parameter] = on_device
    state.step, state.seconds = content["step"], content["seconds"]


def load_mean_network(content: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> SuperPoint:
    """Return a network, in evaluation mode, with the running mean of a checkpoint's weights."""
    try:
        network = SuperPoint(parse_recipe(content.get("recipe", {}), "recipe").network)
        network.load_state_dict({k.removeprefix("mean."): v for k, v in tensors.items() if k.startswith("mean.")})
    except (RuntimeError, TypeError, ValueError) as error:  # of PyTorch
        raise DataError(f"the tensors do not fit the recipe ({error})") from None
    return network.eval()
