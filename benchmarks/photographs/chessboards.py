"""Corners of real chessboards: the design fit against OpenCV's finders.

The crossing of four chessboard squares is the centre of the design ``checker``. The fit starts at OpenCV's corners,
with the map that the board's homography has there, and a radius of ``--radius`` squares. The figures are distances
between corners and the board that a calibration of all photographs puts into them (camera matrix and five distortion
terms): once with all corners, and once calibrated with the corners of one colour and judged on those of the other.
They also hold what the camera model and the flatness of the board miss, which is the same for all finders.

    python benchmarks/photographs/chessboards.py photographs/chessboards --pattern 9x6 --names "left*.jpg"
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

import kpbench
from kpbench.fitting import build_pyramid, fit
from kpbench.types import Float, UInt8

QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
"""A quarter of a turn: every second corner of a chessboard is the design turned so."""
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
"""When cornerSubPix ends."""
SAME_CORNER_PX = 3.0
"""Two finders that differ by more do not see the same corner."""


def fit_corners(grey: UInt8, start: Float, board: Float, radius: float) -> Float:
    """Return corners from the design fit, shape (n, 2); ``board`` holds the corners in squares."""
    H = np.asarray(cv2.findHomography(board, start)[0], np.float64)
    w = np.column_stack([board, np.ones(len(board))]) @ H.T
    xy = w[:, :2] / w[:, 2:]
    J = (H[:2, :2] - xy[:, :, None] * H[2, :2]) / w[:, 2, None, None]
    levels, checker = build_pyramid(grey, 0), kpbench.shipped_patches()[0]
    fits = [fit(levels, start, J @ turn * radius, [checker] * len(start)) for turn in (np.eye(2), QUARTER)]
    return np.where((fits[0].ncc > fits[1].ncc)[:, None], fits[0].xy, fits[1].xy)


def find_corners(grey: UInt8, pattern: tuple[int, int], board: Float, radius: float) -> dict[str, Float] | None:
    """Return the corners of a chessboard by each finder, in one order; None if OpenCV does not find the board."""
    found, rough = cv2.findChessboardCorners(grey, pattern)
    found_sb, sector = cv2.findChessboardCornersSB(grey, pattern, flags=cv2.CALIB_CB_ACCURACY)
    if not (found and found_sb):
        return None
    corners = {"findChessboardCorners": rough[:, 0]}
    for half in (2, 5):
        name = f"cornerSubPix {2 * half + 1}x{2 * half + 1}"
        corners[name] = cv2.cornerSubPix(grey, rough.copy(), (half, half), (-1, -1), CRITERIA)[:, 0]
    start = corners["cornerSubPix 11x11"].astype(np.float64)
    sector = sector[:, 0]
    corners["findChessboardCornersSB"] = min((sector, sector[::-1]), key=lambda c: float(np.abs(c - start).max()))
    corners["kpbench's design fit"] = fit_corners(grey, start, board, radius)
    is_same = all(np.abs(c - start).max() < SAME_CORNER_PX for c in corners.values())
    return {name: c.astype(np.float64) for name, c in corners.items()} if is_same else None


def residuals(points: list[Float], board: Float, size: tuple[int, int], used: Float, judged: Float) -> Float:
    """Calibrate with the corners ``used`` of all photographs. Return the errors of the corners ``judged``, (m, 2)."""
    flat = np.column_stack([board, np.zeros(len(board))]).astype(np.float32)
    seen = [p[used][:, None].astype(np.float32) for p in points]
    _, K, distortion, rotations, shifts = cv2.calibrateCamera([flat[used]] * len(points), seen, size, None, None)  # type: ignore[call-overload]
    errors = [
        cv2.projectPoints(flat[judged], r, t, K, distortion)[0][:, 0] - p[judged]
        for p, r, t in zip(points, rotations, shifts, strict=True)
    ]
    return np.concatenate(errors)


def rms(errors: Float) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="photographs of one camera and one board")
    parser.add_argument("--names", default="*", help="pattern of the names of the photographs")
    parser.add_argument("--pattern", default="9x6", help="inner corners a row and a column")
    parser.add_argument("--radius", type=float, default=0.45, help="radius of the fit, squares")
    options = parser.parse_args()
    columns, rows = map(int, options.pattern.split("x"))
    board = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(np.float64)
    found: list[dict[str, Float]] = []
    size = (0, 0)
    for path in sorted(options.folder.glob(options.names)):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            continue
        size = (grey.shape[1], grey.shape[0])
        corners = find_corners(grey, (columns, rows), board, options.radius)
        print(f"{path.name}: {'all finders' if corners else 'left out, as not every finder sees the board'}")
        found += [corners] if corners else []
    everything = np.arange(len(board))
    even = everything[board.sum(axis=1) % 2 == 0]
    odd = np.setdiff1d(everything, even)
    print(f"\nreal chessboards, {len(found)} photographs of {size[0]}x{size[1]}, {len(found) * len(board)} corners:\n")
    columns_of_table = ("finder", "all corners, RMS px", "other colour, RMS px", "median", "90th percentile", "worst")
    print(f"| {' | '.join(columns_of_table)} |\n|{'---|' * len(columns_of_table)}")
    for name in found[0]:
        points = [corners[name] for corners in found]
        other = np.concatenate([residuals(points, board, size, a, b) for a, b in ((even, odd), (odd, even))])
        length = np.hypot(*other.T)
        own = residuals(points, board, size, everything, everything)
        cells = (rms(own), rms(other), np.median(length), np.percentile(length, 90), length.max())
        print(f"| {name} | {' | '.join(f'{v:.3f}' for v in cells)} |")


if __name__ == "__main__":
    main()
