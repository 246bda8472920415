"""Encode scores and comparisons as JSON and CSV, with their provenance."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import msgspec

from kpbench import __version__
from kpbench.files import encode_utf8, escape_surrogates, sha256_of
from kpbench.provenance import image_source
from kpbench.scoring.board_pose import PoseGroup
from kpbench.scoring.breakpoints import find_breakpoints
from kpbench.scoring.comparison import Comparison
from kpbench.scoring.scores import Scores
from kpbench.text import escape_csv

TABLE_SCHEMA = "kpbench.table/1"
COMPARISON_SCHEMA = "kpbench.comparison/1"
"""Name and version of the format of comparison files."""


class ScoredImages(Protocol):
    """The attributes of a dataset that go into the provenance of its scores."""

    @property
    def path(self) -> Path:
        """Folder of the dataset, or its annotations file."""
        ...

    @property
    def fingerprint(self) -> str:
        """Digest of the dataset."""
        ...

    @property
    def config(self) -> Mapping[str, Any]:
        """How the images were made; may be empty."""
        ...


def collect_provenance(dataset: ScoredImages, predictions: Sequence[Path], command: Sequence[str]) -> dict[str, Any]:
    """Collect the provenance of scores: predictions files with their SHA-256, dataset, command and versions.

    ``source`` of the dataset tells what its images are, see :func:`kpbench.provenance.image_source`; None if unknown.

    Time and machine are left out, so that the same input gives the same bytes.
    """
    return {
        "kpbench": __version__,
        "command": " ".join(command),
        "predictions": [{"file": str(path), "sha256": sha256_of(path)} for path in predictions],
        "dataset": {
            "path": str(dataset.path),
            "fingerprint": dataset.fingerprint,
            "source": image_source(dataset.config) or None,
        },
        "versions": {name: version(name) for name in ("numpy", "scipy")},
    }


def encode_scores(scores: Scores, provenance: Mapping[str, Any], poses: Sequence[PoseGroup] = ()) -> bytes:
    """Encode a scores file (``kpbench.scores/1``): all numbers, breakpoints, errors of the pose, provenance."""
    content = scores.to_dict() | {"breakpoints": [b.to_dict() for b in find_breakpoints(scores)]}
    if poses:
        content["pose"] = [asdict(group) for group in poses]
    return _encode_json(content | {"provenance": provenance})


def encode_comparisons(comparisons: Sequence[Comparison], provenance: Mapping[str, Any]) -> bytes:
    """Encode a comparison file (``kpbench.comparison/1``): every difference, and the provenance."""
    content = {"schema": COMPARISON_SCHEMA, "comparisons": [c.to_dict() for c in comparisons]}
    return _encode_json(content | {"provenance": provenance})


def _encode_json(content: Mapping[str, Any]) -> bytes:
    return msgspec.json.format(msgspec.json.encode(escape_surrogates(content)), indent=2) + b"\n"


def encode_scores_csv(scores: Scores, provenance: Mapping[str, Any]) -> bytes:
    """Encode scores as CSV, one row per group. The first row is the group of all images.

    Each row names the detector, the dataset and the version of kpbench, so that tables can be joined. A text that a
    spreadsheet would take for a formula begins with ``'``.
    """
    about = {
        "schema": TABLE_SCHEMA,
        "detector": scores.name,
        "dataset": scores.fingerprint,
        "source": provenance.get("dataset", {}).get("source") or "",
        "kpbench": provenance["kpbench"],
    }
    return _encode_rows([about | row for row in scores.rows()])


def encode_images_csv(scores: Scores) -> bytes:
    """Encode the counts of each image as CSV, one row per image."""
    return _encode_rows([{"detector": scores.name} | row for row in scores.image_rows()])


def _encode_rows(table: Sequence[Mapping[str, Any]]) -> bytes:
    rows = [{name: escape_csv(value) for name, value in row.items()} for row in table]
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return encode_utf8(text.getvalue())
