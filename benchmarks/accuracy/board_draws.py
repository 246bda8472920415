"""Boards and poses in thousands of *simulated detections* (no images): right points, wrong poses without a flag.

    python benchmarks/accuracy/board_draws.py --draws 10000 --oracle 100

Each draw is a pose, the detections of some of the board's points with errors like those of the shipped detectors, and
up to six false alarms. One draw in three has a lens that bends lines. In every `--oracle`-th draw with four to six
right points and a hexagon or mixed board, all pairings are tried (the brute-force matcher of tests/boards). A pose is
wrong if its error is over 100 in squared standard deviations (six degrees of freedom), and over 1 degree or 0.5 % of
the distance. `board_pose.py` measures the same with rendered images and a real detector.
"""

import argparse
import sys
import time
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np

import kpbench
from kpbench.boards import BoardPose, pose_distance
from kpbench.workers import use_threads

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "boards"))
from board_scenes import BENT, BOARDS, CAMERA, scene
from test_matching import brute_force

SEEN = {"mixed": (3, 4, 5, 6), "trefoil": (4, 5, 6), "wheel": (4, 5, 6), "checker": (5, 6), "grid": (6, 9, 12)}
MOST_ALARMS = 6
WRONG_NEES, WRONG_DEG, WRONG_PERCENT = 100.0, 1.0, 0.5


def judge_pose(row, pose, truth):
    """Count a pose that has no flag."""
    row["clear"] += 1
    nees = pose_distance(pose, truth)
    deg = float(np.degrees(np.linalg.norm(cv2.Rodrigues(pose.rotation @ truth.rotation.T)[0])))
    far = 100 * float(np.linalg.norm(pose.translation_mm - truth.translation_mm) / np.linalg.norm(truth.translation_mm))
    row["wrong poses"] += nees > WRONG_NEES and (deg > WRONG_DEG or far > WRONG_PERCENT)
    row["nees"] += nees


def judge(row, made, board, camera, is_checked):
    """Find the board and its pose in a draw."""
    row["draws"] += 1
    matches = kpbench.find_board(made.found, board, camera)
    if is_checked:
        listed = {
            frozenset(zip(m.index.tolist(), m.points.tolist(), strict=True))
            for match in matches
            for m in (match, *match.alternatives)
        }
        row["oracle"] += 1
        row["as oracle"] += listed == brute_force(made.found, board)
    if not matches:
        return
    match = matches[0]
    row["found"] += 1
    row["ambiguous"] += match.ambiguous
    row["wrong points"] += not match.ambiguous and not np.array_equal(match.points, made.point[match.index])
    try:
        pose = kpbench.estimate_pose(match, camera)
    except kpbench.KpbenchError:
        return
    row["poses"] += 1
    if not pose.ambiguous:
        R, t = made.poses[0]
        judge_pose(row, pose, BoardPose(R, t, np.eye(6), 0.0, 6))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--oracle", type=int, default=100)
    parser.add_argument("--seed", type=int, default=2026)
    args = parser.parse_args()
    use_threads(1)
    kinds = [(name, seen) for name, counts in SEEN.items() for seen in counts]
    rows, start = defaultdict(lambda: defaultdict(float)), time.process_time()
    for n in range(args.draws):
        rng = np.random.default_rng([args.seed, n])
        name, seen = kinds[n % len(kinds)]
        is_bent = rng.random() < 1 / 3
        alarms = int(rng.integers(0, MOST_ALARMS + 1))
        is_checked = n // len(kinds) % args.oracle == 0 and name != "grid" and seen > 3 and not is_bent
        made = scene(
            rng, BOARDS[name], BENT if is_bent else CAMERA, seen, alarms=min(alarms, 1) if is_checked else alarms
        )
        judge(rows[name, seen], made, BOARDS[name], BENT if is_bent else CAMERA, is_checked)
    print(
        "simulated detections\n\n| board | right points | draws | found | ambiguous | wrong points unflagged | poses |",
        end="",
    )
    print(" unflagged | wrong of them | NEES | as the oracle |\n|" + "---|" * 11)
    names = ("draws", "found", "ambiguous", "wrong points", "poses", "clear", "wrong poses")
    for (name, seen), row in rows.items():
        nees = f"{row['nees'] / row['clear']:.2f}" if row["clear"] else ""
        cells = [*(f"{row[key]:.0f}" for key in names), nees, f"{row['as oracle']:.0f} of {row['oracle']:.0f}"]
        print(f"| {name} | {seen} | {' | '.join(cells)} |")
    print(f"{1000 * (time.process_time() - start) / args.draws:.1f} ms a draw")


if __name__ == "__main__":
    main()
