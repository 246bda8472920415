"""Scores of one or several detectors on one dataset as a report: HTML in one offline file, Markdown, LaTeX.

:func:`sections` says what is in a report; each writer only says how it looks.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kpbench.errors import DataError
from kpbench.files import write_atomic
from kpbench.report.charts import STYLE
from kpbench.report.figures import (
    Figure,
    breakpoint_table,
    condition_table,
    confusion_table,
    count_table,
    difference_table,
    eps_chart,
    group_table,
    overview_table,
    paper_table,
    precision_recall_chart,
    radius_chart,
    severity_chart,
    synthetic_table,
    taxonomy_charts,
    verdict_table,
)
from kpbench.report.paper import PAPER, SYNTHETIC, SYNTHETIC_PX
from kpbench.report.tables import Cell, Estimate, Table, cell_text, to_latex, to_markdown
from kpbench.scoring.comparison import Comparison
from kpbench.scoring.scores import Scores

if TYPE_CHECKING:
    from kpbench.report.worst_cases import Case


@dataclass(frozen=True)
class Report:
    """What a report is made of.

    Attributes
    ----------
    runs : tuple of Scores
        One or more detectors on the same truth.
    config : mapping
        The dataset's, which says how its images were made and what the patches are called; may be empty.
    cases : tuple of tuples of Case
        For each run the images to show; may be empty.
    provenance : mapping
        Versions, command, fingerprints.
    comparisons : tuple of Comparison
        Of the first run with others; may be empty.
    poses : tuple of Table
        Of :func:`kpbench.report.pose_table`; may be empty.
    title : str
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
        """How the images were made: "simulated", or "" where the dataset does not say."""
        return "simulated" if self.config.get("kind") in ("suite", "synth") else ""

    @property
    def patch_names(self) -> dict[int, str]:
        """Names of the patches by ID, where the dataset tells them."""
        return {int(patch["id"]): str(patch["name"]) for patch in self.config.get("patches", ())}


@dataclass(frozen=True)
class Gallery:
    """Pictures of one detector's failures."""

    name: str
    cases: tuple[Case, ...]


@dataclass(frozen=True)
class Section:
    """A headline, a sentence or two, and tables, figures and pictures."""

    title: str
    lead: str
    blocks: tuple[Table | Figure | Gallery, ...]


def sections(report: Report) -> Iterator[Section]:
    """Everything in a report, in order."""
    runs, patches = report.runs, report.patch_names
    settings = runs[0].settings
    yield Section(
        "Overview",
        f"A detection matches a keypoint at most {settings.eps:g} of its {settings.eps_radius} radius away "
        f"({settings.matching}). Brackets hold 95 % intervals from resampled scenes.",
        (overview_table(runs), count_table(runs), *taxonomy_charts(runs)),
    )
    if report.comparisons:
        yield Section(
            "Compared",
            "Differences are paired: the same scenes are resampled for both.",
            (verdict_table(report.comparisons), *map(difference_table, report.comparisons)),
        )
    conditions = list(dict.fromkeys(name for run in runs for name in run.conditions))
    known = [PAPER[name] for name in conditions if name in PAPER]
    deteriorate, limits = str(report.config.get("deteriorate")), report.config.get("limits", {})
    like_the_papers = deteriorate in SYNTHETIC and tuple(limits.get("radius_px", SYNTHETIC_PX)) == SYNTHETIC_PX
    if known or like_the_papers:
        tables = [paper_table(runs, table, report.images or "the user's") for table in known]
        if like_the_papers:
            tables.append(synthetic_table(runs, deteriorate))
        yield Section(
            "Beside the paper",
            "The paper's photographs are not public. Its numbers and ours are from different images and different "
            "prints, so they may be compared in shape, not digit by digit.",
            tuple(tables),
        )
    if conditions:
        charts = [
            severity_chart(runs, name, metric)
            for name in conditions
            for metric in ("detection_score", "average_false_alarm")
        ]
        others = [condition_table(runs, name) for name in conditions if name not in PAPER]
        yield Section(
            "Severity",
            "Each condition from rung to rung, all patches together.",
            (breakpoint_table(runs), *charts, *others),
        )
    yield Section(
        "Precision and recall",
        "Which detections to keep, from the surest only to all; and how near a detection must come.",
        (precision_recall_chart(runs), eps_chart(runs)),
    )
    sized = [g for g in runs[0].by if g.key.radius_px is not None]
    if sized:
        tables = [
            group_table([g for g in run.by if g.key.radius_px is not None], f"By radius: {run.name}") for run in runs
        ]
        yield Section(
            "Localisation by radius",
            "Errors are of matches only, so they cannot exceed the reach of a match.",
            (radius_chart(runs, "error_median_px"), radius_chart(runs, "detection_score"), *tables),
        )
    if report.poses:
        yield Section("Pose", "The board's pose from the matched detections, by solvePnP.", report.poses)
    if any(run.confusion for run in runs):
        yield Section(
            "Identities",
            "Matched detections: true ID in rows, detected ID in columns; other is an ID that no true keypoint has.",
            tuple(confusion_table(run, patches) for run in runs if run.confusion),
        )
    if report.cases:
        yield Section(
            "Worst cases",
            "The images with most failures, shared out among the conditions. Ellipses are true keypoints, crosses are "
            "detections, numbers are IDs.",
            tuple(Gallery(run.name, cases) for run, cases in zip(runs, report.cases, strict=True)),
        )
    listed = [(run, [g for g in run.by if g.key.radius_px is None]) for run in runs]
    if any(groups for _, groups in listed):
        yield Section(
            "All groups",
            "Everything by condition, rung and patch.",
            tuple(group_table(groups, run.name, patches) for run, groups in listed if groups),
        )


