"""Score a file of poses beside the true poses of a dataset of films."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from kpbench.boards.pose_files import read_poses
from kpbench.dataset.folder import Dataset, open_dataset
from kpbench.errors import DataError, PredictionsError
from kpbench.scoring.tracks import (
    LEAST_VISIBLE,
    LEAST_VISIBLE_POINTS,
    TRACK_METRICS,
    FilmTruth,
    PoseSeries,
    score_tracks,
)
from kpbench.synth.suite_boards import film_board
from kpbench.types import Int


@dataclass(frozen=True)
class TrackGroup:
    """The metrics of all films, or of those of one rung. ``condition`` and ``rung`` are None for all films."""

    condition: str | None
    rung: float | None
    metrics: dict[str, float | None]


@dataclass(frozen=True)
class TrackScores:
    """The scores of a file of poses: all films first, then each condition and rung.

    Examples
    --------
    >>> from kpbench.tracking import TrackGroup, TrackScores
    >>> TrackScores((TrackGroup(None, None, {"frames_with_pose": 0.9}),))["frames_with_pose"]
    0.9
    """

    groups: tuple[TrackGroup, ...]

    def __getitem__(self, metric: str) -> float | None:
        return self.groups[0].metrics[metric]

    def to_dict(self) -> dict[str, Any]:
        """Return the content of a JSON file."""
        return {"schema": "kpbench.track-scores/1", "groups": [dict(vars(group)) for group in self.groups]}


def score_poses(poses: str | Path, dataset: str | Path | Dataset) -> TrackScores:
    """Compare a file of poses with the true poses of a dataset of films, see :mod:`kpbench.scoring.tracks`.

    Parameters
    ----------
    poses : str or Path
        From :func:`kpbench.boards.write_poses`. Of several poses of an image, the first counts.
    dataset : str, Path or Dataset
        From ``kpbench suite video-v1``.

    Raises
    ------
    PredictionsError
        If the poses cannot be read, or are of other images.
    DataError
        If the dataset holds no films.
    """
    data = dataset if isinstance(dataset, Dataset) else open_dataset(dataset)
    truth = _film_truth(data)
    ids = data.truth.image_id.tolist()
    row_of = {image_id: n for n, image_id in enumerate(ids)}
    raw, filtered, seen = _no_poses(len(ids)), _no_poses(len(ids)), set[int]()
    for entry in read_poses(poses):
        row = row_of.get(entry["image_id"])
        if row is None:
            raise PredictionsError(f"{poses}: image_id {entry['image_id']} is not in {data.path}")
        if row not in seen:
            seen.add(row)
            _put(raw, row, entry)
            _put(filtered, row, entry["filtered"] or {})
    if missing := len(ids) - len(seen):
        raise PredictionsError(f"{poses}: {missing} of the {len(ids)} images of {data.path} are missing")

    def group(condition: str | None, rung: float | None, rows: Int) -> TrackGroup:
        return TrackGroup(condition, rung, score_tracks(truth[rows], raw[rows], filtered[rows]))

    of_image = list(zip(data.truth.condition.tolist(), data.truth.rung.tolist(), strict=True))
    keys = list(dict.fromkeys(of_image))
    rungs = [group(*key, np.array([n for n, other in enumerate(of_image) if other == key])) for key in keys]
    return TrackScores((group(None, None, np.arange(len(ids))), *rungs))


def _no_poses(count: int) -> PoseSeries:
    return PoseSeries(np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan))


def _put(series: PoseSeries, row: int, entry: dict[str, Any]) -> None:
    if entry.get("rotation") is not None:
        series.rotation[row], series.translation_mm[row] = entry["rotation"], entry["translation_mm"]


def _film_truth(data: Dataset) -> FilmTruth:
    shown = film_board(data.config)
    if shown is None:
        raise DataError(f"{data.path}: holds no films of a known board, expected those of `video-v1`")
    records = [data.effects(n)[0] for n in range(len(data))]
    poses = PoseSeries(
        np.array([record["rotation"] for record in records]), np.array([record["translation_mm"] for record in records])
    )
    visible, offsets = data.truth.keypoints["visible"], data.truth.offsets.tolist()
    shows = np.array([(visible[a:b] >= LEAST_VISIBLE).sum() >= LEAST_VISIBLE_POINTS for a, b in pairwise(offsets)])
    film = np.cumsum([record["frame_index"] == 0 for record in records])
    return FilmTruth(film, np.array([r["time_s"] for r in records]), poses, shows, shown[0].points_mm)


def summarise_tracks(scores: TrackScores) -> str:
    """Return the metrics as a table: a line per metric, a column per group."""
    titles = ["all", *(f"{g.condition} {g.rung:g}" for g in scores.groups[1:])]
    rows = [["", *titles]]
    for name in TRACK_METRICS:
        values = [group.metrics[name] for group in scores.groups]
        rows.append([name, *("n/a" if value is None else f"{value:.4g}" for value in values)])
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [[row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))] for row in rows]
    return "\n".join("  ".join(line) for line in lines)
