"""Single tables and charts of the scores of one or several detectors; a report is made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass

from kpbench.report.charts import Series, bar_chart, line_chart
from kpbench.report.paper import PAPER, SYNTHETIC, PaperTable, paper_value
from kpbench.report.tables import Cell, Estimate, Table
from kpbench.scoring.board_pose import PoseGroup
from kpbench.scoring.breakpoints import LIMIT, Breakpoint, breakpoints
from kpbench.scoring.comparison import METRICS as COMPARED
from kpbench.scoring.comparison import Comparison
from kpbench.scoring.groups import Group
from kpbench.scoring.metrics import LABELS, PAPER_METRICS
from kpbench.scoring.scores import Scores

DIFFERENCES = len(COMPARED)
PAPER_STYLE = 7  # grey
SHORT = dict(zip(PAPER_METRICS, ("detection", "ID matching", "false alarms"), strict=True))


@dataclass(frozen=True)
class Figure:
    """A chart with what it shows; ``legend`` lists (name, style) of its series."""

    caption: str
    svg: str
    legend: tuple[tuple[str, int], ...] = ()


# --- tables -----------------------------------------------------------------------------------------------------


def estimate(group: Group | None, metric: str) -> Estimate | None:
    """A metric of a group with its interval; None where there is no such group."""
    return None if group is None else Estimate(group.metrics[metric], group.intervals.get(metric))


def overview_table(runs: Sequence[Scores]) -> Table:
    """A row a detector: the headline metrics over all images; a note tells who failed on some."""
    metrics = (*PAPER_METRICS, "precision", "f1", "average_precision", "error_median_px", "error_p95_px")
    rows = [(run.name, *(estimate(run.overall, metric) for metric in metrics)) for run in runs]
    failed = [f"{run.name} failed on {len(said)} images" for run in runs if (said := run.detector.get("failures"))]
    note = f"{', '.join(failed)}, which count as no detections." if failed else ""
    return Table("All images", ("detector", *(LABELS[m] for m in metrics)), tuple(rows), note)


def paper_table(runs: Sequence[Scores], table: PaperTable, images: str = "simulated") -> Table:
    """A table of the paper with our runs below its rows, a column a rung; ours have ``images``."""
    ours = sorted({r for run in runs for r in run.conditions.get(table.condition, ())})
    rungs = sorted({*table.rungs, *ours})
    rows: list[tuple[Cell, ...]] = []
    for metric in PAPER_METRICS:
        label = SHORT[metric]
        theirs = [paper_value(table.condition, rung, metric) for rung in rungs]
        rows.append((label, "paper", table.images, *(None if v is None else float(v) for v in theirs)))
        for run in runs:
            found = [estimate(run.group(table.condition, rung), metric) for rung in rungs]
            rows.append((label, run.name, images, *found))
            rows.append((label, f"{run.name} less the paper", "", *map(_difference, found, theirs)))
    unit = f" {table.unit}" if table.unit else ""
    title = f"{table.title} (paper: {table.images}; ours: {images})"
    return Table(
        title,
        ("metric", "detector", "images", *(f"{r:g}{unit}" for r in rungs)),
        tuple(rows),
        f"Paper: table {table.number} of arXiv:2410.00521.",
    )


def _difference(ours: Estimate | None, theirs: float | None) -> Estimate | None:
    """Ours less the paper's, whose own spread nobody knows: the interval is ours, moved."""
    if ours is None or ours.value is None or theirs is None:
        return None
    between = None if ours.interval is None else (ours.interval[0] - theirs, ours.interval[1] - theirs)
    return Estimate(ours.value - theirs, between)


def synthetic_table(runs: Sequence[Scores], deteriorate: str) -> Table:
    """The paper's table 2 with our runs below its rows; ours fill the column of ``deteriorate``."""
    rows: list[tuple[Cell, ...]] = []
    for metric in PAPER_METRICS:
        rows.append((SHORT[metric], "paper", "its own simulation", *(SYNTHETIC[k][metric] for k in SYNTHETIC)))
        for run in runs:
            cells = (estimate(run.overall, metric) if k == deteriorate else None for k in SYNTHETIC)
            rows.append((SHORT[metric], run.name, "simulated", *cells))
    return Table(
        "Synthetic validation set (paper: its own simulation; ours: simulated)",
        ("metric", "detector", "images", "without deterioration", "with deterioration"),
        tuple(rows),
        "Paper: table 2 of arXiv:2410.00521. Its images are not ours.",
    )


