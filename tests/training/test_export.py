import json

import cv2
import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from kpbench.detectors.superpoint import SuperPointDetector
from kpbench.errors import DataError
from kpbench.patches.design import shipped_patches
from kpbench.training.export import export_onnx, fold_batchnorm, to_onnx
from kpbench.training.loop import TrainOptions, train
from kpbench.training.network import SuperPoint
from kpbench.training.quantise import export_int8
from kpbench.training.recipe import NetworkConfig, Phase, Recipe
from kpbench.training.weights import read_initial_weights

SIZES = {"widths": (4, 4, 8, 8), "depths": (1, 2, 1, 1), "head_width": 8, "descriptor_width": 8}


def lively(config):
    """A network whose BatchNorms have something to fold."""
    torch.manual_seed(1)
    network = SuperPoint(config).train()
    for _ in range(3):
        network(torch.rand(2, 1, 32, 32))
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, -1.0, 2.0)
            torch.nn.init.uniform_(module.bias, -1.0, 1.0)
    return network.eval()


@pytest.mark.parametrize("norm", ["before", "after"])
@pytest.mark.parametrize("down", ["max", "stride"])
def test_onnx_gives_what_pytorch_gives_at_any_size(norm, down):
    network = lively(NetworkConfig(norm=norm, down=down, **SIZES))
    images = [torch.rand(b, 1, h, w) for b, h, w in ((1, 64, 64), (3, 8, 24), (1, 104, 72))]
    with torch.inference_mode():
        expected = [[part.numpy() for part in network(image)] for image in images]
    session = onnxruntime.InferenceSession(to_onnx(fold_batchnorm(network), {}), providers=["CPUExecutionProvider"])
    for image, wanted in zip(images, expected, strict=True):
        got = session.run(None, {"image": image.numpy()})
        for a, b in zip(got, wanted, strict=True):
            assert a.dtype == np.float32
            np.testing.assert_allclose(a, b, atol=1e-4)


def test_folding_leaves_no_batchnorm_in_the_graph():
    model = onnx.load_from_string(to_onnx(fold_batchnorm(lively(NetworkConfig(**SIZES))), {}))
    kinds = {node.op_type for node in model.graph.node}
    assert kinds <= {"Conv", "Relu", "MaxPool", "Identity"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of two steps, exported: its folder, and what the export said."""
    folder = tmp_path_factory.mktemp("run")
    recipe = Recipe("tiny", (Phase(8),), network=NetworkConfig(**SIZES), batch=4)
    (folder / "photos").mkdir()
    cv2.imwrite(str(folder / "photos" / "a.png"), np.full((64, 64), 99, np.uint8))
    assert train(recipe, folder, folder / "photos", options=TrainOptions(workers=0, validation_images=1))
    return folder, export_onnx(folder / "checkpoint.safetensors", folder / "tiny.onnx")


def test_export_writes_the_mean_weights_and_says_what_they_are(run):
    folder, done = run
    assert done.difference < 1e-4
    assert done.step == 2
    model = onnx.load(folder / "tiny.onnx")
    content = json.loads({p.key: p.value for p in model.metadata_props}["kpbench"])
    assert content["name"] == "tiny"
    assert content["samples"] == 8
    assert [p["id"] for p in content["patches"]] == [0, 1, 2, 3]
    assert content["recipe"]["network"]["widths"] == [4, 4, 8, 8]


def test_eight_bits_give_nearly_the_same_and_always_the_same_file(run, tmp_path):
    exact = run[0] / "tiny.onnx"
    done = [export_int8(exact, tmp_path / name) for name in ("a.onnx", "b.onnx")]
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()
    assert done[0] == done[1]
    image = np.random.default_rng(1).random((2, 1, 40, 56), np.float32)
    both = (
        onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"]).run(None, {"image": image})
        for path in (exact, tmp_path / "a.onnx")
    )
    for wanted, got in zip(*both, strict=True):
        assert 0 < np.abs(wanted - got).max() < 0.1 * np.abs(wanted).max()
    assert "-8-int8-" in SuperPointDetector(tmp_path / "a.onnx").version


def test_eight_bits_come_from_an_exported_file_and_lead_nowhere(run, tmp_path):
    folder, _ = run
    export_int8(folder / "tiny.onnx", tmp_path / "int8.onnx")
    with pytest.raises(DataError, match=r"int8\.onnx: expected a float32 network"):
        export_int8(tmp_path / "int8.onnx", tmp_path / "twice.onnx")
    with pytest.raises(DataError, match=r"int8\.onnx: holds 8-bit integers; start from the float32 file"):
        read_initial_weights(tmp_path / "int8.onnx", shipped_patches())
    with pytest.raises(DataError, match=r"checkpoint\.safetensors: cannot be read as an ONNX file"):
        export_int8(folder / "checkpoint.safetensors", tmp_path / "no.onnx")


def test_a_file_that_is_no_checkpoint_is_one_line(tmp_path):
    (tmp_path / "x.safetensors").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"x\.safetensors: cannot be read as a checkpoint") as caught:
        export_onnx(tmp_path / "x.safetensors", tmp_path / "x.onnx")
    assert "\n" not in str(caught.value)
