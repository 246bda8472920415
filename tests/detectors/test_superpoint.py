import json

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper

from kpbench.detectors.heads import Decoding, decode
from kpbench.detectors.hypotheses import VerifiedCandidates
from kpbench.detectors.inference import open_session
from kpbench.detectors.interface import load_detector
from kpbench.detectors.superpoint import SmallSuperPointDetector, SuperPointDetector, pad_to_cells
from kpbench.errors import DataError
from kpbench.patches.design import parse_patch, shipped_patches

PATCHES = shipped_patches()


def heads(points, h, w, ids=None, spread=0.0):
    """Logits whose probability map has a keypoint, shared out bilinearly or as a Gaussian, at each point."""
    image = np.full((8 * h, 8 * w), 1e-9)
    rows, columns = np.mgrid[: 8 * h, : 8 * w]
    for x, y in points:
        if spread:
            blob = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * spread**2))
            image += blob / blob.sum()
        else:
            image += np.clip(1 - abs(columns - x), 0, 1) * np.clip(1 - abs(rows - y), 0, 1)
    cells = image.reshape(h, 8, w, 8).transpose(1, 3, 0, 2).reshape(64, h, w)
    detector = np.log(np.concatenate([cells, np.maximum(1 - cells.sum(0, keepdims=True), 1e-6)])).astype(np.float32)
    identity = np.zeros((5, h, w), np.float32)
    identity[4] = 5
    for (x, y), patch in zip(points, ids if ids is not None else (), strict=False):
        identity[patch, int(y) // 8, int(x) // 8] = 20
    return detector, identity


@given(st.floats(4, 59), st.floats(4, 43), st.floats(0, 1.2))
def test_the_position_is_the_mean_of_the_distribution_across_cell_borders(x, y, spread):
    found = decode(*heads([(x, y)], 6, 8, spread=spread if spread > 0.6 else 0.0))
    assert len(found) == 1
    # the window cuts the tails of a wide blob unevenly about a keypoint between two pixels
    np.testing.assert_allclose(found.xy[0], (x, y), atol=1e-3 if spread <= 0.6 else 0.05)
    assert found.score[0] > 0.9


@pytest.mark.parametrize("place", [(15.5, 20.0), (16.0, 16.0), (15.5, 15.5), (23.75, 8.25), (0.0, 0.0), (63.0, 47.0)])
def test_keypoints_on_cell_borders_and_at_the_corners_of_the_image_are_found_once(place):
    found = decode(*heads([place], 6, 8, [3]))
    np.testing.assert_allclose(found.xy, [place], atol=1e-4)
    assert found.patch_id.tolist() == [3]


def test_many_keypoints_keep_their_ids_and_come_best_first():
    points = [(10.2, 10.7), (30.0, 12.5), (50.9, 33.1), (20.4, 40.0)]
    detector, identity = heads(points, 6, 8, [0, 1, 2, 3])
    detector[64, 1, 3] += 1.0  # the second is less sure
    found = decode(detector, identity)
    assert len(found) == 4
    assert np.all(np.diff(found.score) <= 0)
    nearest = [int(np.argmin(np.hypot(*(np.array(points) - p).T))) for p in found.xy]
    assert found.patch_id.tolist() == nearest
    assert nearest[-1] == 1


def test_of_two_close_maxima_the_better_one_stays():
    detector, identity = heads([(20.0, 20.0), (24.0, 20.0)], 6, 8)
    assert len(decode(detector, identity, Decoding(threshold=0.1, separation_px=6))) == 1
    assert len(decode(detector, identity, Decoding(threshold=0.1, separation_px=3, window_px=1))) == 2


def test_nothing_is_found_where_nothing_is():
    found = decode(*heads([], 6, 8))
    assert len(found) == 0
    assert found.patch_id is not None


@given(st.integers(1, 40), st.integers(1, 40))
def test_padding_repeats_the_border_and_keeps_the_origin(height, width):
    grey = np.random.default_rng(0).integers(0, 256, (height, width), np.uint8)
    padded = pad_to_cells(grey)
    assert padded.shape == (-(-height // 8) * 8, -(-width // 8) * 8)
    assert np.array_equal(padded[:height, :width], grey)
    assert np.all(padded[height:, :width] == grey[-1])


def brightest_pixel_model(schema="kpbench.superpoint/1", patches=PATCHES):
    """A graph without training: each pixel's logit is its brightness, "no keypoint" is constant."""
    nodes = [
        helper.make_node("SpaceToDepth", ["image"], ["cells"], blocksize=8),
        helper.make_node("Mul", ["cells", "gain"], ["loud"]),
        helper.make_node("ReduceSum", ["cells", "axis"], ["sum"], keepdims=1),
        helper.make_node("Mul", ["sum", "zero"], ["flat"]),
        helper.make_node("Add", ["flat", "level"], ["none"]),
        helper.make_node("Concat", ["loud", "none"], ["detector"], axis=1),
        helper.make_node("Concat", ["flat", "none", "flat"], ["identity"], axis=1),
    ]
    constants = [
        helper.make_tensor("gain", TensorProto.FLOAT, [1], [40.0]),
        helper.make_tensor("zero", TensorProto.FLOAT, [1], [0.0]),
        helper.make_tensor("level", TensorProto.FLOAT, [1], [20.0]),
        helper.make_tensor("axis", TensorProto.INT64, [1], [1]),
    ]
    sides = ["b", 1, "h", "w"]
    graph = helper.make_graph(
        nodes,
        "brightest",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, sides)],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, ["b", "c", "h2", "w2"])
            for name in ("detector", "identity")
        ],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    content = {
        "schema": schema,
        "name": "brightest",
        "designs": "0" * 64,
        "samples": 0,
        "patches": [patches[0].to_dict() | {"id": 5}, patches[1].to_dict() | {"id": 7}],
    }
    helper.set_model_props(model, {"kpbench": json.dumps(content)})
    onnx.checker.check_model(model)
    return model.SerializeToString()