def condition_table(runs: Sequence[Scores], condition: str) -> Table:
    """The paper's three metrics for a condition that the paper does not have."""
    rungs = sorted({r for run in runs for r in run.conditions.get(condition, ())})
    rows = [
        (SHORT[metric], run.name, *(estimate(run.group(condition, r), metric) for r in rungs))
        for metric in PAPER_METRICS
        for run in runs
    ]
    return Table(condition, ("metric", "detector", *(f"{r:g}" for r in rungs)), tuple(rows))


def breakpoint_table(runs: Sequence[Scores], limit: float = LIMIT) -> Table:
    """A row a detector, a column a condition: the rung at which the detection score crosses ``limit``."""
    found = [
        {name: [b for b in breakpoints(run, limit) if b.condition == name] for name in run.conditions} for run in runs
    ]
    names = list(dict.fromkeys(name for by in found for name in by))
    rows = [
        (run.name, *("; ".join(map(_crossing, by.get(name, []))) or None for name in names))
        for run, by in zip(runs, found, strict=True)
    ]
    return Table(
        f"Where the detection score crosses {limit:g}",
        ("detector", *names),
        tuple(rows),
        "On straight lines between the rungs; 95 % intervals from resampled scenes, cut at the ends of the ladder.",
    )


def _crossing(b: Breakpoint) -> str:
    if b.rung is None:
        return f"{b.crossing} everywhere"
    spread = f" [{b.interval[0]:.3g}, {b.interval[1]:.3g}]" if b.interval else ""
    return f"{b.crossing} at {b.rung:.3g}{spread}"


def group_table(
    groups: Sequence[Group],
    title: str,
    patches: Mapping[int, str] | None = None,
    errors: Sequence[str] = ("error_median_px", "error_p95_px", "error_median_radii"),
) -> Table:
    """A row a group: what it is of, and the main metrics; the readings as printed where any differs."""
    printed = [f"{m}_literal" for m in PAPER_METRICS if any(g.metrics[m] != g.metrics[f"{m}_literal"] for g in groups)]
    metrics = (*PAPER_METRICS, *printed, *errors)
    keys: dict[str, list[Cell]] = {
        "condition": [g.condition for g in groups],
        "rung": [None if g.rung is None else f"{g.rung:g}" for g in groups],
        "patch": [g.patch_id if g.patch_id is None else (patches or {}).get(g.patch_id, g.patch_id) for g in groups],
        "radius (px)": [g.key.radius_px and _span(*g.key.radius_px) for g in groups],
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
            *(estimate(g, m) for m in metrics),
        )
        for n, g in enumerate(groups)
    )
    return Table(title, (*keys, "images", "keypoints", *(LABELS[m] for m in metrics)), rows)


def _span(low: float, high: float | None) -> str:
    return f"over {low:g}" if high is None else f"{low:g} to {high:g}"


def count_table(runs: Sequence[Scores]) -> Table:
    """The error taxonomy by counts, a row a detector."""
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
    return Table("What became of keypoints and detections", ("detector", *titles), rows)


def confusion_table(run: Scores, patches: Mapping[int, str]) -> Table:
    """True IDs of matched detections in rows, detected ones in columns."""
    names = [str(patches.get(i, i)) for i in run.confusion["ids"]]
    rows = tuple((name, *cells) for name, cells in zip(names, run.confusion["matrix"], strict=True))
    return Table(f"IDs of matched detections: {run.name}", ("true", *names, "other"), rows, shade=True)


def verdict_table(comparisons: Sequence[Comparison]) -> Table:
    """Wins and losses of the first detector: a row a rival and metric, counted over the conditions' rungs."""
    rows: list[tuple[Cell, ...]] = []
    for c in comparisons:
        for d in c.differences[:DIFFERENCES]:
            n = c.verdicts(d.metric)
            whole = Estimate(d.value, d.interval)
            wins = (n["better"], n["even"], n["worse"])
            rows.append((c.second, LABELS[d.metric], d.first, d.second, whole, d.verdict, *wins))
    name = comparisons[0].first
    columns = ("against", "metric", name, "the other", "difference", "over all images", "rungs better", "even", "worse")
    note = (
        "A difference is called better or worse when its paired 95 % interval leaves out 0. Where nothing differs, "
        "about 5 rungs in 100 are called so by chance."
    )
    return Table(f"{name} against the others", columns, tuple(rows), note)


def difference_table(comparison: Comparison) -> Table:
    """First minus second: a row a condition and rung, the first over all images."""
    at: dict[tuple[str, str], list[Cell]] = {}
    for d in comparison.differences:
        key = ("all", "all") if d.condition is None else (d.condition, f"{d.rung:g}")
        at.setdefault(key, []).append(Estimate(d.value, d.interval))
    names = [LABELS[d.metric] for d in comparison.differences[:DIFFERENCES]]
    title = f"{comparison.first} minus {comparison.second}"
    return Table(title, ("condition", "rung", *names), tuple((*key, *cells) for key, cells in at.items()))


