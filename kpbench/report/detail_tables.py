"""Tabulate what lies behind the main metrics: cost, slices, bias, uncertainty, calibration and pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple
from typing import Any

from kpbench.report.score_tables import get_estimate
from kpbench.report.tables import Cell, Estimate, Table
from kpbench.scoring.board_pose import PoseGroup
from kpbench.scoring.groups import GroupKey
from kpbench.scoring.metrics import LABELS
from kpbench.scoring.scores import Scores
from kpbench.scoring.uncertainty import UNCERTAINTY_METRICS


def cost_table(runs: Sequence[Scores]) -> Table:
    """Tabulate time per image and peak memory, which ``kpbench detect`` recorded: a row per detector that tells them.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.report.cost_table([scores]).rows
    ()
    """
    costs = [(run.name, cost) for run in runs if isinstance(cost := run.detector.get("cost"), dict)]
    keys = ("ms_median", "ms_p95", "peak_mib", "machine")
    rows = [(name, *(_plain_cell(cost.get(key)) for key in keys)) for name, cost in costs]
    columns = ("detector", "ms per image, median", "95th percentile", "peak memory (MiB)", "machine")
    note = "The memory is that of a whole process, with Python and the images."
    return Table("Time and memory", columns, tuple(rows), note)


def _plain_cell(value: object) -> Cell:
    """Return what a predictions file says as a cell; text for anything but a number or None."""
    return value if value is None or isinstance(value, (int, float)) else str(value)


def slice_table(runs: Sequence[Scores]) -> Table:
    """Tabulate the detection score by tilt, contrast and visible share: a row per bin, a column per detector.

    Detectors of different boards have different keypoints; the numbers of keypoints are then several.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> kpbench.report.slice_table([scores]).columns
    ('of', 'from', 'below', 'keypoints', 'oracle')
    """
    names = {"tilt_deg": "tilt (degrees)", "contrast": "contrast (grey levels)", "visible": "visible share"}
    found: list[dict[tuple[str, float, float], dict[str, Any]]] = [
        {(entry["quantity"], *entry["range"]): entry for entry in run.slices} for run in runs
    ]
    bins = sorted(set().union(*found), key=lambda key: ([*names].index(key[0]), *key[1:]))
    rows = [
        (
            names[quantity],
            f"{low:g}",
            "whole" if low == high else f"{high:g}",
            _name_counts([e["truths"] for e in entries if e]),
            *(Estimate(e["detection_score"], e["interval"]) if e else None for e in entries),
        )
        for quantity, low, high in bins
        for entries in [[of_run.get((quantity, low, high)) for of_run in found]]
    ]
    columns = ("of", "from", "below", "keypoints", *(run.name for run in runs))
    return Table("Detection score by tilt, contrast and visible share", columns, tuple(rows))


def _name_counts(counts: Sequence[int]) -> Cell:
    """Return the one number, or all different ones."""
    return counts[0] if len(set(counts)) == 1 else " / ".join(map(str, dict.fromkeys(counts)))


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
