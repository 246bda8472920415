import csv
import io
import json
import re
import shutil
import socketserver
import subprocess
import threading
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

from kpbench.detectors.prediction import record_cost
from kpbench.errors import DataError
from kpbench.report.charts import LIGHT_COLOURS, Series, bar_chart, line_chart
from kpbench.report.detail_tables import cost_table, slice_table
from kpbench.report.latex import to_latex
from kpbench.report.paper import PAPER, SYNTHETIC, paper_value
from kpbench.report.report import to_html, to_latex_report, to_markdown_report, write_report
from kpbench.report.result_files import encode_scores, encode_scores_csv
from kpbench.report.score_charts import severity_chart
from kpbench.report.score_tables import paper_table
from kpbench.report.sections import Report, name_runs
from kpbench.report.tables import Estimate, Table, to_markdown, to_plain
from kpbench.report.worst_cases import pick_worst_cases
from kpbench.scoring.breakpoints import find_breakpoints
from kpbench.scoring.comparison import compare
from kpbench.scoring.scores import score
from kpbench.types import KEYPOINT_DTYPE, Detections, Predictions, Truth
from kpbench.writing import HEAD_BYTES, TAIL_BYTES, kind_of

SHARE = {3: 1.0, 7: 0.95, 11: 0.5, 15: 0.25}  # of keypoints found at each rung


def ladder(scenes=8, share=SHARE, condition="blur"):
    """Truth and detections of two patches on a ladder; every scene finds the same share, exactly."""
    rungs = [r for r in share for _ in range(scenes)]
    n = len(rungs)
    keypoints = np.zeros(20 * n, KEYPOINT_DTYPE)
    keypoints["x"], keypoints["y"] = np.tile(np.arange(20) * 30 + 20, n), np.repeat(np.arange(n) % 7 * 10 + 40, 20)
    keypoints["radius_major"] = keypoints["radius_minor"] = np.tile([4, 8, 16, 30], 5 * n)
    keypoints["patch_id"] = np.tile([0, 1], 10 * n)
    truth = Truth(
        image_id=np.arange(n),
        offsets=np.arange(n + 1) * 20,
        keypoints=keypoints,
        condition=np.array([condition] * n),
        rung=np.array(rungs, float),
        scene_id=np.tile(np.arange(scenes), len(share)),
        fingerprint="f" * 64,
    )
    detections = []
    for k, rung in enumerate(rungs):
        own = keypoints[20 * k : 20 * k + round(20 * share[rung])]
        xy = np.stack([own["x"], own["y"]], axis=1)
        extra = [[300.0, 200.0]] if rung == 15 else np.zeros((0, 2))
        ids = np.append(own["patch_id"], [0] * len(extra))
        if rung == 11:
            ids[0] = 1
        found = np.concatenate([xy + 0.1, extra])
        detections.append(Detections(found, np.linspace(1, 0.1, len(found)), ids))
    return truth, detections


@pytest.fixture(scope="module")
def scores():
    return score(*ladder(), resamples=50)


@pytest.fixture(scope="module")
def report(scores):
    def image(k):
        return np.full((300, 640), 40 + k, np.uint8)

    config = {"kind": "suite", "patches": [{"id": 0, "name": "checker"}, {"id": 1, "name": "<trefoil>"}]}
    other = score(*ladder(share={3: 1.0, 15: 0.5}, condition="fog & <rain>"), resamples=50)
    assert other.conditions == {"fog & <rain>": [3, 15]}
    return Report(
        (scores,), config, (pick_worst_cases(scores.outcomes, image),), {"command": "kpbench <score>"}, title="A & B"
    )


# --- tables -----------------------------------------------------------------------------------------------------

TABLE = Table(
    "A & B",
    ("name", "a|b", "x_y"),
    (("p|q", Estimate(0.25, (0.125, 0.5)), 3), ("50 %", Estimate(None), None), ("ε", 0.0004, 2.0)),
    "100 % {n}",
)


def test_plain_columns_are_aligned():
    assert to_plain(TABLE).splitlines() == [
        "name  a|b                   x_y",
        "p|q   0.250 [0.125, 0.500]  3",
        "50 %  n/a                   n/a",
        "ε     0.0004                2.000",
    ]


def test_markdown_keeps_its_columns():
    lines = to_markdown(TABLE).splitlines()
    assert lines[0] == "**A & B**"
    assert [len(re.split(r"(?<!\\)\|", line)) for line in lines[2:7]] == [5] * 5
    assert lines[-1] == "100 % {n}"


