"""Only regular files are read, up to a limit; what declares much work is tried or measured before memory is taken."""

import io
import json
import os
import re
import resource
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

import kpbench
from kpbench import memory
from kpbench.cli import main
from kpbench.containers import require_sound_container
from kpbench.detectors import TemplateDetector
from kpbench.errors import DataError, KpbenchError, KpbenchWarning
from kpbench.files import read_bytes
from kpbench.images import open_images, read_rgb
from kpbench.predictions import open_coco
from kpbench.printing import correct_sidecars
from kpbench.synth import load_augmentation

PACKAGE = Path(kpbench.__file__).parent


def read_checkpoint(path):
    from kpbench.training.checkpoint import read_checkpoint

    return read_checkpoint(path)


def read_weights(path):
    from kpbench.training.weights import read_initial_weights

    return read_initial_weights(path, kpbench.shipped_patches())


READERS = {
    "a.png": lambda path: open_images(str(path)),
    "a.avi": lambda path: open_images(str(path)),
    "dataset.json": lambda path: kpbench.open_dataset(path.parent),
    "a.toml": lambda path: kpbench.load_patches([path]),
    "pipeline.json": load_augmentation,
    "truth.json": open_coco,
    "sidecar.json": lambda path: correct_sidecars(path.parent, 99.0),
    "a.onnx": lambda path: kpbench.load_detector(str(path)),
    "a.safetensors": read_weights,
    "b.safetensors": read_checkpoint,
    "c.onnx": read_weights,
    "d.pth": read_weights,
    **{f"p{suffix}": kpbench.read_predictions for suffix in (".json", ".jsonl", ".csv", ".parquet", ".h5")},
}


@pytest.mark.parametrize("name", READERS)
def test_no_reader_reads_a_device_or_a_pipe(tmp_path, name):
    for kind, make in (("device", lambda path: path.symlink_to("/dev/zero")), ("pipe", os.mkfifo)):
        path = tmp_path / kind / name
        path.parent.mkdir()
        make(path)
        with pytest.raises(KpbenchError, match=rf"{name}.*it is a {kind}, expected a file"):
            READERS[name](path)


def test_a_picture_of_annotations_that_is_a_pipe_is_no_picture(tmp_path):
    os.mkfifo(tmp_path / "a.png")
    content = {"images": [{"id": 1, "file_name": "a.png", "width": 9, "height": 8}], "annotations": []}
    (tmp_path / "truth.json").write_text(json.dumps(content))
    assert open_coco(tmp_path / "truth.json")
    assert read_rgb(tmp_path / "a.png") is None


def test_a_file_of_more_bytes_than_the_limit_takes_no_memory(tmp_path):
    path, before = tmp_path / "p.json", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with path.open("wb") as file:
        file.truncate(2**31 + 1)
    with pytest.raises(KpbenchError, match=r"p\.json: cannot be read, it has more than 2147483648 bytes"):
        kpbench.read_predictions(path)
    path.write_bytes(b"abc")
    assert read_bytes(path) == b"abc"
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 100_000  # kB


def test_files_of_the_user_are_opened_in_one_place():
    """Files that ship with kpbench, or that it has just written, may be opened anywhere."""
    allowed = {
        "files.py",
        "writing.py",
        "memory.py",
        "report/report.py",
        "detectors/program.py",
        "detectors/verification.py",
        "dataset/generation.py",
        "dataset/export.py",
        "dataset/usage.py",  # lines of READMEs
        "patches/field.py",
        "training/run_log.py",
        "images.py",
        "hdf5.py",
    }
    opening = re.compile(r"\.read_bytes\(|\.read_text\(|fromfile|(?<!fp)open\(\"r|\.open\(\"r")
    found = {path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py") if opening.search(path.read_text())}
    assert found <= allowed


# --- Memory and time -----------------------------------------------------------------------------------------------


def test_memory_that_is_not_there_is_said_before_the_work(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "free_bytes", lambda: 2**28)
    image = np.zeros((2200, 2200), np.uint8)
    with pytest.raises(DataError, match=r"template: an image of 2200 x 2200 pixels needs about 0.4 GiB of memory, 0.2"):
        TemplateDetector()(image)
    with pytest.raises(DataError, match=r"superpoint-small: .* 2200 x 2200 pixels needs about"):
        kpbench.load_detector("superpoint-small")(image)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((5000, 5000), np.uint8))
    with pytest.raises(DataError, match=r"a\.png: an image of 5000 x 5000 pixels needs about 0.4 GiB"):
        open_images(str(tmp_path / "a.png"))
    with pytest.raises(DataError, match="an image of 4000x4000 needs about"):
        kpbench.SynthConfig(n=1, size_px=(4000, 4000))


