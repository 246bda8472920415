"""Tabulate the scores of one or several detectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from kpbench.report.paper import SYNTHETIC, PaperTable, paper_value
from kpbench.report.tables import Cell, Estimate, Table
from kpbench.scoring.breakpoints import DETECTION_SCORE_LIMIT, Breakpoint, find_breakpoints
from kpbench.scoring.comparison import COMPARED_METRICS, Comparison
from kpbench.scoring.groups import Group
from kpbench.scoring.metrics import LABELS, PAPER_METRICS
from kpbench.scoring.scores import Scores

SHORT_LABELS = dict(zip(PAPER_METRICS, ("detection", "ID matching", "false alarms"), strict=True))
"""Labels of the paper's metrics in narrow columns."""


def get_estimate(group: Group | None, metric: str) -> Estimate | None:
    """Return a metric of a group with its interval, or None if the group is None."""
    return None if group is None else Estimate(group.metrics[metric], group.intervals.get(metric))


def overview_table(runs: Sequence[Scores]) -> Table:
    """Tabulate the main metrics over all images, one row per detector.

    The note names the detectors that raised an error on some images.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> table = kpbench.report.overview_table([scores])
    >>> table.columns[:2], table.rows[0][0]
    (('detector', 'detection score'), 'oracle')
    """
    metrics = (*PAPER_METRICS, "precision", "f1", "average_precision", "error_median_px", "error_p95_px")
    rows = [(run.name, *(get_estimate(run.overall, metric) for metric in metrics)) for run in runs]
    failed = [f"{run.name} failed on {len(f)} images" for run in runs if (f := run.detector.get("failures"))]
    note = f"{', '.join(failed)}, which count as no detections." if failed else ""
    versions = [f"{run.name} {run.detector['version']}" for run in runs if run.detector.get("version")]
    note = " ".join(filter(None, (note, f"Versions: {', '.join(versions)}." if versions else "")))
    return Table("All images", ("detector", *(LABELS[m] for m in metrics)), tuple(rows), note)


def paper_table(runs: Sequence[Scores], table: PaperTable, images: str = "simulated") -> Table:
    """Tabulate the values of one of the paper's tables and the metrics of detectors, with one column per rung.

    Parameters
    ----------
    runs : sequence of Scores
    table : PaperTable
        One of :data:`kpbench.report.PAPER`.
    images : str
        How the detectors' images were made. The detectors' rows show this text.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> table = kpbench.report.paper_table([scores], kpbench.report.PAPER["blur"])
    >>> table.columns[3:], table.rows[0][:4]
    (('3 px', '7 px', '11 px', '15 px'), ('detection', 'paper', 'photographs', 1.0))
    """
    rungs = sorted({*table.rungs, *(r for run in runs for r in run.conditions.get(table.condition, ()))})
    rows: list[tuple[Cell, ...]] = []
    for metric in PAPER_METRICS:
        label = SHORT_LABELS[metric]
        paper_values = [paper_value(table.condition, rung, metric) for rung in rungs]
        rows.append((label, "paper", table.images, *(None if v is None else float(v) for v in paper_values)))
        for run in runs:
            found = [get_estimate(run.group(table.condition, rung), metric) for rung in rungs]
            rows.append((label, run.name, images, *found))
            rows.append((label, f"{run.name} less the paper", "", *map(_subtract_paper, found, paper_values)))
    unit = f" {table.unit}" if table.unit else ""
    title = f"{table.title} (paper: {table.images}; ours: {images})"
    return Table(
        title,
        ("metric", "detector", "images", *(f"{r:g}{unit}" for r in rungs)),
        tuple(rows),
        f"Paper: table {table.number} of arXiv:2410.00521.",
    )


def _subtract_paper(estimate: Estimate | None, paper: float | None) -> Estimate | None:
    """Return an estimate minus the paper's value. The paper's value has no interval, so the width stays the same."""
    if estimate is None or estimate.value is None or paper is None:
        return None
    interval = estimate.interval
    return Estimate(estimate.value - paper, interval and (interval[0] - paper, interval[1] - paper))


