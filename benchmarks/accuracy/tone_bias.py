"""Bias of the design fit behind tone curves that it is not told, and under ink that spreads. Simulated.

Patches of known place are drawn in linear light by exact area coverage, blurred by a Gaussian, put through a tone curve
and noised. The fit starts a tenth of a radius beside the truth. The bias is the length of the mean error in the patch's
own frame, over random rotations and places.

    python benchmarks/accuracy/tone_bias.py [--draws 24] [--random 50] [--seed 0] [--noise 2]

``--random N`` adds the worst and the median of N smooth monotone curves, drawn by the seed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import cv2
import numpy as np

import kpbench
from kpbench import Patch, shipped_patches
from kpbench.fitting import build_pyramid
from kpbench.render import Placement, render_scene
from kpbench.types import Float

BLACK, WHITE = 40 / 255, 220 / 255
"""Encoded grey levels of the inks."""
Curve = Callable[[Float], Float]


def srgb(light: Float) -> Float:
    """IEC 61966-2-1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def s_curve(light: Float) -> Float:
    """sRGB, then a sine that lifts the bright half and lowers the dark half."""
    grey = srgb(light)
    return np.asarray(grey - 0.08 * np.sin(2 * np.pi * grey))


CURVES: dict[str, Curve] = {
    "linear": lambda light: light,
    "sRGB": srgb,
    "gamma 1.8": lambda light: np.maximum(light, 0) ** (1 / 1.8),
    "gamma 2.4": lambda light: np.maximum(light, 0) ** (1 / 2.4),
    "S-curve": s_curve,
    "logarithmic": lambda light: np.log1p(50 * np.maximum(light, 0)) / np.log(51),
}


def random_curve(rng: np.random.Generator) -> Curve:
    """A smooth monotone curve from (0, 0) to (1, 1): a power of the light, bent by two sines that let it rise."""
    power = 1 / np.exp(rng.uniform(0, np.log(2.6)))
    first, second = rng.uniform(-0.12, 0.12), rng.uniform(-0.04, 0.04)

    def curve(light: Float) -> Float:
        grey = np.maximum(light, 0) ** power
        return np.asarray(grey + first * np.sin(2 * np.pi * grey) + second * np.sin(4 * np.pi * grey))

    return curve


def inverse(curve: Curve, grey: float) -> float:
    light = np.linspace(0, 1, 20001)
    return float(np.interp(grey, curve(light), light))


def measure(patch: Patch, radius: float, sigma: float, curve: Curve, noise: float, draws: int, seed: int) -> Float:
    """Errors in the patch's frame, px, shape (draws, 2)."""
    rng, errors = np.random.default_rng([seed, patch.patch_id, round(radius), round(10 * sigma)]), []
    dark, light = (inverse(curve, grey) for grey in (BLACK, WHITE))
    for _ in range(draws):
        turn, side = rng.uniform(0, 2 * np.pi), int(2 * radius * 1.25 + 8 * sigma + 12)
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        tilt = np.diag([1.0, rng.uniform(0.75, 1.0)])
        A, xy = radius * R @ tilt, (side - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
        H = np.eye(3)
        H[:2, :2], H[:2, 2] = A, xy
        mask = render_scene(np.zeros((side, side), np.uint8), [Placement(patch, H, 0, 255)]).masks[0]
        ink = np.zeros((side, side))
        x, y, w, h = mask.box
        ink[y : y + h, x : x + w] = mask.black
        scene = cv2.GaussianBlur(light + (dark - light) * ink, (0, 0), sigma)
        image = 255 * curve(scene) + rng.normal(0, noise, scene.shape)
        image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        start = xy + rng.uniform(-0.1, 0.1, 2) * radius / np.sqrt(2)
        found = kpbench.fit(build_pyramid(image, 0), start[None], 1.05 * A[None], [patch])
        errors.append(np.linalg.solve(R, found.xy[0] - xy))
    return np.array(errors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=24)
    parser.add_argument("--random", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise", type=float, default=2.0)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(options.seed)
    drawn = [random_curve(rng) for _ in range(options.random)]
    for radius, sigma in ((8, 0.7), (8, 1.5), (20, 1), (20, 2), (40, 1), (40, 2)):
        for patch in shipped_patches():
            cells = []

            def bias_and_rms(curve: Curve, patch: Patch = patch, radius: float = radius, sigma: float = sigma) -> Float:
                e = measure(patch, radius, sigma, curve, options.noise, options.draws, options.seed)
                return np.array([np.hypot(*e.mean(axis=0)), np.sqrt((e**2).sum(axis=1).mean())])

            for name, curve in CURVES.items():
                bias, rms = bias_and_rms(curve)
                cells.append(f"{name} {bias:.3f} ({rms:.3f})")
            if drawn:
                biases = np.array([bias_and_rms(curve)[0] for curve in drawn])
                cells.append(f"{len(drawn)} random: median {np.median(biases):.3f}, worst {biases.max():.3f}")
            print(f"radius {radius:>2}, blur {sigma}, {patch.name:8}: bias (RMS), px: " + "; ".join(cells), flush=True)


if __name__ == "__main__":
    main()