def test_latex_is_escaped():
    text = to_latex(TABLE)
    assert r"\caption{A \& B. 100 \% \{n\} Sub- and superscripts are 95 \% intervals.}\label{tab:a-b}" in text
    assert r"name & a\textbar{}b & x\_y \\" in text
    assert r"p\textbar{}q & $0.250\sb{0.125}\sp{0.500}$ & 3 \\" in text
    assert r"$\varepsilon$ & 0.0004 & 2.000 \\" in text
    assert text.count(r"\begin{tabular}{lrr}") == text.count(r"\end{tabular}") == 1


# --- the paper --------------------------------------------------------------------------------------------------


def test_the_papers_numbers():
    assert {t.number: len(t.rungs) for t in PAPER.values()} == {3: 7, 4: 7, 5: 4, 6: 4, 7: 4}
    for table in PAPER.values():
        assert len(table.detection_score) == len(table.id_matching_score) == len(table.rungs)
        assert len(table.average_false_alarm) == len(table.rungs)
    assert paper_value("blur", 15, "detection_score") == 0.605
    assert paper_value("noise", 60, "id_matching_score") == 0
    assert paper_value("scale", 4, "average_false_alarm") == 1.032
    assert paper_value("blur", 5, "detection_score") is paper_value(None, None, "recall") is None
    assert SYNTHETIC["none"]["average_false_alarm"] == 0.379  # the table, not the text


def test_the_papers_table_says_what_is_simulated(scores):
    table = paper_table([scores], PAPER["blur"])
    assert table.title == "Blur kernel (paper: photographs; ours: simulated)"
    assert table.columns == ("metric", "detector", "images", "3 px", "7 px", "11 px", "15 px")
    assert table.rows[0] == ("detection", "paper", "photographs", 1.0, 0.986, 0.882, 0.605)
    assert table.rows[1][:3] == ("detection", "detector", "simulated")
    assert [cell.value for cell in table.rows[1][3:]] == [1, 0.95, 0.5, 0.25]
    partly = paper_table([score(*ladder(share={3: 1.0}), resamples=0)], PAPER["blur"])
    assert [cell and cell.value for cell in partly.rows[1][3:]] == [1, None, None, None]


# --- breakpoints ------------------------------------------------------------------------------------------------


def test_a_breakpoint_lies_on_the_line_between_two_rungs(scores):
    (b,) = find_breakpoints(scores, 0.9)
    assert (b.condition, b.crossing) == ("blur", "falls")
    assert b.rung == pytest.approx(7 + 4 * 0.05 / 0.45)
    assert b.interval == pytest.approx((b.rung, b.rung))  # all scenes are alike
    assert find_breakpoints(scores, 0.2)[0].crossing == "over"
    rising = score(*ladder(share={1: 0.5, 2: 0.8, 4: 1.0}), resamples=10)
    (b,) = find_breakpoints(rising, 0.9)
    assert (b.crossing, b.rung) == ("rises", pytest.approx(3))
    assert find_breakpoints(rising, 1.01)[0].crossing == "under"
    valley = score(*ladder(share={1: 1.0, 2: 0.5, 3: 1.0}), resamples=0)
    assert [(b.crossing, b.rung, b.interval) for b in find_breakpoints(valley, 0.75)] == [
        ("falls", 1.5, None),
        ("rises", 2.5, None),
    ]
    one_rung = [score(*ladder(share={1: share}), resamples=10) for share in (1.0, 0.5)]
    assert [b.crossing for run in one_rung for b in find_breakpoints(run, 0.9)] == ["over", "under"]


def test_a_breakpoints_interval_is_that_of_its_scenes():
    truth, detections = ladder(scenes=40)
    rng = np.random.default_rng(0)
    keep = rng.random(40)
    some = [d[rng.random(len(d)) < 0.7 + 0.3 * keep[k % 40]] for k, d in enumerate(detections)]
    scores = score(truth, some, resamples=400)
    (b,) = find_breakpoints(scores, 0.6)
    low, high = b.interval
    assert low < b.rung < high
    assert high - low < 2


# --- charts -----------------------------------------------------------------------------------------------------


