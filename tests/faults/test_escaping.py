"""Text from files does nothing in LaTeX, spreadsheets, Markdown, HTML and terminals."""

import ast
import csv
import io
import json
import re
import warnings
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pytest
from helpers import kpbench as run
from helpers import perfect_predictions, write_dataset

from kpbench import cli, open_dataset, read_predictions, score, write_predictions
from kpbench.cli.messages import clean_usage_error, echo
from kpbench.dataset.card import write_card
from kpbench.dataset.folder import make_manifest, write_manifest
from kpbench.errors import KpbenchWarning
from kpbench.report.latex import to_latex
from kpbench.report.report import to_html, to_latex_report, to_markdown_report
from kpbench.report.result_files import encode_scores_csv
from kpbench.report.sections import Report
from kpbench.report.tables import Estimate, Table, to_markdown, to_plain
from kpbench.text import escape_csv, escape_csv_comment, escape_latex, escape_markdown, escape_terminal
from kpbench.types import KEYPOINT_DTYPE, Truth

IMAGES = [[(3, 4, 2, 0), (6, 2, 2, 1)], [(5, 5, 2, 2)]]
EVIL = {
    "LaTeX": "good\n\\input{/etc/hostname} \\typeout{INJECTED}% $x^2$ a_b ~#&",
    "LaTeX row": "[99cm]",
    "formula": "=cmd|' /C calc'!A0",
    "formula in a list": "x,=cmd|' /C calc'!A0,y;@SUM(A1);\t-1+1",
    "terminal": "a\x1b[2J\x1b]0;title\x07 \x9b31m \r\bover \u202egnp.exe \u2066 \x7f",
    "Markdown": "a | b ![p](http://host/p.png) `code` **bold** <img src=x> </details>",
    "HTML": "</title><script>alert(1)</script> \" ' &lt;",
    "lines": "a\u2028b\u2029c\x85d\x0be\nf\r\ng",
    "surrogate": "not UTF-8: \udcff",
}
CONTROL = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2028\u2029\u2066-\u2069\ud800-\udfff]")
"""What must reach no terminal: C0 but tab and line feed, DEL, C1, directions, separators, surrogates."""


def scores_of(name, condition=""):
    """Scores of a detector of this name."""
    found = perfect_predictions(IMAGES, detector={"name": name, "version": "1"})
    rows = [row for image in IMAGES for row in image]
    keypoints = np.zeros(len(rows), KEYPOINT_DTYPE)
    for k, (x, y, radius, patch_id) in zip(keypoints, rows, strict=True):
        k["x"], k["y"], k["patch_id"] = x, y, patch_id
        k["radius_major"] = k["radius_minor"] = radius
    groups = {"condition": np.array([condition] * 2), "rung": np.array([1.0, 2.0]), "scene_id": np.arange(2)}
    return score(Truth(np.arange(2), np.array([0, 2, 3]), keypoints, **groups, fingerprint=name), found, resamples=50)


# --- LaTeX ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", EVIL.values(), ids=EVIL)
def test_latex_prints_text_and_runs_none(text):
    escaped = escape_latex(text)
    commands = set(re.findall(r"\\([a-zA-Z]+|.)", escaped))
    printing = {
        "textbackslash",
        "textasciitilde",
        "textasciicircum",
        "textless",
        "textgreater",
        "textbar",
        "varepsilon",
    }
    assert commands <= printing | set("&%$#_{}")
    assert not re.search(r"(?<!\\)[%#&_]", escaped)
    assert len(escaped.splitlines()) == 1
    assert escaped[0] not in "[*"


@pytest.mark.parametrize("name", EVIL.values(), ids=EVIL)
def test_a_latex_report_is_one_environment_per_table_and_comments(name):
    text = to_latex_report(Report((scores_of(name, condition=name),), title=name))
    assert not CONTROL.search(text)
    for line in text.split("\n"):
        assert line[:1] in ("", "%", "\\", "$") or line.endswith(r"\\"), line
        if line[:1] != "%":
            assert not re.search(r"\\(input|typeout)", line)


