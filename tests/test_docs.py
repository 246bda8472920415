"""Every example in the README and in docs/ runs, in order, in one empty folder a page.

``sh`` blocks run in a shell (those of nothing but kpbench lines in this process, which is faster), ``python``
blocks in one namespace a block, and a ``toml`` block is written to the file that its first line names.
"""

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from kpbench.cli import main
from kpbench.dataset.generation import generate
from kpbench.synth.synthetic import SynthConfig

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_examples_of_a_page_run(page, tmp_path, monkeypatch):
    blocks = [(kind, code) for kind, code in FENCE.findall(page.read_text()) if kind in ("sh", "python", "toml")]
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PATH", os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if any("photos" in code for _, code in blocks):
        (tmp_path / "photos").mkdir()
        for n in range(11):
            noise = np.random.default_rng(n).integers(0, 256, (120, 160, 3), dtype=np.uint8)
            cv2.imwrite(f"photos/{n}.png", noise)
    if page.name != "README.md" and any("kpbench-data" in code or "kpbench detect" in code for _, code in blocks):
        generate(SynthConfig(6), "kpbench-data", workers=1)
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


def run_shell(code):
    lines = [shlex.split(line, comments=True) for line in code.replace("\\\n", " ").splitlines()]
    if any(words and words[0] != "kpbench" for words in lines):
        subprocess.run(["bash", "-ec", code], check=True, capture_output=True)
        return
    for words in filter(None, lines):
        result = CliRunner().invoke(main, words[1:], catch_exceptions=False)
        assert result.exit_code == 0, f"{' '.join(words)}\n{result.output}"