def synthetic_table(runs: Sequence[Scores], deteriorate: str) -> Table:
    """Tabulate the paper's table 2 and detectors. ``deteriorate`` ("none" or "paper") is the detectors' column."""
    rows: list[tuple[Cell, ...]] = []
    for metric in PAPER_METRICS:
        rows.append((SHORT_LABELS[metric], "paper", "its own simulation", *(SYNTHETIC[k][metric] for k in SYNTHETIC)))
        for run in runs:
            cells = (get_estimate(run.overall, metric) if k == deteriorate else None for k in SYNTHETIC)
            rows.append((SHORT_LABELS[metric], run.name, "simulated", *cells))
    return Table(
        "Synthetic validation set (paper: its own simulation; ours: simulated)",
        ("metric", "detector", "images", "without deterioration", "with deterioration"),
        tuple(rows),
        "Paper: table 2 of arXiv:2410.00521. The paper and kpbench simulate different images.",
    )


def condition_table(runs: Sequence[Scores], condition: str) -> Table:
    """Tabulate the paper's three metrics over the rungs of a condition that the paper does not have."""
    rungs = sorted({r for run in runs for r in run.conditions.get(condition, ())})
    rows = [
        (SHORT_LABELS[metric], run.name, *(get_estimate(run.group(condition, r), metric) for r in rungs))
        for metric in PAPER_METRICS
        for run in runs
    ]
    return Table(condition, ("metric", "detector", *(f"{r:g}" for r in rungs)), tuple(rows))


def breakpoint_table(runs: Sequence[Scores], limit: float = DETECTION_SCORE_LIMIT) -> Table:
    """Tabulate the rungs at which the detection score crosses a limit: a row per detector, a column per condition.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.report.breakpoint_table([scores]).title
    'Where the detection score crosses 0.9'
    """
    found = [
        {name: [b for b in find_breakpoints(run, limit) if b.condition == name] for name in run.conditions}
        for run in runs
    ]
    names = list(dict.fromkeys(name for of_run in found for name in of_run))
    rows = [
        (run.name, *("; ".join(map(_describe_crossing, of_run.get(name, []))) or None for name in names))
        for run, of_run in zip(runs, found, strict=True)
    ]
    return Table(
        f"Where the detection score crosses {limit:g}",
        ("detector", *names),
        tuple(rows),
        "Crossings are interpolated linearly between rungs. Brackets hold 95 % intervals from resampled scenes. No "
        "interval extends beyond the first or the last rung.",
    )


def _describe_crossing(b: Breakpoint) -> str:
    if b.rung is None:
        return f"{b.crossing} everywhere"
    interval = f" [{b.interval[0]:.3g}, {b.interval[1]:.3g}]" if b.interval else ""
    return f"{b.crossing} at {b.rung:.3g}{interval}"


def group_table(
    groups: Sequence[Group],
    title: str,
    patches: Mapping[int, str] | None = None,
    errors: Sequence[str] = ("error_median_px", "error_p95_px", "error_median_radii"),
) -> Table:
    """Tabulate the main metrics of groups, one row per group.

    Condition, rung, patch and radius have a column if at least one group has a value. A metric as printed in the paper
    (``_literal``) has a column if its value differs from the metric without ``_literal`` in at least one group.

    Parameters
    ----------
    groups : sequence of Group
    title : str
    patches : mapping of int to str, optional
        Names of the patches by ID.
    errors : sequence of str
        Names of the localisation errors to tabulate.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.report.group_table(scores.by, "All groups").columns[:3]
    ('patch', 'radius (px)', 'images')
    """
    printed = [f"{m}_literal" for m in PAPER_METRICS if any(g.metrics[m] != g.metrics[f"{m}_literal"] for g in groups)]
    metrics = (*PAPER_METRICS, *printed, *errors)
    keys: dict[str, list[Cell]] = {
        "condition": [g.condition for g in groups],
        "rung": [None if g.rung is None else f"{g.rung:g}" for g in groups],
        "patch": [g.patch_id if g.patch_id is None else (patches or {}).get(g.patch_id, g.patch_id) for g in groups],
        "radius (px)": [g.key.radius_px and _describe_radii(*g.key.radius_px) for g in groups],
    }
    keys = {
        name: ["all" if v is None else v for v in values]
        for name, values in keys.items()
        if any(v is not None for v in values)
    }
    rows = tuple(
        (
            *(values[n] for values in keys.values()),
            g.counts["images"],
            g.counts["truths"],
            *(get_estimate(g, m) for m in metrics),
        )
        for n, g in enumerate(groups)
    )
    return Table(title, (*keys, "images", "keypoints", *(LABELS[m] for m in metrics)), rows)