def test_a_set_of_images_has_a_largest_size():
    with pytest.raises(DataError, match="`size_px` is 14000x14000, expected at most 67108864 pixels"):
        kpbench.SynthConfig(n=1, size_px=(14000, 14000))


@pytest.mark.parametrize(
    ("transform", "problem"),
    [
        ({"__class_fullname__": "Resize", "height": 60000, "width": 60000, "p": 0.1}, "memory|more than 5 s"),
        ({"__class_fullname__": "Resize", "height": 30, "width": 60, "p": 0.1}, "makes 60x30 uint8 of 640x480"),
    ],
)
def test_a_pipeline_is_tried_before_the_work(here, transform, problem):
    Path("a.json").write_text(json.dumps({"transform": transform}))
    done = CliRunner().invoke(main, ["synth", "--n", "2", "--augment", "a.json", "--out", "set"])
    assert done.exit_code == 1
    assert re.search(f"^kpbench: --augment: .*({problem})", done.output)
    assert not Path("set").exists()


def test_a_checkpoint_that_declares_wide_layers_takes_no_memory(tmp_path):
    from dataclasses import asdict, replace

    import torch
    from safetensors.torch import save_file

    from kpbench.training import NetworkConfig, load_recipe

    recipe = replace(load_recipe("reference"), network=NetworkConfig(widths=(4096,) * 4))
    content = {"schema": "kpbench.checkpoint/1", "recipe": asdict(recipe), "step": 1, "seconds": 1.0, "patches": []}
    content |= {"designs": "0" * 64, "versions": {"kpbench": "0", "torch": "0"}}
    path = tmp_path / "a.safetensors"
    save_file({"mean.a": torch.zeros(1)}, path, {"kpbench": json.dumps(content)})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DataError, match="the tensors do not fit the recipe"):
        read_checkpoint(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 300_000  # kB


def test_a_network_that_makes_memory_of_nothing(tmp_path):
    onnx = pytest.importorskip("onnx")
    make, kinds = onnx.helper, onnx.TensorProto
    shape = onnx.numpy_helper.from_array(np.array([50_000, 50_000], np.int64), "shape")
    nodes = [
        make.make_node("ConstantOfShape", ["shape"], ["large"]),
        make.make_node("ReduceSum", ["large"], ["sum"], keepdims=0),
        make.make_node("Add", ["image", "sum"], ["detector"]),
    ]
    image = make.make_tensor_value_info("image", kinds.FLOAT, [1, 1, "h", "w"])
    graph = make.make_graph(nodes, "g", [image], [make.make_tensor_value_info("detector", kinds.FLOAT, None)], [shape])
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 17)], ir_version=8)
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DataError, match=r"a\.onnx: cannot be run on 256 x 256 pixels within 512 MiB and 10 s"):
        kpbench.load_detector(str(tmp_path / "a.onnx"))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 700_000  # kB


# --- Pictures and films --------------------------------------------------------------------------------------------


def noise(n):
    return Image.fromarray(np.random.default_rng(n).integers(0, 255, (24, 32, 3), np.uint8))


def save(path, kind, images, **options):
    stream = io.BytesIO()
    images[0].save(stream, kind, save_all=True, append_images=images[1:], **options)
    path.write_bytes(stream.getvalue())
    return path