def test_charts_are_xml_with_a_gap_where_a_value_is_missing():
    line = Series("a <b>", [1, 2, 3, 4], [0.5, 0.5, None, 1.0], [(0.4, 0.6), None, None, (0.9, 1.0)])
    svg = line_chart([line], "x & y", "score", y_range=(0, 1), log_x=True)
    root = ET.fromstring(svg)
    lines = [e.get("points").split() for e in root.iter("polyline")]
    assert [len(points) for points in lines] == [2, 1]
    assert next(e.text for e in root.iter("title")) == "a <b>: 0.500 [0.400, 0.600] at 1"
    x, y = map(float, lines[1][0].split(","))
    assert (x, y) == (468, 10)  # the last point, at the top of the right edge
    ET.fromstring(line_chart([], "x", "y"))
    ET.fromstring(line_chart([Series("one", [3], [0.0])], "x", "y"))
    bars = ET.fromstring(bar_chart([("a", (3, 1)), ("b", (0, 0))], ("hit", "miss"), (0, 1)))
    widths = [float(r.get("width")) for r in bars.iter("rect")]
    assert widths[0] == pytest.approx(3 * widths[1])
    assert len(widths) == 2


def test_severity_chart_shows_the_paper(scores):
    figure = severity_chart([scores], "blur")
    assert figure.legend == (("detector", 0), ("paper, photographs", 7))
    titles = [e.text for e in ET.fromstring(figure.svg).iter("title")]
    assert "paper, photographs: 0.605 at 15" in titles
    assert any(t.startswith("detector: 0.250") for t in titles)


# --- the report -------------------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Checks that tags close, and keeps links, targets and loaded addresses."""

    VOID = frozenset(
        {"meta", "link", "img", "br", "image", "ellipse", "path", "circle", "line", "rect", "polyline", "polygon"}
    )

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.links, self.loads, self.tags = [], [], [], [], []
        self.feed(text)
        assert not self.open, self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        for name, value in attributes:
            if name == "id":
                self.ids.append(value)
            elif name == "href" and tag == "a":
                self.links.append(value)
            elif name in ("src", "href"):
                self.loads.append(value)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag


def test_html_is_whole_and_loads_nothing(report):
    text = to_html(report)
    page = Page(text)
    assert len(set(page.ids)) == len(page.ids)
    assert {link[1:] for link in page.links} <= set(page.ids)
    assert page.loads
    assert all(address.startswith("data:image/jpeg;base64,") for address in page.loads)
    assert "&lt;trefoil&gt;" in text
    assert "<trefoil>" not in text
    assert "kpbench &lt;score&gt;" in text
    assert "simulated" in text
    assert "photographs" in text
    assert to_html(report) == text


def test_text_reports_hold_every_table_and_the_provenance(report):
    markdown, latex = to_markdown_report(report), to_latex_report(report)
    assert markdown.startswith("# A & B\n")
    for title in ("All images", "Blur kernel (paper: photographs; ours: simulated)", "By radius: detector"):
        assert f"**{title}**" in markdown
        assert f"caption{{{title}" in latex
    assert "kpbench <score>" in markdown
    assert "kpbench <score>" in latex
    bare = [line for line in latex.splitlines() if line and line[0] not in "%\\" and "&" not in line]
    assert bare == []


def test_a_report_of_scores_without_ids_conditions_or_detections(tmp_path):
    truth, _ = ladder(scenes=1, share={3: 0.0}, condition="")
    truth = Truth(**{**vars(truth), "rung": np.full(1, np.nan), "fingerprint": ""})
    nothing = score(truth, [Detections.none(with_ids=False)])
    blind = score(truth, [Detections([[20, 40]], [1.0])])
    for run in (nothing, blind):
        write_report(tmp_path / "r.html", Report((run,), {"kind": "synth", "deteriorate": "none"}, ((),)))
        Page((tmp_path / "r.html").read_text())
        assert "Blur" not in to_markdown_report(Report((run,)))
    assert "without deterioration" in (tmp_path / "r.html").read_text()


def test_several_detectors_share_every_table(scores):
    other = score(*ladder(share={3: 0.5, 7: 0.4, 11: 0.3, 15: 0.0}), resamples=10)
    text = to_markdown_report(Report((scores, other)))
    table = text[text.index("**Blur kernel") :].split("\n\n")[1]
    assert table.count("| detection |") == 5  # the paper, and each of ours with its difference


