"""The content of a report: sections of tables, charts and galleries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from kpbench.errors import DataError
from kpbench.provenance import UNKNOWN_SOURCE, image_source
from kpbench.report.detail_tables import bias_table, cost_table, nees_table, reliability_table, slice_table
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
    breakpoint_table,
    condition_table,
    confusion_table,
    count_table,
    difference_table,
    group_table,
    overview_table,
    paper_table,
    synthetic_table,
    verdict_table,
)
from kpbench.report.tables import Table
from kpbench.scoring.comparison import Comparison
from kpbench.scoring.scores import Scores

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


def name_runs(runs: Sequence[Scores], names: Sequence[str] = ()) -> list[Scores]:
    """Return scores under the given names, or else under the names of their detectors without version.

    Detectors that would share a name keep their version.

    Raises
    ------
    DataError
        If the number of names differs from the number of scores, or two names are equal.
    """
    if names and (len(names) != len(runs) or len({*names}) < len(runs)):
        raise DataError(
            f"`names` are {', '.join(names)}; expected {len(runs)} different names, one per predictions file"
        )
    short = list(names) or [str(run.detector.get("name") or run.name) for run in runs]
    return [run if short.count(name) > 1 else replace(run, name=name) for run, name in zip(runs, short, strict=True)]


def make_sections(report: Report) -> list[Section]:
    """Make the sections of a report, in order. A section without content is left out."""
    makers = (
        _overview_section,
        _comparison_section,
        _paper_section,
        _severity_section,
        _precision_recall_section,
        _radius_section,
        _slices_section,
        _bias_section,
        _pose_section,
        _identity_section,
        _worst_cases_section,
        _all_groups_section,
    )
    return [section for make in makers for section in [make(report)] if section.blocks]


def _overview_section(report: Report) -> Section:
    runs, settings = report.runs, report.runs[0].settings
    costs = cost_table(runs)
    return Section(
        "Overview",
        f"A detection can match a keypoint at a distance of at most {settings.eps:g} radii ({settings.eps_radius} "
        f"semi-axis): the matching threshold. Matching is {settings.matching}. "
        "All intervals are 95 % intervals from resampled scenes.",
        (overview_table(runs), count_table(runs), *([costs] if costs.rows else []), *taxonomy_charts(runs)),
    )


def _comparison_section(report: Report) -> Section:
    comparisons = report.comparisons
    tables = [verdict_table(comparisons), *map(difference_table, comparisons)] if comparisons else []
    lead = "Differences are paired: each resample draws the same scenes for both detectors."
    return Section("Compared", lead, tuple(tables))


def _paper_section(report: Report) -> Section:
    known = [PAPER[name] for name in list_conditions(report) if name in PAPER]
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
    runs, conditions = report.runs, list_conditions(report)
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


def _slices_section(report: Report) -> Section:
    lead = (
        "Keypoints that are alike in one quantity, over all conditions. Tilt is that of the disc to the line of sight."
    )
    tables = (slice_table(report.runs),) if any(run.slices for run in report.runs) else ()
    return Section("Slices", lead, tables)


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


def list_conditions(report: Report) -> list[str]:
    """Return the conditions of all detectors, in the order of their first images."""
    return list(dict.fromkeys(name for run in report.runs for name in run.conditions))
