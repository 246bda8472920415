"""Draw the scores of one or several detectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from kpbench.report.charts import Panel, Series, bar_chart, line_chart
from kpbench.report.paper import PAPER, paper_value
from kpbench.report.score_tables import get_estimate
from kpbench.report.tables import Estimate
from kpbench.scoring.metrics import LABELS
from kpbench.scoring.scores import Scores

PAPER_STYLE = 7
"""Index of the colour of the paper's lines, grey."""


@dataclass(frozen=True)
class Figure:
    """A chart with its caption and legend.

    Attributes
    ----------
    caption : str
    svg : str
        The chart, an ``<svg>`` element.
    legend : tuple of (name, style)
        Name and colour index of each series.
    lines : bool
        Whether the chart has a line per name of the legend, which a page can switch off.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.report.Figure("Nothing", "<svg></svg>").legend
    ()
    """

    caption: str
    svg: str
    legend: tuple[tuple[str, int], ...] = ()
    lines: bool = False


def severity_chart(runs: Sequence[Scores], condition: str, metric: str = "detection_score") -> Figure:
    """Draw a metric over the rungs of a condition.

    Each detector has a line with a 95 % band. The paper's line is dashed.

    Parameters
    ----------
    runs : sequence of Scores
    condition : str
    metric : str
        One of :data:`kpbench.scoring.METRICS`.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.report.severity_chart([scores], "blur").caption
    'blur: detection score'
    """
    panel = severity_panel(runs, condition, metric)
    svg = line_chart(
        panel.series, panel.x_label, panel.y_label, y_range=panel.y_range, x_ticks=panel.x_ticks, log_x=panel.log_x
    )
    legend = tuple((s.name, s.style) for s in panel.series)
    return Figure(f"{condition}: {LABELS[metric]}", svg, legend, lines=True)


def severity_panel(runs: Sequence[Scores], condition: str, metric: str = "detection_score") -> Panel:
    """Return the lines and axes of :func:`severity_chart`."""
    series = []
    for n, run in enumerate(runs):
        rungs = run.conditions.get(condition, [])
        found = [get_estimate(run.group(condition, r), metric) or Estimate(None) for r in rungs]
        series.append(Series(run.name, rungs, [e.value for e in found], [e.interval for e in found], n))
    paper = PAPER.get(condition)
    if paper:
        values = [paper_value(condition, r, metric) for r in paper.rungs]
        series.append(Series(f"paper, {paper.images}", paper.rungs, values, style=PAPER_STYLE, dashed=True))
    ticks = sorted({x for s in series for x in s.x})
    label = f"{paper.title} ({paper.unit})" if paper and paper.unit else paper.title if paper else condition
    bounded = metric not in ("average_false_alarm", "average_false_alarm_literal") and not metric.startswith("error")
    log_x = min(ticks, default=0) > 0 and max(ticks) / min(ticks) > 20
    return Panel(tuple(series), label, LABELS[metric], (0.0, 1.0) if bounded else None, tuple(ticks), log_x)


def precision_recall_chart(runs: Sequence[Scores]) -> Figure:
    """Draw precision over recall at all score thresholds."""
    series = []
    for n, run in enumerate(runs):
        recall = [0.0 if r is None else r for r in run.curve["recall"]]
        series.append(Series(run.name, recall, run.curve["precision"], style=n))
    svg = line_chart(
        series, "recall", "precision", y_range=(0.0, 1.0), x_ticks=(0, 0.2, 0.4, 0.6, 0.8, 1), markers=False
    )
    return Figure("Precision and recall over all thresholds", svg, tuple((s.name, s.style) for s in series), lines=True)


def eps_chart(runs: Sequence[Scores]) -> Figure:
    """Draw the detection score over the matching threshold ε."""
    series = [
        Series(run.name, [e or 0.0 for e in run.eps_curve["eps"]], run.eps_curve["detection_score"], style=n)
        for n, run in enumerate(runs)
    ]
    label = f"ε, in radii ({runs[0].settings.eps_radius})"
    ticks = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
    svg = line_chart(series, label, LABELS["detection_score"], y_range=(0.0, 1.0), x_ticks=ticks, log_x=True)
    return Figure("Detection score over ε", svg, tuple((s.name, s.style) for s in series), lines=True)


def radius_chart(runs: Sequence[Scores], metric: str) -> Figure:
    """Draw a metric over the radius of the true keypoints' discs.

    Each bin of radii is a point midway between the edges of the bin. The last bin has no upper edge, so its point is at
    1.5 times the lower edge.
    """
    series = []
    for n, run in enumerate(runs):
        bins = [(g, *g.key.radius_px) for g in run.by if g.key.radius_px is not None]
        middles = [(low + (high or 2 * low)) / 2 for _, low, high in bins]
        found = [Estimate(g.metrics[metric], g.intervals.get(metric)) for g, _, _ in bins]
        series.append(Series(run.name, middles, [e.value for e in found], [e.interval for e in found], n))
    ticks = sorted({x for s in series for x in s.x})
    svg = line_chart(
        series,
        "radius of the disc (px, middle of its bin)",
        LABELS[metric],
        y_range=(0.0, 1.0) if metric == "detection_score" else None,
        x_ticks=ticks,
        log_x=True,
    )
    return Figure(f"{LABELS[metric]} by radius", svg, tuple((s.name, s.style) for s in series), lines=True)


def taxonomy_charts(runs: Sequence[Scores]) -> tuple[Figure, Figure]:
    """Draw one chart of the outcomes of true keypoints and one of detections. Each bar is a detector."""
    keypoints: tuple[str, ...] = ("found with the right ID", "found with a wrong ID", "missed")
    if any(run.overall.counts["id_correct"] is None for run in runs):
        keypoints = ("found", "missed")
    detections = ("matched", "duplicate", "near miss", "clutter")
    truth, found = [], []
    for run in runs:
        n = {name: count or 0 for name, count in run.overall.counts.items()}
        parts = (n["id_correct"], n["wrong_id"]) if len(keypoints) == 3 else (n["matched"],)
        truth.append((run.name, (*parts, n["missed"])))
        found.append((run.name, (n["matched"], n["duplicate"], n["near_miss"], n["clutter"])))
    styles = (0, 4, 1) if len(keypoints) == 3 else (0, 1)
    return (
        Figure("True keypoints", bar_chart(truth, keypoints, styles), tuple(zip(keypoints, styles, strict=True))),
        Figure(
            "Detections", bar_chart(found, detections, (0, 3, 4, 1)), tuple(zip(detections, (0, 3, 4, 1), strict=True))
        ),
    )