def test_a_slice_stands_under_the_detector_that_it_is_of():
    def run(name, *slices):
        keys = ("quantity", "range", "truths", "detection_score", "interval")
        return SimpleNamespace(name=name, slices=[dict(zip(keys, values, strict=True)) for values in slices])

    patches = run("patches", ("tilt_deg", [30, 45], 8, 0.9, None))
    tags = run("tags", ("tilt_deg", [15, 30], 6, 0.5, None), ("tilt_deg", [30, 45], 4, 0.25, None))
    table = slice_table([patches, tags])  # boards of their own have keypoints of their own
    assert [row[1:] for row in table.rows] == [
        ("15", "30", 6, None, Estimate(0.5)),
        ("30", "45", "8 / 4", Estimate(0.9), Estimate(0.25)),
    ]


def test_an_unknown_suffix_is_one_line(report, tmp_path):
    known = r"\.html, \.md, \.tex, \.pdf, \.png, \.svg"
    with pytest.raises(DataError, match=rf"r\.doc: unknown kind of report, expected {known}"):
        write_report(tmp_path / "r.doc", report)


# --- LaTeX that fits --------------------------------------------------------------------------------------------


def latex_document(latex):
    head = r"\documentclass{article}\usepackage{booktabs,longtable}\begin{document}"
    return f"{head}\n{latex}\n\\end{{document}}\n"


def wide_report():
    names = ("superpoint-small", "template", "a detector with a name that is long")
    shares = {float(rung): 0.5 for rung in range(1, 14)}
    runs = [replace(score(*ladder(2, shares), resamples=20), name=name) for name in names]
    return Report(tuple(runs), comparisons=tuple(compare(runs[0], run) for run in runs[1:]))


def test_no_table_of_a_latex_report_is_wider_than_the_page():
    """Widths of Computer Modern at 8 pt, and of its sub- and superscripts at 6 pt, as Matplotlib measures them."""
    pytest.importorskip("matplotlib")
    latex = to_latex_report(wide_report())
    tables = re.findall(r"\\begin\{(?:tabular|longtable)\}\{([lr]+)\}(.*?)\\end\{(?:tabular|longtable)\}", latex, re.S)
    assert len(tables) > 10
    for columns, body in tables:
        rows = [row.split(" & ") for row in body.splitlines() if " & " in row]
        assert {len(row) for row in rows} == {len(columns)}
        widths = [max(width_pt(row[n]) for row in rows) for n in range(len(columns))]
        assert sum(widths) + 6 * len(columns) <= 345, rows[0]
    labels = re.findall(r"\\label\{([^}]*)\}", latex)
    assert all(re.fullmatch("tab:[a-z0-9-]+", label) for label in labels)


def width_pt(cell):
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    font = TextToPath()

    def measure(text, size):
        return font.get_text_width_height_descent(text, FontProperties(family="cmr10", size=size), False)[0]

    text = cell.removesuffix(r" \\").strip("$")
    if text.startswith("\\parbox"):
        return float(re.search(r"\{(\d+)pt\}", text)[1])
    if text.startswith("\\shortstack"):
        return max(measure(line, 8) for line in text[text.index("{") + 1 : -1].split(r"\\"))
    value, _, bounds = text.partition(r"\sb")
    return measure(value, 8) + max((measure(b, 6) for b in re.findall(r"\{([^}]*)\}", bounds)), default=0.0)


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex")
def test_a_latex_report_compiles_without_an_overfull_box(tmp_path):
    (tmp_path / "r.tex").write_text(latex_document(to_latex_report(wide_report())))
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "r.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Overfull" not in (tmp_path / "r.log").read_text()


# --- figures ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("suffix", "start"), [(".pdf", b"%PDF-"), (".png", b"\x89PNG"), (".svg", b"<?xml")])
def test_a_figure_shows_each_line_in_its_colour_and_may_be_replaced(report, tmp_path, suffix, start):
    pytest.importorskip("matplotlib")
    file = tmp_path / f"severity{suffix}"
    write_report(file, report)
    first = file.read_bytes()
    assert first.startswith(start)
    assert kind_of(first[:HEAD_BYTES], first[-TAIL_BYTES:]) == "report"
    write_report(file, report)
    assert file.read_bytes() == first
    if suffix == ".svg":
        ET.fromstring(first)
        assert all(f"stroke: {LIGHT_COLOURS[style]}".encode() in first for style in (0, 7))


def test_a_figure_needs_conditions(tmp_path):
    plain = score(*ladder(1, {3: 1.0}, condition=""), resamples=0)
    with pytest.raises(DataError, match=r"f\.svg: the images have no conditions, so there is no severity curve"):
        write_report(tmp_path / "f.svg", Report((plain,)))


