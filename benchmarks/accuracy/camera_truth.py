"""Is the truth true behind a camera? An independent fit of the centre under each step of the camera chain. Simulated.

For every step, one patch is photographed by the chain with this step alone. The centre is then found again by least
squares. The model counts ink at 16 x 16 points a pixel (8 x 8 for the mean of many draws) and maps these points back by
formulas of its own or of OpenCV: no outline, coverage, kernel or lens of kpbench (but two tone curves are inverted by
kpbench). Unknown are centre, affine deformation, the two inks and the background. The fit starts up to 0.5 px and 3 %
off.

Geometric and optical steps have neither noise nor rounding but that of the file: the RMS error is printed. Sensor and
processing steps are drawn ``--draws`` times: the length of the mean error is printed, and its standard error.

    python benchmarks/accuracy/camera_truth.py --renders 60 --draws 400
"""

from __future__ import annotations

import argparse
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

from kpbench import Patch, shipped_patches
from kpbench.camera import load_camera_preset
from kpbench.camera.tone import ToneCurve
from kpbench.render import Limits, random_placements
from kpbench.synth.camera_view import photograph_scene
from kpbench.types import Float

WIDTH, HEIGHT, MARGIN = 240, 180, 7


def neutral() -> dict[str, Any]:
    """A camera that changes nothing but by the diffraction of f/0.5, which spreads light by 0.03 px."""
    record = load_camera_preset("industrial").draw(np.random.default_rng(0))
    record |= {"f_number": 0.5, "pixel_um": 10.0, "defocus_px": 0.0, "corner_loss": 0.0, "k1": 0.0, "ink_gain": 0.0}
    record |= {"velocity_px": [0.0, 0.0], "row_time": 0.0, "exposure": 1.0, "full_well_e": 1e12, "read_noise_e": 0.0}
    record |= {"prnu": 0.0, "dsnu_e": 0.0, "row_noise_e": 0.0, "bits": 14, "denoise_sigma": 0.0, "sharpen_amount": 0.0}
    record |= {"jpeg_quality": 0, "balance": [1.0, 1.0], "tone": {"name": "srgb", "parameters": []}}
    return record


def to_light(image: Float) -> Float:
    """Invert IEC 61966-2-1."""
    grey = image / 255
    return np.where(grey <= 0.04045, grey / 12.92, ((grey + 0.055) / 1.055) ** 2.4)


