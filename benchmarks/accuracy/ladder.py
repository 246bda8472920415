"""The ladder measured: what each effect does at each of its severity.

shift   how far a patch's centre moves: 24 renders of the checker (radius 45 px, random turn and sub-pixel
        place), degraded, then least squares of the degraded image on the clean one, its two derivatives by
        re-rendering, and a free blur; light that the effect adds or takes is read from flat black and white
        images. "bias" is the length of the mean shift, "rms" the root mean square.
grey    mean of a suite image (paper-v1, scene 0, checker at 16 %, 640x480), PSNR against the clean one.
noise   standard deviation on flat grey 128.
width   of a step edge's derivative, as the kernel size, length, radius or sigma that it belongs to.

    python benchmarks/accuracy/ladder.py
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

from kpbench import SuiteConfig, load_suite, render_scene, shipped_patches
from kpbench.degrade import LADDER, apply_effects, draw_effect
from kpbench.render import Placement
from kpbench.types import Float, UInt8

SIDE, RADIUS, BLACK, WHITE = 256, 45.0, 50, 200
RANDOM_FIELD = ("noise", "low-light")
WIDTHS: dict[str, Callable[[float], float]] = {  # variance of the edge's derivative, px², to the effect's own measure
    "blur": lambda v: (12 * v + 1) ** 0.5,  # box of k pixels: (k² - 1) / 12
    "gaussian-blur": lambda v: v**0.5,
    "motion-blur": lambda v: (12 * v - 1) ** 0.5,  # a line's exact coverage: L² / 12, and 1 / 12 of the pixel
    "defocus": lambda v: 2 * (v - 1 / 12) ** 0.5,  # a disc's: r² / 4, and 1 / 12 of the pixel
}


@lru_cache(maxsize=512)
def patch(x: float, y: float, turn_deg: float) -> UInt8:
    c, s = RADIUS * np.cos(np.radians(turn_deg)), RADIUS * np.sin(np.radians(turn_deg))
    H = np.array([[c, -s, x], [s, c, y], [0, 0, 1]])
    paper = np.full((SIDE, SIDE), WHITE, np.uint8)
    return render_scene(paper, [Placement(shipped_patches()[0], H, BLACK, WHITE)]).image


def smooth(image: Float, sigma: float) -> Float:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma) if sigma else image)


def shift(effect: str, level: float, seed: int) -> Float:
    """Measured shift of one render, (dx, dy) in px."""
    rng = np.random.default_rng(seed)
    x, y = SIDE / 2 + rng.uniform(-4, 4, 2)  # any place on the grid of 8 x 8 blocks that JPEG uses
    turn = rng.uniform(0, 360)
    recorded = [draw_effect(rng, effect, level, (SIDE, SIDE), np.array([[x, y, RADIUS]]))]

    def run(image: UInt8) -> Float:
        return apply_effects(image, np.random.default_rng(seed), recorded).astype(np.float64)

    got = run(patch(x, y, turn))
    dark, light = (run(np.full((SIDE, SIDE), v, np.uint8)) for v in (BLACK, WHITE))
    if effect in RANDOM_FIELD:
        dark, light = np.full_like(got, BLACK), np.full_like(got, WHITE)
    clean, left, right, up, down = (
        patch(x + dx, y + dy, turn).astype(np.float64)
        for dx, dy in ((0, 0), (-0.25, 0), (0.25, 0), (0, -0.25), (0, 0.25))
    )
    row, column = np.ogrid[:SIDE, :SIDE]
    seen = (np.hypot(column - x, row - y) < 1.6 * RADIUS) & (light - dark > 2)
    if effect not in RANDOM_FIELD:
        seen &= light < 255  # saturated: no ink to be seen
    if not seen.any():
        return np.full(2, np.nan)
    best, answer = np.inf, np.zeros(2)
    for sigma in (0, 0.5, 1, 1.5, 2, 3, 4, 5, 6, 8, 10):
        share = (smooth(clean, sigma) - BLACK) / (WHITE - BLACK)
        columns = [1 - share, share, smooth(right - left, sigma), smooth(down - up, sigma)]
        gain = (light - dark) / (WHITE - BLACK)
        design = np.stack(
            [dark * columns[0], light * columns[1], gain * columns[2] * 2, gain * columns[3] * 2], axis=-1
        )
        solution, *_ = np.linalg.lstsq(design[seen], got[seen], rcond=None)
        residual = float(((got[seen] - design[seen] @ solution) ** 2).sum())
        if residual < best:
            best, answer = residual, solution[2:] / max((solution[0] + solution[1]) / 2, 1e-9)
    return np.asarray(answer)


def edge_width(effect: str, level: float) -> float:
    """The kernel's own measure, from the second moment of a degraded step edge's derivative."""
    step = np.full((201, 201), 20, np.uint8)
    step[:, 100:] = 220
    recorded = draw_effect(np.random.default_rng(0), effect, level, (201, 201))
    if "angle_deg" in recorded:
        recorded["angle_deg"] = 0.0
    profile = apply_effects(step, np.random.default_rng(0), [recorded])[100].astype(np.float64)
    line = np.diff(profile) / 200
    at = np.arange(len(line))
    return WIDTHS[effect](line @ (at - line @ at) ** 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--renders", type=int, default=24)
    renders = parser.parse_args().renders
    cv2.setNumThreads(1)
    config = SuiteConfig(load_suite("paper-v1"), images=1, size_px=(640, 480), only=("pitch",))
    sample, _ = config.make(0)
    discs = np.column_stack([sample.keypoints[name].astype(np.float64) for name in ("x", "y", "radius_major")])
    print(f"clean image: mean grey {sample.image.mean():.1f}")
    print("| effect | rung | unit | shift bias px | shift rms px | mean grey | PSNR dB | noise sigma | width |")
    print("|---|---|---|---|---|---|---|---|---|")
    for effect, severity in LADDER.items():
        for level in severity.levels:
            shifts = np.array([shift(effect, level, seed) for seed in range(renders)])
            bias, rms = np.hypot(*shifts.mean(axis=0)), np.sqrt((shifts**2).sum(axis=1).mean())
            rng = np.random.default_rng(0)
            worn = apply_effects(sample.image, rng, [draw_effect(rng, effect, level, (640, 480), discs)])
            mse = np.mean((worn.astype(np.float64) - sample.image) ** 2)
            flat = np.full((480, 640), 128, np.uint8)
            noisy = apply_effects(flat, rng, [draw_effect(rng, effect, level, (640, 480))])
            sigma = noisy.std() if effect in RANDOM_FIELD else None
            width = edge_width(effect, level) if effect in WIDTHS else None
            ends = [f"{v:.2f}" if v is not None else "" for v in (sigma, width)]
            moved = [f"{v:.4f}" if np.isfinite(v) else "n/a" for v in (bias, rms)]
            numbers = [*moved, f"{worn.mean():.1f}", f"{10 * np.log10(255**2 / mse):.1f}", *ends]
            print("| " + " | ".join([effect, f"{level:g}", severity.unit, *numbers]) + " |")


if __name__ == "__main__":
    main()
