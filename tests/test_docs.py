"""The documentation is true: its examples run, its links lead somewhere, its reference pages are complete.

``sh`` blocks run in a shell, those of nothing but kpbench lines in this process, which is faster. ``python`` blocks run
in one namespace a block, and a ``toml`` block is written to the file that its first line names. The blocks of a page
run in order, in one empty folder. Examples in the docstrings of public names run in an empty folder each; an example
that names ``kpbench-data`` or ``preds.json`` finds what ``example_data`` makes.
"""

import contextlib
import doctest
import importlib
import importlib.util
import inspect
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import board_photos
import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

import kpbench
from kpbench import workers
from kpbench.cli import main

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
ALL_PAGES = [*PAGES, ROOT / "CHANGELOG.md", *sorted((ROOT / "notebook").rglob("*.md"))]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
LARGEST_LINE = 120
MAKE_REFERENCE = "python docs/make_reference.py"

spec = importlib.util.spec_from_file_location("make_reference", ROOT / "docs" / "make_reference.py")
make_reference = importlib.util.module_from_spec(spec)
spec.loader.exec_module(make_reference)
PUBLIC = make_reference.public_names()


def page_id(page):
    return str(page.relative_to(ROOT))


@pytest.fixture(scope="session")
def example_data(tmp_path_factory):
    """A folder with kpbench-data, the first six images of ``kpbench synth``, and preds.json for them.

    The detector of preds.json found every true keypoint, with the right ID and a score of 1, but for the first one.
    """
    folder = tmp_path_factory.mktemp("examples")
    dataset = kpbench.generate(kpbench.SynthConfig(6), folder / "kpbench-data", workers=1).dataset
    truth = dataset.truth
    found = [dataset.keypoints(n) for n in range(len(dataset))]
    found[0] = found[0][1:]
    detections = [
        kpbench.Detections(np.column_stack([k["x"], k["y"]]), np.ones(len(k)), k["patch_id"].astype(np.int64))
        for k in found
    ]
    predictions = kpbench.Predictions.from_detections(
        detections, truth.image_id, {"name": "oracle"}, "kpbench-data", dataset.fingerprint
    )
    kpbench.write_predictions(folder / "preds.json", predictions)
    return folder


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_the_examples_of_a_page_run(page, tmp_path, monkeypatch, example_data):
    blocks = [(kind, code) for kind, code in FENCE.findall(page.read_text()) if kind in ("sh", "python", "toml")]
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(workers, "count_cores", lambda: 1)  # to start processes takes longer than these few images
    monkeypatch.setenv("PATH", os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if any("--board patches-print/truth.json" in code for _, code in blocks):
        board_photos.write_photos("photos", 6)
        if page.name == "photographs-and-tables.md":
            as_camera_files(Path("photos"))
    elif any("photos" in code for _, code in blocks):
        (tmp_path / "photos").mkdir()
        for n in range(11):
            noise = np.random.default_rng(n).integers(0, 256, (120, 160, 3), dtype=np.uint8)
            cv2.imwrite(f"photos/{n}.png", noise)
    code = "\n".join(code for _, code in blocks)
    if "rclpy" in code:
        stand_in_for_ros(monkeypatch)
    if "kpbench-data" in code and not re.search(r"kpbench synth --n \d+(?!.*--out)", code):
        shutil.copytree(example_data / "kpbench-data", tmp_path / "kpbench-data")
    for kind, code in blocks:
        if kind == "python":
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile(code, page.name, "exec"), {"__name__": "__example__"})
        elif kind == "toml":
            name = re.match(r"# (\S+\.toml)\n", code)
            assert name, f"the first line of a toml block names its file: {code.splitlines()[0]}"
            Path(name[1]).write_text(code)
        else:
            run_shell(re.sub(r"--n \d{3,}", "--n 6", code))  # big numbers of images are made small


def as_camera_files(folder):
    """Turn images into JPEG files as a camera writes them, one of them held upright."""
    for n, path in enumerate(sorted(folder.glob("*.png"))):
        exif = Image.Exif()
        exif[0x0112] = 6 if n == 1 else 1
        Image.open(path).save(path.with_suffix(".jpg"), quality=92, exif=exif)
        path.unlink()


