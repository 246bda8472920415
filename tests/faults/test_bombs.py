"""Small files that declare much, and plans that no disk can hold, are refused before memory or time is spent."""

import json
import resource
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

import kpbench
from kpbench.cli import main
from kpbench.errors import DataError, DesignError, KpbenchError, PredictionsError
from kpbench.images import decode_photo, open_images, read_rgb
from kpbench.patches.design import load_patch
from kpbench.synth.user_pipeline import load_augmentation

CASES = Path(__file__).parent / "cases"


def run(*words):
    return CliRunner().invoke(main, [*map(str, words)])


def one_line(done):
    assert done.exit_code == 1, done.output
    [line] = done.output.strip().splitlines()
    return line.removeprefix("kpbench: ")


def chunk(kind, content, length=None):
    length = len(content) if length is None else length
    return struct.pack(">I", length) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


PIXELS = zlib.compress(bytes(1000))


def png(width, height, length=None):
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", PIXELS, length) + chunk(b"IEND", b"")


def tiff(width, height):
    tags = [(256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, 8), (277, 1), (278, height), (279, 100)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(104)


def jpeg(width, height):
    data = bytearray(cv2.imencode(".jpg", np.zeros((16, 16), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


def bmp(width, height):
    data = bytearray(cv2.imencode(".bmp", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    data[18:26] = struct.pack("<ii", width, height)
    return bytes(data)


def gif(width, height):
    data = bytearray(cv2.imencode(".gif", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    data[6:10] = struct.pack("<HH", width, height)
    return bytes(data)


IMAGES = {
    "long-chunk.png": png(32, 24, length=2**31 - 245),
    "large.png": png(30_000, 30_000),
    "large.tif": tiff(30_000, 30_000),
    "large.jpg": jpeg(30_000, 30_000),
    "large.bmp": bmp(30_000, 30_000),
    "large.gif": gif(30_000, 30_000),
    "large.pgm": b"P5 30000 30000 255\n" + bytes(100),
}


def test_an_image_that_declares_more_than_200_megapixels_takes_no_memory(tmp_path):
    for name, content in IMAGES.items():
        (tmp_path / name).write_bytes(content)
    code = (
        "import resource, sys; from pathlib import Path; from kpbench.images import decode_photo, read_rgb\n"
        "read_rgb(Path('none.png'))\n"
        "for path in sorted(Path(sys.argv[1]).iterdir()):\n"
        "    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "    assert read_rgb(path) is None and decode_photo(path, 1) is None, path\n"
        "    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 50_000, path\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert not done.returncode, done.stderr


def test_a_large_image_is_one_line(here):
    for name in ("large.png", "long-chunk.png"):
        Path(name).write_bytes(IMAGES[name])
        assert one_line(run("detect", name)) == f"{name}: cannot be decoded as an image of at most 200 megapixels"


def test_images_within_the_limit_are_read(tmp_path):
    image = np.full((40, 30), 100, np.uint8)
    for suffix in ("png", "jpg", "tif", "bmp", "gif", "pgm", "webp"):
        path = tmp_path / f"a.{suffix}"
        path.write_bytes(cv2.imencode(f".{suffix}", image if suffix != "gif" else np.dstack([image] * 3))[1].tobytes())
        assert read_rgb(path).shape == (40, 30, 3)
        assert decode_photo(path, 1).shape == (40, 30)


def test_a_parquet_file_that_declares_many_rows(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path, count = tmp_path / "p.parquet", 10_000_000
    zeros = pa.DictionaryArray.from_arrays(pa.array(np.zeros(count, np.int8)), pa.array([0]))
    pq.write_table(pa.table({"image_id": zeros, "x": zeros, "y": zeros}), path, row_group_size=count)
    assert path.stat().st_size < 200_000
    with pytest.raises(PredictionsError, match=r"p\.parquet: declares 10000000 rows, 3 columns and 240000000 b"):
        kpbench.read_predictions(path)


DESIGN = 'name = "a"\nid = 1\nsemicircles = [%s]\n'
SEMICIRCLE = '{ start_deg = 0, ink = "black" },'
TOML = {
    "many": (DESIGN % (SEMICIRCLE * 1000), "semicircles has 1000 entries, expected at most 100"),
    "deep": (DESIGN % ("[" * 2000), "not valid TOML (it is nested too deeply)"),
    "deep value": (DESIGN % ("[" * 150 + "]" * 150), "semicircles[0] is [[["),
    "long number": ('name = "a"\nid = ' + "9" * 5000, "not valid TOML (Exceeds the limit (4300 digits)"),
    "large number": ('name = "a"\nid = 1\nsemicircles = []\nquiet_zone = ' + "9" * 400, "quiet_zone is 9999"),
    "large file": ("#" * 2**22 + "#", "cannot be read, it has more than 4194304 bytes"),
}


@pytest.mark.parametrize("case", TOML)
def test_a_toml_file_that_is_nested_long_or_large(here, case):
    text, problem = TOML[case]
    Path("a.toml").write_text(text)
    for words in (["render-patches", "--design", "a.toml"], ["analyze-patches", "a.toml"]):
        assert one_line(run(*words)).startswith(f"a.toml: {problem}")
    for words in (["render-patches", "--board", "a.toml"], ["suite", "a.toml"]):
        assert one_line(run(*words)).startswith("a.toml: ")


DEEP, LONG = "[" * 100_000, "9" * 5000
JSON = {
    "p.json": [DEEP, LONG, '{"schema": "kpbench.predictions/1", "detector": ' + DEEP, f'[{{"image_id": {LONG}}}]'],
    "p.jsonl": [DEEP, '{"schema": "kpbench.predictions/1"}\n' + DEEP, '{"schema": "kpbench.predictions/1"}\n' + LONG],
    "p.csv": ["# " + DEEP, f"image_id,x,y\n{LONG},1,2\n", f"image_id,x,y\n0,{LONG},2\n"],
}


@pytest.mark.parametrize(("name", "text"), [(name, text) for name, texts in JSON.items() for text in texts])
def test_predictions_that_are_nested_or_hold_long_numbers(here, dataset, name, text):
    Path(name).write_text(text)
    assert one_line(run("score", name, "--gt", dataset.path)).startswith(f"{name}: ")


@pytest.mark.parametrize("text", [DEEP, '{"images": ' + DEEP, f'{{"images": [{{"id": {LONG}}}], "annotations": []}}'])
def test_annotations_that_are_nested_or_hold_long_numbers(here, text):
    Path("truth.json").write_text(text)
    Path("p.json").write_text('{"schema": "kpbench.predictions/1", "predictions": []}')
    assert one_line(run("score", "p.json", "--gt", "truth.json")).startswith("truth.json: ")


def test_a_manifest_that_is_nested_or_holds_long_numbers(here, dataset):
    content = json.loads((dataset.path / "dataset.json").read_text())
    Path("set").mkdir()
    for text in (DEEP, json.dumps(content | {"config": "C"}).replace('"C"', DEEP), LONG, '{"schema": ' + LONG):
        Path("set/dataset.json").write_text(text)
        assert one_line(run("inspect", "set")).startswith("set/dataset.json: not a dataset manifest")
    content["shards"][0]["first"] = 10**25
    Path("set/dataset.json").write_text(json.dumps(content))
    assert one_line(run("inspect", "set")).startswith("set/dataset.json: shards[0]: first is 1000000")


YAML = {
    "aliases.yaml": "a: &a [1, 1]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 9)),
    "circle.yaml": "&a [*a]\n",
    "merges.yaml": "a: &a {b: 1}\nc: {<<: [*a, *a]}\n",
}


@pytest.mark.parametrize("name", YAML)
def test_a_pipeline_that_grows_when_it_is_read(here, name):
    Path(name).write_text(YAML[name].replace("*a0", "*a"))
    with pytest.raises(KpbenchError, match=f"^{name}: no pipeline as .*has an alias"):
        load_augmentation(name)


@pytest.mark.parametrize("more", [(), ("--shard-range", "0:2000000"), ("--overwrite",)])
def test_a_plan_that_no_disk_can_hold(here, more):
    line = one_line(run("synth", "--n", 1_000_000_000, "--out", "set", *more))
    assert line.startswith("set: 1000000000 images need about 261 TB, the disk has ")


def test_a_plan_of_too_many_shards(here):
    line = one_line(run("synth", "--n", 10**9, "--shard-size", 1, "--shard-range", "0:1", "--out", "set"))
    assert line == "--n is 1000000000: 1000000000 shards of 1 images, expected at most 4000000"


def test_an_export_that_the_disk_cannot_hold(here, dataset, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"total": 10**9, "free": 1000}))
    for file_format in ("coco", "yolo", "webdataset"):
        line = one_line(run("export", dataset.path, "--format", file_format, "--out", f"out-{file_format}"))
        assert line.startswith(f"out-{file_format}: 6 images need about ")


@pytest.mark.parametrize("letter", ["a", "-", "'", " ", "a.", "é"])
def test_a_long_word_in_a_design_is_read_in_linear_time(tmp_path, letter):
    """A search for deep keys looked at every rest of a word: 100,000 letters took minutes."""
    path = tmp_path / "long.toml"
    path.write_text(f'x = "{letter * (100_000 // len(letter))}"\n')
    start = time.process_time()
    with pytest.raises(DesignError, match=r"long\.toml: "):
        load_patch(path)
    assert time.process_time() - start < 1


def test_a_frame_of_a_gif_that_reaches_out_of_the_picture_counts(tmp_path):
    frames = [Image.new("L", (8, 8), grey) for grey in (0, 200)]
    frames[0].save(tmp_path / "big.gif", save_all=True, append_images=frames[1:])
    data = bytearray((tmp_path / "big.gif").read_bytes())
    second = data.rfind(b"\x2c\x00\x00\x00\x00")
    data[second + 5 : second + 9] = struct.pack("<2H", 6000, 6000)
    (tmp_path / "big.gif").write_bytes(data)
    with pytest.raises(DataError, match=r"big\.gif: declares 2 frames of 6000 x 6000"):
        list(open_images(str(tmp_path / "big.gif")).images)


def test_nothing_here_took_much_memory():
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 2**21  # kB
