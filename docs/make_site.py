"""Build the site from docs/, notebook/ and CHANGELOG.md, and check every link of it.

    python docs/make_site.py [FOLDER]    # default: build/site
    python -m http.server --directory build/site/site

Zensical (``pip install 'kpbench[docs]'``) builds the pages, strictly: a warning is an error. The site loads nothing
from elsewhere. Links that leave the pages lead to the repository.
"""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

DOCS = Path(__file__).parent
ROOT = DOCS.parent
REPOSITORY = "https://github.com/kpbench/kpbench/blob/main"
LINK = re.compile(r"(!?\[[^\]]*\]\()([^)\s#]+)((?:#[^)\s]*)?\))")
ASSETS = {"script": "src", "img": "src", "link": "href", "source": "src", "iframe": "src"}
"""Elements that load a file, and their attribute that names it."""


def pages() -> dict[Path, str]:
    """Return where each file of the site comes from, and its path within the site."""
    found = {path: path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*") if path.is_file()}
    found = {path: name for path, name in found.items() if path.suffix in (".md", ".png", ".svg", ".json", ".ipynb")}
    found |= {path: f"notebook/{path.name}" for path in (ROOT / "notebook").glob("*.md")}
    return found | {ROOT / "CHANGELOG.md": "CHANGELOG.md"}


def write_sources(folder: Path) -> None:
    """Write the pages as the site takes them: notebooks as Markdown, links within the site or to the repository."""
    places = pages()
    for path, name in places.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".md":
            target.write_text(move_links(path.read_text(), path, name, places))
        elif path.suffix == ".ipynb":
            text = notebook_as_markdown(json.loads(path.read_text()), target.with_suffix(""))
            text = move_links(text, path, name, places) + f"\n[Download this notebook]({path.name})\n"
            target.with_suffix(".md").write_text(text)
            shutil.copy(path, target)
        else:
            shutil.copy(path, target)


def move_links(text: str, path: Path, name: str, places: dict[Path, str]) -> str:
    """Return a page with each link to a file as the site needs it."""

    def move(link: re.Match[str]) -> str:
        head, target, tail = link.groups()
        file = (path.parent / target).resolve()
        if ":" in target or not file.exists():  # a picture of a notebook, or a dead link
            return link[0]
        if file in places:
            moved = os.path.relpath(places[file], Path(name).parent)
            return f"{head}{moved.removesuffix('.ipynb') + '.md' if file.suffix == '.ipynb' else moved}{tail}"
        return f"{head}{REPOSITORY}/{file.relative_to(ROOT).as_posix()}{tail}"

    parts = re.split(r"(^```.*?^```)", text, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if n % 2 else LINK.sub(move, part) for n, part in enumerate(parts))


def notebook_as_markdown(notebook: dict[str, Any], images: Path) -> str:
    """Return the cells of a notebook and their outputs as Markdown; pictures are written beside it."""
    parts = []
    for n, cell in enumerate(notebook["cells"]):
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for k, output in enumerate(cell.get("outputs", [])):
            data = output.get("data", {})
            if "image/jpeg" in data:
                picture = images.with_name(f"{images.name}-{n}-{k}.jpg")
                picture.write_bytes(base64.b64decode("".join(data["image/jpeg"])))
                parts.append(f"![Output of the cell above]({picture.name})")
            elif text := "".join(output.get("text", data.get("text/plain", []))):
                parts.append(f"```text\n{text.rstrip()}\n```")
    return "\n\n".join([*parts, ""])


class Page(HTMLParser):
    """The links, the loaded files and the anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links, self.assets, self.anchors = list[str](), list[str](), set[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what an element links, loads or names."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag in ASSETS and ASSETS[tag] in values and values.get("rel") not in ("canonical", "prev", "next", "edit"):
            self.assets.append(values[ASSETS[tag]])


def broken_links(site: Path) -> list[str]:
    """Return a line for each link of a site that leads nowhere, and for each file that is loaded from elsewhere."""
    read = {path.resolve(): Page(path.read_text()) for path in site.rglob("*.html") if path.name != "404.html"}
    problems = []
    for path, page in read.items():
        where = path.relative_to(site.resolve())
        for link in page.links + page.assets:
            parts = urlsplit(link)
            if parts.scheme in ("mailto", "data", "javascript"):
                continue
            if parts.scheme or parts.netloc:
                problems += [f"{where}: loads {link}"] if link in page.assets else []
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.exists():
                problems.append(f"{where}: {link} is not there")
            elif parts.fragment and target in read and unquote(parts.fragment) not in read[target].anchors:
                problems.append(f"{where}: {link} has no such heading")
    return problems


def build(folder: Path) -> list[str]:
    """Build the site below a folder; return its problems, one per line."""
    shutil.rmtree(folder, ignore_errors=True)
    write_sources(folder / "source")
    shutil.copy(DOCS / "zensical.toml", folder)
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    said = [
        line for line in (done.stdout + done.stderr).splitlines() if re.search("warning|error", line, re.IGNORECASE)
    ]
    if done.returncode:
        return [*said, f"zensical ended with {done.returncode}"]
    return said + broken_links(folder / "site")


if __name__ == "__main__":
    out = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "build" / "site")
    found = build(out)
    print("\n".join(found) or f"{out / 'site' / 'index.html'}: no warnings, no dead links")
    sys.exit(bool(found))
