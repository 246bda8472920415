"""How a network does on scenes that it is not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from kpbench.detectors.superpoint import decode
from kpbench.patches.design import Patch
from kpbench.training.batches import Batch, make_batch
from kpbench.training.network import SuperPoint
from kpbench.training.recipe import Recipe
from kpbench.types import UInt8

Validation = list[tuple[str, Batch]]


def validation_set(recipe: Recipe, patches: Sequence[Patch], photos: Sequence[UInt8], count: int = 32) -> Validation:
    """Whole images, clean and with the paper's deteriorations, and crops at full severity; fixed by the seed."""
    scenes = replace(recipe.samples, kind="scenes", size=(640, 480), set_size=count)
    crops = replace(recipe.samples, kind="crops", size=(128, 128))
    seed = recipe.seed + 2**31  # away from all training batches
    return [
        ("clean", make_batch(scenes, patches, photos, seed, 0, count, 0.0)),
        ("paper", make_batch(scenes, patches, photos, seed, 0, count, 1.0)),
        ("hard", make_batch(crops, patches, photos, seed, 1, 8 * count, 1.0)),
    ]


@torch.inference_mode()
def evaluate(network: SuperPoint, validation: Validation) -> dict[str, float]:
    """Share of keypoints found within 3 px and within 1 px, right IDs among the former, false alarms an image."""
    network.eval()
    device = next(network.parameters()).device
    figures: dict[str, float] = {}
    for name, batch in validation:
        truths = found = close = right = alarms = 0
        for image, keypoints in zip(batch.images, batch.keypoints, strict=True):
            blob = torch.as_tensor(image, device=device).float()[None, None] / 255
            detector, ids = network(blob)
            detections = decode(detector[0].float().cpu().numpy(), ids[0].float().cpu().numpy())
            explained = np.zeros(len(detections), bool)
            for x, y, patch, ignore in keypoints[keypoints[:, 2] >= 0]:
                distance = np.hypot(*(detections.xy - (x, y)).T)
                explained |= distance <= max(3.0, ignore)
                if ignore:
                    continue
                truths += 1
                if len(distance) and distance.min() <= 3.0:
                    found += 1
                    close += bool(distance.min() <= 1.0)
                    right += bool(detections.patch_id is not None and detections.patch_id[distance.argmin()] == patch)
            alarms += int(np.sum(~explained))
        figures |= {
            f"{name}_found_3px": found / max(truths, 1),
            f"{name}_found_1px": close / max(truths, 1),
            f"{name}_id": right / max(found, 1),
            f"{name}_alarms": alarms / len(batch.images),
        }
    return figures
