"""A hostile name goes through every output. An independent parser of the format reads the name back, and no more."""

import ast
import csv
import io
import json
import re
import tarfile
import tomllib
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import ezdxf
import lxml.html
import numpy as np
import pikepdf
import pytest
import yaml
from helpers import perfect_predictions, write_dataset

import kpbench
from kpbench import export_dataset, open_dataset, read_predictions, score, write_predictions
from kpbench.dataset.card import write_card
from kpbench.dataset.folder import make_manifest, write_manifest
from kpbench.printing.dxf import to_dxf
from kpbench.printing.page import Page, Text
from kpbench.printing.pdf import to_pdf
from kpbench.printing.svg import to_svg
from kpbench.report.charts import Series, bar_chart, line_chart
from kpbench.report.report import to_html, to_latex_report, to_markdown_report
from kpbench.report.result_files import encode_scores, encode_scores_csv
from kpbench.report.sections import Report
from kpbench.text import FORMULA, escape_csv, escape_dxf, escape_terminal, escape_yaml, replace_unprinted

IMAGES = [[(3, 4, 2, 0), (6, 2, 2, 1)], [(5, 5, 2, 2)]]
HOSTILE = {
    "controls": "a\0b\x01c\x08d\x0be\x0cf\x1bg\x1fh\x7fi\x80j\x9fk",
    "lines": "a\nb\r\nc\rd\u2028e\u2029f\x85g\tend",
    "no characters": "a\ufffeb\uffffc\U0001fffed",
    "directions": "a\u202eb\u2066c\u200fd\ufeffe",
    "above U+FFFF": "a\U0001f600b\U00020000c\U000e0001d",
    "markup": "]]> --> </title></svg><script>x()</script> <!-- &amp; &#0; \" ' `",
    "YAML": "a: [b, {c}] # d\n- e: \"f\\\" 'g' !!python/object &h *i %j @k",
    "TeX": "\\input{/etc/passwd} % $x$ ^^41 # & _ ~ {}",
    "cells": 'x;=1,+2;-3|@4\t=5;"=6;  =7',
    "DXF": "a\\U+0041 %%u ^J \\P {b}",
}
names = pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE)
half = pytest.mark.parametrize("name", [*HOSTILE.values(), "a\udcffb\ud83dc"], ids=[*HOSTILE, "halves"])


def report_of(name):
    found = perfect_predictions(IMAGES, detector={"name": name, "version": "1"})
    keypoints = np.zeros(3, kpbench.KEYPOINT_DTYPE)
    for k, row in zip(keypoints, [row for image in IMAGES for row in image], strict=True):
        k["x"], k["y"], k["radius_major"], k["patch_id"] = row
        k["radius_minor"] = k["radius_major"]
    groups = {"condition": np.array([name.replace("\0", "")] * 2), "rung": np.arange(2.0), "scene_id": np.arange(2)}
    run = score(kpbench.Truth(np.arange(2), np.array([0, 2, 3]), keypoints, **groups, fingerprint=name), found)
    return Report((run, replace(run, name=f"{name} 2")), provenance={"command": name}, title=name)


# --- XML, SVG, HTML ------------------------------------------------------------------------------------------------


@half
def test_charts_are_xml_and_hold_the_name(name):
    line = line_chart([Series(name, [1, 2], [0.5, 0.6], [(0.4, 0.6), (0.5, 0.7)])], name, name)
    bars = bar_chart([(name, (3, 1))], (name, "b"), (0, 1))
    for svg in (line, bars):
        root = ElementTree.fromstring(svg.encode())
        assert escape_terminal(name) in root.attrib["aria-label"]
        assert escape_terminal(name) in next(root.iter("title")).text
    assert {e.tag for e in ElementTree.fromstring(line).iter()} == {
        *("svg", "line", "text", "polygon", "polyline", "circle", "title")
    }


@half
def test_a_page_of_svg_is_xml_and_holds_the_name(name):
    page = Page(40.0, 40.0, (), (Text(name, 1.0, 2.0, 3.0),), name)
    root = ElementTree.fromstring(to_svg(page))
    texts = [e.text for e in root.iter() if e.tag.endswith(("title", "text"))]
    assert texts == [replace_unprinted(name)] * 2


@half
def test_a_page_of_html_holds_names_and_no_control_characters(name):
    page = to_html(report_of(name))
    page.encode()
    assert not re.search("[\0-\x08\x0b-\x1f\x7f-\x9f\ufffe\uffff\u202e\u2066\u2028]", page)
    tree = lxml.html.fromstring(page.encode(), parser=lxml.html.HTMLParser(encoding="utf-8"))
    assert tree.findtext(".//title") == escape_terminal(name, lines=True)
    assert f"{escape_terminal(name)} 2" in [cell.text_content() for cell in tree.iter("td")]
    assert json.loads(tree.findtext(".//pre"))["command"] == name
    for svg in re.findall("<svg.*?</svg>", page, re.DOTALL):
        ElementTree.fromstring(svg)

    found = {key for element in tree.iter() for key in element.attrib}
    assert not {key for key in found if key.startswith("on") or not re.fullmatch("[a-z0-9-]+", key)}


# --- YAML, JSON, TOML ----------------------------------------------------------------------------------------------


@names
def test_a_scalar_of_yaml_is_read_back_by_parsers_of_yaml_and_toml(name):
    assert yaml.safe_load(f"a: {escape_yaml(name)}\nb: 1\n") == {"a": name, "b": 1}
    assert tomllib.loads(f"a = {escape_yaml(name)}\nb = 1\n") == {"a": name, "b": 1}


def test_half_of_a_pair_is_an_escape_in_yaml():
    assert yaml.safe_load(escape_yaml("a\ud83db")) == r"a\ud83db"


