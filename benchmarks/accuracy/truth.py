"""Is the truth true? An independent estimate of the centre in noise-free renders.

Renders every shipped design at radius 5 to 60 px under all tilts of the synthetic set, then finds the
centre again by least squares: the model is the ink at 10 x 10 points a pixel, mapped back through the
homography (no outline, no coverage, none of the renderer's code), with centre, affine deformation, the
two inks and the background free, started up to 0.7 px and 3 % off. Prints the distance to the truth.

    python benchmarks/accuracy/truth.py --renders 200
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from kpbench import Patch, render_scene, shipped_patches
from kpbench.geometry import project
from kpbench.render import Limits, random_placements
from kpbench.types import Float

SUB = 10


def model(patch: Patch, H_image2patch: Float, box: tuple[int, int, int, int]) -> Float:
    """Shares of (black, white, background) by counting points, shape (3, height * SUB, width * SUB)."""
    x, y, w, h = box
    px = x - 0.5 + (np.arange(w * SUB) + 0.5) / SUB
    py = y - 0.5 + (np.arange(h * SUB) + 0.5) / SUB
    points = np.stack(np.meshgrid(px, py), axis=-1)
    patch_points = project(H_image2patch, points.reshape(-1, 2)).reshape(points.shape)
    inside = np.hypot(patch_points[..., 0], patch_points[..., 1]) < patch.extent
    black = patch.is_black(patch_points) & inside
    return np.stack([black, inside & ~black, ~inside]).astype(np.float64)


def binned(fine: Float) -> Float:
    return fine.reshape(*fine.shape[:-2], fine.shape[-2] // SUB, SUB, fine.shape[-1] // SUB, SUB).mean(axis=(-3, -1))


def estimate(image: Float, patch: Patch, H: Float, box: tuple[int, int, int, int], rng: np.random.Generator) -> Float:
    """Centre by Gauss-Newton from a perturbed start, shape (2,)."""
    x, y, w, h = box
    target = image[y : y + h, x : x + w].astype(np.float64)
    centre = H[:2, 2] / H[2, 2]
    columns, rows = np.meshgrid(x + np.arange(w) - centre[0], y + np.arange(h) - centre[1])
    p = np.concatenate([rng.uniform(-0.7, 0.7, 2), rng.uniform(-0.03, 0.03, 4)])
    for _ in range(12):
        A = np.eye(2) + p[2:].reshape(2, 2)
        warp = np.eye(3)
        warp[:2, :2], warp[:2, 2] = A, centre + p[:2] - A @ centre
        fine = model(patch, np.linalg.inv(warp @ H), box)
        shares = binned(fine).reshape(3, -1).T
        inks, *_ = np.linalg.lstsq(shares, target.ravel(), rcond=None)
        grey = np.tensordot(inks, fine, axes=1)
        gy, gx = (binned(g) * SUB for g in np.gradient(grey))
        J = -np.stack([gx, gy, gx * columns, gx * rows, gy * columns, gy * rows], axis=-1).reshape(-1, 6)
        design = np.hstack([J, shares])
        step, *_ = np.linalg.lstsq(design, target.ravel() - shares @ inks, rcond=None)
        p = p + step[:6]
        if np.abs(step[:2]).max() < 1e-5:
            break
    return centre + p[:2]


def measure(patch: Patch, renders: int, seed: int = 0) -> tuple[Float, Float]:
    """(errors in px, radii in px), each of shape (renders,)."""
    rng = np.random.default_rng([seed, patch.patch_id])
    limits = Limits(count=(1, 1), radius_px=(5.0, 60.0))
    errors, radii = [], []
    while len(errors) < renders:
        (placement,) = random_placements(rng, 640, 480, (patch,), limits)
        rendered = render_scene(np.full((480, 640), 128, np.uint8), [placement])
        k = rendered.keypoints[0]
        if k["visible"] < 1 - 1e-9:
            continue
        box = rendered.masks[0].box
        x, y, w, h = box
        if x < 0 or y < 0 or x + w > 640 or y + h > 480:
            continue
        found = estimate(rendered.image, patch, placement.H_patch2image, box, rng)
        errors.append(np.hypot(*(found - [k["x"], k["y"]])))
        radii.append(float(k["radius_major"]))
    return np.array(errors), np.array(radii)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--renders", type=int, default=200)
    renders = parser.parse_args().renders
    print(f"{'design':>12} {'renders':>8} {'radius px':>12} {'worst px':>9} {'RMS px':>9}")
    for patch in shipped_patches():
        errors, radii = measure(patch, renders)
        span = f"{radii.min():.1f}-{radii.max():.1f}"
        rms = np.sqrt((errors**2).mean())
        print(f"{patch.name:>12} {len(errors):>8} {span:>12} {errors.max():>9.4f} {rms:>9.4f}", flush=True)
    sys.stdout.flush()


if __name__ == "__main__":
    main()
