import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from kpbench.errors import DataError
from kpbench.training.losses import compute_losses, make_targets
from kpbench.training.network import SuperPoint
from kpbench.training.recipe import LossConfig, NetworkConfig
from kpbench.training.weights import grow_network, load_into_network, read_weights

TINY = NetworkConfig(widths=(4, 4, 8, 8), depths=(1, 1, 1, 1), head_width=8, descriptor_width=8)


def published_layout(seed=0):
    """Names and shapes of ``superpoint_v6_from_tf.pth``, written down by hand, with random values."""
    tensors = {}
    generator = torch.Generator().manual_seed(seed)

    def block(name, c_in, c_out, kernel):
        tensors[f"{name}.conv.weight"] = torch.randn(c_out, c_in, kernel, kernel, generator=generator)
        tensors[f"{name}.conv.bias"] = torch.randn(c_out, generator=generator)
        for part in ("weight", "bias", "running_mean", "running_var"):
            tensors[f"{name}.bn.{part}"] = torch.rand(c_out, generator=generator)
        tensors[f"{name}.bn.num_batches_tracked"] = torch.tensor(0)

    before = 1
    for stage, width in enumerate((64, 64, 128, 128)):
        block(f"backbone.{stage}.0", before, width, 3)
        block(f"backbone.{stage}.1", width, width, 3)
        before = width
    for head, width in (("detector", 65), ("descriptor", 256)):
        block(f"{head}.0", 128, 256, 3)
        block(f"{head}.1", 256, width, 1)
    return tensors


@pytest.mark.parametrize("down", ["max", "stride"])
@pytest.mark.parametrize("norm", ["before", "after"])
def test_forward_gives_raw_heads_a_cell(down, norm):
    network = SuperPoint(NetworkConfig((4, 4, 8, 8), (1, 2, 1, 2), down, 8, 8, norm)).eval()
    detector, ids = network(torch.rand(2, 1, 40, 56))
    assert detector.shape == (2, 65, 5, 7)
    assert ids.shape == (2, 5, 5, 7)


def test_an_untrained_network_starts_at_the_prior():
    torch.manual_seed(0)
    detector, ids = SuperPoint(TINY).eval()(torch.zeros(1, 1, 32, 32))
    assert torch.softmax(detector, 1)[:, -1].mean().item() == pytest.approx(0.98, abs=0.01)
    assert torch.softmax(ids, 1)[:, -1].mean().item() == pytest.approx(0.98, abs=0.01)


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_published_weights_fit_and_the_attached_layers_stay_fresh(tmp_path, suffix):
    path = tmp_path / f"weights{suffix}"
    tensors = published_layout()
    save_file(tensors, path) if suffix == ".safetensors" else torch.save(tensors, path)
    network = SuperPoint(NetworkConfig(norm="after"))
    attached = [p.clone() for p in network.attached]
    line = load_into_network(network, read_weights(path), path.name)
    assert line == f"weights{suffix}: 72 tensors matched; not in it: descriptor_attached, detector_attached"
    assert torch.equal(network.backbone[3][1].conv.weight, tensors["backbone.3.1.conv.weight"])
    assert torch.equal(network.descriptor[1].bn.running_var, tensors["descriptor.1.bn.running_var"])
    assert all(torch.equal(a, b) for a, b in zip(attached, network.attached, strict=True))


def change(name, value):
    tensors = published_layout()
    if value is None:
        del tensors[name]
    else:
        tensors[name] = value
    return tensors


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("encoder.0.weight", torch.zeros(1), "f: encoder.0.weight has no place in this network"),
        ("backbone.0.0.conv.bias", None, "f: backbone.0.0.conv.bias is missing"),
        ("detector.0.conv.bias", torch.zeros(3), r"f: detector.0.conv.bias has shape \(3,\), expected \(256,\)"),
    ],
)
def test_weights_that_do_not_fit_are_refused(name, value, message):
    network = SuperPoint(NetworkConfig(norm="after"))
    with pytest.raises(DataError, match=f"^{message}$"):
        load_into_network(network, change(name, value), "f")


