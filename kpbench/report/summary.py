"""Write scores and comparisons as plain text, for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from kpbench.report.detail_tables import nees_table, pose_table, reliability_table
from kpbench.report.score_tables import difference_table, group_table, verdict_table
from kpbench.report.tables import Estimate, Table, cell_text, to_plain
from kpbench.scoring.board_pose import PoseGroup
from kpbench.scoring.comparison import Comparison
from kpbench.scoring.metrics import LABELS, PAPER_METRICS
from kpbench.scoring.scores import Scores
from kpbench.text import escape_terminal


def summarise_scores(scores: Scores, poses: Sequence[PoseGroup] = ()) -> str:
    """Write the settings, counts and metrics of a detector, and its tables of IDs, groups and poses.

    A metric as printed in the paper (``_literal``) is left out if it equals the metric without ``_literal`` in all
    groups.

    Parameters
    ----------
    scores : Scores
    poses : sequence of PoseGroup
        Errors of the board's pose; may be empty.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> print(kpbench.report.summarise_scores(scores).splitlines()[0])
    match        at most 0.1 radii (major semi-axis), one-to-one
    """
    overall, settings = scores.overall, scores.settings
    groups = (overall, *scores.by)
    hidden = {f"{m}_literal" for m in PAPER_METRICS if all(g.metrics[m] == g.metrics[f"{m}_literal"] for g in groups)}
    n = {name: cell_text(value) for name, value in overall.counts.items()}
    lines = [
        f"match        at most {settings.eps:g} radii ({settings.eps_radius} semi-axis), {settings.matching}",
        f"images       {n['images']} in {n['scenes']} scenes, which the 95 % intervals resample",
        f"keypoints    {n['truths']}: {n['matched']} matched ({n['wrong_id']} with a wrong ID), {n['missed']} missed",
        f"detections   {n['detections']}: {n['matched']} matched, {n['duplicate']} duplicates, "
        f"{n['near_miss']} near misses, {n['clutter']} clutter",
    ]
    if (ignored := scores.ignored)["patches"]:
        lines.append(f"ignored      {ignored['patches']} patches, {ignored['detections']} detections at them")
    lines.append("")
    for name, label in LABELS.items():
        if name not in hidden:
            estimate = Estimate(overall.metrics[name], overall.intervals.get(name))
            lines.append(f"{label:<30} {cell_text(estimate, 4)}")
    if scores.confusion and any(sum(row) for row in scores.confusion["matrix"]):
        ids = [str(i) for i in scores.confusion["ids"]]
        matrix = tuple((i, *row) for i, row in zip(ids, scores.confusion["matrix"], strict=True))
        lines += ["", "ID of matched detections: true in rows, detected in columns"]
        lines.append(to_plain(Table("", ("", *ids, "other"), matrix)))
    if scores.nees_by_sigma:
        lines += ["", _with_title(nees_table(scores))]
    if scores.reliability["bins"]:
        lines += ["", _with_title(reliability_table(scores))]
    if scores.by:
        errors = ["error_median_px", *(m for m in ("bias_px", "nees") if overall.metrics[m] is not None)]
        lines += ["", to_plain(group_table(scores.by, "", errors=errors), 4)]
    if poses:
        lines += ["", _with_title(pose_table(scores, poses))]
    return "\n".join(lines)


def summarise_comparisons(comparisons: Sequence[Comparison]) -> str:
    """Write the verdicts on the first detector against every other detector, and all differences.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> print(kpbench.report.summarise_comparisons([kpbench.compare(scores, scores)]).splitlines()[0])
    oracle against the others
    """
    return "\n\n".join(map(_with_title, (verdict_table(comparisons), *map(difference_table, comparisons))))


def _with_title(table: Table) -> str:
    return f"{escape_terminal(table.title)}\n{to_plain(table)}"
