"""The structure that the code keeps: who may import whom, what stays unloaded, what is public.

``ROOMS`` is the table of the rooms. A room is a folder of ``kpbench``, or a file beside the ground floor. It may import
the ground floor and the rooms that its row names, and nothing else.

    python tests/test_architecture.py    # prints the numbers: rooms, levels, imports, circles, what is long
"""

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

import kpbench

PACKAGE = Path(kpbench.__file__).parent
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.name != "__main__.py")

GROUND = {
    "errors": [],
    "validity": ["errors"],
    "types": ["errors", "validity"],
    "portable": ["types"],
    "filters": ["types", "portable"],
    "text": [],
    "files": ["errors", "text"],
    "yaml_text": [],
    "toml": ["errors", "files", "text"],
    "writing": ["errors", "files"],
    "locks": ["errors", "files"],
    "signals": [],
    "memory": ["errors"],
    "tiff": [],
    "decoding": ["errors", "memory", "tiff"],
    "hdf5_structure": [],
    "hdf5": ["errors", "files", "memory", "signals", "hdf5_structure"],
    "pixels": ["errors", "types", "files", "tiff", "decoding"],
    "containers": ["errors", "files"],
    "films": ["errors", "types", "decoding", "pixels", "containers"],
    "images": ["errors", "types", "files", "decoding", "writing", "tiff", "pixels", "films"],
    "workers": ["errors", "signals"],
    "seeds": [],
    "opencv": ["errors"],
    "provenance": [],
}
"""What every stage shares, and what each of these modules may import."""
ROOMS = {
    "geometry": [],
    "camera": ["geometry"],
    "patches": ["geometry"],
    "boards": ["geometry", "patches"],
    "printing": ["geometry", "patches"],
    "render": ["geometry", "patches", "camera"],
    "degrade": ["geometry"],
    "predictions": [],
    "dataset": ["geometry", "predictions"],
    "synth": ["geometry", "camera", "patches", "render", "degrade", "predictions", "dataset"],
    "analysis": ["geometry", "camera", "patches", "printing", "render"],
    "scoring": ["geometry"],
    "report": ["scoring"],
    "drift": ["dataset", "predictions", "scoring", "report"],
    "fitting": ["geometry", "patches"],
    "detectors": ["geometry", "patches", "fitting", "predictions", "dataset"],
    "tracking": ["geometry", "patches", "boards", "fitting", "detectors", "dataset", "synth", "scoring"],
    "calibration": ["geometry", "patches", "boards", "printing", "render", "detectors", "dataset"],
    "training": [
        "geometry",
        "camera",
        "patches",
        "render",
        "degrade",
        "scoring",
        "fitting",
        "detectors",
        "dataset",
        "synth",
    ],
    "ui": [
        "geometry",
        "patches",
        "boards",
        "printing",
        "render",
        "degrade",
        "predictions",
        "dataset",
        "analysis",
        "detectors",
        "tracking",
    ],
    "evaluate": ["dataset", "predictions", "scoring", "report", "synth"],
    "benchmark": ["patches", "dataset", "synth", "predictions", "scoring", "report", "detectors"],
}
"""The rooms, and which other rooms each may import; each row names rows above it."""
LAST = "cli"
"""The room that may import every other one, and that no other may import."""
TORCH_ROOM = "training"
H5PY_MODULES = {"hdf5", "hdf5_structure", "dataset.shard", "predictions.h5_files"}
NICEGUI_ROOM = "ui"
ONNXRUNTIME_ROOMS = {"detectors", TORCH_ROOM}
HEAVY = {"nicegui", "torch", "h5py", "onnxruntime", "cv2", "pandas", "scipy"}
"""Packages that neither ``import kpbench`` nor ``kpbench --help`` loads."""
LARGEST_FILE, LARGEST_FUNCTION = 400, 60
"""Lines; those of a function without its docstring."""
LARGE_FILES: dict[str, str] = {}
"""Files that may be longer than ``LARGEST_FILE`` lines, and why."""
LARGE_FUNCTIONS: dict[str, str] = {}
"""Functions that may be longer than ``LARGEST_FUNCTION`` lines, and why."""
NAMES_OF_SEVERAL = {"SCHEMA": "every file format has its own"}
"""Public names that several modules define, and why."""


