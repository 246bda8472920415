"""The site is built without a warning and without a dead link, and its notebooks run."""

import contextlib
import importlib.util
import io
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))

spec = importlib.util.spec_from_file_location("make_site", ROOT / "docs" / "make_site.py")
make_site = importlib.util.module_from_spec(spec)
spec.loader.exec_module(make_site)


def test_the_site_has_no_warning_and_no_dead_link(tmp_path):
    pytest.importorskip("zensical")
    assert not make_site.build(tmp_path)
    home = (tmp_path / "site" / "index.html").read_text()
    assert "search" in home
    assert (tmp_path / "site" / "reference" / "cli.html").exists()


def test_every_page_stands_in_the_menu():
    menu = (ROOT / "docs" / "zensical.toml").read_text()
    for name in make_site.pages().values():
        if name.endswith((".md", ".ipynb")):
            assert f'"{name.replace(".ipynb", ".md")}"' in menu, name


def test_a_dead_link_and_a_file_from_elsewhere_are_found(tmp_path):
    (tmp_path / "a.html").write_text(
        '<a href="b.html#here">1</a><a href="b.html#there">2</a><a href="c.html">3</a><a href="https://x.org/">4</a>'
        '<img src="https://x.org/y.png"><script src="z.js"></script>'
    )
    (tmp_path / "b.html").write_text('<h2 id="here">b</h2>')
    assert make_site.broken_links(tmp_path) == [
        "a.html: b.html#there has no such heading",
        "a.html: c.html is not there",
        "a.html: loads https://x.org/y.png",
        "a.html: z.js is not there",
    ]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_cells_of_a_notebook_run(notebook, here):
    cells = json.loads(notebook.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["outputs"] or cell is not cells[-1] for cell in cells if cell["cell_type"] == "code")
    names = {"__name__": "__notebook__"}
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        for source in code:
            exec(compile(source, notebook.name, "exec"), names)
    assert printed.getvalue()
    assert notebook.stat().st_size < 200_000
