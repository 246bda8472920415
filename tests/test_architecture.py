"""The structure that the code keeps: who may import whom, and what stays unloaded."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import kpbench

PACKAGE = Path(kpbench.__file__).parent
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.name not in ("__main__.py", "__init__.py"))
H5PY = {"dataset.shard", "predictions.table_files"}


def imports(path):
    """Names of kpbench modules (dotted) and of other packages that a module imports."""
    inside, outside = set(), set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            if node.module.split(".")[0] != "kpbench":
                outside.add(node.module.split(".")[0])
                continue
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                is_module = (PACKAGE.parent / (name.replace(".", "/") + ".py")).exists()
                inside.add(name if is_module else node.module)
        elif isinstance(node, ast.Import):
            outside.update(alias.name.split(".")[0] for alias in node.names)
    return {name.removeprefix("kpbench.") for name in inside} - {"kpbench"}, outside


def name_of(path):
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def test_imports_form_no_circle():
    open_ = {name_of(path): imports(path)[0] for path in MODULES}
    while open_:
        free = {name for name, needed in open_.items() if not needed & open_.keys()}
        assert free, f"a circle among {sorted(open_)}"
        open_ = {name: needed for name, needed in open_.items() if name not in free}


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_heavy_libraries_stay_in_their_rooms(path):
    inside, outside = imports(path)
    if path.parent.name != "cli":
        assert not [name for name in inside if name.startswith("cli")], "nothing imports the command line"
    if path.parent.name != "training":
        assert "torch" not in outside
    if name_of(path) not in H5PY:
        assert "h5py" not in outside
    if path.parent.name not in ("detectors", "training"):
        assert "onnxruntime" not in outside


def test_import_kpbench_is_light():
    code = "import sys, kpbench; print(sorted({'torch', 'h5py', 'onnxruntime', 'cv2', 'pandas'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_everything_promised_at_the_top_is_there():
    for name in kpbench.__all__:
        assert getattr(kpbench, name) is not None
