"""No command connects to the internet, or writes outside the folders that it was given and the temporary folder."""

import ast
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys

import pytest

from kpbench.cli import COMMANDS
from kpbench.detectors.inference import import_onnxruntime
from kpbench.files import PACKAGE

path = PACKAGE.parent / "benchmarks" / "robustness" / "trace_commands.py"
spec = importlib.util.spec_from_file_location("trace_commands", path)
tracing = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tracing)


def can_trace():
    return (
        bool(shutil.which("strace")) and not subprocess.run(["strace", "-qq", "true"], capture_output=True).returncode
    )


needs_strace = pytest.mark.skipif(not can_trace(), reason="strace is missing, or may not trace here")
CHAIN = """
synth --n 8 --size 128x128 --workers 1 --out set
synth --n 2 --size 128x128 --augment pipeline.json --workers 1 --out augmented
synth --n 2 --size 128x128 --camera webcam --workers 1 --out taken
synth --n 2 --size 128x128 --shard-range 0:1 --workers 1 --out parts
merge parts
suite paper-v1 --images 1 --size 64x64 --only blur --workers 1 --out suite
render-patches --pdf --png --dpi 50 --out print
inspect set
verify set
preview set --out sheet.png
export set --format coco --out coco
degrade coco/images --effect rain --level 500 --out degraded
detect set --detector superpoint-small --workers 1 --out a.csv
detect set --detector orb --workers 1 --out b.parquet
score a.csv --gt set --json scores.json --csv scores.csv --report report.html
compare a.csv b.parquet --gt set --report report.tex
"""


@needs_strace
def test_commands_connect_to_nothing_and_write_where_they_were_told_to(tmp_path, monkeypatch):
    """``benchmarks/robustness/trace_commands.py`` does the same for every command, in processes of their own."""
    monkeypatch.setenv("PYTHONPATH", str(PACKAGE.parent))
    code = (
        "import shlex, sys\nfrom kpbench.cli import main\n"
        "for line in sys.argv[1].strip().splitlines():\n"
        "    main(shlex.split(line), standalone_mode=False)\n"
        "print('to the end')\n"
    )
    (tmp_path / "work").mkdir()
    pipeline = '{"transform": {"__class_fullname__": "Rotate", "limit": [-20, 20], "p": 1.0}}'
    (tmp_path / "work" / "pipeline.json").write_text(pipeline)
    done, lines = tracing.trace([sys.executable, "-P", "-c", code, CHAIN], tmp_path / "work", tmp_path)
    assert "to the end" in done.stdout, done.stdout + done.stderr
    assert (tmp_path / "work" / "report.html").exists()
    assert not tracing.connections(lines)
    for package in ("onnxruntime", "albumentations"):  # which would connect on their own
        assert any(f"/{package}/" in line for line in lines)
    allowed = [tmp_path / "work", tmp_path / "temporary"]
    assert not tracing.written_outside(lines, tmp_path / "work", allowed)
    assert tracing.written_outside(lines, tmp_path / "work", [tmp_path / "temporary"])
    assert not list((tmp_path / "home").iterdir())


@needs_strace
def test_the_trace_would_show_a_connection_and_a_file(tmp_path):
    code = (
        "import os, socket\n"
        "open('../home/number', 'w').close(), open('mine', 'w').close(), open('/etc/hostname').close()\n"
        "os.mkdir('../home/new'), os.rename('mine', '../home/renamed'), os.symlink('/etc/passwd', 'link')\n"
        "socket.socket(socket.AF_INET, socket.SOCK_DGRAM).connect(('127.0.0.1', 9))\n"
    )
    (tmp_path / "work").mkdir()
    done, lines = tracing.trace([sys.executable, "-c", code], tmp_path / "work", tmp_path)
    assert not done.returncode, done.stderr
    assert len(tracing.connections(lines)) == 1
    found = tracing.written_outside(lines, tmp_path / "work", [tmp_path / "work"])
    assert found == [str(tmp_path / "home" / name) for name in ("new", "number", "renamed")]


def test_every_command_is_in_the_list_that_is_traced_by_hand():
    traced = {shlex.split(line)[0] for line in tracing.COMMANDS.strip().splitlines()}
    assert COMMANDS.keys() <= traced


def test_a_user_may_turn_telemetry_on(monkeypatch):
    for given, kept in ((None, "1"), ("0", "0")):
        monkeypatch.delenv("ORT_DISABLE_TELEMETRY", raising=False)
        if given:
            monkeypatch.setenv("ORT_DISABLE_TELEMETRY", given)
        import_onnxruntime()
        assert os.environ["ORT_DISABLE_TELEMETRY"] == kept


def test_packages_that_report_to_their_makers_are_imported_in_one_place():
    """A submodule may be imported after the one place has imported the package."""
    homes = {"onnxruntime": "inference.py", "albumentations": "user_pipeline.py"}
    for file in PACKAGE.rglob("*.py"):
        text = file.read_text("utf-8")
        for node in ast.walk(ast.parse(text)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names.append(node.module)
            for name in names:
                package, _, submodule = name.partition(".")
                if package in homes and file.name != homes[package]:
                    assert submodule, f"{file} imports {name}"
                    assert re.search(rf"import_{package}\(\)(.|\n)*{re.escape(name)}", text), f"{file} imports {name}"