@pytest.mark.parametrize("down", ["max", "stride"])
def test_a_grown_network_computes_what_the_smaller_one_does(down):
    torch.manual_seed(0)
    smaller = SuperPoint(NetworkConfig((4, 4, 8, 8), (1, 2, 1, 1), down, 8, 8)).eval()
    for name, tensor in smaller.named_parameters():
        if ".bn." in name:
            torch.nn.init.uniform_(tensor, 0.5, 1.5)
    network = SuperPoint(NetworkConfig((6, 4, 12, 16), (2, 2, 1, 3), down, 12, 8)).eval()
    images = torch.rand(4, 1, 40, 56)
    line = grow_network(network, smaller, images, "small.onnx")
    assert line == "grown into another network, convolutions added: 3, left out: 0"
    with torch.no_grad():
        for mine, theirs in zip(network(images), smaller(images), strict=True):
            assert theirs.std() > 0.01
            torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4)


def test_convolutions_beyond_a_stages_depth_are_left_out_whatever_halves():
    smaller = SuperPoint(NetworkConfig((4, 4, 8, 8), (1, 2, 2, 4), "stride", 8, 8)).eval()
    network = SuperPoint(NetworkConfig((6, 4, 12, 8), (2, 2, 1, 2), "max", 12, 8)).eval()
    line = grow_network(network, smaller, torch.rand(4, 1, 40, 56), "small.onnx")
    assert line == "grown into another network, convolutions added: 1, left out: 3"
    for stage, layer in ((0, 0), (1, 0), (1, 1), (2, 0), (3, 0), (3, 1)):
        own, theirs = (net.backbone[stage][layer].conv.weight for net in (network, smaller))
        assert torch.equal(own[: len(theirs), : theirs.shape[1]], theirs)
        assert not own[: len(theirs), theirs.shape[1] :].any()  # what is new is not listened to


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"widths": (4, 4, 8, 6)}, "small.onnx: stage 4 is 8 wide, expected at most 6"),
        ({"descriptor_width": 4}, "small.onnx: descriptor.1 is 8 wide, expected at most 4"),
        (
            {"norm": "after"},
            "small.onnx: differs from [network], and can grow only where norm is 'before' in both",
        ),
    ],
)
def test_what_is_larger_somewhere_does_not_grow(change, message):
    network = SuperPoint(replace(TINY, **change))
    with pytest.raises(DataError, match=f"^{re.escape(message)}$"):
        grow_network(network, SuperPoint(TINY), torch.zeros(1, 1, 16, 16), "small.onnx")


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("content", [b"", b"no weights at all"])
def test_a_damaged_weights_file_is_one_line(tmp_path, suffix, content):
    path = tmp_path / f"weights{suffix}"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"weights\.\w+: cannot be read as weights") as caught:
        read_weights(path)
    assert "\n" not in str(caught.value)


def test_a_pickle_of_other_keys_is_one_line(tmp_path):
    torch.save({0: torch.zeros(1)}, tmp_path / "a.pth")
    with pytest.raises(DataError, match=r"a\.pth: holds no state-dict"):
        read_weights(tmp_path / "a.pth")


class Harm:
    def __reduce__(self):
        return print, ("executed",)


def test_a_pickle_that_would_run_code_is_refused(tmp_path, capsys):
    path = tmp_path / "weights.pth"
    torch.save({"a": Harm()}, path)
    with pytest.raises(DataError, match="cannot be read as weights"):
        read_weights(path)
    assert "executed" not in capsys.readouterr().out


def test_a_pickle_of_something_else_is_refused(tmp_path):
    path = tmp_path / "weights.pth"
    torch.save([torch.zeros(1)], path)
    with pytest.raises(DataError, match="holds no state-dict"):
        read_weights(path)


def one_keypoint(x, y, patch=2, ignore=0.0):
    return torch.tensor([[[x, y, patch, ignore], [0.0, 0.0, -1.0, 0.0]]])


@pytest.mark.parametrize(("x", "y"), [(12.25, 20.5), (7.75, 15.25), (31.0, 0.0), (16.0, 23.9)])
def test_split_targets_have_the_keypoint_as_their_mean(x, y):
    targets = make_targets(one_keypoint(x, y), 40, 48, 4, "split")
    assert torch.allclose(targets.place.sum(1), torch.ones(1, 5, 6))
    pixels = targets.place[0, :64].reshape(8, 8, 5, 6).permute(2, 0, 3, 1).reshape(40, 48)
    assert pixels.sum() == pytest.approx(1, abs=1e-6)
    assert (pixels.sum(0) * torch.arange(48)).sum() == pytest.approx(x, abs=1e-5)
    assert (pixels.sum(1) * torch.arange(40)).sum() == pytest.approx(y, abs=1e-5)


