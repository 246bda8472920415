"""Boards and their poses in the scenes of a suite: right points, poses without a flag, errors, NEES, time. Simulated.

The hexagon boards of the suite are shown, and a hexagon with mixed designs. Besides all detections of an image, random
parts of them are taken: three, four and five right points, with all false alarms. Points are right if each lies within
half a radius of its keypoint. A pose is wrong if its error is over 100 in squared standard deviations (six degrees of
freedom) and over 1 degree or 0.5 % of the distance. NEES is 6 for a true covariance.

    python benchmarks/accuracy/board_pose.py PREDS.h5 --backgrounds photos/ [--scenes 4] [--seed 0] [--size 812x620]

PREDS.h5 is made if it is missing. Everything after the detector can then be repeated without the detector.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

import kpbench
from kpbench import Board, Detections, Predictions, SuiteConfig, load_suite
from kpbench.boards import BoardPose, pose_distance
from kpbench.patches import BoardKeypoint, BoardLike
from kpbench.workers import use_threads

MIXED = (0, 1, 2, 3, 1, 2)
"""Designs of the mixed board."""
PARTS = (3, 4, 5)
WRONG_NEES, WRONG_DEG, WRONG_PERCENT = 100.0, 1.0, 0.5


class BoardSuite(SuiteConfig):
    """The suite with one more board."""

    @cached_property
    def boards(self) -> tuple[BoardLike, ...]:
        """The hexagon boards, and one with mixed designs."""
        hexagons = SuiteConfig.boards.func(self)  # type: ignore[attr-defined]
        patches, keypoints = self.suite.patches, hexagons[0].keypoints
        mixed = [
            BoardKeypoint(patches[n], k.x_mm, k.y_mm, k.rotate_deg, k.diameter_mm)
            for n, k in zip(MIXED, keypoints, strict=True)
        ]
        return (*hexagons, Board("mixed", hexagons[0].side_x_mm, hexagons[0].side_y_mm, tuple(mixed)))


@dataclass
class Tally:
    """What was found in the images of one row."""

    images: int = 0
    found: int = 0
    ambiguous: int = 0
    wrong_points: int = 0
    poses: int = 0
    clear: int = 0
    wrong_poses: int = 0
    nees: list[float] = field(default_factory=list)
    mm: list[float] = field(default_factory=list)
    deg: list[float] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)


def detect(suite: BoardSuite, path: Path, name: str) -> Predictions:
    """Read the predictions of all images, or make and write them."""
    if path.exists():
        return kpbench.read_predictions(path)
    detector, found = kpbench.load_detector(name), []
    for n in range(suite.n):
        found.append(detector(suite.make(n)[0].image))
        if n % 100 == 99:
            print(f"{n + 1} of {suite.n} images", flush=True)
    predictions = Predictions.from_detections(found, detector={"name": name})
    kpbench.write_predictions(path, predictions)
    return predictions


def true_points(found: Detections, keypoints: np.ndarray) -> np.ndarray:
    """Return the index of the keypoint that each detection is, by place and identity; -1 for a false alarm."""
    truth = np.column_stack([keypoints["x"], keypoints["y"]])
    distance = np.linalg.norm(found.xy[:, None] - truth, axis=2) / keypoints["radius_major"]
    distance[found.patch_id[:, None] != keypoints["patch_id"]] = np.inf
    nearest = distance.argmin(axis=1)
    return np.where(distance.min(axis=1) <= 0.5, nearest, -1)


def judge(tally: Tally, found: Detections, true: np.ndarray, board: Board, camera, truth: BoardPose) -> None:
    """Find the board and its pose, and compare them with the truth."""
    tally.images += 1
    start = time.process_time()
    matches = kpbench.find_board(found, board, camera)
    pose = None
    if matches:
        try:
            pose = kpbench.estimate_pose(matches[0], camera)
        except kpbench.KpbenchError:
            pose = None
    tally.ms.append(1000 * (time.process_time() - start))
    tally.found += bool(matches)
    tally.ambiguous += any(match.ambiguous for match in matches)
    tally.wrong_points += any(not m.ambiguous and np.any(true[m.index] != m.points) for m in matches)
    if pose is None:
        return
    tally.poses += 1
    if pose.ambiguous:
        return
    tally.clear += 1
    nees = pose_distance(pose, truth)
    turn = pose.rotation @ truth.rotation.T
    deg = float(np.degrees(np.linalg.norm(cv2.Rodrigues(turn)[0])))
    mm = float(np.linalg.norm(pose.translation_mm - truth.translation_mm))
    far = 100 * mm / float(np.linalg.norm(truth.translation_mm))
    tally.wrong_poses += nees > WRONG_NEES and (deg > WRONG_DEG or far > WRONG_PERCENT)
    tally.nees.append(nees)
    tally.mm.append(mm)
    tally.deg.append(deg)


def row(name: str, t: Tally) -> str:
    def percentiles(values: list[float]) -> str:
        return " / ".join(f"{v:.3g}" for v in np.percentile(values, (50, 95))) if values else ""

    nees = f"{np.mean(t.nees):.2f} ({np.median(t.nees):.2f})" if t.nees else ""
    cells = [t.images, t.found, t.ambiguous, t.wrong_points, t.poses, t.clear, t.wrong_poses]
    cells += [percentiles(t.mm), percentiles(t.deg), nees, f"{np.median(t.ms):.2f}"]
    return f"| {name} | " + " | ".join(map(str, cells)) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("predictions", type=Path)
    parser.add_argument("--backgrounds", type=Path)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size")
    parser.add_argument("--suite", default="paper-v1", help="also extended-v1 and camera-v1")
    parser.add_argument("--detector", default="superpoint-small")
    options = parser.parse_args()
    use_threads(1)
    cv2.setNumThreads(1)
    size = None if options.size is None else tuple(map(int, options.size.split("x")))
    suite = BoardSuite(load_suite(options.suite), options.scenes, options.seed, size, backgrounds=options.backgrounds)
    found = detect(suite, options.predictions, options.detector).detections()
    tables: dict[str, dict[str, Tally]] = {name: defaultdict(Tally) for name in ("points", "rungs", "part")}
    for n, detections in enumerate(found):
        view, rng = suite.view(n), np.random.default_rng(n)
        board, camera = view.board, view.camera
        truth = BoardPose(view.pose.R_board2camera, view.pose.t_camera, np.eye(6), 0.0, 6)
        true = true_points(detections, view.keypoints)
        right = np.unique(true[true >= 0])
        count = f"{board.name}, {len(right)} right points"
        judge(tables["points"][count], detections, true, board, camera, truth)
        if len(right) >= 5:
            for key in (f"{view.condition} {view.rung:g}", "all"):
                judge(tables["rungs"][key], detections, true, board, camera, truth)
        for size in PARTS:
            if len(right) > size:
                keep = (true < 0) | np.isin(true, rng.choice(right, size, replace=False))
                judge(
                    tables["part"][f"{board.name}, part of {size}"], detections[keep], true[keep], board, camera, truth
                )
    for name, table in tables.items():
        print(
            f"\n{name}\n\n| | images | found | ambiguous | wrong points unflagged | poses | unflagged | wrong of them",
            end="",
        )
        print(" | mm: median / 95 % | degrees | NEES: mean (median) | ms |\n|" + "---|" * 12)
        for key in sorted(table) if name != "rungs" else table:
            print(row(key, table[key]))


if __name__ == "__main__":
    main()