class Step:
    """One step: its record, and how the fit sees it."""

    def __init__(self, record: dict[str, Any], noisy: bool = False) -> None:
        self.record, self.noisy, self.sub = neutral() | record, noisy, 8 if noisy else 16

    def back(self, points: Float) -> list[Float]:
        """Map points of the image to the points that they show, at each instant of the exposure."""
        (vx, vy), row_time, k1 = self.record["velocity_px"], self.record["row_time"], self.record["k1"]
        if k1:
            K = np.array([[WIDTH, 0, (WIDTH - 1) / 2], [0, WIDTH, (HEIGHT - 1) / 2], [0, 0, 1.0]])
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-12)
            coefficients = np.array([k1, 0, 0, 0, 0])
            points = cv2.undistortPointsIter(points[:, None], K, coefficients, None, K, criteria)[:, 0]
        if not (vx or vy):
            return [points]
        instants = (np.arange(24) + 0.5) / 24 - 0.5
        time = row_time * (points[:, 1] - (HEIGHT - 1) / 2)
        return [points - np.column_stack([vx * (time + s), vy * (time + s)]) for s in instants]

    def forward(self, centre: Float) -> Float:
        """Map a point of the undisturbed image to the image, at the middle of the exposure of its row."""
        image = centre.copy()
        for _ in range(50):
            image = image + centre - np.mean([points[0] for points in self.back(image[None])], axis=0)
        return image

    def spread(self, fine: Float) -> Float:
        """Spread light as the optics do, on the fine grid."""
        radius = self.record["defocus_px"] * self.sub
        if not radius:
            return fine
        reach = int(radius) + 1
        side = np.arange(-reach, reach + 1)
        disc = (np.hypot(side, side[:, None]) <= radius).astype(float)
        wide = np.pad(fine, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
        return np.stack([fftconvolve(part, disc / disc.sum(), mode="valid") for part in wide])

    def fade(self, points: Float) -> Float:
        """Return the light that reaches points of the image, relative to the centre."""
        x, y = points[:, 0] - (WIDTH - 1) / 2, points[:, 1] - (HEIGHT - 1) / 2
        return 1 - self.record["corner_loss"] * (x**2 + y**2) * 4 / (WIDTH**2 + HEIGHT**2)


STEPS = {
    "no step": Step({}),
    "lens, k1 -0.3": Step({"k1": -0.3}),
    "lens, k1 +0.2": Step({"k1": 0.2}),
    "motion 5 px": Step({"velocity_px": [3.0, -4.0]}),
    "rolling shutter": Step({"velocity_px": [6.0, 3.0], "row_time": 0.01}),
    "ink gain": Step({"ink_gain": 20 / 1024}),
    "defocus 2 px": Step({"defocus_px": 2.0}),
    "vignetting": Step({"corner_loss": 0.5}),
    "photon and read noise": Step({"full_well_e": 3000.0, "read_noise_e": 6.0}, True),
    "fixed pattern": Step({"prnu": 0.02, "dsnu_e": 3.0, "full_well_e": 3000.0}, True),
    "8 bits of light": Step({"bits": 8}, True),
    "S-curve": Step({"tone": {"name": "s-curve", "parameters": [3.0]}}, True),
    "gamma 2.4": Step({"tone": {"name": "gamma", "parameters": [2.4]}}, True),
    "denoising": Step({"denoise_sigma": 8.0, "full_well_e": 3000.0}, True),
    "sharpening": Step({"sharpen_amount": 1.0}, True),
    "JPEG 60": Step({"jpeg_quality": 60}, True),
}


def is_black(patch: Patch, points: Float, gain: float) -> Float:
    """Whether points of the patch frame are black, with ink that spreads by ``gain``, in disc radii."""
    black = patch.is_black(points)
    for angle in np.arange(24) * np.pi / 12 if gain else ():
        black = black | patch.is_black(points + gain * np.array([np.cos(angle), np.sin(angle)]))
    return black


def shares(patch: Patch, H: Float, box: tuple[int, int, int, int], step: Step) -> Float:
    """Shares of (black, white, background) on the fine grid, shape (3, height * sub, width * sub)."""
    (x, y, w, h), sub = box, step.sub
    px, py = x - 0.5 + (np.arange(w * sub) + 0.5) / sub, y - 0.5 + (np.arange(h * sub) + 0.5) / sub
    grid = np.stack(np.meshgrid(px, py), axis=-1).reshape(-1, 2)
    fine, inverse = np.zeros((3, len(grid))), np.linalg.inv(H)
    views = step.back(grid)
    for points in views:
        u, v, z = inverse[:, :2] @ points.T + inverse[:, 2:]
        on_patch = np.column_stack([u / z, v / z])
        black = is_black(patch, on_patch, step.record["ink_gain"])
        inside = (np.hypot(*on_patch.T) < patch.extent) | black
        fine += np.stack([black, inside & ~black, ~inside]) / len(views)
    return step.spread(fine.reshape(3, h * sub, w * sub)) * step.fade(grid).reshape(h * sub, w * sub)


def binned(fine: Float, sub: int) -> Float:
    return fine.reshape(*fine.shape[:-2], fine.shape[-2] // sub, sub, fine.shape[-1] // sub, sub).mean(axis=(-3, -1))


def estimate(seen: Float, patch: Patch, H: Float, box: tuple[int, int, int, int], step: Step, rng: Any) -> Float:
    """Centre in the undisturbed image by Gauss-Newton, shape (2,)."""
    x, y, w, h = box
    centre = H[:2, 2] / H[2, 2]
    columns, rows = np.meshgrid(x + np.arange(w) - centre[0], y + np.arange(h) - centre[1])
    p = np.concatenate([rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.03, 0.03, 4)])
    for _ in range(10):
        A, warp = np.eye(2) + p[2:].reshape(2, 2), np.eye(3)
        warp[:2, :2], warp[:2, 2] = A, centre + p[:2] - A @ centre
        fine = shares(patch, warp @ H, box, step)
        parts = binned(fine, step.sub).reshape(3, -1).T
        inks, *_ = np.linalg.lstsq(parts, seen.ravel(), rcond=None)
        # the gradient of a picture of points is smoothed a little, which changes the size of steps, not where they end
        picture = np.tensordot(inks, fine, axes=1)
        gy, gx = (binned(g, step.sub) * step.sub for g in np.gradient(gaussian_filter(picture, step.sub / 4)))
        J = -np.stack([gx, gy, gx * columns, gx * rows, gy * columns, gy * rows], axis=-1).reshape(-1, 6)
        move, *_ = np.linalg.lstsq(np.hstack([J, parts]), seen.ravel() - parts @ inks, rcond=None)
        p = p + move[:6]
        if np.abs(move[:2]).max() < 1e-4:
            break
    return centre + p[:2]


def measure(step: Step, count: int, seed: int) -> Float:
    """Errors (count, 2) in px, over all designs."""
    rng = np.random.default_rng(seed)
    limits = Limits(count=(1, 1), radius_px=(7.0, 18.0), tilt_deg=45.0)
    tone, errors = ToneCurve(step.record["tone"]["name"], tuple(step.record["tone"]["parameters"])), list[Float]()
    while len(errors) < count:
        patch = shipped_patches()[len(errors) % 4]
        (placement,) = random_placements(rng, WIDTH, HEIGHT, (patch,), limits)
        scene = photograph_scene(np.full((HEIGHT, WIDTH), 128, np.uint8), [placement], rng, step.record)
        if not len(scene.keypoints) or scene.keypoints["visible"][0] < 1 - 1e-9:
            continue
        x, y, w, h = scene.masks[0].box
        x, y, w, h = x - MARGIN, y - MARGIN, w + 2 * MARGIN, h + 2 * MARGIN
        if x < 0 or y < 0 or x + w > WIDTH or y + h > HEIGHT:
            continue
        grey = scene.image[y : y + h, x : x + w].astype(np.float64)
        light = to_light(grey) if tone.name == "srgb" else tone.light(grey / 255)
        found = estimate(light, patch, placement.H_patch2image, (x, y, w, h), step, rng)
        errors.append(step.forward(found) - [scene.keypoints["x"][0], scene.keypoints["y"][0]])
    return np.array(errors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--renders", type=int, default=60)
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="Run only the steps whose name holds this text.")
    options = parser.parse_args()
    for name, step in STEPS.items():
        if options.only not in name:
            continue
        e = measure(step, options.draws if step.noisy else options.renders, options.seed)
        if step.noisy:
            error = np.hypot(*e.std(axis=0)) / np.sqrt(len(e))
            print(
                f"{name:24} mean of {len(e)} draws {np.hypot(*e.mean(axis=0)):.4f} px (standard error {error:.4f})",
                flush=True,
            )
        else:
            rms = np.sqrt((e**2).sum(axis=1).mean())
            print(f"{name:24} RMS of {len(e)} renders {rms:.4f} px, worst {np.hypot(*e.T).max():.4f}", flush=True)


if __name__ == "__main__":
    main()
