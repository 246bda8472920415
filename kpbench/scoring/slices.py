"""Slices: the detection score of keypoints that are alike in tilt, contrast or visible share."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from kpbench.scoring.bootstrap import bootstrap_intervals, sum_by_scene
from kpbench.scoring.outcomes import Outcomes
from kpbench.types import Float

SLICE_EDGES: dict[str, tuple[float, ...]] = {
    "tilt_deg": (0, 15, 30, 45, 60, 75, 90),
    "contrast": (0, 10, 20, 40, 80, 160, 256),
    "visible": (0, 0.5, 0.6, 0.7, 0.8, 0.9, 1, 1.001),
}
"""Edges of the bins of each quantity. A bin holds low <= value < high; the last bin of ``visible`` holds all of a
patch that is whole."""


def slice_values(outcomes: Outcomes) -> dict[str, Float]:
    """Return each quantity of :data:`SLICE_EDGES` for every true keypoint, ndarray of shape (T,).

    ``tilt_deg`` is the angle between the line of sight and the normal of the disc, arccos(minor / major semi-axis),
    degrees. ``contrast`` (grey levels) and ``visible`` are those of the truth; nan if the truth does not tell.
    """
    table = outcomes.truth.keypoints
    minor, major = (table[name].astype(np.float64) for name in ("radius_minor", "radius_major"))
    tilt_deg = np.degrees(np.arccos(np.clip(minor / major, 0, 1)))
    visible = np.round(table["visible"].astype(np.float64), 6)  # single precision: a whole patch may say 0.9999999
    return {"tilt_deg": tilt_deg, "contrast": table["contrast"].astype(np.float64), "visible": visible}


def compute_slices(outcomes: Outcomes) -> list[dict[str, Any]]:
    """Return the detection score in each bin of each quantity, with its 95 % interval from resampled scenes.

    A quantity whose keypoints all lie in one bin is left out, as are empty bins.

    Returns
    -------
    list of dict
        ``quantity``, ``range`` [low, high], ``truths``, ``matched``, ``detection_score``, ``interval`` and
        ``error_median_px``, None without matches.

    Examples
    --------
    >>> import kpbench
    >>> scores = kpbench.score(kpbench.open_dataset("kpbench-data"), kpbench.read_predictions("preds.json"))
    >>> sorted({entry["quantity"] for entry in scores.slices})
    ['contrast', 'tilt_deg']
    """
    slices, matched = [], outcomes.matched
    scene = outcomes.truth.scene_id[outcomes.truth_points.image]
    settings = outcomes.settings
    for quantity, value in slice_values(outcomes).items():
        edges = SLICE_EDGES[quantity]
        bins = [(low, high, (value >= low) & (value < high)) for low, high in pairwise(edges)]
        bins = [(low, high, inside) for low, high, inside in bins if inside.any()]
        for low, high, inside in bins if len(bins) > 1 else ():
            counts = np.column_stack([np.ones(int(inside.sum()), np.int64), matched[inside]])
            scenes = sum_by_scene(counts, scene[inside])
            interval = bootstrap_intervals(
                scenes, lambda s: {"detection_score": s[..., 1] / s[..., 0]}, settings.resamples, settings.seed
            )["detection_score"]
            error = outcomes.matches.distance[inside & matched]
            slices.append(
                {
                    "quantity": quantity,
                    "range": [low, min(high, 1) if quantity == "visible" else high],
                    "truths": len(counts),
                    "matched": int(counts[:, 1].sum()),
                    "detection_score": float(counts[:, 1].mean()),
                    "interval": interval,
                    "error_median_px": float(np.median(error)) if len(error) else None,
                }
            )
    return slices