def to_markdown_report(report: Report) -> str:
    """Tables and text of a report; charts and pictures are left out."""
    return _text(report, to_markdown, "# {}", "## {}", lambda text: text, "```json\n{}\n```")


def to_latex_report(report: Report) -> str:
    """Tables of a report, each a ``table`` environment, with the text between them as comments."""

    def comment(text: str) -> str:
        return "\n".join(f"% {line}" for line in text.splitlines())

    return _text(report, to_latex, "% {}", "% {}", comment, None)


def _text(
    report: Report,
    table: Callable[[Table], str],
    head: str,
    subhead: str,
    text: Callable[[str], str],
    provenance: str | None,
) -> str:
    parts = [head.format(report.title), text(_about(report))]
    for section in sections(replace(report, cases=())):
        parts += [subhead.format(section.title), text(section.lead)]
        parts += [table(block) for block in section.blocks if isinstance(block, Table)]
    known = json.dumps(report.provenance, indent=1)
    parts.append(text(known) if provenance is None else provenance.format(known))
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def _about(report: Report) -> str:
    first = report.runs[0]
    n = first.overall.counts
    made = f" {report.images}" if report.images else ""
    mark = f", fingerprint {first.fingerprint[:16]}" if first.fingerprint else ""
    return f"{n['images']}{made} images in {n['scenes']} scenes with {n['truths']} keypoints{mark}."


def to_html(report: Report) -> str:
    """A page that needs nothing but itself: styles, script, charts and pictures are inside, and it may load nothing."""
    import jinja2

    folder = Path(__file__).parent / "templates"
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    template = environment.from_string((folder / "report.html").read_text("utf-8"))
    style = (folder / "report.css").read_text("utf-8") + STYLE
    return template.render(
        report=report,
        about=_about(report),
        style=style,
        script=(folder / "report.js").read_text("utf-8"),
        sections=list(sections(report)),
        provenance=json.dumps(report.provenance, indent=1),
        text=cell_text,
        sort_key=_sort_key,
        share=_share,
        base64=lambda data: base64.b64encode(data).decode(),
    )


def _sort_key(cell: Cell) -> str:
    """What a browser sorts by: the bare number; nothing where there is none."""
    value = cell.value if isinstance(cell, Estimate) else cell
    return "" if value is None else str(value)


def _share(row: Sequence[Cell], cell: Cell) -> int:
    """Percent that a count has of its row."""
    total = sum(c for c in row if isinstance(c, int))
    return round(100 * cell / total) if isinstance(cell, int) and total else 0


REPORT_WRITERS: dict[str, Callable[[Report], str]] = {
    ".html": to_html,
    ".md": to_markdown_report,
    ".tex": to_latex_report,
}
"""The function that renders a report, by the suffix of its file."""


def write_report(path: str | Path, report: Report) -> None:
    """Write a report, whole or not at all. The suffix of the path selects the form: .html, .md or .tex.

    Raises
    ------
    DataError
        If the suffix is another or the file cannot be written.
    """
    path = Path(path)
    require_report_suffix(path)
    write_atomic(path, REPORT_WRITERS[path.suffix.lower()](report).encode())


def require_report_suffix(path: Path) -> None:
    """Refuse a path whose suffix is that of no report.

    Raises
    ------
    DataError
        If the suffix is another than .html, .md and .tex.
    """
    if path.suffix.lower() not in REPORT_WRITERS:
        raise DataError(f"{path}: unknown kind of report, expected {', '.join(REPORT_WRITERS)}")
