"""Weights to start from: published ones, exported ones, those of a smaller network."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from kpbench.errors import DataError
from kpbench.files import PACKAGE
from kpbench.patches.design import Patch
from kpbench.training.checkpoint import designs_digest, read_checkpoint
from kpbench.training.network import SuperPoint
from kpbench.training.recipe import NetworkConfig, parse_recipe


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
        attached layers gets none. Weights without any BatchNorm are complete, see :func:`restore_batchnorm`.
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


def restore_batchnorm(network: nn.Module, inputs: Iterable[Tensor], layers: Iterable[nn.Module] | None = None) -> None:
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
        Its BatchNorm in place, see :func:`restore_batchnorm`.
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
    restore_batchnorm(network, [images], passing)
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


def initial_weights(path: str | Path, patches: Sequence[Patch]) -> tuple[dict[str, Tensor], NetworkConfig | None]:
    """A state-dict to start from, and the sizes of its network where they are told.

    Published SuperPoint weights, the running mean of a checkpoint, or an ONNX file of ``kpbench export-model``,
    ``superpoint`` and ``superpoint-small`` being those that ship. An ID head for other designs is left out.
    """
    path = _shipped(path)
    if path.suffix == ".onnx":
        content, weights = _read_exported(path)
    else:
        weights = read_weights(path)
        mean = {key.removeprefix("mean."): value for key, value in weights.items() if key.startswith("mean.")}
        if not mean:
            return weights, None
        content, weights = read_checkpoint(path)[0], mean
    same = content.get("designs") == designs_digest(patches)
    kept = {key: value for key, value in weights.items() if same or not key.startswith("descriptor_attached")}
    return kept, parse_recipe(content["recipe"], str(path)).network if "recipe" in content else None


def _read_exported(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """(content, weights) of an ONNX file of ``kpbench export-model``."""
    import onnx

    try:
        model = onnx.load(path)
        content = json.loads({p.key: p.value for p in model.metadata_props}.get("kpbench", "{}"))
    except Exception as error:  # protobuf's own, which is not public, among others
        why = (str(error) or type(error).__name__).splitlines()[0][:200]
        raise DataError(f"{path}: cannot be read as an ONNX model ({why})") from None
    if "int8" in content:
        raise DataError(f"{path}: holds 8-bit integers; start from the float32 file that it was made of")
    if content.get("recipe", {}).get("network", {}).get("norm") == "after":
        raise DataError(f"{path}: its BatchNorm, after the activation, cannot be put back; start from its checkpoint")
    return content, {t.name: torch.from_numpy(onnx.numpy_helper.to_array(t).copy()) for t in model.graph.initializer}


def _shipped(path: str | Path) -> Path:
    ours = PACKAGE / "detectors" / "weights" / f"{path}.onnx"
    return ours if ours.is_file() and not Path(path).is_file() else Path(path)
