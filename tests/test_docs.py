"""Every example in the README and in docs/ runs, in order, in one empty folder a page."""

import contextlib
import io
import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from kpbench.cli import main
from kpbench.pipeline import generate
from kpbench.synth import SynthConfig

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_examples_of_a_page_run(page, tmp_path, monkeypatch):
    blocks = [(kind, code) for kind, code in FENCE.findall(page.read_text()) if kind in ("sh", "python")]
    if not blocks:
        return
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "photos").mkdir()
    for n in range(3):
        noise = np.random.default_rng(n).integers(0, 256, (120, 160, 3), dtype=np.uint8)
        cv2.imwrite(f"photos/{n}.png", noise)
    if page.name != "README.md" and not any("kpbench synth" in code for _, code in blocks):
        generate(SynthConfig(6), "kpbench-data", workers=1)
    for kind, code in blocks:
        if kind == "python":
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile(code, f"{page.name}", "exec"), {"__name__": "__example__"})
        else:
            run_shell(code)


def run_shell(code):
    """Run kpbench lines through the command line; big numbers of images are made small."""
    for line in code.replace("\\\n", " ").splitlines():
        words = shlex.split(re.sub(r"--n \d{3,}", "--n 6", line), comments=True)
        if not words:
            continue
        assert words[0] == "kpbench", f"an example that cannot be run: {line}"
        result = CliRunner().invoke(main, words[1:], catch_exceptions=False)
        assert result.exit_code == 0, f"{line}\n{result.output}"