def name_of(path):
    """Dotted name of a module below ``kpbench``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__") or "kpbench"


def room_of(name):
    return name.split(".")[0]


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
                file = PACKAGE.parent / name.replace(".", "/")
                is_module = file.with_suffix(".py").exists() or file.is_dir()
                inside.add(name if is_module else node.module)
        elif isinstance(node, ast.Import):
            outside.update(alias.name.split(".")[0] for alias in node.names)
    return {name.removeprefix("kpbench.") for name in inside} - {"kpbench"}, outside


def graph():
    """Each module that is no ``__init__``, and the modules that it imports."""
    return {name_of(path): imports(path)[0] for path in MODULES if path.name != "__init__.py"}


def levels(needed):
    """Modules by level: each imports modules of lower levels only. Those of a circle, and above it, have no level."""
    found, left = [], dict(needed)
    while free := {name for name, imported in left.items() if not imported & left.keys()}:
        found.append(free)
        left = {name: imported for name, imported in left.items() if name not in free}
    return found


def circles(needed):
    """Sets of modules that import each other, directly or through others."""
    reached = {name: set(imported) for name, imported in needed.items()}
    for through in reached:
        for name in reached:
            if through in reached[name]:
                reached[name] |= reached[through]
    return {
        frozenset(m for m in reached[name] if name in reached.get(m, ())) for name in reached if name in reached[name]
    }


def long_files():
    lines = {name_of(path): len(path.read_text().splitlines()) for path in MODULES}
    return {name: count for name, count in lines.items() if count > LARGEST_FILE}


def lines_of(function):
    """Lines of a function from ``def`` to its end, without its docstring."""
    first = function.body[0]
    documented = ast.get_docstring(function) is not None
    docstring = first.end_lineno - first.lineno + 1 if documented else 0
    return function.end_lineno - function.lineno + 1 - docstring


def long_functions():
    lines = {
        f"{name_of(path)}.{node.name}": lines_of(node)
        for path in MODULES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
    }
    return {name: count for name, count in lines.items() if count > LARGEST_FUNCTION}


def in_library(path):
    return room_of(name_of(path)) != LAST


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_room_imports_what_its_row_names(path):
    inside, outside = imports(path)
    room = room_of(name_of(path))
    rooms = {room_of(name) for name in inside} - {room}
    if room in GROUND:
        assert rooms <= {*GROUND[room]}
    elif room in ROOMS:
        assert rooms <= {*GROUND, *ROOMS[room]}
    else:
        assert room in ("kpbench", LAST), f"{room} has no row in the table"
    assert "torch" not in outside or room == TORCH_ROOM
    assert not outside & {"nicegui", "fastapi"} or room == NICEGUI_ROOM
    assert "h5py" not in outside or name_of(path) in H5PY_MODULES
    assert "onnxruntime" not in outside or room in ONNXRUNTIME_ROOMS


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_module_imports_from_modules_and_not_from_the_lists_of_public_names(path):
    folders = {name for name in imports(path)[0] if (PACKAGE / name.replace(".", "/")).is_dir()}
    assert not folders


@pytest.mark.parametrize("table", [GROUND, ROOMS], ids=["ground", "rooms"])
def test_a_row_of_a_table_names_rows_above_it(table):
    rows = list(table)
    for n, room in enumerate(rows):
        assert {*table[room]} <= {*rows[:n]}, room


def test_imports_form_no_circle():
    assert not circles(graph())


@pytest.mark.parametrize(
    "code", ["import kpbench", "from kpbench.cli import main; main(['--help'], standalone_mode=False)"]
)
def test_neither_the_package_nor_the_list_of_commands_loads_what_is_heavy(code):
    code += f"; import sys; print('loaded:', *sorted({HEAVY} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1].strip() == "loaded:"


def test_public_functions_stay_callable_when_every_module_is_imported():
    """A module of the name of a public function would replace it once it is imported."""
    for module in pkgutil.walk_packages([str(PACKAGE)], "kpbench."):
        if module.name != "kpbench.__main__":
            importlib.import_module(module.name)
    for room in [kpbench, *(importlib.import_module(f"kpbench.{name}") for name in ROOMS)]:
        for name in getattr(room, "__all__", ()):
            assert not inspect.ismodule(getattr(room, name)), f"{room.__name__}.{name}"


def test_no_module_has_the_name_of_a_public_name_beside_it():
    for folder in [PACKAGE, *(PACKAGE / name for name in ROOMS if (PACKAGE / name).is_dir())]:
        room = importlib.import_module(".".join(["kpbench", *folder.relative_to(PACKAGE).parts]))
        modules = {path.stem for path in folder.iterdir() if path.suffix == ".py" or path.is_dir()}
        assert not modules & {*getattr(room, "__all__", ())}


def strings(path):
    tree = ast.parse(path.read_text())
    return [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]


@pytest.mark.parametrize("path", [path for path in MODULES if in_library(path)], ids=name_of)
def test_the_library_never_speaks_of_options(path):
    """It names parameters, in backticks; the command line translates."""
    assert not [text for text in strings(path) if re.search(r"(?<![\w-])--(n\b|[a-z][a-z])", text)]


def test_files_and_functions_are_short():
    assert long_files().keys() == LARGE_FILES.keys()
    assert long_functions().keys() == LARGE_FUNCTIONS.keys()


def public_names(path):
    """Functions, classes and constants that a module defines, without those that begin with an underscore."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found = [part for target in targets for part in ast.walk(target)]
            names = [part.id for part in found if isinstance(part, ast.Name) and part.id.isupper()]
        else:
            continue
        yield from (name for name in names if not name.startswith("_"))


