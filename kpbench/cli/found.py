"""What ``kpbench detect`` prints of a single image: a table of its patches, and the poses of its boards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from kpbench.cli.messages import echo

if TYPE_CHECKING:
    from kpbench.boards.images import PoseRecord
    from kpbench.patches.design import Patch
    from kpbench.types import Predictions

MOST_ROWS = 40
"""Longest table that is printed."""


def print_found(predictions: Predictions, records: Sequence[PoseRecord], patches: Sequence[Patch]) -> None:
    """Print the detections of one image as a table, and a line per board."""
    import numpy as np

    names = {patch.patch_id: patch.name for patch in patches}
    p, file = predictions, predictions.file[0] if predictions.file is not None else "image"
    echo(f"{file}: {len(p.xy)} detections by {p.detector['name']}")
    point = "" if p.points is None else "  point of the board"
    if len(p.xy):
        echo(f"{'ID':>3}  {'name':<12} {'x px':>9} {'y px':>9} {'radius px':>10} {'score':>6}{point}")
    for n in range(min(len(p.xy), MOST_ROWS)):
        patch_id = None if p.patch_id is None else int(p.patch_id[n])
        label, name = ("-", "-") if patch_id is None else (str(patch_id), names.get(patch_id, "-"))
        radius = "-" if p.A_patch2image is None else f"{np.linalg.norm(p.A_patch2image[n], 2):.1f}"
        x, y = p.xy[n]
        place = "" if p.points is None else f"  {p.points[n] if p.points[n] >= 0 else '-'}"
        echo(f"{label:>3}  {name:<12} {x:>9.2f} {y:>9.2f} {radius:>10} {p.score[n]:>6.2f}{place}")
    if len(p.xy) > MOST_ROWS:
        echo(f"… and {len(p.xy) - MOST_ROWS} more; --out FILE writes all")
    for record in records:
        echo(f"board {record.board}: {_describe_pose(record)}")


def _describe_pose(record: PoseRecord) -> str:
    """Return a pose in words, or why there is none."""
    import numpy as np

    pose = record.pose
    if pose is None:
        return record.reason
    tilt_deg = np.degrees(np.arccos(np.clip(abs(pose.rotation[2, 2]), 0, 1)))
    distance = f"{np.linalg.norm(pose.translation_mm):.0f} mm away, tilted by {tilt_deg:.1f} degrees"
    unsure = ", ambiguous" if pose.ambiguous else ""
    return f"{pose.points} points, {distance}, reprojection error {pose.reprojection_rms_px:.2f} px{unsure}"