def test_names_of_detectors(scores):
    versioned = replace(scores, name="net 0050e9b5")
    versioned.outcomes.detector.update(name="net", version="0050e9b5")
    try:
        assert [run.name for run in name_runs([versioned])] == ["net"]
        assert [run.name for run in name_runs([versioned, versioned])] == ["net 0050e9b5"] * 2
        assert [run.name for run in name_runs([versioned, versioned], ["a", "b"])] == ["a", "b"]
        with pytest.raises(DataError, match="expected 2 different names, one per predictions file"):
            name_runs([versioned, versioned], ["a", "a"])
    finally:
        versioned.outcomes.detector.clear()


def test_the_scores_file_holds_breakpoints_and_csv_says_what_it_is_of(scores):
    content = json.loads(encode_scores(scores, {"kpbench": "1"}))
    assert content["breakpoints"][0]["crossing"] == "falls"
    rows = list(
        csv.DictReader(
            io.StringIO(encode_scores_csv(scores, {"kpbench": "1", "dataset": {"source": "photographs"}}).decode())
        )
    )
    assert {row["dataset"] for row in rows} == {"f" * 64}
    assert {(row["radius_px_low"], row["radius_px_high"]) for row in rows} == {
        ("", ""), ("0", "5"), ("5", "10"), ("10", "20"), ("20", "40"),
    }  # fmt: skip


# --- the gallery ------------------------------------------------------------------------------------------------


def test_the_worst_images_come_first_and_a_good_one_never(scores):
    cases = pick_worst_cases(scores.outcomes, lambda k: np.zeros((300, 640), np.uint8), 20)
    assert {case.rung for case in cases} == {7, 11, 15}
    wrong = [sum(case.failures.values()) for case in cases]
    assert wrong == sorted(wrong, reverse=True)
    assert cases[0].failures == {"missed": 15, "clutter": 1}
    eleven = next(case for case in cases if case.rung == 11)
    assert eleven.failures == {"missed": 10, "wrong ID": 1}
    assert [m.kind for m in eleven.truth].count("wrong ID") == 1
    assert [m.kind for m in eleven.detections].count("matched") == 9
    flawless = score(*ladder(share={3: 1.0}), resamples=0)
    assert pick_worst_cases(flawless.outcomes, lambda k: np.zeros((300, 640), np.uint8)) == ()


def test_conditions_share_the_gallery():
    truth, detections = ladder()
    names = np.where(truth.rung < 10, "a", "b")
    mixed = score(Truth(**{**vars(truth), "condition": names}), detections, resamples=0)
    cases = pick_worst_cases(mixed.outcomes, lambda k: np.zeros((300, 640), np.uint8), 8)
    assert [case.condition for case in cases].count("b") == 4


def test_a_small_board_is_shown_larger():
    truth, _ = ladder(scenes=1, share={3: 0.0})
    keypoints = truth.keypoints.copy()
    keypoints["x"], keypoints["y"], keypoints["radius_major"] = keypoints["x"] / 10 + 500, 250, 3
    scores = score(Truth(**{**vars(truth), "keypoints": keypoints}), [Detections.none()], resamples=0)
    (case,) = pick_worst_cases(scores.outcomes, lambda k: np.zeros((300, 640), np.uint8))
    left, top, width, height = case.box
    assert (width, height) == (160, 75)
    assert left <= 502 - 9
    assert left + width >= 559 + 9 or left + width == 640
    assert top + height <= 300


# --- in a browser -----------------------------------------------------------------------------------------------

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)

PROBE = """
const out = {galleries: document.querySelectorAll(".gallery .case image").length, sorts: 0, wrong: [], focus: 0};
for (const table of document.querySelectorAll("table")) {
  table.querySelectorAll("th button").forEach((button, column) => {
    for (const turn of ["ascending", "descending"]) {
      button.focus(); out.focus += document.activeElement === button; button.click();
      const cells = [...table.tBodies[0].rows].map(r => r.cells[column].dataset.v);
      const values = cells.filter(v => v !== "" && !isNaN(v)).map(Number);
      const sorted = [...values].sort((a, b) => turn === "ascending" ? a - b : b - a);
      const said = button.parentElement.getAttribute("aria-sort");
      if (values.join() !== sorted.join() || said !== turn) out.wrong.push(button.textContent);
      out.sorts++;
    }
  });
}
const toggle = document.querySelector("[data-toggle]"), figure = toggle.closest("figure");
const line = figure.querySelector("polyline"), chart = figure.querySelector("svg.chart");
const box = chart.getBoundingClientRect();
toggle.click(); out.off = getComputedStyle(line).display; toggle.click(); out.on = getComputedStyle(line).display;
const move = () => chart.dispatchEvent(new PointerEvent("pointermove", {clientX: box.right - 5, clientY: box.top + 9}));
move(); out.read = figure.querySelector(".readout").textContent;
figure.querySelector("[data-zoom]").click(); out.zoomed = chart.getAttribute("viewBox");
figure.querySelector("[data-zoom='0']").click(); out.whole = chart.getAttribute("viewBox");
out.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
out.drawn = [...document.querySelectorAll(".case image")].every(i => i.getBBox().width > 0);
document.body.textContent = "PROBE" + JSON.stringify(out) + "PROBE";
"""