def stand_in_for_ros(monkeypatch):
    """Modules of ROS 2 that give a node one image of the folder ``film``, and take the pose that it publishes."""
    published = []

    class Node:
        def __init__(self, name):
            self.name = name

        def create_publisher(self, kind, topic, depth):
            return SimpleNamespace(publish=published.append)

        def create_subscription(self, kind, topic, callback, qos):
            self.callback = callback

    def pose_message(header):
        nested = SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
        return SimpleNamespace(header=header, pose=SimpleNamespace(pose=nested))

    def spin(node):
        image = kpbench.open_dataset("film").image(9)
        header = SimpleNamespace(stamp=SimpleNamespace(sec=7, nanosec=500_000_000))
        height, width = image.shape
        node.callback(SimpleNamespace(data=image.tobytes(), height=height, width=width, step=width, header=header))
        assert published[0].header is header
        assert len(published[0].pose.covariance) == 36
        assert 0.1 < published[0].pose.pose.position.z < 2  # m

    parts = {
        "rclpy": {"init": lambda: None, "spin": spin},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "geometry_msgs.msg": {"PoseWithCovarianceStamped": pose_message},
        "sensor_msgs.msg": {"Image": None},
    }
    for name in ("geometry_msgs", "sensor_msgs", *parts):
        module = ModuleType(name)
        vars(module).update(parts.get(name, {}))
        monkeypatch.setitem(sys.modules, name, module)


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_a_page_uses_public_names_alone(page):
    text = page.read_text()
    for module, names in re.findall(r"^ *from (kpbench[\w.]*) import ([^#\n]+)", text, re.MULTILINE):
        assert module.count(".") < 2, f"from {module} import {names}"
        public = importlib.import_module(module).__all__
        assert {name.strip() for name in names.split(",")} <= set(public), f"from {module} import {names}"
    for path in re.findall(r"\bkpbench((?:\.[a-z_]+)+)\(", text):
        *rooms, name = path[1:].split(".")
        assert name in importlib.import_module(".".join(["kpbench", *rooms])).__all__, f"kpbench{path}"


def run_shell(code):
    lines = [shlex.split(line, comments=True) for line in code.replace("\\\n", " ").splitlines()]
    if any(words and words[0] != "kpbench" for words in lines):
        subprocess.run(["bash", "-ec", code], check=True, capture_output=True)
        return
    for words in filter(None, lines):
        result = CliRunner().invoke(main, words[1:], catch_exceptions=False)
        assert result.exit_code == 0, f"{' '.join(words)}\n{result.output}"


@pytest.mark.parametrize("public", PUBLIC, ids=make_reference.full_name)
def test_the_examples_of_a_docstring_run(public, tmp_path, monkeypatch, example_data):
    monkeypatch.chdir(tmp_path)
    value = make_reference.load(public)
    name = make_reference.full_name(public)
    if not callable(value):
        return
    assert inspect.getdoc(value), f"{name} has no docstring"
    finder, runner = doctest.DocTestFinder(), doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    failures = io.StringIO()
    for example in finder.find(value, name, module=False, globs={}):
        # preds.json names kpbench-data, so an example that needs one file gets all
        needed = any(made.name in (example.docstring or "") for made in example_data.iterdir())
        for made in example_data.iterdir() if needed else ():
            if not Path(made.name).exists():
                (shutil.copytree if made.is_dir() else shutil.copy)(made, made.name)
        runner.run(example, out=failures.write)
    assert not runner.failures, failures.getvalue()


def test_the_reference_of_the_command_line_is_what_the_commands_make():
    assert make_reference.CLI_PAGE.read_text() == make_reference.cli_page(), f"run `{MAKE_REFERENCE}`"


def test_the_reference_of_python_lists_every_public_name():
    assert make_reference.PYTHON_PAGE.read_text() == make_reference.python_page(), f"run `{MAKE_REFERENCE}`"


def prose(page):
    """The lines of a page outside code blocks and tables, with their numbers."""
    in_code = False
    for number, line in enumerate(page.read_text().splitlines(), 1):
        if line.lstrip().startswith("```"):
            in_code = not in_code
        elif not in_code and not line.lstrip().startswith("|"):
            yield number, line


def anchors(page):
    """The fragments of a page's headings, made as GitHub makes them."""
    headings = [re.sub(r"^#+ ", "", line) for _, line in prose(page) if re.match(r"#+ ", line)]
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", ALL_PAGES, ids=page_id)
def test_every_link_of_a_page_leads_somewhere(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for link in LINK.findall(re.sub(r"`[^`\n]*`", "", text)):
        target, _, fragment = link.partition("#")
        if target.startswith(("http:", "https:")):
            continue
        file = page.parent / target if target else page
        assert file.exists(), f"{link}: no such file"
        assert not fragment or fragment in anchors(file), f"{link}: no such heading"


@pytest.mark.parametrize("page", ALL_PAGES, ids=page_id)
def test_no_line_of_prose_is_long(page):
    long = [number for number, line in prose(page) if len(line) > LARGEST_LINE]
    assert not long, f"lines {long} have more than {LARGEST_LINE} columns"


def test_the_index_links_every_page():
    index = ROOT / "docs" / "index.md"
    linked = {(index.parent / link.partition("#")[0]).resolve() for link in LINK.findall(index.read_text())}
    assert {page.resolve() for page in PAGES[1:]} - {index.resolve()} <= linked
