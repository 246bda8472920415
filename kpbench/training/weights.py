"""Initial weights: from a published file, an exported file or a checkpoint.

If the initial weights belong to a smaller network, the smaller network grows (:func:`grow_network`).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from kpbench.detectors.verification import WEIGHTS
from kpbench.errors import DataError, system_reason
from kpbench.files import open_file, read_bytes
from kpbench.patches.design import Patch
from kpbench.training.batches import load_photos, make_batch
from kpbench.training.checkpoint import TrainingState, digest_designs, empty_network, read_checkpoint, start_state
from kpbench.training.network import SuperPoint, network_input
from kpbench.training.recipe import NetworkConfig, parse_recipe

BATCHNORM_PX = 128 * 96 * 96
"""Total number of px of the samples that initialise BatchNorm. The number of samples is limited to 2 to 128."""


def load_initial_weights(
    state: TrainingState,
    init: str | Path,
    patches: Sequence[Patch],
    backgrounds: str | Path | None,
    device: torch.device,
) -> str:
    """Load initial weights into a fresh training.

    If the weights belong to a network of other sizes, :func:`grow_network` starts the network from that network.

    Parameters
    ----------
    state : TrainingState
        Changed in place.
    init : str or Path
        See :func:`read_initial_weights`.
    patches : sequence of Patch
    backgrounds : path or None
        Photographs of the training, see :func:`kpbench.training.load_photos`.
    device : torch.device

    Returns
    -------
    str
        One line that tells which weights were loaded.

    Raises
    ------
    DataError
        If the weights cannot be read or do not fit.
    """
    recipe, network = state.recipe, state.network
    weights, sizes = read_initial_weights(init, patches)
    their_config = replace(sizes or recipe.network, ids=recipe.network.ids)
    same_sizes = their_config == recipe.network
    if not same_sizes:  # before memory is taken for the sizes that the file declares
        _require_fitting(empty_network(their_config).state_dict(), weights, str(init))
    theirs = network if same_sizes else start_state(replace(recipe, network=their_config), device).network
    line = load_into_network(theirs, weights, str(init))
    if is_folded(weights) or not same_sizes:
        photos = load_photos(backgrounds, "training")
        width, height = recipe.samples.size
        count = max(2, min(128, BATCHNORM_PX // (width * height)))
        batch = make_batch(recipe.samples, patches, photos, recipe.seed, 0, count, recipe.phase(0)[1])
        images = network_input(torch.from_numpy(batch.images).to(device))
        if is_folded(weights):
            restore_batchnorm(theirs, [images])
        if not same_sizes:
            line += f"; {grow_network(network, theirs, images, str(init))}"
    state.mean.load_state_dict(network.state_dict())
    return line


def read_initial_weights(name: str | Path, patches: Sequence[Patch]) -> tuple[dict[str, Tensor], NetworkConfig | None]:
    """Read weights to start from.

    Parameters
    ----------
    name : str or Path
        ``superpoint`` or ``superpoint-small`` (the shipped weights), an ONNX file of ``kpbench export-model``, a
        checkpoint (its running mean is read), or published SuperPoint weights.
    patches : sequence of Patch
        Designs of the training. If the weights were trained on other designs, the weights of the ID head's attached
        layer are left out.

    Returns
    -------
    weights : dict of str to Tensor
    sizes : NetworkConfig or None
        Sizes of the network that the weights belong to; None if the file does not hold the sizes.
    """
    shipped = WEIGHTS / f"{name}.onnx"
    path = shipped if shipped.is_file() and not Path(name).is_file() else Path(name)
    if path.suffix == ".onnx":
        content, weights = _read_exported(path)
    else:
        weights = read_weights(path)
        mean = {key.removeprefix("mean."): value for key, value in weights.items() if key.startswith("mean.")}
        if not mean:
            return weights, None
        content, weights = read_checkpoint(path)[0], mean
    same_designs = content.get("designs") == digest_designs(patches)
    kept = {key: value for key, value in weights.items() if same_designs or not key.startswith("descriptor_attached")}
    return kept, parse_recipe(content["recipe"], str(path)).network if "recipe" in content else None


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Read a state-dict from a safetensors file, or from a PyTorch file of which only tensors are unpickled.

    Raises
    ------
    DataError
        If the file cannot be read, or is no dict of named tensors.
    """
    from safetensors.torch import load

    try:
        if Path(path).suffix == ".safetensors":
            return dict(load(read_bytes(path)))
        with open_file(path) as file:
            loaded = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # PyTorch's unpickler raises anything on a damaged file
        why = system_reason(error) or "neither safetensors nor PyTorch's own"
        raise DataError(f"{path}: cannot be read as weights ({why})") from None
    if not isinstance(loaded, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in loaded.items()
    ):
        raise DataError(f"{path}: holds no state-dict, expected names with tensors")
    return loaded


