"""The lines of every README that kpbench writes into a folder run in that folder."""

import importlib.util
import re
import shutil
import subprocess
import warnings

import pytest

from kpbench.dataset.export import EXPORT_FORMATS, export_dataset
from kpbench.dataset.usage import EXPORT_USAGE

FENCE = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
BLOCKS = [("dataset", 0), *((name, n) for name, text in EXPORT_USAGE.items() for n in range(len(FENCE.findall(text))))]


@pytest.fixture(scope="module")
def folders(dataset, tmp_path_factory):
    """A dataset, and its export to each format."""
    top = tmp_path_factory.mktemp("exported")
    shutil.copytree(dataset.path, top / "dataset")
    for name in EXPORT_FORMATS:
        export_dataset(dataset, name, top / name)
    return top


def test_every_format_has_lines():
    assert EXPORT_USAGE.keys() == EXPORT_FORMATS.keys()


@pytest.mark.parametrize(("name", "number"), BLOCKS)
def test_the_lines_of_a_readme_run(folders, name, number, monkeypatch):
    monkeypatch.chdir(folders / name)
    kind, code = FENCE.findall((folders / name / "README.md").read_text())[number]
    if kind == "sh":
        program = code.split()[0]
        if not shutil.which(program):
            pytest.skip(f"{program} is not installed")
        subprocess.run(["bash", "-ec", code], check=True, capture_output=True)
        return
    for package in re.findall(r"^(?:import|from) (\w+)", code, re.MULTILINE):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    warnings.simplefilter("ignore", DeprecationWarning)  # of the packages of others; pytest restores the filters
    exec(compile(code, f"{name}/README.md", "exec"), {"__name__": "__readme__"})


@pytest.mark.parametrize("name", ["dataset", *EXPORT_FORMATS])
def test_a_readme_names_no_path_and_tells_what_the_images_are(folders, dataset, name):
    text = (folders / name / "README.md").read_text()
    assert "# Keypoint patches, 6 simulated images" in text
    assert "tags: [keypoint-patches, simulated]" in text
    assert str(dataset.path) not in text