# --- CSV -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", ["=", "+", "-", "@"])
def test_no_cell_of_text_is_a_formula_and_numbers_stay(start):
    assert escape_csv(f"{start}1+1") == f"'{start}1+1"
    assert [escape_csv(value) for value in (-1, -0.5, None, "", "a=b", "template")] == [
        -1,
        -0.5,
        None,
        "",
        "a=b",
        "template",
    ]


@pytest.mark.parametrize("name", EVIL.values(), ids=EVIL)
def test_a_table_of_scores_is_data(name):
    rows = list(
        csv.reader(io.StringIO(encode_scores_csv(scores_of(name, name), {"kpbench": "1"}).decode(), newline=""))
    )
    assert len({len(row) for row in rows}) == 1
    assert not [cell for row in rows for cell in row if cell[:1] in ("=", "+", "@", "\t", "\r") and cell]


@pytest.mark.parametrize("name", EVIL.values(), ids=EVIL)
def test_predictions_as_csv_are_data_however_a_program_splits_them(tmp_path, name):
    if name == EVIL["surrogate"]:
        return
    write_predictions(tmp_path / "a.csv", perfect_predictions(IMAGES, detector={"name": name}, dataset=name))
    with (tmp_path / "a.csv").open(encoding="utf-8", newline="") as file:
        for line in file:
            assert not [cell for cell in re.split("[,;\t]", line.rstrip("\n")) if re.match("[=+@]|-[^0-9]", cell)]
    assert read_predictions(tmp_path / "a.csv").detector == {"name": name}
    assert read_predictions(tmp_path / "a.csv").dataset == name


def test_a_comment_keeps_what_it_says():
    content = {"a": [1, -1, "x,=1", ",-1;+2,@a"], "b": -0.5}
    assert json.loads(escape_csv_comment(json.dumps(content))) == content
    assert escape_csv_comment(json.dumps({"a": [-1, 2]})) == json.dumps({"a": [-1, 2]})


# --- Markdown ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", EVIL.values(), ids=EVIL)
def test_markdown_shows_text_and_marks_nothing(text):
    escaped = escape_markdown(text)
    assert len(escaped.splitlines()) == 1
    assert not re.search(r"(?<!\\)(\\\\)*[|<>`*\[\]]", escaped)


def test_markdown_leaves_names_and_numbers_alone():
    for text in ("superpoint-small", "my_module:MyDetector", "paper-v1, 6.5 %", "A & B", "ε = 0.1"):
        assert escape_markdown(text) == text
    table = to_markdown(Table("t", ("a",), ((Estimate(0.5, (0.4, 0.6)),), (-1.5,), (None,))))
    assert table.splitlines()[4:] == ["| 0.500 [0.400, 0.600] |", "| -1.500 |", "| n/a |"]


@pytest.mark.parametrize("text", EVIL.values(), ids=EVIL)
def test_tables_keep_their_rows_and_columns(text):
    table = Table(text, (text, "n"), ((text, 1), ("b", 2)), text)
    assert [len(re.split(r"(?<!\\)\|", line)) for line in to_markdown(table).split("\n")[2:6]] == [4] * 4
    assert len(to_plain(table).split("\n")) == 3
    assert to_latex(table).count("\n") == 13


@pytest.mark.parametrize("name", EVIL.values(), ids=EVIL)
def test_a_markdown_report_has_the_sections_of_a_harmless_one(name):
    def outline(name):
        text = to_markdown_report(Report((scores_of(name, name),), title=name))
        assert not re.search(r"(?<!\\)<", text)
        assert not CONTROL.search(text)
        return [line[:2] for line in text.split("\n") if line[:1] in "#|`"]

    assert outline(name) == outline("a")


def test_a_dataset_card_is_text(tmp_path):
    write_dataset(tmp_path / "set", IMAGES)
    data = open_dataset(tmp_path / "set")
    for text in EVIL.values():
        patches = [{"id": 0, "name": text}]
        config = {"seed": text, "patches": patches, "deteriorate": text, "backgrounds": {"kind": text}}
        write_manifest(tmp_path / "set", make_manifest(config, data.shards, {"versions": {text: text}}))
        write_card(open_dataset(tmp_path / "set"), tmp_path / "set")
        card = (tmp_path / "set" / "README.md").read_text("utf-8").partition("-->")[2]
        assert not re.search(r"(?<![\\])<|(?<!\\)!\[p", card)
        assert not CONTROL.search(card)
        assert {line.count("|") - line.count(r"\|") for line in card.split("\n") if line[:1] == "|"} == {3, 4}