def _read_exported(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the metadata and the weights of an ONNX file of ``kpbench export-model``."""
    import onnx

    try:
        model = onnx.load_from_string(read_bytes(path))
        content = json.loads({p.key: p.value for p in model.metadata_props}.get("kpbench", "{}"))
        weights = {t.name: torch.from_numpy(onnx.numpy_helper.to_array(t).copy()) for t in model.graph.initializer}
        if not isinstance(content, dict):
            raise ValueError("its metadata are no JSON object")
        recipe = parse_recipe(content["recipe"], str(path)) if "recipe" in content else None
    except Exception as error:  # protobuf raises errors of private classes
        why = system_reason(error) or (str(error) or type(error).__name__).splitlines()[0][:200]
        raise DataError(f"{path}: cannot be read as an ONNX model ({why})") from None
    if "int8" in content:
        raise DataError(f"{path}: holds 8-bit integers; start from the float32 file that it was made of")
    if recipe is not None and recipe.network.norm == "after":
        raise DataError(f"{path}: its BatchNorm, after the activation, cannot be put back; start from its checkpoint")
    return content, weights


def load_into_network(network: SuperPoint, weights: Mapping[str, Tensor], source: str) -> str:
    """Load a state-dict into a network. Attached layers that the state-dict lacks keep their random weights.

    Parameters
    ----------
    network : SuperPoint
        Changed in place.
    weights : dict of str to Tensor
        The state-dict. BatchNorm may be missing from the whole state-dict; see :func:`restore_batchnorm`.
    source : str
        Name of the file, for messages.

    Returns
    -------
    str
        One line that tells how many tensors matched and which layers keep their random weights.

    Raises
    ------
    DataError
        If a tensor has a name that the network does not know, if a tensor has a wrong shape, or if a tensor outside the
        attached layers is missing.
    """
    given, fresh = _require_fitting(network.state_dict(), weights, source)
    network.load_state_dict({name: weights[name] for name in given}, strict=False)
    return f"{source}: {len(given)} tensors matched; not in it: {', '.join(fresh) or 'nothing'}"


def _require_fitting(
    own: Mapping[str, Tensor], weights: Mapping[str, Tensor], source: str
) -> tuple[set[str], list[str]]:
    """Return the names of the tensors to load, and the names of the layers that keep their random weights."""
    bare = is_folded(weights)
    # BatchNorm counts its batches; this count is no weight, and some files lack the count
    ours = {name for name in own if not (name.endswith("num_batches_tracked") or (bare and ".bn." in name))}
    needed = {name for name in ours if "_attached" not in name}
    given = {name for name in weights if not name.endswith("num_batches_tracked")}
    for name in sorted(given - set(own)):
        raise DataError(f"{source}: {name} has no place in this network")
    for name in sorted(needed - given):
        raise DataError(f"{source}: {name} is missing")
    for name in sorted(given):
        if own[name].shape != weights[name].shape:
            theirs, expected = tuple(weights[name].shape), tuple(own[name].shape)
            raise DataError(f"{source}: {name} has shape {theirs}, expected {expected}")
    return given, sorted({name.split(".")[0] for name in ours - given})


def is_folded(weights: Mapping[str, Tensor]) -> bool:
    """Return whether a state-dict has no BatchNorm. The export folds BatchNorm into the convolutions."""
    return not any(".bn." in name for name in weights)


def restore_batchnorm(network: nn.Module, inputs: Iterable[Tensor], layers: Iterable[nn.Module] | None = None) -> None:
    """Reverse the folding of BatchNorm: make each BatchNorm the identity, so that the network can be trained again.

    The mean and the variance of the features that reach a BatchNorm, measured on ``inputs``, set the statistics, the
    weight and the bias of this BatchNorm. ``inputs`` : arguments of the network. ``layers`` : the BatchNorms that are
    changed; None: all.
    """

    def become_identity(module: nn.Module, given: tuple[Tensor]) -> None:
        bn = cast(nn.BatchNorm2d, module)
        variance, mean = torch.var_mean(given[0], (0, 2, 3), correction=0)
        cast(Tensor, bn.running_mean).copy_(mean)
        cast(Tensor, bn.running_var).copy_(variance)
        bn.weight.copy_((variance + bn.eps).sqrt())
        bn.bias.copy_(mean)

    chosen = [m for m in network.modules() if isinstance(m, nn.BatchNorm2d)] if layers is None else layers
    hooks = [m.register_forward_pre_hook(become_identity) for m in chosen]
    mode = network.training
    with torch.no_grad():
        network.eval()(*inputs)
    network.train(mode)
    for hook in hooks:
        hook.remove()


@torch.no_grad()
def grow_network(network: SuperPoint, smaller: SuperPoint, images: Tensor, source: str) -> str:
    """Start a network from a trained network of less width or another depth (Chen et al., *Net2Net*, ICLR 2016).

    In each layer, the first channels are copied from the smaller network; these are the trained channels. The other
    channels keep their random weights. The weights from random channels to trained channels are 0. In each stage,
    convolutions that the smaller network lacks become the identity, and surplus convolutions of the smaller network are
    left out. The network then computes the same outputs as the smaller network, with two exceptions: if convolutions
    are left out, or if the two networks halve the image in different ways.

    Parameters
    ----------
    network : SuperPoint
        Changed in place.
    smaller : SuperPoint
        The trained network, with BatchNorm; see :func:`restore_batchnorm`.
    images : Tensor of shape (B, 1, H, W)
        Images in [0, 1]. On these images, the BatchNorm of each added convolution becomes the identity.
    source : str
        Name of the smaller network, for messages.

    Returns
    -------
    str
        A few words that tell how many convolutions were added and left out.

    Raises
    ------
    DataError
        If a layer of the smaller network is wider than the same layer of the network, or if one of the two networks has
        BatchNorm after the activation.
    """
    # with BatchNorm after the activation, an added convolution cannot be the identity: the BatchNorm before it gives
    # negative values, and the activation after it cuts off negative values
    if "after" in (smaller.config.norm, network.config.norm):
        raise DataError(f"{source}: differs from [network], and can grow only where norm is 'before' in both")
    identities: list[nn.Module] = []
    width, left_out = 1, 0
    for n, (stage, theirs) in enumerate(zip(network.backbone, smaller.backbone, strict=True)):
        for layer, given in zip_longest(_blocks(stage), _blocks(theirs)):
            if layer is None:
                left_out += 1
            elif given is None:
                nn.init.dirac_(cast(Tensor, layer.get_submodule("conv").weight)[:width])
                identities.append(layer.get_submodule("bn"))
            else:
                width = _copy_channels(layer, given, width, f"{source}: stage {n + 1}")
    for head in ("detector", "descriptor"):
        inputs = width
        for name in (f"{head}.0", f"{head}.1", f"{head}_attached"):
            layer, given = network.get_submodule(name), smaller.get_submodule(name)
            inputs = _copy_channels(layer, given, inputs, f"{source}: {name}")
    restore_batchnorm(network, [images], identities)
    return f"grown into another network, convolutions added: {len(identities)}, left out: {left_out}"


def _blocks(stage: nn.Module) -> list[nn.Module]:
    """Return the convolutions of a stage, each with its BatchNorm."""
    return [part for part in stage.children() if isinstance(part, nn.Sequential)]


def _copy_channels(layer: nn.Module, given: nn.Module, inputs: int, place: str) -> int:
    """Copy a trained convolution and its BatchNorm into the first channels of a layer; return the number of channels.

    ``inputs`` : number of input channels that are trained. ``place`` : name of the layer, for messages.
    """
    own, theirs = (cast(nn.Conv2d, getattr(part, "conv", part)) for part in (layer, given))
    width = theirs.out_channels
    if width > own.out_channels:
        raise DataError(f"{place} is {width} wide, expected at most {own.out_channels}")
    own.weight[:width] = 0
    own.weight[:width, :inputs] = theirs.weight
    cast(Tensor, own.bias)[:width] = cast(Tensor, theirs.bias)
    if layer is not own:
        kept = layer.get_submodule("bn").state_dict()
        for key, value in given.get_submodule("bn").state_dict().items():
            if value.ndim:
                kept[key][:width] = value
    return width
