"""Tabulate the scores of one or several detectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple
from typing import Any

from kpbench.report.paper import SYNTHETIC, PaperTable, paper_value
from kpbench.report.tables import Cell, Estimate, Table
from kpbench.scoring.board_pose import PoseGroup
from kpbench.scoring.breakpoints import DETECTION_SCORE_LIMIT, Breakpoint, find_breakpoints
from kpbench.scoring.comparison import COMPARED_METRICS, Comparison
from kpbench.scoring.groups import Group, GroupKey
from kpbench.scoring.metrics import LABELS, PAPER_METRICS
from kpbench.scoring.scores import Scores
from kpbench.scoring.uncertainty import UNCERTAINTY_METRICS

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


def slice_table(runs: Sequence[Scores]) -> Table:
    """Tabulate the detection score by tilt, contrast and visible share: a row per bin, a column per detector.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.report.slice_table([scores]).columns
    ('of', 'from', 'below', 'keypoints', 'oracle')
    """
    names = {"tilt_deg": "tilt (degrees)", "contrast": "contrast (grey levels)", "visible": "visible share"}
    found: dict[tuple[str, float, float], list[dict[str, Any]]] = {}
    for run in runs:
        for entry in run.slices:
            found.setdefault((entry["quantity"], *entry["range"]), []).append(entry)
    rows = [
        (
            names[quantity],
            f"{low:g}",
            "whole" if low == high else f"{high:g}",
            entries[0]["truths"],
            *(Estimate(e["detection_score"], e["interval"]) for e in entries),
        )
        for (quantity, low, high), entries in found.items()
    ]
    columns = ("of", "from", "below", "keypoints", *(run.name for run in runs))
    return Table("Detection score by tilt, contrast and visible share", columns, tuple(rows))


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


def bias_table(runs: Sequence[Scores], patches: Mapping[int, str] | None = None) -> Table:
    """Tabulate bias, scatter, predicted standard deviation and NEES: a row per detector, and per detector and patch.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.report.bias_table([scores]).rows[0][:2]
    ('oracle', 'all')
    """
    metrics = ("error_rms_px", *UNCERTAINTY_METRICS)
    rows: list[tuple[Cell, ...]] = []
    for run in runs:
        for group in (run.overall, *(g for g in run.by if g.key == GroupKey(patch_id=g.patch_id))):
            patch = "all" if group.patch_id is None else str((patches or {}).get(group.patch_id, group.patch_id))
            rows.append((run.name, patch, group.counts["matched"], *(get_estimate(group, name) for name in metrics)))
    note = (
        "Bias is the mean error of matched keypoints in the frame of the patch, so biases of different patches may "
        "cancel in the row of all. NEES is 2 where the predicted covariances are right, and more where they are too "
        "small."
    )
    columns = ("detector", "patch", "matched", *(LABELS[name] for name in metrics))
    return Table("Bias and uncertainty", columns, tuple(rows), note)


def nees_table(run: Scores) -> Table:
    """Tabulate the NEES in each quintile of the predicted standard deviation, one row per quintile."""
    rows = tuple(
        (f"{low:.3g} to {high:.3g}", part["matched"], Estimate(part["nees"], part["interval"]))
        for part in run.nees_by_sigma
        for low, high in [part["sigma_px"]]
    )
    return Table(f"NEES by predicted sigma: {run.name}", ("predicted sigma (px)", "matched", LABELS["nees"]), rows)


def reliability_table(run: Scores) -> Table:
    """Tabulate the reliability curve of the scores of detections, one row per bin of scores."""
    rows = tuple(
        (f"{low:.1f} to {high:.1f}", part["detections"], part["score_mean"], part["precision"])
        for part in run.reliability["bins"]
        for low, high in [part["score"]]
    )
    title = f"Calibration of the score: {run.name}, ECE {run.reliability['ece']:.3f}"
    return Table(title, ("score", "detections", "mean score", "precision"), rows)


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


def pose_table(run: Scores, groups: Sequence[PoseGroup]) -> Table:
    """Tabulate errors of the board's pose: a row for all images, then a row per condition and rung.

    Parameters
    ----------
    run : Scores
    groups : sequence of PoseGroup
        The result of :func:`kpbench.scoring.group_pose_errors`.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> group = kpbench.scoring.PoseGroup(None, None, 6, 6, 0.1, 0.4, 0.3, 1.2)
    >>> kpbench.report.pose_table(scores, [group]).rows[0][:4]
    ('all', 'all', 6, 6)
    """
    rows = []
    for group in groups:
        _, _, *cells = astuple(group)
        rung = "all" if group.rung is None else f"{group.rung:g}"
        rows.append((group.condition or "all", rung, *cells))
    percentiles = ("median", "95th percentile")
    errors = [f"{error}, {percentile}" for error in ("translation (%)", "rotation (°)") for percentile in percentiles]
    columns = ("condition", "rung", "images", "with a pose", *errors)
    note = "A pose needs at least four matched keypoints. Translation is in % of the board's distance from the camera."
    return Table(f"Pose of the board: {run.name}", columns, tuple(rows), note)