class Proxy(socketserver.ThreadingTCPServer):
    """Stands where the network would be, and writes down what is asked of it."""

    allow_reuse_address = daemon_threads = True

    def __init__(self):
        self.asked = []
        super().__init__(("127.0.0.1", 0), Asked)


class Asked(socketserver.StreamRequestHandler):
    def handle(self):
        self.server.asked.append(self.rfile.readline().decode(errors="replace").strip())
        self.wfile.write(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")


def browse(page, profile, width=1280):
    """DOM, console lines, and requests to the network of a page opened in a headless browser."""
    with Proxy() as proxy:
        threading.Thread(target=proxy.serve_forever, daemon=True).start()
        flags = [
            "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", "--disable-default-apps", "--disable-extensions",
            "--enable-logging=stderr", f"--window-size={width},900", f"--user-data-dir={profile}",
            f"--proxy-server=127.0.0.1:{proxy.server_address[1]}", "--proxy-bypass-list=<-loopback>",
            "--virtual-time-budget=3000", "--dump-dom",
        ]  # fmt: skip
        done = subprocess.run([CHROMIUM, *flags, page.as_uri()], capture_output=True, text=True, timeout=120)
        proxy.shutdown()
        console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
        # A browser asks its maker for things of its own
        return done.stdout, console, [line for line in proxy.asked if "google" not in line]


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium installed")
@pytest.mark.parametrize("width", [1280, 500])
def test_the_page_works_in_a_browser_without_network(report, tmp_path, width):
    page = tmp_path / "report.html"
    page.write_text(to_html(report).replace("</body>", f"<script>{PROBE}</script></body>"))
    dom, console, asked = browse(page, tmp_path / "profile", width)
    assert console == []
    assert asked == []
    probe = json.loads(dom.split("PROBE")[1])
    assert probe["galleries"] == 12
    assert probe["drawn"]
    assert probe["wrong"] == []
    assert (probe["off"], probe["on"]) == ("none", "inline")
    assert probe["read"].startswith("detector: 0.250")
    assert (probe["zoomed"] != probe["whole"], probe["whole"]) == (True, "0 0 480 300")
    assert probe["focus"] == probe["sorts"] > 20
    assert probe["wide"] <= 0  # tables scroll in their own boxes, the page never sideways


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium installed")
def test_the_browser_test_would_see_a_request_and_an_error(tmp_path):
    page = tmp_path / "bad.html"
    page.write_text('<img src="http://kpbench.invalid/x.png"><script>console.error("oh"); nothing.here</script>')
    _, console, asked = browse(page, tmp_path / "profile")
    assert len(console) == 2
    assert any("http://kpbench.invalid/x.png" in line for line in asked)


# --- time and memory --------------------------------------------------------------------------------------------


def test_what_a_detector_took_stands_in_the_report_of_its_predictions(scores):
    assert cost_table([scores]).rows == ()
    found = Predictions.from_detections([Detections.none()] * 2, [0, 1], {"name": "a"}, "", ms=[2.0, 4.0])
    cost = record_cost(found).detector["cost"]
    assert (cost["ms_median"], cost["machine"]) == (3.0, cost["machine"])
    assert cost["peak_mib"] is None or 10 < cost["peak_mib"] < 10**5
    told = score(Truth(**{**vars(ladder(1, {3: 1.0})[0])}), [Detections.none()], resamples=0)
    told.outcomes.detector.update(cost={"ms_median": 3.0, "ms_p95": [], "machine": "<x>"})
    assert cost_table([told]).rows == (("detector", 3.0, "[]", None, "<x>"),)
    assert "Time and memory" in to_markdown_report(Report((told,)))
