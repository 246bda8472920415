"""Report the scores of one or several detectors on one dataset: HTML in one offline file, Markdown, LaTeX.

:func:`make_sections` makes the content of a report. One function per format renders the content.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kpbench.errors import DataError
from kpbench.files import encode_utf8
from kpbench.provenance import UNKNOWN_SOURCE, describe_images, image_source
from kpbench.report.charts import CHART_COLOURS, CHART_STYLE
from kpbench.report.paper import PAPER, SYNTHETIC, SYNTHETIC_RADIUS_PX
from kpbench.report.score_charts import (
    Figure,
    eps_chart,
    precision_recall_chart,
    radius_chart,
    severity_chart,
    taxonomy_charts,
)
from kpbench.report.score_tables import (
    bias_table,
    breakpoint_table,
    condition_table,
    confusion_table,
    count_table,
    difference_table,
    group_table,
    nees_table,
    overview_table,
    paper_table,
    reliability_table,
    synthetic_table,
    verdict_table,
)
from kpbench.report.tables import Cell, Estimate, Table, cell_text, to_latex, to_markdown
from kpbench.scoring.comparison import Comparison
from kpbench.scoring.scores import Scores
from kpbench.text import escape_markdown, escape_terminal
from kpbench.writing import write_file

if TYPE_CHECKING:
    from kpbench.report.worst_cases import Case


@dataclass(frozen=True)
class Report:
    """The content of a report.

    Attributes
    ----------
    runs : tuple of Scores
        Scores of one or more detectors on the same truth.
    config : mapping
        The dataset's config: how the images were made, and the names of the patches. May be empty.
    cases : tuple of tuples of Case
        The images to show for each run; may be empty.
    provenance : mapping
        Versions, command, digests of the predictions, fingerprint of the dataset.
    comparisons : tuple of Comparison
        Comparisons of the first run with each other run; may be empty.
    poses : tuple of Table
        Results of :func:`kpbench.report.pose_table`; may be empty.
    title : str

    Examples
    --------
    >>> import kpbench
    >>> dataset = kpbench.open_dataset("kpbench-data")
    >>> scores = kpbench.score(dataset, kpbench.read_predictions("preds.json"))
    >>> kpbench.report.Report((scores,), dataset.config).images
    'simulated'
    """

    runs: tuple[Scores, ...]
    config: Mapping[str, Any] = field(default_factory=dict)
    cases: tuple[tuple[Case, ...], ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    comparisons: tuple[Comparison, ...] = ()
    poses: tuple[Table, ...] = ()
    title: str = "kpbench report"

    @property
    def images(self) -> str:
        """What the images are, see :func:`kpbench.provenance.image_source`; "" if the config does not tell."""
        return image_source(self.config)

    @property
    def patch_names(self) -> dict[int, str]:
        """Names of the patches in the config, by patch ID."""
        return {int(patch["id"]): str(patch["name"]) for patch in self.config.get("patches", ())}


@dataclass(frozen=True)
class Gallery:
    """Pictures of a detector's failures."""

    name: str
    cases: tuple[Case, ...]


Block = Table | Figure | Gallery
"""A table, chart or gallery in a section."""


@dataclass(frozen=True)
class Section:
    """A section of a report: a title, a short text, and tables, charts or galleries."""

    title: str
    lead: str
    blocks: tuple[Block, ...]


def make_sections(report: Report) -> list[Section]:
    """Make the sections of a report, in order. A section without content is left out."""
    makers = (
        _overview_section,
        _comparison_section,
        _paper_section,
        _severity_section,
        _precision_recall_section,
        _radius_section,
        _bias_section,
        _pose_section,
        _identity_section,
        _worst_cases_section,
        _all_groups_section,
    )
    return [section for make in makers for section in [make(report)] if section.blocks]


def _overview_section(report: Report) -> Section:
    runs, settings = report.runs, report.runs[0].settings
    return Section(
        "Overview",
        f"A detection can match a keypoint at a distance of at most {settings.eps:g} radii ({settings.eps_radius} "
        f"semi-axis): the matching threshold. Matching is {settings.matching}. "
        "All intervals are 95 % intervals from resampled scenes.",
        (overview_table(runs), count_table(runs), *taxonomy_charts(runs)),
    )


def _comparison_section(report: Report) -> Section:
    comparisons = report.comparisons
    tables = [verdict_table(comparisons), *map(difference_table, comparisons)] if comparisons else []
    lead = "Differences are paired: each resample draws the same scenes for both detectors."
    return Section("Compared", lead, tuple(tables))


def _paper_section(report: Report) -> Section:
    known = [PAPER[name] for name in _conditions(report) if name in PAPER]
    tables = [paper_table(report.runs, table, report.images or UNKNOWN_SOURCE) for table in known]
    deteriorate, limits = str(report.config.get("deteriorate")), report.config.get("limits", {})
    radius_px = tuple(limits.get("radius_px", SYNTHETIC_RADIUS_PX))
    if deteriorate in SYNTHETIC and radius_px == SYNTHETIC_RADIUS_PX:
        tables.append(synthetic_table(report.runs, deteriorate))
    return Section(
        "Beside the paper",
        "The paper's photographs are not public. The paper's numbers and ours come from different images and different "
        "prints. Compare the shapes of the curves, not the values.",
        tuple(tables),
    )


