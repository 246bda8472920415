"""Scores and comparisons as JSON and CSV, with their provenance."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from kpbench import __version__
from kpbench.files import sha256_of
from kpbench.scoring.board_pose import PoseGroup
from kpbench.scoring.breakpoints import breakpoints
from kpbench.scoring.comparison import Comparison
from kpbench.scoring.scores import Scores

COMPARISON_SCHEMA = "kpbench.comparison/1"


def provenance(dataset: Path, fingerprint: str, predictions: Sequence[Path], command: Sequence[str]) -> dict[str, Any]:
    """List what numbers were made from: the files with their SHA-256, the dataset, versions.

    The time and the machine are left out, so that the same input gives the same bytes.
    """
    return {
        "kpbench": __version__,
        "command": " ".join(command),
        "predictions": [{"file": str(path), "sha256": sha256_of(path)} for path in predictions],
        "dataset": {"path": str(dataset), "fingerprint": fingerprint},
        "versions": {name: version(name) for name in ("numpy", "scipy")},
    }


def scores_file(scores: Scores, known: Mapping[str, Any], poses: Sequence[PoseGroup] = ()) -> bytes:
    """The scores file (``kpbench.scores/1``): all numbers, the breakpoints, errors of the pose, and the provenance."""
    content = scores.to_dict() | {"breakpoints": [b.to_dict() for b in breakpoints(scores)]}
    if poses:
        content["pose"] = [asdict(group) for group in poses]
    return _json(content | {"provenance": known})


def _json(content: Mapping[str, Any]) -> bytes:
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"


def comparison_file(comparisons: Sequence[Comparison], known: Mapping[str, Any]) -> bytes:
    """The comparison file (``kpbench.comparison/1``): every difference, and the provenance."""
    content = {"schema": COMPARISON_SCHEMA, "comparisons": [c.to_dict() for c in comparisons], "provenance": known}
    return _json(content)


def scores_csv(scores: Scores, known: Mapping[str, Any]) -> bytes:
    """One row a group, the first overall; each row says which detector, dataset and version it is of."""
    about = {"detector": scores.name, "dataset": scores.fingerprint, "kpbench": known["kpbench"]}
    rows = [about | row for row in scores.rows()]
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()