def test_no_two_modules_define_one_public_name():
    homes = defaultdict(set)
    for path in filter(in_library, MODULES):
        for name in public_names(path):
            homes[name].add(name_of(path))
    several = {name: modules for name, modules in homes.items() if len(modules) > 1}
    assert several.keys() == NAMES_OF_SEVERAL.keys(), several


def main():
    """Print the numbers of the house."""
    needed = graph()
    folders = sorted(name for name in {*ROOMS, LAST} if (PACKAGE / name).is_dir())
    crossings = {
        (room_of(name), room_of(imported))
        for name, all_imported in needed.items()
        for imported in all_imported
        if {room_of(name), room_of(imported)} <= {*ROOMS, LAST} and room_of(name) != room_of(imported)
    }
    by_name = {name: sum(room_of(module) == name for module in needed) for name in folders}
    print(f"rooms (folders)          {len(folders)}: {', '.join(f'{room} {n}' for room, n in by_name.items())}")
    print(f"modules                  {len(needed)}, of which {len(needed) - sum(by_name.values())} beside the folders")
    rooms = {name: {*imported} for name, imported in ROOMS.items()} | {LAST: {*ROOMS}}
    print(f"levels of imports        {len(levels(needed))} of modules, {len(levels(rooms))} of rooms above the ground")
    print(f"imports between rooms    {len(crossings)} pairs of rooms, without the ground floor")
    print(f"circles                  {len(circles(needed))}")
    for title, long in (
        (f"files over {LARGEST_FILE} lines", long_files()),
        (f"functions over {LARGEST_FUNCTION}", long_functions()),
    ):
        listed = ", ".join(f"{name} {count}" for name, count in sorted(long.items()))
        print(f"{title:<24} {len(long)}{f': {listed}' if long else ''}")


if __name__ == "__main__":
    main()
