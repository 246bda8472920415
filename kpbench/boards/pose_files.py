"""Files of poses: CSV and JSON lines, one line per image and board."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kpbench.boards.images import PoseRecord
from kpbench.boards.pose import BoardPose
from kpbench.errors import DataError, PredictionsError, system_reason
from kpbench.files import encode_utf8, open_file, read_bytes
from kpbench.text import escape_csv
from kpbench.writing import require_writable, write_file

POSES_SCHEMA = "kpbench.poses/1"
"""Name and version of the format of files of poses."""
POSE_SUFFIXES = (".csv", ".jsonl")
"""Ends of the names of files of poses."""
MATRIX_COLUMNS = [f"rotation_{i}{j}" for i in "123" for j in "123"]
COVARIANCE_COLUMNS = [f"covariance_{i}{j}" for i in "123456" for j in "123456" if j >= i]
MOTION_KEYS = ("rotation", "quaternion_xyzw", "translation_mm")
OTHER_KEYS = ("covariance", "reprojection_rms_px", "points", "ambiguous", "second", "state", "filtered")
MOTION_COLUMNS = ("qx", "qy", "qz", "qw", "tx_mm", "ty_mm", "tz_mm")
POSE_COLUMNS = (
    *("image_id", "file", "frame_index", "time_s", "board", *MATRIX_COLUMNS),
    *(*MOTION_COLUMNS, *COVARIANCE_COLUMNS),
    *("reprojection_rms_px", "points", "ambiguous"),
    *(f"second_{name}" for name in MOTION_COLUMNS),
    *("state", "reason"),
    *(f"filtered_{name}" for name in (*MOTION_COLUMNS, *COVARIANCE_COLUMNS)),
)
"""Columns of a CSV file. A covariance is symmetric: its upper triangle is listed."""
ROTATION_TOLERANCE = 1e-4
"""Largest deviation of a rotation times its transpose from the identity."""


def require_poses_path(path: str | Path) -> Path:
    """Refuse a path to which poses cannot be written, before any work is done.

    Raises
    ------
    DataError
        If the path ends in neither .csv nor .jsonl, cannot be written, or is a file other than poses by kpbench.
    """
    path = Path(path)
    if path.suffix.lower() not in POSE_SUFFIXES:
        raise DataError(f"{path}: unknown kind of poses file, expected {' or '.join(POSE_SUFFIXES)}")
    require_writable(path, "poses")
    return path


def write_poses(path: str | Path, records: Sequence[PoseRecord]) -> None:
    """Write poses to a file, whole or not at all.

    Parameters
    ----------
    path : str or Path
        File ending in .csv or .jsonl.
    records : sequence of PoseRecord
        From :func:`locate_boards`.

    Raises
    ------
    DataError
        If the path has another suffix, or the file cannot be written.

    Examples
    --------
    >>> from kpbench.boards import PoseRecord, write_poses
    >>> write_poses("poses.jsonl", [PoseRecord(0, "a.png", None, None, "grid", None, "the board was not found")])
    """
    path = require_poses_path(path)
    if path.suffix.lower() == ".csv":
        write_file(path, _encode_csv(records))
    else:
        lines = [json.dumps({"schema": POSES_SCHEMA}), *(json.dumps(_to_dict(record)) for record in records), ""]
        write_file(path, "\n".join(lines).encode())


def holds_poses(path: str | Path) -> bool:
    """Return whether a file begins as a file of poses does."""
    try:
        with open_file(path, is_noted=False) as file:
            return POSES_SCHEMA.encode() in file.read(64)
    except OSError:
        return False


def read_poses(path: str | Path) -> list[dict[str, Any]]:
    """Read a file of poses.

    Returns
    -------
    list of dict
        Per line: ``image_id``; ``rotation`` (3 x 3) and ``translation_mm``, or None for no pose; and ``filtered``, None
        or a dict with the same two.

    Raises
    ------
    PredictionsError
        If the file cannot be read, or a line is no pose. The message names the line.

    Examples
    --------
    >>> from kpbench.boards import PoseRecord, read_poses, write_poses
    >>> write_poses("poses.csv", [PoseRecord(0, "a.png", None, None, "grid", None, "the board was not found")])
    >>> read_poses("poses.csv")
    [{'image_id': 0, 'rotation': None, 'translation_mm': None, 'filtered': None}]
    """
    path = Path(path)
    try:
        lines = read_bytes(path).decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise PredictionsError(f"{path}: cannot be read, {system_reason(error) or 'it is no text'}") from None
    if not lines or POSES_SCHEMA not in lines[0]:
        raise PredictionsError(f"{path}: line 1: expected the schema {POSES_SCHEMA!r}")
    is_csv = path.suffix.lower() == ".csv"
    rows: Iterable[Any] = csv.DictReader(lines[1:]) if is_csv else filter(str.strip, lines[1:])
    found = list[dict[str, Any]]()
    parse: Callable[[Any], dict[str, Any]] = _parse_csv if is_csv else _parse_json
    first = 3 if is_csv else 2
    try:
        for row in rows:
            found.append(parse(row))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError, csv.Error):
        raise PredictionsError(f"{path}: line {first + len(found)}: expected a pose as kpbench writes it") from None
    return found


def _parse_json(line: str) -> dict[str, Any]:
    content = json.loads(line)
    filtered = content["filtered"]
    return {"image_id": _as_id(content["image_id"]), **_checked(content), "filtered": filtered and _checked(filtered)}


def _as_id(value: object) -> int:
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError
    return value


def _checked(content: dict[str, Any]) -> dict[str, Any]:
    if content["rotation"] is None:
        return {"rotation": None, "translation_mm": None}
    rotation, place = (np.array(content[name], np.float64) for name in ("rotation", "translation_mm"))
    if (
        rotation.shape != (3, 3)
        or place.shape != (3,)
        or not (np.isfinite(rotation).all() and np.isfinite(place).all())
        or not np.abs(rotation @ rotation.T - np.eye(3)).max() < ROTATION_TOLERANCE
        or np.linalg.det(rotation) < 0
    ):
        raise ValueError
    return {"rotation": rotation.tolist(), "translation_mm": place.tolist()}


def _parse_csv(row: dict[str, str]) -> dict[str, Any]:
    def motion(prefix: str) -> dict[str, Any]:
        values = [row[f"{prefix}{name}"] for name in MOTION_COLUMNS]
        if not values[0]:
            return {"rotation": None, "translation_mm": None}
        x, y, z, w, *place = map(float, values)
        rotation = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        return _checked({"rotation": rotation, "translation_mm": place})

    filtered = motion("filtered_")
    return {
        "image_id": _as_id(int(row["image_id"])),
        **motion(""),
        "filtered": filtered if filtered["rotation"] else None,
    }


def _to_dict(record: PoseRecord) -> dict[str, Any]:
    pose = record.pose
    content: dict[str, Any] = {
        "image_id": record.image_id,
        "file": encode_utf8(record.file).decode() or None,
        "frame_index": record.frame_index,
        "time_s": record.time_s,
        "board": record.board,
        **dict.fromkeys((*MOTION_KEYS, *OTHER_KEYS)),
    }
    if pose is not None:
        content |= {
            **_motion(pose),
            "covariance": pose.covariance.tolist(),
            "reprojection_rms_px": pose.reprojection_rms_px,
            "points": pose.points,
            "ambiguous": pose.ambiguous,
            "second": None if pose.second is None else _motion(pose.second),
            "state": record.state,
        }
    if record.filtered is not None:
        filtered = _motion(record.filtered) | {"covariance": record.filtered.covariance.tolist()}
        content |= {"state": record.state, "filtered": filtered}
    return content | {"reason": record.reason or None}


def _motion(pose: BoardPose) -> dict[str, Any]:
    return {name: getattr(pose, name).tolist() for name in MOTION_KEYS}


def _encode_csv(records: Sequence[PoseRecord]) -> bytes:
    text = io.StringIO()
    text.write(f"# {json.dumps({'schema': POSES_SCHEMA})}\n")
    writer = csv.DictWriter(text, POSE_COLUMNS, lineterminator="\n")
    writer.writeheader()
    for record in records:
        content = _to_dict(record)
        row = {name: content.get(name) for name in POSE_COLUMNS}
        row |= {"file": escape_csv(content["file"] or ""), "board": escape_csv(record.board)}
        if record.pose is not None:
            row |= dict(zip(MATRIX_COLUMNS, record.pose.rotation.ravel().tolist(), strict=True))
            row |= _flatten(content, "") | _flatten(content["second"], "second_")
            row["ambiguous"] = int(record.pose.ambiguous)
        row |= _flatten(content["filtered"], "filtered_")
        writer.writerow(row)
    return encode_utf8(text.getvalue())


def _flatten(motion: dict[str, Any] | None, prefix: str) -> dict[str, float]:
    if motion is None:
        return {}
    values = [*motion["quaternion_xyzw"], *motion["translation_mm"]]
    row = dict(zip(MOTION_COLUMNS, values, strict=True))
    if "covariance" in motion:
        upper = [v for k, line in enumerate(motion["covariance"]) for v in line[k:]]
        row |= dict(zip(COVARIANCE_COLUMNS, upper, strict=True))
    return {f"{prefix}{name}": value for name, value in row.items()}