@pytest.fixture
def detector(tmp_path):
    path = tmp_path / "brightest.onnx"
    path.write_bytes(brightest_pixel_model())
    return SuperPointDetector(path, verified=False, threads=1)


@pytest.mark.parametrize("shape", [(40, 48), (41, 51), (9, 17), (40, 48, 3)])
def test_any_size_and_mode_is_accepted_and_ids_are_those_of_the_designs(detector, shape):
    image = np.zeros(shape, np.uint8)
    image[5, 13] = 255
    found = detector(image)
    np.testing.assert_allclose(found.xy, [(13, 5)], atol=1e-3)
    assert found.patch_id.tolist() == [7]


def test_what_lies_in_the_padding_is_no_detection(detector):
    image = np.zeros((9, 17), np.uint8)
    image[8, 16] = 255  # repeated over the padding, the last pixel becomes a bright square
    found = detector(image)
    assert np.all(found.xy < (16.5, 8.5))


def test_with_verification_a_bright_pixel_is_no_patch(detector):
    image = np.zeros((64, 64), np.uint8)
    image[30, 33] = 255
    assert len(detector(image)) == 1
    detector.verified = True
    assert len(detector(image)) == 0


@pytest.mark.parametrize("shape", [(1, 1), (3, 9), (12, 12), (15, 200)])
def test_a_tiny_image_is_verified_as_any_other(detector, shape):
    image = np.zeros(shape, np.uint8)
    image[0, 0] = 255
    detector.verified = True
    assert len(detector(image)) == 0


def test_a_design_without_an_edge_at_its_centre_is_left_to_the_network(tmp_path):
    halves = [{"radius": 0.5, "start_deg": start, "ink": "black"} for start in (0, 180)]
    bullseye = parse_patch({"name": "eye", "id": 9, "semicircles": halves}, "eye.toml")
    path = tmp_path / "eye.onnx"
    path.write_bytes(brightest_pixel_model(patches=(PATCHES[0], bullseye)))
    image = np.zeros((40, 48), np.uint8)
    image[5, 13] = 255
    assert SuperPointDetector(path)(image).patch_id.tolist() == [7]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no model", r"weights\.onnx: cannot be read as an ONNX model"),
        (brightest_pixel_model("other/1"), r"weights\.onnx: not written by kpbench export-model"),
    ],
)
def test_a_file_that_is_no_model_of_ours_is_one_line(tmp_path, content, message):
    path = tmp_path / "weights.onnx"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        SuperPointDetector(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DataError, match=r"nowhere\.onnx: cannot be read"):
        SuperPointDetector(tmp_path / "nowhere.onnx")