# --- HTML ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EVIL.values(), ids=EVIL)
def test_an_html_report_has_the_elements_of_a_harmless_one(name):
    def elements(name):
        run = scores_of(name, name)
        text = to_html(Report((run, replace(run, name=f"{name} 2")), provenance={"command": name}, title=name))
        return re.findall(r"<(/?[a-z]+)", text)

    assert elements(name) == elements("a")


# --- Terminal ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", EVIL.values(), ids=EVIL)
def test_a_line_is_a_line_of_printed_characters(text, capsys):
    for options in ({}, {"err": True}, {"bold": True}):
        echo(text, **options)
        out, err = capsys.readouterr()
        assert (out + err).replace("\x1b[1m", "").replace("\x1b[0m", "").removesuffix("\n").isprintable()
    assert not CONTROL.search(escape_terminal(text, lines=True))
    assert escape_terminal("Würfel 板 ε … ✓") == "Würfel 板 ε … ✓"


def test_commands_print_through_one_function():
    for path in Path(cli.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                allowed = path.name == "messages.py" and name == "click.secho"
                assert (
                    allowed
                    or not re.fullmatch(r"print|(click\.)s?echo|sys\.std(out|err)\.write", name)
                    or name == "echo"
                )


def test_errors_of_click_are_printed_clean(here):
    assert clean_usage_error(click.UsageError("a\x1b[31m\nb")).format_message() == "a\\x1b[31m\nb"
    for arguments in (
        ("\x1b[2J",),
        ("detect", "x", "--patches", "p", "--detector", "\x1b[2J\x9b"),
        ("demo", "\x1b[2J"),
    ):
        result = run(*arguments, code=2)
        assert not CONTROL.search(result.output)


def test_no_command_prints_control_characters(here):
    """Names of files, of detectors and in datasets, in what is printed and in warnings and errors."""
    evil = EVIL["terminal"] + EVIL["lines"]
    write_dataset(here / "set", IMAGES, condition="a\x1b[31m")
    data = open_dataset(here / "set")
    config = {"patches": [{"id": 0, "name": evil}], "seed": evil, "deteriorate": evil}
    write_manifest(here / "set", make_manifest(config, data.shards, {}))
    about = {"detector": {"name": evil, "version": evil, "failures": [[0, evil]]}, "image_id": [0, 1]}
    file = f"a{evil}.json".replace("/", "-")
    write_predictions(file, perfect_predictions(IMAGES, dataset=evil, **about))
    bad = f"bad{evil}.toml".replace("/", "-")
    Path(bad).write_text('name = "\\u001b[2J"\n"\\u001b" = 1')
    commands = [
        (0, "inspect", "set"),
        (0, "score", file, "--gt", "set", "--report", "r.md"),
        (1, "score", file),
        (0, "compare", file, file, "--gt", "set"),
        (1, "score", f"missing{evil}.json", "--gt", "set"),
        (1, "suite", bad),
        (1, "render-patches", "--design", bad),
        (1, "verify", f"missing{evil}"),
        (1, "detect", f"missing{evil}"),
        (1, "detect", "set", "--detector", f"a{evil}:b"),
    ]
    for code, *arguments in commands:
        result = run(*arguments, code=code)
        assert not CONTROL.search(result.stdout + result.stderr), arguments
        if code:
            assert len(result.stderr.splitlines()) == 1, arguments


def test_warnings_are_printed_clean(here, monkeypatch):
    def warn(path):
        warnings.warn("a\x1b[31m\nb", KpbenchWarning, stacklevel=1)
        raise click.ClickException("c\x9b")

    monkeypatch.setattr("kpbench.dataset.folder.open_dataset", warn)
    result = run("verify", "x", code=1)
    assert result.stderr.splitlines() == ["kpbench: a\\x1b[31m\\nb", "Error: c\\x9b"]