def _describe_radii(low: float, high: float | None) -> str:
    return f"over {low:g}" if high is None else f"{low:g} to {high:g}"


def count_table(runs: Sequence[Scores]) -> Table:
    """Tabulate the outcomes of true keypoints and detections, one row per detector."""
    names = ("truths", "matched", "wrong_id", "missed", "detections", "duplicate", "near_miss", "clutter")
    titles = (
        "keypoints",
        "matched",
        "of these with a wrong ID",
        "missed",
        "detections",
        "duplicates",
        "near misses",
        "clutter",
    )
    rows = tuple((run.name, *(run.overall.counts[name] for name in names)) for run in runs)
    return Table("Outcomes of keypoints and detections", ("detector", *titles), rows)


def confusion_table(run: Scores, patches: Mapping[int, str]) -> Table:
    """Tabulate the identities of matched detections: true IDs in rows, detected IDs in columns."""
    names = [str(patches.get(i, i)) for i in run.confusion["ids"]]
    rows = tuple((name, *cells) for name, cells in zip(names, run.confusion["matrix"], strict=True))
    return Table(f"IDs of matched detections: {run.name}", ("true", *names, "other"), rows, shade=True)


def verdict_table(comparisons: Sequence[Comparison]) -> Table:
    """Tabulate differences over all images, and verdicts counted over rungs: a row per other detector and metric.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.report.verdict_table([kpbench.compare(scores, scores)]).rows[0][:2]
    ('oracle', 'detection score')
    """
    rows: list[tuple[Cell, ...]] = []
    for c in comparisons:
        for d in c.differences[: len(COMPARED_METRICS)]:
            n = c.verdicts(d.metric)
            overall = Estimate(d.value, d.interval)
            counts = (n["better"], n["even"], n["worse"])
            rows.append((c.second, LABELS[d.metric], d.first, d.second, overall, d.verdict, *counts))
    name = comparisons[0].first
    columns = ("against", "metric", name, "the other", "difference", "over all images", "rungs better", "even", "worse")
    note = (
        "A rung is better or worse if its paired 95 % interval does not contain 0 and its p-value, adjusted for all "
        "rungs by Holm's method, is at most 0.05. Between equal detectors, chance makes any rung better or worse in "
        "at most 5 of 100 comparisons."
    )
    return Table(f"{name} against the others", columns, tuple(rows), note)


def difference_table(comparison: Comparison) -> Table:
    """Tabulate the differences of a comparison: a row for all images, then a row per condition and rung.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.report.difference_table(kpbench.compare(scores, scores)).rows[0][:2]
    ('all', 'all')
    """
    cells_of: dict[tuple[str, str], list[Cell]] = {}
    for d in comparison.differences:
        key = ("all", "all") if d.condition is None else (d.condition, f"{d.rung:g}")
        cells_of.setdefault(key, []).append(Estimate(d.value, d.interval))
    names = [LABELS[d.metric] for d in comparison.differences[: len(COMPARED_METRICS)]]
    title = f"{comparison.first} minus {comparison.second}"
    return Table(title, ("condition", "rung", *names), tuple((*key, *cells) for key, cells in cells_of.items()))
