"""A board that is followed through the films of video-v1, and detected anew in each frame; beside AprilTag. Simulated.

Each frame is taken four times: by the tracker, by the detector with :func:`kpbench.find_board`, by the AprilTag library
and by OpenCV's ChArUco detector on boards of equal size on the same path. Times are of one core: those of the tracker,
of the detector, and of the tags' detectors alone. NEES is 6 for a true covariance. All patches lie on the board of
mixed designs.

    python benchmarks/accuracy/board_track.py --backgrounds photos/ [--films 3] [--seed 0] [--size 1624x1240]
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

import kpbench
from kpbench import SuiteConfig, load_suite
from kpbench.boards import BoardPose, pose_distance
from kpbench.boards.pose import rotation_vector
from kpbench.workers import use_threads

WRONG_NEES, WRONG_DEG, WRONG_PERCENT = 100.0, 1.0, 0.5
"""As in board_pose.py: a pose is wrong if its error exceeds the first limit and one of the others."""


@dataclass
class Tally:
    """What one method did in the frames of a rung."""

    ms: list[float] = field(default_factory=list)
    mm: list[float] = field(default_factory=list)
    ray_mm: list[float] = field(default_factory=list)
    """Errors along the ray from the camera to the board; positive if the pose is too far away."""
    deg: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    frames: int = 0
    ambiguous: int = 0
    wrong: int = 0

    def add(self, ms: float, pose: BoardPose | None, truth: BoardPose, has_covariance: bool = True) -> None:
        """Count a frame."""
        self.frames += 1
        self.ms.append(ms)
        if pose is None:
            return
        deg = float(np.degrees(np.linalg.norm(rotation_vector(pose.rotation @ truth.rotation.T))))
        mm = float(np.linalg.norm(pose.translation_mm - truth.translation_mm))
        self.mm.append(mm)
        ray = truth.translation_mm / np.linalg.norm(truth.translation_mm)
        self.ray_mm.append(float((pose.translation_mm - truth.translation_mm) @ ray))
        self.deg.append(deg)
        self.ambiguous += pose.ambiguous
        if has_covariance and not pose.ambiguous:
            nees = pose_distance(pose, truth)
            self.nees.append(nees)
            far = 100 * mm / float(np.linalg.norm(truth.translation_mm))
            self.wrong += nees > WRONG_NEES and (deg > WRONG_DEG or far > WRONG_PERCENT)

    def row(self, name: str) -> str:
        """Return a row of the table."""

        def pair(values: list[float]) -> str:
            return " / ".join(f"{v:.3g}" for v in np.percentile(values, (50, 95))) if values else ""

        nees = f"{np.mean(self.nees):.2f} ({np.median(self.nees):.2f})" if self.nees else ""
        cells = [self.frames, len(self.mm), self.ambiguous, self.wrong, pair(self.mm)]
        cells += [f"{np.median(self.ray_mm or [0]):.2g}", pair(self.deg), nees]
        return f"| {name} | " + " | ".join(map(str, [*cells, pair(self.ms)])) + " |"


def timed(call, *arguments):  # type: ignore[no-untyped-def]
    """Return the result of a call and its time on the processor, ms."""
    start = time.process_time()
    result = call(*arguments)
    return result, 1000 * (time.process_time() - start)


def tag_pose(board, found, camera) -> BoardPose | None:  # type: ignore[no-untyped-def]
    """Return the pose of a board of tags from its corners, by OpenCV."""
    place = {k.patch_id: (k.x_mm, k.y_mm, 0.0) for k in board.keypoints}
    rows = [n for n, patch_id in enumerate(found.patch_id.tolist()) if patch_id in place]
    if len(rows) < 4:
        return None
    X, xy = np.array([place[int(found.patch_id[n])] for n in rows]), found.xy[rows]
    good, r, t = cv2.solvePnP(X, xy, camera.K, None, flags=cv2.SOLVEPNP_IPPE)
    if not good:
        return None
    r, t = cv2.solvePnPRefineLM(X, xy, camera.K, None, r, t)
    return BoardPose(cv2.Rodrigues(r)[0], t.ravel(), np.eye(6), 0.0, len(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backgrounds", type=Path)
    parser.add_argument("--films", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size")
    parser.add_argument("--tracker-only", action="store_true")
    options = parser.parse_args()
    use_threads(1)
    size = None if options.size is None else tuple(map(int, options.size.split("x")))
    config = SuiteConfig(load_suite("video-v1"), options.films, options.seed, size, backgrounds=options.backgrounds)
    tags = {} if options.tracker_only else {name: replace(config, board=name) for name in ("apriltag", "charuco")}
    detectors = {name: kpbench.load_detector(name) for name in ("superpoint-small", *tags)}
    tracker = kpbench.Tracker(config.boards[0], config.camera, detectors["superpoint-small"])
    tables: dict[str, dict[float, Tally]] = defaultdict(lambda: defaultdict(Tally))
    states: dict[str, int] = defaultdict(int)
    for n in range(config.n):
        view, image = config.view(n), config.make(n)[0].image
        truth = BoardPose(view.pose.R_board2camera, view.pose.t_camera, np.eye(6), 0.0, 6)
        if not view.frame["frame_index"]:
            tracker.reset()
        found, ms = timed(tracker, image, view.frame["time_s"])
        states[found.state] += 1
        tables["track"][view.rung].add(ms, found.pose, truth)
        if found.state == "tracked":
            tables["track, tracked frames"][view.rung].add(ms, found.pose, truth)
        if found.filtered is not None:
            tables["filtered"][view.rung].add(ms, found.filtered, truth)
        if options.tracker_only:
            continue

        def detect(image=image, view=view) -> BoardPose | None:  # type: ignore[no-untyped-def]
            matches = kpbench.find_board(detectors["superpoint-small"](image), view.board, view.camera)
            try:
                return kpbench.estimate_pose(matches[0], view.camera) if matches else None
            except kpbench.KpbenchError:
                return None

        pose, ms = timed(detect)
        tables["detect each frame"][view.rung].add(ms, pose, truth)
        for name, with_tags in tags.items():
            shot = with_tags.make(n)[0].image
            corners, ms = timed(detectors[name], shot)
            pose = tag_pose(with_tags.boards[0], corners, view.camera) if len(corners) else None
            tables[name][view.rung].add(ms, pose, truth, has_covariance=False)
    print(dict(states))
    for name, table in tables.items():
        print(f"\n{name}, simulated\n\n| px per frame | frames | with pose | ambiguous | wrong of the others", end="")
        print(" | mm: median / 95 % | median along the ray | degrees | NEES: mean (median) | ms |\n|" + "---|" * 10)
        for rung, tally in table.items():
            print(tally.row(f"{rung:g}"))


if __name__ == "__main__":
    main()