@pytest.mark.filterwarnings("ignore::kpbench.errors.KpbenchWarning")
@pytest.mark.parametrize("kind", ["gif", "webp"])
def test_a_film_that_is_cut_anywhere_gives_its_whole_frames(tmp_path, kind):
    options = {"lossless": True} if kind == "webp" else {}
    path = save(tmp_path / f"a.{kind}", kind, [noise(n) for n in range(3)], **options)
    data = path.read_bytes()
    whole = [frame for _, frame in open_images(str(path)).images]
    for cut in range(len(data) // 2, len(data) - 1, 41):
        path.write_bytes(data[:cut])
        source = open_images(str(path))
        frames = [frame for _, frame in source.images]
        good = [frame for frame in frames if frame is not None]
        assert source.film
        assert 1 <= len(good) <= 3
        assert frames[len(good) :] in ([], [None], [None, None])
        assert all(map(np.array_equal, good, whole))


def test_transparency_of_a_film_is_said(tmp_path):
    clear = [Image.new("RGBA", (8, 8), (n, 0, 0, 0)) for n in range(2)]
    path = save(tmp_path / "a.gif", "GIF", [*clear, noise(0).convert("RGBA").crop((0, 0, 8, 8))], disposal=2)
    with pytest.warns(KpbenchWarning, match=r"a\.gif: is transparent, and is laid on white"):
        assert next(open_images(str(path)).images)[1].min() == 255


def test_further_pages_of_a_tiff_are_said(tmp_path, recwarn):
    assert read_rgb(save(tmp_path / "one.tif", "TIFF", [noise(0)])) is not None
    open_images(str(tmp_path / "one.tif"))
    assert not recwarn.list
    with pytest.warns(KpbenchWarning, match=r"two\.tif: has several pages, of which only the first is read"):
        open_images(str(save(tmp_path / "two.tif", "TIFF", [noise(0), noise(1)])))


def test_a_tiff_whose_table_lacks_strips_is_refused(tmp_path):
    path = save(tmp_path / "a.tif", "TIFF", [noise(0)])
    data = bytearray(path.read_bytes())
    at = max(data.find(struct.pack("<HH", 278, kind)) for kind in (3, 4))
    struct.pack_into("<H", data, at + 8, 6)  # four strips, of which the table names one
    path.write_bytes(data)
    assert read_rgb(path) is None


def test_the_white_of_a_pgm_counts(tmp_path):
    (tmp_path / "a.pgm").write_bytes(b"P5 # of a comment\n2 1 15\n\0\x0f")
    assert read_rgb(tmp_path / "a.pgm")[0, :, 0].tolist() == [0, 255]


def film(path, code):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 10.0, (64, 48))
    for n in range(6):
        writer.write(np.full((48, 64, 3), 30 * n, np.uint8))
    writer.release()
    return bytearray(path.read_bytes())


def test_a_film_with_damaged_lengths_or_tables_is_refused(tmp_path):
    avi, mp4 = film(tmp_path / "a.avi", "MJPG"), film(tmp_path / "a.mp4", "mp4v")
    struct.pack_into("<I", avi, avi.find(b"movi") - 4, 4)
    struct.pack_into(">I", mp4, mp4.find(b"stts") + 12, 16384)
    for name, data in (("a.avi", avi), ("a.mp4", mp4)):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(DataError, match=f"{name}: its container is damaged "):
            open_images(str(tmp_path / name))


@pytest.mark.parametrize(("name", "code"), [("a.avi", "MJPG"), ("a.mp4", "mp4v"), ("a.mov", "MJPG"), ("a.mkv", "FFV1")])
def test_the_container_of_a_film_that_is_cut_off_counts_as_sound(tmp_path, name, code):
    data = film(tmp_path / name, code)
    for cut in range(len(data) // 2, len(data), 97):
        (tmp_path / name).write_bytes(data[:cut])
        require_sound_container(tmp_path / name)