def test_pixel_targets_are_one_hot_at_the_nearest_pixel():
    targets = make_targets(one_keypoint(12.4, 20.6), 40, 48, 4, "pixel")
    # row 21 = 2·8 + 5, column 12 = 1·8 + 4
    assert targets.place[0, 5 * 8 + 4, 2, 1] == 1
    assert targets.place[0, :64].sum() == 1


def test_identity_is_trained_near_keypoints_and_far_from_all():
    targets = make_targets(one_keypoint(11.5, 11.5), 64, 64, 4, "split")
    assert targets.identity[0, 1, 1] == 2
    assert targets.near[0].sum() == 5  # the cell and its four neighbours, whose centres are 8 px away
    assert set(targets.identity[0][~targets.near[0]].tolist()) == {4}
    assert not (targets.near & targets.far).any()
    assert not targets.far[0, 1, 3]
    assert targets.far[0, 7, 7]


def test_ignored_keypoints_ask_for_nothing_around_them():
    targets = make_targets(one_keypoint(11.5, 11.5, ignore=6.0), 64, 64, 4, "split")
    assert targets.place[0, 64].min() == 1
    assert targets.valid[0, 1, 1] == 0
    assert targets.valid[0, 5, 5] == 1
    assert not targets.near.any()


@pytest.mark.parametrize("identity", ["entropy", "hinge"])
def test_perfect_heads_lose_nothing_and_wrong_ones_do(identity):
    config = LossConfig(place="pixel", identity=identity)
    targets = make_targets(one_keypoint(20.0, 20.0), 64, 64, 4, "pixel")
    detector = 50 * targets.place
    ids = 50 * torch.nn.functional.one_hot(targets.identity, 5).permute(0, 3, 1, 2).float()
    if identity == "hinge":  # a keypoint's class belongs to the cell that it lies in alone
        inside = targets.place[:, 64] < 1
        ids = 50 * torch.nn.functional.one_hot(torch.where(inside, targets.identity, 4), 5).permute(0, 3, 1, 2).float()
    located, identified = compute_losses(detector, ids, targets, config)
    assert located.item() == pytest.approx(0, abs=1e-6)
    assert identified.item() == pytest.approx(0, abs=1e-6)
    located, identified = compute_losses(detector.roll(1, 1), ids.roll(1, 1), targets, config)
    assert located > 1
    assert identified > 0.1


def test_hinge_equals_the_sum_over_pairs_of_cells():
    """SuperPoint's loss written out pair by pair, as in its paper."""
    torch.manual_seed(0)
    config = LossConfig(identity="hinge", lambda_d=250.0, positive_margin=0.9, negative_margin=0.2)
    targets = make_targets(one_keypoint(20.0, 20.0), 32, 40, 4, "pixel")
    ids = torch.randn(1, 5, 4, 5)
    classes = np.full(20, 4)
    classes[2 * 5 + 2] = 2
    descriptors = (ids / ids.norm(dim=1, keepdim=True))[0].reshape(5, 20).T.numpy()
    total = 0.0
    for a in range(20):
        for b in range(20):
            dot = descriptors[a, classes[b]]
            if a == b:
                total += 250.0 * max(0.0, 0.9 - dot)
            elif classes[a] != classes[b]:
                total += max(0.0, dot - 0.2)
    detector = torch.zeros(1, 65, 4, 5)
    assert compute_losses(detector, ids, targets, config)[1].item() == pytest.approx(total / 400, rel=1e-5)


def test_focal_weight_spares_what_is_already_right():
    targets = make_targets(one_keypoint(20.0, 20.0), 64, 64, 4, "pixel")
    ids = torch.zeros(1, 5, 8, 8)
    right = 6 * targets.place
    plain, focal = (compute_losses(right, ids, targets, LossConfig(focal=f))[0] for f in (0.0, 2.0))
    assert focal < 0.2 * plain