def pose_table(run: Scores, groups: Sequence[PoseGroup]) -> Table:
    """Errors of the board's pose: a row for all images and for each condition and rung."""
    rows = []
    for group in groups:
        _, _, *cells = astuple(group)
        rung = "all" if group.rung is None else f"{group.rung:g}"
        rows.append((group.condition or "all", rung, *cells))
    spread = ("median", "95th percentile")
    errors_of = [f"{what}, {part}" for what in ("translation (%)", "rotation (°)") for part in spread]
    columns = ("condition", "rung", "images", "with a pose", *errors_of)
    note = "From at least four matched keypoints an image; translation in % of the distance of board and camera."
    return Table(f"Pose of the board: {run.name}", columns, tuple(rows), note)


# --- charts -----------------------------------------------------------------------------------------------------


def severity_chart(runs: Sequence[Scores], condition: str, metric: str = "detection_score") -> Figure:
    """A metric over the rungs of a condition, a line a detector with its 95 % band, and the paper's numbers dashed."""
    series = []
    for n, run in enumerate(runs):
        rungs = run.conditions.get(condition, [])
        at = [estimate(run.group(condition, r), metric) or Estimate(None) for r in rungs]
        series.append(Series(run.name, rungs, [e.value for e in at], [e.interval for e in at], n))
    paper = PAPER.get(condition)
    if paper:
        values = [paper_value(condition, r, metric) for r in paper.rungs]
        series.append(Series(f"paper, {paper.images}", paper.rungs, values, style=PAPER_STYLE, dashed=True))
    ticks = sorted({x for s in series for x in s.x})
    label = f"{paper.title} ({paper.unit})" if paper and paper.unit else paper.title if paper else condition
    bounded = metric not in ("average_false_alarm", "average_false_alarm_literal") and not metric.startswith("error")
    svg = line_chart(
        series,
        label,
        LABELS[metric],
        y_range=(0.0, 1.0) if bounded else None,
        x_ticks=ticks,
        log_x=min(ticks, default=0) > 0 and max(ticks) / min(ticks) > 20,
    )
    return Figure(f"{condition}: {LABELS[metric]}", svg, tuple((s.name, s.style) for s in series))


def precision_recall_chart(runs: Sequence[Scores]) -> Figure:
    """Precision over recall as the threshold on the score falls."""
    series = []
    for n, run in enumerate(runs):
        recall = [0.0 if r is None else r for r in run.curve["recall"]]
        series.append(Series(run.name, recall, run.curve["precision"], style=n))
    svg = line_chart(
        series, "recall", "precision", y_range=(0.0, 1.0), x_ticks=(0, 0.2, 0.4, 0.6, 0.8, 1), markers=False
    )
    return Figure("Precision and recall over all thresholds", svg, tuple((s.name, s.style) for s in series))


def eps_chart(runs: Sequence[Scores]) -> Figure:
    """Detection score over the reach of a match; the one that was used is not special here."""
    series = [
        Series(run.name, [e or 0.0 for e in run.eps_curve["eps"]], run.eps_curve["detection_score"], style=n)
        for n, run in enumerate(runs)
    ]
    label = f"ε, in radii ({runs[0].settings.eps_radius})"
    ticks = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
    svg = line_chart(series, label, LABELS["detection_score"], y_range=(0.0, 1.0), x_ticks=ticks, log_x=True)
    return Figure("Detection score over ε", svg, tuple((s.name, s.style) for s in series))


def radius_chart(runs: Sequence[Scores], metric: str) -> Figure:
    """A metric over the radius of the true keypoints' discs; each bin is drawn at the middle of its edges."""
    series = []
    for n, run in enumerate(runs):
        bins = [(g, *g.key.radius_px) for g in run.by if g.key.radius_px is not None]
        middle = [(low + (high or 2 * low)) / 2 for _, low, high in bins]
        at = [Estimate(g.metrics[metric], g.intervals.get(metric)) for g, _, _ in bins]
        series.append(Series(run.name, middle, [e.value for e in at], [e.interval for e in at], n))
    ticks = sorted({x for s in series for x in s.x})
    svg = line_chart(
        series,
        "radius of the disc (px, middle of its bin)",
        LABELS[metric],
        y_range=(0.0, 1.0) if metric == "detection_score" else None,
        x_ticks=ticks,
        log_x=True,
    )
    return Figure(f"{LABELS[metric]} by radius", svg, tuple((s.name, s.style) for s in series))


def taxonomy_charts(runs: Sequence[Scores]) -> tuple[Figure, Figure]:
    """Shares of what became of the true keypoints, and of the detections: a bar a detector."""
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
