"""The quantities whose distributions are compared: what a training sees of a dataset.

References
----------
.. [1] J. Immerkaer, "Fast noise variance estimation", Computer Vision and Image Understanding 64(2), 1996.
   https://doi.org/10.1006/cviu.1996.0060
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kpbench.dataset.folder import Dataset
from kpbench.drift.distributions import MOST_SCENES, SceneValues
from kpbench.predictions.coco import CocoDataset
from kpbench.types import Float

IMAGES_MEASURED = MOST_SCENES
"""Largest number of images of each dataset whose pixels are measured."""
NOISE_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
"""Immerkaer's kernel [1]_. White noise of standard deviation 1 gets standard deviation 6; planes and edges get 0."""

Quantities = dict[str, SceneValues | None]


def collect_quantities(dataset: Dataset | CocoDataset, progress: Callable[[int], None]) -> Quantities:
    """Return the values of each quantity; None for a quantity that the dataset does not tell."""
    return {**_collect_from_truth(dataset), **_collect_from_images(dataset, progress)}


def _collect_from_truth(dataset: Dataset | CocoDataset) -> Quantities:
    truth, keypoints = dataset.truth, dataset.truth.keypoints
    counts = np.diff(truth.offsets)
    scene = np.repeat(truth.scene_id, counts)
    names = [
        f"{condition} {rung:g}" if condition else "none"
        for condition, rung in zip(truth.condition, truth.rung, strict=True)
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        tilt_deg = np.degrees(np.arccos(np.clip(keypoints["radius_minor"] / keypoints["radius_major"], 0, 1)))
    of_keypoints: dict[str, NDArray[Any]] = {
        "patch ID": keypoints["patch_id"].astype(np.str_),
        "x, px": keypoints["x"],
        "y, px": keypoints["y"],
        "radius, px": keypoints["radius_major"],
        "short axis, px": 2 * keypoints["radius_minor"],
        "tilt, degrees": tilt_deg,
        "visible fraction": keypoints["visible"],
        "contrast, levels": keypoints["contrast"],
    }
    return {
        "condition": SceneValues(np.array(names, np.str_), truth.scene_id),
        "keypoints per image": SceneValues(counts, truth.scene_id),
        **{name: SceneValues(values, scene) for name, values in of_keypoints.items()},
    }


def count_measured(dataset: Dataset | CocoDataset) -> int:
    """Return the number of images whose pixels are measured."""
    return min(IMAGES_MEASURED, len(dataset))


def _collect_from_images(dataset: Dataset | CocoDataset, progress: Callable[[int], None]) -> Quantities:
    """Measure evenly spaced images."""
    chosen = np.linspace(0, len(dataset) - 1, count_measured(dataset)).astype(int)
    sizes, effects, levels, noise, widths = list[str](), list[str](), list[float](), list[float](), list[Float]()
    for n in chosen.tolist():
        image, keypoints = dataset[n]
        grey = (image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).astype(np.float32)
        sizes.append(f"{grey.shape[1]}x{grey.shape[0]}")
        effects.append("+".join(sorted({str(record["effect"]) for record in dataset.effects(n)})) or "none")
        levels.append(float(grey.mean()))
        noise.append(_measure_noise(grey))
        widths.append(_measure_edge_widths(grey, keypoints))
    scene = dataset.truth.scene_id[chosen]
    per_image = {
        "image size": np.array(sizes, np.str_),
        "brightness, levels": np.array(levels),
        "noise, levels": np.array(noise),
    }
    return {
        **{name: SceneValues(values, scene) for name, values in per_image.items()},
        "effects": SceneValues(np.array(effects, np.str_), scene) if isinstance(dataset, Dataset) else None,
        "edge width, px": SceneValues(np.concatenate(widths), np.repeat(scene, [len(part) for part in widths])),
    }


def _measure_noise(grey: NDArray[np.float32]) -> float:
    """Estimate the standard deviation of white noise, grey levels [1]_. nan for an image below 3 px."""
    if min(grey.shape) < 3:
        return np.nan
    response = cv2.filter2D(grey, -1, NOISE_KERNEL)[1:-1, 1:-1]
    return float(np.sqrt(np.pi / 2) / 6 * np.abs(response).mean())


def _measure_edge_widths(grey: NDArray[np.float32], keypoints: NDArray[Any]) -> Float:
    """Measure the width of the steepest edge of each patch, px: its contrast over its steepest slope.

    A step that a Gaussian of standard deviation s blurs has a width of s·sqrt(2·pi). Contrast is the range between the
    5th and the 95th percentile of the levels. nan for a patch without contrast.
    """
    widths = np.full(len(keypoints), np.nan)
    for k, keypoint in enumerate(keypoints):
        x, y, reach = (np.rint(keypoint[name]) for name in ("x", "y", "radius_major"))
        top, left = (int(np.clip(v - reach, 0, size)) for v, size in zip((y, x), grey.shape, strict=True))
        bottom, right = (int(np.clip(v + reach + 1, 0, size)) for v, size in zip((y, x), grey.shape, strict=True))
        patch = grey[top:bottom, left:right]
        if min(patch.shape) < 3:
            continue
        low, high = np.quantile(patch, (0.05, 0.95))
        slope = np.hypot(cv2.Scharr(patch, -1, 1, 0), cv2.Scharr(patch, -1, 0, 1))[1:-1, 1:-1].max() / 32
        widths[k] = (high - low) / slope if slope > 0 else np.nan
    return widths