@pytest.mark.parametrize("name", ["superpoint", "superpoint-small"])
def test_the_shipped_weights_find_large_clean_patches(name):
    """An easy scene, in which a wrong file, frame or channel order is seen."""
    from kpbench.render.placement import Limits
    from kpbench.synth.synthetic import SynthConfig

    detect = load_detector(name)
    limits = Limits(count=(4, 4), radius_px=(15, 30), tilt_deg=20, black=(0, 30), white=(220, 255))
    truths = found = right = 0
    for n in range(3):
        sample = SynthConfig(3, seed=4, deteriorate="none", limits=limits).make(n)[0]
        detections = detect(sample.image)
        for k in sample.keypoints:
            distance = np.hypot(*(detections.xy - [k["x"], k["y"]]).T)
            truths += 1
            if distance.min() <= 0.1 * k["radius_major"]:
                found += 1
                right += int(detections.patch_id[distance.argmin()] == k["patch_id"])
    assert found >= 0.75 * truths
    assert right >= 0.75 * found


@pytest.mark.parametrize("x", [-0.6, -0.4, 99.4, 99.6])
def test_a_verified_detection_lies_in_the_image(monkeypatch, x):
    """A fit may move a centre over the image's border, which is half a pixel outside the last pixel's centre."""
    A = np.eye(2)[None]
    pose = np.array([[x, 50.0]]), 20.0 * A, 0.01 * A, np.array([0.5])
    fitted = VerifiedCandidates(np.array([0]), np.array([1]), *pose, np.array([0.9]))
    monkeypatch.setattr("kpbench.detectors.superpoint.verify_candidates", lambda *candidates: fitted)
    found = SmallSuperPointDetector()(np.zeros((100, 100), np.uint8))
    assert len(found) == (-0.5 < x < 99.5)


def test_a_batch_gives_what_single_images_give(detector):
    images = np.zeros((3, 41, 51), np.uint8)
    images[0, 5, 13] = images[2, 30, 40] = 255
    for together, alone in zip(detector.batch(list(images)), map(detector, images), strict=True):
        np.testing.assert_allclose(together.xy, alone.xy, atol=1e-4)
    assert [len(found) for found in detector.batch(list(images))] == [1, 0, 1]
    assert detector.batch([]) == []
    with pytest.raises(DataError, match="images of one size"):
        detector.batch([images[0], images[0, :40]])


def test_strips_of_a_large_picture_give_what_the_whole_gives(monkeypatch):
    detector = SmallSuperPointDetector(threads=1)
    image = np.random.default_rng(0).integers(0, 255, (400, 203), np.uint8)
    whole = detector.heads([image])
    monkeypatch.setattr("kpbench.detectors.superpoint.STRIP_PIXELS", 208 * 137)
    for one, other in zip(whole, detector.heads([image]), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("height", "width", "smallest"), [(480, 640, 60.0), (3000, 4000, 93.75), (99, 400, 49.5), (20, 20, 10.0)]
)
def test_octaves_go_on_to_a_short_side_of_fifty_pixels(height, width, smallest):
    scales = SmallSuperPointDetector().view_scales(height, width)
    assert scales[:2] == (1.2, 0.5)
    assert min(height, width) * scales[-1] == pytest.approx(smallest)


def test_weights_are_a_detector_by_the_name_of_their_file(tmp_path):
    path = tmp_path / "own.onnx"
    path.write_bytes(brightest_pixel_model())
    assert load_detector(str(path)).name == "own"  # the file's, so that weights can be told apart
    with pytest.raises(DataError, match=r"other\.onnx: cannot be read"):
        load_detector(str(tmp_path / "other.onnx"))


@pytest.mark.parametrize(("asked", "message"), [("fast", "expected one of: auto, cpu"), ("cuda", "has no CUDA")])
def test_a_runtime_that_is_not_there_is_one_line(monkeypatch, asked, message):
    monkeypatch.setenv("KPBENCH_RUNTIME", asked)
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(DataError, match=message):
        open_session(brightest_pixel_model())


def test_openvino_gives_what_onnx_runtime_gives(monkeypatch):
    pytest.importorskip("openvino")
    image = {"image": np.random.default_rng(0).random((2, 1, 16, 24), np.float32)}
    plain = open_session(brightest_pixel_model())[0].run(None, image)
    monkeypatch.setenv("KPBENCH_RUNTIME", "openvino")
    other, content = open_session(brightest_pixel_model())
    assert json.loads(content)["name"] == "brightest"
    for a, b in zip(plain, other.run(None, image), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)