def _severity_section(report: Report) -> Section:
    runs, conditions = report.runs, _conditions(report)
    metrics = ("detection_score", "average_false_alarm")
    charts = [severity_chart(runs, name, metric) for name in conditions for metric in metrics]
    others = [condition_table(runs, name) for name in conditions if name not in PAPER]
    blocks: list[Block] = [breakpoint_table(runs), *charts, *others] if conditions else []
    return Section("Severity", "Metrics at each rung of each condition, over all patches.", tuple(blocks))


def _precision_recall_section(report: Report) -> Section:
    calibration = (reliability_table(run) for run in report.runs if run.reliability["bins"])
    return Section(
        "Precision and recall",
        "Precision and recall at every score threshold; detection score against the matching threshold.",
        (precision_recall_chart(report.runs), eps_chart(report.runs), *calibration),
    )


def _radius_section(report: Report) -> Section:
    runs = report.runs
    bins = [(run, [g for g in run.by if g.key.radius_px is not None]) for run in runs]
    blocks: tuple[Block, ...] = ()
    if bins[0][1]:
        charts = (radius_chart(runs, "error_median_px"), radius_chart(runs, "detection_score"))
        blocks = (*charts, *(group_table(groups, f"By radius: {run.name}") for run, groups in bins))
    lead = "Only matches have errors, so no error exceeds the matching threshold."
    return Section("Localisation by radius", lead, blocks)


def _bias_section(report: Report) -> Section:
    runs = report.runs
    if all(run["bias_px"] is None and run["sigma_median_px"] is None for run in runs):
        return Section("Bias and uncertainty", "", ())
    lead = "The mean error apart from the scatter about it, and how the errors compare with the predicted covariances."
    tables = (bias_table(runs, report.patch_names), *(nees_table(run) for run in runs if run.nees_by_sigma))
    return Section("Bias and uncertainty", lead, tables)


def _pose_section(report: Report) -> Section:
    lead = "Errors of the board's pose. solvePnP estimates the pose from the matched detections."
    return Section("Pose", lead, report.poses)


def _identity_section(report: Report) -> Section:
    return Section(
        "Identities",
        "Matched detections: true IDs in rows, detected IDs in columns. The column “other” counts IDs that no true "
        "keypoint has, and matches with two different IDs at one place and one score.",
        tuple(confusion_table(run, report.patch_names) for run in report.runs if run.confusion),
    )


def _worst_cases_section(report: Report) -> Section:
    galleries = (Gallery(run.name, cases) for run, cases in zip(report.runs, report.cases, strict=True))
    return Section(
        "Worst cases",
        "The images with the most failures. All conditions have the same limit on the number of images. Ellipses are "
        "true keypoints, crosses are detections, numbers are detected IDs.",
        tuple(galleries) if report.cases else (),
    )


def _all_groups_section(report: Report) -> Section:
    listed = [(run, [g for g in run.by if g.key.radius_px is None]) for run in report.runs]
    tables = tuple(group_table(groups, run.name, report.patch_names) for run, groups in listed if groups)
    return Section("All groups", "The metrics of each condition, rung and patch.", tables)


def _conditions(report: Report) -> list[str]:
    return list(dict.fromkeys(name for run in report.runs for name in run.conditions))


def to_markdown_report(report: Report) -> str:
    """Render the tables and the text of a report as Markdown, without charts and pictures."""
    return _render_text(report, to_markdown, "# {}", "## {}", escape_markdown, "```json\n{}\n```")


def to_latex_report(report: Report) -> str:
    """Render the tables of a report as LaTeX, each in a ``table`` environment. Other text becomes comments."""

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
"""For each file suffix, the function that renders a report."""


def write_report(path: str | Path, report: Report) -> None:
    """Write a report, whole or not at all.

    Parameters
    ----------
    path : str or Path
        The suffix selects the format: .html, .md or .tex.
    report : Report

    Raises
    ------
    DataError
        If the path does not end in .html, .md or .tex, or the file cannot be written.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.write_report("report.md", kpbench.report.Report((scores,)))
    """
    path = Path(path)
    require_report_suffix(path)
    write_file(path, encode_utf8(_add_mark(path.suffix.lower(), REPORT_WRITERS[path.suffix.lower()](report))))


def require_report_suffix(path: Path) -> None:
    """Refuse a path that does not end in .html, .md or .tex.

    Raises
    ------
    DataError
        If the path does not end in .html, .md or .tex.
    """
    if path.suffix.lower() not in REPORT_WRITERS:
        raise DataError(f"{path}: unknown kind of report, expected {', '.join(REPORT_WRITERS)}")
