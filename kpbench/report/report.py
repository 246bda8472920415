"""Report the scores of one or several detectors on one dataset: HTML in one offline file, Markdown, LaTeX.

:func:`kpbench.report.sections.make_sections` makes the content of a report. One function per format renders it.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from kpbench.errors import DataError
from kpbench.files import encode_utf8
from kpbench.provenance import describe_images
from kpbench.report.charts import CHART_COLOURS, CHART_STYLE
from kpbench.report.figures import FIGURE_FORMATS, draw_panels
from kpbench.report.latex import to_latex
from kpbench.report.score_charts import severity_panel
from kpbench.report.sections import Report, list_conditions, make_sections
from kpbench.report.tables import Cell, Estimate, Table, cell_text, to_markdown
from kpbench.text import escape_markdown, escape_terminal
from kpbench.writing import write_file


def to_markdown_report(report: Report) -> str:
    """Render the tables and the text of a report as Markdown, without charts and pictures."""
    return _render_text(report, to_markdown, "# {}", "## {}", escape_markdown, "```json\n{}\n```")


def to_latex_report(report: Report) -> str:
    """Render the tables of a report as LaTeX, see :func:`kpbench.report.to_latex`. Other text becomes comments."""

    def comment(text: str) -> str:
        return "\n".join(f"% {escape_terminal(line)}" for line in text.splitlines())

    return _render_text(report, to_latex, "{}", "{}", comment, None)


def _render_text(
    report: Report,
    to_text: Callable[[Table], str],
    title_template: str,
    section_template: str,
    format_prose: Callable[[str], str],
    provenance_template: str | None,
) -> str:
    """Render a report as plain text.

    Each template contains one ``{}``. If ``provenance_template`` is None, ``format_prose`` formats the provenance.
    """
    parts = [title_template.format(format_prose(report.title)), format_prose(_describe_images(report))]
    for section in make_sections(replace(report, cases=())):
        parts += [section_template.format(format_prose(section.title)), format_prose(section.lead)]
        parts += [to_text(block) for block in section.blocks if isinstance(block, Table)]
    content = json.dumps(report.provenance, indent=1)
    parts.append(format_prose(content) if provenance_template is None else provenance_template.format(content))
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def _describe_images(report: Report) -> str:
    first = report.runs[0]
    n = first.overall.counts
    fingerprint = f", fingerprint {first.fingerprint[:16]}" if first.fingerprint else ""
    images = describe_images(n["images"] or 0, report.images)
    text = f"{images} in {n['scenes']} scenes with {n['truths']} keypoints{fingerprint}."
    if first.outcomes.truth_points.least_reach_px is not None:
        error = first.truth_error
        text += f" The truth has a standard deviation of {error['sigma_median_px']:.4f} px (median); it limits the "
        text += f"matching threshold of {error['limited']:.0f} keypoints."
    if (ignored := first.ignored)["patches"]:
        text += f" {ignored['patches']} more patches are ignored: "
        text += " and ".join(f"{run.ignored['detections']} detections of {run.name}" for run in report.runs)
        text += " at them count neither way."
    return text


def to_html(report: Report) -> str:
    """Render a report as one page of HTML that loads no other file: styles, script, charts and pictures are inside."""
    import jinja2
    from markupsafe import Markup

    def clean(value: object) -> object:
        """Escape what no page may hold, before jinja2 escapes the markup."""
        return escape_terminal(value, lines=True) if isinstance(value, str) and not isinstance(value, Markup) else value

    folder = Path(__file__).parent / "templates"
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined, finalize=clean
    )
    template = environment.from_string((folder / "report.html").read_text("utf-8"))
    style = (folder / "report.css").read_text("utf-8") + CHART_STYLE
    return template.render(
        report=report,
        about=_describe_images(report),
        style=style,
        script=(folder / "report.js").read_text("utf-8"),
        sections=make_sections(report),
        provenance=json.dumps(report.provenance, indent=1),
        text=cell_text,
        sort_key=_sort_key,
        share=_share,
        chart_colours=CHART_COLOURS,
        base64=lambda data: base64.b64encode(data).decode(),
    )


def _sort_key(cell: Cell) -> str:
    """Return the text by which a browser sorts the cell: the number without its interval, or "" if undefined."""
    value = cell.value if isinstance(cell, Estimate) else cell
    return "" if value is None else str(value)


def _share(row: Sequence[Cell], cell: Cell) -> int:
    """Return a count as a percentage of the sum of its row; 0 for a cell that is no count."""
    total = sum(c for c in row if isinstance(c, int))
    return round(100 * cell / total) if isinstance(cell, int) and total else 0


def _add_mark(suffix: str, text: str) -> str:
    """Return a report with the mark that lets :func:`kpbench.writing.write_file` replace the file later."""
    start, end = {".html": ("", ""), ".md": ("<!-- ", " -->\n\n"), ".tex": ("% ", "\n")}[suffix]
    return f"{start}{REPORT_MARK}{end}{text}" if start else text


REPORT_MARK = "kpbench.report/1"
REPORT_WRITERS: dict[str, Callable[[Report], str]] = {
    ".html": to_html,
    ".md": to_markdown_report,
    ".tex": to_latex_report,
}
"""For each file suffix, the function that renders a report as text."""
REPORT_SUFFIXES = (*REPORT_WRITERS, *FIGURE_FORMATS)
"""Suffixes of files that a report can be written to; a figure shows the severity curves alone."""


def write_report(path: str | Path, report: Report) -> None:
    """Write a report, whole or not at all.

    Parameters
    ----------
    path : str or Path
        The suffix selects the format: .html, .md or .tex. A .pdf, .png or .svg shows the severity curves alone.
    report : Report

    Raises
    ------
    DataError
        If the path has another suffix, a figure is wanted of scores without conditions or without Matplotlib, or the
        file cannot be written.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.write_report("report.md", kpbench.report.Report((scores,)))
    """
    path = Path(path)
    require_report_suffix(path)
    suffix = path.suffix.lower()
    if suffix in FIGURE_FORMATS:
        panels = [severity_panel(report.runs, name) for name in list_conditions(report)]
        if not panels:
            raise DataError(f"{path}: the images have no conditions, so there is no severity curve")
        write_file(path, draw_panels(panels, suffix))
    else:
        write_file(path, encode_utf8(_add_mark(suffix, REPORT_WRITERS[suffix](report))))


def require_report_suffix(path: Path) -> None:
    """Refuse a path that does not end in one of :data:`REPORT_SUFFIXES`.

    Raises
    ------
    DataError
        If it does not.
    """
    if path.suffix.lower() not in REPORT_SUFFIXES:
        raise DataError(f"{path}: unknown kind of report, expected {', '.join(REPORT_SUFFIXES)}")
