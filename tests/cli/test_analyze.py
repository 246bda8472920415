import json
import re
from pathlib import Path

import pytest
from helpers import kpbench

from kpbench.analysis import localisation, measures
from kpbench.analysis.natural_images import sample_windows

DESIGNS = Path(__file__).parents[2] / "benchmarks" / "designs"


@pytest.fixture
def quick(monkeypatch):
    """Fewer sizes and windows: what is printed, not what is measured."""
    monkeypatch.setattr(measures, "SIZES_PX", (5.0, 8.0))
    monkeypatch.setattr(localisation, "PARTS_OF_BASIN", (1.0,))
    monkeypatch.setattr(sample_windows, "__defaults__", (400,))


def test_table_json_and_figure(quick, tmp_path):
    files = [DESIGNS / "alternatives" / f"{name}.toml" for name in ("half", "quarter")]
    done = kpbench("analyze-patches", *files, "--json", tmp_path / "a.json", "--figure", tmp_path / "a.svg")
    assert re.search(r"0 half +0\.03\d+ +0\.02\d+ .* inf\n", done.stdout)
    assert re.search(r"1 quarter +yes +0\.00 ", done.stdout)
    table = json.loads((tmp_path / "a.json").read_text())
    assert table["schema"] == "kpbench.analysis/1"
    assert table["designs"][0]["bound_without_rim_px"] is None
    assert len(table["distance"]) == 2
    drawn = (tmp_path / "a.svg").read_text()
    assert "1 quarter" in drawn
    assert "no crossing, unique orientation" in drawn


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["nowhere.toml"], 1, "nowhere.toml: cannot be read"),
        (["--backgrounds", "nowhere"], 1, "nowhere: no such folder of background images"),
        (["--search", "a.toml"], 2, "--search goes through a whole family of designs and takes no FILES"),
        (["--figure", "a.gif"], 2, "'--figure': a.gif: expected a file ending in .svg, .png, .pdf"),
    ],
)
def test_bad_input(arguments, code, says, here):
    done = kpbench("analyze-patches", *arguments, code=code)
    assert done.stdout == ""
    assert says in done.stderr
