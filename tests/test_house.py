"""The structure that the code keeps: who may import whom, and what stays unloaded."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import kpbench

PACKAGE = Path(kpbench.__file__).parent

# Each module may import those of its own line and of the lines before it.
LAYERS = [
    {"errors"},
    {"keypoints"},
    {"files", "geometry", "outline", "raster", "workers"},
    {"design"},
    {"background", "board", "cells", "draw", "lookalikes", "sidecar", "tiling"},
    {"tags"},
    {"sheet", "analysis", "search", "design_figure"},
    {"scene", "degrade"},
    {"augment", "camera"},
    {"pieces", "store", "sources"},
    {"header"},
    {"columns"},
    {"coco"},
    {"records"},
    {"predictions"},
    {"synth", "suite", "crops"},
    {"samples", "recipe"},
    {"match"},
    {"sectors"},
    {"refine"},
    {"program", "runtime"},
    {"verify"},
    {"detect"},
    {"assignment"},
    {"metrics", "bootstrap"},
    {"tally"},
    {"scoring"},
    {"breakpoints", "charts", "comparison", "gallery", "paper", "pose", "preview", "tables"},
    {"card", "exhibits"},
    {"interchange"},
    {"report"},
    {"generation"},
    {"pipeline"},
    {"bench"},
]
EVALUATOR = {
    *("assignment", "metrics", "bootstrap", "tally", "scoring", "predictions", "program", "detect", "store", "sources"),
    *("breakpoints", "card", "charts", "comparison", "exhibits", "gallery", "interchange", "paper", "preview", "pose"),
    *("report", "tables", "pieces", "header", "columns", "coco", "records"),
}
GENERATOR = {
    *("design", "cells", "board", "draw", "sheet", "sidecar", "tiling", "analysis", "search", "design_figure"),
    *(
        "background",
        "lookalikes",
        "tags",
        "scene",
        "degrade",
        "augment",
        "camera",
        "synth",
        "suite",
        "crops",
        "samples",
    ),
}
TORCH = {"network", "train", "export"}


def imports(path, top_level_only=False):
    """Names of kpbench modules and of other packages that a module imports."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_level_only else ast.walk(tree)
    inside, outside = set(), set()
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            parts = node.module.split(".")
            if parts[0] != "kpbench":
                outside.add(parts[0])
            elif len(parts) > 1:
                inside.add(parts[1])
            else:
                inside.update(alias.name for alias in node.names if (PACKAGE / f"{alias.name}.py").exists())
        elif isinstance(node, ast.Import):
            outside.update(alias.name.split(".")[0] for alias in node.names)
    return inside, outside


MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.name != "__main__.py")
FLAT = [path for path in MODULES if path.parent == PACKAGE and path.name != "__init__.py"]


@pytest.mark.parametrize("path", FLAT, ids=lambda path: path.stem)
def test_data_flows_one_way(path):
    name = path.stem
    inside, _ = imports(path)
    assert "cli" not in inside, "nothing imports the command line"
    if name in EVALUATOR:
        assert not inside & GENERATOR, "the evaluator knows nothing of the generator"
    if name in TORCH:
        return
    level = next((n for n, layer in enumerate(LAYERS) if name in layer), None)
    assert level is not None, f"{name}.py has no place in the house yet"
    allowed = set().union(*LAYERS[: level + 1]) | ({"detectors"} if name == "detect" else set())
    assert inside <= allowed, f"{name} imports {sorted(inside - allowed)} from a later stage"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_heavy_libraries_stay_in_their_rooms(path):
    _, outside = imports(path)
    if path.stem not in TORCH:
        assert "torch" not in outside
    if path.stem not in ("store", "columns"):
        assert "h5py" not in outside
    if path.parent.name != "detectors":
        assert "onnxruntime" not in outside or path.stem in ("runtime", "export")


def test_import_kpbench_is_light():
    code = "import sys, kpbench; print(sorted({'torch', 'h5py', 'onnxruntime', 'cv2', 'pandas'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_everything_promised_at_the_top_is_there():
    for name in kpbench.__all__:
        assert getattr(kpbench, name) is not None