@pytest.fixture
def data(tmp_path):
    """A function that makes a dataset in which a patch has a name."""

    def make(name):
        made = write_dataset(tmp_path / "set", IMAGES)
        config = {"seed": 0, "patches": [{"id": 0, "name": name}]}
        write_manifest(tmp_path / "set", make_manifest(config, made.shards, {"versions": {"a": name}}))
        return open_dataset(tmp_path / "set")

    return make


@half
def test_exports_hold_the_name(tmp_path, data, name):
    dataset = data(name)
    whole = name.encode(errors="backslashreplace").decode()
    assert dataset.config["patches"][0]["name"] == name
    listed = yaml.safe_load(export_dataset(dataset, "yolo", tmp_path / "yolo").read_text("utf-8"))
    assert listed["names"] == {0: whole, 1: "patch-1", 2: "patch-2"}
    coco = json.loads(export_dataset(dataset, "coco", tmp_path / "coco").read_bytes())
    assert [category["name"] for category in coco["categories"]] == [whole, "patch-1", "patch-2"]
    with tarfile.open(export_dataset(dataset, "webdataset", tmp_path / "web")) as tar:
        assert all(json.load(tar.extractfile(m)) for m in tar.getmembers() if m.name.endswith("json"))
    for folder in ("yolo", "coco", "web"):
        head = (tmp_path / folder / "README.md").read_text("utf-8").split("---\n")[1]
        assert yaml.safe_load(head)["pretty_name"] == "Keypoint patches, 2 images"


@half
def test_a_card_is_one_table_row_per_fact(data, name):
    dataset = data(name)
    write_card(dataset, dataset.path)
    card = (dataset.path / "README.md").read_text("utf-8")
    [row] = [line for line in card.split("\n") if line.startswith("| designs |")]
    assert len(re.findall(r"(?<!\\)(?:\\\\)*\|", row)) == 3


@half
@pytest.mark.parametrize("suffix", [".json", ".jsonl", ".csv", ".parquet", ".h5"])
def test_predictions_of_every_format_hold_the_name(tmp_path, suffix, name):
    path = tmp_path / f"p{suffix}"
    write_predictions(path, perfect_predictions(IMAGES, detector={"name": name}, dataset=name))
    whole = name.encode(errors="backslashreplace").decode()
    assert read_predictions(path).detector == {"name": whole}
    if suffix == ".json":
        assert json.loads(path.read_bytes())["dataset"] == whole
    if suffix == ".csv":
        header, *_ = path.read_text("utf-8").split("\n")
        assert json.loads(header[1:])["dataset"] == whole
        for separator in ",;|\t":
            cells = next(csv.reader([header], delimiter=separator))
            assert not [cell for cell in cells if re.match(rf"[\s\"\\]*[{FORMULA}]", cell)], separator


# --- Tables --------------------------------------------------------------------------------------------------------


@half
@pytest.mark.parametrize("separator", list(",;\t|"))
def test_no_cell_of_scores_is_a_formula_however_a_spreadsheet_splits_lines(name, separator):
    run = report_of(name).runs[0]
    text = encode_scores_csv(run, {"kpbench": "1"}).decode()
    rows = [*csv.reader(io.StringIO(text, newline=""), delimiter=separator)]
    assert not [cell for row in rows for cell in row if re.match(rf"[\s\"]*(?!-[\d.])[{FORMULA}]", cell)]
    if separator == ",":
        assert escape_csv(name) in rows[1]
    assert json.loads(encode_scores(run, {}))["schema"]


@pytest.mark.parametrize("start", FORMULA)
@pytest.mark.parametrize("before", ["", ";", ",", "a;", "a, ", '"', ';"', "a|", " ", ";;"])
def test_a_formula_gets_an_apostrophe_wherever_a_cell_may_begin(start, before):
    assert escape_csv(f"{before}{start}1") == f"{before}'{start}1"
    assert escape_csv(f"a{start}1") == f"a{start}1"


# --- LaTeX, Markdown -----------------------------------------------------------------------------------------------


@half
def test_text_reports_hold_printed_characters_only(name):
    for text in (to_latex_report(report_of(name)), to_markdown_report(report_of(name))):
        assert all(line.isprintable() for line in text.split("\n"))
    code = [line for line in to_latex_report(report_of(name)).split("\n") if not line.startswith("%")]
    assert not re.search(r"\^|\\(input|par)\b", "".join(code))


# --- DXF, PDF ------------------------------------------------------------------------------------------------------


@half
def test_a_drawing_holds_the_name(name):
    page = Page(40.0, 40.0, (), (Text(name, 1.0, 2.0, 3.0),), name)
    drawing = ezdxf.read(io.StringIO(to_dxf(page).decode("ascii")))
    [text] = drawing.modelspace().query("TEXT")
    shown = "".join(c for c in replace_unprinted(name) if ord(c) < 0x10000).replace("%%", "% %")
    assert re.sub(r"\\U\+([0-9A-F]{4})", lambda m: chr(int(m[1], 16)), text.dxf.text) == shown
    with pikepdf.open(io.BytesIO(to_pdf([page]))) as pdf:
        assert len(pdf.pages) == 1
        assert str(pdf.docinfo.Title) == replace_unprinted(name)


def test_codes_of_dxf_are_text():
    assert escape_dxf("a\\U+0041^J%%u\U0001f600\n") == r"a\U+005CU+0041\U+005EJ% %u\U+000A"


# --- One home ------------------------------------------------------------------------------------------------------


def test_only_one_module_knows_how_to_escape():
    """No other module imports an escape of the standard library, or defines a function of that name."""
    package = Path(kpbench.__file__).parent
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and path.name != "text.py":
                found = {alias.name for alias in node.names} & {"escape", "quoteattr", "saxutils"}
                assert not found, path
